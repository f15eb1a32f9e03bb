"""Survey of a recording without ground truth, from its own residuals and states."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from netpos.evaluation.availability import LOSSES
from netpos.evaluation.consistency import MeanTest, nis_test
from netpos.evaluation.pairing import ClockOffsets, Trajectory
from netpos.evaluation.residuals import Residuals, Series, newest, series_of, summary
from netpos.messages.values import (
    Array,
    RsuErrors,
    RsuInfo,
    RsuMeasurement,
    TrackState,
    TrackStatus,
)
from netpos.tracking.health.diagnosis import errors_in_words

_GAP_S = 1.0
_BIASED, _FEW, _SEVERAL = 0.5, 20, 4
_TOO_FAR = 0.02
_NIS_LOW, _NIS_HIGH = 0.5, 1.3


@dataclass(frozen=True, slots=True, kw_only=True)
class VueSurvey:
    """One device without ground truth.

    span_s : from the first to the last measurement or status; states : share of that by state;
    gaps : intervals of more than a second without an estimate, and the longest [s]; accepted and
    rejected : measurements, the latter by reason; nis : its mean, nis_dof : what is expected
    """

    span_s: float
    estimates: int
    measurements: int
    states: Mapping[str, float]
    gaps: int
    longest_gap_s: float
    way_m: float
    accepted: int
    rejected: Mapping[str, int]
    nis: MeanTest | None
    nis_dof: float
    position_sd_m: float | None
    protection_level_m: float | None
    residuals: tuple[Residuals, ...]
    suggestions: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """Plain types."""
        return asdict(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class VueRecord:
    """Data of one device in a recording."""

    track: Trajectory
    statuses: Sequence[TrackStatus]
    clock: ClockOffsets
    measurements: Sequence[RsuMeasurement]
    errors: Sequence[RsuErrors]


@dataclass(frozen=True, slots=True, kw_only=True)
class SurveyedVue:
    """A device, its figures and the series behind them."""

    record: VueRecord
    figures: VueSurvey
    series: tuple[Series, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Survey:
    """A recording without ground truth."""

    path: Path
    vues: Mapping[str, SurveyedVue]
    rsus: tuple[RsuInfo, ...]
    buildings: Array
    topics: Mapping[str, tuple[str, int]]
    notes: tuple[str, ...] = ()
    facts: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Plain types in the form of ``netpos evaluate --json``."""
        return {
            "bag": self.path.name,
            "ground_truth": False,
            "notes": list(self.notes),
            "vues": {name: vue.figures.to_json() for name, vue in self.vues.items()},
            "topics": {
                topic: {"type": type_name, "messages": count}
                for topic, (type_name, count) in sorted(self.topics.items())
            },
        }


def survey_vue(record: VueRecord, rsus: Mapping[str, RsuInfo], learns: bool) -> SurveyedVue:
    """Figures of one device. ``learns``: whether its tracker learned the errors of the RSUs."""
    series = tuple(series_of(record.measurements, rsus, record.track, record.clock))
    said = {key: errors_in_words(errors) for key, errors in newest(record.errors).items()}
    rows = tuple(summary(s, said.get((s.rsu_id, s.quantity), "")) for s in series)
    figures = _figures(record, rows)
    suggestions = tuple(_suggestions(figures, rsus, record.measurements, learns))
    return SurveyedVue(
        record=record, figures=replace(figures, suggestions=suggestions), series=series
    )


def _figures(record: VueRecord, rows: tuple[Residuals, ...]) -> VueSurvey:
    stamps = [m.stamp_ns for m in record.measurements] + [s.stamp_ns for s in record.statuses]
    span_s = (max(stamps) - min(stamps)) * 1e-9 if stamps else 0.0
    stamps_ns, places = record.track.stamp_ns, record.track.position[:, :2]
    gaps = np.diff(stamps_ns) * 1e-9
    evaluated = [s for s in record.statuses if s.nis_dof > 0]
    sds = [s.position_sd_m for s in record.statuses if s.state is TrackState.TRACKING]
    levels = [s.protection_level_m for s in record.statuses if s.protection_level_m >= 0.0]
    last = record.statuses[-1] if record.statuses else None
    return VueSurvey(
        span_s=span_s,
        estimates=len(stamps_ns),
        measurements=len(record.measurements),
        states=_states(record.statuses, span_s),
        gaps=int((gaps > _GAP_S).sum()),
        longest_gap_s=float(gaps.max(initial=0.0)),
        way_m=float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum()),
        accepted=last.accepted if last else 0,
        rejected=dict(sorted(last.rejected.items())) if last else {},
        nis=nis_test(
            np.array([s.nis for s in evaluated]), np.array([s.nis_dof for s in evaluated])
        ),
        nis_dof=float(np.mean([s.nis_dof for s in evaluated])) if evaluated else 0.0,
        position_sd_m=float(np.median(sds)) if sds else None,
        protection_level_m=float(np.median(levels)) if levels else None,
        residuals=rows,
        suggestions=(),
    )


