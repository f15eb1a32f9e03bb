"""Rivals of the estimate: what it would be had the device turned and nobody noticed.

With one RSU a turn along the bearing shows in no single measurement: the clock takes the range,
and the bearing hardly changes. The estimate goes on in the wrong direction and is sure of it. What
tells is the sum of many measurements. A rival is the second answer of ``protection.level_in``,
carried on with the same measurements for as long as they fit it better than the estimate (the
likelihood ratio of Page 1954); the protection level holds it, too.
"""

from __future__ import annotations

import copy
import math

import numpy as np

from netpos.filters import ekf
from netpos.filters.compile import kernel, leaf
from netpos.filters.fit import surprise
from netpos.filters.gate import accepted_rows
from netpos.filters.manoeuvre import add_manoeuvre, unnoticed_s
from netpos.filters.measurement import GROUP
from netpos.filters.motion import Model, Parameter
from netpos.messages.values import Array
from netpos.tracking.config import TrackerConfig
from netpos.tracking.engine import GATE, GATE_SIZE, Option, is_sound
from netpos.tracking.estimates import Estimate
from netpos.tracking.models import motions_of, options_of
from netpos.tracking.protection import (
    Scratch,
    apply_about,
    gaussian_radius,
    level_scratch,
)

# The turn of each rival lies within so many times the time in which a single epoch would show it:
# what the filter follows in part is noticed later.
_WINDOWS = np.array([1.0, 2.0])
_NONE = -1.0  # evidence of a rival that is not there
_CERTAIN = 50.0  # log odds; more is remembered for no longer
_UNUSUAL = 2.0  # NIS per degree of freedom below which no rival is better

State = tuple[Array, Array, Array, Array]
"""Means (K, n), covariances (K, n, n), evidence (K,): log likelihood ratio to the estimate, and
(K,) whether the rival reached beyond the level of the last epoch."""


@kernel
def no_rivals(n: int) -> State:
    """State of ``n`` states without rivals."""
    count = _WINDOWS.size
    return (
        np.zeros((count, n)),
        np.zeros((count, n, n)),
        np.full(count, _NONE),
        np.zeros(count),
    )


@leaf
def _present(evidence: Array) -> bool:
    """Whether there is a rival."""
    most = _NONE
    for k in range(evidence.size):
        most = max(most, evidence[k])
    return most >= 0.0


@leaf
def _begins(rows: Array, nis: float, dof: int) -> bool:
    """Whether a rival may begin: an epoch of a single measurement (two tell where the device is)
    that fits badly."""
    alone = rows[0, GROUP] == rows[rows.shape[0] - 1, GROUP]
    return bool(alone and nis > _UNUSUAL * dof)


@leaf
def matter(rows: Array, nis: float, dof: int, evidence: Array) -> bool:
    """Whether ``rival_level`` has anything to do."""
    return bool(_present(evidence) or _begins(rows, nis, dof))


@kernel
def rival_level(
    level: float,
    dt: float,
    prior_mean: Array,
    prior_cov: Array,
    rows: Array,
    accepted: Array,
    unheard_s: float,
    nis: float,
    dof: int,
    mean: Array,
    motion: Array,
    bias: Array,
    options: Array,
    risk: float,
    rivals: State,
    scratch: Scratch,
) -> float:
    """Radius [m] round ``mean`` (n,) that holds ``level`` and the rivals, which are moved by
    ``dt`` seconds, weighed and updated in place; arguments as for ``manoeuvre_level``.

    nis, dof : of the accepted rows. A rival begins in an epoch of a single measurement. An
    inertial model has no rivals: only the estimate gets its increments.
    """
    means, covs, evidence, beyond = rivals
    present, unusual = _present(evidence), _begins(rows, nis, dof)
    if not (present or unusual) or int(motion[Parameter.MODEL]) == Model.INERTIAL:
        return level
    if present:
        _move(dt, motion, bias, rivals)
    kept = rows[accepted_rows(rows, accepted)]
    if dof > 0:
        _weigh(prior_mean, prior_cov, kept, unheard_s, unusual, options, rivals)
    radius, height_m = level, options[Option.HEIGHT]
    for k in range(evidence.size):
        if evidence[k] < 0.0:
            continue
        x, P = means[k].copy(), covs[k].copy()
        if dof > 0:
            apply_about(x, P, means[k], covs[k], rows, accepted, height_m, scratch)
            means[k], covs[k] = x, P
        if not is_sound(x, P):
            evidence[k] = _NONE
            continue
        apart = math.hypot(x[0] - mean[0], x[1] - mean[1])
        reached = apart + gaussian_radius(P[0, 0], P[0, 1], P[1, 1], risk)
        beyond[k] = 1.0 if reached > level else 0.0
        radius = max(radius, reached)
    return radius


