"""The samples of a device's IMU, and their integrals between any two stamps."""

from __future__ import annotations

from array import array
from bisect import bisect_left, bisect_right

import numpy as np
from numpy.typing import NDArray

from netpos.messages.values import Array, ImuSample

_KEEP_NS = 70_000_000_000
_GAP_NS = 50_000_000  # a longer silence of the IMU is a hole, not a step


class ImuBuffer:
    """The samples of the last minute, and integrals of yaw rate and forward acceleration,
    trapezoidal between their stamps.

    The device's base_link has x forward and z up; a planar track counts pitch and roll as part of
    the acceleration's bias.
    """

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget all samples."""
        self._stamps: list[int] = []
        self._rates = array("d")  # six a sample: angular velocity, specific force
        self._integrals: list[tuple[float, float, int]] = []  # yaw, speed, time in holes [ns]

    def add(self, sample: ImuSample) -> str | None:
        """Take a sample; returns the reason when it is not newer than the last."""
        stamp = sample.stamp_ns
        if self._stamps and stamp <= self._stamps[-1]:
            return "duplicate" if stamp == self._stamps[-1] else "late"
        value = (*sample.angular_velocity.tolist(), *sample.specific_force.tolist())
        yaw, speed, holes = self._integrals[-1] if self._integrals else (0.0, 0.0, 0)
        if self._stamps:
            span = stamp - self._stamps[-1]
            if span > _GAP_NS:
                holes += span
            else:
                yaw += (self._rates[-4] + value[2]) / 2.0 * span * 1e-9
                speed += (self._rates[-3] + value[3]) / 2.0 * span * 1e-9
        self._stamps.append(stamp)
        self._rates.extend(value)
        self._integrals.append((yaw, speed, holes))
        if self._stamps[0] < stamp - 2 * _KEEP_NS:
            keep = bisect_left(self._stamps, stamp - _KEEP_NS)
            del self._stamps[:keep], self._rates[: 6 * keep], self._integrals[:keep]
        return None

    def between(self, from_ns: int, to_ns: int) -> tuple[NDArray[np.int64], Array]:
        """Stamps (n,) and rates (n, 6) that cover an interval, with one sample before it."""
        first = max(bisect_right(self._stamps, from_ns) - 1, 0)
        last = min(bisect_left(self._stamps, to_ns) + 1, len(self._stamps))
        stamps = np.array(self._stamps[first:last], dtype=np.int64)
        return stamps, np.array(self._rates[6 * first : 6 * last]).reshape(-1, 6)

    def increments(self, from_ns: int, to_ns: int) -> tuple[float, float, float]:
        """Yaw [rad] and speed [m/s] gained between two stamps, and the seconds not covered."""
        first, last = self._at(from_ns), self._at(to_ns)
        uncovered = (last[2] - first[2]) * 1e-9
        return last[0] - first[0], last[1] - first[1], uncovered

    def _at(self, stamp_ns: int) -> tuple[float, float, int]:
        """Integrals up to a stamp; beyond the samples only the uncovered time grows."""
        if not self._stamps:
            return 0.0, 0.0, stamp_ns
        i = bisect_left(self._stamps, stamp_ns)
        if i == len(self._stamps):
            yaw, speed, holes = self._integrals[-1]
            return yaw, speed, holes + stamp_ns - self._stamps[-1]
        if i == 0:
            yaw, speed, holes = self._integrals[0]
            return yaw, speed, holes + stamp_ns - self._stamps[0]
        before, after = self._integrals[i - 1], self._integrals[i]
        span = self._stamps[i] - self._stamps[i - 1]
        share = (stamp_ns - self._stamps[i - 1]) / span
        if after[2] > before[2]:
            return before[0], before[1], before[2] + int(share * span)
        w0, a0 = self._rates[6 * i - 4 : 6 * i - 2]
        w1, a1 = self._rates[6 * i + 2 : 6 * i + 4]
        t = share * span * 1e-9
        yaw = before[0] + t * (w0 + share * (w1 - w0) / 2.0)
        speed = before[1] + t * (a0 + share * (a1 - a0) / 2.0)
        return yaw, speed, before[2]
