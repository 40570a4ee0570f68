"""The main job on real photos: `generate PHOTO | fit-sdf`, by the installed command, each mesh checked and drawn.

Every photo of `../shared/photos`, those of `matting/` with their true masks as alpha. A mesh should be watertight, and
from the front fill the photo's outline (IoU with the cut-out as framed; the target is .85 on average).

    python benchmarks/generate_photos.py [--sheet PICTURE.png] [--only NAME,...] [--quick]
"""

from __future__ import annotations

import argparse
import os
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from mv3d_cli.capture.rendering import render
from mv3d_cli.capture.sheet import sheet_of_rows
from mv3d_cli.formats.cameras import load_cameras, select
from mv3d_cli.formats.images import read_photo, write_png
from mv3d_cli.formats.meshes import find_meshes, read_mesh
from mv3d_cli.formats.views_folder import read_views
from mv3d_cli.meshes.repair import watertight
from mv3d_cli.metrics.overlap import iou
from mv3d_cli.scene.views import Views
from shared_data import empty_cache, shared, table
from training_runs import MV3D

SHOWN = ("front", "front_right", "right", "back")
SIZE = 256


@dataclass(frozen=True)
class Made:
    """What became of a photo."""

    photo: np.ndarray
    views: Views
    drawn: Views
    overlap: float
    closed: bool
    seconds: tuple[float, float]


def photos(scratch: Path) -> list[Path]:
    """The photos, those that come with a mask given it as alpha."""
    folder = shared("photos")
    found = sorted(path for path in folder.iterdir() if path.suffix in (".jpg", ".png"))
    for mask in sorted((folder / "matting").glob("*_mask.png")):
        name = mask.stem.removesuffix("_mask")
        color = read_photo(mask.with_name(f"{name}.png"))
        color[..., 3] = read_photo(mask)[..., 0]
        found.append(scratch / f"{name}.png")
        write_png(found[-1], color)
    return found


def ran(*words: object) -> float:
    """Seconds of the installed command; its complaint is shown."""
    started = time.perf_counter()
    done = subprocess.run([str(MV3D), *map(str, words)], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    if done.returncode:
        raise RuntimeError(done.stderr.strip().replace("\n", "; "))
    if done.stderr:
        print(done.stderr.strip(), flush=True)
    return time.perf_counter() - started


def made(photo: Path, scratch: Path, options: list[str]) -> Made:
    """The photo's views and mesh."""
    views, mesh = scratch / f"{photo.stem}_views", scratch / f"{photo.stem}.glb"
    seconds = ran("generate", photo, "-o", views), ran("fit-sdf", views, *options, "-o", mesh)
    fitted, seen = read_mesh(find_meshes(mesh)[0]), read_views(views)
    drawn = render(fitted, select(load_cameras(), SHOWN), SIZE, None)
    front, cut = drawn.frames[0].color, seen.frames[0].color
    assert front is not None
    assert cut is not None
    return Made(
        read_photo(photo), seen, drawn, iou(front[..., 3] > 127, cut[..., 3] > 127), watertight(fitted), seconds
    )


def row_of(done: Made) -> list[np.ndarray | None]:
    """Photo, colours and a depth, then the mesh from four sides."""
    colors = [view.color for view in done.views.frames]
    return [done.photo, *colors, done.views.frames[0].depth, *(view.color for view in done.drawn.frames)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sheet", type=Path, help="where to draw everything")
    parser.add_argument("--only", default="", help="parts of the photos' names, with commas between")
    parser.add_argument("--quick", action="store_true", help="fit-sdf --quick")
    given = parser.parse_args()
    rows, sheet = [], []
    with empty_cache(), TemporaryDirectory() as scratch:
        for photo in photos(Path(scratch)):
            if given.only and not any(part in photo.name for part in given.only.split(",")):
                continue
            try:
                done = made(photo, Path(scratch), ["--quick"] if given.quick else [])
            except RuntimeError as error:
                rows.append([photo.name, "-", "-", "-", "-"])
                print(f"{photo.name}: {error}", flush=True)
                continue
            times = (f"{seconds:.1f}" for seconds in done.seconds)
            rows.append([photo.name, f"{done.overlap:.3f}", "yes" if done.closed else "no", *times])
            sheet.append(row_of(done))
    overlaps = [float(row[1]) for row in rows if row[1] != "-"]
    table(["photo", "front outline IoU", "watertight", "generate s", "fit-sdf s"], rows)
    print(f"\n{len(overlaps)} of {len(rows)} photos became meshes; mean IoU {np.mean(overlaps):.3f} (target .85)")
    if given.sheet:
        write_png(given.sheet, sheet_of_rows(sheet))


if __name__ == "__main__":
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    main()
