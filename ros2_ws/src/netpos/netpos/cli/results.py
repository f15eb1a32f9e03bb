"""``netpos evaluate``, ``netpos report`` and ``netpos bench``."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from netpos.cli.own_recordings import Align, Offset, TruthMap, TruthOrigin, TruthUnits
from netpos.cli.progress import doing
from netpos.common.files import write_text

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from netpos.bench import Result
    from netpos.evaluation import Evaluation, Survey
    from netpos.evaluation.evaluate import TruthOf
    from netpos.messages.values import Odometry, RsuInfo, RsuMeasurement

_DEVICES_BESIDE = 3  # more of them, or longer figures, do not fit into 80 columns
_FIGURES_BESIDE = 5
_HEAD_WIDTH = 13


def evaluate(
    bag: Annotated[Path, typer.Argument(help="Bag with estimates.")],
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
    truth: Annotated[
        Path | None,
        typer.Option(help="Ground truth from elsewhere: a text file (TUM), or any bag."),
    ] = None,
    truth_topic: Annotated[
        str | None,
        typer.Option(
            help="Topic of the bag with the truth: Odometry, PoseStamped, NavSatFix, or another "
            "with --truth-map."
        ),
    ] = None,
    truth_map: TruthMap = None,
    truth_units: TruthUnits = "",
    truth_time_offset: Offset = "0",
    truth_align: Align = "none",
    truth_origin: TruthOrigin = None,
) -> None:
    """Score a recording against its ground truth; without one, show what it says of itself."""
    from rich.console import Console  # noqa: PLC0415

    from netpos.evaluation import Evaluation, assess_bag  # noqa: PLC0415

    if json_file is not None:
        check_json(json_file)
    for file in (map_file, errors_file, bounds_file):
        if file is not None:
            refuse_recording(file)
    options = (
        truth_topic, truth_map, truth_units, truth_time_offset, truth_align, truth_origin,
    )  # fmt: skip
    elsewhere = None if truth is None else _truth_from(bag, truth, *options)
    if truth is None and options != (None, None, "", "0", "none", None):
        raise ValueError("options of the ground truth need --truth: name its file or bag")
    with doing("reading") as tell:
        evaluation = assess_bag(bag, skip=skip, vue=vue, truth=elsewhere, progress=tell)
    if json_file is not None:
        write_json(json_file, evaluation.to_json())
    pictures = (("map", map_file), ("errors", errors_file), ("bounds", bounds_file))
    _draw(evaluation, {kind: path for kind, path in pictures if path is not None})
    console = Console()
    for note in evaluation.notes:
        console.print(note, markup=False)
    if not isinstance(evaluation, Evaluation):
        _print_survey(console, evaluation)
        return
    for table in tables(evaluation):
        console.print(table)


def _truth_from(
    bag: Path,
    source: Path,
    topic: str | None,
    mapping: str | None,
    units: str,
    offset: str,
    way: str,
    origin: str | None,
) -> TruthOf:
    """A function that reads a truth and aligns it with the measurements of a bag."""
    from netpos.bags import BagReader  # noqa: PLC0415
    from netpos.bags.importers.own.recording import truth_of  # noqa: PLC0415
    from netpos.cli.own_recordings import truth_option  # noqa: PLC0415
    from netpos.evaluation.contents import config_of  # noqa: PLC0415
    from netpos.tracking.config import TrackerConfig  # noqa: PLC0415

    with BagReader(bag) as reader:
        config = config_of(reader) or TrackerConfig()
    named: Path | str = source if topic is None else topic
    truth = truth_option(named, mapping, units, offset, way, config.device_height_m, origin)
    assert truth is not None

    def read(
        infos: list[RsuInfo], measurements: list[RsuMeasurement], vue: str
    ) -> tuple[list[Odometry], str]:
        within = source if topic is not None else None
        poses, sentence = truth_of(truth, infos, measurements, within=within)
        return poses.odometry(vue), sentence or f"truth from {source.name}"

    return read


def _print_survey(console: Console, survey: Survey) -> None:
    """Print what a recording without ground truth shows; what needs attention comes first."""
    from rich.box import SIMPLE  # noqa: PLC0415
    from rich.markup import escape  # noqa: PLC0415
    from rich.table import Table  # noqa: PLC0415

    from netpos.evaluation.summary import (  # noqa: PLC0415
        RESIDUAL_HEAD,
        residual_rows,
        survey_rows,
    )

    console.print(
        "No ground truth: the errors are unknown. This is what the recording itself shows."
    )
    for name, vue in survey.vues.items():
        for text in vue.figures.suggestions:
            console.print(f"{name}: {text}", markup=False, highlight=False)
    table = Table("figure", "unit", title=survey.path.name)
    for name in survey.vues:
        table.add_column(name, justify="right")
    for row in survey_rows(survey):
        table.add_row(*map(escape, row))
    console.print(table)
    for name, vue in survey.vues.items():
        title = f"{name}: measured minus where the track is"
        table = Table(*RESIDUAL_HEAD[:-1], title=title, box=SIMPLE)
        for *row, _ in residual_rows(vue.figures.residuals):
            table.add_row(*map(escape, row))
        console.print(table)
        for rsu_id, *_, learned in residual_rows(vue.figures.residuals):
            if learned:
                console.print(f"learned of {rsu_id}: {learned}", markup=False, highlight=False)


def _draw(evaluation: Evaluation | Survey, files: dict[str, Path]) -> None:
    if not files:
        return
    from netpos.evaluation import Evaluation  # noqa: PLC0415

    if not isinstance(evaluation, Evaluation):
        for kind, path in files.items():
            if kind != "map":
                raise ValueError(f"--{kind} {path} needs ground truth, and the bag has none")
        from netpos.evaluation.pictures import draw_survey, save  # noqa: PLC0415

        save(draw_survey(evaluation), files["map"])
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
    with doing("reading") as tell:
        left_out = write_report(bags, out, skip=skip, progress=tell)
    for reason in left_out:
        typer.echo(f"netpos: left out: {reason}", err=True)
    typer.echo(f"wrote {out}: {len(bags) - len(left_out)} of {len(bags)} bags")


def compare(
    bags: Annotated[
        list[Path], typer.Argument(metavar="A B...", help="Bags with estimates of the same run.")
    ],
    skip: Annotated[int, typer.Option(help="Estimates at the start that do not count.")] = 20,
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Write the differences as JSON.")
    ] = None,
) -> None:
    """Compare several estimates of one run with the first one.

    The interval of each difference takes into account that errors are correlated over time.
    """
    from rich.console import Console  # noqa: PLC0415
    from rich.markup import escape  # noqa: PLC0415
    from rich.table import Table  # noqa: PLC0415

    from netpos.evaluation.compare import compare_bags  # noqa: PLC0415

    if json_file is not None:
        check_json(json_file)
    with doing("comparing"):
        found = compare_bags(bags, skip=skip)
    console = Console()
    for difference in found:
        console.print(difference.sentence(), markup=False, highlight=False)
    table = Table("device", "A", "B", "epochs", "only A, B", "RMSE A", "RMSE B", "block s")
    for d in found:
        a, b = d.rmse_m
        alone = f"{d.only_first}, {d.only_second}"
        cells = (f"{d.epochs}", alone, f"{a:.3f}", f"{b:.3f}", f"{d.block_s:.1f}")
        table.add_row(escape(d.vue), escape(d.first), escape(d.second), *cells)
    console.print(table)
    if json_file is not None:
        write_json(json_file, {"differences": [d.to_json() for d in found]})


def refuse_recording(path: Path) -> None:
    """``ValueError`` for a file inside a bag, which nothing but its writer changes."""
    folder = path.absolute().parent
    if (folder / "metadata.yaml").exists():
        raise ValueError(
            f"{path} is inside a recording, and recordings are never changed; choose another file"
        )


def check_json(path: Path) -> None:
    """Make sure, before the work starts, that figures can be written to ``path``: its folder is
    made, and neither a recording nor a file of another kind is overwritten.

    Raises ``ValueError``, or ``OSError`` where there is no writing there.
    """
    refuse_recording(path)
    if path.is_file() and path.suffix.lower() != ".json":
        raise ValueError(f"{path} exists and is no .json file; choose another name")
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
    write_text(path, json.dumps(figures, indent=2, allow_nan=False) + "\n")


def tables(evaluation: Evaluation) -> list[Table]:
    """Figures and verdicts as tables for the terminal."""
    from netpos.evaluation.summary import figure_rows, verdict_rows  # noqa: PLC0415

    name, vues = evaluation.path.name, list(evaluation.vues)
    figures = (["figure", "unit"], list(evaluation.columns()), figure_rows(evaluation))
    verdicts = (["requirement", "", "required"], vues, verdict_rows(evaluation))
    return [
        *_side_by_side(f"{name}: accuracy", *figures),
        *_side_by_side(f"{name}: requirements", *verdicts),
    ]


def _side_by_side(
    title: str, about: list[str], devices: list[str], rows: list[list[str]]
) -> list[Table]:
    """Rows that begin with what they are ``about``: a column for each of a few devices, a row for
    each of many."""
    from rich.box import SIMPLE  # noqa: PLC0415
    from rich.markup import escape  # noqa: PLC0415
    from rich.table import Table  # noqa: PLC0415

    if len(devices) <= _DEVICES_BESIDE:
        table = Table(*about, title=title)
        for name in devices:
            table.add_column(escape(name), justify="right")
        for row in rows:
            table.add_row(*map(escape, row))
        return [table]
    tables = []
    for first in range(0, len(rows), _FIGURES_BESIDE):
        shown = rows[first : first + _FIGURES_BESIDE]
        table = Table("device", title=None if first else title, box=SIMPLE, padding=(0, 1, 0, 0))
        for row in shown:
            unit = f" [{row[1]}]" if row[1] and about[1] == "unit" else ""
            head = "\n".join(filter(None, [row[0] + unit, *row[2 : len(about)]]))
            table.add_column(escape(head), justify="right", max_width=_HEAD_WIDTH)
        for index, name in enumerate(devices):
            table.add_row(escape(name), *(escape(row[len(about) + index]) for row in shown))
        tables.append(table)
    return tables


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
    """Measure speed as ratios, side by side in one run. Two parts are measured only if you ask
    for them: --only soak, a simulated day, and --only live_soak, an hour."""
    from rich.console import Console  # noqa: PLC0415

    from netpos.bench import as_json, chosen, surroundings  # noqa: PLC0415
    from netpos.bench import bench as run_bench  # noqa: PLC0415

    if json_file is not None:
        check_json(json_file)
    console = Console()
    around = surroundings(quick)
    results: list[Result] = []
    with doing("measuring", "parts done") as tell:
        for done, (_, rows) in enumerate(run_bench(chosen(only or []), quick), start=1):
            results += rows
            tell(done)
    console.print(bench_table(results))
    load, cores = around["load_average"][0], around["cores"]
    remarks = [f"The load average was {load:.1f} on {cores} cores before the first measurement."]
    for line in (*remarks, *bench_remarks(results)):
        console.print(line, markup=False, highlight=False)
    if json_file is not None:
        write_json(json_file, as_json(results, around))


def bench_table(results: Iterable[Result]) -> Table:
    """The rows that were measured."""
    from rich.box import SIMPLE  # noqa: PLC0415
    from rich.markup import escape  # noqa: PLC0415
    from rich.table import Table  # noqa: PLC0415

    from netpos.bench import Row  # noqa: PLC0415
    from netpos.common.quantity import quantity  # noqa: PLC0415

    table = Table("what, and beside what", box=SIMPLE, padding=(0, 1, 1, 0), expand=False)
    for head in ("ours", "beside", "ratio", "target"):
        table.add_column(head, justify="right", no_wrap=True)
    table.add_column("")
    for row in results:
        if isinstance(row, Row):
            sign = "≥" if row.relation == ">=" else "≤"
            table.add_row(
                f"{escape(row.name)}\n{escape(row.reference)}",
                quantity(row.ours, row.unit),
                quantity(row.reference_value, row.unit),
                f"{row.ratio:.3g}",
                f"{sign} {row.target:g}",
                "ok" if row.ok else "MISSED",
            )
    return table


def bench_remarks(results: Iterable[Result]) -> list[str]:
    """What the rows do not say: notes, and what was left out."""
    from netpos.bench import LeftOut  # noqa: PLC0415

    return [
        f"left out: {r.name}: {r.reason}" if isinstance(r, LeftOut) else f"{r.name}: {r.note}"
        for r in results
        if isinstance(r, LeftOut) or r.note
    ]
