"""The page of one or several recordings. The plotting script is inside, no network is needed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import jinja2
from plotly.offline import get_plotlyjs

from netpos import __version__
from netpos.common.files import write_text
from netpos.evaluation.evaluate import Evaluation, assess_bag
from netpos.evaluation.metrics import SKIP_EPOCHS
from netpos.evaluation.report import plots, tables
from netpos.evaluation.report.moments import moments_of
from netpos.evaluation.residuals import summary
from netpos.evaluation.survey import Survey

_HERE = files(__package__)


def bags_in(source: Path) -> list[Path]:
    """The bag itself, or the bags in a folder of bags, sorted.

    Raises
    ------
    ValueError  nothing there, or a folder without bags
    """
    if not source.exists():
        raise ValueError(f"{source} does not exist; check the path")
    if source.is_file() or (source / "metadata.yaml").exists() or any(source.glob("*.mcap")):
        return [source]
    markers = (*source.glob("*/metadata.yaml"), *source.glob("*/*.mcap"))
    bags = sorted({path.parent for path in markers})
    if not bags:
        raise ValueError(f"{source} is neither a bag nor a folder of bags")
    return bags


def write_report(
    bags: Sequence[Path],
    out: Path,
    *,
    skip: int = SKIP_EPOCHS,
    progress: Callable[[int], None] | None = None,
) -> list[str]:
    """Evaluate the bags and write the report. Of several bags those that cannot be evaluated are
    left out; the reasons are in the report and returned. ``progress`` is called with the number
    of messages read.

    Raises
    ------
    ValueError  no bag can be evaluated, or ``out`` is not an .html file
    """
    if out.suffix.lower() not in {".html", ".htm"}:
        raise ValueError(f"{out}: the report is an HTML file; choose a name that ends in .html")
    results: list[Evaluation | Survey] = []
    sections: list[dict[str, object]] = []
    left_out: list[str] = []
    for bag in bags:
        try:
            one = assess_bag(bag, skip=skip, residuals=True, progress=progress)
            sections.append(_scored(one) if isinstance(one, Evaluation) else _surveyed(one))
            results.append(one)
        except ValueError as error:
            left_out.append(str(error))
    if not sections:
        raise ValueError("; ".join(left_out))
    common = [tables.overview(results)] if len(results) > 1 else []
    page = jinja2.Template((_HERE / "page.html").read_text(encoding="utf-8")).render(
        plotly=get_plotlyjs(),
        script=(_HERE / "page.js").read_text(encoding="utf-8"),
        version=__version__,
        skip=skip,
        common=[*common, tables.runs(results)],
        sections=sections,
        left_out=left_out,
    )
    write_text(out, page)
    return left_out


def _scored(evaluation: Evaluation) -> dict[str, object]:
    """Sections of a recording with ground truth."""
    vues = evaluation.vues
    tracks = {
        name: (vue.run.estimate, vue.run.statuses, vue.run.truth) for name, vue in vues.items()
    }
    residuals = {name: [summary(series) for series in vue.series] for name, vue in vues.items()}
    of_rsus = [
        _plot(f"{name}: measured minus true", plots.residuals(name, vue.series))
        for name, vue in vues.items()
        if vue.series
    ]
    return {
        "name": evaluation.path.name,
        "notes": evaluation.notes,
        "tables": tables.of_evaluation(evaluation, residuals),
        "devices": list(vues),
        "map": plots.html(plots.map_of_evaluation(evaluation)),
        "map_text": "Ground truth dashed, ellipses of 95 %. At the time of the slider: "
        "estimate ●, true place ✕, protection level as a circle.",
        "moments": moments_of(tracks),
        "plots": [
            _plot("Errors", plots.errors(evaluation)),
            *_integrity(evaluation),
            *of_rsus,
        ],
    }


def _integrity(evaluation: Evaluation) -> list[dict[str, str]]:
    figure, sentences = plots.integrity(evaluation)
    if not sentences:
        return []
    return [_plot("Integrity (Stanford diagram)", figure, " ".join(sentences))]


def _surveyed(survey: Survey) -> dict[str, object]:
    """Sections of a recording without ground truth."""
    notes, drawn = list(survey.notes), []
    for name, vue in survey.vues.items():
        notes += [f"{name}: {text}" for text in vue.figures.suggestions]
        drawn.append(_plot(f"{name}: over time", plots.over_time(name, vue)))
        title = f"{name}: measured minus where the track is"
        drawn.append(_plot(title, plots.residuals(name, vue.series)))
    tracks = {
        name: (vue.record.track, vue.record.statuses, None) for name, vue in survey.vues.items()
    }
    return {
        "name": f"{survey.path.name} (no ground truth)",
        "notes": notes,
        "tables": tables.of_survey(survey),
        "devices": list(survey.vues),
        "map": plots.html(plots.map_of_survey(survey)),
        "map_text": "Coloured by state: green TRACKING, red COASTING, orange INITIALISING, purple "
        "AMBIGUOUS. At the time of the slider: estimate ●, protection level as a circle.",
        "moments": moments_of(tracks),
        "plots": drawn,
    }


def _plot(title: str, figure: Any, text: str = "") -> dict[str, str]:
    return {"title": title, "text": text, "plot": plots.html(figure)}
