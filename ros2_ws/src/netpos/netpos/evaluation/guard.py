"""Committed baselines: figures of guarded runs with intervals, and figures outside of them.

The seeds and recordings are fixed, so an interval covers harmless changes of the program only
(rounding, the order of sums), not the spread between runs. Its half width is three times the root
mean square change of the figure in ``REPLICATES`` runs without a random ``DROPPED`` share of the
measurements, and at least the resolution ``LEAST`` of the figure. A figure of which that is more
than the ``WIDEST`` share says nothing and is left out.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from netpos.evaluation.guarded_runs import Case, Tracked, thinned, track

REPLICATES = 5
DROPPED = 0.01
WIDTH = 3.0
WIDEST = 0.5
_RELATIVE = 0.02
_SHARE = 0.001
_DIGITS = 4

Pooled = dict[str, float | None]


@dataclass(frozen=True, slots=True)
class Interval:
    """A figure of the baseline, and the interval that harmless changes do not leave."""

    value: float
    low: float
    high: float

    def holds(self, value: float) -> bool:
        """Whether a figure lies within, ends included."""
        return self.low <= value <= self.high


@dataclass(frozen=True, slots=True)
class Baseline:
    """What a case must keep: the number of its runs and its figures, None where it has none."""

    runs: int
    figures: Mapping[str, Interval | None]

    def to_text(self) -> str:
        """JSON, one line a figure, keys sorted: a difference shows one line for each change."""
        lines = [
            f"    {json.dumps(name)}: {_line(self.figures[name])}" for name in sorted(self.figures)
        ]
        body = ",\n".join(lines)
        return f'{{\n  "figures": {{\n{body}\n  }},\n  "runs": {self.runs}\n}}\n'

    @classmethod
    def of_text(cls, text: str) -> Baseline:
        """The baseline that ``to_text`` wrote."""
        content = json.loads(text)
        figures = {
            name: None if interval is None else Interval(**interval)
            for name, interval in content["figures"].items()
        }
        return cls(runs=content["runs"], figures=figures)


def pooled(runs: Sequence[Tracked]) -> Pooled:
    """Figures of many runs as one, by name: root mean squares over all estimates, means over all
    estimates, counts and shares over all measurements. None where no run has the figure.

    ``p50_m`` is the mean of the runs' median errors: one bad run rules ``rmse_m``, not this.
    """
    judged = sum(run.judged for run in runs)
    nis, dof = _mean(runs, "nis_mean"), _mean(runs, "nis_dof_mean")
    return {
        "rmse_m": _rms(runs, "rmse_m"),
        "p50_m": _mean(runs, "p50_m"),
        "velocity_rmse_mps": _rms(runs, "velocity_rmse_mps"),
        "heading_rmse_deg": _rms(runs, "heading_rmse_deg"),
        "clock_offset_sd_ns": _rms(runs, "clock_offset_sd_ns"),
        "nees_mean": _mean(runs, "nees_mean"),
        "nis_over_dof": None if nis is None or not dof else nis / dof,
        "protection_exceeded": _mean(runs, "protection_exceeded"),
        "availability": _mean(runs, "availability"),
        "lost_tracks": float(sum(run.lost for run in runs)),
        "rejected_share": sum(run.rejected for run in runs) / judged if judged else None,
    }


def _of_value(value: float) -> float:
    return _RELATIVE * value


# The smallest half width of a figure: what a reader would not call a change. Shares have one of
# their own; of lost tracks each counts.
LEAST: dict[str, Callable[[float], float]] = {
    "rmse_m": _of_value,
    "p50_m": _of_value,
    "velocity_rmse_mps": _of_value,
    "heading_rmse_deg": _of_value,
    "clock_offset_sd_ns": _of_value,
    "nees_mean": _of_value,
    "nis_over_dof": _of_value,
    "protection_exceeded": lambda _: _SHARE,
    "availability": lambda _: _SHARE,
    "rejected_share": lambda _: _SHARE,
    "lost_tracks": lambda _: 0.0,
}
_SHARES = ("protection_exceeded", "availability", "rejected_share")


def figures_of(case: Case) -> Pooled:
    """The pooled figures of a case today."""
    return pooled([run for material in case.materials() for run in track(material)])


def measured(case: Case) -> Baseline:
    """The baseline of a case today, with the intervals that its thinned runs give."""
    full: list[Tracked] = []
    thin: list[list[Tracked]] = [[] for _ in range(REPLICATES)]
    count = 0
    for count, material in enumerate(case.materials(), start=1):
        full += track(material)
        for k, replicate in enumerate(thin):
            replicate.extend(track(thinned(material, DROPPED, REPLICATES * count + k)))
    return baseline_of(pooled(full), [pooled(replicate) for replicate in thin], count)


def baseline_of(full: Pooled, replicates: Sequence[Pooled], runs: int) -> Baseline:
    """Intervals around the figures of ``full`` by how far the replicates are off."""
    figures: dict[str, Interval | None] = {}
    for name, value in full.items():
        if value is None:
            figures[name] = None
            continue
        others = [other for replicate in replicates if (other := replicate[name]) is not None]
        half = WIDTH * _rms_change(value, others)
        if LEAST[name] is not _of_value or half <= WIDEST * value:
            figures[name] = _interval(name, value, max(half, LEAST[name](value)))
    return Baseline(runs=runs, figures=figures)


def losses(name: str, baseline: Baseline, figures: Pooled) -> list[str]:
    """One sentence for each figure of a case that has left its interval."""
    return [
        f"{name}: {figure} is {_text(figures.get(figure))}, its baseline is {_known(interval)}; if"
        " this is meant, run `make baselines` and read the diff"
        for figure, interval in sorted(baseline.figures.items())
        if not _kept(interval, figures.get(figure))
    ]


def read_baselines(folder: Path) -> dict[str, Baseline]:
    """The committed baselines by case."""
    return {
        path.stem: Baseline.of_text(path.read_text(encoding="utf-8"))
        for path in sorted(folder.glob("*.json"))
    }


def _kept(interval: Interval | None, value: float | None) -> bool:
    if interval is None or value is None:
        return interval is None and value is None
    return interval.holds(value)


def _known(interval: Interval | None) -> str:
    if interval is None:
        return "none"
    return f"{interval.value:g} ({interval.low:g} to {interval.high:g})"


def _text(value: float | None) -> str:
    return "missing" if value is None else f"{value:.{_DIGITS}g}"


def _line(interval: Interval | None) -> str:
    if interval is None:
        return "null"
    return json.dumps({"value": interval.value, "low": interval.low, "high": interval.high})


def _rms_change(value: float, others: Sequence[float]) -> float:
    return math.sqrt(float(np.mean((np.array(others) - value) ** 2))) if others else 0.0


def _interval(name: str, value: float, half: float) -> Interval:
    rounded = _rounded(value)
    high = min(rounded + half, 1.0) if name in _SHARES else rounded + half
    return Interval(rounded, max(_rounded(rounded - half), 0.0), _rounded(high))


def _rounded(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")


def _weighted(runs: Sequence[Tracked], figure: str) -> tuple[np.ndarray[Any, Any], ...]:
    """Values and weights, the numbers of estimates scored, of the runs that have a figure."""
    having = [run.figures for run in runs if getattr(run.figures, figure) is not None]
    values = np.array([getattr(figures, figure) for figures in having], dtype=np.float64)
    return values, np.array([figures.n for figures in having], dtype=np.float64)


def _mean(runs: Sequence[Tracked], figure: str) -> float | None:
    values, weights = _weighted(runs, figure)
    return float(values @ weights / weights.sum()) if weights.sum() > 0.0 else None


def _rms(runs: Sequence[Tracked], figure: str) -> float | None:
    values, weights = _weighted(runs, figure)
    return math.sqrt(float(values**2 @ weights / weights.sum())) if weights.sum() > 0 else None
