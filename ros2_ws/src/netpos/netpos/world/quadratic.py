"""Motion in stretches of constant acceleration."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from netpos.world.body import BodyState, Kinematics, check_times, level

Array = npt.NDArray[np.float64]


class QuadraticMotion:
    """Per axis a polynomial of degree 2 at a time: stretches of constant acceleration, the
    position and the velocity continuous (dvornikov2017: curves of the second order)."""

    def __init__(
        self,
        start_m: npt.ArrayLike,
        velocity_mps: npt.ArrayLike,
        durations_s: Sequence[float],
        accelerations_mps2: npt.ArrayLike,
    ) -> None:
        """From ``start_m`` (2,) with ``velocity_mps`` (2,), then accelerations (k, 2) for
        durations (k,).

        Raises ``ValueError`` where durations are not > 0 or something is not finite.
        """
        a = np.asarray(accelerations_mps2, dtype=np.float64).reshape(-1, 2)
        durations = np.asarray(durations_s, dtype=np.float64)
        if len(a) != durations.size or not durations.size:
            raise ValueError(
                f"{durations.size} durations need as many accelerations, got {len(a)}"
            )
        if not ((durations > 0) & (durations < math.inf)).all():
            raise ValueError(f"durations must be finite and > 0 s, got {durations.tolist()}")
        position = [np.asarray(start_m, dtype=np.float64)]
        velocity = [np.asarray(velocity_mps, dtype=np.float64)]
        if not np.isfinite([position[0], velocity[0], *a]).all():
            raise ValueError("start, velocity and accelerations must be finite")
        for dt, acceleration in zip(durations[:-1], a[:-1], strict=True):
            position.append(position[-1] + dt * velocity[-1] + dt * dt / 2 * acceleration)
            velocity.append(velocity[-1] + dt * acceleration)
        self.duration_s = float(durations.sum())
        self.smooth = True
        self._start = np.concatenate([[0.0], np.cumsum(durations)[:-1]])
        self._stretches = np.hstack([position, velocity, a])

    def at(self, time_s: npt.ArrayLike) -> Kinematics:
        """State at times (n,) since the start [s]; at a jump of the acceleration, the state after
        it. The heading is the direction of the velocity.

        Raises ``ValueError`` as ``Motion.at``.
        """
        t = check_times(time_s, self.duration_s)
        k = np.maximum(np.searchsorted(self._start, t, side="right") - 1, 0)
        tau = (t - self._start[k])[:, None]
        p, v, a = np.hsplit(self._stretches[k], 3)
        now = v + tau * a
        across = now[:, 0] * a[:, 1] - now[:, 1] * a[:, 0]
        speed2 = (now**2).sum(axis=1)
        return Kinematics(
            position=p + tau * v + tau * tau / 2 * a,
            velocity=now,
            acceleration=a,
            yaw=np.arctan2(now[:, 1], now[:, 0]),
            yaw_rate=np.divide(across, speed2, out=np.zeros_like(speed2), where=speed2 > 0),
        )

    def body_at(self, time_s: npt.ArrayLike) -> BodyState:
        """The same as a level body in three dimensions."""
        return level(self.at(time_s))
