"""``netpos evaluate``, ``netpos report`` and ``netpos bench``."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from rich.table import Table

    from netpos.evaluation import Evaluation
    from netpos.evaluation.bench import Result


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
    bounds_file: Annotated[
        Path | None,
        typer.Option(
            "--bounds",
            metavar="FILE",
            help="Draw the error beside its bounds: .png, .svg or .pdf.",
        ),
    ] = None,
    skip: Annotated[int, typer.Option(help="Estimates at the start that do not count.")] = 20,
    vue: Annotated[str | None, typer.Option(help="Only this device.")] = None,
) -> None:
    """Score a recording against its ground truth."""
    from rich.console import Console  # noqa: PLC0415

    from netpos.evaluation import evaluate_bag  # noqa: PLC0415

    if json_file is not None:
        check_json(json_file)
    evaluation = evaluate_bag(bag, skip=skip, vue=vue)
    if json_file is not None:
        write_json(json_file, evaluation.to_json())
    pictures = (("map", map_file), ("errors", errors_file), ("bounds", bounds_file))
    _draw(evaluation, {kind: path for kind, path in pictures if path is not None})
    console = Console()
    for table in tables(evaluation):
        console.print(table)


def _draw(evaluation: Evaluation, files: dict[str, Path]) -> None:
    if not files:
        return
    from netpos.evaluation.pictures import (  # noqa: PLC0415 - slow to load
        draw_bounds,
        draw_errors,
        draw_map,
        save,
    )

    draw = {"map": draw_map, "errors": draw_errors, "bounds": draw_bounds}
    for kind, path in files.items():
        save(draw[kind](evaluation), path)


def report(
    source: Annotated[Path, typer.Argument(metavar="BAG|DIR", help="A bag, or a folder of bags.")],
    out: Annotated[Path, typer.Option(metavar="FILE.html", help="HTML file to write.")],
    skip: Annotated[int, typer.Option(help="Estimates at the start that do not count.")] = 20,
) -> None:
    """Write one HTML file with figures, verdicts, maps and errors; it needs no network."""
    from netpos.evaluation.report import bags_in, write_report  # noqa: PLC0415

    refuse_recording(out)
    bags = bags_in(source)
    left_out = write_report(bags, out, skip=skip)
    for reason in left_out:
        typer.echo(f"netpos: left out: {reason}", err=True)
    typer.echo(f"wrote {out}: {len(bags) - len(left_out)} of {len(bags)} bags")


def refuse_recording(path: Path) -> None:
    """``ValueError`` for a file inside a bag, which nothing but its writer changes."""
    folder = path.absolute().parent
    if (folder / "metadata.yaml").exists():
        raise ValueError(f"{path} would lie in a recording, which is never changed; name another")


def check_json(path: Path) -> None:
    """Make sure, before the work starts, that figures can be written to ``path``: its folder is
    made, and neither a recording nor a file of another kind is overwritten.

    Raises ``ValueError``, or ``OSError`` where there is no writing there.
    """
    refuse_recording(path)
    if path.is_file() and path.suffix.lower() != ".json":
        raise ValueError(f"{path} exists and is no .json file; name another")
    if path.is_dir():
        raise IsADirectoryError(f"--json {path} is a folder; give a file")
    path.parent.mkdir(parents=True, exist_ok=True)
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        raise PermissionError(f"{path} cannot be written")


def write_json(path: Path, figures: dict[str, Any]) -> None:
    """Write figures; a value that is not finite is an error, not a word JSON does not know.

    Raises what ``check_json`` does.
    """
    check_json(path)
    path.write_text(json.dumps(figures, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def tables(evaluation: Evaluation) -> list[Table]:
    """Figures and verdicts as tables for the terminal."""
    from rich.markup import escape  # noqa: PLC0415
    from rich.table import Table  # noqa: PLC0415

    from netpos.evaluation.summary import figure_rows, verdict_rows  # noqa: PLC0415

    names = list(evaluation.vues)
    figures = Table("figure", "unit", title=f"{evaluation.path.name}: accuracy")
    for name in evaluation.columns():
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
    only: Annotated[
        list[str] | None,
        typer.Option("--only", metavar="NAME", help="Measure this part alone; may be repeated."),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Few rounds: does it run, not how fast it is.")
    ] = False,
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Write the ratios as JSON.")
    ] = None,
) -> None:
    """Measure speed as ratios, side by side in one run."""
    from rich.console import Console  # noqa: PLC0415

    from netpos.evaluation.bench import as_json, chosen, surroundings  # noqa: PLC0415
    from netpos.evaluation.bench import bench as run_bench  # noqa: PLC0415

    if json_file is not None:
        check_json(json_file)
    console = Console()
    around = surroundings(quick)
    results = []
    with console.status("measuring") as status:
        parts = chosen(only or [])
        for name, rows in run_bench(parts, quick):
            status.update(f"measured {name}")
            results += rows
    console.print(bench_table(results))
    load, cores = around["load_average"][0], around["cores"]
    remarks = [f"The load average was {load:.1f} on {cores} cores before the first measurement."]
    for line in (*remarks, *bench_remarks(results)):
        console.print(line, markup=False, highlight=False)
    if json_file is not None:
        write_json(json_file, as_json(results, around))


def bench_table(results: Iterable[Result]) -> Table:
    """The rows that were measured."""
    from rich.markup import escape  # noqa: PLC0415
    from rich.table import Table  # noqa: PLC0415

    from netpos.evaluation.bench import Row, quantity  # noqa: PLC0415

    table = Table("what", "ours", "reference", "", "ratio", "target", "")
    for row in results:
        if isinstance(row, Row):
            sign = "≥" if row.relation == ">=" else "≤"
            table.add_row(
                escape(row.name),
                quantity(row.ours, row.unit),
                escape(row.reference),
                quantity(row.reference_value, row.unit),
                f"{row.ratio:.3g}",
                f"{sign} {row.target:g}",
                "ok" if row.ok else "MISSED",
            )
    return table


def bench_remarks(results: Iterable[Result]) -> list[str]:
    """What the rows do not say: notes, and what was left out."""
    from netpos.evaluation.bench import LeftOut  # noqa: PLC0415

    return [
        f"left out: {r.name}: {r.reason}" if isinstance(r, LeftOut) else f"{r.name}: {r.note}"
        for r in results
        if isinstance(r, LeftOut) or r.note
    ]
