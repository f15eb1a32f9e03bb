"""What dead reckoning reports of a walk in steps of constant velocity, by the error model of
petukhov:eq.6-8: length and heading of every step have one error each, and standing still is a
velocity of zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from netpos.estimation.measurement import GROUP, ORIGIN, ROW_WIDTH, VALUE, VARIANCE
from netpos.estimation.rows import linear_rows
from netpos.inertial.pdr_output import step_velocity
from netpos.messages.values import Array, Velocity

Ints = npt.NDArray[np.int64]

_VELOCITY = np.eye(2, 6, k=2)


@dataclass(frozen=True, slots=True, kw_only=True)
class StepErrors:
    """Standard deviations of a step's length and heading, and of the speed of a person at rest.
    The paper gives none; these are a calibrated length (5 %) and a good magnetic heading."""

    length_sd_m: float = 0.03
    heading_sd_rad: float = math.radians(3.0)
    rest_sd_mps: float = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class Person:
    """Common errors of all steps of a person: true over reported length, angle from
    reported to true heading."""

    length_factor: float = 1.0
    heading_offset_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class Steps:
    """Steps (n,) of a walk: start and end [s], length [m], heading [rad]."""

    start_s: Array
    end_s: Array
    length_m: Array
    heading_rad: Array


def steps_of(points: Array, pauses_s: Array, speed_mps: float, step_m: float) -> Steps:
    """Equal steps of about ``step_m`` along the legs between way-points (n, 2), walked at
    ``speed_mps`` with a pause at each."""
    columns: list[tuple[float, float, float, float]] = []
    time_s = 0.0
    for leg, pause_s in zip(np.diff(points, axis=0), pauses_s, strict=False):
        time_s += pause_s
        count = max(1, round(math.hypot(*leg) / step_m))
        length = math.hypot(*leg) / count
        for _ in range(count):
            end_s = time_s + length / speed_mps
            columns.append((time_s, end_s, length, math.atan2(leg[1], leg[0])))
            time_s = end_s
    return Steps(*np.array(columns).T)


def velocity_rows(
    times_s: Array,
    steps: Steps,
    errors: StepErrors,
    rng: np.random.Generator,
    tau_s: float,
    person: Person = Person(),
) -> tuple[Array, Ints]:
    """Rows (n, 2, ROW_WIDTH) of the velocities reported at times (n,), group 1, and the step each
    belongs to (n,), -1 at rest.

    tau_s : correlation time the filter assumes of their errors (``velocity_correlation_s``)
    """
    noise = rng.standard_normal((len(steps.start_s), 2))
    step: Ints = np.searchsorted(steps.start_s, times_s + 1e-9, side="right") - 1
    step[(step >= 0) & (times_s + 1e-9 >= steps.end_s[step])] = -1
    still = linear_rows(np.zeros(2), errors.rest_sd_mps**2 * np.eye(2), _VELOCITY, 1)
    rows = np.empty((len(times_s), 2, ROW_WIDTH))
    rows[:] = still
    for s in np.unique(step[step >= 0]).tolist():
        value, cov = step_velocity(
            steps.length_m[s] / person.length_factor + errors.length_sd_m * noise[s, 0],
            steps.end_s[s] - steps.start_s[s],
            steps.heading_rad[s] - person.heading_offset_rad + errors.heading_sd_rad * noise[s, 1],
            errors.length_sd_m,
            errors.heading_sd_rad,
        )
        rows[step == s] = linear_rows(value, cov, _VELOCITY, 1)
    if tau_s > 0.0 and len(times_s) > 1:
        gaps_s = np.diff(times_s)
        gaps_s = np.append(gaps_s[:1], gaps_s)  # dead reckoning has reported before
        rows[:, :, VARIANCE] *= np.maximum(1.0, tau_s / np.maximum(gaps_s, 1e-9))[:, None]
    rows[..., GROUP] = 1
    return rows, step


def reported_velocity(rows: Array) -> Array:
    """The velocity (2,) m/s behind two decorrelated rows (2, ROW_WIDTH)."""
    H = rows[:, ORIGIN + 2 : ORIGIN + 4]
    return np.asarray(np.linalg.solve(H, rows[:, VALUE]), dtype=np.float64)


def reported(stamp_ns: int, rows: Array) -> Velocity:
    """The message behind two decorrelated rows (2, ROW_WIDTH): equal within a step, its covariance
    that of a single value."""
    H = rows[:, ORIGIN + 2 : ORIGIN + 4]
    value: Array = np.round(reported_velocity(rows), 12)
    cov = np.asarray(np.linalg.inv(H.T @ H), dtype=np.float64)
    return Velocity(stamp_ns=stamp_ns, vue_id="", velocity=value, cov=cov)
