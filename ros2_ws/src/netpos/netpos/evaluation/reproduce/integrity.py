"""Protection levels of a whole run at once, as ``tracking.track`` reports them."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import chdtri

from netpos.filters import ekf
from netpos.filters.compile import kernel
from netpos.filters.measurement import GROUP
from netpos.filters.motion import Parameter
from netpos.messages.values import Array
from netpos.tracking.engine import GATE, GATE_SIZE, Option
from netpos.tracking.protection import gaussian_radius, manoeuvre_level, radius_limit

_WINDOW, _TAIL = 50, 1e-3  # of ``NisWindow``
_BOUND = np.append(0.0, chdtri(np.arange(1.0, 64.0 * _WINDOW), _TAIL))


@kernel
def protection_levels(
    stamps_ns: Array,
    row_start: Array,
    rows: Array,
    means: Array,
    covs: Array,
    nis: Array,
    dof: Array,
    taken: Array,
    motions: Array,
    bias: Array,
    options: Array,
    risk: float,
) -> Array:
    """Levels [m] of the epochs of ``engine.run_epochs``, (N,), inputs and results of which these
    are; every epoch has rows, its groups equally many.

    motions : (N, Parameter) of each epoch, or (1, Parameter) of all. Where part of the groups was
    refused, which ones is not known here, and the level of a manoeuvre takes them all.
    """
    count = means.shape[0]
    level = np.empty(count)
    full_nis, full_dof = np.empty(count), np.empty(count)
    sum_nis = sum_dof = 0.0
    heard_ns = stamps_ns[0]
    accepted = np.ones(GATE_SIZE)
    for k in range(count):
        own = rows[row_start[k] : row_start[k + 1]]
        m = own.shape[0]
        groups = int(own[m - 1, GROUP]) + 1
        size = m // groups
        full_nis[k] = nis[k] + (groups - taken[k]) * options[GATE + min(size, GATE_SIZE - 1)]
        full_dof[k] = m
        sum_nis, sum_dof = sum_nis + full_nis[k], sum_dof + full_dof[k]
        if k >= _WINDOW:
            sum_nis, sum_dof = sum_nis - full_nis[k - _WINDOW], sum_dof - full_dof[k - _WINDOW]
        cov = covs[k]
        optimism = math.sqrt(sum_nis / sum_dof) if sum_nis > _BOUND[int(sum_dof)] else 1.0
        level[k] = 0.0
        if options[Option.MANOEUVRE_SPEED] > 0.0 and k > 0:
            unheard_s = (stamps_ns[k] - heard_ns) * 1e-9
            x, P = means[k - 1].copy(), covs[k - 1].copy()
            motion = motions[min(k, motions.shape[0] - 1)].copy()
            motion[Parameter.JUMP_SPEED] = 0.0
            ekf.predict(x, P, (stamps_ns[k] - stamps_ns[k - 1]) * 1e-9, motion, bias)
            accepted[:] = 1.0 if taken[k] > 0 else 0.0
            level[k] = manoeuvre_level(x, P, own, accepted, unheard_s, means[k], options, risk)
            if taken[k] == 0:
                level[k] += options[Option.MANOEUVRE_SPEED] * unheard_s
        if level[k] < optimism * radius_limit(cov[0, 0], cov[0, 1], cov[1, 1], risk):
            radius = gaussian_radius(cov[0, 0], cov[0, 1], cov[1, 1], risk)
            level[k] = max(level[k], optimism * radius)
        if taken[k] > 0:
            heard_ns = stamps_ns[k]
    return level
