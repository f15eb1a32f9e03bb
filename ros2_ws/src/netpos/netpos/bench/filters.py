"""Filters against FilterPy and against plain C: one run of epochs, prediction and update of six
states with the DOA and TOA of two RSUs."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit

from netpos.bench.common import (
    LeftOut,
    Result,
    Unavailable,
    faster,
    side_by_side,
    within,
)
from netpos.bench.problem import (
    DT_S,
    HEIGHT_M,
    MOTION,
    ROWS,
    Problem,
    bends,
    model,
    problem,
    variances,
)
from netpos.bench.yardstick import Yardstick
from netpos.estimation.forms import ekf, sigma, srukf
from netpos.estimation.measurement import AXES, ORIGIN, VALUE, VARIANCE, linearise, predict_row
from netpos.estimation.motion import NO_BIAS, propagate
from netpos.estimation.state import POSITION, X
from netpos.messages.values import Array

NO_GATE = np.array([np.inf])
_EKF = "EKF predict + update, 6 states, 2 RSUs"
_SRUKF = "square-root UKF predict + update, 6 states, 2 RSUs"
_YARDSTICK = "the same filter in C"


# Not cached: Numba would not notice that the kernels inside have changed.
@njit(error_model="numpy")
def ekf_loop(
    rows: Array,
    dt: float,
    motion: Array,
    bias: Array,
    mean: Array,
    cov: Array,
    gate: Array,
    accepted: Array,
    work: Array,
) -> None:
    """All epochs of ``rows`` through the extended Kalman filter, in place."""
    for k in range(rows.shape[0]):
        ekf.predict(mean, cov, dt, motion, bias)
        ekf.update(mean, cov, rows[k], 0.0, gate, 1, accepted, work)


@njit(error_model="numpy")
def srukf_loop(
    rows: Array,
    dt: float,
    motion: Array,
    bias: Array,
    mean: Array,
    spread: Array,
    gate: Array,
    accepted: Array,
) -> None:
    """All epochs of ``rows`` through the square-root unscented filter, in place."""
    for k in range(rows.shape[0]):
        srukf.predict(mean, spread, dt, motion, bias)
        srukf.update(mean, spread, rows[k], 0.0, gate, accepted)


@njit(error_model="numpy")
def _predicted(rows: Array, x: Array, height_m: float) -> Array:
    values, h = np.empty(rows.shape[0]), np.empty(x.size)
    for i in range(rows.shape[0]):
        values[i] = predict_row(rows[i], x, height_m, h)
    return values


def compiled_ekf(p: Problem) -> tuple[Array, Array]:
    """Posterior after all epochs, the loop over epochs compiled."""
    mean, cov = p.mean.copy(), p.cov.copy()
    accepted, work = np.zeros(2), ekf.workspace(6, ROWS)
    ekf_loop(p.rows, DT_S, MOTION, NO_BIAS, mean, cov, NO_GATE, accepted, work)
    return mean, cov


def called_ekf(p: Problem) -> tuple[Array, Array]:
    """Posterior after all epochs, predict and update called from Python."""
    mean, cov = p.mean.copy(), p.cov.copy()
    accepted, work = np.zeros(2), ekf.workspace(6, ROWS)
    predict, update = ekf.predict, ekf.update
    for rows in p.rows:
        predict(mean, cov, DT_S, MOTION, NO_BIAS)
        update(mean, cov, rows, HEIGHT_M, NO_GATE, 1, accepted, work)
    return mean, cov


def compiled_srukf(p: Problem) -> tuple[Array, Array]:
    """Posterior after all epochs, the loop over epochs compiled."""
    mean, spread = p.mean.copy(), np.linalg.cholesky(p.cov)
    srukf_loop(p.rows, DT_S, MOTION, NO_BIAS, mean, spread, NO_GATE, np.zeros(2))
    return mean, spread @ spread.T


def called_srukf(p: Problem) -> tuple[Array, Array]:
    """Posterior after all epochs, predict and update called from Python."""
    mean, spread, accepted = p.mean.copy(), np.linalg.cholesky(p.cov), np.zeros(2)
    predict, update = srukf.predict, srukf.update
    for rows in p.rows:
        predict(mean, spread, DT_S, MOTION, NO_BIAS)
        update(mean, spread, rows, HEIGHT_M, NO_GATE, accepted)
    return mean, spread @ spread.T


def epoch_terms(p: Problem) -> list[tuple[Array, Array]]:
    """Of every epoch the values (4,) less what linearising leaves out of their means, and R (4, 4)
    with what it leaves out of their variances, as our filter finds them."""
    mean, cov = p.mean.copy(), p.cov.copy()
    accepted, work = np.zeros(2), ekf.workspace(6, ROWS)
    terms = []
    for rows in p.rows:
        ekf.predict(mean, cov, DT_S, MOTION, NO_BIAS)
        values = rows[:, VALUE] - bends(rows, mean, cov)
        terms.append((values, np.diag(variances(rows, mean, cov))))
        ekf.update(mean, cov, rows, HEIGHT_M, NO_GATE, 1, accepted, work)
    return terms


class FilterPyEkf:
    """FilterPy's filter on the same problem. Second-order terms are given to it; with ``compiled``
    its h and H are our kernels, so that only its own cost counts, else they are written in
    NumPy."""

    def __init__(self, p: Problem, compiled: bool = True) -> None:
        from filterpy.kalman import ExtendedKalmanFilter  # noqa: PLC0415

        self._problem = p
        self._terms = epoch_terms(p)
        self._filter = ExtendedKalmanFilter(6, ROWS)
        self._filter.F, self._filter.Q = model()
        self._models = (_jacobian, _expected) if compiled else (numpy_jacobian, numpy_expected)

    def run(self) -> tuple[Array, Array]:
        """Posterior after all epochs."""
        p, reference, (jacobian, expected) = self._problem, self._filter, self._models
        reference.x, reference.P = p.mean.copy(), p.cov.copy()
        for rows, (values, R) in zip(p.rows, self._terms, strict=True):
            reference.predict()
            reference.update(values, jacobian, expected, R, args=rows, hx_args=rows)
        return np.asarray(reference.x), np.asarray(reference.P)


def _jacobian(x: Array, rows: Array) -> Array:
    return np.asarray(linearise(rows, x, HEIGHT_M)[1])


def _expected(x: Array, rows: Array) -> Array:
    return np.asarray(_predicted(rows, x, HEIGHT_M))


def numpy_expected(x: Array, rows: Array) -> Array:
    """h (4,): azimuth, TOA of one RSU, then of the other, for RSUs that look east."""
    d = np.array([*x[POSITION], HEIGHT_M]) - rows[::2, ORIGIN:AXES]
    values = np.empty(ROWS)
    values[::2] = np.arctan2(d[:, 1], d[:, 0])
    values[1::2] = np.linalg.norm(d, axis=1) + x[X.CLOCK]
    return values


def numpy_jacobian(x: Array, rows: Array) -> Array:
    """H (4, 6) of ``numpy_expected``."""
    d = np.array([*x[POSITION], HEIGHT_M]) - rows[::2, ORIGIN:AXES]
    rho2 = d[:, 0] ** 2 + d[:, 1] ** 2
    H = np.zeros((ROWS, 6))
    H[::2, X.PX], H[::2, X.PY] = -d[:, 1] / rho2, d[:, 0] / rho2
    H[1::2, POSITION] = d[:, :2] / np.linalg.norm(d, axis=1)[:, None]
    H[1::2, X.CLOCK] = 1.0
    return H


class FilterPyUkf:
    """FilterPy's unscented filter with our sigma points, f and h compiled."""

    def __init__(self, p: Problem) -> None:
        from filterpy.kalman import (  # noqa: PLC0415
            MerweScaledSigmaPoints,
            UnscentedKalmanFilter,
        )

        points = MerweScaledSigmaPoints(6, sigma.ALPHA, sigma.BETA, sigma.kappa(6))
        self._problem = p
        self._filter = UnscentedKalmanFilter(6, ROWS, DT_S, _expected, _moved, points)
        self._filter.Q = model()[1]
        self._noise = [np.diag(rows[:, VARIANCE]) for rows in p.rows]

    def run(self) -> tuple[Array, Array]:
        """Posterior after all epochs."""
        p, reference = self._problem, self._filter
        reference.x, reference.P = p.mean.copy(), p.cov.copy()
        for rows, R in zip(p.rows, self._noise, strict=True):
            reference.predict()
            reference.update(rows[:, VALUE], R, rows=rows)
        return np.asarray(reference.x), np.asarray(reference.P)


