"""`mv3d train`."""

from __future__ import annotations

import os
import time
from typing import Annotated

import typer

from mv3d_cli.cli.console import progress_bar, show_result
from mv3d_cli.cli.options import Json, Output, inputs_from, with_settings
from mv3d_cli.steps.train import Config, run
from mv3d_cli.store import check_output

PATIENCE = 10.0  # seconds in which the first of several processes speaks for all

app = typer.Typer(add_completion=False)


@app.command()
@with_settings(Config)
def train(
    config: Config,
    data: Annotated[
        list[str] | None, typer.Argument(metavar="MESHES|DATASET|-...", help="Meshes, or what `mv3d render` made.")
    ] = None,
    output: Output = None,
    as_json: Json = False,
) -> None:
    """Objects become a model: photo -> views, colour and depth, by multi-view diffusion."""
    try:
        if output is not None:
            check_output(output)
        with progress_bar() as tell:
            artifact = run(config, inputs_from(data or []), tell, output)
    except Exception:
        if os.environ.get("RANK", "0") != "0":  # the first says it, and what launched us ends us
            time.sleep(PATIENCE)
        raise
    if artifact is not None:
        show_result(artifact, output, as_json)
