"""What is reported of an estimate: its protection level, of one epoch of a track and of a whole
run."""

from __future__ import annotations

import numpy as np

from netpos.estimation.compile import kernel, leaf
from netpos.estimation.engine import GATE_SIZE, Epochs, FilterOptions, Run
from netpos.estimation.forms import ekf
from netpos.estimation.measurement import GROUP
from netpos.estimation.motion import Parameter
from netpos.estimation.nis_window import NisWindow
from netpos.estimation.protection import (
    FusedEpoch,
    gaussian_radius,
    level_in,
    level_scratch,
    radius_limit,
)
from netpos.estimation.state import X
from netpos.messages.values import Array

LEVEL_MAX_M = 1e6
"""Protection level of a track whose error nothing bounds."""


@leaf
def level_of(
    radius_m: float,
    inflation: float,
    undetected_m: float,
    manoeuvre_sd_mps: float,
    unheard_s: float,
) -> float:
    """Protection level [m] of an estimate that is one Gaussian.

    radius_m : that its error leaves with ``integrity_risk``; inflation : factor on the sd
    undetected_m : where a manoeuvre that nothing has shown may have taken the device, at the last
        measurement that was accepted, ``unheard_s`` ago; it goes on at ``manoeuvre_sd_mps``
    """
    moved_m = undetected_m + manoeuvre_sd_mps * unheard_s
    return max(inflation * radius_m, min(moved_m, LEVEL_MAX_M))


def run_levels(
    epochs: Epochs, run: Run, motions: Array, bias: Array, options: FilterOptions
) -> Array:
    """Protection levels [m] (N,) that a track reports of the ``epochs`` of which
    ``components.run_epochs`` made ``run``, or of the first N of them; the groups of an epoch have
    equally many rows.

    motions : (N, Parameter) of each epoch, or (1, Parameter) of all. Where part of the groups was
    refused, which ones is not known here, and the level of a manoeuvre takes them all.
    """
    inflation = NisWindow.of_run(*_nis_of_all_groups(epochs, run, options))
    undetected_m = np.zeros((2, run.nis.size))
    if options.manoeuvre_speed_sd > 0.0:
        _undetected(epochs, run, motions, bias, options, undetected_m)
    levels: Array = _levels(run, inflation, undetected_m, options)
    return levels


def _nis_of_all_groups(epochs: Epochs, run: Run, options: FilterOptions) -> tuple[Array, Array]:
    """NIS and number of rows (N,) of the epochs, refused groups as at their gate."""
    row_start, rows = epochs.row_start[: run.nis.size + 1], epochs.rows
    dof = np.diff(row_start)
    groups = rows[row_start[1:] - 1, GROUP].astype(int) + 1
    refused = options.gate_nis[np.minimum(dof // groups, GATE_SIZE - 1)]
    return run.nis + (groups - run.groups) * refused, dof


@kernel
def _undetected(
    epochs: Epochs,
    run: Run,
    motions: Array,
    bias: Array,
    options: FilterOptions,
    undetected_m: Array,
) -> None:
    """Fill ``undetected_m`` (2, N) with ``level_in`` of each epoch but the first, and the seconds
    since the last accepted measurement after it."""
    stamps_ns, row_start, rows = epochs
    means, covs, groups = run.means, run.covs, run.groups
    x, P, motion = means[0].copy(), covs[0].copy(), motions[0].copy()
    scratch = level_scratch(x.size, np.diff(row_start).max())
    heard_ns, accepted = stamps_ns[0], np.ones(GATE_SIZE)
    for k in range(1, groups.size):
        heard_ns = stamps_ns[k - 1] if groups[k - 1] > 0 else heard_ns
        dt = (stamps_ns[k] - stamps_ns[k - 1]) * 1e-9
        unheard_s = (stamps_ns[k] - heard_ns) * 1e-9
        x[:], P[:], motion[:] = means[k - 1], covs[k - 1], motions[min(k, len(motions) - 1)]
        motion[Parameter.VELOCITY_STEP_SD] = 0.0
        ekf.predict(x, P, dt, motion, bias)
        accepted[:] = 1.0 if groups[k] > 0 else 0.0
        own = rows[row_start[k] : row_start[k + 1]]
        epoch = FusedEpoch(x, P, own, accepted, unheard_s, means[k])
        undetected_m[0, k] = level_in(epoch, options, scratch)
        undetected_m[1, k] = 0.0 if groups[k] > 0 else unheard_s


@kernel
def _levels(run: Run, inflation: Array, undetected_m: Array, options: FilterOptions) -> Array:
    """Level (N,) of each epoch: ``level_of``, and that of a mixture."""
    level, risk = run.radius.copy(), options.integrity_risk
    speed = options.manoeuvre_speed_sd
    for k in range(level.size):
        cov, factor = run.covs[k], inflation[k]
        xx, xy, yy = cov[X.PX, X.PX], cov[X.PX, X.PY], cov[X.PY, X.PY]
        at_most = factor * radius_limit(xx, xy, yy, risk)
        level[k] = max(level[k], level_of(0.0, 1.0, undetected_m[0, k], speed, undetected_m[1, k]))
        if level[k] < at_most:
            level[k] = max(level[k], factor * gaussian_radius(xx, xy, yy, risk))
    return level
