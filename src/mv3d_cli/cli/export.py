"""`mv3d export`."""

from __future__ import annotations

from typing import Annotated

import typer

from mv3d_cli.cli.console import progress_bar, show_result
from mv3d_cli.cli.options import Json, Output, inputs_from, with_settings
from mv3d_cli.steps.export import Config, main_file, run
from mv3d_cli.store import check_output

app = typer.Typer(add_completion=False)


@app.command()
@with_settings(Config)
def export(
    config: Config,
    source: Annotated[str, typer.Argument(metavar="MESH|FIT|-", help="A mesh file, or what `mv3d fit-sdf` made.")],
    output: Output = None,
    as_json: Json = False,
) -> None:
    """Meshes and fits into glb, obj, ply or stl: simplified, coloured, to a height in millimetres."""
    main = main_file(config, output)
    if output is not None:
        check_output(output, main)
    with progress_bar() as tell:
        artifact = run(config, inputs_from([source]), tell, main)
    show_result(artifact, output, as_json)