@kernel
def _move(dt: float, motion: Array, bias: Array, rivals: State) -> None:
    """Predict every rival; the velocity step noted in ``motion`` is the estimate's."""
    means, covs, evidence, _ = rivals
    own = motion.copy()
    own[Parameter.JUMP_SPEED] = 0.0
    for k in range(evidence.size):
        if evidence[k] >= 0.0:
            ekf.predict(means[k], covs[k], dt, own, bias)


@kernel
def _weigh(
    prior_mean: Array,
    prior_cov: Array,
    rows: Array,
    unheard_s: float,
    unusual: bool,
    options: Array,
    rivals: State,
) -> None:
    """Add what ``rows`` say to the evidence of each rival, drop those that lose to the estimate,
    and take up one anew where it is better. A misfit counts as far as the gate lets it: what is
    beyond is an outlier to either."""
    means, covs, evidence, beyond = rivals
    height_m, speed = options[Option.HEIGHT], options[Option.MANOEUVRE_SPEED]
    m, gate = rows.shape[0], options[GATE:]
    most = gate[min(m, GATE_SIZE - 1)]
    distance, size = surprise(prior_mean, prior_cov, rows, height_m)
    estimate = min(distance, most) + size
    longest_s = math.inf
    if unusual:
        h = np.empty(prior_mean.size)
        _, longest_s = unnoticed_s(prior_mean, prior_cov, rows, height_m, gate[2], speed, h)
    for k in range(evidence.size):
        rival = math.inf
        if evidence[k] >= 0.0:
            distance, size = surprise(means[k], covs[k], rows, height_m)
            rival = min(distance, most) + size
            evidence[k] = min(evidence[k] + (estimate - rival) / 2.0, _CERTAIN)
        if evidence[k] < 0.0:
            evidence[k], rival = _NONE, math.inf
        if math.isinf(longest_s):
            continue
        wide = prior_cov.copy()
        add_manoeuvre(speed, _WINDOWS[k] * max(unheard_s, longest_s), wide)
        distance, size = surprise(prior_mean, wide, rows, height_m)
        fresh = min(distance, most) + size
        gained = (estimate - fresh) / 2.0
        better = gained > evidence[k] if beyond[k] > 0.0 else fresh < rival
        if gained > 0.0 and (evidence[k] < 0.0 or better):
            means[k], covs[k], evidence[k] = prior_mean, wide, gained


class Rivals:
    """The rivals of one track, from epoch to epoch."""

    def __init__(self, config: TrackerConfig) -> None:
        self._options, self._risk = options_of(config), config.integrity_risk
        interacting = config.motion_model == "interacting"
        self._straight = motions_of(config)[1] if interacting else None
        self._able = config.manoeuvre_speed_sd_mps > 0.0
        self._stamp_ns = 0
        self._state: State | None = None

    @property
    def present(self) -> bool:
        """Whether there is one; none comes with an epoch of several measurements."""
        return self._state is not None

    def level(
        self,
        level: float,
        stamp_ns: int,
        estimate: Estimate,
        rows: Array,
        accepted: Array,
        unheard_s: float,
        fit: tuple[float, int],
        bias: Array,
    ) -> float:
        """``rival_level`` after an epoch; ``fit``: NIS and number of the accepted rows."""
        dt, self._stamp_ns = (stamp_ns - self._stamp_ns) * 1e-9, stamp_ns
        usual = accepted.size > 1 or fit[0] <= _UNUSUAL * fit[1]
        if not self._able or (usual and self._state is None):
            return level
        epoch = (*estimate.prior, rows, accepted, unheard_s)
        mean, options, risk = estimate.mean, self._options, self._risk
        if self._state is None or self._state[0].shape[1] != mean.size:
            self._state = no_rivals(mean.size)  # anew where a bias has joined the states
        motion = estimate.motion if self._straight is None else self._straight
        scratch = level_scratch(mean.size, len(rows))
        reached: float = rival_level(
            level, dt, *epoch, *fit, mean, motion, bias, options, risk, self._state, scratch
        )
        if self._state[2].max() < 0.0:
            self._state = None
        return reached

    def copy(self) -> Rivals:
        """An independent copy: a track that goes back in time goes back to it."""
        twin = copy.copy(self)
        if self._state is not None:
            means, covs, evidence, beyond = self._state
            twin._state = (means.copy(), covs.copy(), evidence.copy(), beyond.copy())
        return twin
