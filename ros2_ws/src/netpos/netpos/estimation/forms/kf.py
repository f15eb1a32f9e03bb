"""Linear Kalman filter for ``LINEAR`` rows, with an optional floor under its gain. In place;
prediction is ``ekf.predict``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from netpos.common.parameters import real
from netpos.estimation.compile import kernel, spliced
from netpos.estimation.factor import factor
from netpos.estimation.forms import ekf
from netpos.estimation.forms.form import FilterForm
from netpos.estimation.measurement import GATE_VARIANCE, GROUP, KIND, VARIANCE, Kind
from netpos.estimation.state import X
from netpos.estimation.update.fusion import predicted_in
from netpos.estimation.update.gate import gate_groups, select_rows
from netpos.estimation.update.predicted import PredictedRows, predicted_rows
from netpos.messages.values import Array

if TYPE_CHECKING:
    from netpos.estimation.engine import FilterOptions

NO_FLOOR = np.zeros(3)
NOTHING = np.empty((0, 0))
# Position, velocity [1/s], acceleration [1/s^2]: dvornikov2017, section on the simulation.
DVORNIKOV_FLOOR = np.array([0.0926, 0.008, 0.0003])


@kernel
def update(
    mean: Array,
    cov: Array,
    rows: Array,
    height_m: float,
    gate_nis: Array,
    accepted: Array,
    gain_floor: Array,
    own: Array,
) -> tuple[float, int]:
    """One epoch, in place: gate each group as a whole and all together, fuse what passed row by
    row.

    A group that holds a row other than ``LINEAR`` is rejected. Nothing changes where nothing
    passes.

    rows : (m, ROW_WIDTH), rows of a group adjacent
    gate_nis : (d + 1,) largest accepted squared Mahalanobis distance for d degrees of freedom
    accepted : (groups,), filled with 0 or 1
    gain_floor : (3,) smallest gain from a position to the position, velocity and acceleration of
        its axis, per metre; 0: none. The third is for CONSTANT_ACCELERATION only.
    own : (n, n), or ``NOTHING``: the part of ``cov`` that the noise of these rows and those before
        made. What else is in ``cov`` comes from the motion and the start, which others who watch
        the same object share.

    Returns the NIS of the accepted rows together, with their gate variances, and their number.
    """
    predicted = predicted_rows(mean, cov, rows, height_m)
    nis, used = _update_predicted(mean, cov, rows, predicted, gate_nis, accepted, gain_floor, own)
    return nis, used


@kernel
def _update_predicted(
    mean: Array,
    cov: Array,
    rows: Array,
    predicted: PredictedRows,
    gate_nis: Array,
    accepted: Array,
    gain_floor: Array,
    own: Array,
) -> tuple[float, int]:
    """``update`` with the rows ``predicted``."""
    m, n = rows.shape[0], mean.size
    innovation, H = predicted.innovation[:m].copy(), predicted.H[:, :n].copy()
    S = H @ predicted.HP[:, :n].copy().T
    for i in range(m):
        S[i, i] += rows[i, GATE_VARIANCE]
    gate_groups(rows, innovation, S, gate_nis, accepted)
    for i in range(m):
        if int(rows[i, KIND]) != Kind.LINEAR:
            accepted[int(rows[i, GROUP])] = 0.0
    index, nis = select_rows(rows, innovation, S, gate_nis, accepted)
    if index.size == 0:
        return 0.0, 0
    start = mean.copy()
    for i in index:
        residual = innovation[i] - np.dot(H[i], mean - start)
        fuse_row(mean, cov, residual, H[i], rows[i, VARIANCE], gain_floor, own)
    return nis, index.size


@kernel
def fuse_row(
    mean: Array,
    cov: Array,
    residual: float,
    h: Array,
    variance: float,
    gain_floor: Array,
    own: Array,
) -> None:
    """Fuse one row with the Kalman gain or its floor: (I - K h) P (I - K h)' + K r K', true for
    any gain, as a sum of squares; the same for the share ``own`` of P where there is one."""
    n = mean.size
    Ph = cov @ h
    K = Ph / (np.dot(h, Ph) + variance)
    _raise_gain(K, h, gain_floor)
    A = np.eye(n)
    for a in range(n):
        mean[a] += K[a] * residual
        for b in range(n):
            A[a, b] -= K[a] * h[b]
    root = A @ factor(cov)
    for a in range(n):
        for b in range(a + 1):
            cov[a, b] = cov[b, a] = np.dot(root[a], root[b]) + K[a] * variance * K[b]
    if own.size == 0:
        return
    root = A @ factor(own)
    for a in range(n):
        for b in range(a + 1):
            own[a, b] = own[b, a] = np.dot(root[a], root[b]) + K[a] * variance * K[b]


@kernel
def _raise_gain(K: Array, h: Array, gain_floor: Array) -> None:
    """Raise the gains of one axis to their floors where ``h`` (n,) measures one position alone."""
    axis = -1
    for i in range(h.size):
        if h[i] != 0.0:
            if axis >= 0 or i > X.PY:
                return
            axis = i
    if axis < 0:
        return
    for order in range(3):
        i = (X.PX, X.VX, X.AX)[order] + axis
        if i < h.size and gain_floor[order] > 0.0 and K[i] * h[axis] < gain_floor[order]:
            K[i] = gain_floor[order] / h[axis]


@spliced
def _update_form(
    mean: Array,
    cov: Array,
    rows: Array,
    options: FilterOptions,
    gate_nis: Array,
    accepted: Array,
    work: Array,
) -> tuple[float, int]:
    predicted = predicted_in(work, mean.size, rows.shape[0])
    floor, own = options.of_form, work[:0]
    nis, used = _update_predicted(mean, cov, rows, predicted, gate_nis, accepted, floor, own)
    return nis, used


FORM = FilterForm(
    name="kf",
    predict=ekf.predict,
    update=_update_form,
    update_shared=update,
    summary="linear: position fixes and velocities only",
    parameters={
        "position_gain_min": real(
            0.0, 0.0, 1.0, "kf: floor of the position gain (dvornikov2017: 0.0926)"
        ),
        "velocity_gain_min": real(
            0.0, 0.0, 10.0, "kf: floor of the velocity gain [1/s] (dvornikov2017: 0.008)"
        ),
        "accel_gain_min": real(
            0.0, 0.0, 10.0, "kf: floor of the acceleration gain [1/s^2] (dvornikov2017: 0.0003)"
        ),
    },
    follows_manoeuvres=True,
)
