import json
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mv3d_cli.errors import BadCameras, MissingInput
from mv3d_cli.formats import assets, cameras
from mv3d_cli.scene.camera import Camera, Orthographic, Perspective, look_at_origin
from mv3d_cli.scene.rig import HORIZONTAL

SHARED = Path(os.environ.get("MV3D_SHARED", Path(__file__).resolve().parents[3] / "shared"))


def test_the_rig():
    rig = cameras.load_cameras()
    assert len(rig) == 12
    positions = {camera.name: camera.world_from_camera[:3, 3] for camera in rig}
    assert np.allclose(positions["front"], (0, -2, 0))
    assert np.allclose(positions["right"], (2, 0, 0))
    assert np.allclose(positions["front_left_top"], np.array([-2, -2, 2]) / 3**0.5)
    for camera in rig:
        assert camera.projection == Orthographic(1.0)
        assert np.linalg.norm(positions[camera.name]) == pytest.approx(2)
        assert np.allclose(camera.world_from_camera[:3, 2], -positions[camera.name] / 2), "looks at the origin"
    assert len({tuple(np.round(position, 6)) for position in positions.values()}) == 12


@pytest.mark.parametrize("name", [camera.name for camera in cameras.load_cameras()])
def test_names_say_where_a_camera_is(name):
    (camera,) = cameras.select(cameras.load_cameras(), [name])
    signs = {"front": (1, -1), "back": (1, 1), "right": (0, 1), "left": (0, -1), "top": (2, 1)}
    expected = np.zeros(3)
    for word in name.split("_"):
        axis, sign = signs[word]
        expected[axis] = sign
    assert np.allclose(camera.world_from_camera[:3, 3], 2 * expected / np.linalg.norm(expected))


def test_the_eight_horizontal_ones():
    chosen = cameras.select(cameras.load_cameras(), HORIZONTAL)
    assert [camera.name for camera in chosen] == list(HORIZONTAL)
    assert all(abs(camera.world_from_camera[2, 3]) < 1e-12 for camera in chosen)
    assert len(chosen) == 8


def test_an_unknown_view_names_the_known_ones():
    with pytest.raises(BadCameras, match="fornt") as caught:
        cameras.select(cameras.load_cameras(), ["fornt"])
    assert "Did you mean front?" in caught.value.hint
    assert "back_left" in caught.value.hint


def test_a_missing_asset():
    with pytest.raises(MissingInput, match=r"none\.bin"):
        assets.asset("none.bin")


def test_the_assets_of_an_installed_wheel_come_first(tmp_path, monkeypatch):
    (tmp_path / "assets").mkdir()
    (tmp_path / "assets" / "cameras.json").write_text("{}")
    monkeypatch.setattr(assets, "_FOLDERS", (tmp_path / "assets", *assets._FOLDERS))
    assert assets.asset("cameras.json") == tmp_path / "assets" / "cameras.json"


def written(tmp_path: Path, content) -> Path:
    path = tmp_path / "cameras.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_our_layout(tmp_path):
    pose = look_at_origin("p", (1.0, -1.0, 1.0), Orthographic()).world_from_camera
    path = written(
        tmp_path,
        {
            "version": 1,
            "cameras": [
                {"name": "a", "position": [0, 0, 3], "projection": {"type": "orthographic", "half_extent": 0.5}},
                {
                    "name": "b",
                    "world_from_camera": pose.tolist(),
                    "projection": {"type": "perspective", "focal": [1.1, 1.2], "centre": [0.4, 0.6]},
                },
            ],
        },
    )
    a, b = cameras.load_cameras(path)
    assert a.projection == Orthographic(0.5)
    assert b.projection == Perspective((1.1, 1.2), (0.4, 0.6))
    assert np.array_equal(b.world_from_camera, pose)


def test_lists_of_matrices(tmp_path):
    pose = look_at_origin("p", (1.0, -1.0, 1.0), Orthographic()).camera_from_world
    intrinsics = [[280, 0, 128], [0, 140, 96], [0, 0, 1]]
    content = {"model": "perspective", "width": 256, "height": 128, "K": intrinsics}
    (camera,) = cameras.load_cameras(written(tmp_path, {**content, "camera_from_world": [pose[:3].tolist()]}))
    assert camera.name == "000"
    assert camera.projection == Perspective((280 / 256, 140 / 128), (0.5, 0.75))
    assert np.allclose(camera.camera_from_world, pose)


def test_published_cameras():
    path = SHARED / "gso30" / "cameras.json"
    if not path.exists():
        pytest.skip(f"needs the published cameras at {path}")
    rig = cameras.load_cameras(path)
    assert [camera.name for camera in rig[:2]] == ["000", "001"]
    assert len(rig) == 16
    content = json.loads(path.read_text())
    for camera, azimuth in zip(rig, content["azimuth_rad"], strict=True):
        x, y, z = camera.world_from_camera[:3, 3]
        assert np.linalg.norm((x, y, z)) == pytest.approx(1.5, abs=1e-4)
        assert np.arctan2(y, x) % (2 * np.pi) == pytest.approx(azimuth, abs=1e-4)
        assert z == pytest.approx(0.75, abs=1e-4)


