"""What cannot be used is refused in two lines, and nothing is left behind; what can be used half is, with a warning."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from PIL import Image

from mv3d_cli.formats.images import read_image

TINY = ("--size", 16)


def truncated(path: Path) -> None:
    trimesh.creation.box().export(path)
    path.write_bytes(path.read_bytes()[:-200])


def gltf(path: Path, **content: object) -> None:
    path.write_text(json.dumps({"asset": {"version": "2.0"}, **content}))


def without_faces(path: Path) -> None:
    gltf(path, scenes=[{"nodes": [0]}], nodes=[{"name": "empty"}], scene=0)


def points_only(path: Path) -> None:
    trimesh.PointCloud(np.eye(3)).export(path)


def not_finite(path: Path) -> None:
    box = trimesh.creation.box()
    vertices = box.vertices.astype(np.float32)
    vertices[3] = np.nan
    write_ply(path, vertices, box.faces)


def degenerate(path: Path) -> None:
    write_ply(path, np.float32([[0, 0, 0], [1, 1, 1], [2, 2, 2]]), np.array([[0, 1, 2], [0, 0, 1]]))


def one_place(path: Path) -> None:
    write_ply(path, np.ones((3, 3), np.float32), np.array([[0, 1, 2]]))


def missing_vertex(path: Path) -> None:
    write_ply(path, np.eye(3, dtype=np.float32), np.array([[0, 1, 7]]))


def outside(path: Path) -> None:
    triangle = {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}
    gltf(
        path,
        buffers=[{"uri": "../../etc/passwd", "byteLength": 36}],
        bufferViews=[{"buffer": 0, "byteLength": 36}],
        accessors=[triangle],
        meshes=[{"primitives": [{"attributes": {"POSITION": 0}}]}],
        nodes=[{"mesh": 0}],
        scenes=[{"nodes": [0]}],
    )


def not_gltf(path: Path) -> None:
    path.write_bytes(bytes(range(256)) * 4)


def empty(path: Path) -> None:
    path.write_bytes(b"")


BAD = {
    "truncated.glb": (truncated, "truncated"),
    "no_faces.gltf": (without_faces, "face"),
    "points.ply": (points_only, "face"),
    "nan.ply": (not_finite, "finite"),
    "degenerate.ply": (degenerate, "area"),
    "one_place.ply": (one_place, "area"),
    "missing_vertex.ply": (missing_vertex, "vertex 7"),
    "outside.gltf": (outside, "outside its folder"),
    "noise.glb": (not_gltf, "gltf"),
    "empty.stl": (empty, ""),
    "empty.glb": (empty, "gltf"),
}


def write_ply(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """A binary PLY, as it stands: nothing is checked or mended."""
    kinds = "".join(f"property float {axis}\n" for axis in "xyz")
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n{kinds}"
    header += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    rows = np.empty(len(faces), [("count", "u1"), ("corners", "<i4", 3)])
    rows["count"], rows["corners"] = 3, faces
    path.write_bytes(header.encode() + vertices.astype("<f4").tobytes() + rows.tobytes())


def textured(folder: Path, texture: bytes | None) -> Path:
    """A square that faces the front with a texture, which is missing where it is None."""
    folder.mkdir(exist_ok=True)
    (folder / "a.obj").write_text(
        "mtllib a.mtl\nv -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
        "usemtl m\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"
    )
    (folder / "a.mtl").write_text("newmtl m\nKd 1 1 1\nmap_Kd a.png\n")
    if texture is not None:
        (folder / "a.png").write_bytes(texture)
    return folder / "a.obj"


def colours(folder: Path) -> set[tuple[int, ...]]:
    pixels = read_image(folder / "color" / "front.png")
    return {tuple(map(int, pixel)) for pixel in pixels[pixels[..., 3] == 255]}


def measured(words: list[object]) -> tuple[subprocess.CompletedProcess[str], float]:
    """A run of the command, and the GB of memory that it took."""
    code = """
    import resource, subprocess, sys
    done = subprocess.run([sys.executable, "-m", "mv3d_cli", *sys.argv[1:]])
    print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss, file=sys.stderr)
    sys.exit(done.returncode)
    """
    command = [sys.executable, "-c", textwrap.dedent(code), *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True)
    return done, int(done.stderr.splitlines()[-1]) / 1e6


@pytest.mark.parametrize("name", BAD)
def test_a_mesh_that_cannot_be_used(refused, tmp_path, cache_folder, name):
    make, reason = BAD[name]
    make(tmp_path / name)
    ran = refused("render", tmp_path / name, *TINY, "-o", tmp_path / "out")
    assert reason in ran.stderr.splitlines()[0].lower()
    assert name in ran.stderr
    assert os.listdir(tmp_path) == [name]
    assert not [*cache_folder.glob("v1/render/*/*[!k]")]  # only .lock files


def test_all_of_them_in_a_batch(mv3d, ball, tmp_path):
    for name, (make, _) in BAD.items():
        make(tmp_path / name)
    ran = mv3d("render", tmp_path, ball, *TINY)
    failures = json.loads((ran.path / "failures.json").read_text())
    assert sorted(Path(failure["source"]).name for failure in failures) == sorted(BAD)
    for failure in failures:
        assert BAD[Path(failure["source"]).name][1] in failure["reason"].lower()
        assert failure["hint"]
    assert [entry["name"] for entry in json.loads((ran.path / "index.json").read_text())["objects"]] == ["ball"]
    assert f"{len(BAD)} of {len(BAD) + 1} objects failed" in ran.stderr


def test_inputs_that_are_not_there(refused, tmp_path):
    assert "none.glb" in refused("render", tmp_path / "none.glb", "-o", tmp_path / "out").stderr
    assert "no mesh" in refused("render", tmp_path, "-o", tmp_path / "out").stderr
    (tmp_path / "a.txt").write_text("not a mesh")
    assert "a.txt" in refused("render", tmp_path / "a.txt").stderr
    assert os.listdir(tmp_path) == ["a.txt"]


@pytest.mark.parametrize("texture", [None, b"not a picture", b""])
def test_a_texture_that_cannot_be_had_is_grey(mv3d, tmp_path, texture):
    ran = mv3d("render", textured(tmp_path / "obj", texture), *TINY, "--lighting", "none", "--views", "front")
    assert [line.split(":")[0] for line in ran.stderr.splitlines()] == ["warning"]
    assert "a.png" in ran.stderr
    assert colours(ran.path) == {(128, 128, 128, 255)}
    assert json.loads((ran.path / "object.json").read_text())["warnings"]


def test_a_texture_that_can_be_had_is_not_grey(mv3d, tmp_path):
    red = cv2.imencode(".png", np.full((4, 4, 3), (0, 0, 255), np.uint8))[1].tobytes()
    ran = mv3d("render", textured(tmp_path / "obj", red), *TINY, "--lighting", "none", "--views", "front")
    assert (colours(ran.path), ran.stderr) == ({(255, 0, 0, 255)}, "")


def test_a_huge_texture_takes_little_memory(tmp_path):
    mesh = textured(tmp_path / "obj", None)
    Image.new("L", (20_000, 20_000), "white").save(mesh.with_name("a.png"), compress_level=1)
    done, gigabytes = measured(["render", mesh, *TINY, "--lighting", "none", "--views", "front"])
    assert "20000" in done.stderr
    assert (done.returncode, gigabytes < 2) == (0, True), (done.stderr, gigabytes)
    assert colours(Path(done.stdout.strip())) == {(255, 255, 255, 255)}


def test_a_mesh_of_two_million_faces(tmp_path):
    side = 1001
    x, y = np.meshgrid(*[np.linspace(-1, 1, side, dtype=np.float32)] * 2)
    corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).reshape(-1, 1)
    faces = (corner + np.array([0, 1, side + 1, 0, side + 1, side])).reshape(-1, 3)
    write_ply(tmp_path / "grid.ply", np.stack([x, y, 0.3 * np.sin(3 * x)], axis=-1).reshape(-1, 3), faces)
    done, gigabytes = measured(["render", tmp_path / "grid.ply", "--size", 64, "--views", "front,top"])
    assert (done.returncode, gigabytes < 4) == (0, True), (done.stderr, gigabytes)
    assert json.loads((Path(done.stdout.strip()) / "object.json").read_text())["faces"] == 2_000_000


def test_outputs_that_cannot_be_written(refused, ball, tmp_path, cache_folder):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "theirs.txt").write_text("theirs")
    places = [tmp_path / "file", tmp_path / "file" / "below", tmp_path / "folder", Path("/proc/mv3d"), cache_folder]
    for place in places:
        refused("render", ball, *TINY, "-o", place)
    assert (tmp_path / "file").read_text() == "mine"
    assert os.listdir(tmp_path / "folder") == ["theirs.txt"]


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_without_permission(refused, ball, tmp_path):
    (tmp_path / "locked").mkdir(mode=0o500)
    refused("render", ball, *TINY, "-o", tmp_path / "locked" / "out")


def test_a_cache_that_cannot_be_written(refused, ball, tmp_path):
    (tmp_path / "file").write_text("mine")
    ran = refused("render", ball, *TINY, env={"MV3D_CACHE_DIR": str(tmp_path / "file" / "cache")})
    assert "MV3D_CACHE_DIR" in ran.stderr


@pytest.mark.parametrize(
    ("words", "problem", "advice"),
    [
        (["--views", "frnt"], "frnt", "did you mean front?"),
        (["--views", "front,front"], "front", "once"),
        (["--size", "-5"], "--size -5", "8 to 8192"),
        (["--size", "100000"], "--size 100000", "8 to 8192"),
        (["--tilt", "nan"], "--tilt", "0 to 180"),
        (["--jobs", "-1"], "--jobs -1", "0 to 256"),
        (["--cameras", "none.json"], "none.json", "path"),
        (["--device", "tpu"], "tpu", "--help"),
    ],
)
def test_settings_out_of_range(refused, ball, words, problem, advice):
    error, hint = refused("render", ball, *words).stderr.splitlines()
    assert problem in error
    assert advice.lower() in hint.lower()


@pytest.mark.parametrize("text", ["", "{", "[]", '{"version": 1, "cameras": [{"name": "a"}]}', "\0\1"])
def test_malformed_cameras(refused, ball, tmp_path, text):
    (tmp_path / "rig.json").write_text(text)
    assert "rig.json" in refused("render", ball, "--cameras", tmp_path / "rig.json", "-o", tmp_path / "out").stderr
    assert os.listdir(tmp_path) == ["rig.json"]


def test_no_cuda(refused, ball):
    import warp

    if warp.is_cuda_available():
        pytest.skip("there is a CUDA device")
    assert "CUDA" in refused("render", ball, *TINY, "--device", "cuda").stderr


@pytest.mark.parametrize("batch", [False, True])
def test_no_blender(ball, batch):
    """Without the package bpy, which a finder hides here, the engine is refused, for one mesh and for all."""
    code = """
    import sys
    class Hidden:
        def find_spec(self, name, path=None, target=None):
            if name.partition(".")[0] == "bpy": raise ModuleNotFoundError(name)
    sys.meta_path.insert(0, Hidden())
    from mv3d_cli.cli.app import main
    main()
    """
    meshes = [ball, ball] if batch else [ball]
    words = ["render", *map(str, meshes), "--size", "16", "--jobs", "1", "--engine", "blender"]
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(code), *words], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (1, "")
    error, hint = done.stderr.splitlines()
    assert error.startswith("error: ")
    assert "bpy" in error
    assert "mv3d-cli[blender]" in hint
