"""The photo as an input: its bytes, its digest, its object cut out of it."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from mv3d_cli.capture.photo import cut_out, is_cut_by_frame
from mv3d_cli.capture.photo.framing import framed
from mv3d_cli.formats.images import read_bytes, read_photo
from mv3d_cli.steps.settings import Tell, Warned

_THUMBNAIL = 192  # pixels


@dataclass(frozen=True)
class Photo:
    """A photo that is not decoded yet; `name` is its path, or says that it came without one."""

    name: str
    source: Path | bytes
    digest: str


@dataclass(frozen=True)
class Subject:
    """A photo's object.

    cut    the photo, transparent around the object
    whole  the photo as it came, small
    """

    cut: UInt8[np.ndarray, "height width 4"]
    whole: UInt8[np.ndarray, "rows columns 4"]


def photo_of(source: Path | bytes) -> Photo:
    """The photo of a file or of bytes. Raises MissingInput."""
    data = source if isinstance(source, bytes) else read_bytes(source)
    name = "the picture" if isinstance(source, bytes) else str(source)
    return Photo(name, source, hashlib.sha256(data).hexdigest())


def subject_of(photo: Photo, tell: Tell) -> Subject:
    """The photo's object; told where the frame cuts it. Raises BadImage."""
    pixels = read_photo(photo.source)
    mask = cut_out(pixels, photo.name)
    if is_cut_by_frame(mask):
        tell(Warned(f"the object in {photo.name} touches the photo's border: what lies beyond it will be missing"))
    whole = framed(pixels, _THUMBNAIL, None)
    pixels[..., 3] = mask
    return Subject(pixels, whole)
