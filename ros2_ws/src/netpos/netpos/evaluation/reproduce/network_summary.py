"""Figures of the network experiments over all seeds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from netpos.evaluation.consistency import MeanTest, chi2_mean_bounds, effective_size
from netpos.evaluation.reproduce.frame import Work
from netpos.evaluation.reproduce.network_stages import Setting, errors_of_seeds, stages_of
from netpos.messages.values import Array

_AXES = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkSummary:
    """time_s (n,); errors (runs, n, 2) m and covs (n, 2, 2) by estimator, at the common
    instants."""

    setting: Setting
    time_s: Array
    errors: Mapping[str, Array]
    covs: Mapping[str, Array]

    def within(self, from_s: float, to_s: float) -> npt.NDArray[np.bool_]:
        """(n,) the instants of a window, its end left out."""
        return (self.time_s >= from_s) & (self.time_s < to_s)

    def rmse_m(self, name: str, from_s: float = 0.0, to_s: float = np.inf) -> float:
        """Horizontal RMSE in a window."""
        square = (self.errors[name][:, self.within(from_s, to_s)] ** 2).sum(axis=2)
        return float(np.sqrt(square.mean()))

    def axis_rmse_m(self, name: str, from_s: float, to_s: float = np.inf) -> float:
        """RMSE of the coordinate x in a window."""
        error = self.errors[name][:, self.within(from_s, to_s), 0]
        return float(np.sqrt((error**2).mean()))

    def axis_sd_m(self, name: str, at_s: float) -> float:
        """Standard deviation of the coordinate x in the covariance, from the first instant on."""
        return float(np.sqrt(self.covs[name][self.within(at_s, np.inf)][0, 0, 0]))

    def axis_share_within(self, name: str, limit_m: float, from_s: float) -> float:
        """Share of errors of the coordinate x within a limit."""
        error = self.errors[name][:, self.within(from_s, np.inf), 0]
        return float((np.abs(error) <= limit_m).mean())

    def axis_largest_m(self, name: str, from_s: float) -> float:
        """Largest error of the coordinate x of all runs."""
        return float(np.abs(self.errors[name][:, self.within(from_s, np.inf), 0]).max())

    def nees(self, name: str) -> Array:
        """(runs, n) normalised squared errors of the position."""
        e, P = self.errors[name], self.covs[name]
        solved = np.linalg.solve(P[None], e[..., None])[..., 0]
        result: Array = (e * solved).sum(axis=2)
        return result

    def nees_test(self, name: str, from_s: float = 0.0, to_s: float = np.inf) -> MeanTest:
        """Mean NEES of a window over all runs: runs are independent, instants of one are not."""
        values = self.nees(name)[:, self.within(from_s, to_s)]
        n_eff = float(sum(effective_size(run) for run in values))
        bounds = chi2_mean_bounds(_AXES, n_eff)
        return MeanTest(mean=float(values.mean()), bounds=bounds, n_eff=n_eff)


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
