"""Objects brought into the unit sphere: meshes, at random turns, and other people's scenes by their silhouettes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from mv3d_cli.errors import BadMesh, BadViews
from mv3d_cli.scene.camera import Camera, Orthographic, Perspective, pixel_from_camera
from mv3d_cli.scene.mesh import Mesh, transform, unit_sphere_from_mesh

MARGIN = 1.02  # of the sphere that the outlines span
ROOM = 0.35  # scene units: a centre within, and a radius up to 1, is where our own views have the object


def unit_sphere_from_views(
    cameras: Sequence[Camera], masks: Sequence[Bool[np.ndarray, "height width"] | None]
) -> Float[np.ndarray, "4 4"]:
    """The similarity that brings the object into the unit sphere; the identity where it lies there already.

    The centre is the point nearest to the rays through the silhouettes' middles, the radius reaches the silhouettes'
    farthest pixels. Raises BadViews where the cameras do not look at one object.
    """
    seen = [(camera, mask) for camera, mask in zip(cameras, masks, strict=True) if mask is not None and mask.any()]
    if len(seen) < 2:
        return np.eye(4)
    rays = [_ray(camera, _middle(mask), mask.shape) for camera, mask in seen]
    centre = _nearest_point(rays)
    if any((centre - place) @ along <= 0 for place, along in rays):
        raise BadViews(
            "the cameras do not look at one object: what they show lies behind some of them",
            "check transform_matrix: nerfstudio's cameras look along -z, with y up",
        )
    radius = max(_radius(camera, mask, centre) for camera, mask in seen)
    if np.linalg.norm(centre) < ROOM and 0.4 < radius <= MARGIN and np.linalg.norm(centre) + 0.9 * radius < 1.1:
        return np.eye(4)
    scale = 1 / (MARGIN * radius)
    similarity = np.diag([scale, scale, scale, 1.0])
    similarity[:3, 3] = -scale * centre
    return similarity


def placed(mesh: Mesh, turned: Float[np.ndarray, "4 4"]) -> tuple[Mesh, Float[np.ndarray, "4 4"]]:
    """The mesh turned and brought into the unit sphere, and the similarity that did it. Raises BadMesh."""
    moved = transform(mesh, turned)
    similarity = unit_sphere_from_mesh(moved)
    if not np.isfinite(similarity).all():
        raise BadMesh("the mesh has no extent", "all of its vertices lie in one place; check the file")
    return transform(moved, similarity), similarity @ turned


def random_turn(rng: np.random.Generator, tilt: float) -> Float[np.ndarray, "4 4"]:
    """A turn about +Z, even over the circle, then a tip of up to `tilt` degrees about a random horizontal axis."""
    from scipy.spatial.transform import Rotation

    axis = rng.uniform(0, 2 * np.pi)
    tip = Rotation.from_rotvec(np.deg2rad(rng.uniform(0, tilt)) * np.array([np.cos(axis), np.sin(axis), 0.0]))
    turned = np.eye(4)
    turned[:3, :3] = (tip * Rotation.from_euler("z", rng.uniform(0, 2 * np.pi))).as_matrix()
    return turned


def moved_camera(camera: Camera, b_from_a: Float[np.ndarray, "4 4"]) -> Camera:
    """The camera that sees the world moved by a similarity as it was seen before."""
    scale = float(np.cbrt(np.linalg.det(b_from_a[:3, :3])))
    pose = camera.world_from_camera.copy()
    pose[:3, :3] = b_from_a[:3, :3] @ pose[:3, :3] / scale
    pose[:3, 3] = b_from_a[:3, :3] @ pose[:3, 3] + b_from_a[:3, 3]
    projection = camera.projection
    if isinstance(projection, Orthographic):
        projection = Orthographic(projection.half_extent * scale)
    return replace(camera, world_from_camera=pose, projection=projection)


def _middle(mask: np.ndarray) -> np.ndarray:
    """The middle of the mask's box, (x, y) in pixels."""
    rows, columns = np.nonzero(mask)
    return np.array([columns.min() + columns.max() + 1, rows.min() + rows.max() + 1]) / 2


def _ray(camera: Camera, pixel: np.ndarray, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Origin and unit direction, in the world, of a pixel's ray."""
    (sx, ox), (sy, oy) = pixel_from_camera(camera, shape[1], shape[0])
    across = np.array([(pixel[0] - ox) / sx, (pixel[1] - oy) / sy])
    pinhole = isinstance(camera.projection, Perspective)
    start = np.zeros(3) if pinhole else np.array([*across, 0.0])
    along = np.array([*across, 1.0]) if pinhole else np.array([0.0, 0.0, 1.0])
    pose = camera.world_from_camera
    return pose[:3, :3] @ start + pose[:3, 3], pose[:3, :3] @ along / np.linalg.norm(along)


def _nearest_point(rays: Sequence[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """The point with the least squared distance to all lines; what they do not determine is nearest to the origin."""
    system, right = 1e-9 * np.eye(3), np.zeros(3)
    for place, along in rays:
        across = np.eye(3) - np.outer(along, along)
        system += across
        right += across @ place
    return np.linalg.solve(system, right)


def _radius(camera: Camera, mask: np.ndarray, centre: np.ndarray) -> float:
    """How far the silhouette reaches from the centre, at the centre's depth, scene units."""
    rows, columns = np.nonzero(mask)
    (sx, ox), (sy, oy) = pixel_from_camera(camera, mask.shape[1], mask.shape[0])
    x, y, z = (camera.camera_from_world @ [*centre, 1.0])[:3]
    unit = z if isinstance(camera.projection, Perspective) else 1.0
    return float(np.hypot((columns + 0.5 - ox) / sx * unit - x, (rows + 0.5 - oy) / sy * unit - y).max())
