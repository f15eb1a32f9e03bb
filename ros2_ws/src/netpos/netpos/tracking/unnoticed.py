"""How far a device may be in a manoeuvre that no single epoch would show.

One range, or one angle, says nothing across its line: a turn along it stays unnoticed for ever.
RSUs that are heard one after the other see all directions between them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from netpos.estimation.engine import FilterOptions
from netpos.estimation.measurement import GATE_VARIANCE
from netpos.estimation.predicted import predicted_rows
from netpos.estimation.protection import radius_of
from netpos.estimation.state import POSITION
from netpos.messages.values import Array

_BLIND = 1e-12  # share of the information along the line they see best


def level_of_epochs(
    recent: Sequence[tuple[int, Array]],
    stamp_ns: int,
    prediction: tuple[Array, Array],
    cov: Array,
    options: FilterOptions,
) -> float:
    """Radius [m] as ``manoeuvre_level``, of the newest epochs together: as few as see every
    direction, inf where all do not, or there is no gate.

    recent : stamps and rows (m, ROW_WIDTH), oldest first, the newest of ``stamp_ns``
    prediction : mean (n,) and covariance (n, n) at ``stamp_ns``; cov : (n, n) after it

    Each epoch has a gate of its own. Of k epochs the one that sees a direction best has at least
    the k-th part of what they know of it together, and may be the oldest: a step of the velocity
    goes unnoticed for at most sqrt(k) times as long as one epoch with all rows would let it, and
    the age of the oldest. What it does to the position is added to ``cov``.
    """
    gate = float(options.gate_nis[2])
    if math.isinf(gate):
        return math.inf
    mean, prior_cov = prediction
    information = np.zeros((2, 2))
    for k, (then_ns, rows) in enumerate(reversed(recent), start=1):
        information += _information(mean, prior_cov, rows, options.height_m)
        least, most = np.linalg.eigvalsh(information)
        if least <= _BLIND * most:
            continue
        speed = options.manoeuvre_speed_sd
        longest_s = math.sqrt(k * gate / least) / speed
        within_s = longest_s + 1e-9 * (stamp_ns - then_ns)
        moved2 = (speed * within_s) ** 2 / 3.0  # a step at any time in it
        return float(
            radius_of(cov[POSITION, POSITION] + moved2 * np.eye(2), options.integrity_risk)
        )
    return math.inf


def _information(mean: Array, cov: Array, rows: Array, height_m: float) -> Array:
    """Of rows (m, ROW_WIDTH) about the position of mean (n,) (2, 2)."""
    predicted = predicted_rows(mean, cov, rows, height_m)
    variance = rows[:, GATE_VARIANCE] + predicted.prior_var + predicted.second_order_var
    slopes = predicted.H[:, POSITION] / np.sqrt(variance)[:, np.newaxis]
    information: Array = slopes.T @ slopes
    return information
