"""Entry point of ``netpos``: the commands in the order of the help."""

from __future__ import annotations

import typer

from netpos.cli import recordings, reproduce, results, rsus, runs, sweep
from netpos.cli.errors import Commands
from netpos.cli.interrupts import INTERRUPTED, answer_ctrl_c, leave

app = typer.Typer(
    cls=Commands,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Position vehicles and pedestrians from the network side.",
)
for command in (
    runs.scenarios,
    runs.run,
    runs.replay,
    results.evaluate,
    results.report,
    results.compare,
    sweep.sweep,
    results.bench,
    reproduce.reproduce,
    recordings.recover,
):
    app.command()(command)
app.add_typer(recordings.importers, name="import")
app.add_typer(rsus.rsus, name="rsus")


def main() -> None:
    """Run the command line."""
    answer_ctrl_c()
    try:
        app(prog_name="netpos")
    except SystemExit as end:
        if end.code == INTERRUPTED:
            leave()
        raise
