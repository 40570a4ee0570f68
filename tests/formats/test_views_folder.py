import json
from dataclasses import replace

import numpy as np
import pytest

from mv3d_cli.errors import BadImage, BadViews, MissingInput
from mv3d_cli.formats.cameras import load_cameras
from mv3d_cli.formats.images import write_png
from mv3d_cli.formats.views_folder import read_views, write_views
from mv3d_cli.scene.camera import Camera, Orthographic, Perspective, look_at_origin
from mv3d_cli.scene.views import View, Views


def view(camera: Camera, seed: int = 0, height: int = 12, width: int = 16) -> View:
    rng = np.random.default_rng(seed)
    return View(
        camera,
        color=rng.integers(0, 256, (height, width, 4), np.uint8),
        depth=rng.random((height, width), np.float32),
        normal=rng.integers(0, 256, (height, width, 3), np.uint8),
        source="generated",
        weight=0.25,
    )


@pytest.fixture
def views() -> Views:
    perspective = look_at_origin("photo", (1.0, -1.3, 0.4), Perspective((1.25, 1.5), (0.5, 0.375)))
    cameras = [*load_cameras()[:3], perspective]
    return Views(tuple(view(camera, seed) for seed, camera in enumerate(cameras)))


def assert_same(a: Views, b: Views) -> None:
    assert len(a) == len(b)
    for one, other in zip(a.frames, b.frames, strict=True):
        assert one.camera.name == other.camera.name
        assert one.camera.projection == other.camera.projection
        assert np.array_equal(one.camera.world_from_camera, other.camera.world_from_camera)
        assert (one.source, one.weight) == (other.source, other.weight)
        for kind in ("color", "depth", "normal"):
            mine, theirs = getattr(one, kind), getattr(other, kind)
            assert (mine is None) == (theirs is None)
            assert mine is None or (mine.dtype == theirs.dtype and np.array_equal(mine, theirs))


def test_the_round_trip_is_exact(tmp_path, views):
    write_views(tmp_path / "views", views)
    assert_same(read_views(tmp_path / "views"), views)


def test_views_without_some_pictures(tmp_path, views):
    a, b, c, _ = views.frames
    some = Views((replace(a, color=None), replace(b, depth=None, normal=None), replace(c, normal=None)))
    write_views(tmp_path, some)
    assert_same(read_views(tmp_path), some)


def test_only_the_kinds_asked_for_are_written(tmp_path, views):
    write_views(tmp_path, views, depth=False, normal=False)
    assert {path.name for path in tmp_path.iterdir()} == {"color", "transforms.json"}
    assert read_views(tmp_path).frames[0].depth is None


def test_same_views_give_the_same_bytes(tmp_path, views):
    for name in "ab":
        write_views(tmp_path / name, views)
    for path in (tmp_path / "a").rglob("*.*"):
        assert path.read_bytes() == (tmp_path / "b" / path.relative_to(tmp_path / "a")).read_bytes()


def test_the_schema_is_nerfstudios(tmp_path, views):
    write_views(tmp_path, Views(views.frames[:1]))
    content = json.loads((tmp_path / "transforms.json").read_text())
    assert content["camera_model"] == "ORTHOPHOTO"
    (frame,) = content["frames"]
    assert frame["file_path"] == "color/front.png"
    assert frame["depth_file_path"] == "depth/front.exr"
    assert frame["normal_file_path"] == "normal/front.png"
    assert (frame["w"], frame["h"], frame["fl_x"], frame["cx"]) == (16, 12, 8, 8)
    assert (frame["name"], frame["source"], frame["weight"], frame["half_extent"]) == ("front", "generated", 0.25, 1)
    # camera-to-world in OpenGL's axes: at -Y, its z axis points away from the object, its y axis up
    expected = [[1, 0, 0, 0], [0, 0, -1, -2], [0, 1, 0, 0], [0, 0, 0, 1]]
    assert np.allclose(frame["transform_matrix"], expected)


