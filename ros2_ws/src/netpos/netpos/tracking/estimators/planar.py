"""The planar estimator: position, velocity and clock by the filters of ``estimates``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import count
from typing import Self

import numpy as np

from netpos.estimation.measurement import VARIANCE
from netpos.estimation.mixture.gaussians import Mixture, moments, one_component
from netpos.estimation.state import N_CORE, POSITION, VELOCITY
from netpos.estimation.update.fit import innovations_with_sd
from netpos.messages.values import (
    Array,
    InitialPose,
    NetworkTrack,
    Odometry,
    RsuErrors,
    RsuMeasurement,
    StepCalibration,
    TrackMode,
    Velocity,
)
from netpos.tracking import output
from netpos.tracking.config import TrackerConfig
from netpos.tracking.estimators import estimates
from netpos.tracking.estimators.adaptive_process_noise import AdaptiveProcessNoise
from netpos.tracking.estimators.epoch_rows import EpochRows, Source, planar_form
from netpos.tracking.estimators.estimates import Estimate, UpdateResult
from netpos.tracking.estimators.estimator import (
    Description,
    Estimator,
    FirstFix,
    Past,
    Recent,
)
from netpos.tracking.estimators.models import (
    carries_modes,
    heading_index,
    height_state,
    initial_extra_sd,
    pose_state,
    slow_states,
)
from netpos.tracking.first_fix.initialise import Initialiser
from netpos.tracking.first_fix.lever_arm_heading import with_heading
from netpos.tracking.first_fix.phase_start import PhaseStart
from netpos.tracking.networks.secondary import OwnNoise, Secondary
from netpos.tracking.rsus.learning import LearnedErrors
from netpos.tracking.rsus.rsu import Rsu
from netpos.tracking.rsus.shared_errors import SharedErrors
from netpos.tracking.rsus.shift import DeviceState
from netpos.tracking.smoothing.planar import Posterior, PosteriorRecorder

_IMU_HOLE_S = 0.05
_BLIND_GYRO = 1.0  # rad/s/sqrt(Hz): what the heading does while the IMU is silent
_OPEN_HEADING = (
    "the heading of the body is open: measure two of its antennas, apart by their lever arms"
)


class PlanarEstimator(Estimator):
    """Estimator of a device that moves at a known height."""

    estimate: Estimate | None
    recorder: PosteriorRecorder | None = None

    def __init__(
        self,
        vue_id: str,
        config: TrackerConfig,
        rsus: Mapping[str, Rsu],
        shared: SharedErrors | None = None,
    ) -> None:
        self._heading = heading_index(config)
        self._height = height_state(config)
        super().__init__(vue_id, config, rsus, planar_form(self._heading, self._height))
        self._shared, self._lives = shared, count(1)
        self._extra_sd = initial_extra_sd(config)
        # states of a motion model have directions; a track for others is one Gaussian
        one_model = carries_modes(config) and not self._extra_sd.size
        self._may_mirror = one_model and not config.network
        self._use_imu, self._calibrates_steps = config.use_imu, config.calibrates_steps
        self._secondary = Secondary(vue_id, config) if config.network else None
        if config.fixed_lag_s > 0.0:
            self.recorder = PosteriorRecorder(vue_id, config)
        self._forget()

    def _forget(self) -> None:
        config = self._config
        learned = (
            LearnedErrors(self._shared, (self._vue_id, next(self._lives)))
            if config.learn_errors
            else None
        )
        self.estimate = None
        self.biases = slow_states(config, learned)
        self.bias = self.biases.arrays()
        self._initialiser = Initialiser(config)
        self._phase_start = PhaseStart(config)
        self._process_noise = AdaptiveProcessNoise(config)
        self._own: OwnNoise | None = None
        self._pose: tuple[int, Array, Array] | None = None  # waits for its heading
        self._yaw = 0.0

    def set_config(self, config: TrackerConfig) -> None:
        super().set_config(config)
        self._phase_start.config = config
        self._process_noise.set_config(config)
        if self.estimate is not None:
            self.estimate.set_config(config)

    def copy(self) -> Self:
        twin = super().copy()
        twin._process_noise = self._process_noise.copy()
        if self.estimate is None:
            twin._initialiser = self._initialiser.copy()
            twin._phase_start = self._phase_start.copy()
        else:
            twin.estimate = self.estimate.copy()
        return twin

    @property
    def missing(self) -> str:
        return self._initialiser.missing

    def innovations(self, rows: Array) -> Array:
        mean, cov = self._there().moments
        innovations: Array = innovations_with_sd(mean, cov, rows, self._config.device_height_m)
        return innovations

    def _there(self) -> Estimate:
        assert self.estimate is not None
        return self.estimate

    # first fix

    def pose_cost(self, stamp_ns: int, pose: InitialPose, recent: Recent | None) -> float:
        window = self._initialiser if recent is None else Initialiser(self._config)
        for then_ns, rows in recent or ():
            self._collect(window, then_ns, rows)
        return self._excess_cost(window, stamp_ns, pose)

    def start_from_pose(self, stamp_ns: int, pose: InitialPose) -> bool:
        mean, cov = pose_state(self._config, pose.position[:2], pose.cov[:2, :2])
        if self._heading >= 0:
            self._pose = stamp_ns, mean, cov  # the first antennas tell the heading
            return False
        self.estimate = Estimate(self._config, stamp_ns, mean, cov)
        return True

    def first_fix(self, stamp_ns: int, epoch_rows: EpochRows) -> FirstFix:
        bias_var = epoch_rows.slow_variance(self.biases)
        if self._phase_start.heard(epoch_rows):
            self.estimate = self._phase_start.add(stamp_ns, epoch_rows.rows, bias_var)
            return FirstFix(self.estimate is not None)
        pose = self._pose_at(stamp_ns)
        if pose is None:
            self._collect(self._initialiser, stamp_ns, epoch_rows)
        slow = self.biases.slow_errors
        fix = one_component(*pose) if pose is not None else self._initialiser.solve(slow)
        if fix is None:
            return FirstFix(False)
        if self._heading >= 0:
            rows = epoch_rows.rows.copy()
            rows[:, VARIANCE] += bias_var
            mean, cov = moments(fix)
            core = mean[:N_CORE], cov[:N_CORE, :N_CORE]
            turned = with_heading(*core, rows, self._config.device_height_m)
            if turned is None:
                self._initialiser.missing = _OPEN_HEADING
                return FirstFix(False, refused="heading_open")
            fix = one_component(*turned)
        has_mirror = self._may_mirror and pose is None
        mirror = self._initialiser.mirror(fix) if has_mirror else None
        self.estimate = estimates.start_from(self._config, stamp_ns, fix, mirror)
        return FirstFix(True, epoch_rows.has_time)

    def _pose_at(self, stamp_ns: int) -> tuple[Array, Array] | None:
        """The initial pose that waits for its heading, for a device that has moved since; None
        where it is older than the longest gap."""
        if self._pose is None:
            return None
        given_ns, mean, cov = self._pose
        age_s = (stamp_ns - given_ns) * 1e-9
        if age_s > self._config.max_gap_s:
            return None
        moved = cov.copy()
        moved[POSITION, POSITION] += age_s**2 * cov[VELOCITY, VELOCITY]
        return mean, moved

    # estimate

    def predict(self, stamp_ns: int) -> None:
        estimate = self.estimate
        if estimate is not None and stamp_ns > estimate.stamp_ns:
            self._prepared(stamp_ns).predict(stamp_ns, self.bias)

    def _prepared(self, stamp_ns: int, items: tuple[Source, ...] = ()) -> Estimate:
        """The estimate with the biases heard of, the IMU up to ``stamp_ns`` and what velocities
        say of its motion, not yet moved."""
        estimate = self._there()
        if estimate.mean.size < self.biases.first + len(self.biases.sd):
            estimate.augment(np.append(self._extra_sd, self.bias[0]))
        if self._use_imu:
            yaw, speed, uncovered_s = self.imu.increments(estimate.stamp_ns, stamp_ns)
            blind = uncovered_s > _IMU_HOLE_S
            gyro = _BLIND_GYRO if blind else self._config.gyro_noise_density
            estimate.set_imu_increment(yaw, speed, gyro)
        velocities = [item for item in items if isinstance(item, Velocity)]
        if velocities or self._process_noise.hears(stamp_ns):
            free = estimate.declared_density
            density = self._process_noise.density(stamp_ns, free, velocities)
            estimate.set_process_noise(density)
        return estimate

    def update(self, stamp_ns: int, epoch_rows: EpochRows, past: Past) -> UpdateResult:
        rows, unheard_s = epoch_rows.rows, past.unheard_s
        estimate = self._prepared(stamp_ns, epoch_rows.items)
        was_one = estimate.is_smoothable
        result = estimate.step(stamp_ns, unheard_s, past.rejected_in_row, rows, self.bias)
        if self._secondary is not None:
            self._own = self._secondary.after(self._own, stamp_ns, estimate, rows, self.bias)
        self._keep_in_front(epoch_rows, result.accepted)
        # a smoother does not reach across: it keeps one Gaussian, and its clock does not step
        breaks = result.breaks > 0 or estimate.is_smoothable != was_one
        return result._replace(breaks=int(breaks))

    def _keep_in_front(self, epoch_rows: EpochRows, accepted: Sequence[float]) -> None:
        """Take away what is behind an array that hears the device."""
        estimate = self._there()
        for item, taken in zip(epoch_rows.items, accepted, strict=True):
            if not taken or not isinstance(item, RsuMeasurement):
                continue
            rsu = self._rsus[item.rsu_id]
            if rsu.cone:
                across = math.hypot(rsu.axes[0], rsu.axes[1])
                estimate.keep_in_front(rsu.info.position[:2], rsu.axes[:2] / across)

    def learn(
        self, stamp_ns: int, rows: Array, accepted: Sequence[float]
    ) -> tuple[RsuErrors, ...]:
        estimate, biases = self.estimate, self.biases
        if biases.learned is None or estimate is None or estimate.modes:
            return ()
        mean, cov = (of_it.copy() for of_it in estimate.likeliest)
        height_m, density = self._config.device_height_m, estimate.accel_density
        posterior = DeviceState(stamp_ns, mean, cov, height_m, density)
        concluded, changes = biases.learn(rows, np.array(accepted), posterior)
        for change in changes:
            estimate.change_prior(*change)
        self.bias = biases.arrays()
        if not concluded:
            return ()
        return biases.errors(concluded, estimate.mean, estimate.cov, stamp_ns, self._vue_id)

    @property
    def modes(self) -> tuple[TrackMode, ...]:
        return self._there().modes

    @property
    def is_at_a_place(self) -> bool:
        return self._there().is_at_a_place

    @property
    def components(self) -> Mixture:
        return self._there().components

    def radius(self, level_m: float) -> float:
        return self._there().radius(level_m)

    # output

    def describe(self, stamp_ns: int) -> Description:
        estimate, config = self._there(), self._config
        mean, cov = estimate.moments
        odometry, clock, self._yaw, sd_m, radius_m = output.describe(
            stamp_ns,
            self._vue_id,
            mean,
            cov,
            config.device_height_m,
            self._yaw,
            self._heading,
            config.integrity_risk,
        )
        if self._height.entry:
            output.with_height(odometry, mean, cov, self._height)
        return Description(odometry, clock, sd_m, radius_m)

    def step_calibration(self) -> StepCalibration | None:
        if not self._calibrates_steps:
            return None
        return self.biases.step_calibration(self._there().mean, self._there().cov)

    def network_track(self, segment: int) -> NetworkTrack | None:
        if self._secondary is None:
            return None
        return self._secondary.track(self._own, segment, self._there(), self.bias)

    # smoothing

    def keep_posteriors(self) -> None:
        self.recorder = PosteriorRecorder(self._vue_id, self._config, keep=True)

    def record(self, segment: int) -> tuple[Odometry, ...]:
        estimate = self.estimate
        if self.recorder is None or estimate is None or not estimate.is_smoothable:
            return ()
        return self.recorder.note(Posterior.of(estimate, segment, self.bias))

    def go_back(self, stamp_ns: int) -> None:
        if self.recorder is not None:
            self.recorder.go_back(stamp_ns)

    def smoothed(self) -> list[Odometry]:
        return self.recorder.smoothed() if self.recorder is not None else []
