"""`mv3d depth2normal`."""

from __future__ import annotations

from typing import Annotated

import typer

from mv3d_cli.cli.console import progress_bar, show_result
from mv3d_cli.cli.options import Json, Output, inputs_from, with_settings
from mv3d_cli.steps.depth2normal import Config, main_file, run
from mv3d_cli.store import check_output

app = typer.Typer(add_completion=False)


@app.command()
@with_settings(Config)
def depth2normal(
    config: Config,
    depth: Annotated[str, typer.Argument(metavar="VIEWS|DEPTH.exr|-", help="A views folder, or one depth map.")],
    output: Output = None,
    as_json: Json = False,
) -> None:
    """Depth becomes normals: metric, filtered, sharp at silhouettes and steps."""
    inputs = inputs_from([depth])
    if output is not None:
        check_output(output, main_file(inputs))
    with progress_bar() as tell:
        artifact = run(config, inputs, tell)
    show_result(artifact, output, as_json)
