import contextlib
import os
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from mv3d_cli.errors import BadMesh, InputError
from mv3d_cli.formats.meshes import MeshFile, MeshWarning, mesh_sources, read_mesh
from mv3d_cli.formats.obj import statements
from mv3d_cli.formats.textures import GREY
from mv3d_cli.scene.mesh import Mesh

SHARED = Path(os.environ.get("MV3D_SHARED", Path(__file__).resolve().parents[3] / "shared"))
QUAD = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
UVS = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
TEXTURED = f"mtllib a.mtl\n{QUAD}{UVS}usemtl m\nf 1/1 2/2 3/3 4/4\n"


def read(folder: Path, text: str, **files: str | bytes) -> Mesh:
    """The mesh in its own axes."""
    for name, content in files.items():
        name = name.replace("_mtl", ".mtl")
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    (folder / "a.obj").write_bytes(text.encode())
    return read_mesh(MeshFile("a", folder / "a.obj"), up="z")


def picture(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (3, 2), (200, 100, 50)).save(path)


def test_polygons_become_fans(tmp_path):
    mesh = read(tmp_path, QUAD + "f 1 2 3 4\nf 2 3 4\n")
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [1, 2, 3]]
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]


def test_y_is_up(tmp_path):
    read(tmp_path, QUAD + "f 1 2 3 4\n")
    turned = read_mesh(MeshFile("a", tmp_path / "a.obj"))
    assert turned.vertices[3].tolist() == [0, 0, 1]


@pytest.mark.parametrize(
    "text",
    [
        QUAD + "f -4 -3 -2\nf -4 -2 -1\n",
        "v 0 0 0\nv 1 0 0\nv 1 1 0\nf -3 -2 -1\nv 0 1 0\nf -4 -2 -1\n",
        QUAD.replace("\n", "\r\n") + "f 1 2 3\r\nf 1 3 4\r\n",
        QUAD.replace("\n", "\r") + "f 1 2 3\rf 1 3 4",
        QUAD + "f 1 2 \\\n 3 4",
        "# a comment\n\n" + QUAD.replace("v ", "  v\t") + "g group\ns off\nf 1 2 3 # one\nf 1 3 4\nl 1 2\n",
        "v 0 0 0 1\nv 1 0 0\nv 1 1 0 1.0\nv 0 1e0 -0.0\nf 1// 2// 3//\nf 1 3 4\n",
    ],
)
def test_the_many_ways_to_write_a_quad(tmp_path, text):
    mesh = read(tmp_path, text)
    assert mesh.vertices[mesh.faces].tolist() == [
        [[0, 0, 0], [1, 0, 0], [1, 1, 0]],
        [[0, 0, 0], [1, 1, 0], [0, 1, 0]],
    ]


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 400), st.randoms(use_true_random=False))
def test_pieces_do_not_matter(size, rng):
    import io

    lines = [f"v {rng.random()} {rng.random()} {rng.random()}" for _ in range(9)]
    lines += [f"vt {rng.random()} {rng.random()}" for _ in range(5)]
    for _ in range(30):
        corners = [f"{rng.randrange(1, 10)}/{rng.randrange(1, 6)}" for _ in range(rng.randrange(3, 6))]
        lines.append("f " + (" \\\n" if rng.random() < 0.3 else " ").join(corners))
        if rng.random() < 0.3:
            lines.append(f"usemtl m{rng.randrange(3)}")
    text = "\n".join(lines).encode()
    whole = statements.read_statements(io.BytesIO(text))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(statements, "_BLOCK", size)
        cut = statements.read_statements(io.BytesIO(text))
    assert np.array_equal(whole.corners, cut.corners)
    assert np.array_equal(whole.vertices, cut.vertices)
    assert np.array_equal(whole.face_material, cut.face_material)
    assert whole.material_names == cut.material_names


def test_vertices_are_welded_per_corner(tmp_path):
    picture(tmp_path / "t.png")
    normals = "vn 0 0 2\nvn 1 0 0\n"
    faces = "usemtl m\nf 1/1/1 2/2/1 3/3/1\nf 1/1/1 3/3/2 4/4/1\n"
    mesh = read(tmp_path, "mtllib a.mtl\n" + QUAD + UVS + normals + faces, a_mtl="newmtl m\nmap_Kd t.png\n")
    assert len(mesh.vertices) == 5
    assert mesh.normals is not None
    assert mesh.uvs is not None
    assert mesh.normals[mesh.faces].tolist() == [[[0, 0, 1]] * 3, [[0, 0, 1], [1, 0, 0], [0, 0, 1]]]
    assert np.allclose(mesh.uvs, np.stack([mesh.vertices[:, 0], 1 - mesh.vertices[:, 1]], axis=1)), "v downwards"


