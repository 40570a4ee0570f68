"""`mv3d fit-sdf`."""

from __future__ import annotations

from typing import Annotated

import typer

from mv3d_cli.cli.console import progress_bar, show_result
from mv3d_cli.cli.options import Json, Output, inputs_from, with_settings
from mv3d_cli.steps import export
from mv3d_cli.steps.fit_sdf import MAIN, Config, export_settings, run
from mv3d_cli.store import check_output

app = typer.Typer(add_completion=False)


@app.command()
@with_settings(Config)
def fit_sdf(
    config: Config,
    views: Annotated[str, typer.Argument(metavar="VIEWS|-", help="A views folder, ours or nerfstudio's.")],
    output: Output = None,
    as_json: Json = False,
) -> None:
    """Views become a textured mesh: aligned, fused, refined by a neural signed distance field."""
    inputs = inputs_from([views])
    elsewhere = output is not None and output.suffix.lower() in (".obj", ".ply", ".stl")
    as_file = export_settings(config)
    main = export.main_file(as_file, output) if elsewhere else MAIN
    if output is not None:
        check_output(output, main)
    with progress_bar() as tell:
        artifact = run(config, inputs, tell)
        if elsewhere:
            artifact = export.run(as_file, [artifact.path], tell, main)
    show_result(artifact, output, as_json)
