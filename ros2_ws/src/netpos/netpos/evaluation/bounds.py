"""The posterior Cramér-Rao bound: the smallest error covariance any unbiased filter can reach.

With the process and measurement models at the true state, the Fisher information follows the
recursion of Tichavsky, Muravchik and Nehorai (IEEE Trans. Signal Processing 46, 1998, eq. 21)

    J' = (Q + F J^-1 F')^-1 + sum H' R^-1 H

which is the Riccati recursion of the extended Kalman filter linearised at the truth. The kernel
carries J^-1, so that a state nothing is known about needs no special case.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from netpos.estimation.compile import kernel
from netpos.estimation.forms import ekf
from netpos.estimation.measurement import VARIANCE, predict_row
from netpos.estimation.motion import NO_BIAS
from netpos.messages.values import Array

Stamps = npt.NDArray[np.int64]
NS = 1e9


@kernel
def bound_covariances(
    stamps_ns: Stamps,
    row_start: Stamps,
    rows: Array,
    truth: Array,
    prior_cov: Array,
    height_m: float,
    motions: Array,
    bias: Array,
) -> Array:
    """Bounds (N, n, n) after the rows of each of N epochs.

    stamps_ns : (N,) not decreasing; row_start : (N + 1,), rows[row_start[i] : row_start[i + 1]]
    belong to epoch i; rows : (M, ROW_WIDTH) with variances > 0; truth : (N, n) true states;
    prior_cov : (n, n) at the first stamp, before its rows; bias : as the filters take it
    motions : (1, Parameter), or (N, Parameter) where row i is that of the step to epoch i
    """
    count, n = truth.shape
    bounds = np.empty((count, n, n))
    cov = prior_cov.copy()
    mean, h, Ph = np.empty(n), np.empty(n), np.empty(n)
    for i in range(count):
        if i > 0:
            mean[:] = truth[i - 1]
            motion = motions[min(i, motions.shape[0] - 1)]
            ekf.predict(mean, cov, (stamps_ns[i] - stamps_ns[i - 1]) / NS, motion, bias)
        for k in range(row_start[i], row_start[i + 1]):
            predict_row(rows[k], truth[i], height_m, h)
            s = rows[k, VARIANCE]
            for a in range(n):
                Ph[a] = 0.0
                for b in range(n):
                    Ph[a] += cov[a, b] * h[b]
                s += h[a] * Ph[a]
            for a in range(n):
                for b in range(a, n):
                    cov[a, b] -= Ph[a] * Ph[b] / s
                    cov[b, a] = cov[a, b]
        bounds[i] = cov
    return bounds


def run_bound(
    stamps_ns: Stamps,
    row_start: Stamps,
    rows: Array,
    truth_ns: Stamps,
    truth_states: Array,
    prior_cov: Array,
    motions: Array,
    bias: Array = NO_BIAS,
    height_m: float = 0.0,
) -> Array:
    """Bounds (N, n, n) of a recorded run: ``bound_covariances`` at the truth interpolated
    linearly to the epochs.

    truth_ns : (T,) increasing; truth_states : (T, k) true states, k <= n; entries beyond k (clock,
    biases) enter no Jacobian of the measurements and count as 0

    Raises
    ------
    ValueError  an epoch lies outside the truth, the arrays do not fit together, a variance is not
        > 0
    """
    n = prior_cov.shape[0]
    if row_start.shape != (stamps_ns.size + 1,) or int(row_start[-1]) != len(rows):
        raise ValueError(
            f"row_start must have one entry more than the {stamps_ns.size} epochs and end at the "
            f"number of rows {len(rows)}, got {row_start.size} entries"
        )
    if not (np.diff(stamps_ns) >= 0).all():
        raise ValueError("the stamps of the epochs must not decrease; sort the epochs")
    if not (rows[:, VARIANCE] > 0).all():
        raise ValueError("every row needs a variance > 0")
    if stamps_ns.size and not (truth_ns[0] <= stamps_ns[0] and stamps_ns[-1] <= truth_ns[-1]):
        raise ValueError(
            f"epochs from {stamps_ns[0]} to {stamps_ns[-1]} ns reach beyond the truth, "
            f"{truth_ns[0]} to {truth_ns[-1]} ns; leave those outside out"
        )
    truth = np.zeros((stamps_ns.size, n))
    elapsed, known = stamps_ns - truth_ns[0], truth_ns - truth_ns[0]
    for column in range(truth_states.shape[1]):
        truth[:, column] = np.interp(elapsed, known, truth_states[:, column])
    bounds: Array = bound_covariances(
        stamps_ns, row_start, rows, truth, prior_cov, height_m, motions, bias
    )
    return bounds


def bound_rmse(bounds: Array) -> float:
    """Smallest root mean square position error [m] the bounds (N, n, n) allow."""
    return float(np.sqrt(np.mean(bounds[:, 0, 0] + bounds[:, 1, 1])))
