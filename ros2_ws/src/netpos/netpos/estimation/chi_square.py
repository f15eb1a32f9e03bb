"""Bounds of chi-square variables with whole degrees of freedom (Abramowitz and Stegun 26.4.4 and
26.4.5).

SciPy has them; it would cost every node 6 MB and a tenth of its start.
"""

from __future__ import annotations

import math
from functools import lru_cache
from statistics import NormalDist

_STEPS = 100


@lru_cache(1024)
def chi_square_bound(dof: int, tail: float) -> float:
    """What a chi-square variable exceeds with probability ``tail``: inf for 0, 0 for 1.

    Raises ``ValueError`` for ``dof`` < 1 or a probability outside [0, 1].
    """
    if dof < 1:
        raise ValueError(f"dof must be >= 1, got {dof!r}")
    if not 0.0 <= tail <= 1.0:
        raise ValueError(f"tail must be a probability, got {tail!r}")
    if tail in (0.0, 1.0):
        return math.inf if tail == 0.0 else 0.0
    normal = NormalDist().inv_cdf(tail / 2.0 if dof == 1 else tail)
    if dof == 1:
        return normal * normal
    # Wilson and Hilferty, then Newton: log Q is concave, so that it ends up on the right side
    h = 2.0 / (9.0 * dof)
    y = max(dof / 2.0 * (1.0 - h - normal * math.sqrt(h)) ** 3, 1e-3)
    for _ in range(_STEPS):
        log_q, slope = log_survival(dof, y)
        step = (log_q - math.log(tail)) / slope
        y -= step if step < y else y / 2.0
        if abs(step) <= 1e-15 * y:
            break
    return 2.0 * y


def log_survival(dof: int, y: float) -> tuple[float, float]:
    """Logarithm of Q(dof / 2, y), the regularised upper incomplete gamma function, and its
    derivative; a finite sum for whole ``dof``. The probability that a chi-square variable exceeds
    2 y."""
    log_y = math.log(y)
    first = 0.5 if dof % 2 else 0.0
    terms = [
        math.exp(k * log_y - y - math.lgamma(k + 1.0))
        for k in (first + j for j in range(dof // 2))
    ]
    q = math.fsum(terms) + (math.erfc(math.sqrt(y)) if dof % 2 else 0.0)
    half = dof / 2.0
    density = math.exp((half - 1.0) * log_y - y - math.lgamma(half))
    return math.log(q), -density / q
