"""What we write, read back by ourselves, by trimesh, and as pictures."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from mv3d_cli.capture import rendering
from mv3d_cli.errors import BadMesh, OutputRefused
from mv3d_cli.formats.cameras import load_cameras
from mv3d_cli.formats.images import read_image
from mv3d_cli.formats.meshes import WRITTEN_SUFFIXES, MeshFile, mesh_sources, read_mesh, write_mesh
from mv3d_cli.scene.conventions import Y_UP_FROM_WORLD, linear_from_srgb, srgb_from_linear
from mv3d_cli.scene.mesh import Material, Mesh, Texture, face_normals, transform

COLOURED = (".glb", ".obj", ".ply")


def back(path: Path, mesh: Mesh, up="auto", **how) -> Mesh:
    files = write_mesh(path, mesh, up=up, **how)
    assert files == mesh_sources(MeshFile("a", path)), "what a mesh reads is what was written"
    return read_mesh(MeshFile("a", path), up)


def at_corners(mesh: Mesh, attribute: str) -> np.ndarray:
    """An attribute of each face's corners, faces in the order of their materials."""
    faces = mesh.faces[np.argsort(mesh.face_material, kind="stable")]
    return getattr(mesh, attribute)[faces]


@pytest.mark.parametrize("suffix", WRITTEN_SUFFIXES)
@pytest.mark.parametrize("normals", [True, False])
def test_geometry_comes_back(samples, tmp_path, suffix, normals):
    mesh = samples.globe(normals=normals)
    found = back(tmp_path / f"a{suffix}", mesh)
    assert np.allclose(at_corners(found, "vertices"), at_corners(mesh, "vertices"), atol=1e-6)
    assert np.allclose(face_normals(found), face_normals(mesh), atol=1e-3), "faces look outwards"
    if normals and suffix != ".stl":
        assert np.allclose(at_corners(found, "normals"), at_corners(mesh, "normals"), atol=1e-4)
    else:
        assert found.normals is None
    if suffix != ".stl":
        assert len(found.vertices) == len(np.unique(mesh.faces)), "no vertex is split, none without use is kept"


@pytest.mark.parametrize("suffix", WRITTEN_SUFFIXES)
@pytest.mark.parametrize("up", ["auto", "y", "z"])
def test_the_file_s_own_axes_and_scale(samples, tmp_path, suffix, up):
    mesh = samples.globe()
    path = tmp_path / f"a{suffix.upper()}"
    found = back(path, mesh, up, scale=37.5, unit="mm")
    assert np.allclose(at_corners(found, "vertices"), 37.5 * at_corners(mesh, "vertices"), atol=1e-4)
    y_up = up == "y" or (up == "auto" and suffix in (".glb", ".obj"))
    as_it_lies = transform(mesh, Y_UP_FROM_WORLD) if y_up else mesh
    stored = trimesh.load(path, force="mesh", process=False)
    assert np.allclose(stored.bounds, 37.5 * trimesh.Trimesh(as_it_lies.vertices, mesh.faces).bounds, atol=1e-4)
    said = path.read_bytes()
    assert b"mm" in said
    assert b"37.5" in said


@pytest.mark.parametrize("suffix", COLOURED)
def test_vertex_colours_come_back(samples, tmp_path, suffix):
    mesh = samples.globe(colors=True)
    found = back(tmp_path / f"a{suffix}", mesh)
    error = srgb_from_linear(at_corners(found, "colors")) - srgb_from_linear(at_corners(mesh, "colors"))
    assert np.abs(error).max() < (0.51 / 255 if suffix == ".ply" else 1e-4)
    assert found.materials[0].base_color == (1, 1, 1, 1)


@pytest.mark.parametrize("suffix", COLOURED)
def test_a_texture_comes_back(samples, tmp_path, suffix):
    mesh = samples.globe(Material(texture=Texture(samples.smooth_picture())))
    found = back(tmp_path / f"a{suffix}", mesh)
    (material,) = found.materials
    assert material.texture is not None
    assert np.array_equal(material.texture.pixels, samples.smooth_picture())
    assert np.allclose(at_corners(found, "uvs"), at_corners(mesh, "uvs"), atol=1e-6)
    assert (material.base_color, material.alpha_mode, material.metallic) == ((1, 1, 1, 1), "opaque", 0)


