"""The kernels' one source also compiles for CUDA; this needs no card."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import pytest
import warp as wp

from mv3d_cli.kernels.fuse import warp_kernels as fuse
from mv3d_cli.kernels.hash_grid import warp_kernels as hash_grid
from mv3d_cli.kernels.rasterize import warp_kernels as rasterize
from mv3d_cli.kernels.shade import warp_kernels as shade


@pytest.mark.parametrize("module", [fuse, hash_grid, rasterize, shade], ids=["fuse", "hash_grid", "rasterize", "shade"])
def test_compiles_for_cuda(module: ModuleType, tmp_path: Path) -> None:
    wp.compile_aot_module(module, device=None, arch=80, module_dir=str(tmp_path), use_ptx=True)
    (program,) = tmp_path.glob("*.ptx")
    assert ".target sm_80" in program.read_text()
