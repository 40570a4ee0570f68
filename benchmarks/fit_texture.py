"""How like the object a fitted, exported GLB looks from where no view was: PSNR on white, 256 pixels.

Clean views of the rig's eight horizontal cameras are fitted by the installed command; its GLB and the scan are drawn
by `mv3d render`'s rasteriser from the rig's four upper cameras and from between the horizontal ones. The views, and
the truth, are without light (the texture holds the light that was on the views).
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from mv3d_cli.capture.rendering import render
from mv3d_cli.formats.cameras import load_cameras
from mv3d_cli.formats.images import write_png
from mv3d_cli.formats.meshes import find_meshes, read_mesh
from mv3d_cli.formats.views_folder import write_views
from mv3d_cli.metrics.image import psnr
from mv3d_cli.scene.camera import Camera, Orthographic, direction_on_sphere, look_at_origin
from mv3d_cli.scene.rig import HORIZONTAL
from mv3d_cli.scene.views import Views
from reconstruction_scores import SCANS, rig
from shared_data import scanned_mesh, shared, table

SIZE = 256
MV3D = Path(sys.executable).parent / "mv3d"
TOP = tuple(camera for camera in load_cameras() if camera.name not in HORIZONTAL)


def between() -> tuple[Camera, ...]:
    """Eight cameras half-way between the rig's horizontal ones."""
    turns = np.deg2rad(22.5 + 45 * np.arange(8))
    return tuple(
        look_at_origin(f"between_{i}", direction_on_sphere(t, 0.0), Orthographic()) for i, t in enumerate(turns)
    )


def likeness(name: str, options: list[str], pictures: Path | None) -> dict[str, float]:
    """Mean PSNR of one scan's fit over each set of cameras."""
    scan = scanned_mesh(name)
    views = render(scan, rig(), SIZE, None)
    with tempfile.TemporaryDirectory() as scratch:
        write_views(Path(scratch) / "views", Views(tuple(replace(view, normal=None) for view in views.frames)))
        command = [str(MV3D), "fit-sdf", f"{scratch}/views", *options, "-o", f"{scratch}/mesh.glb"]
        subprocess.run(
            command, check=True, stdout=subprocess.DEVNULL, env={**os.environ, "MV3D_CACHE_DIR": scratch + "/c"}
        )
        fitted = read_mesh(find_meshes(Path(scratch) / "mesh.glb")[0])
    found = {}
    for group, cameras in {"seen": rig(), "between": between(), "top": TOP}.items():
        ours, true = (render(mesh, cameras, SIZE, None).frames for mesh in (fitted, scan))
        found[group] = float(np.mean([psnr(a.color, b.color) for a, b in zip(ours, true, strict=True)]))
        if pictures:
            rows = [np.hstack([view.color for view in frames]) for frames in (ours, true)]
            write_png(pictures / f"{name}_{group}.png", np.vstack(rows))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--objects", default=",".join(SCANS))
    parser.add_argument("--pictures", type=Path, help="a folder for pictures of ours above the truth")
    given, options = parser.parse_known_args()
    shared("gso")
    names = given.objects.split(",")
    if given.pictures:
        given.pictures.mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(2) as pool:
        found = list(pool.map(partial(likeness, options=options, pictures=given.pictures), names))
    rows = [
        [name, *(f"{scores[group]:.1f}" for group in ("seen", "between", "top"))]
        for name, scores in zip(names, found, strict=True)
    ]
    mean = {group: np.mean([scores[group] for scores in found]) for group in ("seen", "between", "top")}
    rows.append(["mean", *(f"{mean[group]:.1f}" for group in mean)])
    table(["scan", "seen views, dB", "between", "top"], rows)
    held_out = (8 * mean["between"] + 4 * mean["top"]) / 12
    print(f"\nheld-out views (8 between, 4 top): {held_out:.1f} dB on average; target: at least 24")


if __name__ == "__main__":
    main()
