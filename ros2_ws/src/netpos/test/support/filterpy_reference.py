"""The oracle of the filters: FilterPy's objects with our models and our gate, FilterPy's
algebra."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from curved_rows import values_of_a_bend
from filterpy import kalman
from netpos.estimation.forms.sigma import ALPHA, BETA, kappa
from netpos.estimation.measurement import (
    AXES,
    BIAS,
    COMMON,
    GATE_VARIANCE,
    GROUP,
    KIND,
    ORIGIN,
    REFERENCE,
    VALUE,
    VARIANCE,
    Kind,
    curvature_mean,
    curvature_variance,
    is_cyclic,
    linearise,
    predict_row,
    second_order_variance,
    wrap,
)
from netpos.estimation.motion import noise, propagate, transition
from netpos.messages.values import Array

# A FilterPy filter holding mean, cov after fusing rows with the variances of a column.
_Update = Callable[[Array, Array, Array, int, float], Any]


def _noise(mean: Array, dt: float, motion: Array, bias: Array) -> Array:
    Q = np.empty((mean.size, mean.size))
    noise(mean, dt, motion, bias, Q)
    return Q


def _moved(mean: Array, dt: float, motion: Array, bias: Array) -> Array:
    x = mean.copy()
    propagate(x, dt, motion, bias)
    return x


def _values(rows: Array, x: Array, height_m: float) -> Array:
    h = np.empty(x.size)
    return np.array([predict_row(row, x, height_m, h) for row in rows])


def _difference(rows: Array) -> Callable[[Array, Array], Array]:
    angle = np.array([is_cyclic(row) for row in rows])

    def difference(a: Array, b: Array) -> Array:
        y = a - b
        y[angle] = [wrap(value) for value in y[angle]]
        return y

    return difference


def ekf_predict(mean: Array, cov: Array, dt: float, motion: Array, bias: Array) -> None:
    """``ekf.predict`` on FilterPy's ``ExtendedKalmanFilter``."""
    if dt <= 0.0:
        return

    reference = kalman.ExtendedKalmanFilter(dim_x=mean.size, dim_z=1)
    reference.P = cov.copy()
    transition(mean, dt, motion, bias, reference.F)
    moved = _moved(mean, dt, motion, bias)
    reference.Q = _noise(moved, dt, motion, bias)
    reference.predict()  # of the covariance; FilterPy moves means by F x only
    mean[:], cov[:] = moved, reference.P


def _ekf(mean: Array, cov: Array, rows: Array, column: int, height_m: float) -> Any:
    reference = kalman.ExtendedKalmanFilter(dim_x=mean.size, dim_z=len(rows))
    reference.x, reference.P = mean.copy(), cov.copy()
    bent = np.array([curvature_variance(row, mean, cov, height_m) for row in rows])
    if column == VARIANCE:
        true = np.array([second_order_variance(row, mean, cov, height_m) for row in rows])
        bent += (values_of_a_bend(mean, rows) - 1.0) * true
    bend = np.array([curvature_mean(row, mean, cov, height_m) for row in rows])
    reference.update(
        rows[:, VALUE] - bend,
        lambda x: linearise(rows, x, height_m)[1],
        lambda x: _values(rows, x, height_m),
        R=np.diag(rows[:, column] + bent),
        residual=_difference(rows),
    )
    return reference


def ekf_update(
    mean: Array, cov: Array, rows: Array, height_m: float, gate_nis: Array, accepted: Array
) -> tuple[float, int]:
    """``ekf.update`` with one iteration on FilterPy's ``ExtendedKalmanFilter``."""
    return _update(_ekf, mean, cov, rows, height_m, gate_nis, accepted)


def follow_tangents(
    before: Array, mean: Array, cov: Array, first: int, rows: Array, height_m: float
) -> None:
    """``slow_errors.follow_tangents`` of ``rows``, by one matrix."""
    parts: dict[int, Array] = {}
    for row in rows[rows[:, KIND] != Kind.STEP_VELOCITY]:
        if row[BIAS] >= 0.0:
            part = row.copy()
            if row[KIND] == Kind.TDOA:
                part[[KIND, COMMON, REFERENCE]] = Kind.RANGE, -1.0, 0.0
            parts[int(row[BIAS])] = part
            if row[REFERENCE] > 0.0:
                part = part.copy()
                part[ORIGIN : ORIGIN + 3] += row[AXES : AXES + 3]
                part[BIAS] = row[REFERENCE]
                parts[int(row[REFERENCE])] = part
    if not parts:
        return
    explained = cov[:, first:] @ np.linalg.inv(cov[first:, first:])
    turn = np.eye(mean.size)
    for error, part in parts.items():
        old, new = (linearise(part[None], x, height_m)[1][0] for x in (before, mean))
        if old @ explained @ cov[first:, first:] @ explained.T @ old < cov[error, error]:
            turn[error, first:] += (old - new)[:first] @ explained[:first]
    cov[:] = turn @ cov @ turn.T


