"""The estimate of a device whose posterior is not one Gaussian: a mixture of them."""

from __future__ import annotations

import copy

import numpy as np

from netpos.filters import imm, mixture
from netpos.filters.measurement import GROUP
from netpos.filters.motion import Parameter
from netpos.messages.values import Array, TrackMode
from netpos.tracking.config import TrackerConfig
from netpos.tracking.estimates import Estimate, KalmanEstimate, OneModel
from netpos.tracking.models import augmented, options_of
from netpos.tracking.protection import mixture_radius


class MixtureEstimate(OneModel):
    """Components of ``filters.mixture`` with the interface of ``estimates.Estimate``.

    ``mean`` and ``cov`` are the moments of the whole mixture. Its arrays are replaced, never
    changed, so that copies may share them.
    """

    def __init__(self, config: TrackerConfig, estimate: KalmanEstimate) -> None:
        """A mixture of one component: ``estimate``."""
        self.stamp_ns = estimate.stamp_ns
        self._risk = config.integrity_risk
        self._options = options_of(config)
        self._motion = estimate.motion.copy()
        one = estimate.mean[None].copy(), estimate.cov[None].copy(), np.zeros(1)
        self._set(one)
        self._prior = (self.mean, self.cov)

    def _set(self, components: mixture.Mixture) -> None:
        self._components = components
        means, covs, log_weights = components
        self.mean, self.cov = np.empty_like(means[0]), np.empty_like(covs[0])
        imm.combine(means, covs, np.exp(log_weights), self.mean, self.cov)
        self._modes: tuple[TrackMode, ...] | None = None  # until asked for

    @property
    def modes(self) -> tuple[TrackMode, ...]:
        """Modes that carry more than the integrity risk, the most probable first; none where it is
        only one."""
        if self._modes is None:
            means, covs, log_weights = self._components
            weights, mode = np.exp(log_weights), mixture.mode_of(means, covs, log_weights)
            sums = np.bincount(mode, weights)
            x, y = (np.bincount(mode, weights * means[:, a]) / sums for a in (0, 1))
            order = np.argsort(-sums, kind="stable").tolist()
            modes = [
                TrackMode(weight=float(sums[m]), x_m=float(x[m]), y_m=float(y[m]))
                for m in order
                if sums[m] > self._risk
            ]
            self._modes = tuple(modes) if len(modes) > 1 else ()
        return self._modes

    @property
    def prior(self) -> tuple[Array, Array]:
        return self._prior

    def radius(self, level_m: float) -> float:
        """Radius [m] round ``mean`` that holds ``level_m`` and all of the mixture but the
        integrity risk."""
        means, covs, log_weights = self._components
        weights = np.exp(log_weights)
        held: float = mixture_radius(means, covs, weights, self.mean[:2], self._risk)
        return max(level_m, held)

    def augment(self, sd: Array) -> None:
        if self.mean.size < 6 + sd.size:
            means, covs, log_weights = self._components
            pairs = [augmented(mean, cov, sd) for mean, cov in zip(means, covs, strict=True)]
            means = np.array([mean for mean, _ in pairs])
            self._set((means, np.array([cov for _, cov in pairs]), log_weights))

    def predict(self, stamp_ns: int, bias: Array) -> None:
        if stamp_ns <= self.stamp_ns:
            return
        self._motion[Parameter.VELOCITY_STEP_SD] = 0.0
        means, covs, log_weights = self._components
        means, covs = means.copy(), covs.copy()
        mixture.predict(means, covs, (stamp_ns - self.stamp_ns) * 1e-9, self._motion, bias)
        self.stamp_ns = stamp_ns
        self._set((means, covs, log_weights))

    def step(
        self, stamp_ns: int, unheard_s: float, rejected_in_row: int, rows: Array, bias: Array
    ) -> tuple[float, int, Array]:
        self.predict(stamp_ns, bias)
        self._prior = (self.mean, self.cov)
        accepted = np.zeros(int(rows[-1, GROUP]) + 1)
        height_m, gate = self._options.height_m, self._options.gate_nis
        *components, nis, dof = mixture.update(*self._components, rows, height_m, gate, accepted)
        self._set(tuple(components))
        return nis, dof, accepted

    def as_single(self, config: TrackerConfig) -> Estimate | None:
        """The only component as an estimate of its own; None while there are several."""
        means, covs, log_weights = self._components
        if log_weights.size > 1:
            return None
        single = KalmanEstimate(config, self.stamp_ns, means[0], covs[0])
        single.set_motion(self._motion)
        return single

    def copy(self) -> MixtureEstimate:
        twin = copy.copy(self)
        twin._motion = self._motion.copy()
        return twin


def with_components(
    config: TrackerConfig, estimate: Estimate, stamp_ns: int, rows: Array, bias: Array
) -> Estimate:
    """The estimate as a mixture where, after a silence that made it COASTING, it is too wide for
    one of ``rows``; a mixture of one component as an estimate of its own."""
    if isinstance(estimate, MixtureEstimate):
        return estimate.as_single(config) or estimate
    if not isinstance(estimate, KalmanEstimate):
        return estimate
    dt, height_m = (stamp_ns - estimate.stamp_ns) * 1e-9, config.device_height_m
    if dt <= config.coast_after_s:
        return estimate
    known = estimate.mean, estimate.cov, dt, estimate.motion
    if not mixture.will_split(*known, bias, rows, height_m):
        return estimate
    return MixtureEstimate(config, estimate)
