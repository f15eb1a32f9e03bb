"""A motion with white acceleration added: the motion model that trackers assume."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from netpos.world.body import BodyMotion, BodyState, Kinematics, check_times, level

Array = npt.NDArray[np.float64]


class Wander:
    """A motion in the plane plus the integral of white acceleration.

    On a grid of ``step_s`` from the start, the deviation is an exact draw; between two of its
    instants it is the cubic that fits position and velocity at both. The body looks where it goes.
    """

    smooth = False

    def __init__(
        self, way: BodyMotion, density: float, step_s: float, rng: np.random.Generator
    ) -> None:
        """density: of the acceleration per axis [m/s^2/sqrt(Hz)].

        Raises
        ------
        ValueError  density or step_s not finite and > 0
        """
        for name, value in (("density", density), ("step_s", step_s)):
            if not 0 < value < math.inf:
                raise ValueError(f"{name} must be finite and > 0, got {value}")
        self._way = way
        self.duration_s = way.duration_s
        self._step_s = step_s
        steps = math.ceil(way.duration_s / step_s) + 1
        h = step_s
        factor = np.linalg.cholesky([[h**3 / 3, h**2 / 2], [h**2 / 2, h]])
        drawn = density * rng.standard_normal((steps, 2, 2)) @ factor.T  # (step, axis, dp dv)
        self._velocity = np.zeros((steps + 1, 2))
        self._velocity[1:] = np.cumsum(drawn[:, :, 1], axis=0)
        self._position = np.zeros((steps + 1, 2))
        self._position[1:] = np.cumsum(h * self._velocity[:-1] + drawn[:, :, 0], axis=0)

    def body_at(self, time_s: npt.ArrayLike) -> BodyState:
        """State at times (n,) since the start [s], level.

        Raises
        ------
        ValueError  a time is not finite or outside [0, duration_s]
        """
        t = check_times(time_s, self.duration_s)
        way = self._way.body_at(t)
        steps = t / self._step_s
        whole = np.rint(steps)
        # stamps are whole nanoseconds, so a grid time may be off by rounding
        steps = np.where(np.abs(steps - whole) < 1e-6, whole, steps)
        k = np.floor(steps).astype(int)
        s = (steps - k)[:, None]
        p0, p1 = self._position[k], self._position[k + 1]
        v0, v1 = self._step_s * self._velocity[k], self._step_s * self._velocity[k + 1]
        cubic = 2 * (p0 - p1) + v0 + v1
        rise = 3 * (p1 - p0) - 2 * v0 - v1
        position = way.position[:, :2] + p0 + s * (v0 + s * (rise + s * cubic))
        velocity = way.velocity[:, :2] + (v0 + s * (2 * rise + 3 * s * cubic)) / self._step_s
        acceleration = (2 * rise + 6 * s * cubic) / self._step_s**2
        across = velocity[:, 0] * acceleration[:, 1] - velocity[:, 1] * acceleration[:, 0]
        speed2 = (velocity**2).sum(axis=1)
        return level(
            Kinematics(
                position=position,
                velocity=velocity,
                acceleration=acceleration,
                yaw=np.arctan2(velocity[:, 1], velocity[:, 0]),
                yaw_rate=np.divide(across, speed2, out=np.zeros_like(speed2), where=speed2 > 0),
            )
        )
