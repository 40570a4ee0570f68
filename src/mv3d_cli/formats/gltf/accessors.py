"""Accessors: typed arrays inside buffers."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float32, Int64, Shaped

from mv3d_cli.formats.gltf.container import Document, view_bytes

COMPONENTS = {
    5120: np.int8,
    5121: np.uint8,
    5122: np.int16,
    5123: np.uint16,
    5125: np.uint32,
    5126: np.float32,
}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_MAX_SPARSE = 2**24
"""Elements of an accessor without a buffer view, whose size no buffer bounds."""


def elements(document: Document, index: Any) -> Shaped[np.ndarray, "count width"]:
    """An accessor's elements in their stored type; a view of the buffer where possible.

    Raises BadMesh where they reach beyond their buffer view.
    """
    accessor = document.item("accessors", index)
    if accessor["componentType"] not in COMPONENTS or accessor["type"] not in WIDTHS:
        raise document.bad(f"accessors[{index}] has an unknown type")
    dtype, width = np.dtype(COMPONENTS[accessor["componentType"]]).newbyteorder("<"), WIDTHS[accessor["type"]]
    count = accessor["count"]
    if "bufferView" in accessor:
        where = (accessor["bufferView"], accessor.get("byteOffset", 0))
        values = _strided(document, where, dtype, (count, width))
    elif count > _MAX_SPARSE:
        raise document.bad(f"accessors[{index}] declares {count} elements and holds none")
    else:
        values = np.zeros((count, width), dtype)
    return _with_sparse(document, accessor["sparse"], values) if "sparse" in accessor else values


def floats(document: Document, index: Any) -> Float32[np.ndarray, "count width"]:
    """An accessor's elements as numbers; normalised integers are brought to [0, 1] or [-1, 1]."""
    accessor = document.item("accessors", index)
    return normalised(elements(document, index), bool(accessor.get("normalized")))


def normalised(values: Shaped[np.ndarray, "count width"], apply: bool) -> Float32[np.ndarray, "count width"]:
    """float32 values, divided by their integer type's largest if `apply`."""
    if not apply or values.dtype.kind == "f":
        return values.astype(np.float32)
    return np.maximum(values.astype(np.float32) / np.float32(np.iinfo(values.dtype).max), -1)


def indices(document: Document, index: Any) -> Int64[np.ndarray, "count"]:
    """An accessor's elements as indices."""
    return elements(document, index).reshape(-1).astype(np.int64)


def _strided(
    document: Document, where: tuple[Any, int], dtype: np.dtype, shape: tuple[int, int]
) -> Shaped[np.ndarray, "count width"]:
    """The elements of a (buffer view, byte offset)."""
    view, offset = where
    data = view_bytes(document, view)
    count, width = shape
    element = dtype.itemsize * width
    stride = document.item("bufferViews", view).get("byteStride") or element
    end = offset + stride * (count - 1) + element if count > 0 else 0
    if count < 0 or offset < 0 or stride < 1 or end > len(data):
        raise document.bad(f"it is truncated or damaged: {count} elements reach beyond bufferViews[{view}]")
    return np.ndarray(shape, dtype, buffer=data, offset=offset if count else 0, strides=(stride, dtype.itemsize))


def _with_sparse(
    document: Document, sparse: dict[str, Any], values: Shaped[np.ndarray, "count width"]
) -> Shaped[np.ndarray, "count width"]:
    """The values with some replaced."""
    count, at, new = sparse["count"], sparse["indices"], sparse["values"]
    where = (at["bufferView"], at.get("byteOffset", 0))
    rows = _strided(document, where, np.dtype(COMPONENTS[at["componentType"]]), (count, 1)).reshape(-1)
    if rows.size and rows.max() >= len(values):
        raise document.bad("a sparse accessor replaces elements that are not there")
    replaced = values.copy()
    where = (new["bufferView"], new.get("byteOffset", 0))
    replaced[rows] = _strided(document, where, values.dtype, (count, values.shape[1]))
    return replaced
