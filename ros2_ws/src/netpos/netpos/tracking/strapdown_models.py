"""From the parameters of a tracker to what the strapdown filter takes."""

from __future__ import annotations

import math

import numpy as np

from netpos.filters.error_state import Constraints
from netpos.inertial.strapdown import (
    ERR,
    NAV,
    POSITION,
    QUATERNION,
    VELOCITY,
    Earth,
    InertialNoise,
    earth_at,
)
from netpos.messages.values import Array
from netpos.tracking.config import TrackerConfig
from netpos.tracking.strapdown_engine import Sensors


def sensors_of(config: TrackerConfig) -> Sensors:
    """Errors of the IMU, the earth and the constraints of the vehicle."""
    turning = earth_at(math.radians(config.latitude_deg)).rate
    return Sensors(
        noise=InertialNoise(
            config.inertial_accel_density_mps2_sqrthz,
            config.gyro_noise_density,
            config.accel_bias_sd_mps2,
            config.gyro_bias_sd_radps,
            config.bias_correlation_time_s,
        ),
        earth=Earth(config.gravity_mps2, turning if config.earth_rate else np.zeros(3)),
        constraints=Constraints(
            config.sideways_sd_mps,
            config.upwards_sd_mps,
            config.standstill_sd_mps,
            config.still_force_mps2,
            config.still_rate_radps,
        ),
    )


def nav_of(position: Array, velocity: Array, quaternion: Array) -> Array:
    """Navigation state (NAV,) of a pose and a velocity (3,) in map, without biases."""
    nav = np.zeros(NAV)
    nav[POSITION:VELOCITY], nav[VELOCITY:QUATERNION] = position, velocity
    nav[QUATERNION : QUATERNION + 4] = quaternion
    return nav


def start_sd(
    config: TrackerConfig, position_m: float, velocity_mps: float, tilt: float, heading: float
) -> Array:
    """Standard deviations (ERR,) of a start: per axis of position and velocity, of roll and
    pitch, of the heading [rad], and the biases of the sensors."""
    sd = np.empty(ERR)
    sd[:3], sd[3:6], sd[6:8], sd[8] = position_m, velocity_mps, tilt, heading
    sd[9:12], sd[12:] = config.accel_bias_sd_mps2, config.gyro_bias_sd_radps
    return sd
