"""Coarse alignment: the first attitude, position and velocity of a strapdown system.

The accelerometers show roll and pitch (level), the way shows the heading: a vehicle drives where
it points. Between the fixes gyro and accelerometer give the shape of the way, up to where it
begins, its heading psi and the speed s there:

    p(t) = p0 + R(psi) (s A(t) + B(t) + a D(t))
    A = integral of (cos d, sin d),  B = integral of u (cos d, sin d),  u = integral of f_forward
    D = integral of t (cos d, sin d)

with d the heading turned since. Levelling takes the mean acceleration for tilt; ``a`` gives it
back, to the way and to the tilt. Start from rest (s = 0, then B shows psi) and from motion are one
problem. Fitted by Levenberg-Marquardt to horizontal fixes with their covariances.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from netpos.common.least_squares import minimiser
from netpos.inertial.attitude import GRAVITY_MPS2

Array = npt.NDArray[np.float64]

_HEADINGS = 8
_ACCELERATION_SD = 1.0
"""Prior of the mean forward acceleration [m/s^2]."""


def level(specific_force: Array) -> tuple[float, float]:
    """Roll and pitch [rad] of a body whose mean specific force (3,) only holds gravity up.

    Raises ``ValueError`` where there is no force.
    """
    x, y, z = np.asarray(specific_force, dtype=np.float64).tolist()
    if not math.hypot(x, y, z) > 0.0:
        raise ValueError("level needs a specific force, got zero; is the accelerometer connected?")
    return math.atan2(y, z), math.atan2(-x, math.hypot(y, z))


@dataclass(frozen=True, slots=True, kw_only=True)
class Way:
    """Shape of a way at k instants: time (k,) s, heading turned (k,) rad, A (k, 2) s, B (k, 2) m,
    D (k, 2) s^2 and gained forward speed (k,) m/s, all since its begin; roll and pitch [rad] where
    the mean acceleration is 0."""

    time_s: Array
    turned: Array
    A: Array
    B: Array
    D: Array
    gained: Array
    roll: float
    pitch: float


def way_of(time_s: Array, rates: Array, at_s: Array) -> Way:
    """Shape of the way that an IMU saw.

    time_s : (n,) ends of the samples' intervals, rates : (n, 6) angular velocity and specific
    force; at_s : (k,) instants, increasing, the first is the begin
    """
    roll, pitch = level(rates[:, 3:].mean(axis=0))
    flat = Rotation.from_euler("ZYX", [0.0, pitch, roll])
    dt = np.diff(time_s, prepend=time_s[0] - (time_s[1] - time_s[0]))
    turned = np.cumsum(flat.apply(rates[:, :3])[:, 2] * dt)
    forward = flat.apply(rates[:, 3:])[:, 0]
    gained = np.cumsum(forward * dt)
    ahead = np.column_stack([np.cos(turned), np.sin(turned)])
    A = np.cumsum(ahead * dt[:, None], axis=0)
    B = np.cumsum(ahead * (gained * dt)[:, None], axis=0)
    D = np.cumsum(ahead * (time_s * dt)[:, None], axis=0)
    series = np.column_stack([turned, gained, A, B, D])
    interpolated = np.column_stack([np.interp(at_s, time_s, column) for column in series.T])
    turned_at, gained_at, A_at, B_at, D_at = np.split(
        interpolated - interpolated[0], [1, 2, 4, 6], axis=1
    )
    back = Rotation.from_euler("z", -float(interpolated[0, 0])).as_matrix()[:2, :2]
    B_at = B_at - float(interpolated[0, 1]) * A_at  # speed and time count from the begin as well
    D_at = D_at - float(at_s[0]) * A_at
    return Way(
        time_s=at_s - at_s[0],
        turned=turned_at[:, 0],
        A=A_at @ back.T,
        B=B_at @ back.T,
        D=D_at @ back.T,
        gained=gained_at[:, 0],
        roll=roll,
        pitch=pitch,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Course:
    """Position (2,) m, heading [rad] and speed [m/s] at the end of a way, cov (4, 4) of the four,
    roll and pitch [rad], and the mean squared residual per degree of freedom."""

    position: Array
    heading: float
    speed: float
    cov: Array
    roll: float
    pitch: float
    misfit: float


def fit_course(way: Way, position: Array, cov: Array) -> Course | None:
    """Fit the way to fixes (k, 2) m with covariances (k, 2, 2), k >= 3; None where they leave it
    open or no fit is found."""
    if len(position) < 3:
        return None
    root = np.linalg.inv(np.linalg.cholesky(cov))
    best: tuple[float, Array, Array] | None = None
    for heading in np.arange(_HEADINGS) * (math.tau / _HEADINGS):
        candidate = _fit(way, position, root, heading)
        if candidate is not None and (best is None or candidate[0] < best[0]):
            best = candidate
    if best is None:
        return None
    cost, x, normal = best
    ends, J_end = _predict(way, x)
    J = np.vstack([J_end[-2:], [0, 0, 1, 0, 0], [0, 0, 0, 1, way.time_s[-1]]])
    end_cov = J @ np.linalg.inv(normal) @ J.T
    speed = float(x[3] + way.gained[-1] + x[4] * way.time_s[-1])
    sideways = speed * float(way.turned[-1]) / max(float(way.time_s[-1]), 1e-3)
    return Course(
        position=ends[-1],
        heading=math.remainder(float(x[2] + way.turned[-1]), math.tau),
        speed=speed,
        cov=(end_cov + end_cov.T) / 2,
        roll=way.roll - sideways / GRAVITY_MPS2,
        pitch=way.pitch + float(x[4]) / GRAVITY_MPS2,
        misfit=cost / max(2 * len(position) - 4, 1),
    )


def _predict(way: Way, x: Array) -> tuple[Array, Array]:
    """Positions (k, 2) for x = (east, north, psi, s, a), and their Jacobian (2 k, 5)."""
    c, s = math.cos(x[2]), math.sin(x[2])
    R = np.array([[c, -s], [s, c]])
    shape = x[3] * way.A + way.B + x[4] * way.D
    moved = shape @ R.T
    J = np.zeros((len(moved), 2, 5))
    J[:, 0, 0] = J[:, 1, 1] = 1.0
    J[:, 0, 2], J[:, 1, 2] = -moved[:, 1], moved[:, 0]
    J[:, :, 3], J[:, :, 4] = way.A @ R.T, way.D @ R.T
    return x[:2] + moved, J.reshape(-1, 5)


def _equations(x: Array, given: tuple[Way, Array, Array]) -> tuple[float, Array, Array]:
    """Those of ``minimiser``, of the fit of a way to positions (k, 2) with the roots (k, 2, 2) of
    their information."""
    way, position, root = given
    predicted, J = _predict(way, x)
    whitened = np.einsum("kij,kjl->kil", root, J.reshape(-1, 2, 5)).reshape(-1, 5)
    r = np.einsum("kij,kj->ki", root, position - predicted).ravel()
    prior = np.array([0.0, 0.0, 0.0, 0.0, 1.0 / _ACCELERATION_SD])
    r, J = np.append(r, -x[4] / _ACCELERATION_SD), np.vstack([whitened, prior])
    return float(r @ r), J.T @ r, J.T @ J


_minimise = minimiser(_equations, np.linalg.solve)


def _fit(
    way: Way, position: Array, root: Array, heading: float
) -> tuple[float, Array, Array] | None:
    """Cost, parameters and normal matrix (5, 5) from one heading."""
    span = float(np.linalg.norm(way.A[-1])) or 1.0
    speed = max(float(np.linalg.norm(position[-1] - position[0])) / span, 0.0)
    start = np.array([*position[0], heading, speed, 0.0])
    try:
        cost, x, normal = _minimise(start, (way, position, root))
    except np.linalg.LinAlgError:
        return None
    scale = np.sqrt(np.diag(normal))
    if not (scale > 0.0).all() or np.linalg.cond(normal / np.outer(scale, scale)) > 1e12:
        return None
    forwards = x[3] + way.gained[-1] + x[4] * way.time_s[-1] > 0.0
    return (cost, x, normal) if forwards else None
