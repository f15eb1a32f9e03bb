"""Figures of a walk over many runs: errors, consistency, and what is not scored or lost."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from netpos.evaluation.consistency import MeanTest, nees, nees_over_runs
from netpos.messages.values import Array

LOST_M = 0.5
FAR_M = 5.0
_END = 20  # estimates at the end that decide whether a run is lost


@dataclass(frozen=True, slots=True, kw_only=True)
class Scores:
    """One run at the instants of its beacons: squared horizontal error (n,) m^2 and NEES (n,);
    NaN where the estimate is not scored."""

    error2: Array
    nees: Array

    @classmethod
    def of(cls, error: Array, cov: Array) -> Scores:
        """Of errors (n, 2) m, NaN where not scored, and covariances (n, 2, 2)."""
        scored = np.flatnonzero(np.isfinite(error).all(axis=1))
        values = np.full(len(error), np.nan)
        normalised, usable = nees(error[scored], cov[scored])
        values[scored[usable]] = normalised
        return cls(error2=(error**2).sum(axis=1), nees=values)


@dataclass(frozen=True, slots=True, kw_only=True)
class Figures:
    """Over all runs of a case.

    rmse_m, error_max_m, nees : of the estimates that are scored
    decided_s : time of the first of them, mean and 95 % of the runs that have one
    unscored : share of all instants that are not scored
    lost : runs that end more than ``LOST_M`` off, or without a scored estimate
    error2 : (runs, n) m^2, NaN where not scored
    """

    runs: int
    rmse_m: float
    error_max_m: float
    nees: MeanTest
    decided_s: tuple[float, float]
    unscored: float
    lost: int
    error2: Array

    @classmethod
    def of(cls, times_s: Array, runs: Sequence[Scores]) -> Figures:
        """Of runs at the same instants (n,).

        Raises
        ------
        ValueError  no run has a scored estimate
        """
        error2 = np.array([run.error2 for run in runs])
        values = np.array([run.nees for run in runs])
        scored = np.isfinite(error2)
        first = times_s[np.argmax(scored, axis=1)][scored.any(axis=1)]
        return cls(
            nees=nees_over_runs(np.nansum(values, axis=1), np.isfinite(values).sum(axis=1), 2),
            runs=len(runs),
            rmse_m=float(np.sqrt(np.nanmean(error2))),
            error_max_m=float(np.sqrt(np.nanmax(error2))),
            decided_s=(float(first.mean()), float(np.quantile(first, 0.95))),
            unscored=float(1.0 - scored.mean()),
            lost=int(np.sum(_lost(error2))),
            error2=error2,
        )

    @property
    def median_rmse_m(self) -> float:
        """RMSE of the median run, of those with a scored estimate."""
        kept = self.error2[np.isfinite(self.error2).any(axis=1)]
        return float(np.sqrt(np.median(np.nanmean(kept, axis=1))))

    def share_above(self, limit_m: float) -> float:
        """Share of runs with at least one scored error above a limit [m]."""
        return float((np.nan_to_num(self.error2) > limit_m**2).any(axis=1).mean())


def _lost(error2: Array) -> Array:
    """Which runs (runs,) are lost at their end."""
    end = error2[:, -_END:]
    return np.asarray((end > LOST_M**2).any(axis=1) | np.isnan(end).all(axis=1))


def ratio_at_same_instants(above: Figures, below: Figures) -> float | None:
    """RMSE of one case over that of another, both at the instants at which both are scored in the
    same run; None where there are none."""
    both = np.isfinite(above.error2) & np.isfinite(below.error2)
    if not both.any():
        return None
    return math.sqrt(float(above.error2[both].mean() / below.error2[both].mean()))