def _moved(x: Array, dt: float) -> Array:
    moved = x.copy()
    propagate(moved, dt, MOTION, NO_BIAS)
    return moved


def ekf_rows(quick: bool) -> list[Result]:
    """The extended Kalman filter against FilterPy and C."""
    long, middle, short = problem(1000), problem(400), problem(20)
    operations: dict[str, Any] = {
        "loop": (lambda: compiled_ekf(long), long.epochs),
        "called": (lambda: called_ekf(middle), middle.epochs),
        "FilterPy": (FilterPyEkf(short).run, short.epochs),
        "NumPy": (FilterPyEkf(short, compiled=False).run, short.epochs),
    }
    left_out: list[Result] = []
    with tempfile.TemporaryDirectory() as folder:
        try:
            yardstick = Yardstick(Path(folder))
            operations["C"] = (lambda: yardstick.run(long), long.epochs)
        except Unavailable as reason:
            left_out = [LeftOut(f"{_EKF}, against {_YARDSTICK}", str(reason))]
        cost = side_by_side(operations, 3 if quick else 500)
    rows: list[Result] = []
    for reference, key in (
        ("FilterPy 2.0 EKF, h and H in NumPy", "NumPy"),
        ("FilterPy 2.0 EKF, given our compiled h and H", "FilterPy"),
    ):
        theirs = cost[key]
        rows += [
            faster(f"{_EKF}, compiled loop", cost["loop"], reference, theirs, 60.0),
            faster(f"{_EKF}, called from Python", cost["called"], reference, theirs, 20.0),
        ]
    if "C" in cost:
        rows.append(within(f"{_EKF}, compiled loop", cost["loop"], _YARDSTICK, cost["C"], 1.5))
    return rows + left_out


def srukf_rows(quick: bool) -> list[Result]:
    """The square-root unscented filter against FilterPy's unscented filter, f and h compiled."""
    long, short = problem(50), problem(4)
    cost = side_by_side(
        {
            "loop": (lambda: compiled_srukf(long), long.epochs),
            "called": (lambda: called_srukf(long), long.epochs),
            "FilterPy": (FilterPyUkf(short).run, short.epochs),
        },
        3 if quick else 300,
    )
    theirs, reference = cost["FilterPy"], "FilterPy 2.0 UKF"
    return [
        faster(f"{_SRUKF}, compiled loop", cost["loop"], reference, theirs, 20.0),
        faster(f"{_SRUKF}, called from Python", cost["called"], reference, theirs, 20.0),
    ]
