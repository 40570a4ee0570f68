import io
import resource
import sys
import warnings
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from PIL import Image

from mv3d_cli.errors import BadImage, MissingInput
from mv3d_cli.formats import images
from mv3d_cli.formats.textures import MeshWarning, TextureFiles


@settings(max_examples=30, deadline=None)
@given(pixels=arrays.arrays(np.uint8, st.tuples(st.integers(1, 40), st.integers(1, 40), st.sampled_from([3, 4]))))
def test_png_round_trip_is_exact(tmp_path_factory, pixels):
    path = tmp_path_factory.mktemp("png") / "a.png"
    images.write_png(path, pixels)
    read = images.read_image(path)
    assert np.array_equal(read[..., : pixels.shape[2]], pixels)
    theirs = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert theirs is not None
    assert np.array_equal(theirs[..., [2, 1, 0]], pixels[..., :3])


def test_grey_png(tmp_path):
    pixels = np.arange(12, dtype=np.uint8).reshape(3, 4)
    images.write_png(tmp_path / "mask.png", pixels)
    assert np.array_equal(images.read_image(tmp_path / "mask.png")[..., 0], pixels)


@settings(max_examples=30, deadline=None)
@given(
    depth=arrays.arrays(
        np.float32,
        st.tuples(st.integers(1, 40), st.integers(1, 40)),
        elements=st.floats(0, 2.0**100, width=32),
    )
)
def test_depth_round_trip_is_exact(tmp_path_factory, depth):
    path = tmp_path_factory.mktemp("exr") / "a.exr"
    images.write_depth(path, depth)
    assert np.array_equal(images.read_depth(path), depth)


def test_depth_is_one_float_channel_z(tmp_path):
    images.write_depth(tmp_path / "a.exr", np.ones((3, 5)))
    with OpenEXR.File(str(tmp_path / "a.exr")) as file:
        assert list(file.channels()) == ["Z"]
        assert file.channels()["Z"].pixels.dtype == np.float32
        assert file.channels()["Z"].pixels.shape == (3, 5)


def test_same_depth_gives_the_same_bytes(tmp_path):
    depth = np.random.default_rng(0).random((64, 64), np.float32)
    for name in "ab":
        images.write_depth(tmp_path / name, depth)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


@pytest.mark.parametrize("kept", [0, 4, 200, 5000])
def test_a_damaged_depth_map_is_refused_and_stdout_stays_clean(tmp_path, capfd, kept):
    path = tmp_path / "a.exr"
    images.write_depth(path, np.random.default_rng(0).random((64, 64), np.float32))
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(BadImage, match=r"a\.exr"):
        images.read_depth(path)
    assert capfd.readouterr().out == ""


@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0])
def test_depths_that_are_no_depths_are_refused(tmp_path, value):
    images.write_depth(tmp_path / "a.exr", np.full((4, 4), value))
    with pytest.raises(BadImage, match="not finite"):
        images.read_depth(tmp_path / "a.exr")


def test_a_colour_exr_is_no_depth(tmp_path):
    with OpenEXR.File({}, {"RGB": np.zeros((4, 4, 3), np.float32)}) as file:
        file.write(str(tmp_path / "a.exr"))
    with pytest.raises(BadImage, match="no channel Z"):
        images.read_depth(tmp_path / "a.exr")


def test_a_depth_map_that_cannot_be_written_is_an_os_error(tmp_path):
    with pytest.raises(OSError, match="nowhere"):
        images.write_depth(tmp_path / "nowhere" / "a.exr", np.ones((2, 2)))


