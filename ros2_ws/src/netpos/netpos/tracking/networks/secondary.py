"""The second stage: what a network's tracker tells of a device, for others to fuse.

Trackers of several networks that follow one object share its motion and may share their start, but
not the noise of their measurements. A linear filter's covariance is therefore a sum, own + shared,
and both parts go through the same gains: (I - K h) P (I - K h)' + K r K' for the own one, without
the last term for the other, true for any gain (``kf.update``).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from netpos.estimation.forms.table import form_of
from netpos.estimation.motion import Parameter, add_velocity_step, transition
from netpos.messages.values import Array, NetworkTrack
from netpos.tracking.config import TrackerConfig
from netpos.tracking.estimators.estimates import Estimate
from netpos.tracking.estimators.models import height_state, options_of
from netpos.tracking.networks.common_instant import TRACK_STATES

_PLANAR = TRACK_STATES[:4]


@dataclass(frozen=True, slots=True)
class OwnNoise:
    """The own part ``cov`` (n, n) of a track's covariance at ``stamp_ns``."""

    stamp_ns: int
    cov: Array

    def at(self, estimate: Estimate, bias: Array) -> Array:
        """(n, n) where the estimate is: process noise and new states are nobody's own."""
        n, old = len(estimate.mean), len(self.cov)
        own = np.zeros((n, n))
        own[:old, :old] = self.cov
        dt = (estimate.stamp_ns - self.stamp_ns) * 1e-9
        if dt > 0.0:
            F = np.empty((n, n))
            transition(np.zeros(n), dt, estimate.motion, bias, F)
            own = F @ own @ F.T
        return (own + own.T) / 2.0


class Secondary:
    """Follows the own part of a track's covariance and reports the track."""

    def __init__(self, vue_id: str, config: TrackerConfig) -> None:
        self._vue_id = vue_id
        self._config = config
        self._options, self._height = options_of(config), height_state(config)
        self._accelerates = any(model.states == ("AX", "AY") for model in config.motion_models)

    def after(
        self,
        own: OwnNoise | None,
        stamp_ns: int,
        estimate: Estimate,
        rows: Array,
        bias: Array,
    ) -> OwnNoise | None:
        """The own part after an epoch that the ``estimate`` has just applied; None where it is
        not known: the filter is not linear.

        The update is done once more, from the prediction the estimate keeps.
        """
        update_shared = form_of(self._config.filter).update_shared
        if update_shared is None:
            return None
        mean, cov = estimate.prior[0].copy(), estimate.prior[1].copy()
        share = np.zeros_like(cov) if own is None else own.at(estimate, bias)
        motion = estimate.motion
        add_velocity_step(
            motion[Parameter.VELOCITY_STEP_SD],
            motion[Parameter.VELOCITY_STEP_AGE],
            motion[Parameter.VELOCITY_STEP_POSITION_SD],
            cov,
        )
        options, accepted = self._options, np.zeros(len(rows))
        floor, gate, height_m = options.of_form, options.gate_nis, options.height_m
        update_shared(mean, cov, rows, height_m, gate, accepted, floor, share)
        return OwnNoise(stamp_ns, share)

    def track(
        self, own: OwnNoise | None, segment: int, estimate: Estimate, bias: Array
    ) -> NetworkTrack:
        """The track where the estimate is.

        A motion model without acceleration knows it as 0 with ``accel_state_sd_mps2``.
        """
        share = None if own is None else own.at(estimate, bias)
        k, height_m = self._height
        return NetworkTrack(
            stamp_ns=estimate.stamp_ns,
            network=self._config.network,
            vue_id=self._vue_id,
            segment=segment,
            frame_id=self._config.map_frame,
            mean=self._mean(estimate.mean),
            cov=self._matrix(estimate.cov, self._config.accel_state_sd_mps2**2),
            own_cov=np.zeros((6, 6)) if share is None else self._matrix(share, 0.0),
            height_m=height_m + estimate.mean.item(k) if k else height_m,
        )

    def _mean(self, mean: Array) -> Array:
        if self._accelerates:
            return np.take(mean, TRACK_STATES)
        return np.concatenate([mean[_PLANAR], np.zeros(2)])

    def _matrix(self, matrix: Array, accel_var: float) -> Array:
        states = TRACK_STATES if self._accelerates else _PLANAR
        full = np.diag([0.0, 0.0, 0.0, 0.0, accel_var, accel_var])
        full[: len(states), : len(states)] = matrix[np.ix_(states, states)]
        return full
