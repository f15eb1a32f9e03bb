"""Faults of an IMU stream: refused samples by reason, and conditions reported once.

A *fault* refuses one sample. A *condition* lasts; it is reported in one sentence when it begins
and in one when it ends.
"""

from __future__ import annotations

import math
from collections import Counter, deque

from netpos.inertial.pdr_config import PdrConfig

Vector = tuple[float, float, float]

# So many samples of exactly the same, largest reading: the end of a range narrower than declared.
_PLATEAU_SAMPLES = 4
_PLATEAU_MPS2 = 14.7  # 1.5 g; a sensor at rest may well repeat itself
_EDGE = 1.001  # a reading further beyond the range is refused
_GRAVITY_MEMORY_S = 5.0


class Conditions:
    """Which conditions hold, and the sentences that were not yet taken."""

    def __init__(self) -> None:
        self._active: list[str] = []
        self._notices: deque[str] = deque(maxlen=100)

    @property
    def active(self) -> tuple[str, ...]:
        """Names of the conditions that hold now, in order of their beginning."""
        return tuple(self._active)

    def set(self, name: str, holds: bool, begins: str, ends: str) -> None:
        """Note whether a condition holds; report when it begins and when it ends."""
        if holds and name not in self._active:
            self._active.append(name)
            self._notices.append(begins)
        elif not holds and name in self._active:
            self._active.remove(name)
            self._notices.append(ends)

    def tell(self, sentence: str) -> None:
        """Report an event that does not last."""
        self._notices.append(sentence)

    def take(self) -> list[str]:
        """The sentences since the last call."""
        notices = list(self._notices)
        self._notices.clear()
        return notices


class StreamWatch:
    """Judges the samples of one IMU: order, range, rate, direction of gravity."""

    def __init__(self, config: PdrConfig, conditions: Conditions, counters: Counter[str]) -> None:
        self._cfg, self._conditions, self._counters = config, conditions, counters
        self.reset()

    def reset(self) -> None:
        """Forget the stream, for example after a gap."""
        self._rate_start_ns: int | None = None
        self._rate_n = 0
        self.rate_ok = True
        self._repeats = [0, 0, 0]
        self._last: Vector = (math.nan, math.nan, math.nan)
        self._largest = [0.0, 0.0, 0.0]
        self._gravity: Vector | None = None
        self._settled_s = 0.0

    def saturated(self, rate: Vector, force: Vector) -> tuple[str, bool] | None:
        """Reason when a sample is at the end of a sensor's range, and whether it lies beyond it
        and cannot be a reading at all; reported once."""
        cfg = self._cfg
        turn, push = max(map(abs, rate)), max(map(abs, force))
        if turn >= cfg.gyro_range_radps:
            reason, what = "gyro_saturated", f"gyro_range_radps {cfg.gyro_range_radps:g}"
        elif push >= cfg.accelerometer_range_mps2:
            reason = "accelerometer_saturated"
            what = f"accelerometer_range_mps2 {cfg.accelerometer_range_mps2:g}"
        elif self._plateau(force):
            reason, what = "accelerometer_saturated", f"{push:.1f} m/s^2, read again and again"
        else:
            return None
        if not self._counters[reason]:
            self._conditions.tell(
                f"{reason}: readings at the end of the range ({what}); tilt, heading and step "
                "length suffer, steps may be missed. Use a wider range"
            )
        self._counters[reason] += 1
        beyond = turn > _EDGE * cfg.gyro_range_radps or push > _EDGE * cfg.accelerometer_range_mps2
        return reason, beyond

    def _plateau(self, force: Vector) -> bool:
        for i in range(3):
            size = abs(force[i])
            self._largest[i] = max(self._largest[i], size)
            largest = size >= max(self._largest[i], _PLATEAU_MPS2)
            same = largest and force[i] == self._last[i]
            self._repeats[i] = self._repeats[i] + 1 if same else 0
        self._last = force
        return max(self._repeats) >= _PLATEAU_SAMPLES - 1

    def rate(self, stamp_ns: int) -> None:
        """Count the samples of each second of stamps."""
        if self._rate_start_ns is None:
            self._rate_start_ns = stamp_ns
            return
        self._rate_n += 1
        span_s = (stamp_ns - self._rate_start_ns) * 1e-9
        if span_s < 1.0:
            return
        rate_hz, cfg = self._rate_n / span_s, self._cfg
        self.rate_ok = cfg.min_rate_hz <= rate_hz <= cfg.max_rate_hz
        if not self.rate_ok:
            self._counters["rate_out_of_range"] += 1
        self._conditions.set(
            "rate",
            not self.rate_ok,
            f"the IMU comes at {rate_hz:.1f} Hz, outside {cfg.min_rate_hz:g} to "
            f"{cfg.max_rate_hz:g} Hz: the velocity is unknown; set its rate",
            f"the IMU comes at {rate_hz:.1f} Hz again",
        )
        self._rate_start_ns, self._rate_n = stamp_ns, 0

    def mounted(self, dt_s: float, force: Vector) -> bool:
        """Whether gravity is where the mounting says, within ``max_mount_tilt_rad`` of z."""
        if self._gravity is None:
            self._gravity = force
        self._settled_s += dt_s
        a = min(dt_s / min(_GRAVITY_MEMORY_S, max(self._settled_s, 1e-9)), 1.0)
        gx, gy, gz = (g + a * (f - g) for g, f in zip(self._gravity, force, strict=True))
        self._gravity = (gx, gy, gz)
        if self._settled_s < 1.0:
            return "axes" not in self._conditions.active
        tilt = math.atan2(math.hypot(gx, gy), gz)
        bad = tilt > self._cfg.max_mount_tilt_rad
        axis, value = max(zip("xyz", self._gravity, strict=True), key=lambda p: abs(p[1]))
        self._conditions.set(
            "axes",
            bad,
            f"gravity points along {'-' if value < 0 else '+'}{axis} of the device, "
            f"{math.degrees(tilt):.0f} deg from +z: its axes are swapped, or it is not mounted "
            "as declared (x forward, y left, z up); the heading is unknown",
            "gravity points along +z of the device again",
        )
        return not bad