def _states(statuses: Sequence[TrackStatus], span_s: float) -> dict[str, float]:
    """Share of the span by state: each status holds until the next, for a second at most; the rest
    is unheard."""
    if span_s <= 0.0:
        return {}
    shares: dict[str, float] = defaultdict(float)
    for status, after in zip(statuses, [*statuses[1:], None], strict=True):
        lasts_s = 0.0 if after is None else (after.stamp_ns - status.stamp_ns) * 1e-9
        shares[status.state.name.lower()] += min(max(lasts_s, 0.0), _GAP_S) / span_s
    shares["unheard"] = max(1.0 - sum(shares.values()), 0.0)
    return {name: share for name, share in shares.items() if share > 0.0}


def _common_bias(rows: Sequence[Residuals]) -> float:
    """The median bias of lengths where all RSUs have one to the same side, else 0."""
    biases = [row.bias for row in rows]
    one_sided = min(biases, default=0.0) > 0.0 or max(biases, default=0.0) < 0.0
    if len(rows) < _SEVERAL or not one_sided or rows[0].unit != "m":
        return 0.0
    common = float(np.median(biases))
    return common if abs(common) > _BIASED * float(np.median([r.stated for r in rows])) else 0.0


def _off(bias: float, unit: str) -> str:
    if unit == "m":
        return f"{'long' if bias > 0.0 else 'short'} by {abs(bias):.2f} m"
    return f"off by {bias:+.2f} {unit}".rstrip()


def _suggestions(
    figures: VueSurvey,
    rsus: Mapping[str, RsuInfo],
    measurements: Iterable[RsuMeasurement],
    learns: bool,
) -> Iterable[str]:
    """Suggestions, the most important first."""
    unknown = sorted({m.rsu_id for m in measurements} - rsus.keys())
    if unknown:
        yield f"no RsuInfo of {', '.join(unknown)}: what they measured was not used"
    if not figures.estimates:
        yield "no estimate at all: see what is rejected, and track_status.reason"
    total = figures.accepted + sum(n for r, n in figures.rejected.items() if r not in LOSSES)
    for reason, count in sorted(figures.rejected.items(), key=lambda item: -item[1]):
        if reason not in LOSSES and total and count / total > _TOO_FAR:
            yield f"{100 * count / total:.0f} % of the measurements rejected: {reason}"
    remedy = "" if learns else ": correct it, declare its bias sd, or set learn_errors"
    for quantity in sorted({row.quantity for row in figures.residuals}):
        rows = [r for r in figures.residuals if r.quantity == quantity and r.count >= _FEW]
        common = _common_bias(rows)
        if common:
            yield (
                f"{quantity} of all RSUs {_off(common, rows[0].unit)}: a delay of the device, or "
                "a wrong height of the device or the RSUs"
            )
        for row in rows:
            excess = row.bias - common
            if abs(excess) > _BIASED * row.stated:
                off = _off(excess, row.unit)
                yield f"{quantity} of {row.rsu_id} {off}, against the others{remedy}"
    if figures.nis is not None:
        ratio = figures.nis.mean / figures.nis_dof
        if ratio > _NIS_HIGH:
            yield f"NIS {ratio:.2g} times as expected: variances stated too small, or biases"
        elif ratio < _NIS_LOW:
            yield f"NIS {ratio:.2g} times as expected: variances stated too large"
    coasting = figures.states.get("coasting", 0.0) + figures.states.get("unheard", 0.0)
    if coasting > _TOO_FAR:
        yield f"{100 * coasting:.0f} % of the time without a measurement that was taken"
