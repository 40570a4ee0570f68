"""`mv3d render`."""

from __future__ import annotations

from typing import Annotated

import typer

from mv3d_cli.cli.console import progress_bar, show_result
from mv3d_cli.cli.options import Json, Output, inputs_from, with_settings
from mv3d_cli.steps.render import Config, run
from mv3d_cli.store import check_output

app = typer.Typer(add_completion=False)


@app.command()
@with_settings(Config)
def render(
    config: Config,
    meshes: Annotated[list[str] | None, typer.Argument(metavar="MESH|FOLDER|-...", help="Meshes, or folders.")] = None,
    output: Output = None,
    as_json: Json = False,
) -> None:
    """Meshes become views: colour, depth and normals from a rig of cameras."""
    if output is not None:
        check_output(output)
    with progress_bar() as tell:
        artifact = run(config, inputs_from(meshes or []), tell)
    show_result(artifact, output, as_json)