def test_vertex_colours_are_srgb(tmp_path):
    mesh = read(tmp_path, "v 0 0 0 1 0.5 0\nv 1 0 0 1 0.5 0\nv 1 1 0\nf 1 2 3\n")
    assert mesh.colors is not None
    assert np.allclose(mesh.colors[0], (1, GREY, 0, 1))
    assert np.allclose(mesh.colors[2], 1)
    assert mesh.materials[0].base_color == (1, 1, 1, 1)


def test_without_colours_it_is_grey(tmp_path):
    assert read(tmp_path, QUAD + "f 1 2 3\n").materials[0].base_color == (GREY, GREY, GREY, 1)


def test_many_materials_and_libraries(tmp_path):
    text = "mtllib a.mtl b.mtl\n" + QUAD + "f 1 2 3\nusemtl red\nf 1 2 3\nusemtl clear one\nf 1 3 4\nf 1 2 4\n"
    red = "newmtl red\nKd 0.5 0 0\nd 0.5\nPr 0.25\nPm 1\n"
    mesh = read(tmp_path, text, a_mtl=red, b_mtl="newmtl clear one\nTr 0.75\nKd 0 1 0\n")
    first, second, rest = mesh.materials
    assert mesh.face_material.tolist() == [2, 0, 1, 1]
    assert (first.base_color, first.roughness, first.metallic) == ((0.5, 0, 0, 0.5), 0.25, 1)
    assert first.alpha_mode == "blend"
    assert second.base_color == (0, 1, 0, 0.25)
    assert rest.base_color[0] == GREY


def test_options_of_a_map(tmp_path):
    picture(tmp_path / "my t.png")
    line = "map_Kd -s 2 3 1 -o 0.5 0.25 -blendu on -clamp on my t.png"
    mesh = read(tmp_path, TEXTURED, a_mtl=f"newmtl m\nKd 0 0 0\n{line}\n")
    (material,) = mesh.materials
    assert material.base_color == (1, 1, 1, 1)
    assert material.texture is not None
    assert (material.texture.wrap_u, material.texture.wrap_v) == ("clamp", "clamp")
    assert mesh.uvs is not None
    expected = np.stack([mesh.vertices[:, 0] * 2 + 0.5, 1 - (mesh.vertices[:, 1] * 3 + 0.25)], axis=1)
    assert np.allclose(mesh.uvs, expected)


def test_two_layings_of_one_texture_vertex(tmp_path):
    picture(tmp_path / "t.png")
    library = "newmtl m\nmap_Kd t.png\nnewmtl n\nmap_Kd -s 2 2 t.png\n"
    mesh = read(tmp_path, TEXTURED + "usemtl n\nf 1/1 2/2 3/3\n", a_mtl=library)
    assert mesh.uvs is not None
    assert mesh.uvs[mesh.faces[2]].tolist() == [[0, 1], [2, 1], [2, -1]]
    assert mesh.uvs[mesh.faces[0]].tolist() == [[0, 1], [1, 1], [1, 0]]


@pytest.mark.parametrize(
    ("written", "there"),
    [
        ("t.png", "mesh/t.png"),
        ("T.PNG", "mesh/t.png"),
        ("t.png", "materials/textures/t.png"),
        ("t.png", "mesh/textures/T.png"),
        ("C:\\Users\\me\\t.png", "mesh/textures/t.png"),
        ("/somewhere/else/t.png", "textures/t.png"),
        ("../maps/t.png", "maps/t.png"),
        ("maps\\t.png", "mesh/maps/t.png"),
    ],
)
def test_where_pictures_are_looked_for(tmp_path, written, there):
    (tmp_path / "mesh").mkdir()
    picture(tmp_path / there)
    (material,) = read(tmp_path / "mesh", TEXTURED, a_mtl=f"newmtl m\nmap_Kd {written}\n").materials
    assert material.texture is not None
    assert (material.texture.pixels == (200, 100, 50, 255)).all()
    sources = mesh_sources(MeshFile("a", tmp_path / "mesh" / "a.obj"))
    assert [path.resolve() for path in sources] == [
        (tmp_path / path).resolve() for path in ("mesh/a.obj", "mesh/a.mtl", there)
    ]


@pytest.mark.parametrize(
    "written", ["none.png", "../../outside.png", "{root}/outside.png", "link.png", "text.png", ".."]
)
def test_pictures_that_cannot_be_had_are_grey(tmp_path, written):
    folder = tmp_path / "a" / "mesh"
    folder.mkdir(parents=True)
    picture(tmp_path / "outside.png")
    (folder / "link.png").symlink_to(tmp_path / "outside.png")
    (folder / "text.png").write_text("no picture")
    with pytest.warns(MeshWarning, match="grey"):
        (material,) = read(folder, TEXTURED, a_mtl=f"newmtl m\nmap_Kd {written.format(root=tmp_path)}\n").materials
    assert material.base_color == (GREY, GREY, GREY, 1)


