"""From the parameters of a tracker to the arrays its kernels take."""

from __future__ import annotations

import numpy as np

from netpos.estimation.chi_square import chi_square_bound
from netpos.estimation.densities import Density, held
from netpos.estimation.engine import GATE_SIZE, FilterOptions
from netpos.estimation.forms.table import form_of, number_of
from netpos.estimation.mixture.epoch import Dynamics
from netpos.estimation.motion import SPEED_OF_LIGHT_MPS, Model, ProcessNoise, motion_parameters
from netpos.estimation.motion.model import MotionModel
from netpos.estimation.state import N_CORE, POSITION, HeightState, X
from netpos.estimation.update.conditioning import RobustOptions
from netpos.messages.values import Array
from netpos.tracking.config import ROBUST, TrackerConfig
from netpos.tracking.rsus.learning import LearnedErrors
from netpos.tracking.rsus.rsu import BiasStates, SlowErrors

_FOLLOWS_NONE = 2**31 - 1  # more states than there are


def gate_thresholds(probability: float) -> Array:
    """Largest accepted squared Mahalanobis distance for 0, 1, ... degrees of freedom (chi-square
    quantiles)."""
    bounds = [chi_square_bound(dof, 1.0 - probability) for dof in range(1, GATE_SIZE)]
    return np.array([0.0, *bounds])


def options_of(config: TrackerConfig) -> FilterOptions:
    """What the kernels of a planar track take of the parameters."""
    form = form_of(config.filter)
    return FilterOptions(
        filter=number_of(form),
        iterations=form.iterations,
        height_m=float(config.device_height_m),
        inflate_after=int(config.inflate_after_epochs),
        lost_after=int(config.max_rejected_epochs),
        initial_speed_sd=float(config.initial_speed_sd_mps),
        manoeuvre_speed_sd=config.manoeuvre_sd_mps,
        integrity_risk=float(config.integrity_risk),
        robust=robust_options_of(config),
        models=max(len(config.motion_models), 1),
        first_slow_error=first_slow_error(config) if form.is_extended else _FOLLOWS_NONE,
        sector_slip=float(config.sector_slip_probability) if by_sectors(config) else 0.0,
        learns_density=config.learns_density,
        of_form=np.array([float(getattr(config, name)) for name in form.parameters]),
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
    """Vectors ``motion``, one per motion model (k, size); k > 1 when they interact."""
    models = config.motion_models
    extras = max(len(model.states) for model in models)
    idle = max(initial_extra_sd(config), default=0.0) if len(models) > 1 else 0.0
    return np.array([_motion_of(config, model, extras, idle) for model in models])


def dynamics_of(config: TrackerConfig, bias: Array) -> Dynamics:
    """The motion models of a planar track, as new arrays, and the biases (2, k)."""
    motions = motions_of(config)
    return Dynamics(motions, np.full(len(motions), config.sojourn_s), bias)


def _motion_of(config: TrackerConfig, model: MotionModel, extras: int, idle: float) -> Array:
    c = SPEED_OF_LIGHT_MPS
    accel = held(config.accel_density_mps2_sqrthz, Density.ACCEL)
    if model.accel_density is not None:
        accel = getattr(config, model.accel_density)
    elif config.process_noise == "white_acceleration":
        accel = config.accel_sd_mps2
    return motion_parameters(
        Model[model.name],
        ProcessNoise[config.process_noise.upper()],
        extras,
        accel=accel,
        velocity_step=config.velocity_step_sd_mps,
        offset_density=c * config.clock_white_density,
        drift_density=held(c * config.clock_walk_density, Density.CLOCK),
        drift_step=c * config.drift_step_sd,
        idle=idle,
        gyro=config.gyro_noise_density,
        **{name: getattr(config, parameter) for name, parameter in model.own.items()},
    )


def heading_index(config: TrackerConfig) -> int:
    """State index of the heading; -1 where the motion model has none of its own."""
    models = config.motion_models
    return models[0].heading if len(models) == 1 else -1


def carries_modes(config: TrackerConfig) -> bool:
    """Whether an estimate may start as a mixture; others are one Gaussian, or merge what differs
    in heading only."""
    return not config.interacts and heading_index(config) < 0


def by_sectors(config: TrackerConfig) -> bool:
    """Whether every sector of a phase difference is a component."""
    single = len(config.motion_models) == 1 and heading_index(config) < 0
    return config.ambiguity == "hypotheses" and single


def initial_extra_sd(config: TrackerConfig) -> Array:
    """Standard deviations of the motion models' own states at the first fix; their means are 0."""
    sds = [model.initial_sd(config) for model in config.motion_models]
    return np.array(max(sds, key=len, default=()), dtype=float)


def first_slow_error(config: TrackerConfig) -> int:
    """Index of the first slow error of a planar state, behind those of the motion models and the
    height."""
    others = slow_states(config)
    return others.first + len(others.sd)


def height_state(config: TrackerConfig) -> HeightState:
    """Where the state of a planar track has the height of the device."""
    unknown = config.device_height_sd_m > 0.0
    entry = N_CORE + initial_extra_sd(config).size if unknown else 0
    return HeightState(entry, float(config.device_height_m))


def slow_states(config: TrackerConfig, learned: LearnedErrors | None = None) -> BiasStates:
    """The states of a new track that are first-order Gauss-Markov processes: the height of the
    device where it is unknown; those of RSUs follow when they are heard."""
    slow = BiasStates(N_CORE + initial_extra_sd(config).size, config.step_errors, learned)
    if height_state(config).entry:
        slow.sd = [float(config.device_height_sd_m)]
        slow.tau_s = [float(config.device_height_time_s)]
    return slow


def start_state(config: TrackerConfig, mean: Array, cov: Array) -> tuple[Array, Array]:
    """Mean and covariance that a filter starts from: core states (6,), (6, 6), to which the
    motion model's own states and the height come. What has all of them stays as it is."""
    sd = np.append(initial_extra_sd(config), slow_states(config).sd)
    return augmented(mean, cov, sd)


def state_of_fit(
    config: TrackerConfig, mean: Array, cov: Array, slow: SlowErrors
) -> tuple[Array, Array]:
    """Mean and covariance that a filter starts from after a fit: core states and the slow errors
    that last, (n,), (n, n). The motion model's own states and the other errors are not known."""
    sd = np.concatenate([np.zeros(N_CORE), initial_extra_sd(config), slow.sd])
    fitted = np.concatenate([np.arange(N_CORE), slow.first + np.flatnonzero(slow.lasts)])
    start, start_cov = np.zeros(sd.size), np.diag(sd**2)
    start[fitted] = mean
    start_cov[np.ix_(fitted, fitted)] = cov
    return start, start_cov


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


def augmented(mean: Array, cov: Array, sd: Array, first: int = N_CORE) -> tuple[Array, Array]:
    """Mean and covariance (n, n) with the last entries of ``sd`` appended as independent states of
    mean 0, so that there are as many as ``first`` + len(sd)."""
    n = len(cov)
    new = sd[n - first :]
    if not new.size:
        return mean, cov
    larger = np.zeros((n + new.size, n + new.size))
    larger[:n, :n] = cov
    larger[n:, n:] = np.diag(new**2)
    return np.append(mean, np.zeros(new.size)), larger
