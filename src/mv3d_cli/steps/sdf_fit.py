"""A fitted signed distance field on disk, and the mesh that is made of it.

views/             the views that were fitted, as they came, their weights as they counted
field.safetensors  the views' warps and the trained residual; the fusion is made again from both, in closed form
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mv3d_cli.errors import DamagedArtifact, MissingInput

if TYPE_CHECKING:
    from torch import Tensor

    from mv3d_cli.fields.alignment import Alignment
    from mv3d_cli.fields.alignment.warps import Warp
    from mv3d_cli.fields.fusion import Fusion
    from mv3d_cli.fields.relief import Relief
    from mv3d_cli.fields.sdf import Field
    from mv3d_cli.meshes.shots import Shot
    from mv3d_cli.scene.mesh import Mesh
    from mv3d_cli.scene.views import View, Views

FIELD = "field.safetensors"
VIEWS = "views"
_FUSED = ("base", "origin", "voxel")  # of a field's state: made again from the views
BAND = 3  # voxels beyond the fusion's reach in which the residual may have moved the surface


@dataclass(frozen=True)
class MeshSettings:
    """What mesh is made of a fit: most faces, texels a side (0: none), colours at vertices instead, voxels a side."""

    faces: int = 30_000
    texture: int = 1024
    vertex_colors: bool = False
    resolution: int | None = None


@dataclass(frozen=True)
class Fit:
    """Views, how they were aligned, and what was learnt of them.

    fit_from_world  the similarity into the unit sphere in which the fit happened; views are in the world
    residual        the field's trained values; None: the fusion alone
    """

    views: Views
    fit_from_world: np.ndarray
    alignment: Alignment
    resolution: int
    residual: dict[str, Tensor] | None = None


def framed(views: Views, fit_from_world: np.ndarray) -> Views:
    """The views moved to where the fit happens."""
    from mv3d_cli.capture.framing import moved_camera
    from mv3d_cli.scene.views import Views

    if (fit_from_world == np.eye(4)).all():
        return views
    scale = np.float32(np.cbrt(np.linalg.det(fit_from_world[:3, :3])))

    def moved(view: View) -> View:
        depth = None if view.depth is None else view.depth * scale
        return replace(view, camera=moved_camera(view.camera, fit_from_world), depth=depth)

    return Views(tuple(moved(view) for view in views.frames))


def fusion_of(fit: Fit, resolution: int | None = None, device: str = "cpu") -> tuple[list[Relief], Fusion]:
    """The aligned reliefs of a fit, and their fusion. Raises BadViews."""
    from mv3d_cli.fields.alignment.warps import warped
    from mv3d_cli.fields.fusion import fuse
    from mv3d_cli.fields.relief import reliefs_of

    reliefs = reliefs_of(framed(fit.views, fit.fit_from_world))
    aligned = [warped(relief, warp) for relief, warp in zip(reliefs, fit.alignment.warps, strict=True)]
    after = fit.alignment.after
    left = 0.0 if np.isnan(after) else after
    return aligned, fuse(aligned, resolution or fit.resolution, left, device)


def field_of(fusion: Fusion, residual: dict[str, Tensor]) -> Field:
    """The field that a fusion and a residual are. Raises DamagedArtifact for a residual that does not fit."""
    from mv3d_cli.fields import sdf

    field = sdf.field_of(fusion)
    try:
        field.load_state_dict(field.state_dict() | residual)
    except RuntimeError as error:
        raise DamagedArtifact(f"the fit's weights do not fit ({error})", "make the fit again") from None
    return field.eval()


def residual_of(field: Field) -> dict[str, Tensor]:
    """What was trained of a field: all but the fusion that it stands on."""
    return {name: value.detach().cpu() for name, value in field.state_dict().items() if name not in _FUSED}


def mesh_of_fit(folder: Path, settings: MeshSettings) -> Mesh:
    """The textured mesh of a fit on disk, in the world. Raises MissingInput, DamagedArtifact, EmptySurface."""
    return mesh_of(read_fit(folder), settings)


def mesh_of(fit: Fit, settings: MeshSettings) -> Mesh:
    """The textured mesh of a fit, in the world of its views. Raises EmptySurface."""
    from mv3d_cli.meshes.repair import repaired, without_floaters
    from mv3d_cli.meshes.simplify import simplified
    from mv3d_cli.scene.mesh import transform

    bare = without_floaters(_surface(fit, settings.resolution))
    bare = repaired(simplified(bare, settings.faces))
    mesh = _colored(bare, shots_of(fit), settings)
    world_from_fit = np.linalg.inv(fit.fit_from_world)
    return mesh if (world_from_fit == np.eye(4)).all() else transform(mesh, world_from_fit)


def _surface(fit: Fit, resolution: int | None) -> Mesh:
    """The zero of the field as a mesh, in the fit's frame."""
    from mv3d_cli.meshes.surface import surface_of_field, surface_of_grid

    if fit.residual is None:
        _, fusion = fusion_of(fit, resolution)
        return surface_of_grid(fusion.distance, np.array(fusion.origin), fusion.voxel)
    _, fusion = fusion_of(fit)
    field = field_of(fusion, fit.residual)
    distance_of = _distance_of(field)
    if resolution is not None and resolution != fit.resolution:
        last = np.array(fusion.origin) + fusion.voxel * (np.array(fusion.distance.shape) - 1)
        return surface_of_field(distance_of, np.stack([np.array(fusion.origin), last]), resolution)
    distance, near = field.base.numpy().copy(), np.argwhere(_band(fusion)).astype(np.int16)
    origin = np.array(fusion.origin, dtype=np.float32)
    for part in np.array_split(near, max(1, len(near) // 2**18)):
        distance[tuple(part.T)] = distance_of(origin + np.float32(fusion.voxel) * part)
    return surface_of_grid(distance, np.array(fusion.origin), fusion.voxel)


def _band(fusion: Fusion) -> np.ndarray:
    """Nodes near the fusion's surface."""
    from scipy.ndimage import maximum_filter

    close = (np.abs(fusion.distance) < 0.999 * fusion.reach).astype(np.uint8)
    return maximum_filter(close, size=2 * BAND + 1) > 0


def _distance_of(field: Field) -> Callable[[np.ndarray], np.ndarray]:
    import torch

    def distance(points: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return field.distance(torch.from_numpy(np.ascontiguousarray(points, dtype=np.float32))).numpy()

    return distance


def shots_of(fit: Fit) -> list[Shot]:
    """The views as pictures to take colours from, in the fit's frame; none where the views have no colour."""
    from mv3d_cli.meshes.shots import Shot

    shots = []
    for view, warp in zip(framed(fit.views, fit.fit_from_world).frames, fit.alignment.warps, strict=True):
        if view.color is not None and view.weight > 0:
            pixel_of = None if not np.any(warp.offsets) else partial(_pixel_of, view, warp)
            shots.append(Shot(view.camera, view.color, view.weight, pixel_of, view.source == "photo"))
    return shots


def _pixel_of(view: View, warp: Warp, points: np.ndarray) -> np.ndarray:
    """Where the aligned view shows points of the world, (x, y) in its picture as it came."""
    from mv3d_cli.fields.alignment.warps import came_from
    from mv3d_cli.scene.camera import projected

    height, width = view.shape
    return came_from(warp, projected(view.camera, points, width, height)[0], view.shape)


def _colored(bare: Mesh, shots: list[Shot], settings: MeshSettings) -> Mesh:
    """The mesh with a texture or with colours at its vertices; grey where no view has colour."""
    from mv3d_cli.meshes.bake import bake, balanced, vertex_colors
    from mv3d_cli.meshes.unwrap import unwrapped
    from mv3d_cli.scene.mesh import Material

    if not shots:
        return bare
    shots = list(balanced(bare, shots))
    if settings.vertex_colors or not settings.texture:
        return vertex_colors(bare, shots)
    mesh = unwrapped(bare, settings.texture)
    return replace(mesh, materials=(Material(texture=bake(mesh, shots, settings.texture), name="surface"),))


def write_fit(folder: Path, fit: Fit) -> None:
    """Writes a fit into a folder."""
    import torch
    from safetensors.torch import save_file

    from mv3d_cli.formats.views_folder import write_views

    write_views(folder / VIEWS, fit.views)
    warps = fit.alignment.warps
    tensors: dict[str, Any] = {
        "warps.offsets": torch.from_numpy(np.stack([warp.offsets for warp in warps])),
        "warps.values": torch.tensor([[w.scale, w.shift, w.gain] for w in warps], dtype=torch.float64),
        "fit_from_world": torch.from_numpy(fit.fit_from_world),
    }
    for name, value in (fit.residual or {}).items():
        tensors[f"residual.{name}"] = value.contiguous()
    metadata = {"resolution": fit.resolution, "before": fit.alignment.before, "after": fit.alignment.after}
    save_file(tensors, folder / FIELD, {"mv3d": json.dumps(metadata)})


def read_fit(folder: Path) -> Fit:
    """A fit from its folder. Raises MissingInput, DamagedArtifact."""
    from safetensors import SafetensorError, safe_open

    from mv3d_cli.fields.alignment import Alignment
    from mv3d_cli.fields.alignment.warps import Warp
    from mv3d_cli.formats.views_folder import read_views

    if not (folder / FIELD).is_file():
        raise MissingInput(f"{folder} is not a fit: it has no {FIELD}", "`mv3d fit-sdf views/ -o fit/` makes one")
    try:
        with safe_open(folder / FIELD, "pt") as stored:
            metadata = json.loads((stored.metadata() or {})["mv3d"])
            tensors = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118 - it is no dict
        values = tensors["warps.values"].tolist()
        offsets = tensors["warps.offsets"].numpy()
        warps = tuple(Warp(o, *v) for o, v in zip(offsets, values, strict=True))
        alignment = Alignment(warps, float(metadata["before"]), float(metadata["after"]))
        residual = {k.removeprefix("residual."): v for k, v in tensors.items() if k.startswith("residual.")}
        frame, resolution = tensors["fit_from_world"].numpy(), int(metadata["resolution"])
    except (SafetensorError, KeyError, ValueError, OSError) as error:
        raise DamagedArtifact(f"{folder / FIELD} is damaged ({error})", "make the fit again") from None
    return Fit(read_views(folder / VIEWS), frame, alignment, resolution, residual or None)
