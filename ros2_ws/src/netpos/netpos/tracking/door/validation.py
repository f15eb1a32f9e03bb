"""What is refused at the door. Every function returns the reason, or None for a sound value."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from netpos.estimation.factor import eigenvalues
from netpos.estimation.motion import SPEED_OF_LIGHT_MPS
from netpos.estimation.rows import rsu_axes
from netpos.estimation.sensors.model import Reading, Refusal
from netpos.estimation.sensors.table import readings
from netpos.messages.fields import MAP_FRAME, bad_stamp, malformed_nanosec, stamp_fault
from netpos.messages.topics import is_vue_id
from netpos.messages.values import (
    Array,
    Field,
    GroundSpeed,
    ImuSample,
    InitialPose,
    RsuInfo,
    RsuMeasurement,
    Velocity,
)
from netpos.tracking.rsus.rsu import REFERENCED, Rsu

# Plain integers: arithmetic of flags costs ten times as much
_READINGS = {int(reading.field): reading for _, reading in reversed(readings())}
_POSITION = int(Field.POSITION)
_KNOWN = sum(_READINGS) | _POSITION
_LARGEST = 1e9
_LEVER_ARM_MAX_M = 1e3
_NO_LEVER = (0.0, 0.0, 0.0)
_TILT_MAX = 0.05  # of the baseline: the first fix takes two antennas for level
_BASELINE_MAX = 50.0  # wavelengths: each takes two hypotheses
# Variances (m, rad, m/s) beyond which double precision cannot fuse with metres.
_VAR_MIN, _VAR_MAX = 1e-6**2, 1e6**2
_FAR_SD = 10.0  # of a time difference, beyond the distance of its RSUs
_ASYMMETRY_MAX = 1e-6  # relative
_CONDITION_MIN = 1e-12  # smallest over largest eigenvalue; below it a Cholesky factor is rounding


class _Limit(NamedTuple):
    """What one number of a description may be; 0 always may where it means none."""

    name: str  # in the message
    value: Callable[[RsuInfo], float]
    unit: str
    low: float
    high: float

    def fault(self, info: RsuInfo) -> str | None:
        value = self.value(info)
        if self.low <= value <= self.high or (value == 0.0 and self.low > 0.0):
            return None
        none = ", or 0 for none" if self.low > 0.0 else ""
        return (
            f"{self.name} of {info.rsu_id} is {value:g} {self.unit}; "
            f"send one from {self.low:g} to {self.high:g}{none}"
        )


def _axis(i: int) -> Callable[[RsuInfo], float]:
    return lambda info: float(info.position[i])


# Beyond these the arithmetic of a track leaves what double precision holds.
_TIME = ("s", 1e-6, 1e9)
_LIMITS = (
    *(_Limit(f"pose.position.{axis}", _axis(i), "m", -1e9, 1e9) for i, axis in enumerate("xyz")),
    *(
        _Limit(f"{name}_bias_sd", attrgetter(f"{name}_bias_sd_{unit}"), unit, 1e-9, 1e6)
        for name, unit in (("azimuth", "rad"), ("elevation", "rad"), ("range", "m"))
    ),
    _Limit("common_range_bias_sd", attrgetter("common_range_bias_sd_m"), "m", 1e-9, 1e6),
    *(
        _Limit(f"{name}_correlation_time", attrgetter(f"{name}_correlation_time_s"), *_TIME)
        for name in ("bias", "common_bias", "noise")
    ),
    _Limit("wavelength", attrgetter("wavelength_m"), "m", 1e-6, 1e6),
)


class _Checks(NamedTuple):
    """What is looked at in the scalars of a measurement."""

    quantities: tuple[tuple[attrgetter[tuple[float, float]], float], ...]
    """What reads value and variance, and the square of what makes the variance one of metres or
    radians."""
    values: tuple[tuple[attrgetter[float], Refusal], ...]


@lru_cache(256)
def _checks(fields: int) -> _Checks:
    carried = [reading for field, reading in _READINGS.items() if fields & field]
    return _Checks(
        tuple((attrgetter(r.value, r.variance), r.scale * r.scale) for r in carried),
        tuple((attrgetter(r.value), refusal) for r in carried for refusal in r.refusals),
    )


def measurement_fault(m: RsuMeasurement, map_frame: str = MAP_FRAME) -> str | None:
    """Reason to refuse an RSU measurement whatever the track thinks of it."""
    if not is_vue_id(m.vue_id):
        return "vue_id"
    if m.stamp_ns <= 0:
        return stamp_fault(m.stamp_ns)
    fields = int(m.fields)
    if not fields or fields & ~_KNOWN:
        return "no_fields" if not fields else "unknown_fields"
    checks = _checks(fields)
    for quantity, scale2 in checks.quantities:
        value, variance = quantity(m)
        if not (abs(value) < _LARGEST and math.isfinite(variance)):
            return "not_finite"
        if not _VAR_MIN <= scale2 * variance <= _VAR_MAX:
            return "variance"
    if m.lever_arm != _NO_LEVER and not all(abs(arm) < _LEVER_ARM_MAX_M for arm in m.lever_arm):
        return "lever_arm"
    if fields & REFERENCED and m.reference_rsu_id in ("", m.rsu_id):
        return "no_reference"
    for value_of, refusal in checks.values:
        if refusal.is_bad(value_of(m)):
            return refusal.reason
    if fields & _POSITION:
        return _frame_fault(m.frame_id, map_frame) or _gaussian_fault(m.position, m.position_cov)
    return None


def explanation(m: RsuMeasurement, reason: str) -> str:
    """Sentence about the scalar for which a measurement was refused: its name, its value and the
    remedy. Empty where the reason concerns no scalar."""
    if reason == "bad_stamp":
        return bad_stamp(malformed_nanosec(m.stamp_ns) or 0)
    for field, reading in _READINGS.items():
        if not int(m.fields) & field:
            continue
        value, variance = getattr(m, reading.value), getattr(m, reading.variance)
        for refusal in reading.refusals:
            if refusal.reason == reason and refusal.is_bad(value):
                return f"{reading.value} is {value:g} {reading.unit}; {refusal.remedy}"
        if reason == "not_finite" and not abs(value) < _LARGEST:
            return f"{reading.value} is {value:g} {reading.unit}; leave out what was not measured"
        if reason in ("not_finite", "variance") and not _var_limits(reading, variance):
            low, high = (limit / reading.scale**2 for limit in (_VAR_MIN, _VAR_MAX))
            return (
                f"{reading.variance} is {variance:g} {reading.unit}^2; "
                f"send one from {low:g} to {high:g}"
            )
    return ""


def _var_limits(reading: Reading, variance: float) -> bool:
    return _variance_in_range(reading.scale * reading.scale * variance)


def difference_fault(m: RsuMeasurement, rsu: Rsu, reference: Rsu | None) -> str | None:
    """Reason to refuse a time difference between two RSUs."""
    if reference is None:
        return "unknown_reference"
    between = float(np.linalg.norm(reference.info.position - rsu.info.position))
    spread = _FAR_SD * math.sqrt(m.tdoa_var) * SPEED_OF_LIGHT_MPS
    reach = between + rsu.info.baseline_m + reference.info.baseline_m + spread
    return "tdoa_too_large" if abs(m.tdoa_s) * SPEED_OF_LIGHT_MPS > reach else None


def velocity_fault(v: Velocity, map_frame: str = MAP_FRAME) -> str | None:
    """Reason to refuse a velocity."""
    if v.stamp_ns <= 0:
        return stamp_fault(v.stamp_ns)
    return "frame" if v.frame_id != map_frame else _gaussian_fault(v.velocity, v.cov)


def speed_fault(v: GroundSpeed) -> str | None:
    """Reason to refuse a ground speed."""
    if v.stamp_ns <= 0:
        return stamp_fault(v.stamp_ns)
    if not (math.isfinite(v.speed_mps) and math.isfinite(v.speed_var)):
        return "not_finite"
    if abs(v.speed_mps) >= _LARGEST:
        return "not_finite"
    return None if _variance_in_range(v.speed_var) else "variance"


def imu_fault(sample: ImuSample) -> str | None:
    """Reason to refuse an IMU sample."""
    if sample.stamp_ns <= 0:
        return stamp_fault(sample.stamp_ns)
    values = (*sample.angular_velocity.tolist(), *sample.specific_force.tolist())
    return None if all(abs(v) < _LARGEST for v in values) else "not_finite"


def pose_fault(p: InitialPose, map_frame: str = MAP_FRAME) -> str | None:
    """Reason to refuse an initial pose; its stamp may be 0 (tools send it so)."""
    if malformed_nanosec(p.stamp_ns) is not None:
        return stamp_fault(p.stamp_ns)
    return _frame_fault(p.frame_id, map_frame) or _gaussian_fault(p.position, p.cov)


def _frame_fault(frame_id: str, map_frame: str) -> str | None:
    """A place is one in the map, or says nothing of where it is."""
    return None if frame_id in ("", map_frame) else "frame"


def rsu_fault(info: RsuInfo, map_frame: str = MAP_FRAME) -> str | None:
    """Reason to refuse the description of an RSU."""
    if not info.rsu_id:
        return "rsu_id is empty"
    if _frame_fault(info.frame_id, map_frame):
        return f"pose of {info.rsu_id} is in {info.frame_id!r}; give it in {map_frame!r}"
    if not (np.isfinite(info.position).all() and np.isfinite(info.quaternion).all()):
        return f"pose of {info.rsu_id} is not finite"
    if abs(float(np.linalg.norm(info.quaternion)) - 1.0) > 1e-3:
        return f"orientation of {info.rsu_id} is not a unit quaternion"
    biases = (info.azimuth_bias_sd_rad, info.elevation_bias_sd_rad, info.range_bias_sd_m)
    common = info.common_range_bias_sd_m
    if not all(0.0 <= sd < _LARGEST for sd in (*biases, common)):
        return f"bias sd of {info.rsu_id} must be finite and >= 0"
    if any(biases) and not info.bias_correlation_time_s > 0.0:
        return f"bias_correlation_time of {info.rsu_id} must be > 0 s where it has a bias"
    if common and not info.common_bias_correlation_time_s > 0.0:
        return f"common_bias_correlation_time of {info.rsu_id} must be > 0 s where it has a bias"
    if not 0.0 <= info.noise_correlation_time_s < _LARGEST:
        return f"noise_correlation_time of {info.rsu_id} must be finite and >= 0 s"
    nanosec = malformed_nanosec(info.stamp_ns)
    if nanosec is not None:
        return f"RsuInfo of {info.rsu_id}: {bad_stamp(nanosec)}"
    outside = (limit.fault(info) for limit in _LIMITS)
    return _array_fault(info) or next((fault for fault in outside if fault), None)


def _array_fault(info: RsuInfo) -> str | None:
    """Reason to refuse the two antennas of an RSU; both values are 0 where it has none."""
    baseline, wavelength = info.baseline_m, info.wavelength_m
    if not (0.0 <= baseline < _LARGEST and 0.0 <= wavelength < _LARGEST):
        return f"baseline and wavelength of {info.rsu_id} must be finite and >= 0 m"
    if baseline > 0.0 and wavelength == 0.0:
        return (
            f"{info.rsu_id} has a baseline of {baseline:g} m but no wavelength; "
            "give the wavelength of its channel [m]"
        )
    if wavelength > 0.0 and baseline < wavelength / 2.0 * (1.0 - 1e-9):
        return (
            f"baseline of {info.rsu_id} must be at least half its wavelength of {wavelength:g} m, "
            f"got {baseline:g} m"
        )
    if baseline > _BASELINE_MAX * wavelength:
        return (
            f"baseline of {info.rsu_id} must be at most {_BASELINE_MAX:g} wavelengths of "
            f"{wavelength:g} m, got {baseline:g} m"
        )
    tilt = abs(float(rsu_axes(info)[5])) if baseline > 0.0 else 0.0
    if tilt > _TILT_MAX:
        return (
            f"the antennas of {info.rsu_id} must be level, one is {100.0 * tilt:.0f} % of the "
            "baseline above the other; correct its orientation"
        )
    return None


def _gaussian_fault(value: Array, cov: Array) -> str | None:
    """Judges the first two components."""
    x, y = value[:2].tolist()
    (xx, xy), (yx, yy) = cov[:2, :2].tolist()
    if not all(map(math.isfinite, (x, y, xx, xy, yx, yy))):
        return "not_finite"
    if abs(x) >= _LARGEST or abs(y) >= _LARGEST:
        return "not_finite"
    if abs(xy - yx) > _ASYMMETRY_MAX * min(abs(xy), abs(yx)):
        return "variance"
    smallest, largest = eigenvalues(xx, (xy + yx) / 2.0, yy)
    definite = smallest > _CONDITION_MIN * largest
    sound = definite and _variance_in_range(smallest) and _variance_in_range(largest)
    return None if sound else "variance"


def _variance_in_range(variance: float) -> bool:
    return _VAR_MIN <= variance <= _VAR_MAX
