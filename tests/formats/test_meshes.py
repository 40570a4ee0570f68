import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh
from trimesh.exchange.ply import export_ply
from trimesh.visual import ColorVisuals

from mv3d_cli.errors import BadMesh, MissingInput
from mv3d_cli.formats.meshes import MeshFile, find_meshes, mesh_sources, read_mesh
from mv3d_cli.formats.textures import GREY
from mv3d_cli.scene.conventions import linear_from_srgb
from mv3d_cli.scene.mesh import face_normals

SHARED = Path(os.environ.get("MV3D_SHARED", Path(__file__).resolve().parents[3] / "shared"))


def touched(folder: Path, *names: str) -> None:
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"")


def names(folder: Path) -> list[str]:
    return [file.name for file in find_meshes(folder)]


def test_names_below_a_folder(tmp_path):
    touched(tmp_path, "b.glb", "a/b.GLB", "a/c d.stl", "readme.txt", ".hidden/x.glb", "a/.y.glb", "z.ply", "z.obj")
    assert names(tmp_path) == ["a__b", "a__c_d", "b", "z_obj", "z_ply"]


def test_names_stay_distinct(tmp_path):
    touched(tmp_path, "a b.glb", "a_b.glb", "a__b.glb", "a/b.glb", "A_B.glb")
    found = names(tmp_path)
    assert len({name.casefold() for name in found}) == 5
    assert found == names(tmp_path)


def test_scanned_objects_are_called_after_their_folder(tmp_path):
    for name in ("Dino", "Mug"):
        touched(tmp_path, f"{name}/meshes/model.obj", f"{name}/materials/textures/texture.png")
    touched(tmp_path, "other/meshes/model.obj")
    assert names(tmp_path) == ["Dino", "Mug", "other__meshes__model"]
    assert names(tmp_path / "Dino") == ["Dino"]
    assert names(tmp_path / "Dino" / "meshes") == ["Dino"]
    assert names(tmp_path / "Dino" / "meshes" / "model.obj") == ["Dino"]


def test_one_file(tmp_path):
    touched(tmp_path, "a.glb", "a.txt")
    assert find_meshes(tmp_path / "a.glb") == [MeshFile("a", tmp_path / "a.glb")]
    with pytest.raises(MissingInput, match="not a mesh file"):
        find_meshes(tmp_path / "a.txt")


def test_nothing_there(tmp_path):
    with pytest.raises(MissingInput, match="no mesh in"):
        find_meshes(tmp_path)
    with pytest.raises(MissingInput, match="no file or folder"):
        find_meshes(tmp_path / "none")


def test_the_shared_scans():
    if not (SHARED / "gso").is_dir():
        pytest.skip(f"needs scans in {SHARED / 'gso'}")
    found = find_meshes(SHARED / "gso")
    assert [file.name for file in found] == sorted(path.name for path in (SHARED / "gso").iterdir() if path.is_dir())
    sources = mesh_sources(found[0])
    assert [path.name for path in sources] == ["model.obj", "model.mtl", "texture.png"]
    assert all(path.is_file() for path in sources)


def test_scanned_objects_are_z_up(tmp_path):
    touched(tmp_path, "Mug/materials/textures/texture.png", "Mug/meshes/model.obj")
    path = tmp_path / "Mug" / "meshes" / "model.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 0 1\nf 1 2 3\n")
    assert read_mesh(MeshFile("a", path)).vertices[2].tolist() == [0, 0, 1]
    assert read_mesh(MeshFile("a", path), up="y").vertices[2].tolist() == [0, -1, 0]


@pytest.fixture
def box() -> trimesh.Trimesh:
    return trimesh.creation.box((1, 2, 3))


@pytest.mark.parametrize(
    ("suffix", "kind"),
    [(".ply", "ply"), (".ply", "ply_ascii"), (".stl", "stl"), (".stl", "stl_ascii"), (".STL", "stl")],
)
def test_ply_and_stl(tmp_path, box, suffix, kind):
    path = tmp_path / f"a{suffix}"
    if kind == "ply_ascii":
        path.write_bytes(export_ply(box, encoding="ascii"))
    else:
        box.export(path, file_type=kind)
    mesh = read_mesh(MeshFile("a", path))
    assert np.allclose(mesh.vertices[mesh.faces], box.vertices[box.faces])
    assert np.allclose(face_normals(mesh), box.face_normals)
    assert mesh.materials[0].base_color == (GREY, GREY, GREY, 1)
    assert np.allclose(read_mesh(MeshFile("a", path), up="y").vertices[:, 2], mesh.vertices[:, 1])
    assert mesh_sources(MeshFile("a", path)) == [path]


