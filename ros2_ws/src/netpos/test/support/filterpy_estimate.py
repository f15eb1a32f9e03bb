"""An estimate of a track on FilterPy: the rules of ``engine.predict_epoch`` and ``update_epoch``
written once more around ``filterpy_reference``."""

from __future__ import annotations

import copy

import filterpy_reference as reference
import numpy as np
from netpos.estimation import engine
from netpos.estimation.measurement import GROUP
from netpos.estimation.motion import Parameter, add_velocity_step
from netpos.estimation.update.fit import innovations_with_sd
from netpos.messages.values import Array, TrackMode
from netpos.tracking.config import TrackerConfig
from netpos.tracking.estimators.estimates import UpdateResult
from netpos.tracking.estimators.models import augmented, initial_extra_sd, motions_of, options_of


class FilterpyEstimate:
    """``estimates.Estimate`` of one motion model and one component; ``filter`` is ekf or ukf."""

    def __init__(self, config: TrackerConfig, stamp_ns: int, mean: Array, cov: Array) -> None:
        self.stamp_ns = stamp_ns
        self._options = options_of(config)
        self.motion: Array = motions_of(config)[0].copy()
        self._predict = getattr(reference, f"{config.filter}_predict")
        self._update = getattr(reference, f"{config.filter}_update")
        self.mean, self.cov = augmented(mean, cov, initial_extra_sd(config))
        self.prior = (self.mean, self.cov)

    def set_imu_increment(self, yaw_rad: float, speed_mps: float, gyro_density: float) -> None:
        self.motion[Parameter.YAW_INCREMENT] = yaw_rad
        self.motion[Parameter.SPEED_INCREMENT] = speed_mps
        self.motion[Parameter.GYRO] = gyro_density

    @property
    def modes(self) -> tuple[TrackMode, ...]:
        return ()

    @property
    def moments(self) -> tuple[Array, Array]:
        return self.mean, self.cov

    @property
    def is_smoothable(self) -> bool:
        return True

    @property
    def is_at_a_place(self) -> bool:
        return True

    def radius(self, level_m: float) -> float:
        return level_m

    def augment(self, sd: Array) -> None:
        self.mean, self.cov = augmented(self.mean, self.cov, sd)

    def predict(self, stamp_ns: int, bias: Array) -> None:
        dt = (stamp_ns - self.stamp_ns) * 1e-9
        if dt > 0.0:
            self.motion[Parameter.VELOCITY_STEP_SD] = 0.0
            self.mean, self.cov = self.mean.copy(), self.cov.copy()
            self._predict(self.mean, self.cov, dt, self.motion, bias)
            self.stamp_ns = stamp_ns

    def step(
        self, stamp_ns: int, unheard_s: float, rejected_in_row: int, rows: Array, bias: Array
    ) -> UpdateResult:
        height_m, first = self._options.height_m, self._options.first_slow_error
        dt = (stamp_ns - self.stamp_ns) * 1e-9
        self.predict(stamp_ns, bias)
        if dt > 0.0 and self.mean.size > first:
            reference.follow_prediction(self.mean, self.cov, first, rows, dt, height_m)
        self.prior = self.mean, self.cov
        mean, cov = self.mean.copy(), self.cov.copy()
        opened = rejected_in_row >= self._options.inflate_after
        sd = self._options.initial_speed_sd if opened else 0.0
        add_velocity_step(sd, unheard_s, 0.0, cov)
        accepted = np.zeros(int(rows[-1, GROUP]) + 1)
        gate = self._options.gate_nis
        innovations = innovations_with_sd(mean, cov, rows, height_m)
        nis, used = self._update(mean, cov, rows, height_m, gate, accepted)
        if used and self._update is reference.ekf_update and mean.size > first:
            passed = rows[accepted[rows[:, GROUP].astype(int)] == 1.0]
            reference.follow_tangents(self.prior[0], mean, cov, first, passed, height_m)
        if used:
            self.mean, self.cov = mean, cov
            engine.set_velocity_step_noise(self.motion, sd, unheard_s, 0.0, 0.0)
        return UpdateResult(nis, used, accepted.tolist(), (1.0 - accepted).tolist(), innovations)

    def copy(self) -> FilterpyEstimate:
        twin = copy.copy(self)
        twin.motion = self.motion.copy()
        return twin
