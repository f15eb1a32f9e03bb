"""Yaw rate and forward acceleration of a device, integrated between any two stamps."""

from __future__ import annotations

from bisect import bisect_left

from netpos.messages.values import ImuSample

_KEEP_NS = 70_000_000_000
_GAP_NS = 50_000_000  # a longer silence of the IMU is a hole, not a step


class ImuBuffer:
    """Integrals of the last minute of IMU samples, trapezoidal between their stamps.

    The device's base_link has x forward and z up; the track is planar, so pitch and roll count as
    part of the acceleration's bias.
    """

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget all samples."""
        self._stamps: list[int] = []
        self._samples: list[tuple[float, float]] = []
        self._integrals: list[tuple[float, float, int]] = []  # yaw, speed, time in holes [ns]

    def add(self, sample: ImuSample) -> str | None:
        """Take a sample; returns the reason when it is not newer than the last."""
        stamp = sample.stamp_ns
        value = (float(sample.angular_velocity[2]), float(sample.specific_force[0]))
        if self._stamps and stamp <= self._stamps[-1]:
            return "duplicate" if stamp == self._stamps[-1] else "late"
        yaw, speed, holes = self._integrals[-1] if self._integrals else (0.0, 0.0, 0)
        if self._stamps:
            span = stamp - self._stamps[-1]
            if span > _GAP_NS:
                holes += span
            else:
                last = self._samples[-1]
                yaw += (last[0] + value[0]) / 2.0 * span * 1e-9
                speed += (last[1] + value[1]) / 2.0 * span * 1e-9
        self._stamps.append(stamp)
        self._samples.append(value)
        self._integrals.append((yaw, speed, holes))
        if self._stamps[0] < stamp - 2 * _KEEP_NS:
            keep = bisect_left(self._stamps, stamp - _KEEP_NS)
            del self._stamps[:keep], self._samples[:keep], self._integrals[:keep]
        return None

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
        (w0, a0), (w1, a1) = self._samples[i - 1], self._samples[i]
        t = share * span * 1e-9
        yaw = before[0] + t * (w0 + share * (w1 - w0) / 2.0)
        speed = before[1] + t * (a0 + share * (a1 - a0) / 2.0)
        return yaw, speed, before[2]
