"""From the parameters of a tracker to the arrays its kernels take."""

from __future__ import annotations

import math

import numpy as np

from netpos.estimation.chi_square import chi_square_bound
from netpos.estimation.conditioning import RobustOptions
from netpos.estimation.engine import GATE_SIZE, FilterOptions
from netpos.estimation.motion import (
    SPEED_OF_LIGHT_MPS,
    Model,
    ProcessNoise,
    extra_states,
    motion_parameters,
)
from netpos.estimation.state import N_CORE, POSITION, X
from netpos.messages.values import Array
from netpos.tracking.config import FILTERS, ROBUST, TrackerConfig

FILTER_ITERATIONS = {"ekf": 1, "iekf": 8}


def gate_thresholds(probability: float) -> Array:
    """Largest accepted squared Mahalanobis distance for 0, 1, ... degrees of freedom (chi-square
    quantiles)."""
    bounds = [chi_square_bound(dof, 1.0 - probability) for dof in range(1, GATE_SIZE)]
    return np.array([0.0, *bounds])


def options_of(config: TrackerConfig) -> FilterOptions:
    """What the kernels of a planar track take of the parameters."""
    return FilterOptions(
        filter=FILTERS.index(config.filter),
        iterations=FILTER_ITERATIONS.get(config.filter, 1),
        height_m=float(config.device_height_m),
        inflate_after=int(config.inflate_after_epochs),
        lost_after=int(config.max_rejected_epochs),
        initial_speed_sd=float(config.initial_speed_sd_mps),
        manoeuvre_speed_sd=config.manoeuvre_sd_mps,
        coast_after_s=float(config.coast_after_s),
        integrity_risk=float(config.integrity_risk),
        robust=robust_options_of(config),
        gain_floor=np.array(
            [config.position_gain_min, config.velocity_gain_min, config.accel_gain_min]
        ),
        gate_nis=gate_thresholds(config.gate_probability),
    )


def robust_options_of(config: TrackerConfig) -> RobustOptions:
    """How the rows of a planar or spatial track are re-weighted."""
    return RobustOptions(
        kind=ROBUST.index(config.robust),
        parameter=float(config.robust_parameter),
        nlos_probability=float(config.nlos_probability),
        nlos_excess_m=float(config.nlos_mean_excess_m),
    )


def motions_of(config: TrackerConfig) -> Array:
    """Vectors of ``motion.Parameter``, one per motion model (k, Parameter); k > 1 when they
    interact."""
    names = [config.motion_model]
    if config.motion_model == "interacting":
        names = ["stationary", "constant_velocity", "constant_turn"]
    models = [Model[name.upper()] for name in names]
    extras = max(extra_states(model) for model in models)
    c = SPEED_OF_LIGHT_MPS
    accel = config.accel_density_mps2_sqrthz
    if config.use_imu:
        accel = config.inertial_accel_density_mps2_sqrthz
    elif config.process_noise == "white_acceleration":
        accel = config.accel_sd_mps2
    return np.array(
        [
            motion_parameters(
                model,
                ProcessNoise[config.process_noise.upper()],
                extras,
                accel=accel,
                velocity_step=config.velocity_step_sd_mps,
                offset_density=c * config.clock_white_density,
                drift_density=c * config.clock_walk_density,
                drift_step=c * config.drift_step_sd,
                turn_rate=config.turn_rate_density,
                jerk=config.jerk_density,
                rest_speed=config.rest_speed_sd_mps,
                gyro=config.gyro_noise_density,
                gyro_bias=config.gyro_bias_walk,
                accel_bias=config.accel_bias_walk,
            )
            for model in models
        ]
    )


def heading_index(config: TrackerConfig) -> int:
    """State index of the heading; -1 where the motion model has none of its own."""
    return int(X.YAW) if config.motion_model == "rigid_body" else -1


def by_sectors(config: TrackerConfig) -> bool:
    """Whether phase differences are resolved by a bank of filters."""
    single = config.motion_model not in ("interacting", "rigid_body", "strapdown")
    return config.ambiguity == "hypotheses" and config.backend == "compiled" and single


def initial_extra_sd(config: TrackerConfig) -> Array:
    """Standard deviations of the motion model's own states at the first fix; their means are 0."""
    match config.motion_model:
        case "constant_turn" | "interacting":
            return np.array([config.turn_rate_density])
        case "rigid_body":
            return np.array([math.pi / math.sqrt(3.0), config.turn_rate_density])
        case "constant_acceleration":
            return np.full(2, config.accel_state_sd_mps2)
        case "inertial":
            return np.array([config.gyro_bias_sd_radps, config.accel_bias_sd_mps2])
    return np.zeros(0)


def pose_state(config: TrackerConfig, position: Array, position_cov: Array) -> tuple[Array, Array]:
    """Mean (6,) and covariance (6, 6) that a given position (2,) m with covariance (2, 2) starts
    from: fokin2020:eq.32, 33."""
    c = SPEED_OF_LIGHT_MPS
    mean = np.zeros(N_CORE)
    mean[POSITION] = position
    mean[X.DRIFT] = c * config.clock_drift_mean
    sd = [1.0, 1.0, *([config.initial_speed_sd_mps] * 2)]
    cov = np.diag(np.array([*sd, c * config.clock_offset_sd_s, c * config.clock_drift_sd]) ** 2)
    cov[POSITION, POSITION] = position_cov
    return mean, cov


def augmented(mean: Array, cov: Array, sd: Array) -> tuple[Array, Array]:
    """Mean and covariance with the last entries of ``sd`` appended as independent states of mean
    0, so that there are as many as 6 + len(sd)."""
    new = sd[mean.size - N_CORE :]
    if not new.size:
        return mean, cov
    n = mean.size + new.size
    larger = np.zeros((n, n))
    larger[: mean.size, : mean.size] = cov
    larger[mean.size :, mean.size :] = np.diag(new**2)
    return np.append(mean, np.zeros(new.size)), larger