def test_nerfstudio(tmp_path):
    path = written(
        tmp_path,
        {
            "camera_model": "OPENCV",
            **{"w": 200, "h": 100, "fl_x": 150, "fl_y": 160, "cx": 90, "cy": 55},
            "frames": [{"file_path": "images/frame_1.png", "transform_matrix": np.eye(4).tolist()}],
        },
    )
    (camera,) = cameras.load_cameras(path)
    assert camera.name == "frame_1"
    assert camera.projection == Perspective((0.75, 1.6), (0.45, 0.55))
    assert np.array_equal(camera.world_from_camera, np.diag([1, -1, -1, 1])), "looks along -z, y up"


def test_a_field_of_view_gives_the_focal_length():
    frame = {"transform_matrix": np.eye(4).tolist(), "camera_angle_x": np.pi / 2}
    camera = cameras.camera_from_frame(frame, {"w": 200, "h": 100}, "a")
    assert isinstance(camera.projection, Perspective)
    assert camera.projection.focal == pytest.approx((0.5, 1.0))


coordinate = st.floats(-3, 3).filter(lambda value: abs(value) > 0.1)
projections = st.one_of(
    st.builds(Orthographic, st.floats(0.1, 10)),
    st.builds(
        Perspective, st.tuples(st.floats(0.1, 5), st.floats(0.1, 5)), st.tuples(st.floats(0, 1), st.floats(0, 1))
    ),
)


@given(st.tuples(coordinate, coordinate, coordinate), projections, st.integers(1, 2000), st.integers(1, 2000))
def test_frames_round_trip(position, projection, width, height):
    camera = look_at_origin("a", position, projection)
    frame = json.loads(json.dumps(cameras.frame_from_camera(camera, width, height)))
    back = cameras.camera_from_frame(frame, {}, "a")
    assert np.array_equal(back.world_from_camera, camera.world_from_camera)
    if isinstance(projection, Orthographic):
        assert back.projection == projection
        del frame["half_extent"]
        back = cameras.camera_from_frame(frame, {}, "a")
        assert isinstance(back.projection, Orthographic)
        assert back.projection.half_extent == pytest.approx(projection.half_extent, rel=1e-14)
    else:
        assert isinstance(back.projection, Perspective)
        assert back.projection.focal == pytest.approx(projection.focal, rel=1e-15)
        assert back.projection.centre == pytest.approx(projection.centre, rel=1e-15, abs=1e-300)


GOOD = {"name": "a", "position": [0, -2, 0], "projection": {"type": "orthographic"}}
EYE = np.eye(4).tolist()
BAD = {
    "not JSON": ("{", "line 1"),
    "binary": ("\x00\x01", "not JSON"),
    "deep": ("[" * 100_000, "nested|JSON"),
    "a list": ([], "not a JSON object"),
    "no list": ({}, "no list"),
    "no camera": ({"cameras": []}, "no camera"),
    "future": ({"version": 2, "cameras": [GOOD]}, "version 2"),
    "no name": ({"cameras": [{"position": [0, -2, 0]}]}, "camera 0.*no name"),
    "number": ({"cameras": [GOOD, 3]}, "camera 1.*not a JSON object"),
    "twice": ({"cameras": [GOOD, GOOD]}, "same name"),
    "slash": ({"cameras": [{**GOOD, "name": "../a"}]}, "other characters"),
    "no position": ({"cameras": [{"name": "a"}]}, "camera 0 .a.: position is missing"),
    "origin": ({"cameras": [{**GOOD, "position": [0, 0, 0]}]}, "origin"),
    "two numbers": ({"cameras": [{**GOOD, "position": [0, 0]}]}, "3 numbers"),
    "words": ({"cameras": [{**GOOD, "position": ["x", 0, 1]}]}, "numbers"),
    "nan": ('{"cameras": [{"name": "a", "position": [NaN, 0, 0]}]}', "not finite"),
    "fisheye": ({"cameras": [{**GOOD, "projection": {"type": "fisheye"}}]}, "fisheye"),
    "flat": ({"cameras": [{**GOOD, "projection": {"type": "orthographic", "half_extent": 0}}]}, "not positive"),
    "mirror": ({"cameras": [{"name": "a", "world_from_camera": np.diag([1, 1, -1, 1]).tolist()}]}, "rotation"),
    "scaled": ({"cameras": [{"name": "a", "world_from_camera": np.diag([2, 2, 2, 1]).tolist()}]}, "rotation"),
    "K": ({"camera_from_world": [EYE], "width": 2, "height": 2}, "K is missing"),
    "distorted": ({"k1": 0.1, "w": 4, "h": 4, "fl_x": 3, "frames": [{"transform_matrix": EYE}]}, "distortion"),
    "equirectangular": ({"camera_model": "EQUIRECTANGULAR", "frames": [{"transform_matrix": EYE}]}, "camera_model"),
    "no size": ({"frames": [{"transform_matrix": EYE, "fl_x": 3}]}, "w is missing"),
    "no focal length": ({"frames": [{"transform_matrix": EYE, "w": 3, "h": 3}]}, "fl_x is missing"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_malformed_file_says_what_and_where(tmp_path, case):
    content, message = BAD[case]
    with pytest.raises(BadCameras, match=message) as caught:
        cameras.load_cameras(written(tmp_path, content))
    assert "cameras.json" in str(caught.value)


def test_a_missing_file(tmp_path):
    with pytest.raises(MissingInput):
        cameras.load_cameras(tmp_path / "none.json")


def test_a_camera_is_a_value():
    assert isinstance(cameras.load_cameras()[0], Camera)
