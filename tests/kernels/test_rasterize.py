"""The rasteriser against its torch twin, analytic shapes and trimesh's ray caster."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from mv3d_cli.kernels import runtime
from mv3d_cli.kernels.rasterize import rasterize, reference
from mv3d_cli.scene.camera import Camera, Orthographic, Perspective, direction_on_sphere, look_at_origin

ORTHOGRAPHIC = look_at_origin("a", direction_on_sphere(0.4, 0.5), Orthographic(1.1))
PERSPECTIVE = look_at_origin("b", direction_on_sphere(-1.0, 0.2, 2.5), Perspective((1.2, 1.1), (0.45, 0.55)))
INSIDE = Camera("c", np.eye(4), Perspective((0.5, 0.5)))


def soup(seed: int, faces: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """Random triangles that meet and cross."""
    rng = np.random.default_rng(seed)
    vertices = rng.uniform(-0.9, 0.9, (faces * 2, 3)).astype(np.float32)
    return vertices, rng.integers(0, len(vertices), (faces, 3)).astype(np.int32)


@pytest.mark.parametrize("camera", [ORTHOGRAPHIC, PERSPECTIVE, INSIDE], ids=["orthographic", "perspective", "inside"])
@settings(deadline=None, max_examples=8)
@given(seed=st.integers(0, 10_000))
def test_equals_the_torch_twin(camera: Camera, seed: int) -> None:
    vertices, faces = soup(seed)
    ours = rasterize(torch.from_numpy(vertices), torch.from_numpy(faces), [camera], 48, 40)
    twin = reference.rasterize(torch.from_numpy(vertices), torch.from_numpy(faces), [camera], 48, 40)
    same = ours.face == twin.face
    tie = (ours.depth - twin.depth).abs() < 1e-5  # where faces cross or coincide either may win
    assert (same | tie).float().mean() > 0.995  # and they may differ on edges
    seen = same & (twin.face >= 0)
    assert seen.sum() > 100
    assert torch.allclose(ours.depth[seen], twin.depth[seen], atol=1e-4, rtol=1e-4)
    corners = torch.from_numpy(vertices)[torch.from_numpy(faces)[twin.face[seen]]]
    ours_at = (ours.barycentric[seen][..., None] * corners).sum(1)
    twin_at = (twin.barycentric[seen][..., None] * corners).sum(1)
    assert (ours_at - twin_at).norm(dim=-1).quantile(0.99) < 1e-3


@pytest.mark.parametrize("threads", [1, 3])
def test_threads_and_families_change_nothing(threads: int) -> None:
    vertices, faces = soup(3, 400)
    runtime.use_threads(threads)
    try:
        fragments = rasterize(vertices, faces, [PERSPECTIVE], 65, 33)
    finally:
        runtime.use_threads(0)
    for cameras in ([PERSPECTIVE], [PERSPECTIVE, ORTHOGRAPHIC, INSIDE]):
        tensors = rasterize(torch.from_numpy(vertices), torch.from_numpy(faces), cameras, 65, 33)
        assert np.array_equal(fragments.face[0], tensors.face[0].numpy())
        assert np.array_equal(fragments.depth[0], tensors.depth[0].numpy())


def test_plane_depth_is_exact_and_gapless() -> None:
    """A tilted square of many triangles: depth follows the plane's equation and no pixel inside is missed."""
    grid = np.linspace(-1, 1, 38)
    x, y = np.meshgrid(grid, grid)
    vertices = np.stack([x, 0.3 * x - 0.2 * y, y], axis=-1).reshape(-1, 3).astype(np.float32)
    i = np.arange(38 * 38).reshape(38, 38)
    quads = np.stack([i[:-1, :-1], i[:-1, 1:], i[1:, 1:], i[1:, :-1]], -1).reshape(-1, 4)
    faces = np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]]).astype(np.int32)
    front = look_at_origin("front", (0.0, -2.0, 0.0), Orthographic())
    depth = rasterize(vertices, faces, [front], 301, 301).depth[0]
    centre = (np.arange(301) + 0.5) / 301 * 2 - 1
    expected = 2 + 0.3 * centre[None, :] - 0.2 * -centre[:, None]
    assert (depth > 0).all()
    assert np.abs(depth - expected).max() < 1e-5


def test_sphere_depth_is_analytic() -> None:
    sphere = trimesh.creation.icosphere(subdivisions=6, radius=0.8)
    cameras = [look_at_origin(str(a), direction_on_sphere(a, 0.3), Orthographic()) for a in (0.0, 1.0, 2.0)]
    fragments = rasterize(sphere.vertices.astype(np.float32), sphere.faces.astype(np.int32), cameras, 128, 128)
    c = (np.arange(128) + 0.5) / 64 - 1
    radius2 = c[None, :] ** 2 + c[:, None] ** 2
    inner = radius2 < 0.6
    expected = 2 - np.sqrt(np.maximum(0.64 - radius2, 0))
    for depth in fragments.depth:
        assert np.abs(depth - expected)[inner].max() < 5e-4  # the chords' sagitta
        assert not depth[radius2 > 0.6401].any()


@pytest.mark.parametrize("camera", [ORTHOGRAPHIC, PERSPECTIVE], ids=["orthographic", "perspective"])
def test_agrees_with_trimesh_rays(camera: Camera) -> None:
    mesh = trimesh.creation.torus(0.6, 0.25, major_sections=24, minor_sections=16)
    vertices, faces = mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32)
    fragments = rasterize(vertices, faces, [camera], 64, 64)
    origin, direction = (part.reshape(-1, 3).numpy() for part in reference._rays(camera, 64, 64))
    rotation, eye = camera.world_from_camera[:3, :3], camera.world_from_camera[:3, 3]
    start, along = origin @ rotation.T + eye, direction @ rotation.T
    tester = trimesh.ray.ray_triangle.RayMeshIntersector(trimesh.Trimesh(vertices, faces, process=False))
    points, rays, hit = tester.intersects_location(start, along, multiple_hits=False)
    depth, face = fragments.depth[0].reshape(-1), fragments.face[0].reshape(-1)
    assert (face[rays] == hit).mean() > 0.995
    assert np.quantile(np.abs(depth[rays] - ((points - eye) @ rotation)[:, 2]), 0.99) < 1e-4
    assert abs(len(rays) - (face >= 0).sum()) < 0.01 * len(rays)


def test_nothing_in_front_is_nothing() -> None:
    vertices, faces = soup(1)
    away = np.eye(4)
    away[2, 3] = 5.0
    behind = Camera("behind", away, Perspective((1.0, 1.0)))
    assert (rasterize(vertices, faces, [behind], 16, 16).face == -1).all()


@pytest.mark.cuda
def test_cuda_equals_cpu() -> None:
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    vertices, faces = (torch.from_numpy(part) for part in soup(5, 3000))
    cameras = [ORTHOGRAPHIC, PERSPECTIVE, INSIDE]
    host = rasterize(vertices, faces, cameras, 96, 80)
    card = rasterize(vertices.cuda(), faces.cuda(), cameras, 96, 80)
    assert (host.face == card.face.cpu()).float().mean() > 0.999
    assert torch.allclose(host.depth, card.depth.cpu(), atol=1e-4) or (host.face != card.face.cpu()).any()