@pytest.mark.parametrize("suffix", [".glb", ".obj"])
def test_many_materials_come_back(samples, tmp_path, suffix):
    mesh = samples.patchwork()
    found = back(tmp_path / f"a{suffix}", mesh)
    assert np.allclose(at_corners(found, "vertices"), at_corners(mesh, "vertices"), atol=1e-6)
    paint, red, tinted, lace = found.materials
    assert red.base_color == pytest.approx((0.8, 0.2, 0.1, 1))
    assert (red.texture, red.roughness, red.metallic) == (None, 0.4, 0.25)
    assert np.array_equal(paint.texture.pixels, samples.smooth_picture())
    shown = linear_from_srgb(tinted.texture.pixels[..., :3] / 255) * tinted.base_color[:3]
    wanted = linear_from_srgb(samples.smooth_picture()[..., :3] / 255) * (0.5, 0.9, 0.3)
    assert np.abs(srgb_from_linear(shown) - srgb_from_linear(wanted)).max() < 0.51 / 255
    assert np.array_equal(lace.texture.pixels, mesh.materials[4].texture.pixels)
    assert lace.alpha_mode == ("mask" if suffix == ".glb" else "blend")
    sizes = np.bincount(mesh.face_material)
    assert np.bincount(found.face_material).tolist() == sizes[sizes > 0].tolist()


def test_base_colours_become_a_ply_s_vertex_colours(samples, tmp_path):
    mesh = samples.globe(colors=True)
    materials = (Material(base_color=(0.8, 0.2, 0.1, 1.0)), Material(base_color=(0.1, 0.7, 0.9, 1.0)))
    mesh = replace(mesh, materials=materials, face_material=(mesh.faces[:, 0] % 2).astype(np.int32))
    found = back(tmp_path / "a.ply", mesh)
    base = np.array([material.base_color for material in materials], np.float32)
    wanted = at_corners(mesh, "colors") * base[np.sort(mesh.face_material)][:, None]
    assert np.abs(srgb_from_linear(found.colors[found.faces]) - srgb_from_linear(wanted)).max() < 0.51 / 255


@pytest.mark.parametrize("suffix", COLOURED)
@pytest.mark.parametrize("kind", ["textured", "coloured"])
def test_the_same_picture_after_a_round_trip(samples, tmp_path, suffix, kind):
    material = Material(texture=Texture(samples.smooth_picture()), base_color=(0.9, 0.7, 0.5, 1.0))
    mesh = samples.globe(material) if kind == "textured" else samples.globe(colors=True, normals=False)
    found = back(tmp_path / f"a{suffix}", mesh)
    cameras = load_cameras(None)[::3]
    pairs = zip(*(rendering.render(m, cameras, 96, None).frames for m in (mesh, found)), strict=True)
    for first, second in pairs:
        assert first.color.std() > 20
        error = first.color.astype(float) - second.color
        assert 20 * np.log10(255 / max(np.sqrt((error**2).mean()), 1e-9)) > 40


@pytest.mark.parametrize("suffix", WRITTEN_SUFFIXES)
def test_trimesh_reads_the_same_triangles(samples, tmp_path, suffix):
    mesh = samples.globe(colors=True)
    write_mesh(tmp_path / f"a{suffix}", mesh, up="z")
    stored = trimesh.load(tmp_path / f"a{suffix}", force="mesh", process=False)
    assert np.allclose(stored.vertices[stored.faces], mesh.vertices[mesh.faces], atol=1e-6)
    if suffix == ".stl":
        assert np.allclose(stored.face_normals, face_normals(mesh), atol=1e-5)
        return
    if suffix == ".glb":
        stored = trimesh.load(tmp_path / "a.glb", force="mesh", process=False, skip_materials=True)
    colors = mesh.colors if suffix == ".glb" else srgb_from_linear(mesh.colors)  # trimesh gives them as they are stored
    assert np.abs(stored.visual.vertex_colors[stored.faces][..., :3] - 255.0 * colors[mesh.faces][..., :3]).max() < 1.01


@pytest.mark.parametrize("suffix", COLOURED)
def test_trimesh_reads_the_same_texture(samples, tmp_path, suffix):
    mesh = samples.globe(Material(texture=Texture(samples.smooth_picture())))
    write_mesh(tmp_path / f"a{suffix}", mesh, up="z")
    stored = trimesh.load(tmp_path / f"a{suffix}", force="mesh", process=False)
    v_up = mesh.uvs[mesh.faces] * (1, -1) + (0, 1)
    assert np.allclose(stored.visual.uv[stored.faces], v_up, atol=1e-5)
    material = stored.visual.material
    picture = material.baseColorTexture if suffix == ".glb" else material.image
    assert np.array_equal(np.asarray(picture.convert("RGBA")), samples.smooth_picture())


