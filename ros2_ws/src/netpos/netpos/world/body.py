"""State of the body that carries a device, in the plane and in three dimensions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from netpos.world.frames import quaternion_from_yaw

Array = npt.NDArray[np.float64]

_TIME_TOLERANCE_S = 1e-9  # stamps are whole nanoseconds


@dataclass(frozen=True, slots=True, kw_only=True)
class Kinematics:
    """State of motion at n instants: position, velocity, acceleration (n, 2) in map; yaw, yaw_rate
    (n,) rad, rad/s."""

    position: Array
    velocity: Array
    acceleration: Array
    yaw: Array
    yaw_rate: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class BodyState:
    """Motion of a body in three dimensions at n instants: position, velocity (n, 3) in map;
    ``rotation`` n rotations body -> map; angular_velocity (n, 3) rad/s in body axes."""

    position: Array
    velocity: Array
    rotation: Rotation
    angular_velocity: Array


class BodyMotion(Protocol):
    """Motion that carries a device: a vehicle's ``Motion`` or a person's gait."""

    duration_s: float
    smooth: bool

    def body_at(self, time_s: npt.ArrayLike) -> BodyState:
        """State at times (n,) since the start [s]; z is the height over the route."""
        ...


def check_times(time_s: npt.ArrayLike, duration_s: float) -> Array:
    """(n,) times; ``ValueError`` where one is not finite or outside [0, duration_s]."""
    t = np.atleast_1d(np.asarray(time_s, dtype=np.float64))
    if not ((t >= 0) & (t <= duration_s + _TIME_TOLERANCE_S)).all():
        raise ValueError(f"time must be in [0, {duration_s}] s, got {t.min()} to {t.max()}")
    return t


def level(state: Kinematics) -> BodyState:
    """A plane motion as the motion of a level body in three dimensions."""
    zero = np.zeros((len(state.yaw), 2))
    return BodyState(
        position=np.hstack([state.position, zero[:, :1]]),
        velocity=np.hstack([state.velocity, zero[:, :1]]),
        rotation=Rotation.from_quat(quaternion_from_yaw(state.yaw)),
        angular_velocity=np.hstack([zero, state.yaw_rate[:, None]]),
    )


def on_hills(state: Kinematics, height: Array, climb: Array, rate: Array) -> BodyState:
    """A plane motion as the motion of a body that pitches with its climb."""
    speed = np.hypot(*state.velocity.T)
    gained = (state.velocity * state.acceleration).sum(axis=1) / speed
    pitch = -np.arctan2(climb, speed)
    pitch_rate = -(rate * speed - climb * gained) / (speed**2 + climb**2)
    turning = [-state.yaw_rate * np.sin(pitch), pitch_rate, state.yaw_rate * np.cos(pitch)]
    return BodyState(
        position=np.column_stack([state.position, height]),
        velocity=np.column_stack([state.velocity, climb]),
        rotation=Rotation.from_euler("ZY", np.column_stack([state.yaw, pitch])),
        angular_velocity=np.column_stack(turning),
    )
