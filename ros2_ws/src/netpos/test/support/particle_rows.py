"""What a particle filter is told, as rows, and how likely that is."""

from __future__ import annotations

import math
from enum import IntEnum

from numba import njit


class Kind(IntEnum):
    """What a row measures; ``a`` and ``b`` are its last two entries."""

    STATE = 0  # entry a of the state
    RANGE = 1  # distance from the origin
    LATE_RANGE = 2  # distance, with probability a plus an exponential excess of mean b
    BEARING = 3  # direction from the origin
    TOA = 4  # distance from the origin plus clock offset [m]
    PHASE = 5  # a times the cosine of the bearing against the direction b, modulo one turn
    FRONT = 6  # heard, which needs a place in front (direction a) of the origin


WIDTH = 7  # kind, value, sd, origin x, origin y, a, b


@njit(cache=True)
def _late_log_density(e, sd, share, excess):  # type: ignore[no-untyped-def]
    """Log density of noise of ``sd`` plus, with probability ``share``, an exponential excess,
    over what it never exceeds."""
    clear = math.exp(-0.5 * (e / sd) ** 2) / (sd * math.sqrt(2.0 * math.pi))
    u = (e / sd - sd / excess) / math.sqrt(2.0)
    exponent = 0.5 * (sd / excess) ** 2 - e / excess
    late = math.exp(exponent) * 0.5 * math.erfc(-u) / excess if u > -25.0 else 0.0
    total = (1.0 - share) * clear + share * late
    most = (1.0 - share) / (sd * math.sqrt(2.0 * math.pi)) + share / excess
    return math.log(total / most) if total > 0.0 else -math.inf


@njit(cache=True)
def _wrapped(angle):  # type: ignore[no-untyped-def]
    return angle - 2.0 * math.pi * math.floor(angle / (2.0 * math.pi) + 0.5)


@njit(cache=True)
def log_likelihood(row, x, y, vx, vy, offset, variance):  # type: ignore[no-untyped-def]
    """Log likelihood of a row, less a constant that leaves it at most 0, and its innovation."""
    kind, dx, dy = int(row[0]), x - row[3], y - row[4]
    if kind == 0:
        e = row[1] - (x, y, vx, vy)[int(row[5])]
    elif kind == 3:
        e = _wrapped(row[1] - math.atan2(dy, dx))
    elif kind == 5:
        r = max(math.sqrt(dx * dx + dy * dy), 1e-9)
        value = row[5] * (dx * math.cos(row[6]) + dy * math.sin(row[6])) / r
        e = _wrapped(row[1] - value)
    elif kind == 6:
        ahead = dx * math.cos(row[5]) + dy * math.sin(row[5])
        return (0.0 if ahead > 0.0 else -math.inf), 0.0
    else:
        e = row[1] - math.sqrt(dx * dx + dy * dy)
        if kind == 2:
            return _late_log_density(e, row[2], row[5], row[6]), e
        if kind == 4:
            e -= offset
    return -0.5 * e * e / variance, e