@pytest.mark.parametrize("library", [None, "newmtl other\n", "\x00\xff"])
def test_materials_that_are_not_there_are_grey(tmp_path, library):
    files = {} if library is None else {"a_mtl": library}
    with pytest.warns(MeshWarning, match="grey"):
        (material,) = read(tmp_path, TEXTURED, **files).materials
    assert material.base_color == (GREY, GREY, GREY, 1)


def test_lines_of_a_library_that_make_no_sense_are_told(tmp_path):
    with pytest.warns(MeshWarning) as told:
        (material,) = read(tmp_path, TEXTURED, a_mtl="newmtl m\nKd red\nd\n").materials
    assert ["Kd red" in str(told[0].message), "'d'" in str(told[1].message)] == [True, True]
    assert material.base_color == (0.8, 0.8, 0.8, 1)


BAD = {
    "empty": ("", "no face"),
    "words": ("hello world\n", "no face"),
    "points": (QUAD, "no face"),
    "beyond": (QUAD + "f 1 2 5\n", "5 of 4 vertices"),
    "beyond uv": (QUAD + UVS + "f 1/1 2/2 3/5\n", "5 of 4 texture"),
    "zero": (QUAD + "f 0 1 2\n", "not there"),
    "before": (QUAD + "f -5 1 2\n", "before the first"),
    "enormous": (QUAD + "f 1 2 99999999999999999999\n", "not there"),
    "text in v": ("v 0 0 x\n" + QUAD + "f 1 2 3\n", "numbers"),
    "short v": ("v 0 0\n" + QUAD + "f 1 2 3\n", "2 numbers"),
    "blank v": ("v \n" + QUAD + "f 1 2 3\n", "0 numbers"),
    "text in f": (QUAD + "f 1 2 c\n", "numbers"),
    "slashes": (QUAD + "f 1/1/1/1 2 3\n", "three parts"),
    "half": (QUAD + "f 1 2 2.5\n", "numbers"),
    "nan": ("v nan 0 0\n" + QUAD + "f 1 2 3\n", "not finite"),
    "overflow": ("v 1e999 0 0\n" + QUAD + "f 1 2 3\n", "not finite"),
    "two corners": (QUAD + "f 1 2\n", "no face"),
    "flat": (QUAD + "f 1 1 2\n", "area"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files_say_what_is_wrong(tmp_path, case):
    text, message = BAD[case]
    with pytest.raises(BadMesh, match=message) as caught:
        read(tmp_path, text)
    assert "a.obj" in str(caught.value)


@pytest.mark.filterwarnings("ignore::mv3d_cli.formats.textures.MeshWarning")
def test_flipped_bytes_never_escape_as_another_error(tmp_path):
    rng = random.Random(0)
    for _ in range(300):
        damaged = bytearray(TEXTURED.encode())
        for _ in range(3):
            damaged[rng.randrange(len(damaged))] = rng.randrange(256)
        (tmp_path / "a.obj").write_bytes(damaged)
        with contextlib.suppress(InputError):
            read_mesh(MeshFile("a", tmp_path / "a.obj"))


def some_scans() -> list[Path]:
    return sorted(SHARED.glob("gso/*/meshes/model.obj"))[::6]


@pytest.mark.parametrize("path", some_scans() or [None], ids=lambda path: path.parts[-3] if path else "none")
def test_trimesh_agrees(path):
    if path is None:
        pytest.skip(f"needs scans in {SHARED / 'gso'}")
    import trimesh

    ours = read_mesh(MeshFile("a", path))
    theirs: Any = trimesh.load_mesh(path, process=False)
    corners = theirs.vertices[theirs.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    kept = np.linalg.norm(cross, axis=1) > 1e-16
    assert len(ours.faces) == pytest.approx(len(theirs.faces), abs=10)
    if kept.all() and len(ours.faces) == len(theirs.faces):
        assert np.allclose(ours.vertices[ours.faces], corners, atol=1e-6)
    assert ours.uvs is not None
    low, high = theirs.visual.uv.min(axis=0), theirs.visual.uv.max(axis=0)
    assert np.allclose(ours.uvs[ours.faces].reshape(-1, 2).min(axis=0), (low[0], 1 - high[1]), atol=1e-5)
    texture = ours.materials[0].texture
    assert texture is not None
    expected = np.asarray(Image.open(path.parents[1] / "materials" / "textures" / "texture.png").convert("RGBA"))
    assert np.array_equal(texture.pixels, expected)
