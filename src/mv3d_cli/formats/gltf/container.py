"""The container: JSON, buffers and addresses of a .gltf or .glb file. Nothing outside its folder is read.

Messages do not say which file: who opens it does.
"""

from __future__ import annotations

import base64
import binascii
import json
import re
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote_to_bytes

from mv3d_cli.errors import BadMesh
from mv3d_cli.formats.images import read_bytes

_SUPPORTED = {
    "KHR_draco_mesh_compression", "KHR_mesh_quantization", "KHR_texture_transform", "EXT_texture_webp",
    "KHR_lights_punctual",
}  # fmt: skip
JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*:")


@dataclass(frozen=True)
class Document:
    """A parsed file. `binary` is the .glb's own buffer; `buffers` remembers those that were opened."""

    path: Path
    json: dict[str, Any]
    binary: memoryview | None = None
    buffers: dict[int, memoryview] = field(default_factory=dict)

    def item(self, kind: str, index: Any) -> dict[str, Any]:
        """The entry `index` of the list `kind`. Raises BadMesh where it is not there."""
        items = self.json.get(kind, [])
        if not isinstance(items, list) or not isinstance(index, int) or not 0 <= index < len(items):
            raise self.bad(f"it refers to {kind}[{index}], which is not there")
        if not isinstance(items[index], dict):
            raise self.bad(f"{kind}[{index}] is not an object")
        return items[index]

    def bad(self, reason: str, hint: str = "Export the mesh again as glTF 2.0.") -> BadMesh:
        """The error to raise."""
        return BadMesh(f"{reason}.", hint)


def read_document(path: Path) -> Document:
    """Open a file and read its JSON, not yet its buffers.

    Raises MissingInput, or BadMesh for another format, a truncated file, or extensions that we lack.
    """
    data = memoryview(read_bytes(path))
    text, binary = _chunks(data) if data[:4] == b"glTF" else (data, None)
    try:
        content = json.loads(bytes(text))
    except (ValueError, RecursionError) as error:
        raise BadMesh(f"it is not glTF: {error}.", "Give a .glb or .gltf file of version 2.") from None
    if not isinstance(content, dict) or not isinstance(content.get("asset"), dict):
        raise BadMesh("it is not glTF: it has no asset.", "Give a .glb or .gltf file of version 2.")
    document = Document(path, content, binary)
    if not str(content["asset"].get("version", "")).startswith("2."):
        raise document.bad(f"it is glTF of version {content['asset'].get('version')}, not 2")
    lacking = [name for name in content.get("extensionsRequired", []) if not _supported(str(name))]
    if lacking:
        hint = "Export it without; textures as PNG or JPEG, meshes plain or with Draco."
        raise document.bad(f"it requires {', '.join(map(str, lacking))}, which is not supported", hint)
    return document


def buffer(document: Document, index: Any) -> memoryview:
    """A buffer's bytes. Raises BadMesh where it has fewer than it declares, or lies outside the folder."""
    if index not in document.buffers:
        item = document.item("buffers", index)
        if "uri" in item:
            data = memoryview(uri_bytes(document, item["uri"]))
        elif document.binary is not None and index == 0:
            data = document.binary
        else:
            raise document.bad(f"buffers[{index}] has no data")
        if len(data) < item["byteLength"]:
            missing = f"{len(data)} of its {item['byteLength']} bytes"
            raise document.bad(f"it is truncated: buffers[{index}] has {missing}")
        document.buffers[index] = data
    return document.buffers[index]


def view_bytes(document: Document, index: Any) -> memoryview:
    """The bytes of a buffer view."""
    item = document.item("bufferViews", index)
    start, length = item.get("byteOffset", 0), item["byteLength"]
    data = buffer(document, item["buffer"])
    if start < 0 or length < 0 or start + length > len(data):
        raise document.bad(f"bufferViews[{index}] reaches beyond its buffer")
    return data[start : start + length]


def uri_bytes(document: Document, uri: str) -> bytes:
    """The bytes behind an address: data: or a file of the folder. Raises BadMesh for any other."""
    if not uri.startswith("data:"):
        return read_bytes(uri_path(document, uri))
    head, _, body = uri.partition(",")
    try:
        return base64.b64decode(body, validate=True) if head.endswith(";base64") else unquote_to_bytes(body)
    except binascii.Error as error:
        raise document.bad(f"a data: address is damaged ({error})") from None


def uri_path(document: Document, uri: str) -> Path:
    """The file behind a relative address. Raises BadMesh for one that leaves the folder, also by a link."""
    name = unquote_to_bytes(uri).decode("utf-8", errors="replace").replace("\\", "/")
    folder = document.path.parent.resolve()
    path = (folder / name).resolve()
    if _SCHEME.match(name) or name.startswith("/") or not path.is_relative_to(folder):
        hint = "Put its buffers and textures beside it, or export it as one .glb."
        raise document.bad(f"it refers to {uri[:200]}, outside its folder, which is refused", hint)
    return path


def _supported(extension: str) -> bool:
    # Material extensions refine a surface that is well-defined without them.
    return extension in _SUPPORTED or extension.startswith("KHR_materials_")


def _chunks(data: memoryview) -> tuple[memoryview, memoryview | None]:
    """The JSON and the binary chunk of a .glb."""
    if len(data) < 20:
        raise BadMesh(f"it is truncated: it has {len(data)} bytes.", "Copy or export the file again.")
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2:
        raise BadMesh(f"it is binary glTF of version {version}, not 2.", "Export it as glTF 2.0.")
    if length > len(data):
        raise BadMesh(f"it is truncated: {len(data)} of {length} bytes.", "Copy or export the file again.")
    found: dict[int, memoryview] = {}
    offset = 12
    while offset + 8 <= length:
        size, kind = struct.unpack_from("<II", data, offset)
        if offset + 8 + size > length:
            raise BadMesh("it is truncated inside a chunk.", "Copy or export the file again.")
        found.setdefault(kind, data[offset + 8 : offset + 8 + size])
        offset += 8 + size + (-size % 4)
    if JSON_CHUNK not in found:
        raise BadMesh("it has no JSON chunk.", "Copy or export the file again.")
    return found[JSON_CHUNK], found.get(BINARY_CHUNK)
