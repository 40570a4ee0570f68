"""STL: triangles without colour. Written as binary: an 80-byte header, then 50 bytes a face."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mv3d_cli.errors import BadMesh
from mv3d_cli.formats.images import check_readable
from mv3d_cli.formats.textures import GREY_MATERIAL
from mv3d_cli.scene.mesh import Mesh, face_normals

_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read_stl(path: Path) -> Mesh:
    """A grey mesh in the file's own axes, of all its solids. Raises MissingInput or BadMesh."""
    from trimesh.exchange.stl import load_stl

    check_readable(path)
    with path.open("rb") as stream:
        read: dict[str, Any] = load_stl(stream)
    solids = list(read["geometry"].values()) if "geometry" in read else [read]
    if not solids:
        raise BadMesh("it has no face.", "Give a mesh of triangles.")
    vertices = np.concatenate([solid["vertices"] for solid in solids]).astype(np.float32)
    faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
    return Mesh(vertices, faces, np.zeros(len(faces), np.int32), (GREY_MATERIAL,))


def stl_bytes(mesh: Mesh, note: str) -> bytes:
    """The mesh in its own axes; `note`, of which 80 bytes are kept, may not begin with "solid"."""
    facets = np.zeros(len(mesh.faces), _FACET)
    facets["normal"] = face_normals(mesh)
    facets["corners"] = mesh.vertices[mesh.faces]
    header = note.encode("ascii", errors="replace")[:80].ljust(80)
    return header + np.uint32(len(facets)).astype("<u4").tobytes() + facets.tobytes()
