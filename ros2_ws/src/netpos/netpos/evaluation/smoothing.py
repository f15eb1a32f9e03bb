"""Gain of smoothing over the filter in a recording."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from netpos.bags import BagReader, codec
from netpos.evaluation.metrics import SKIP_EPOCHS
from netpos.evaluation.pairing import Trajectory, pair
from netpos.messages import topics


@dataclass(frozen=True, slots=True, kw_only=True)
class SmoothingGain:
    """Horizontal RMSE [m] of the same ``n`` epochs, filtered and smoothed."""

    n: int
    filter_rmse_m: float
    smoothed_rmse_m: float

    @property
    def ratio(self) -> float:
        """How many times smaller the error is; inf for no error."""
        return self.filter_rmse_m / self.smoothed_rmse_m if self.smoothed_rmse_m else math.inf


def smoothing_gains(bag: Path, skip_epochs: int = SKIP_EPOCHS) -> dict[str, SmoothingGain]:
    """Gain by device, of the epochs that have a filtered and a smoothed estimate and a truth,
    without the first ``skip_epochs``; devices without any are left out."""
    gains = {}
    with BagReader(bag) as reader:
        vues = sorted({topics.split(name)[0] for name in reader.topics} - {""})
        for vue in vues:
            truth, filtered, smoothed = (
                _trajectory(reader, topics.of_vue(vue, name))
                for name in (topics.GROUND_TRUTH, topics.ODOMETRY, topics.ODOMETRY_SMOOTHED)
            )
            common = np.intersect1d(filtered.stamp_ns, smoothed.stamp_ns)[skip_epochs:]
            rmse = []
            for trajectory in (filtered, smoothed):
                of_both = trajectory.take(np.isin(trajectory.stamp_ns, common))
                error = pair(of_both, truth).horizontal_error
                rmse.append(math.sqrt(float(np.mean(error**2))) if error.size else math.nan)
            if not math.isnan(rmse[0]):
                gains[vue] = SmoothingGain(
                    n=int(error.size), filter_rmse_m=rmse[0], smoothed_rmse_m=rmse[1]
                )
    return gains


def _trajectory(reader: BagReader, topic: str) -> Trajectory:
    if topic not in reader.topics:
        return Trajectory.of([])
    make = codec()
    return Trajectory.of(
        make.odometry_from_msg(entry.message) for entry in reader.messages([topic])
    )
