"""What the reconstruction benchmarks share: objects, their clean views, their true surface, scores of a mesh."""

from __future__ import annotations

import warnings

import numpy as np

from mv3d_cli.capture.lighting import studio
from mv3d_cli.capture.rendering import render
from mv3d_cli.formats.cameras import load_cameras, select
from mv3d_cli.formats.images import read_image
from mv3d_cli.formats.meshes import MeshFile, MeshWarning, read_mesh
from mv3d_cli.kernels.rasterize import rasterize
from mv3d_cli.metrics.shape import ShapeScores, Surface, outer_surface, shape_scores
from mv3d_cli.scene.camera import Camera, projected
from mv3d_cli.scene.mesh import Mesh, transform
from mv3d_cli.scene.rig import HORIZONTAL
from mv3d_cli.scene.views import View, Views
from shared_data import scanned_mesh, shared

SCANS = (
    "Air_Hogs_Wind_Flyers_Set_Airplane_Red", "Android_Figure_Panda", "BUNNY_RACER",
    "Breyer_Horse_Of_The_Year_2015", "Cole_Hardware_Hammer_Black", "Crayola_Crayons_24_count", "Dino_4",
    "Kong_Puppy_Teething_Rubber_Small_Pink", "Nintendo_Yoshi_Action_Figure", "Now_Designs_Bowl_Akita_Black",
    "Room_Essentials_Mug_White_Yellow", "Sapota_Threshold_4_Ceramic_Round_Planter_Red", "Schleich_Bald_Eagle",
    "Schleich_Spinosaurus_Action_Figure", "Sootheze_Toasty_Orca", "Threshold_Porcelain_Spoon_Rest_White",
    "Twinlab_Nitric_Fuel", "Wishbone_Pencil_Case",
)  # fmt: skip
TUNED_ON = SCANS[::2]
HELD_OUT = SCANS[1::2]
"""Nothing is ever chosen by the scores of these."""

SYNCED = (
    "alarm", "blocks", "chicken", "grandmother", "hat", "shoe1", "sofa", "stucking_cups", "teapot", "toaster",
)  # fmt: skip
TURNED = ("alarm", "blocks", "chicken", "grandmother", "sofa")  # their meshes by a quarter of a turn

POINTS = 150_000
VISIBILITY = 1024  # pixels a side of the pictures that say what the rig sees
STEP = 0.006  # a point this far behind what the camera sees is hidden from it


def rig() -> tuple[Camera, ...]:
    """The eight horizontal cameras."""
    return select(load_cameras(), HORIZONTAL)


def clean_views(name: str, size: int = 256) -> tuple[Mesh, Views]:
    """A scan in the unit sphere, and its eight horizontal views in studio light."""
    mesh = scanned_mesh(name)
    return mesh, render(mesh, rig(), size, studio())


def ground_truth(mesh: Mesh) -> Surface:
    """The outer surface of a true mesh, and which of it the eight horizontal cameras see."""
    outer = outer_surface(mesh.vertices, mesh.faces, POINTS, seed=0)
    return Surface(outer.points, outer.normals, _seen_by_rig(mesh, outer.points))


def _seen_by_rig(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    seen = np.zeros(len(points), bool)
    cameras = rig()
    depths = rasterize(mesh.vertices, mesh.faces, cameras, VISIBILITY, VISIBILITY).depth
    for camera, depth in zip(cameras, depths, strict=True):
        (column, row), z = (part.T for part in projected(camera, points, VISIBILITY, VISIBILITY))
        place = tuple(np.clip(np.floor(v).astype(int), 0, VISIBILITY - 1) for v in (row, column))
        seen |= z < depth[place] + STEP
    return seen


def score(mesh: Mesh, truth: Surface) -> ShapeScores:
    """Scores of a mesh's outer surface."""
    return shape_scores(outer_surface(mesh.vertices, mesh.faces, POINTS, seed=1), truth)


def is_watertight(mesh: Mesh) -> bool:
    """Whether the surface has no border: vertices at one place are one, and every edge has an even number of faces.

    Texture seams are no holes then, nor are sheets that touch along an edge, where four faces meet.
    """
    _, place = np.unique(mesh.vertices, axis=0, return_inverse=True)
    faces = place.reshape(-1)[mesh.faces]
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges = edges[edges[:, 0] != edges[:, 1]]
    return not (np.unique(edges, axis=0, return_counts=True)[1] % 2).any()


def synced_object(name: str) -> tuple[Views, Mesh]:
    """An object of the SyncDreamer test set in its cameras' world: its 16 renders, its mesh of longest side 1."""
    folder = shared(f"gso30/{name}")
    cameras = load_cameras(folder.parent / "cameras.json")
    frames = tuple(View(camera, read_image(folder / f"{camera.name}.png")) for camera in cameras)
    with warnings.catch_warnings(category=MeshWarning, action="ignore"):  # its materials are not there
        mesh = read_mesh(MeshFile(name, folder / "model.obj"), up="z")
    if name in TURNED:
        mesh = transform(mesh, np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]))
    return Views(frames), unit_box(mesh)


def unit_box(mesh: Mesh) -> Mesh:
    """The mesh with its bounding box centred on the origin, the longest side 1."""
    used = mesh.vertices[np.unique(mesh.faces)]
    low, high = used.min(axis=0), used.max(axis=0)
    similarity = np.eye(4) / float((high - low).max())
    similarity[:3, 3] = -similarity[0, 0] * (low + high) / 2
    similarity[3, 3] = 1
    return transform(mesh, similarity)
