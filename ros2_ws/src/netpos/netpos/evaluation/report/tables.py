"""Tables of a report."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from netpos.common.yaml_text import load_yaml
from netpos.evaluation.contents import lost_in
from netpos.evaluation.evaluate import Evaluation
from netpos.evaluation.metrics import Figures
from netpos.evaluation.residuals import Residuals
from netpos.evaluation.summary import (
    NOTHING,
    RESIDUAL_HEAD,
    figure_rows,
    residual_rows,
    survey_rows,
    verdict_rows,
)
from netpos.evaluation.survey import Survey, VueSurvey
from netpos.scenario.settings import SCENARIO_FACT, TRACKER_FACT, known_parameters, not_usual
from netpos.tracking.config import TrackerConfig

Table = dict[str, Any]
_OVERVIEW = (
    "recording", "device", "lost on the way", "tracks lost", "unscored s", "above 5 m %",
    "refused %", "above level", "RMSE m", "95 % m", "NEES", "available %", "scored",
)  # fmt: skip


def _table(
    caption: str, head: Sequence[str], rows: Sequence[Sequence[str]], text: tuple[int, ...] = ()
) -> Table:
    """``text``: the columns of sentences."""
    return {"caption": caption, "head": head, "rows": rows, "text": text}


def overview(results: Iterable[Evaluation | Survey]) -> Table:
    """A row for each recording and device, misses first."""
    rows = []
    for one in results:
        lost = str(sum(lost_in(one.facts).values()) or 0)
        if isinstance(one, Evaluation):
            rows += [
                [one.path.name, vue, lost, *_scored(figures)]
                for vue, figures in one.columns().items()
            ]
        else:
            rows += [
                [one.path.name, vue, lost, *_surveyed(surveyed.figures)]
                for vue, surveyed in one.vues.items()
            ]
    return _table("All recordings", _OVERVIEW, rows)


def _cell(value: float | None, style: str) -> str:
    return NOTHING if value is None else format(value, style).removesuffix("%")


def _scored(figures: Figures) -> list[str]:
    nees = _cell(figures.nees_mean, ".2f")
    if figures.nees_consistent is not None:
        nees += " ✓" if figures.nees_consistent else " ✗"
    return [
        _cell(figures.lost_tracks, "d"),
        _cell(figures.unscored_s, ".1f"),
        _cell(figures.share_above_5m, ".2%"),
        _cell(figures.rejected_share, ".2%"),
        _cell(figures.protection_exceeded, ".1e"),
        _cell(figures.rmse_m, ".3f"),
        _cell(figures.p95_m, ".3f"),
        nees,
        _cell(figures.availability, ".1%"),
        str(figures.n),
    ]


def _surveyed(figures: VueSurvey) -> list[str]:
    """Row of a recording without ground truth: most figures are unknown."""
    total = figures.accepted + sum(figures.rejected.values())
    refused = sum(figures.rejected.values()) / total if total else None
    unknown = [NOTHING] * 3
    tracking = _cell(figures.states.get("tracking", 0.0), ".1%")
    return [*unknown, _cell(refused, ".2%"), *unknown, NOTHING, tracking, "no truth"]


def runs(results: Iterable[Evaluation | Survey]) -> Table:
    """How each recording was made and tracked."""
    head = (
        "recording",
        "scenario",
        "seed",
        "netpos",
        "tracker parameters that are not the default",
    )
    return _table("Runs", head, [_run(one.path.name, one.facts) for one in results], text=(4,))


def _run(name: str, facts: Mapping[str, tuple[str, ...]]) -> list[str]:
    scenario = _first(facts, SCENARIO_FACT)
    parameters = "not said"
    if TRACKER_FACT in facts:
        config = TrackerConfig.from_mapping(known_parameters(_first(facts, TRACKER_FACT)))
        changed = [f"{key} {value}" for key, value in not_usual(config).items()]
        parameters = ", ".join(changed) or "none"
        if len(facts[TRACKER_FACT]) > 1:
            parameters = "contradicts itself"
    return [
        name,
        str(scenario.get("name", NOTHING)),
        str(scenario.get("seed", NOTHING)),
        " and ".join(facts.get("netpos_version", (NOTHING,))),
        parameters,
    ]


def _first(facts: Mapping[str, tuple[str, ...]], name: str) -> Mapping[str, Any]:
    """The first value of a fact, empty where it cannot be read."""
    try:
        value = load_yaml(facts.get(name, ("",))[0])
    except ValueError:
        value = None
    return value if isinstance(value, dict) else {}


def of_evaluation(
    evaluation: Evaluation, residuals: Mapping[str, Sequence[Residuals]]
) -> list[Table]:
    """Figures, verdicts, and what each RSU measured."""
    figures = ["figure", "unit", *evaluation.columns()]
    verdicts = ["set", "requirement", "required", *evaluation.vues]
    return [
        _table("Figures", figures, figure_rows(evaluation)),
        _table("Requirements", verdicts, verdict_rows(evaluation)),
        *_residuals(residuals, "measured minus true"),
    ]


def of_survey(survey: Survey) -> list[Table]:
    """Tables of a recording without ground truth."""
    rows = {name: vue.figures.residuals for name, vue in survey.vues.items()}
    return [
        _table("Figures", ["figure", "unit", *survey.vues], survey_rows(survey)),
        *_residuals(rows, "measured minus where the track is"),
    ]


def _residuals(rows: Mapping[str, Sequence[Residuals]], what: str) -> list[Table]:
    return [
        _table(f"{name}: {what}", RESIDUAL_HEAD, residual_rows(series), text=(9,))
        for name, series in rows.items()
        if series
    ]
