"""``netpos sweep``."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from netpos.cli.completion import complete_scenario
from netpos.cli.progress import Bars
from netpos.cli.results import refuse_recording
from netpos.cli.runs import parse_setting
from netpos.cli.work import ClusterAddress, Resume, Workers, worked

if TYPE_CHECKING:
    from rich.table import Table

    from netpos.evaluation.sweep import Mean


def sweep(
    scenario: Annotated[
        str,
        typer.Argument(help="Scenario, by name or YAML file.", autocompletion=complete_scenario),
    ],
    vary: Annotated[
        list[str],
        typer.Option(
            metavar="KEY=A,B,C",
            help="Values of a key of the scenario, such as tracker.hold_s=0,0.1 or "
            "devices.0.speed_mps=5,10; may be repeated.",
        ),
    ],
    out: Annotated[Path, typer.Option(metavar="FILE", help="Table to write: .csv or .parquet.")],
    runs: Annotated[int, typer.Option(help="Runs (seeds) of each setting.")] = 10,
    seed: Annotated[int, typer.Option(help="Seed of the first run; run i has seed + i.")] = 1,
    figure: Annotated[str, typer.Option(help="Figure to show: a column of the table.")] = "rmse_m",
    plot: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Draw the figure: .png, .svg or .pdf."),
    ] = None,
    skip: Annotated[int, typer.Option(help="Estimates at the start that do not count.")] = 20,
    workers: Workers = None,
    cluster: ClusterAddress = None,
    resume: Resume = None,
) -> None:
    """Simulate, track and score a scenario under several settings, each with the same seeds."""
    from rich.console import Console  # noqa: PLC0415

    from netpos.evaluation.pictures import check_format, save  # noqa: PLC0415
    from netpos.evaluation.sweep import (  # noqa: PLC0415
        Plan,
        check_table,
        draw_sweep,
        means,
        write_table,
    )
    from netpos.evaluation.sweep import sweep as run  # noqa: PLC0415
    from netpos.evaluation.work import Kept, Work  # noqa: PLC0415

    values = dict(_values(text) for text in vary)
    check_table(out)
    for file in (out, plot):
        if file is not None:
            refuse_recording(file)
    if plot is not None:
        check_format(plot)
    bars = Bars()
    kept = None if resume is None else Kept(resume)
    try:
        with (
            worked(),
            Work(runs, seed, workers, bars.show, cluster=cluster, kept=kept, apart=True) as work,
        ):
            table = run(Plan(scenario, values, skip), work)
    finally:
        bars.stop()
    write_table(table, out)
    found = means(table, tuple(values), figure)
    Console().print(_table(found, figure, tuple(values)))
    typer.echo(f"wrote {out}: {len(table)} rows")
    if plot is not None:
        save(draw_sweep(found, figure), plot)
        typer.echo(f"wrote {plot}")


def _values(text: str) -> tuple[str, tuple[object, ...]]:
    """A key and its values, separated by commas and read as YAML."""
    key, equals, values = text.partition("=")
    if not (equals and key.strip() and values.strip()):
        raise ValueError(f"--vary takes KEY=A,B,C, got {text!r}")
    return key.strip(), tuple(parse_setting(f"{key}={value}")[1] for value in values.split(","))


def _table(found: Iterable[Mean], figure: str, keys: tuple[str, ...]) -> Table:
    from rich.box import SIMPLE  # noqa: PLC0415
    from rich.markup import escape  # noqa: PLC0415
    from rich.table import Table  # noqa: PLC0415

    table = Table(title=f"{figure}: mean of the runs", box=SIMPLE, padding=(0, 1, 0, 0))
    for key in keys:
        table.add_column(escape(key.replace(".", ".\n")), overflow="fold")
    for column in ("lost tracks", "runs without", "runs", "mean", "95 % interval"):
        table.add_column(column, justify="right", no_wrap=column == "95 % interval")
    for mean in found:
        interval = "–" if mean.interval is None else "{:.3g} to {:.3g}".format(*mean.interval)
        table.add_row(
            *(escape(str(mean.setting[key])) for key in keys),
            str(mean.lost_tracks),
            str(mean.without),
            str(mean.runs),
            "–" if mean.mean is None else f"{mean.mean:.3g}",
            interval,
        )
    return table
