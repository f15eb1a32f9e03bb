"""Protection level: the radius round the estimate that holds the position error, and what widens
it.

The Gaussian part is exact (``protection_level``). What the covariance cannot know comes on top:
an optimistic filter (``noise_scale``) and a manoeuvre not yet noticed (``manoeuvre_level``).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from netpos.estimation.compile import kernel, leaf
from netpos.estimation.engine import FilterOptions
from netpos.estimation.factor import eigenvalues
from netpos.estimation.level.manoeuvre import add_manoeuvre
from netpos.estimation.measurement import (
    GROUP,
    VARIANCE,
    curvature_mean,
    curvature_variance,
    innovation_row,
    same_bend_variance,
)
from netpos.estimation.mixture.gaussians import Mixture
from netpos.estimation.state import X
from netpos.estimation.update.fusion import W_GAIN, fuse
from netpos.messages.values import Array

_ANGLES = 16
_COS2 = np.cos(np.linspace(0.0, np.pi / 2, _ANGLES + 1)) ** 2
_WEIGHT = np.append(np.append(0.5, np.ones(_ANGLES - 1)), 0.5) / _ANGLES
_ITERATIONS = 20
_NEGLIGIBLE = 40.0  # exponent of a term too small for the sum's digits
RISK_MIN, RISK_MAX = 1e-15, 0.5


@leaf
def gaussian_radius(xx: float, xy: float, yy: float, risk: float) -> float:
    """Radius r with P(|e| > r) = risk for e ~ N(0, [[xx, xy], [xy, yy]]); see
    ``protection_level``. Takes what it is given."""
    small, large = eigenvalues(xx, xy, yy)
    if large <= 0.0:
        return 0.0
    ratio = max(small, 0.0) / large
    log_risk = math.log(risk)
    circular = -2.0 * log_risk
    # Laplace's approximation of the mean over the angles: nearly there
    u = max(circular - math.log(1.0 + math.pi / 2.0 * circular * (1.0 - ratio)), 0.0)
    for _ in range(_ITERATIONS):
        total, slope = 0.0, 0.0
        least = max(u / (u + 2.0 * _NEGLIGIBLE), 1e-9)
        for i in range(_COS2.size):
            axis = _COS2[i] + ratio * (1.0 - _COS2[i])
            if axis < least:  # so are those that follow
                break
            term = _WEIGHT[i] * math.exp(-0.5 * u * (1.0 / axis - 1.0))
            total += term
            slope -= 0.5 * term / axis
        excess = math.log(total) - 0.5 * u - log_risk
        step = excess * total / slope
        u = max(u - step, 0.0)
        if abs(step) <= 1e-4 * u:  # the next one would be its square
            break
    return math.sqrt(u * large)


@leaf
def radius_limit(xx: float, xy: float, yy: float, risk: float) -> float:
    """What ``gaussian_radius`` never exceeds: the radius of a circular error that is everywhere as
    large as this one is along its longer axis."""
    _, large = eigenvalues(xx, xy, yy)
    return math.sqrt(-2.0 * math.log(risk) * max(large, 0.0))


def protection_level(cov2: Array, risk: float) -> float:
    """Radius [m] of the circle round the estimate that the position error leaves with probability
    ``risk``.

    cov2 : (2, 2) m^2, may be singular

    With whitened polar coordinates P(|e| > r) is the mean over phi of exp(-r^2 / 2 (a cos^2 phi +
    b sin^2 phi)), a and b the eigenvalues (for b = 0 Craig's form of the Gaussian tail): smooth
    and periodic, so that the trapezoidal rule on 17 angles of a quarter gives the radius to 1e-5,
    for risks below 0.01 to 1e-9. Its logarithm is convex in r^2: Newton's steps always converge.
    Between the limits sd isf(risk / 2) of an error along a line and sd sqrt(-2 ln risk) of a
    circular one; monotone in ``cov2`` and ``risk``.

    Raises ``ValueError`` for a covariance that is none or a risk outside [1e-15, 0.5].
    """
    if not RISK_MIN <= risk <= RISK_MAX:
        raise ValueError(f"risk must be in [{RISK_MIN:g}, {RISK_MAX:g}], got {risk!r}")
    radius: float = radius_of(cov2, risk)
    if math.isnan(radius):
        raise ValueError(f"cov2 must be a finite covariance, got {np.asarray(cov2).tolist()}")
    return radius


@leaf
def gaussian_tail(xx: float, xy: float, yy: float, radius: float) -> float:
    """P(|e| > radius) for e ~ N(0, [[xx, xy], [xy, yy]]): what ``gaussian_radius`` inverts."""
    small, large = eigenvalues(xx, xy, yy)
    if radius <= 0.0:
        return 1.0
    if large <= 0.0:
        return 0.0
    u, ratio, total = radius * radius / large, max(small, 0.0) / large, 0.0
    for i in range(_COS2.size):
        axis = _COS2[i] + ratio * (1.0 - _COS2[i])
        if axis > 0.0:
            total += _WEIGHT[i] * math.exp(-0.5 * u / axis)
    return total


@kernel
def mixture_radius(components: Mixture, centre: Array, risk: float) -> float:
    """Radius round the position of ``centre`` (n,) that a device with the mixture ``components``
    leaves with at most the probability ``risk``.

    Of a component at distance d at most the tail of its own error beyond radius - d lies outside.
    """
    means, covs, weights = components.means, components.covs, np.exp(components.log_weights)
    low, high = 0.0, 0.0
    away = np.hypot(means[:, X.PX] - centre[0], means[:, X.PY] - centre[1])
    for k in range(weights.size):
        P = covs[k]
        high = max(
            high, away[k] + gaussian_radius(P[X.PX, X.PX], P[X.PX, X.PY], P[X.PY, X.PY], risk)
        )
    while high - low > 1e-4 * high:
        middle = 0.5 * (low + high)
        outside = 0.0
        for k in range(weights.size):
            P = covs[k]
            tail = gaussian_tail(P[X.PX, X.PX], P[X.PX, X.PY], P[X.PY, X.PY], middle - away[k])
            outside += weights[k] * tail
        if outside > risk:
            low = middle
        else:
            high = middle
    return high


@leaf
def radius_of(cov2: Array, risk: float) -> float:
    """``gaussian_radius`` of cov2 (2, 2); not a number where it is no covariance."""
    xx, xy, yy = cov2[0, 0], cov2[0, 1], cov2[1, 1]
    if math.isfinite(xx + yy) and min(xx, yy) >= 0.0 and xy * xy <= xx * yy * (1.0 + 1e-9):
        return float(gaussian_radius(xx, xy, yy, risk))
    return math.nan


LevelScratch = tuple[Array, Array, Array, Array]


class FusedEpoch(NamedTuple):
    """An epoch that a filter has applied: prediction (n,), (n, n), rows (m, ROW_WIDTH), which
    groups it accepted, seconds since an accepted measurement before, posterior mean (n,)."""

    prior_mean: Array
    prior_cov: Array
    rows: Array
    accepted: Array
    unheard_s: float
    mean: Array


@kernel
def level_scratch(n: int, m: int) -> LevelScratch:
    """Memory of ``manoeuvre_level`` for ``n`` states and up to ``m`` rows."""
    vectors, covs = np.empty((4, max(n, m))), np.empty((2, n, n))
    return vectors, covs, np.empty((m, n)), np.empty((W_GAIN + 1, n))


@leaf
def manoeuvre_level(
    epoch: FusedEpoch, longest_s: float, options: FilterOptions, scratch: LevelScratch
) -> float:
    """Radius [m] round the posterior mean that a device leaves with probability ``integrity_risk``
    if it is in a manoeuvre nobody has noticed, which may take ``longest_s`` seconds
    (``detection_delay_s``).

    The accepted groups are applied once more to the prediction, which allows for a manoeuvre in
    that time: how far the two answers lie apart, and the level of the second (solution separation,
    as receiver autonomous integrity monitoring has it). inf where the time is.
    """
    prior_mean, prior_cov, rows, mean = epoch.prior_mean, epoch.prior_cov, epoch.rows, epoch.mean
    n, height_m, speed = mean.size, options.height_m, options.manoeuvre_speed_sd
    x, wide, P = scratch[0][0, :n], scratch[1][0], scratch[1][1]
    if math.isinf(longest_s):
        return math.inf
    for a in range(n):
        x[a] = mean[a]
        for b in range(n):
            wide[a, b] = prior_cov[a, b]
    add_manoeuvre(speed, max(epoch.unheard_s, longest_s), wide)
    apply_about(x, P, prior_mean, wide, rows, epoch.accepted, height_m, scratch)
    apart = math.hypot(x[X.PX] - mean[X.PX], x[X.PY] - mean[X.PY])
    return float(
        apart
        + gaussian_radius(P[X.PX, X.PX], P[X.PX, X.PY], P[X.PY, X.PY], options.integrity_risk)
    )


@leaf
def apply_about(
    x: Array,
    P: Array,
    prior_mean: Array,
    prior_cov: Array,
    rows: Array,
    accepted: Array,
    height_m: float,
    scratch: LevelScratch,
) -> None:
    """Apply the accepted groups of ``rows`` (m, ROW_WIDTH) to the prior (n,), (n, n), linearised
    at ``x`` (n,), an answer already known, and once more at what comes of it, with the curvature
    that is left. The posterior replaces ``x`` and fills ``P`` (n, n)."""
    n, m = x.size, rows.shape[0]
    vectors, _, H, work = scratch
    innovation, variance, use = vectors[1, :m], vectors[2, :m], vectors[3, :m]
    for again in range(2):
        for i in range(m):
            use[i] = accepted[int(rows[i, GROUP])]
            innovation[i] = innovation_row(rows[i], x, height_m, H[i])
            for a in range(n):
                innovation[i] += H[i, a] * (x[a] - prior_mean[a])
            variance[i] = rows[i, VARIANCE]
            if again:
                bent = curvature_variance(rows[i], x, P, height_m)
                variance[i] += same_bend_variance(rows[i], x, P, height_m, bent)
                innovation[i] -= curvature_mean(rows[i], x, P, height_m)
        for a in range(n):
            x[a] = prior_mean[a]
            for b in range(n):
                P[a, b] = prior_cov[a, b]
        fuse(x, P, innovation, H[:m], variance, use, work)