def someone_elses(folder, **frame):
    write_png(folder / "a.png", np.full((4, 6, 3), 9, np.uint8))
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist(), **frame}
    (folder / "transforms.json").write_text(json.dumps({"w": 6, "h": 4, "fl_x": 5, "frames": [frame]}))


def test_someone_elses_folder(tmp_path):
    someone_elses(tmp_path)
    (read,) = read_views(tmp_path).frames
    assert read.camera.name == "a"
    assert (read.source, read.weight) == ("photo", 1.0)
    assert read.camera.projection == Perspective((5 / 6, 5 / 4))
    assert read.color is not None
    assert (read.color[..., 3] == 255).all()


def test_a_mask_becomes_alpha(tmp_path):
    mask = np.zeros((4, 6), np.uint8)
    mask[:, 3:] = 255
    write_png(tmp_path / "mask.png", mask)
    someone_elses(tmp_path, mask_path="mask.png")
    color = read_views(tmp_path).frames[0].color
    assert color is not None
    assert np.array_equal(color[..., 3], mask)


BAD = {
    "outside": ({"file_path": "../a.png"}, "outside"),
    "absolute": ({"file_path": "/etc/passwd"}, "outside"),
    "missing": ({"file_path": "b.png"}, "no file b.png"),
    "nan": ({"transform_matrix": [[float("nan")] * 4] * 4}, "not finite"),
    "no matrix": ({"transform_matrix": None}, "missing"),
    "size": ({"w": 7}, "sizes differ"),
    "source": ({"source": "dream"}, "dream"),
    "weight": ({"weight": -1}, "weight"),
    "weight nan": ({"weight": float("nan")}, "weight"),
    "depth png": ({"depth_file_path": "a.png"}, "not an EXR"),
    "no picture": ({"file_path": None}, "names no picture"),
    "name": ({"name": "a/b"}, "other characters"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_frame_says_what_and_where(tmp_path, case):
    frame, message = BAD[case]
    someone_elses(tmp_path, **frame)
    with pytest.raises(BadViews, match=message) as caught:
        read_views(tmp_path)
    assert "transforms.json" in str(caught.value)


def test_a_link_out_of_the_folder_is_refused(tmp_path):
    (tmp_path / "views").mkdir()
    someone_elses(tmp_path / "views", file_path="link.png")
    write_png(tmp_path / "secret.png", np.zeros((4, 6, 3), np.uint8))
    (tmp_path / "views" / "link.png").symlink_to(tmp_path / "secret.png")
    with pytest.raises(BadViews, match="outside"):
        read_views(tmp_path / "views")


@pytest.mark.parametrize("content", ["{", "[]", "{}", '{"frames": []}', '{"frames": [1]}', '{"frames": 3}'])
def test_a_malformed_transforms_json(tmp_path, content):
    (tmp_path / "transforms.json").write_text(content)
    with pytest.raises(BadViews, match=r"transforms\.json"):
        read_views(tmp_path)


def test_sizes_must_agree_within_a_view(tmp_path, views):
    write_views(tmp_path, views)
    write_png(tmp_path / "normal" / "front.png", np.zeros((5, 5, 3), np.uint8))
    with pytest.raises(BadViews, match=r"front.*sizes differ.*5x5"):
        read_views(tmp_path)


def test_a_damaged_picture_is_a_bad_image(tmp_path, views):
    write_views(tmp_path, views)
    (tmp_path / "color" / "front.png").write_bytes(b"no picture")
    with pytest.raises(BadImage, match=r"front\.png"):
        read_views(tmp_path)


def test_no_folder(tmp_path):
    for path in (tmp_path, tmp_path / "none"):
        with pytest.raises(MissingInput, match="not a views folder"):
            read_views(path)


@pytest.mark.parametrize("names", [("a", "a"), ("../a", "b"), ("a", "A")])
def test_names_that_cannot_be_files_are_not_written(tmp_path, names):
    cameras = [look_at_origin(name, (0.0, -2.0, 0.0), Orthographic()) for name in names]
    with pytest.raises(BadViews):
        write_views(tmp_path / "views", Views(tuple(view(camera) for camera in cameras)))
    assert not (tmp_path / "views").exists()
