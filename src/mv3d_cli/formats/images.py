"""Pictures and depth maps.

Colour is sRGB with straight alpha, 8 bits; depth is planar z in scene units, float32, 0 = no surface.

Decoding is Pillow's: as fast as OpenCV's on these files and, unlike it, strict about truncated ones.
PNG encoding is OpenCV's: Pillow has no choice of filter, and takes 10 ms where this takes 4 ms.
"""

from __future__ import annotations

import contextlib
import io
import sys
import threading
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, UInt8
from PIL import Image, ImageOps
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile

from mv3d_cli.errors import BadImage, MissingInput

MAX_SIDE = 16_384
MAX_PIXELS = 64_000_000
_MAX_DECODED = 768 * 2**20
"""Bytes that Pillow may hold for one picture before it is reduced."""

# No PostScript: Pillow hands it to another program.
_FORMATS = ("WEBP", "TIFF", "BMP", "TGA", "GIF", "PPM", "JPEG2000", "AVIF")
_DEEP_MODES = ("I", "F")
_exr_reading = threading.Lock()


def read_image(path: Path) -> UInt8[np.ndarray, "height width 4"]:
    """A picture's pixels as they are stored: sRGB, straight alpha, EXIF orientation ignored.

    Raises MissingInput, or BadImage for no picture, a damaged one, or one beyond MAX_SIDE or MAX_PIXELS.
    """
    return np.array(_decoded(read_bytes(path), str(path)))


def read_photo(source: Path | bytes) -> UInt8[np.ndarray, "height width 4"]:
    """A photo's pixels, turned upright as its EXIF orientation says; from a file or from its bytes.

    Raises as `read_image`.
    """
    data, label = (source, "the picture") if isinstance(source, bytes) else (read_bytes(source), str(source))
    return np.array(_decoded(data, label, upright=True))