def test_all_solids_of_an_stl_are_read(tmp_path):
    facet = "facet normal 0 0 1\nouter loop\nvertex 0 0 {z}\nvertex 1 0 {z}\nvertex 1 1 {z}\nendloop\nendfacet\n"
    solids = [f"solid a\n{facet.format(z=z)}endsolid a\n" for z in (0, 5)]
    (tmp_path / "a.stl").write_text("".join(solids))
    mesh = read_mesh(MeshFile("a", tmp_path / "a.stl"))
    assert mesh.vertices[mesh.faces][:, 0, 2].tolist() == [0, 5]


@pytest.mark.parametrize("of", ["vertices", "faces"])
def test_ply_colours_become_linear(tmp_path, box, of):
    colors = np.random.default_rng(0).integers(0, 255, (len(getattr(box, of)), 4), np.uint8)
    box.visual = ColorVisuals(box, **{"vertex_colors" if of == "vertices" else "face_colors": colors})
    box.export(tmp_path / "a.ply")
    mesh = read_mesh(MeshFile("a", tmp_path / "a.ply"))
    assert mesh.colors is not None
    expected = colors[box.faces] if of == "vertices" else np.repeat(colors[:, None], 3, axis=1)
    found = mesh.colors[mesh.faces]
    assert np.allclose(found[..., :3], linear_from_srgb(expected[..., :3] / 255), atol=1e-6)
    assert np.allclose(found[..., 3], expected[..., 3] / 255)
    assert np.allclose(mesh.vertices[mesh.faces], box.vertices[box.faces])
    assert mesh.materials[0].base_color == (1, 1, 1, 1)


def test_ply_normals(tmp_path):
    sphere = trimesh.creation.icosphere(2)
    sphere.export(tmp_path / "a.ply", vertex_normal=True)
    mesh = read_mesh(MeshFile("a", tmp_path / "a.ply"))
    assert mesh.normals is not None
    assert np.allclose(mesh.normals, mesh.vertices, atol=0.02)


HEADER = "ply\nformat ascii 1.0\nelement vertex {v}\nproperty float x\nproperty float y\nproperty float z\n"
HEADER += "element face {f}\nproperty list uchar int vertex_indices\nend_header\n"
CORNERS = "0 0 0\n1 0 0\n1 1 0\n0 1 0\n"


def test_quads_in_ply(tmp_path):
    (tmp_path / "a.ply").write_text(HEADER.format(v=4, f=1) + CORNERS + "4 0 1 2 3\n")
    mesh = read_mesh(MeshFile("a", tmp_path / "a.ply"))
    assert len(mesh.faces) == 2
    assert np.allclose(face_normals(mesh), (0, 0, 1))


BAD = {
    "a.ply": {
        "empty": b"",
        "words": b"hello",
        "points": HEADER.format(v=4, f=0).encode() + CORNERS.encode(),
        "truncated": HEADER.format(v=4, f=2).encode() + CORNERS.encode() + b"3 0 1 2\n",
        "huge": HEADER.format(v=10**15, f=10**15).encode() + CORNERS.encode(),
        "huge binary": HEADER.format(v=10**15, f=10**15).replace("ascii", "binary_little_endian").encode() + b"1234",
        "beyond": HEADER.format(v=4, f=1).encode() + CORNERS.encode() + b"3 0 1 7\n",
        "before": HEADER.format(v=4, f=1).encode() + CORNERS.encode() + b"3 0 1 -1\n",
        "nan": HEADER.format(v=4, f=1).encode() + b"nan 0 0\n" + CORNERS.encode()[6:] + b"3 0 1 2\n",
        "flat": HEADER.format(v=4, f=1).encode() + CORNERS.encode() + b"3 1 1 2\n",
    },
    "a.stl": {
        "empty": b"",
        "words": b"hello",
        "no facet": b"solid a\nendsolid a\n",
        "huge": b"\0" * 80 + b"\xff\xff\xff\xff" + b"\0" * 50,
        "none": b"\0" * 84,
        "flat": b"\0" * 80 + b"\x01\0\0\0" + b"\0" * 50,
    },
    "a.glb": {"empty": b"", "words": b"hello", "picture": b"\x89PNG\r\n", "version 1": b"glTF\1\0\0\0" + b"\0" * 40},
    "a.gltf": {"empty": b"", "list": b"[]", "glb inside": b"glTF" + b"\0" * 40, "deep": b"[" * 200_000},
}


