"""From the parameters of a tracker to what the strapdown filter takes."""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg import block_diag

from netpos.estimation.densities import Density, held
from netpos.estimation.motion import SPEED_OF_LIGHT_MPS
from netpos.estimation.spatial.error_state import Constraints, Sensors, SlowErrors
from netpos.estimation.state import (
    ERR_ACCEL_BIAS,
    ERR_GYRO_BIAS,
    ERR_POSITION,
    ERR_VELOCITY,
    NAV_POSITION,
    NAV_QUATERNION,
    NAV_VELOCITY,
    Err,
)
from netpos.inertial.strapdown import (
    ERR,
    NAV,
    Earth,
    InertialNoise,
    earth_at,
)
from netpos.messages.values import Array
from netpos.tracking.config import TrackerConfig


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
        slow=SlowErrors(
            SPEED_OF_LIGHT_MPS * config.clock_white_density,
            held(SPEED_OF_LIGHT_MPS * config.clock_walk_density, Density.CLOCK),
            np.zeros((2, 0)),
        ),
    )


def nav_of(position: Array, velocity: Array, quaternion: Array) -> Array:
    """Navigation state (NAV,) of a pose and a velocity (3,) in map, without biases."""
    nav = np.zeros(NAV)
    nav[NAV_POSITION], nav[NAV_VELOCITY], nav[NAV_QUATERNION] = position, velocity, quaternion
    return nav


def with_clock(config: TrackerConfig, nav: Array, cov: Array) -> tuple[Array, Array]:
    """A start nav (NAV,), cov (ERR, ERR) with the clock of which nothing has been heard."""
    c = SPEED_OF_LIGHT_MPS
    sd = np.array([c * config.clock_offset_sd_s, c * config.clock_drift_sd])
    return np.append(nav, [0.0, c * config.clock_drift_mean]), block_diag(cov, np.diag(sd**2))


def start_sd(
    config: TrackerConfig, position_m: float, velocity_mps: float, tilt: float, heading: float
) -> Array:
    """Standard deviations (ERR,) of a start: per axis of position and velocity, of roll and
    pitch, of the heading [rad], and the biases of the sensors."""
    sd = np.empty(ERR)
    sd[ERR_POSITION], sd[ERR_VELOCITY] = position_m, velocity_mps
    sd[Err.ROLL], sd[Err.PITCH], sd[Err.YAW] = tilt, tilt, heading
    sd[ERR_ACCEL_BIAS], sd[ERR_GYRO_BIAS] = config.accel_bias_sd_mps2, config.gyro_bias_sd_radps
    return sd