@pytest.mark.parametrize("content", [b"", b"hello", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xe0", b"%!PS-Adobe-3.0 EPSF"])
def test_what_is_no_picture_is_refused(tmp_path, content):
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(BadImage, match=r"a\.png"):
        images.read_image(tmp_path / "a.png")


def test_a_truncated_png_is_refused(tmp_path):
    path = tmp_path / "a.png"
    images.write_png(path, np.random.default_rng(0).integers(0, 255, (64, 64, 4), np.uint8))
    path.write_bytes(path.read_bytes()[:-3000])
    with pytest.raises(BadImage, match="truncated"):
        images.read_image(path)


def test_a_missing_picture_and_a_folder(tmp_path):
    for path in (tmp_path / "none.png", tmp_path):
        with pytest.raises(MissingInput):
            images.read_image(path)


def test_sixteen_bits_are_scaled_not_clipped(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.full((2, 2), 0x8040, np.uint16))
    assert (images.read_image(tmp_path / "a.png")[..., :3] == 0x80).all()


def test_palettes_keep_their_transparency(tmp_path):
    picture = Image.new("P", (2, 1))
    picture.putpalette([255, 0, 0, 0, 255, 0])
    picture.putpixel((1, 0), 1)
    picture.save(tmp_path / "a.png", transparency=0)
    assert images.read_image(tmp_path / "a.png").tolist() == [[[255, 0, 0, 0], [0, 255, 0, 255]]]


def test_photos_are_turned_upright_and_pictures_are_not(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.new("RGB", (30, 20)).save(tmp_path / "a.jpg", exif=exif)
    assert images.read_photo(tmp_path / "a.jpg").shape == (30, 20, 4)
    assert images.read_photo((tmp_path / "a.jpg").read_bytes()).shape == (30, 20, 4)
    assert images.read_image(tmp_path / "a.jpg").shape == (20, 30, 4)


def test_a_huge_picture_is_refused_before_it_is_decoded(tmp_path):
    Image.new("L", (20_000, 10)).save(tmp_path / "a.png")
    with pytest.raises(BadImage, match="20000x10"):
        images.read_image(tmp_path / "a.png")


def encoded(picture: Image.Image, kind: str, **settings) -> bytes:
    stream = io.BytesIO()
    picture.save(stream, kind, **settings)
    return stream.getvalue()


@pytest.mark.parametrize("kind", ["PNG", "JPEG"])
def test_reduced_pictures_keep_their_means(kind):
    rng = np.random.default_rng(0)
    smooth = cv2.resize(rng.integers(0, 255, (8, 8, 3), np.uint8), (1000, 600), interpolation=cv2.INTER_CUBIC)
    pixels, size = images.decode_reduced(encoded(Image.fromarray(smooth), kind), "a", 256)
    assert size == (1000, 600)
    assert max(pixels.shape) <= 256
    expected = cv2.resize(smooth, (pixels.shape[1], pixels.shape[0]), interpolation=cv2.INTER_AREA)
    assert np.abs(pixels[..., :3].astype(int) - expected).mean() < 3


def test_reduction_weighs_colour_by_alpha():
    pixels = np.zeros((4, 4, 4), np.uint8)
    pixels[::2] = (200, 100, 50, 255)
    reduced, _ = images.decode_reduced(encoded(Image.fromarray(pixels), "PNG"), "a", 2)
    assert np.abs(reduced.reshape(-1, 4).astype(int) - (200, 100, 50, 128)).max() <= 1


@pytest.mark.skipif(sys.platform != "linux", reason="measures memory in Linux's way")
def test_a_20000_pixel_jpeg_texture_is_reduced_with_a_warning(tmp_path):
    data = encoded(Image.new("L", (20_000, 20_000), 77), "JPEG")
    files = TextureFiles(tmp_path / "mesh.glb")
    before = int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
    with pytest.warns(MeshWarning, match="20000x20000"):
        pixels = files.pixels(0, data, "big")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - before < 2**30
    assert pixels is not None
    assert max(pixels.shape) <= 4096
    assert np.abs(pixels[..., 0].astype(int) - 77).max() <= 1


def png_that_declares(width: int, height: int) -> bytes:
    import struct
    import zlib

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", b"") + chunk(b"IEND", b"")


@pytest.mark.parametrize("side", [20_000, 60_000])
def test_a_png_beyond_memory_is_refused_by_its_header(side):
    with pytest.raises(BadImage, match=f"{side}x{side}"):
        images.decode_reduced(png_that_declares(side, side), "big", 4096)


def test_a_texture_that_is_no_picture_warns_once(tmp_path):
    files = TextureFiles(tmp_path / "mesh.glb")
    with pytest.warns(MeshWarning, match="grey"):
        assert files.pixels(0, b"nonsense", "a") is None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert files.pixels(0, b"nonsense", "a") is None
