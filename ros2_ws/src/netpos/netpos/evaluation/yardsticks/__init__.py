"""Yardsticks for recordings: least squares of one second, and a plain Kalman filter.

They take the measurements of a bag, know nothing of netpos' filters, and have no parameter chosen
by a score.
"""

from netpos.evaluation.yardsticks.observations import Kind, Observations, ranges, residuals
from netpos.evaluation.yardsticks.of_bag import observations_of_bag, observations_of_devices
from netpos.evaluation.yardsticks.plain_ekf import PlainConfig, PlainRun, plain_ekf
from netpos.evaluation.yardsticks.snapshot import Fix, Space, snapshot, snapshots

__all__ = [
    "Fix",
    "Kind",
    "Observations",
    "PlainConfig",
    "PlainRun",
    "Space",
    "observations_of_bag",
    "observations_of_devices",
    "plain_ekf",
    "ranges",
    "residuals",
    "snapshot",
    "snapshots",
]
