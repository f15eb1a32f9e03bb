"""Rauch-Tung-Striebel smoothing of what a filter stored.

All states have the length of the last one; where biases were appended on the way, the caller pads
the earlier means with 0 and covariances with the bias's prior variance. Process noise is the
model's: a covariance the filter inflated between two entries was inflated by nobody the smoother
knows, and only the filtered entries show it.
"""

from __future__ import annotations

import numpy as np

from netpos.estimation.compile import kernel
from netpos.estimation.factor import factor, solve_factored
from netpos.estimation.motion import noise, propagate, transition
from netpos.messages.values import Array


@kernel
def step_back(
    mean: Array, cov: Array, dt: float, motion: Array, bias: Array, later: Array, later_cov: Array
) -> None:
    """Smooth the filtered ``mean`` (n,), ``cov`` (n, n) in place by the smoothed state ``dt``
    seconds later.

    The covariance is (I - C F) P (I - C F)' + C (Q + P_later) C', equal to the textbook's
    P + C (P_later - P_predicted) C' and positive semidefinite for any gain C; what is predicted
    exactly (a singular covariance) teaches nothing.
    """
    n = mean.size
    F, Q = np.eye(n), np.zeros((n, n))
    predicted = mean.copy()
    if dt > 0.0:
        transition(mean, dt, motion, bias, F)
        propagate(predicted, dt, motion, bias)
        noise(predicted, dt, motion, bias, Q)
    FP = F @ cov
    Ct = FP.copy()
    solve_factored(factor(FP @ F.T + Q), Ct)
    C = np.ascontiguousarray(Ct.T)
    mean += C @ (later - predicted)
    A = np.eye(n) - C @ F
    smoothed = A @ cov @ A.T + C @ (Q + later_cov) @ Ct
    for a in range(n):
        for b in range(n):
            cov[a, b] = (smoothed[a, b] + smoothed[b, a]) / 2.0


@kernel
def rts(dts: Array, means: Array, covs: Array, motions: Array, bias: Array) -> tuple[Array, Array]:
    """Smoothed means (N, n) and covariances (N, n, n) of filtered ones, as new arrays.

    dts : (N - 1,) seconds from each entry to the next, >= 0
    motions : (N - 1, Parameter) of each step, or (1, Parameter) of all
    bias : (2, k) stationary sd and time constant of each bias state
    """
    means, covs = means.copy(), covs.copy()
    for k in range(dts.size - 1, -1, -1):
        motion = motions[min(k, motions.shape[0] - 1)]
        step_back(means[k], covs[k], dts[k], motion, bias, means[k + 1], covs[k + 1])
    return means, covs
