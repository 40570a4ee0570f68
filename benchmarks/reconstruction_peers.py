"""What people fuse depth views with, each a plain function views -> mesh, set as well as we could.

tsdf             truncated signed distances (Curless & Levoy, 1996): nearest pixels, equal weights, binary visual hull
tsdf_plus        the same with bilinear depth, weights of cos^2 and a hull with its edge inside the pixel
poisson          screened Poisson (Kazhdan & Hoppe, 2013) of pymeshlab on the depth pixels and their normals
trimmed          what any of them made, cut off outside the silhouettes

Parallel cameras, square pictures with colour and depth; signed distances are positive outside.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn.functional import grid_sample

from mv3d_cli.capture.normals import normals_from_depth
from mv3d_cli.scene.camera import Camera, Orthographic
from mv3d_cli.scene.mesh import Material, Mesh
from mv3d_cli.scene.views import Views

VOXEL = 2 / 192  # scene units
MARGIN = 4  # voxels around what is seen
STEP_ACROSS = 0.03  # bilinear depth does not reach over steps higher than this
TRIM_PIXELS = 2.0

Picture = Float[np.ndarray, "height width"]
Columns = Float[Tensor, "xy z"]


@dataclass(frozen=True)
class Sight:
    """One view: depth, the silhouette's distance (scene units), `pixel` = a pixel's width in scene units."""

    camera: Camera
    depth: Picture
    outside: Picture
    extent: float
    pixel: float


def tsdf(views: Views, tau: float = 0.04) -> Mesh:
    """Truncated signed distances with nearest pixels, equal weights and a binary hull."""
    sights = _sights(views)
    axes = _axes(sights)
    total, weights, hull = torch.zeros(()), torch.zeros(()), torch.tensor(-torch.inf)
    for sight, place, z in _lookups(sights, axes):
        depth = _looked_up(sight.depth, place, "nearest")
        known = (depth > 0) & (depth - z > -tau)
        total = total + (depth - z).clamp(-tau, tau) * known
        weights = weights + known
        hull = torch.maximum(hull, torch.where(depth > 0, -tau, tau))
    return _surface(torch.maximum(_mean(total, weights, tau), hull), axes)


def tsdf_plus(views: Views, tau: float = 0.04) -> Mesh:
    """Truncated signed distances with bilinear depth, cos^2 weights and a sub-pixel hull.

    The best tau is about .025 for clean views, and .08 for generated ones (.06 where there are thin wings).
    """
    sights = _sights(views)
    axes = _axes(sights)
    total, weights, hull = torch.zeros(()), torch.zeros(()), torch.tensor(-torch.inf)
    for sight, place, z in _lookups(sights, axes):
        filled = _filled(sight.depth, sight.depth > 0)
        depth, nearest = (_looked_up(filled, place, mode) for mode in ("bilinear", "nearest"))
        depth = torch.where((depth - nearest).abs() < STEP_ACROSS, depth, nearest)
        outside = _looked_up(sight.outside, place, "bilinear")
        facing = _filled(normals_from_depth(sight.depth, sight.camera)[..., 2], sight.depth > 0)
        weight = _looked_up(facing, place, "bilinear") ** 2 * ((depth - z > -tau) & (outside < 0))
        total = total + (depth - z).clamp(-tau, tau) * weight
        weights = weights + weight
        hull = torch.maximum(hull, outside)
    return _surface(torch.maximum(_mean(total, weights, tau), hull), axes)


def poisson(views: Views, depth: int = 8) -> Mesh:
    """Screened Poisson on every depth pixel, oriented by normals from depth."""
    import pymeshlab

    points, normals = zip(*map(_oriented_points, _sights(views)), strict=True)
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(np.concatenate(points), v_normals_matrix=np.concatenate(normals)))
    # one thread: its threads wait for each other busily, and take ten times as long where a core is not free
    meshes.generate_surface_reconstruction_screened_poisson(depth=depth, threads=1)
    found = meshes.current_mesh()
    return _mesh(found.vertex_matrix(), found.face_matrix())


def trimmed(mesh: Mesh, views: Views) -> Mesh:
    """A mesh of the views without the faces that leave a silhouette by more than TRIM_PIXELS; it is open there."""
    kept = np.ones(len(mesh.vertices), bool)
    for sight in _sights(views):
        move = sight.camera.camera_from_world
        place = (mesh.vertices @ move[:2, :3].T + move[:2, 3]) / sight.extent
        outside = _looked_up(sight.outside, torch.as_tensor(place, dtype=torch.float32)[None, None], "bilinear")
        kept &= (outside[0] < TRIM_PIXELS * sight.pixel).numpy()
    return _mesh(mesh.vertices, mesh.faces[kept[mesh.faces].all(axis=1)])


def _sights(views: Views) -> list[Sight]:
    found = []
    for view in views.frames:
        lens = view.camera.projection
        assert isinstance(lens, Orthographic)
        assert view.color is not None
        assert view.depth is not None
        pixel = 2 * lens.half_extent / view.shape[1]
        outside = _distance_outside(view.color[..., 3] / 255) * pixel
        found.append(Sight(view.camera, view.depth, outside, lens.half_extent, pixel))
    return found


def _distance_outside(alpha: Picture) -> Picture:
    """Pixels to the silhouette, positive outside; alpha places the edge inside its pixels."""
    inside = alpha >= 0.5
    inner, outer = (np.asarray(distance_transform_edt(part)) for part in (inside, ~inside))
    distance = np.where(inside, 0.5 - inner, outer - 0.5)
    return np.where(np.abs(distance) < 1, 0.5 - alpha, distance)


def _filled(picture: Picture, known: np.ndarray) -> Picture:
    rows, columns = np.asarray(distance_transform_edt(~known, return_distances=False, return_indices=True))
    return picture[rows, columns]


def _oriented_points(sight: Sight) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """World points and outward normals of the pixels that have depth."""
    rows, columns = np.nonzero(sight.depth > 0)
    half = np.array(sight.depth.shape) / 2
    across, down = (columns + 0.5 - half[1]) * sight.pixel, (rows + 0.5 - half[0]) * sight.pixel
    world_from_camera = sight.camera.world_from_camera
    points = np.stack([across, down, sight.depth[rows, columns]], axis=1)
    normals = normals_from_depth(sight.depth, sight.camera)[rows, columns] * [1, -1, -1]
    return points @ world_from_camera[:3, :3].T + world_from_camera[:3, 3], normals @ world_from_camera[:3, :3].T


def _axes(sights: list[Sight]) -> list[Float[Tensor, "n"]]:
    """Voxel centres along x, y, z around all that is seen."""
    points = np.concatenate([_oriented_points(sight)[0] for sight in sights])
    low, high = points.min(axis=0) - MARGIN * VOXEL, points.max(axis=0) + MARGIN * VOXEL
    return [torch.arange(float(a), float(b), VOXEL) for a, b in zip(low, high, strict=True)]


def _lookups(sights: list[Sight], axes: list[Tensor]) -> Iterator[tuple[Sight, Float[Tensor, "1 xy z 2"], Columns]]:
    """Per view: where every voxel lies in the picture (in grid_sample's units), and its z."""
    x, y, z = axes
    for sight in sights:
        move = torch.as_tensor(sight.camera.camera_from_world, dtype=torch.float32)
        across, down, deep = ((m[0] * x[:, None, None] + m[1] * y[:, None] + m[2] * z) + m[3] for m in move[:3])
        place = torch.stack([across, down], dim=-1) / sight.extent
        yield sight, place.flatten(0, 1)[None], deep.flatten(0, 1)


def _looked_up(picture: Picture, place: Float[Tensor, "1 a b 2"], mode: str) -> Float[Tensor, "a b"]:
    source = torch.as_tensor(np.ascontiguousarray(picture, np.float32))[None, None]
    return grid_sample(source, place, mode, "border", align_corners=False)[0, 0]


def _mean(total: Columns, weights: Columns, tau: float) -> Columns:
    """Weighted mean distance; what no view speaks of lies behind all they see: inside."""
    return torch.where(weights > 1e-6, total / weights.clamp_min(1e-6), -tau)


def _surface(field: Columns, axes: list[Tensor]) -> Mesh:
    """The zero level as a mesh, by marching cubes (Lewiner et al., 2003)."""
    from skimage.measure import marching_cubes

    volume = field.unflatten(0, (len(axes[0]), len(axes[1]))).numpy()
    vertices, faces, _, _ = marching_cubes(volume, 0.0, spacing=(VOXEL,) * 3, gradient_direction="ascent")
    return _mesh(vertices + [float(axis[0]) for axis in axes], faces)


def _mesh(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    faces = np.ascontiguousarray(faces, np.int32)
    return Mesh(np.ascontiguousarray(vertices, np.float32), faces, np.zeros(len(faces), np.int32), (Material(),))
