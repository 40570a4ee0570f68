"""The published mesh protocol on spheres, whose scores are known, and its cameras on the real renders."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from mv3d_cli.kernels.rasterize import rasterize
from mv3d_cli.metrics.overlap import iou
from mv3d_cli.metrics.syncdreamer import chamfer, seen_points, syncdreamer_scores
from mv3d_cli.scene.camera import Camera, Orthographic, Perspective, direction_on_sphere, look_at_origin
from mv3d_cli.scene.mesh import Material, Mesh

OBJECTS = (
    "alarm", "blocks", "chicken", "grandmother", "hat", "shoe1", "sofa", "stucking_cups", "teapot", "toaster",
)  # fmt: skip


@pytest.fixture(scope="module")
def cameras() -> list[Camera]:
    """Sixteen as published."""
    lens = Perspective((280 / 256,) * 2)
    places = [direction_on_sphere(k * np.pi / 8, np.pi / 6, 1.5) for k in range(16)]
    return [look_at_origin(f"{k:03d}", place, lens) for k, place in enumerate(places)]


def sphere(radius: float) -> Mesh:
    ball = trimesh.creation.icosphere(5, radius)
    faces = ball.faces.astype(np.int32)
    return Mesh(ball.vertices.astype(np.float32), faces, np.zeros(len(faces), np.int32), (Material(),))


def test_spheres_of_known_distance(cameras: list[Camera]):
    distance, overlap = syncdreamer_scores(sphere(0.46), sphere(0.5), cameras)
    assert distance == pytest.approx(0.04, rel=0.03)
    assert overlap == pytest.approx((0.46 / 0.5) ** 3, abs=0.015)
    assert syncdreamer_scores(sphere(0.5), sphere(0.5), cameras) == (0.0, 1.0)


@pytest.mark.parametrize("lens", [Perspective((280 / 256,) * 2, (0.45, 0.55)), Orthographic(0.7)])
def test_seen_points_lie_on_the_sphere_that_is_seen(lens: Perspective | Orthographic):
    camera = look_at_origin("a", (0.5, -1.2, 0.6), lens)
    points = seen_points(sphere(0.5), [camera])
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 0.5, atol=5e-4)
    assert (points @ np.array([0.5, -1.2, 0.6])).min() > 0


def test_what_no_camera_sees_counts_only_inside(cameras: list[Camera]):
    """A core inside the shell leaves the distance as it is."""
    shell, core = sphere(0.5), sphere(0.3)
    faces = np.concatenate([shell.faces, core.faces + len(shell.vertices)])
    both = Mesh(np.concatenate([shell.vertices, core.vertices]), faces, np.zeros(len(faces), np.int32), (Material(),))
    distance, overlap = syncdreamer_scores(both, shell, cameras)
    assert distance == 0
    assert overlap == pytest.approx(1 - 0.6**3, abs=0.01)


def test_chamfer_is_the_mean_of_both_ways():
    one = np.array([[0.0, 0, 0]])
    assert chamfer(one, np.array([[3.0, 4, 0], [0, 0, 1]])) == pytest.approx((1 + (5 + 1) / 2) / 2)
    assert np.isnan(chamfer(one, np.zeros((0, 3))))


@pytest.mark.parametrize("name", OBJECTS)
def test_true_meshes_cover_their_renders(name: str, shared: Path, monkeypatch: pytest.MonkeyPatch):
    benchmarks = Path(__file__).resolve().parents[2] / "benchmarks"
    monkeypatch.syspath_prepend(benchmarks)
    scores = pytest.importorskip("reconstruction_scores")
    views, mesh = scores.synced_object(name)
    rig = [view.camera for view in views.frames]
    depths = rasterize(mesh.vertices, mesh.faces, rig, 256, 256).depth
    overlaps = [iou(depth > 0, view.color[..., 3] > 127) for depth, view in zip(depths, views.frames, strict=True)]
    assert len(overlaps) == 16
    assert min(overlaps) > 0.995
    assert set(scores.SYNCED) == set(OBJECTS)