def follow_prediction(
    mean: Array, cov: Array, first: int, rows: Array, dt: float, height_m: float
) -> None:
    """``slow_errors.follow_prediction``."""
    unknown, known = np.trace(cov[2:4, 2:4]), float(mean[2:4] @ mean[2:4])
    before = mean.copy()
    before[:2] -= unknown / (unknown + known) * dt * mean[2:4]
    follow_tangents(before, mean, cov, first, rows, height_m)


def _points(n: int) -> Any:
    return kalman.MerweScaledSigmaPoints(n, ALPHA, BETA, kappa(n))


def ukf_predict(mean: Array, cov: Array, dt: float, motion: Array, bias: Array) -> None:
    """``ukf.predict`` on FilterPy's ``UnscentedKalmanFilter``; ``cov`` has to be positive
    definite, else ``LinAlgError``."""
    if dt <= 0.0:
        return
    reference = kalman.UnscentedKalmanFilter(
        mean.size, 1, dt, None, lambda x, dt: _moved(x, dt, motion, bias), _points(mean.size)
    )
    reference.x, reference.P = mean.copy(), cov.copy()
    reference.Q = np.zeros_like(cov)
    reference.predict()
    mean[:], cov[:] = reference.x, reference.P + _noise(reference.x, dt, motion, bias)


def _ukf(mean: Array, cov: Array, rows: Array, column: int, height_m: float) -> Any:
    difference = _difference(rows)

    def average(values: Array, weights: Array) -> Array:
        result: Array = values[0].copy()
        for value, weight in zip(values, weights, strict=True):
            result += weight * difference(value, values[0])
        return result

    reference = kalman.UnscentedKalmanFilter(
        mean.size,
        len(rows),
        0.0,
        lambda x: _values(rows, x, height_m),
        None,
        _points(mean.size),
        z_mean_fn=average,
        residual_z=difference,
    )
    reference.x, reference.P = mean.copy(), cov.copy()
    reference.sigmas_f = _points(mean.size).sigma_points(mean, cov)
    reference.update(rows[:, VALUE], R=np.diag(rows[:, column]))
    return reference


def ukf_update(
    mean: Array, cov: Array, rows: Array, height_m: float, gate_nis: Array, accepted: Array
) -> tuple[float, int]:
    """``ukf.update`` on FilterPy's ``UnscentedKalmanFilter``; ``cov`` has to be positive definite,
    else ``LinAlgError``."""
    return _update(_ukf, mean, cov, rows, height_m, gate_nis, accepted)


def _update(
    fused: _Update,
    mean: Array,
    cov: Array,
    rows: Array,
    height_m: float,
    gate_nis: Array,
    accepted: Array,
) -> tuple[float, int]:
    keep = np.zeros(len(rows), dtype=bool)
    for group in np.unique(rows[:, GROUP]):
        members = rows[:, GROUP] == group
        part = rows[members]
        nis = fused(mean, cov, part, GATE_VARIANCE, height_m).mahalanobis ** 2
        passes = nis <= gate_nis[min(len(part), len(gate_nis) - 1)]
        accepted[int(group)] = passes
        keep[members] = passes
    if not keep.any():
        return 0.0, 0

    def together(chosen: Array) -> float:
        some = rows[chosen]
        fit = fused(mean, cov, some, GATE_VARIANCE, height_m)
        return float(fit.mahalanobis**2)

    def misfit(chosen: Array) -> float:
        return together(chosen) - float(gate_nis[chosen.sum()])

    if keep.sum() < len(gate_nis) and misfit(keep) > 0.0:
        rest, most = keep, (np.unique(rows[keep, GROUP]).size - 1) // 2
        for _ in range(most):
            rests = [rest & (rows[:, GROUP] != g) for g in np.unique(rows[rest, GROUP])]
            rest = min(rests, key=misfit)
            if misfit(rest) <= 0.0:
                accepted[rows[keep & ~rest, GROUP].astype(int)] = 0.0
                keep = rest
                break
    nis = together(keep)
    kept = rows[keep]
    posterior = fused(mean, cov, kept, VARIANCE, height_m)
    mean[:], cov[:] = posterior.x, posterior.P
    return float(nis), int(keep.sum())
