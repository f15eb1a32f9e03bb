"""What ``tracking.track`` reports of a whole run, at once: estimates or their hypotheses, and
protection levels."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import chdtri

from netpos.filters import ekf
from netpos.filters.compile import kernel
from netpos.filters.measurement import GROUP
from netpos.filters.motion import Parameter
from netpos.filters.state import X
from netpos.messages.values import Array
from netpos.tracking.engine import GATE_SIZE, Epochs, FilterOptions, Run
from netpos.tracking.manoeuvre_hypotheses import (
    SELECTED,
    hypothesis_level,
    is_needed,
    no_hypotheses,
)
from netpos.tracking.protection import (
    FusedEpoch,
    gaussian_radius,
    level_in,
    level_scratch,
    radius_limit,
)

_WINDOW, _TAIL = 50, 1e-3  # of ``NisWindow``
_BOUND = np.append(0.0, chdtri(np.arange(1.0, 64.0 * _WINDOW), _TAIL))


@kernel
def reported(
    epochs: Epochs, run: Run, motions: Array, bias: Array, options: FilterOptions
) -> tuple[Array, Array, Array]:
    """Means (N, n), covariances (N, n, n) and levels [m] (N,) reported of the ``epochs``
    of which ``engine.run_epochs`` made ``run``; every epoch has rows, its groups equally many.

    motions : (N, Parameter) of each epoch, or (1, Parameter) of all. Where part of the groups was
    refused, which ones is not known here, and the level of a manoeuvre takes them all.
    """
    means, covs, risk = run.means, run.covs, options.integrity_risk
    level = np.zeros(means.shape[0])
    if options.manoeuvre_speed_sd > 0.0:
        means, covs = _allow_for_manoeuvres(epochs, run, motions, bias, options, level)
    optimism = _optimism(epochs, run, options)
    for k in range(level.size):
        xx, xy, yy = covs[k, X.PX, X.PX], covs[k, X.PX, X.PY], covs[k, X.PY, X.PY]
        if level[k] < optimism[k] * radius_limit(xx, xy, yy, risk):
            level[k] = max(level[k], optimism[k] * gaussian_radius(xx, xy, yy, risk))
    return means, covs, level


@kernel
def _allow_for_manoeuvres(
    epochs: Epochs,
    run: Run,
    motions: Array,
    bias: Array,
    options: FilterOptions,
    level: Array,
) -> tuple[Array, Array]:
    """Fill ``level`` (N,) with those of a manoeuvre nobody has noticed, hypotheses of the estimate
    included; means and covariances reported."""
    stamps_ns, row_start, rows = epochs
    means, covs, nis, dof, groups = run
    told_means, told_covs, led = means, covs, False
    x, P, motion = means[0].copy(), covs[0].copy(), motions[0].copy()
    scratch = level_scratch(x.size, np.diff(row_start).max())
    heard_ns, accepted = stamps_ns[0], np.ones(GATE_SIZE)
    hypotheses = no_hypotheses(x.size, stamps_ns[0])
    for k in range(level.size):
        if k > 0:
            dt = (stamps_ns[k] - stamps_ns[k - 1]) * 1e-9
            unheard_s = (stamps_ns[k] - heard_ns) * 1e-9
            x[:], P[:], motion[:] = means[k - 1], covs[k - 1], motions[min(k, len(motions) - 1)]
            motion[Parameter.VELOCITY_STEP_SD] = 0.0
            ekf.predict(x, P, dt, motion, bias)
            accepted[:] = 1.0 if groups[k] > 0 else 0.0
            own = rows[row_start[k] : row_start[k + 1]]
            epoch = FusedEpoch(x, P, own, accepted, unheard_s, means[k], nis[k], int(dof[k]))
            level[k] = level_in(epoch, options, scratch)
            if is_needed(stamps_ns[k], epoch, hypotheses):
                level[k] = hypothesis_level(
                    level[k], stamps_ns[k], dt, epoch, motion, bias, options, hypotheses
                )
                selected = hypotheses.marks[SELECTED]
                if selected >= 0:
                    if not led:
                        told_means, told_covs, led = means.copy(), covs.copy(), True
                    told_means[k] = hypotheses.means[selected]
                    told_covs[k] = hypotheses.covs[selected]
            if groups[k] == 0:
                level[k] += options.manoeuvre_speed_sd * unheard_s
        if groups[k] > 0:
            heard_ns = stamps_ns[k]
    return told_means, told_covs


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
