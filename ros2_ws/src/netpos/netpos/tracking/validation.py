"""What is refused at the door. Every function returns the reason, or None for a sound value."""

from __future__ import annotations

import math

import numpy as np

from netpos.messages.codec import MAP_FRAME
from netpos.messages.values import (
    Array,
    Field,
    GroundSpeed,
    InitialPose,
    RsuInfo,
    RsuMeasurement,
    Velocity,
)

_SCALARS = (
    (Field.AZIMUTH, "azimuth_rad", "azimuth_var"),
    (Field.ELEVATION, "elevation_rad", "elevation_var"),
    (Field.TOA, "toa_s", "toa_var"),
    (Field.RANGE, "range_m", "range_var"),
    (Field.PHASE, "phase_difference_rad", "phase_difference_var"),
)
_KNOWN = sum(flag for flag, _, _ in _SCALARS) | Field.POSITION
_LARGEST = 1e9


def measurement_fault(m: RsuMeasurement) -> str | None:
    """Reason to refuse an RSU measurement whatever the track thinks of it."""
    if m.stamp_ns <= 0:
        return "zero_stamp"
    if not m.fields & _KNOWN or m.fields & ~_KNOWN:
        return "no_fields" if not m.fields else "unknown_fields"
    for flag, name, var_name in _SCALARS:
        if m.fields & flag:
            value, variance = getattr(m, name), getattr(m, var_name)
            if not (math.isfinite(value) and abs(value) < _LARGEST and math.isfinite(variance)):
                return "not_finite"
            if variance <= 0.0:
                return "variance"
    if m.fields & Field.RANGE and m.range_m < 0.0:
        return "negative_range"
    if m.fields & Field.POSITION:
        return _gaussian_fault(m.position[:2], m.position_cov[:2, :2])
    return None


def velocity_fault(v: Velocity) -> str | None:
    """Reason to refuse a velocity."""
    if v.stamp_ns <= 0:
        return "zero_stamp"
    return "frame" if v.frame_id != MAP_FRAME else _gaussian_fault(v.velocity, v.cov)


def speed_fault(v: GroundSpeed) -> str | None:
    """Reason to refuse a ground speed."""
    if v.stamp_ns <= 0:
        return "zero_stamp"
    if not (math.isfinite(v.speed_mps) and math.isfinite(v.speed_var)):
        return "not_finite"
    return "variance" if v.speed_var <= 0.0 else None


def pose_fault(p: InitialPose) -> str | None:
    """Reason to refuse an initial pose; its stamp may be 0 (tools send it so)."""
    return _gaussian_fault(p.position[:2], p.cov[:2, :2])


def rsu_fault(info: RsuInfo) -> str | None:
    """Reason to refuse the description of an RSU."""
    if not info.rsu_id:
        return "rsu_id is empty"
    if not (np.isfinite(info.position).all() and np.isfinite(info.quaternion).all()):
        return f"pose of {info.rsu_id} is not finite"
    if abs(float(np.linalg.norm(info.quaternion)) - 1.0) > 1e-3:
        return f"orientation of {info.rsu_id} is not a unit quaternion"
    biases = (info.azimuth_bias_sd_rad, info.elevation_bias_sd_rad, info.range_bias_sd_m)
    if not all(math.isfinite(sd) and sd >= 0.0 for sd in biases):
        return f"bias sd of {info.rsu_id} must be finite and >= 0"
    if any(biases) and not info.bias_correlation_time_s > 0.0:
        return f"bias_correlation_time of {info.rsu_id} must be > 0 s where it has a bias"
    return None


def _gaussian_fault(value: Array, cov: Array) -> str | None:
    if not (np.isfinite(value).all() and np.isfinite(cov).all()):
        return "not_finite"
    if (np.abs(value) >= _LARGEST).any():
        return "not_finite"
    if not np.allclose(cov, cov.T, rtol=1e-6, atol=0.0) or np.linalg.eigvalsh(cov)[0] <= 0.0:
        return "variance"
    return None
