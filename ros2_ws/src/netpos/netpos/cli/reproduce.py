"""``netpos reproduce``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from netpos.cli.progress import Bars
from netpos.cli.results import check_json, write_json
from netpos.cli.work import ClusterAddress, Resume, Workers, worked

if TYPE_CHECKING:
    from rich.table import Table

    from netpos.reproduction import Reproduction


def reproduce(
    paper: Annotated[str, typer.Argument(help="Paper, for example fokin2020.")],
    runs: Annotated[
        int | None,
        typer.Option(help="Runs (seeds) of each experiment. Default: 1000; deng2022: 100."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the first run; run i has seed + i.")] = 1,
    workers: Workers = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Write the rows as JSON.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Draw the paper's pictures there.")
    ] = None,
    cluster: ClusterAddress = None,
    resume: Resume = None,
) -> None:
    """Reproduce a paper's figures; every row says whether its target is kept.

    Columns: what the paper says; the paper's own filter on our simulation; netpos with the
    settings of the scenario; netpos with the default motion, clock and start parameters.
    """
    from rich.console import Console  # noqa: PLC0415

    from netpos.evaluation.work import Kept  # noqa: PLC0415
    from netpos.reproduction import reproduce as run  # noqa: PLC0415

    if out is not None and out.exists() and not out.is_dir():
        raise NotADirectoryError(f"--out {out} is a file; give a folder")
    if json_file is not None:
        check_json(json_file)
    bars = Bars()
    try:
        with worked():
            result = run(
                paper,
                runs=runs,
                seed=seed,
                workers=workers,
                progress=bars.show,
                cluster=cluster,
                kept=None if resume is None else Kept(resume),
            )
    finally:
        bars.stop()
    Console().print(_table(result))
    for note in result.outcome.notes:
        typer.echo(note, err=True)
    if json_file is not None:
        write_json(json_file, result.to_json())
    if out is not None:
        for path in result.outcome.draw(out):
            typer.echo(f"wrote {path}")


def _table(result: Reproduction) -> Table:
    from rich.markup import escape  # noqa: PLC0415
    from rich.table import Table  # noqa: PLC0415

    title = f"{result.paper}: {result.runs} runs from seed {result.seed}, {result.wall_s:.1f} s"
    table = Table("figure", "unit", title=title)
    for column in ("paper", "paper's filter", "ours", "defaults"):
        table.add_column(column, justify="right")
    table.add_column("ok")
    verdicts = {True: "yes", False: "NO", None: ""}
    for row in result.rows:
        figures = (row.paper, row.baseline, row.ours, row.defaults)
        values = ["–" if v is None else f"{v:.3g}" for v in figures]
        table.add_row(escape(row.name), escape(row.unit), *values, verdicts[row.ok])
    return table
