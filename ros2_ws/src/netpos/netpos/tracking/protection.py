"""Protection level: the radius round the estimate that holds the position error, and what widens
it.

The Gaussian part is exact (``protection_level``). What the covariance cannot know comes on top:
an optimistic filter (``NisWindow``) and a single RSU that is wrong but not refused
(``bias_shift``, ``faulted_level``).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from scipy.special import chdtri

from netpos.filters.compile import kernel, leaf
from netpos.filters.measurement import GATE_VARIANCE, curvature_variance, innovation_row
from netpos.messages.values import Array

_ANGLES = 16
_COS2 = np.cos(np.linspace(0.0, np.pi / 2, _ANGLES + 1)) ** 2
_WEIGHT = np.append(np.append(0.5, np.ones(_ANGLES - 1)), 0.5) / _ANGLES
_ITERATIONS = 20
RISK_MIN, RISK_MAX = 1e-15, 0.5


@leaf
def gaussian_radius(xx: float, xy: float, yy: float, risk: float) -> float:
    """Radius r with P(|e| > r) = risk for e ~ N(0, [[xx, xy], [xy, yy]]); see
    ``protection_level``. Takes what it is given."""
    centre, spread = (xx + yy) / 2.0, math.hypot((xx - yy) / 2.0, xy)
    large = centre + spread
    if large <= 0.0:
        return 0.0
    ratio = max(centre - spread, 0.0) / large
    log_risk = math.log(risk)
    u = -2.0 * log_risk  # of a circular error: an upper bound
    for _ in range(_ITERATIONS):
        total, slope = 0.0, 0.0
        for i in range(_COS2.size):
            axis = _COS2[i] + ratio * (1.0 - _COS2[i])
            if axis < 1e-9:
                continue
            term = _WEIGHT[i] * math.exp(-0.5 * u * (1.0 / axis - 1.0))
            total += term
            slope -= 0.5 * term / axis
        excess = math.log(total) - 0.5 * u - log_risk
        step = excess * total / slope
        u = max(u - step, 0.0)
        if abs(step) <= 1e-11 * u:
            break
    return math.sqrt(u * large)


def protection_level(cov2: Array, risk: float, inflation: float = 1.0) -> float:
    """Radius [m] of the circle round the estimate that the position error leaves with probability
    ``risk``.

    cov2 : (2, 2) m^2, may be singular; inflation : factor on the sd

    With whitened polar coordinates P(|e| > r) is the mean over phi of exp(-r^2 / 2 (a cos^2 phi +
    b sin^2 phi)), a and b the eigenvalues (for b = 0 Craig's form of the Gaussian tail): smooth
    and periodic, so that the trapezoidal rule on 17 angles of a quarter gives the radius to 1e-5,
    for risks below 0.01 to 1e-9. Its logarithm is convex in r^2: Newton's steps always converge.
    Between the limits sd isf(risk / 2) of an error along a line and sd sqrt(-2 ln risk) of a
    circular one; monotone in ``cov2`` and ``risk``.

    Raises ``ValueError`` for a covariance that is none, a risk outside [1e-15, 0.5], an inflation
    below 1.
    """
    xx, xy, yy = float(cov2[0, 0]), float(cov2[0, 1]), float(cov2[1, 1])
    if not (math.isfinite(xx + yy) and min(xx, yy) >= 0.0 and xy * xy <= xx * yy * (1.0 + 1e-9)):
        raise ValueError(f"cov2 must be a finite covariance, got {np.asarray(cov2).tolist()}")
    if not RISK_MIN <= risk <= RISK_MAX:
        raise ValueError(f"risk must be in [{RISK_MIN:g}, {RISK_MAX:g}], got {risk!r}")
    if not 1.0 <= inflation < math.inf:
        raise ValueError(f"inflation must be finite and >= 1, got {inflation!r}")
    return inflation * float(gaussian_radius(xx, xy, yy, risk))


@lru_cache(1024)
def _bound(dof: int, tail: float) -> float:
    return float(chdtri(dof, tail))


class NisWindow:
    """Factor on the sd from the NIS of the last epochs.

    While their sum is below its chi-square bound the covariance stands and the factor is 1. Above
    it the covariance is called too small, and the factor is sqrt(sum of NIS / sum of dof), the
    scale factor of Birge (1932) as used by the Particle Data Group. The NIS of accepted groups is
    cut off by the gate: pass the NIS of all groups, refused ones capped at the gate's threshold,
    or the factor sees nothing of what matters.
    """

    def __init__(self, epochs: int = 50, confidence: float = 0.999) -> None:
        if epochs < 1:
            raise ValueError(f"epochs must be >= 1, got {epochs}")
        if not 0.5 <= confidence < 1.0:
            raise ValueError(f"confidence must be in [0.5, 1), got {confidence}")
        self._tail = 1.0 - confidence
        self._window: deque[tuple[float, int]] = deque(maxlen=epochs)

    def add(self, nis: float, dof: int) -> None:
        """Take the NIS of one epoch; one without measurements (``dof`` 0) says nothing."""
        if dof > 0:
            self._window.append((nis, dof))

    def inflation(self) -> float:
        """Factor on the sd, >= 1."""
        dof = sum([d for _, d in self._window])
        nis = math.fsum([n for n, _ in self._window])
        if dof == 0 or nis <= _bound(dof, self._tail):
            return 1.0
        return math.sqrt(nis / dof)

    def copy(self) -> NisWindow:
        """An independent copy: a track that goes back in time goes back to it."""
        twin = NisWindow.__new__(NisWindow)
        twin._tail = self._tail
        twin._window = self._window.copy()
        return twin


@kernel
def unnoticed_shift(mean: Array, cov: Array, rows: Array, height_m: float, gate: float) -> float:
    """Largest distance [m] the device may have moved off the prediction mean (n,), cov (n, n)
    while its measurements rows (m, ROW_WIDTH) still pass ``gate``, the threshold of the squared
    Mahalanobis distance: what a manoeuvre does before it is noticed. inf where they leave a
    direction open."""
    xx = xy = yy = 0.0
    h = np.empty(mean.size)
    for i in range(rows.shape[0]):
        innovation_row(rows[i], mean, height_m, h)
        variance = rows[i, GATE_VARIANCE] + curvature_variance(rows[i], mean, cov, height_m)
        for a in range(mean.size):
            for b in range(mean.size):
                variance += h[a] * cov[a, b] * h[b]
        xx += h[0] * h[0] / variance
        xy += h[0] * h[1] / variance
        yy += h[1] * h[1] / variance
    least = (xx + yy) / 2.0 - math.hypot((xx - yy) / 2.0, xy)
    return math.sqrt(gate / least) if least > 0.0 else math.inf


@kernel
def bias_shift(
    cov_prior: Array, H_group: Array, variance_group: Array, gate: float, cov_fused: Array
) -> float:
    """Largest shift of the position [m] by a bias of one RSU that its gate would still pass.

    cov_prior : (n, n) the gate sees; H_group : (m, n); variance_group : (m,); gate : threshold T
    of the squared Mahalanobis distance; cov_fused : (n, n) the group is fused into, that is after
    all others of the epoch (``cov_prior`` where it is alone)

    The slope of receiver autonomous integrity monitoring (Brown 1992; Walter and Enge 1995): the
    bias b with b' S^-1 b <= T, S of the prior, that moves the position K b furthest; sqrt(T) times
    the largest singular value of K_xy S^(1/2). For a group that is alone that is sqrt(T) times the
    root of the largest eigenvalue of what its update takes off the position covariance.

    To be added to a protection level only together with a probability (``faulted_level``): alone
    it answers "how bad at worst", and every healthy track would carry some sqrt(T) = 4 sd of it.
    It is the shift of one epoch: a bias that grows slowly moves the track along, passes every gate
    and adds up. That is what the comparison of RSUs over time is for, not this bound. It also
    takes the noise of the faulty group as 0: half of the biases on the bound are refused.
    inf without a gate.
    """
    m, n = H_group.shape
    S_gate = _innovation_cov(cov_prior, H_group, variance_group)
    S = _innovation_cov(cov_fused, H_group, variance_group)
    K = np.zeros((m, 2))  # transposed: S K = H P_xy by elimination, S being positive definite
    for i in range(m):
        for p in range(2):
            for a in range(n):
                K[i, p] += H_group[i, a] * cov_fused[a, p]
    for i in range(m):
        for j in range(i + 1, m):
            factor = S[j, i] / S[i, i]
            for k in range(m):
                S[j, k] -= factor * S[i, k]
            for p in range(2):
                K[j, p] -= factor * K[i, p]
    for i in range(m - 1, -1, -1):
        for p in range(2):
            for j in range(i + 1, m):
                K[i, p] -= S[i, j] * K[j, p]
            K[i, p] /= S[i, i]
    xx = xy = yy = 0.0
    for i in range(m):
        for j in range(m):
            xx += K[i, 0] * S_gate[i, j] * K[j, 0]
            xy += K[i, 0] * S_gate[i, j] * K[j, 1]
            yy += K[i, 1] * S_gate[i, j] * K[j, 1]
    return math.sqrt(gate * ((xx + yy) / 2.0 + math.hypot((xx - yy) / 2.0, xy)))


@kernel
def _innovation_cov(cov: Array, H: Array, variance: Array) -> Array:
    """H cov H' + diag(variance), (m, m)."""
    m, n = H.shape
    S = np.zeros((m, m))
    for i in range(m):
        S[i, i] = variance[i]
        for j in range(m):
            for a in range(n):
                for b in range(n):
                    S[i, j] += H[i, a] * cov[a, b] * H[j, b]
    return S


def faulted_level(
    cov2: Array,
    risk: float,
    shifts: Sequence[float],
    fault_probability: float,
    inflation: float = 1.0,
) -> float:
    """Protection level [m] that also holds when one RSU is wrong by what its gate passes.

    shifts : m, ``bias_shift`` of each RSU fused; fault_probability : that a given RSU is wrong

    The risk is split as in advanced RAIM (Blanch et al. 2012): half to the fault-free case, half
    evenly to the faults, each of which may then leave its share with the probability risk / (2 n
    fault_probability), and the error of a shifted estimate exceeds r no more often than that of
    the true one exceeds r - shift. Faults less probable than their share cost nothing. Two faults
    at once are not covered.
    """
    if not 0.0 <= fault_probability <= 1.0:
        raise ValueError(f"fault_probability must be in [0, 1], got {fault_probability!r}")
    if not shifts or fault_probability == 0.0:
        return protection_level(cov2, risk, inflation)
    level = protection_level(cov2, max(risk / 2.0, RISK_MIN), inflation)
    share = risk / (2.0 * len(shifts) * fault_probability)
    if share >= 1.0:
        return level
    share = min(max(share, RISK_MIN), RISK_MAX)
    return max(level, max(shifts) + protection_level(cov2, share, inflation))