@pytest.mark.parametrize(("name", "case"), [(name, case) for name in BAD for case in BAD[name]])
def test_bad_files(tmp_path, name, case):
    (tmp_path / name).write_bytes(BAD[name][case])
    with pytest.raises(BadMesh) as caught:
        read_mesh(MeshFile("a", tmp_path / name))
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)
    assert caught.value.hint


@pytest.mark.parametrize("name", ["a.glb", "a.gltf", "a.obj", "a.ply", "a.stl"])
def test_missing_files(tmp_path, name):
    for verb in (read_mesh, mesh_sources):
        with pytest.raises(MissingInput):
            verb(MeshFile("a", tmp_path / name))


def test_a_truncated_binary_ply(tmp_path, box):
    box.export(tmp_path / "a.ply")
    whole = (tmp_path / "a.ply").read_bytes()
    for kept in range(0, len(whole), 37):
        (tmp_path / "a.ply").write_bytes(whole[:kept])
        with pytest.raises(BadMesh):
            read_mesh(MeshFile("a", tmp_path / "a.ply"))


def test_a_mesh_by_another_name_is_not_read(tmp_path, box):
    box.export(tmp_path / "a.stl")
    shutil.copy(tmp_path / "a.stl", tmp_path / "a.glb")
    with pytest.raises(BadMesh, match="not glTF"):
        read_mesh(MeshFile("a", tmp_path / "a.glb"))


TEXTURED_PLY = """ply
format ascii 1.0
comment TextureFile {picture}
element vertex 3
property float x
property float y
property float z
property float {u}
property float {v}
property uchar red
property uchar green
property uchar blue
element face 1
property list uchar int vertex_indices
end_header
0 0 0 0 1 10 20 30
1 0 0 1 1 10 20 30
1 1 0 1 0 10 20 30
3 0 1 2
"""


@pytest.mark.parametrize("names", [("s", "t"), ("u", "v"), ("texture_u", "texture_v")])
def test_another_program_s_textured_ply(Builder, tmp_path, names):
    (tmp_path / "my skin.png").write_bytes(Builder.png())
    path = tmp_path / "a.ply"
    path.write_text(TEXTURED_PLY.format(picture="my skin.png", u=names[0], v=names[1]))
    mesh = read_mesh(MeshFile("a", path))
    assert mesh.uvs.tolist() == [[0, 0], [1, 0], [1, 1]]
    assert mesh.materials[0].texture.pixels[0, 0].tolist() == [200, 100, 50, 255]
    assert mesh.colors is None, "the picture is shown, not both"
    assert mesh_sources(MeshFile("a", path)) == [path, tmp_path / "my skin.png"]


@pytest.mark.parametrize("picture", ["none.png", "../../secret.png"])
def test_a_ply_s_picture_that_is_not_there_or_not_its_own(Builder, tmp_path, picture):
    folder = tmp_path / "a" / "b"
    folder.mkdir(parents=True)
    (tmp_path / "secret.png").write_bytes(Builder.png())
    (folder / "a.ply").write_text(TEXTURED_PLY.format(picture=picture, u="s", v="t"))
    with pytest.warns(UserWarning, match="replaced"):
        mesh = read_mesh(MeshFile("a", folder / "a.ply"))
    assert mesh.materials[0].texture is None
    assert mesh.colors is not None
    assert mesh_sources(MeshFile("a", folder / "a.ply")) == [folder / "a.ply"]