@pytest.mark.parametrize(
    ("suffix", "others"), [(".glb", []), (".obj", ["mtl", "png"]), (".ply", ["png"]), (".stl", [])]
)
def test_files_and_bytes(samples, tmp_path, suffix, others):
    mesh = samples.globe(Material(texture=Texture(samples.smooth_picture())))
    (tmp_path / "one").mkdir()
    first = write_mesh(tmp_path / f"my mug{suffix}", mesh)
    second = write_mesh(tmp_path / "one" / f"my mug{suffix}", mesh)
    assert [path.name for path in first] == [f"my mug{suffix}", *(f"my mug.{other}" for other in others)]
    assert [path.read_bytes() for path in first] == [path.read_bytes() for path in second]
    assert sorted(tmp_path.iterdir()) == sorted([*first, tmp_path / "one"]), "nothing temporary is left"
    for path in first:
        path.write_bytes(b"old")
    write_mesh(first[0], mesh)
    assert [path.read_bytes() for path in first] == [path.read_bytes() for path in second]


def test_a_failed_write_leaves_the_old_file(samples, tmp_path, monkeypatch):
    path = tmp_path / "a.ply"
    path.write_bytes(b"old")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(OSError, match="No space"):
        write_mesh(path, samples.globe())
    assert [p.read_bytes() for p in tmp_path.iterdir()] == [b"old"]


def test_an_obj_says_how_its_texture_clamps(samples, tmp_path):
    texture = Texture(samples.smooth_picture(), "clamp", "clamp")
    mesh = samples.globe(Material(texture=texture))
    assert back(tmp_path / "in.obj", mesh).materials[0].texture.wrap_u == "repeat", "there is nothing to say"
    wide = replace(mesh, uvs=mesh.uvs * 3 - 1)
    found = back(tmp_path / "out.obj", wide)
    assert (found.materials[0].texture.wrap_u, found.materials[0].texture.wrap_v) == ("clamp", "clamp")
    assert np.array_equal(read_image(tmp_path / "out.png"), texture.pixels)


def test_an_stl_s_header_states_its_unit(samples, tmp_path):
    write_mesh(tmp_path / "a.stl", samples.globe())
    data = (tmp_path / "a.stl").read_bytes()
    assert data[:80].rstrip() == b"mv3d, +Z up, scale 1 per scene unit, unit: scene unit (unit-sphere radius = 1)"
    assert len(data) == 84 + 50 * len(samples.globe().faces)


def test_a_scan_s_place_keeps_its_axes(samples, tmp_path):
    """Where an OBJ would be read as a Google Scanned Object it is written as one."""
    path = tmp_path / "meshes" / "model.obj"
    for folder in (path.parent, tmp_path / "materials" / "textures"):
        folder.mkdir(parents=True)
    mesh = samples.globe()
    found = back(path, mesh)
    assert np.allclose(at_corners(found, "vertices"), at_corners(mesh, "vertices"), atol=1e-6)


def wrapped(mesh: Mesh, *wraps) -> Mesh:
    texture = Texture(mesh.materials[0].texture.pixels, *wraps)
    return replace(mesh, uvs=mesh.uvs * 2, materials=(replace(mesh.materials[0], texture=texture),))


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("a.fbx", lambda mesh: mesh),
        ("a.gltf", lambda mesh: mesh),
        ("a", lambda mesh: mesh),
        ("-a.obj", lambda mesh: mesh),
        ("a\nb.ply", lambda mesh: mesh),
        ("a#1.obj", lambda mesh: mesh),
        ("a.ply", lambda mesh: wrapped(mesh, "clamp", "clamp")),
        ("a.obj", lambda mesh: wrapped(mesh, "clamp", "repeat")),
        ("a.obj", lambda mesh: wrapped(mesh, "mirror", "mirror")),
        ("a.ply", lambda mesh: replace(mesh, colors=np.full((len(mesh.vertices), 4), 0.5, np.float32))),
        (
            "a.ply",
            lambda mesh: replace(
                mesh, materials=(*mesh.materials, Material()), face_material=mesh.faces[:, 0] % np.int32(2)
            ),
        ),
    ],
)
def test_what_cannot_be_written_is_refused(samples, tmp_path, name, change):
    mesh = samples.globe(Material(texture=Texture(samples.smooth_picture())))
    with pytest.raises(OutputRefused) as caught:
        write_mesh(tmp_path / name, change(mesh))
    assert caught.value.hint
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize("faces", [0, 10])
def test_no_surface_is_no_mesh(samples, tmp_path, faces):
    mesh = samples.globe()
    bad = replace(mesh, faces=mesh.faces[:faces], face_material=mesh.face_material[:faces])
    bad.vertices[5] = np.nan
    with pytest.raises(BadMesh):
        write_mesh(tmp_path / "a.glb", bad)
