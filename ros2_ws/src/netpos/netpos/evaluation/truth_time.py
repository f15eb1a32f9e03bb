"""Whether the ground truth and the measurements tell the same time.

Receivers stamp what they measured when it arrives. Where that is late against the clock of the
ground truth, a moving device seems to be where it was: an error of speed times the offset, which
is nobody's. What RSUs measured shows it without any track: it fits the ground truth best at
another time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from netpos.evaluation.pairing import ClockOffsets, Trajectory, at_stamps
from netpos.evaluation.residuals import Series, series_of, summary
from netpos.messages import topics
from netpos.messages.values import Array, RsuInfo, RsuMeasurement

_NS = 1_000_000_000
_FEWEST, _MOST = 200, 4000  # measurements
_STEP_S = 0.05  # of the difference that stands for a derivative
_ROUNDS, _LONGEST_STEP_S = 8, 0.3
_SETTLED_S = 1e-3
_FAR = 3.0  # scatters: such a residual has no say
_LEAST_S = 0.02
_SMALLER = 0.9  # of the scatter, for the offset to be said
_NO_CLOCK = ClockOffsets(stamp_ns=np.empty(0, dtype=np.int64), offset_s=np.empty(0))


@dataclass(frozen=True, slots=True)
class TimeOffset:
    """How much later the ground truth would have to be [s], and what the measurements would
    scatter by about it then, over what they do now."""

    offset_s: float
    scatter: float

    @property
    def matters(self) -> bool:
        """Whether it explains a tenth of the scatter."""
        return abs(self.offset_s) >= _LEAST_S and self.scatter < _SMALLER

    def sentence(self, vue: str, bag: Path | None) -> str:
        """For people. ``bag``: that holds the ground truth, None: it comes from elsewhere."""
        remedy = f"{self.offset_s:.2f} more in --truth-time-offset"
        if bag is not None:
            topic = topics.of_vue(vue, topics.GROUND_TRUTH)
            offset = f"--truth-time-offset {self.offset_s:.2f}"
            remedy = f"--truth {bag} --truth-topic {topic} {offset}"
        return (
            f"{vue}: the measurements fit the ground truth best if it is {self.offset_s:.2f} s "
            f"later (they scatter by {1.0 - self.scatter:.0%} less about it): do their clocks "
            f"agree? An error of speed times this offset is in all figures; {remedy} scores "
            "without it"
        )


def time_offset(
    measurements: Sequence[RsuMeasurement], rsus: Mapping[str, RsuInfo], truth: Trajectory
) -> TimeOffset | None:
    """The offset of the ground truth, by what RSUs measured of a device; None where too little
    was. Times of arrival have no say, they need the device's clock.

    A robust fit (Gauss and Newton) of one offset and one constant error of each quantity of each
    RSU, of at most 4000 measurements.
    """
    if len(measurements) > _MOST:
        chosen = np.random.default_rng(0).choice(len(measurements), _MOST, replace=False)
        measurements = [measurements[i] for i in np.sort(chosen).tolist()]
    stamps = np.unique(np.array([m.stamp_ns for m in measurements], dtype=np.int64))

    def seen(offset_s: float) -> dict[tuple[str, str], Series]:
        later = replace(truth, stamp_ns=truth.stamp_ns + round(offset_s * _NS))
        found = series_of(measurements, rsus, at_stamps(later, stamps), _NO_CLOCK)
        return {(s.rsu_id, s.quantity): _finite(s) for s in found}

    at_first, offset_s = seen(0.0), 0.0
    if _count(at_first) < _FEWEST:
        return None
    for _ in range(_ROUNDS):
        step = _step(seen(offset_s - _STEP_S), seen(offset_s), seen(offset_s + _STEP_S))
        offset_s += min(max(step, -_LONGEST_STEP_S), _LONGEST_STEP_S)
        if abs(step) < _SETTLED_S:
            break
    at_last = seen(offset_s)
    if _count(at_last) < _FEWEST:  # it has gone past the end of the truth
        return None
    return TimeOffset(offset_s, _scatter(at_last) / _scatter(at_first))


def _finite(series: Series) -> Series:
    """Without residuals of values that are no numbers."""
    kept = np.isfinite(series.residual)
    return replace(
        series,
        stamp_ns=series.stamp_ns[kept],
        residual=series.residual[kept],
        stated=series.stated[kept],
    )


def _step(
    earlier: Mapping[tuple[str, str], Series],
    now: Mapping[tuple[str, str], Series],
    later: Mapping[tuple[str, str], Series],
) -> float:
    """By how much more the truth should be later [s]."""
    down = up = 0.0
    for key in earlier.keys() & now.keys() & later.keys():
        residual, rate = _joined(earlier[key], now[key], later[key])
        if not len(residual):
            continue
        scatter = summary(now[key]).scatter
        near = np.abs(residual - np.median(residual)) <= _FAR * scatter
        if scatter <= 0.0 or not near.any():
            continue
        r, g = residual[near] - residual[near].mean(), rate[near] - rate[near].mean()
        up -= float(g @ r) / scatter**2
        down += float(g @ g) / scatter**2
    return up / down if down > 0.0 else 0.0


def _joined(earlier: Series, now: Series, later: Series) -> tuple[Array, Array]:
    """Residuals (n,) at the stamps that all have, and how they change with the offset (n,)."""
    common = np.intersect1d(earlier.stamp_ns, later.stamp_ns)
    common = np.intersect1d(common, now.stamp_ns)
    a, r, b = (s.residual[np.searchsorted(s.stamp_ns, common)] for s in (earlier, now, later))
    return r, (b - a) / (2.0 * _STEP_S)


def _count(seen: Mapping[tuple[str, str], Series]) -> int:
    return sum(len(s.residual) for s in seen.values())


def _scatter(seen: Mapping[tuple[str, str], Series]) -> float:
    """The geometric mean of all scatters, by the numbers of measurements."""
    heard = [s for s in seen.values() if len(s.residual)]
    each = [(len(s.residual), max(summary(s).scatter, 1e-12)) for s in heard]
    counts, scatters = np.array(each).T
    return float(np.exp(counts @ np.log(scatters) / counts.sum()))
