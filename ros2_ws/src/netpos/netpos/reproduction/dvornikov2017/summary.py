"""Figures of the network experiments over all seeds."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from netpos.evaluation.consistency import MeanTest, nees_over_runs
from netpos.evaluation.work import Work
from netpos.messages.values import Array
from netpos.reproduction.dvornikov2017.stages import Setting, errors_of_seeds, stages_of

LOST_M = 30.0  # three standard deviations of the worse network's fixes
_AXES = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkSummary:
    """time_s (n,); errors (runs, n, 2) m by estimator at the common instants, NaN where there is
    no estimate, and covs (n, 2, 2), or (runs, n, 2, 2) where they differ between runs. A figure
    of an estimator without any estimate is NaN."""

    setting: Setting
    time_s: Array
    errors: Mapping[str, Array]
    covs: Mapping[str, Array]

    def within(self, from_s: float, to_s: float = np.inf) -> npt.NDArray[np.bool_]:
        """(n,) the instants of a window, its end left out."""
        return (self.time_s >= from_s) & (self.time_s < to_s)

    def rmse_m(self, name: str, from_s: float = 0.0, to_s: float = np.inf) -> float:
        """Horizontal RMSE in a window."""
        return _rms(np.hypot(*self._axes(name, from_s, to_s)))

    def axis_rmse_m(self, name: str, axis: int, from_s: float, to_s: float = np.inf) -> float:
        """RMSE of one coordinate in a window."""
        return _rms(self._axes(name, from_s, to_s)[axis])

    def axis_sd_m(self, name: str, axis: int, at_s: float) -> float:
        """Standard deviation of one coordinate that the covariance gives at the first instant
        from ``at_s`` on; RMS over the runs."""
        k = int(np.argmax(self.within(at_s)))
        return _rms(np.sqrt(self.covs[name][..., k, axis, axis]))

    def axis_share_within(self, name: str, axis: int, limit_m: float, from_s: float) -> float:
        """Share of errors of one coordinate within a limit."""
        error = self._axes(name, from_s)[axis]
        known = error[np.isfinite(error)]
        return float((np.abs(known) <= limit_m).mean()) if known.size else math.nan

    def axis_largest_m(self, name: str, axis: int, from_s: float) -> float:
        """Largest error of one coordinate of all runs."""
        error = self._axes(name, from_s)[axis]
        return float(np.nanmax(np.abs(error))) if np.isfinite(error).any() else math.nan

    def axis_settled_s(self, name: str, axis: int, limit_m: float) -> float:
        """Time from which the RMSE of one coordinate over the runs stays within a limit; NaN
        where it does not."""
        errors = self.errors[name][..., axis]
        above = [k for k, column in enumerate(errors.T) if not _rms(column) <= limit_m]
        first = above[-1] + 1 if above else 0
        return float(self.time_s[first]) if first < len(self.time_s) else math.nan

    def share_of_runs_above(self, name: str, limit_m: float, from_s: float) -> float:
        """Share of runs with a horizontal error above a limit."""
        error = np.hypot(*self._axes(name, from_s))
        if not np.isfinite(error).any():
            return math.nan
        above: npt.NDArray[np.bool_] = np.asarray(np.nan_to_num(error) > limit_m)
        return float(above.any(axis=1).mean())

    def share_without(self, name: str, from_s: float = 0.0) -> float:
        """Share of instants without an estimate."""
        return float(np.isnan(self._axes(name, from_s)[0]).mean())

    def lost(self, name: str) -> int:
        """Runs without an estimate at the last instant, or more than ``LOST_M`` off."""
        end: Array = np.hypot(*self.errors[name][:, -1].T)
        return len(end) - int((end <= LOST_M).sum())

    def nees(self, name: str) -> Array:
        """(runs, n) normalised squared errors of the position."""
        e = self.errors[name]
        missing: npt.NDArray[np.bool_] = np.asarray(np.isnan(e).any(axis=-1))
        P = np.broadcast_to(self.covs[name], (*e.shape, _AXES))
        P = np.where(missing[..., None, None], np.eye(_AXES), P)
        result: Array = (e * np.linalg.solve(P, e[..., None])[..., 0]).sum(axis=2)
        return result

    def nees_test(self, name: str, from_s: float = 0.0, to_s: float = np.inf) -> MeanTest | None:
        """Mean NEES of a window by the spread between runs; None without estimates."""
        values = self.nees(name)[:, self.within(from_s, to_s)]
        counts = np.isfinite(values).sum(axis=1)
        if not counts.any():
            return None
        return nees_over_runs(np.nansum(values, axis=1), counts, _AXES)

    def _axes(self, name: str, from_s: float, to_s: float = np.inf) -> Array:
        """Errors (2, runs, k) of both coordinates in a window."""
        chosen = self.errors[name][:, self.within(from_s, to_s)]
        return np.asarray(np.moveaxis(chosen, 2, 0))


def _rms(values: Array) -> float:
    """Of the values that are known; NaN where none is."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else math.nan


def summarise(work: Work, setting: Setting) -> NetworkSummary:
    """All seeds of a setting."""
    parts = work.over_seeds(setting.name, errors_of_seeds, setting)
    stages = stages_of(setting)
    return NetworkSummary(
        setting=setting,
        time_s=stages.time_s,
        errors={name: np.concatenate([part[name] for part in parts]) for name in parts[0]},
        covs=stages.covs,
    )
