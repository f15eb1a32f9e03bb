"""The heading of a device whose antenna is off its middle, from what RSUs measured of it."""

from __future__ import annotations

import math

import numpy as np

from netpos.estimation.measurement import BLOCKED, GROUP, HEADING, LEVER, VARIANCE, wrap
from netpos.estimation.rows import drop_biases
from netpos.estimation.update.fit import map_cost
from netpos.estimation.update.fusion import workspace
from netpos.estimation.update.iteration import iterate_from
from netpos.messages.values import Array

# Odds of another heading this much worse in cost (chi-square 0.99, 2 dof) rule it out.
_OTHER_COST = 9.21
_HEADINGS = 16
_HEADING_SD_MAX = 0.5


def with_heading(
    mean: Array, cov: Array, rows: Array, height_m: float
) -> tuple[Array, Array] | None:
    """A fix mean (6,), cov (6, 6) that ignored the lever arms of ``rows`` (m, ROW_WIDTH), and the
    heading they speak for: mean (7,), cov (7, 7); None where they leave it open."""
    levers = rows[rows[:, HEADING] >= 0, LEVER:BLOCKED]
    if not levers.any():
        return None
    rows = rows.copy()
    drop_biases(rows)
    rows[rows[:, HEADING] >= 0, HEADING] = 6
    rows[:, GROUP] = 0
    reach = 30.0 * float(np.hypot(levers[:, 0], levers[:, 1]).max())  # the fix tells no heading
    prior = np.zeros((7, 7))
    prior[:6, :6] = cov + reach**2 * np.diag([1.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    prior[6, 6] = math.pi**2
    variance, work = rows[:, VARIANCE].copy(), workspace(7, len(rows))
    candidates = []
    for k in range(_HEADINGS):
        start = np.append(mean, 2.0 * math.pi * k / _HEADINGS)
        x, P = iterate_from(start, start, prior, rows, variance, height_m, 30, work)
        candidates.append((map_cost(x, P, rows, variance, height_m, x), k, x, P))
    candidates.sort(key=lambda c: c[:2])
    cost, _, x, P = candidates[0]
    far = 5.0 * math.sqrt(P[6, 6])
    if P[6, 6] > _HEADING_SD_MAX**2 or any(
        c[0] < cost + _OTHER_COST and abs(wrap(c[2][6] - x[6])) > far for c in candidates
    ):
        return None
    x[6] = wrap(float(x[6]))
    return x, P
