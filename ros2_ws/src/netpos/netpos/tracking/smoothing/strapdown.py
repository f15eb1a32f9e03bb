"""Fixed-interval smoothing of a strapdown track: Rauch-Tung-Striebel on its error state.

The filter is recorded chunk by chunk, since constraints act within an epoch. With nav-, P- the
prediction of a chunk from nav, P of the one before, both P- = Phi P Phi' + Q, and nav_s, P_s what
the rest of the recording made of the prediction's instant,

    G = P Phi' (P-)^-1,  error = G (nav_s - nav-),  nav <- nav + error,  P <- P + G (P_s - P-) G'

in which differences and sums of navigation states are those of the error state.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from netpos.estimation.factor import factor, solve_factored
from netpos.estimation.spatial.error_state import (
    Chunk,
    Imu,
    Sensors,
    apply_constraints,
    predict_chunk,
)
from netpos.estimation.state import ERR_BIASES
from netpos.inertial.strapdown import ACCEL_BIAS, ATTITUDE_ERR, QUATERNION, inject
from netpos.messages.values import Array
from netpos.tracking.estimators.models import augmented


@dataclass(slots=True)
class Instant:
    """The filter at the end of a chunk: nav (n + 1,), cov (n, n) with all that is of this stamp;
    ``predicted`` from the instant before: nav, cov and transition Phi, None where a track began.

    epoch : it is one, ``rate`` (3,) the angular velocity measured there
    """

    stamp_ns: int
    nav: Array
    cov: Array
    predicted: tuple[Array, Array, Array] | None
    epoch: bool = False
    rate: Array | None = None


class Recorder:
    """Keeps what a smoother needs, 7 kB a chunk: the memory of a whole recording.

    A track that is lost and starts anew is a passage of its own.
    """

    def __init__(self) -> None:
        self._passages: list[list[Instant]] = []
        self._bias_sd: list[Array] = []

    def begin(self, stamp_ns: int, nav: Array, cov: Array) -> None:
        """A track begins."""
        self._passages.append([Instant(stamp_ns, nav.copy(), cov.copy(), None)])
        self._bias_sd.append(np.zeros(0))

    def advance(
        self,
        nav: Array,
        cov: Array,
        memory: Array,
        from_ns: int,
        to_ns: int,
        imu: Imu,
        sensors: Sensors,
    ) -> None:
        """``error_state.advance``, recorded."""
        now = from_ns
        while now < to_ns:
            chunk = Chunk(np.empty(7), np.empty(cov.shape))
            now, blind_s = predict_chunk(nav, cov, memory, now, to_ns, imu, sensors, chunk)
            predicted = (nav.copy(), cov.copy(), chunk.transition)
            if blind_s == 0.0:
                apply_constraints(nav, cov, memory, sensors, chunk.mean)
            self._passages[-1].append(Instant(now, nav.copy(), cov.copy(), predicted))

    def note(self, nav: Array, cov: Array, rate: Array | None, bias_sd: Array) -> None:
        """What the filter knows after the epoch at the newest instant; bias_sd (k,) of all biases
        heard of so far, in the order of the states."""
        newest = self._passages[-1][-1]
        newest.nav, newest.cov, newest.epoch, newest.rate = nav.copy(), cov.copy(), True, rate
        self._bias_sd[-1] = bias_sd

    def go_back(self, stamp_ns: int) -> None:
        """Forget what is newer: the track goes back."""
        while self._passages and self._passages[-1][0].stamp_ns > stamp_ns:
            self._passages.pop()
            self._bias_sd.pop()
        while self._passages and self._passages[-1][-1].stamp_ns > stamp_ns:
            self._passages[-1].pop()

    def smoothed(self) -> list[Instant]:
        """The epochs given all measurements, as new values in the order of stamps."""
        epochs: list[Instant] = []
        for instants, bias_sd in zip(self._passages, self._bias_sd, strict=True):
            epochs += [i for i in smooth(instants, bias_sd) if i.epoch][::-1]
        return epochs


def difference(later: Array, nav: Array) -> Array:
    """Error (n,) that ``inject`` takes ``nav`` (n + 1,) to ``later`` with."""
    error = np.empty(nav.size - 1)
    error[:ATTITUDE_ERR] = (later - nav)[:QUATERNION]
    turn = slice(QUATERNION, ACCEL_BIAS)
    turned = Rotation.from_quat(later[turn]) * Rotation.from_quat(nav[turn]).inv()
    error[ATTITUDE_ERR : ATTITUDE_ERR + 3] = turned.as_rotvec()
    error[ATTITUDE_ERR + 3 :] = (later - nav)[ACCEL_BIAS:]
    return error


def _step_back(instant: Instant, later: Instant, nav_s: Array, cov_s: Array, sd: Array) -> None:
    """Smooth ``instant`` in place by the smoothed nav_s, cov_s of the ``later`` one."""
    assert later.predicted is not None
    nav_p, cov_p, Phi = later.predicted
    instant.nav, instant.cov = augmented(
        instant.nav, instant.cov, sd[: len(cov_p) - ERR_BIASES], ERR_BIASES
    )
    gain_t = Phi @ instant.cov
    solve_factored(factor(cov_p.copy()), gain_t)
    inject(instant.nav, gain_t.T @ difference(nav_s[: nav_p.size], nav_p))
    n = len(cov_p)
    cov = instant.cov + gain_t.T @ (cov_s[:n, :n] - cov_p) @ gain_t
    instant.cov = (cov + cov.T) / 2.0


def smooth(instants: Sequence[Instant], bias_sd: Array) -> Iterator[Instant]:
    """Smoothed instants, newest first, as new values.

    bias_sd : (k,) prior standard deviations of all biases, in the order of the states
    """
    later: Instant | None = None
    for recorded in reversed(instants):
        instant = replace(recorded, nav=recorded.nav.copy(), cov=recorded.cov.copy())
        if later is not None:
            _step_back(instant, later, later.nav, later.cov, bias_sd)
        yield instant
        later = instant
