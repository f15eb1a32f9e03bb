"""A bearing under a prior about as wide as the RSU is far, by its moments.

Linearised, such a bearing pulls a device behind the RSU on top of it, where no bearing means
anything, and leaves it there. In coordinates along (r) and across (c) the bearing, the prior is
N(r) N(c | r) and the posterior

    p(r, c) ~ N(r; a, P_rr) N(c; m(r), v) N(c / r; 0, sigma^2),  r > 0,

is normal in c given r; what is left is a quadrature over r. The rest of the state follows the
position linearly.

The moments of one bearing are exact, but the next one cuts the normal prior made of them at the
RSU again, and the next: the same news each time. Counted again and again it puts a device on top
of the RSU, sure to a millimetre, whatever the bearings say.
"""

from __future__ import annotations

import math

import numpy as np

from netpos.estimation.compile import kernel, leaf
from netpos.estimation.measurement import (
    AXES,
    BIAS,
    COMMON,
    HEADING,
    KIND,
    ORIGIN,
    VALUE,
    VARIANCE,
    Kind,
    curvature_mean,
    curvature_variance,
    linearise,
    same_bend_variance,
)
from netpos.estimation.state import POSITION, X
from netpos.estimation.update.fusion import W_COV, W_PRIOR, W_USE, fuse
from netpos.messages.values import Array

_NODES = 64
_REACH_SD = 6.0
_RESOLVED = 0.04  # sd over the width of the quadrature
_ZOOMS = 8


@leaf
def is_plain_bearing(row: Array) -> bool:
    """Whether the row is an azimuth in upright axes, without biases and lever arm's heading."""
    return (
        int(row[KIND]) == Kind.AZIMUTH
        and row[AXES + 8] > 1.0 - 1e-12
        and row[BIAS] < 0.0
        and row[COMMON] < 0.0
        and row[HEADING] < 0.0
    )


@leaf
def _moments(
    low: float,
    high: float,
    prior: tuple[float, float, float, float, float, float],
    variance: float,
) -> tuple[float, float, float, float, float]:
    """Mean of (r, c) and their covariance (rr, rc, cc) over ``low`` < r < ``high``; prior: mean a,
    variance P_rr, and of c given r mean m(a), its slope, variance v + w r^2."""
    a, rr, m_a, slope, v_0, wedge = prior
    top = -math.inf
    for scan in range(2):  # the largest weight first, then the sums
        total = sr = sc = srr = src = scc = 0.0
        for k in range(_NODES):
            r = low + (k + 0.5) * (high - low) / _NODES
            noise, v = r * r * variance, v_0 + wedge * r * r
            m, s = m_a + slope * (r - a), v + noise
            log_weight = math.log(r) - 0.5 * ((r - a) ** 2 / rr + m * m / s + math.log(s))
            if scan == 0:
                top = max(top, log_weight)
                continue
            weight = math.exp(log_weight - top)
            c = m * noise / s
            total += weight
            sr += weight * r
            sc += weight * c
            srr += weight * r * r
            src += weight * r * c
            scc += weight * (c * c + v * noise / s)
    r, c = sr / total, sc / total
    return r, c, srr / total - r * r, src / total - r * c, scc / total - c * c


@kernel
def fuse_bearing(mean: Array, cov: Array, row: Array, variance: float) -> bool:
    """Fuse a plain bearing with ``variance`` [rad^2] into mean (n,) and cov (n, n) in place;
    False, and nothing done, where the prior is degenerate.

    As far as the prior is a strip along the bearing already, by those before, it is taken for the
    wedge they left, and the range keeps its second moment about the prior's mean, as if what lies
    behind the RSU were folded to its front: the bearing tells the side once more, and no distance.
    """
    angle = row[VALUE] + math.atan2(row[AXES + 1], row[AXES])
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    rsu = row[ORIGIN : ORIGIN + 2]
    P = turn.T @ cov[POSITION, POSITION].copy() @ turn
    a = turn.T @ (mean[POSITION] - rsu)
    rr, slope = P[0, 0], P[0, 1] / P[0, 0]
    v = P[1, 1] - slope * P[0, 1]
    if not (rr > 0.0 and v > 0.0):
        return False
    reach = _REACH_SD * math.sqrt(rr)
    # Behind the RSU the prior falls off like exp(a r / P_rr).
    low, high = max(a[0] - reach, 0.0), a[0] + reach if a[0] > 0.0 else reach - 0.5 * a[0]
    strip = max(1.0 - P[1, 1] / rr, 0.0)
    prior = (a[0], rr, a[1], slope, (1.0 - strip) * v, strip * v / (a[0] * a[0] + rr))
    for _ in range(_ZOOMS):
        r, c, c_rr, c_rc, c_cc = _moments(low, high, prior, variance)
        sd = math.sqrt(max(c_rr, 0.0))
        if sd > _RESOLVED * (high - low):
            break
        width = max(_REACH_SD * sd, (high - low) / _NODES)
        low, high = max(r - width, 0.0), r + width
    c_rr += strip * (r - a[0]) ** 2
    C = np.array([[c_rr, c_rc], [c_rc, c_cc]])
    prior_2d = cov[POSITION, POSITION].copy()
    gain = np.linalg.solve(prior_2d, cov[POSITION].copy()).T.copy()
    cov += gain @ (turn @ C @ turn.T - prior_2d) @ gain.T
    mean += gain @ (rsu + turn @ np.array([r, c]) - mean[POSITION])
    return True


@leaf
def on_top(mean: Array, cov: Array, rows: Array, work: Array) -> bool:
    """Whether ``mean`` lies nearer to the RSU of a bearing used than two of its own sd."""
    for i in range(rows.shape[0]):
        if work[W_USE, i] == 0.0 or not is_plain_bearing(rows[i]):
            continue
        dx, dy = mean[X.PX] - rows[i, ORIGIN], mean[X.PY] - rows[i, ORIGIN + 1]
        if dx * dx + dy * dy < 4.0 * (cov[X.PX, X.PX] + cov[X.PY, X.PY]):
            return True
    return False


@kernel
def fuse_around(mean: Array, cov: Array, rows: Array, height_m: float, work: Array) -> None:
    """Update again from the prior kept in the workspace, the bearings used by their moments, the
    other rows used linearised at the result."""
    n, m = mean.size, rows.shape[0]
    mean[:] = work[W_PRIOR, :n]
    cov[:] = work[W_COV : W_COV + n, :n]
    use = work[W_USE, :m].copy()
    for i in range(m):
        wanted = use[i] == 1.0 and is_plain_bearing(rows[i])
        if wanted and fuse_bearing(mean, cov, rows[i], rows[i, VARIANCE]):
            use[i] = 0.0
    innovation, H = linearise(rows, mean, height_m)
    variance = rows[:, VARIANCE].copy()
    for i in range(m):
        bent = curvature_variance(rows[i], mean, cov, height_m)
        variance[i] += same_bend_variance(rows[i], mean, cov, height_m, bent)
        innovation[i] -= curvature_mean(rows[i], mean, cov, height_m)
    fuse(mean, cov, innovation, H, variance, use, work)
