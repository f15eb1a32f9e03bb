"""Entry point of ``netpos``: the commands in the order of the help."""

from __future__ import annotations

from typing import Annotated

import typer

import netpos
from netpos.cli import (
    faults,
    geojson,
    params,
    recordings,
    reproduce,
    results,
    rsus,
    runs,
    sweep,
    watch,
)
from netpos.cli.errors import Commands
from netpos.cli.examples import epilog
from netpos.cli.interrupts import INTERRUPTED, answer_ctrl_c, leave

EXAMPLES = """
Position vehicles and pedestrians from the network side.

Begin with: netpos run fast_pass --offline --bag my_run, netpos evaluate my_run,
netpos report my_run --out report.html
"""

app = typer.Typer(
    cls=Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help=EXAMPLES,
)
for command in (
    runs.scenarios,
    runs.run,
    runs.replay,
    results.evaluate,
    results.report,
    results.compare,
    sweep.sweep,
    faults.faults,
    results.bench,
    reproduce.reproduce,
    recordings.recover,
    watch.watch,
    params.params,
    geojson.geojson,
):
    app.command(epilog=epilog(command.__name__))(command)
app.add_typer(recordings.importers, name="import")
app.add_typer(rsus.rsus, name="rsus")


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"netpos {netpos.__version__}")
        raise typer.Exit


@app.callback(help=EXAMPLES)
def options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_version, is_eager=True, help="Show the version and exit."
        ),
    ] = False,
) -> None:
    """What holds for every command."""


def main() -> None:
    """Run the command line."""
    answer_ctrl_c()
    try:
        app(prog_name="netpos")
    except SystemExit as end:
        if end.code == INTERRUPTED:
            leave()
        raise
