"""Best possible error on the rectangle: the posterior Cramér-Rao bound of a filter that knows
the sector and the instants at which the walker starts, stops and turns."""

from __future__ import annotations

import numpy as np

from netpos.estimation.motion import NO_BIAS, Parameter, motion_parameters
from netpos.evaluation.bounds import bound_covariances, bound_rmse
from netpos.messages.values import Array
from netpos.radio.noise import generator
from netpos.reproduction.experiment import VUE
from netpos.reproduction.petukhov.rectangle import ERRORS, Setup
from netpos.reproduction.petukhov.steps import Steps, velocity_rows
from netpos.tracking.estimators.models import pose_state

_ACCEL = 1e-6  # m/s^2/sqrt(Hz): between those instants the speed is kept
_FREE_MPS = 10.0


def known_instants_rmse_m(setup: Setup, from_s: float, every_step: bool = False) -> float:
    """Bound [m] of the position RMSE from ``from_s`` on.

    every_step : the velocity may change at every step, else only where the walk changes
    """
    velocity, step = velocity_rows(setup.times_s, setup.steps, ERRORS, generator(1, VUE), 0.0)
    rows = np.concatenate([setup.rows(1)[:, :2], velocity], axis=1)
    repeated = (step >= 0) & (np.diff(step, prepend=-1) == 0)  # say the same again
    changes = _changes(setup.steps, every_step)
    times = np.concatenate([setup.times_s, changes])
    order = np.argsort(times, kind="stable")
    motion = motion_parameters(accel=_ACCEL)
    motions, blocks = np.tile(motion, (len(times), 1)), []
    starts, truth = np.zeros(len(times) + 1, dtype=np.int64), np.zeros((len(times), 6))
    for position, index in enumerate(order.tolist()):
        if index < len(rows):
            epoch_rows = rows[index, :2] if repeated[index] else rows[index]
            blocks.append(epoch_rows)
            starts[position + 1] = len(epoch_rows)
        else:
            motions[position, Parameter.VELOCITY_STEP_SD] = _FREE_MPS
    for axis in range(2):
        truth[:, axis] = np.interp(times[order], setup.times_s, setup.truth[:, axis])
    config = setup.config
    bounds: Array = bound_covariances(
        np.round(times[order] * 1e9).astype(np.int64),
        np.cumsum(starts),
        np.concatenate(blocks),
        truth,
        pose_state(config, np.zeros(2), np.eye(2) * 100.0)[1],
        config.device_height_m,
        motions,
        NO_BIAS,
    )
    return bound_rmse(bounds[(order < len(rows)) & (times[order] >= from_s)])


def _changes(steps: Steps, every_step: bool) -> Array:
    """Instants at which the velocity may change [s]."""
    edges: Array = np.unique(np.round(np.concatenate([steps.start_s, steps.end_s]), 9))
    if every_step:
        return edges
    inner = np.intersect1d(np.round(steps.start_s, 9), np.round(steps.end_s, 9))
    return np.asarray(np.setdiff1d(edges, inner))
