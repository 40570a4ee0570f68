"""What the benchmarks have in common: where the data lie, how a mesh is prepared, how a table is printed."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from mv3d_cli.formats.meshes import find_meshes, read_mesh
from mv3d_cli.scene.mesh import Mesh, transform, unit_sphere_from_mesh

SHARED = Path(os.environ.get("MV3D_SHARED", Path(__file__).resolve().parents[2] / "shared"))


def shared(name: str) -> Path:
    """A file or folder of the shared data; where it is missing the benchmark ends with a clear word."""
    path = SHARED / name
    if not path.exists():
        print(f"skipped: there is no {path}; set MV3D_SHARED to the folder that holds {name}")
        sys.exit(0)
    return path


def scanned_mesh(name: str) -> Mesh:
    """A Google Scanned Object in the unit sphere."""
    return in_unit_sphere(read_mesh(find_meshes(shared(f"gso/{name}"))[0]))


def in_unit_sphere(mesh: Mesh) -> Mesh:
    return transform(mesh, unit_sphere_from_mesh(mesh))


@contextmanager
def empty_cache() -> Iterator[Path]:
    """A cache of our own for the time of the benchmark."""
    before = os.environ.get("MV3D_CACHE_DIR")
    with tempfile.TemporaryDirectory(prefix="mv3d-bench-") as folder:
        os.environ["MV3D_CACHE_DIR"] = folder
        try:
            yield Path(folder)
        finally:
            os.environ.pop("MV3D_CACHE_DIR")
            if before is not None:
                os.environ["MV3D_CACHE_DIR"] = before


def table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """Prints one markdown table."""
    lines = [[str(cell) for cell in row] for row in (head, *rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(head))]
    lines.insert(1, ["-" * width for width in widths])
    for line in lines:
        print("| " + " | ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) + " |")
