"""``netpos faults``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from netpos.cli.errors import WorkFailedError
from netpos.cli.progress import Bars
from netpos.cli.results import check_json, refuse_recording, write_json
from netpos.cli.work import ClusterAddress, Resume, Workers, worked

if TYPE_CHECKING:
    from rich.table import Table

    from netpos.evaluation.faults import Outcome


def faults(
    scenarios: Annotated[
        list[str], typer.Argument(metavar="SCENARIO...", help="Scenarios, by name or YAML file.")
    ],
    plan: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Which faults, when and how strong. Default: ours."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the table as Markdown: .md.")
    ] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Write the figures as JSON.")
    ] = None,
    list_them: Annotated[
        bool, typer.Option("--list", help="Tell what each fault does, and its unit; no run.")
    ] = False,
    workers: Workers = None,
    cluster: ClusterAddress = None,
    resume: Resume = None,
) -> None:
    """Put faults into scenarios, one by one: what noticed them, how large the error was, when the
    track was right again.

    Exit status 1 where a fault ended the tracker or made it publish what is no number.
    """
    from rich.console import Console  # noqa: PLC0415

    from netpos.evaluation.faults import FAULTS, campaign, load_plan  # noqa: PLC0415
    from netpos.evaluation.faults.page import markdown, summary  # noqa: PLC0415
    from netpos.evaluation.faults.plan import DEFAULT  # noqa: PLC0415
    from netpos.evaluation.work import Kept, Work  # noqa: PLC0415

    if list_them:
        for name, fault in FAULTS.items():
            unit = f" [{fault.unit}]" if fault.unit else ""
            typer.echo(f"{name}{unit}: {fault.text}")
        return
    chosen = load_plan(DEFAULT if plan is None else plan)
    _check_out(out, json_file)
    bars = Bars()
    kept = None if resume is None else Kept(resume)
    try:
        with (
            worked(),
            Work(1, 0, workers, bars.show, cluster=cluster, kept=kept, apart=True) as work,
        ):
            outcomes = list(campaign(chosen, scenarios, work))
    finally:
        bars.stop()
    Console().print(_table(outcomes))
    typer.echo(summary(outcomes))
    if out is not None:
        out.write_text(markdown(outcomes, _command(scenarios, plan)), encoding="utf-8")
        typer.echo(f"wrote {out}")
    if json_file is not None:
        write_json(json_file, {"outcomes": [outcome.to_json() for outcome in outcomes]})
    failed = sum(outcome.failed for outcome in outcomes)
    if failed:
        raise WorkFailedError(f"{failed} faults ended the tracker or made it publish no number")


def _check_out(out: Path | None, json_file: Path | None) -> None:
    if json_file is not None:
        check_json(json_file)
    if out is not None:
        if out.suffix != ".md":
            raise ValueError(f"--out {out}: the table is a .md file")
        refuse_recording(out)
        out.parent.mkdir(parents=True, exist_ok=True)


def _command(scenarios: Sequence[str], plan: Path | None) -> str:
    given = "" if plan is None else f" --plan {plan}"
    return f"netpos faults {' '.join(scenarios)}{given} --out TABLE.md"


def _table(outcomes: Sequence[Outcome]) -> Table:
    from rich.box import SIMPLE  # noqa: PLC0415
    from rich.markup import escape  # noqa: PLC0415
    from rich.table import Table  # noqa: PLC0415

    from netpos.evaluation.faults.page import HEADS, row, worst_first  # noqa: PLC0415

    table = Table(*HEADS, box=SIMPLE, padding=(0, 1, 0, 0))
    for outcome in worst_first(outcomes):
        style = "bold" if outcome.missed or outcome.failed else None
        table.add_row(*map(escape, row(outcome)), style=style)
    return table
