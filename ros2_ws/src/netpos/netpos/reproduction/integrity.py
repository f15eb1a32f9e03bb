"""Protection levels that ``tracking.track`` reports of a whole run, at once."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import chdtri

from netpos.estimation.compile import kernel
from netpos.estimation.engine import GATE_SIZE, Epochs, FilterOptions, Run
from netpos.estimation.forms import ekf
from netpos.estimation.measurement import GROUP
from netpos.estimation.motion import Parameter
from netpos.estimation.protection import (
    FusedEpoch,
    gaussian_radius,
    level_in,
    level_scratch,
    radius_limit,
)
from netpos.estimation.state import X
from netpos.messages.values import Array

_WINDOW, _TAIL = 50, 1e-3  # of ``NisWindow``
_BOUND = np.append(0.0, chdtri(np.arange(1.0, 64.0 * _WINDOW), _TAIL))


@kernel
def levels(epochs: Epochs, run: Run, motions: Array, bias: Array, options: FilterOptions) -> Array:
    """Protection levels [m] (N,) reported of the ``epochs`` of which ``components.run_epochs``
    made ``run``; every epoch has rows, its groups equally many.

    motions : (N, Parameter) of each epoch, or (1, Parameter) of all. Where part of the groups was
    refused, which ones is not known here, and the level of a manoeuvre takes them all.
    """
    risk, level = options.integrity_risk, run.radius.copy()
    if options.manoeuvre_speed_sd > 0.0:
        _allow_for_manoeuvres(epochs, run, motions, bias, options, level)
    optimism = _optimism(epochs, run, options)
    for k in range(level.size):
        cov = run.covs[k]
        xx, xy, yy = cov[X.PX, X.PX], cov[X.PX, X.PY], cov[X.PY, X.PY]
        if run.radius[k] > 0.0:
            level[k] = max(level[k], optimism[k] * run.radius[k])
        elif level[k] < optimism[k] * radius_limit(xx, xy, yy, risk):
            level[k] = max(level[k], optimism[k] * gaussian_radius(xx, xy, yy, risk))
    return level


@kernel
def _allow_for_manoeuvres(
    epochs: Epochs,
    run: Run,
    motions: Array,
    bias: Array,
    options: FilterOptions,
    level: Array,
) -> None:
    """Raise ``level`` (N,) to those of a manoeuvre nobody has noticed."""
    stamps_ns, row_start, rows = epochs
    means, covs, groups = run.means, run.covs, run.groups
    x, P, motion = means[0].copy(), covs[0].copy(), motions[0].copy()
    scratch = level_scratch(x.size, np.diff(row_start).max())
    heard_ns, accepted = stamps_ns[0], np.ones(GATE_SIZE)
    for k in range(level.size):
        if k > 0:
            dt = (stamps_ns[k] - stamps_ns[k - 1]) * 1e-9
            unheard_s = (stamps_ns[k] - heard_ns) * 1e-9
            x[:], P[:], motion[:] = means[k - 1], covs[k - 1], motions[min(k, len(motions) - 1)]
            motion[Parameter.VELOCITY_STEP_SD] = 0.0
            ekf.predict(x, P, dt, motion, bias)
            accepted[:] = 1.0 if groups[k] > 0 else 0.0
            own = rows[row_start[k] : row_start[k + 1]]
            epoch = FusedEpoch(x, P, own, accepted, unheard_s, means[k])
            unnoticed_m = level_in(epoch, options, scratch)
            if groups[k] == 0:
                unnoticed_m += options.manoeuvre_speed_sd * unheard_s
            level[k] = max(level[k], unnoticed_m)
        if groups[k] > 0:
            heard_ns = stamps_ns[k]


@kernel
def _optimism(epochs: Epochs, run: Run, options: FilterOptions) -> Array:
    """Factor on the sd (N,) of a ``NisWindow`` after each epoch."""
    row_start, count = epochs.row_start, run.nis.size
    factor, full_nis = np.ones(count), np.empty(count)
    sum_nis = sum_dof = 0.0
    for k in range(count):
        m = row_start[k + 1] - row_start[k]
        groups = int(epochs.rows[row_start[k + 1] - 1, GROUP]) + 1
        refused = options.gate_nis[min(m // groups, GATE_SIZE - 1)]
        full_nis[k] = run.nis[k] + (groups - run.groups[k]) * refused
        sum_nis, sum_dof = sum_nis + full_nis[k], sum_dof + m
        if k >= _WINDOW:
            old = k - _WINDOW
            sum_nis -= full_nis[old]
            sum_dof -= row_start[old + 1] - row_start[old]
        if sum_nis > _BOUND[int(sum_dof)]:
            factor[k] = math.sqrt(sum_nis / sum_dof)
    return factor
