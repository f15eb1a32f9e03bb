"""Angles and orientations: map is ENU, base_link is FLU (REP-103), yaw is counter-clockwise from
east."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def wrap_angle(angle_rad: npt.ArrayLike) -> Array:
    """Angle in [-pi, pi); any shape."""
    return np.asarray(np.mod(np.asarray(angle_rad) + np.pi, 2 * np.pi) - np.pi)


def quaternion_from_yaw(yaw_rad: npt.ArrayLike) -> Array:
    """Level orientation (..., 4), x y z w, of a heading (...)."""
    half = np.asarray(yaw_rad, dtype=np.float64) / 2
    zero = np.zeros_like(half)
    return np.stack([zero, zero, np.sin(half), np.cos(half)], axis=-1)


def yaw_from_quaternion(quaternion: npt.ArrayLike) -> Array:
    """Heading (...) of the body's x axis for an orientation (..., 4), x y z w."""
    x, y, z, w = np.moveaxis(np.asarray(quaternion, dtype=np.float64), -1, 0)
    return np.asarray(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