def decode_reduced(data: bytes, label: str, side: int) -> tuple[UInt8[np.ndarray, "height width 4"], tuple[int, int]]:
    """Pixels brought down to at most `side` pixels a side, and the picture's own (width, height).

    JPEG is decoded at a fraction of its size; other formats are decoded whole, within a fixed amount of
    memory, and averaged strip by strip. Raises BadImage, also where that memory would not do.
    """
    with _decoding(label):
        image = _opened(data)
        size = image.size
        if image.format == "JPEG" and max(size) > side:
            image.draft(None, (side, side))
        _refuse_beyond_memory(image, size, label)
        factor = -(-max(image.size) // side)
        pixels = _rgba(image) if factor == 1 else _averaged(image, factor)
        return np.array(pixels), size


def read_bytes(path: Path) -> bytes:
    """The file's bytes. Raises MissingInput where there is no such file, or it may not be read."""
    check_readable(path)
    return path.read_bytes()


def check_readable(path: Path) -> None:
    """Raise MissingInput unless `path` is a file that can be opened."""
    try:
        path.open("rb").close()
    except (FileNotFoundError, NotADirectoryError):
        raise MissingInput(f"there is no file {path}.", "Check the path.") from None
    except OSError as error:
        reason = error.strerror or error
        raise MissingInput(f"{path} cannot be read: {reason}.", "Give a file that you may read.") from None


def write_png(path: Path, pixels: UInt8[np.ndarray, "height width *channels"]) -> None:
    """Write grey, RGB or RGBA pixels (no, 3 or 4 channels)."""
    path.write_bytes(png_bytes(pixels))


def png_bytes(pixels: UInt8[np.ndarray, "height width *channels"]) -> bytes:
    """Grey, RGB or RGBA pixels (no, 3 or 4 channels) as the bytes of a PNG file."""
    import cv2

    to_bgr = {3: cv2.COLOR_RGB2BGR, 4: cv2.COLOR_RGBA2BGRA}
    swapped = cv2.cvtColor(pixels, to_bgr[pixels.shape[2]]) if pixels.ndim == 3 else pixels
    # Renders are runs of flat colour: with the sub filter, run lengths beat zlib's search in time and in size
    # (512^2 RGBA of an object: 4.0 ms and 160 kB; defaults at level 1: 10.3 ms and 174 kB).
    settings = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
    settings += [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_SUB]
    return cv2.imencode(".png", swapped, settings)[1].tobytes()


def write_depth(path: Path, depth: Float[np.ndarray, "height width"]) -> None:
    """Write planar z (scene units, 0 = no surface) as OpenEXR, one float32 channel `Z`."""
    import OpenEXR

    # Lossless, 512^2 map of an object: RLE 2.9 ms, 421 kB; none 2.1 ms, 1032 kB; ZIP 5.7 ms, 395 kB;
    # ZIPS 10 ms, 436 kB; PIZ 19 ms, 387 kB.
    header = {"compression": OpenEXR.RLE_COMPRESSION, "type": OpenEXR.scanlineimage}
    try:
        with OpenEXR.File(header, {"Z": np.ascontiguousarray(depth, np.float32)}) as file:
            file.write(str(path))
    except RuntimeError as error:
        raise OSError(f"{path} could not be written: {error}") from error


def read_depth(path: Path) -> Float32[np.ndarray, "height width"]:
    """Planar z (scene units, 0 = no surface) from channel `Z`, or the only channel, of an OpenEXR file.

    Raises MissingInput, or BadImage for a damaged file, another layout, or values that are no depth.
    """
    import OpenEXR

    check_readable(path)
    # On a damaged file the library prints to stdout, which belongs to results.
    with _decoding(str(path)), _exr_reading, contextlib.redirect_stdout(sys.stderr):
        with OpenEXR.File(str(path), header_only=True) as file:
            low, high = file.header()["dataWindow"]
        width, height = (int(high[axis]) - int(low[axis]) + 1 for axis in (0, 1))
        _refuse_large((width, height), str(path))
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    depth = channels.get("Z") if "Z" in channels or len(channels) != 1 else next(iter(channels.values()))
    if depth is None or depth.ndim != 2:
        found = ", ".join(channels)
        raise BadImage(f"{path} has no channel Z, only {found}.", "Write depth as one float32 channel Z.")
    if not np.isfinite(depth).all() or depth.min(initial=0) < 0:
        raise BadImage(f"{path} holds depths below 0 or not finite.", "Write 0 where there is no surface.")
    return depth.astype(np.float32, copy=False)


def _decoded(data: bytes, label: str, upright: bool = False) -> Image.Image:
    with _decoding(label):
        image = _opened(data)
        _refuse_large(image.size, label)
        return _rgba(ImageOps.exif_transpose(image) if upright else image)


@contextlib.contextmanager
def _decoding(label: str):
    """Whatever a decoder makes of a damaged file becomes BadImage."""
    try:
        yield
    except BadImage:
        raise
    except Exception as error:  # decoders of damaged files raise nearly every kind
        reason = "not a picture" if isinstance(error, Image.UnidentifiedImageError) else str(error).rstrip(".")
        hint = "Give an intact picture, for example a PNG."
        raise BadImage(f"{label} cannot be decoded: {reason}.", hint) from error


def _opened(data: bytes) -> Image.Image:
    # By class, because Image.open refuses by pixel count before one could ask for a reduced decode.
    stream = io.BytesIO(data)
    if data.startswith(b"\xff\xd8\xff"):
        return JpegImageFile(stream)
    if data.startswith(b"\x89PNG"):
        return PngImageFile(stream)
    return Image.open(stream, formats=_FORMATS)


def _refuse_large(size: tuple[int, int], label: str) -> None:
    if max(size) > MAX_SIDE or size[0] * size[1] > MAX_PIXELS:
        raise BadImage(
            f"{label} is {size[0]}x{size[1]}: over {MAX_SIDE} pixels a side or {MAX_PIXELS // 10**6} M.",
            "Scale it down; results use at most a few thousand pixels a side.",
        )


def _refuse_beyond_memory(image: Image.Image, size: tuple[int, int], label: str) -> None:
    pixel_bytes = 1 if image.mode in ("1", "L", "P") else 4
    needed = image.width * image.height * pixel_bytes
    if image.info.get("progressive"):  # libjpeg holds all coefficients, whatever the output size
        needed += size[0] * size[1] * 6
    if needed > _MAX_DECODED:
        raise BadImage(
            f"{label} is {size[0]}x{size[1]} pixels and cannot be decoded in {_MAX_DECODED >> 20} MiB.",
            "Scale it down, or save it as a baseline JPEG, which can be read at reduced size.",
        )


def _rgba(image: Image.Image) -> Image.Image:
    if image.mode in _DEEP_MODES:
        raise BadImage("32-bit samples are no colour picture.", "Save it with 8 or 16 bits per channel.")
    if image.mode.startswith("I;16"):  # Pillow would clip instead of scaling
        image = Image.fromarray((np.asarray(image) >> 8).astype(np.uint8))
    return image.convert("RGBA")


def _averaged(image: Image.Image, factor: int) -> Image.Image:
    """The mean over blocks of `factor` x `factor` pixels, weighted by alpha."""
    image.load()
    reduced = Image.new("RGBA", (-(-image.width // factor), -(-image.height // factor)))
    rows = factor * max(1, 2**22 // (factor * image.width))
    for top in range(0, image.height, rows):
        strip = image.crop((0, top, image.width, min(top + rows, image.height)))
        reduced.paste(_rgba(strip).reduce(factor), (0, top // factor))
    return reduced
