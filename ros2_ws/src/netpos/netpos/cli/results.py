"""``netpos evaluate`` and ``netpos report``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from rich.table import Table

    from netpos.evaluation import Evaluation


def evaluate(
    bag: Annotated[Path, typer.Argument(help="Bag with ground truth and estimates.")],
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Write the figures as JSON.")
    ] = None,
    map_file: Annotated[
        Path | None,
        typer.Option("--map", metavar="FILE", help="Draw the map: .png, .svg or .pdf."),
    ] = None,
    errors_file: Annotated[
        Path | None,
        typer.Option(
            "--errors", metavar="FILE", help="Draw errors against time: .png, .svg or .pdf."
        ),
    ] = None,
    skip: Annotated[int, typer.Option(help="Estimates at the start that do not count.")] = 20,
    vue: Annotated[str | None, typer.Option(help="Only this device.")] = None,
) -> None:
    """Score a recording against its ground truth."""
    from rich.console import Console  # noqa: PLC0415

    from netpos.evaluation import evaluate_bag  # noqa: PLC0415

    evaluation = evaluate_bag(bag, skip=skip, vue=vue)
    if json_file is not None:
        write_json(json_file, evaluation.to_json())
    if map_file is not None or errors_file is not None:
        from netpos.evaluation.pictures import draw_errors, draw_map, save  # noqa: PLC0415

        if map_file is not None:
            save(draw_map(evaluation), map_file)
        if errors_file is not None:
            save(draw_errors(evaluation), errors_file)
    console = Console()
    for table in tables(evaluation):
        console.print(table)


def report(
    source: Annotated[Path, typer.Argument(metavar="BAG|DIR", help="A bag, or a folder of bags.")],
    out: Annotated[Path, typer.Option(metavar="FILE.html", help="HTML file to write.")],
    skip: Annotated[int, typer.Option(help="Estimates at the start that do not count.")] = 20,
) -> None:
    """Write one HTML file with figures, verdicts, maps and errors; it needs no network."""
    from netpos.evaluation.report import bags_in, write_report  # noqa: PLC0415

    bags = bags_in(source)
    left_out = write_report(bags, out, skip=skip)
    for reason in left_out:
        typer.echo(f"netpos: left out: {reason}", err=True)
    typer.echo(f"wrote {out}: {len(bags) - len(left_out)} of {len(bags)} bags")


def write_json(path: Path, figures: dict[str, Any]) -> None:
    """Write figures; a value that is not finite is an error, not a word JSON does not know."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(figures, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def tables(evaluation: Evaluation) -> list[Table]:
    """Figures and verdicts as tables for the terminal."""
    from rich.markup import escape  # noqa: PLC0415
    from rich.table import Table  # noqa: PLC0415

    from netpos.evaluation.summary import figure_rows, verdict_rows  # noqa: PLC0415

    names = list(evaluation.vues)
    figures = Table("figure", "unit", title=f"{evaluation.path.name}: accuracy")
    for name in names:
        figures.add_column(name, justify="right")
    for row in figure_rows(evaluation):
        figures.add_row(*map(escape, row))
    verdicts = Table("requirement", "", "required", title=f"{evaluation.path.name}: requirements")
    for name in names:
        verdicts.add_column(name, justify="right")
    for row in verdict_rows(evaluation):
        verdicts.add_row(*map(escape, row))
    return [figures, verdicts]


def bench(
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Write the ratios as JSON.")
    ] = None,
) -> None:
    """Measure speed as ratios, side by side in one run."""
    from rich.console import Console  # noqa: PLC0415
    from rich.table import Table  # noqa: PLC0415

    from netpos.evaluation.bench import as_json  # noqa: PLC0415
    from netpos.evaluation.bench import bench as run_bench  # noqa: PLC0415

    rows = run_bench()
    table = Table("operation", "ours", "reference", "", "times faster")
    for row in rows:
        ours, reference = (f"{1e6 * s:,.1f} µs" for s in (row.ours_s, row.reference_s))
        table.add_row(row.name, ours, row.reference, reference, f"{row.ratio:.0f}")
    Console().print(table)
    if json_file is not None:
        json_file.write_text(json.dumps(as_json(rows), indent=2) + "\n", encoding="utf-8")
