"""An evaluation as rows of text, for the terminal and the report."""

from __future__ import annotations

from collections.abc import Iterable

from netpos.evaluation.evaluate import Evaluation
from netpos.evaluation.metrics import Figures
from netpos.evaluation.requirements import Row
from netpos.evaluation.residuals import Residuals
from netpos.evaluation.survey import Survey

NOTHING = "–"

# label, unit, field of VueSurvey, format
_SURVEY_ROWS = (
    ("duration", "s", "span_s", ".1f"),
    ("measurements", "", "measurements", "d"),
    ("estimates", "", "estimates", "d"),
    ("gaps above 1 s", "", "gaps", "d"),
    ("longest gap", "s", "longest_gap_s", ".2f"),
    ("way", "m", "way_m", ".1f"),
    ("measurements accepted", "", "accepted", "d"),
    ("position sd while TRACKING, median", "m", "position_sd_m", ".2f"),
    ("protection level, median", "m", "protection_level_m", ".2f"),
)
# label, unit, field of Figures, format
_ROWS = (
    ("estimates scored", "", "n", "d"),
    ("before the first TRACKING", "", "initialising", "d"),
    ("duration", "s", "duration_s", ".1f"),
    ("estimates with ground truth", "%", "truth_share", ".1%"),
    ("available, of that time", "%", "availability", ".1%"),
    ("measured, of that time", "%", "measured", ".1%"),
    ("tracks lost", "", "lost_tracks", "d"),
    ("time without a scored estimate", "s", "unscored_s", ".1f"),
    ("measurements refused", "%", "rejected_share", ".2%"),
    ("rejections of all kinds", "", "rejected", "d"),
    ("position RMSE", "m", "rmse_m", ".3f"),
    ("errors above 5 m", "%", "share_above_5m", ".2%"),
    ("position RMSE, 3-D", "m", "rmse_3d_m", ".3f"),
    ("north RMSE", "m", "north_rmse_m", ".3f"),
    ("east RMSE", "m", "east_rmse_m", ".3f"),
    ("RMSE along the way", "m", "along_rmse_m", ".3f"),
    ("RMSE across the way", "m", "across_rmse_m", ".3f"),
    ("vertical RMSE", "m", "vertical_rmse_m", ".3f"),
    ("vertical error, mean", "m", "vertical_error_m", "+.3f"),
    ("mean position error", "m", "mean_error_m", ".3f"),
    ("50 % within", "m", "p50_m", ".3f"),
    ("95 % within", "m", "p95_m", ".3f"),
    ("99 % within", "m", "p99_m", ".3f"),
    ("largest error", "m", "max_m", ".3f"),
    ("velocity RMSE", "m/s", "velocity_rmse_mps", ".3f"),
    ("heading RMSE", "°", "heading_rmse_deg", ".2f"),
    ("clock offset sd", "ns", "clock_offset_sd_ns", ".2f"),
    ("clock offset RMSE", "ns", "clock_offset_rmse_ns", ".2f"),
    ("NEES, mean (2 expected)", "", "nees_mean", ".2f"),
    ("squared error / variance along the way (1 expected)", "", "along_nees", ".2f"),
    ("squared error / variance across the way (1 expected)", "", "across_nees", ".2f"),
    ("NIS, mean", "", "nis_mean", ".2f"),
    ("NIS, expected", "", "nis_dof_mean", ".2f"),
    ("error above protection level", "", "protection_exceeded", ".1e"),
    ("protection level, median", "m", "protection_level_m", ".2f"),
    ("error / bound", "", "bound_ratio", ".2f"),
    ("output rate", "Hz", "output_rate_hz", ".2f"),
    ("longest gap", "s", "longest_gap_s", ".2f"),
)
_INITIAL = (
    ("first fix after", "s", "time_to_first_fix_s"),
    ("ready after", "s", "time_to_ready_s"),
    ("within 1 m after", "s", "time_to_1m_s"),
)


def _text(value: float | None, style: str) -> str:
    if value is None:
        return NOTHING
    return format(value, style).removesuffix("%")


def _interval(figures: Figures) -> str:
    if figures.nees_bounds is None:
        return NOTHING
    low, high = figures.nees_bounds
    verdict = "consistent" if figures.nees_consistent else "not consistent"
    return f"{low:.2f} to {high:.2f}, {verdict}"


def figure_rows(evaluation: Evaluation) -> list[list[str]]:
    """Rows of label, unit and one value per entry of ``Evaluation.columns``."""
    all_figures = list(evaluation.columns().values())
    rows = []
    for label, unit, name, style in _ROWS:
        rows.append([label, unit, *(_text(getattr(f, name), style) for f in all_figures)])
        if name == "nees_mean":
            rows.append(["NEES, 95 % bounds", "", *map(_interval, all_figures)])
    rows += [
        [label, unit, *(_text(getattr(f.initial, name), ".2f") for f in all_figures)]
        for label, unit, name in _INITIAL
    ]
    return rows


def survey_rows(survey: Survey) -> list[list[str]]:
    """Rows of label, unit and one value per device of a recording without ground truth."""
    vues = [vue.figures for vue in survey.vues.values()]
    rows = [
        [label, unit, *(_text(getattr(vue, name), style) for vue in vues)]
        for label, unit, name, style in _SURVEY_ROWS
    ]
    states = sorted({state for vue in vues for state in vue.states})
    rows += [
        [f"time {state}", "%", *(_text(vue.states.get(state, 0.0), ".1%") for vue in vues)]
        for state in states
    ]
    reasons = sorted({reason for vue in vues for reason in vue.rejected})
    rows += [
        [f"rejected: {reason}", "", *(_text(vue.rejected.get(reason, 0), "d") for vue in vues)]
        for reason in reasons
    ]
    rows.append(
        ["NIS, mean", "", *(_text(vue.nis.mean if vue.nis else None, ".2f") for vue in vues)]
    )
    rows.append(["NIS, expected", "", *(_text(vue.nis_dof or None, ".2f") for vue in vues)])
    return rows


RESIDUAL_HEAD = (
    "RSU", "of", "n", "bias", "scatter", "stated", "unit", "lasts s", "> 4 sd %", "learned",
)  # fmt: skip


def residual_rows(residuals: Iterable[Residuals]) -> list[list[str]]:
    """Rows under ``RESIDUAL_HEAD``: what each RSU measured against the track."""
    return [
        [
            row.rsu_id,
            row.quantity,
            str(row.count),
            f"{row.bias:+.3g}",
            f"{row.scatter:.3g}",
            f"{row.stated:.3g}",
            row.unit,
            _text(row.correlation_s, ".1f"),
            _text(row.far, ".1%"),
            row.learned,
        ]
        for row in residuals
    ]


def _verdict(row: Row) -> str:
    mark = {True: " ✓", False: " ✗", None: ""}[row.ok]
    return _text(row.measured, ".3g") + mark


def verdict_rows(evaluation: Evaluation) -> list[list[str]]:
    """Rows of requirement set, requirement, what is required and one verdict per device."""
    columns = [vue.verdicts for vue in evaluation.vues.values()]
    rows = []
    for index, verdict in enumerate(columns[0]):
        for line, row in enumerate(verdict.rows):
            cells = [_verdict(verdicts[index].rows[line]) for verdicts in columns]
            rows.append([verdict.name, row.name, row.required, *cells])
    return rows
