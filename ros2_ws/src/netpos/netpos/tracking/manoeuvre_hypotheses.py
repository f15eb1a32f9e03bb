"""Manoeuvre hypotheses: what the estimate would be had the device turned and nobody noticed.

With one RSU a turn along the bearing shows in no single measurement: the clock takes the range,
and the bearing hardly changes. The estimate goes on in the wrong direction and is sure of it. What
tells, if anything, is the sum of many measurements. A hypothesis is the estimate with its velocity
opened at some time, carried on with the same measurements; its odds are how often devices turn
times its likelihood ratio to the estimate. The protection level holds every hypothesis as far as
its odds demand (multiple hypotheses: Pervan, Pullen and Christie 1998), and what is reported is
the hypothesis that has won where one has (Wald 1945). The estimate itself goes on as it is:
hypotheses that are wrong leave nothing behind.
"""

from __future__ import annotations

import copy
import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from netpos.filters import ekf
from netpos.filters.compile import kernel, leaf
from netpos.filters.fit import neg2_log_likelihood
from netpos.filters.gate import accepted_rows
from netpos.filters.manoeuvre import add_manoeuvre, detection_delay_s
from netpos.filters.measurement import GROUP
from netpos.filters.motion import Model, Parameter
from netpos.filters.state import X
from netpos.messages.values import Array
from netpos.tracking.config import TrackerConfig
from netpos.tracking.engine import GATE_SIZE, FilterOptions, is_sound
from netpos.tracking.estimates import Estimate
from netpos.tracking.models import motions_of, options_of
from netpos.tracking.protection import FusedEpoch, gaussian_radius, radius_limit
from netpos.tracking.sectors import PhaseAmbiguityBank

Ints = npt.NDArray[np.int64]


class Hypotheses(NamedTuple):
    """The hypotheses of one estimate."""

    means: Array  # (K, n)
    covs: Array  # (K, n, n)
    odds: Array  # (K,) logarithms, to the estimate; -inf: no hypothesis there
    marks: Ints  # (2,) ``SELECTED`` and ``BEGUN``


# Of ``marks``: the hypothesis to report, -1: none; stamp [ns] at which the last one began.
SELECTED, BEGUN = 0, 1

_COUNT = 8
_PERIOD_NS = 250_000_000  # from one hypothesis to the next where every epoch fits
_TURNS_HZ = 1.0 / 30.0  # how often a device turns
_UNUSUAL = 2.0  # NIS per degree of freedom above which a hypothesis begins
_CERTAIN = 50.0  # log odds; more is remembered for no longer


@kernel
def no_hypotheses(n: int, stamp_ns: int) -> Hypotheses:
    """Of ``n`` states at ``stamp_ns``, none yet."""
    marks = np.array([-1, stamp_ns])
    odds = np.full(_COUNT, -math.inf)
    return Hypotheses(np.zeros((_COUNT, n)), np.zeros((_COUNT, n, n)), odds, marks)


@leaf
def _present(odds: Array) -> bool:
    """Whether there is a hypothesis."""
    most = -math.inf
    for k in range(odds.size):
        most = max(most, odds[k])
    return most > -math.inf


@leaf
def _begins(stamp_ns: int, epoch: FusedEpoch, begun_ns: int) -> bool:
    """Whether a hypothesis begins: in an epoch of a single measurement (two tell where the device
    is) that fits badly, and from time to time, for a turn that shows in none."""
    rows = epoch.rows
    alone = rows[0, GROUP] == rows[rows.shape[0] - 1, GROUP]
    wanted = epoch.nis > _UNUSUAL * epoch.dof or stamp_ns - begun_ns >= _PERIOD_NS
    return bool(alone and epoch.dof > 0 and wanted)


@leaf
def is_needed(stamp_ns: int, epoch: FusedEpoch, hypotheses: Hypotheses) -> bool:
    """Whether ``hypothesis_level`` has anything to do."""
    return bool(_present(hypotheses.odds) or _begins(stamp_ns, epoch, hypotheses.marks[BEGUN]))


@kernel
def hypothesis_level(
    level: float,
    stamp_ns: int,
    dt: float,
    epoch: FusedEpoch,
    motion: Array,
    bias: Array,
    options: FilterOptions,
    hypotheses: Hypotheses,
) -> float:
    """Radius [m] that holds ``level``, a radius round the posterior mean, and the hypotheses,
    which are moved by ``dt`` seconds to ``stamp_ns``, weighed and updated in place: round the
    hypothesis ``SELECTED`` where there is one, else round that mean.

    An inertial model has no hypotheses: only the estimate gets its increments.
    """
    odds, marks, rows, risk = hypotheses.odds, hypotheses.marks, epoch.rows, options.integrity_risk
    present, begins = _present(odds), _begins(stamp_ns, epoch, marks[BEGUN])
    if not (present or begins) or int(motion[Parameter.MODEL]) == Model.INERTIAL:
        return level
    if present:
        _move(dt, motion, bias, hypotheses)
    if epoch.dof > 0:
        prior_mean, prior_cov = epoch.prior_mean, epoch.prior_cov
        kept = rows[accepted_rows(rows, epoch.accepted)]
        estimate_cost = _update_odds(prior_mean, prior_cov, kept, options, hypotheses)
        if begins:
            unusual = epoch.nis > _UNUSUAL * epoch.dof
            since_s = min(stamp_ns - marks[BEGUN], _PERIOD_NS) * 1e-9
            within_s = max(epoch.unheard_s, since_s)
            window_s = _window_s(prior_mean, prior_cov, kept, within_s, unusual, options)
            if _begin(prior_mean, prior_cov, kept, window_s, estimate_cost, options, hypotheses):
                marks[BEGUN] = stamp_ns
        _update(kept, options, hypotheses)
    if rows[0, GROUP] != rows[rows.shape[0] - 1, GROUP]:
        _dismiss(level, epoch.mean, risk, hypotheses)
    _select(risk, odds, marks)
    return float(_reach(level, epoch.mean, risk, hypotheses))


@kernel
def _move(dt: float, motion: Array, bias: Array, hypotheses: Hypotheses) -> None:
    """Predict every hypothesis; the velocity step noted in ``motion`` is the estimate's."""
    means, covs, odds, _ = hypotheses
    own = motion.copy()
    own[Parameter.VELOCITY_STEP_SD] = 0.0
    for k in range(odds.size):
        if odds[k] > -math.inf:
            ekf.predict(means[k], covs[k], dt, own, bias)


@kernel
def _neg2_log_likelihood(mean: Array, cov: Array, rows: Array, options: FilterOptions) -> float:
    """Minus twice the log density of ``rows``. A misfit counts as far as the gate lets it: what
    is beyond is an outlier to any."""
    distance, size = neg2_log_likelihood(mean, cov, rows, options.height_m, False)
    return float(min(distance, options.gate_nis[min(rows.shape[0], GATE_SIZE - 1)]) + size)


@kernel
def _update_odds(
    prior_mean: Array,
    prior_cov: Array,
    rows: Array,
    options: FilterOptions,
    hypotheses: Hypotheses,
) -> float:
    """Add what ``rows`` say to the odds of each hypothesis and drop those the risk no longer
    counts; returns ``_neg2_log_likelihood`` of the estimate."""
    means, covs, odds, _ = hypotheses
    estimate = _neg2_log_likelihood(prior_mean, prior_cov, rows, options)
    for k in range(odds.size):
        if odds[k] > -math.inf:
            ratio = (estimate - _neg2_log_likelihood(means[k], covs[k], rows, options)) / 2.0
            odds[k] = min(odds[k] + ratio, _CERTAIN)
            if not odds[k] >= math.log(options.integrity_risk):
                odds[k] = -math.inf
    return float(estimate)


@kernel
def _window_s(
    prior_mean: Array,
    prior_cov: Array,
    rows: Array,
    within_s: float,
    unusual: bool,
    options: FilterOptions,
) -> float:
    """Time [s] in which the turn of a new hypothesis lies: ``within_s``, or in an unusual epoch
    the time in which one in the worst direction would show in it."""
    if not unusual:
        return within_s
    h, speed = np.empty(prior_mean.size), options.manoeuvre_speed_sd
    height_m, gate = options.height_m, options.gate_nis[2]
    _, longest_s = detection_delay_s(prior_mean, prior_cov, rows, height_m, gate, speed, h)
    return max(within_s, longest_s if math.isfinite(longest_s) else 0.0)


@kernel
def _begin(
    prior_mean: Array,
    prior_cov: Array,
    rows: Array,
    window_s: float,
    estimate_cost: float,
    options: FilterOptions,
    hypotheses: Hypotheses,
) -> bool:
    """Begin a hypothesis that turned in the last ``window_s``, in the place of the least likely
    one unless it is less likely still; whether it did."""
    means, covs, odds, marks = hypotheses
    wide = prior_cov.copy()
    add_manoeuvre(options.manoeuvre_speed_sd, window_s, wide)
    ratio = (estimate_cost - _neg2_log_likelihood(prior_mean, wide, rows, options)) / 2.0
    fresh = math.log(_TURNS_HZ * window_s) + ratio
    least = int(np.argmin(odds))
    if not fresh > max(odds[least], math.log(options.integrity_risk)):
        return False
    means[least], covs[least], odds[least] = prior_mean, wide, fresh
    if marks[SELECTED] == least:
        marks[SELECTED] = -1
    return True


@kernel
def _update(rows: Array, options: FilterOptions, hypotheses: Hypotheses) -> None:
    """Fuse ``rows``, linearised once: what iterates on a wide prior is soon sure of a range no
    bearing tells."""
    means, covs, odds, _ = hypotheses
    m, height_m = rows.shape[0], options.height_m
    work, accepted = ekf.workspace(means.shape[1], m), np.empty(int(rows[m - 1, GROUP]) + 1)
    no_gate = np.full(GATE_SIZE, np.inf)
    for k in range(odds.size):
        if odds[k] > -math.inf:
            ekf.update(means[k], covs[k], rows, height_m, no_gate, 1, accepted, work)
            if not is_sound(means[k], covs[k]):
                odds[k] = -math.inf


@kernel
def _dismiss(level: float, mean: Array, risk: float, hypotheses: Hypotheses) -> None:
    """Drop the hypotheses within ``level`` of ``mean``: for an epoch of several measurements,
    which let them go nowhere else."""
    means, covs, odds, _ = hypotheses
    for k in range(odds.size):
        x, P = means[k], covs[k]
        apart = math.hypot(x[X.PX] - mean[X.PX], x[X.PY] - mean[X.PY])
        if apart + gaussian_radius(P[X.PX, X.PX], P[X.PX, X.PY], P[X.PY, X.PY], risk) <= level:
            odds[k] = -math.inf


@leaf
def _select(risk: float, odds: Array, marks: Ints) -> None:
    """A hypothesis leads from where its odds are 1 to ``risk`` to where they are even again."""
    if marks[SELECTED] >= 0 and odds[marks[SELECTED]] > 0.0:
        return
    most = -math.log(risk)
    marks[SELECTED] = -1
    for k in range(odds.size):
        if odds[k] > most:
            most = odds[k]
            marks[SELECTED] = k


@kernel
def _reach(level: float, mean: Array, risk: float, hypotheses: Hypotheses) -> float:
    """Radius [m] round the selected hypothesis, or ``mean``, that holds ``level`` round ``mean``
    and every hypothesis but the share that its odds leave of ``risk``."""
    means, covs, odds, marks = hypotheses
    middle = mean if marks[SELECTED] < 0 else means[marks[SELECTED]]
    radius = level + math.hypot(mean[X.PX] - middle[X.PX], mean[X.PY] - middle[X.PY])
    for k in range(odds.size):
        share = risk * math.exp(-min(odds[k], 0.0))
        if share < 0.5:
            P, x = covs[k], means[k]
            apart = math.hypot(x[X.PX] - middle[X.PX], x[X.PY] - middle[X.PY])
            if apart + radius_limit(P[X.PX, X.PX], P[X.PX, X.PY], P[X.PY, X.PY], share) > radius:
                radius = max(
                    radius,
                    apart + gaussian_radius(P[X.PX, X.PX], P[X.PX, X.PY], P[X.PY, X.PY], share),
                )
    return float(radius)


class ManoeuvreHypotheses:
    """The hypotheses of one track, from epoch to epoch."""

    def __init__(self, config: TrackerConfig) -> None:
        self._options = options_of(config)
        interacting = config.motion_model == "interacting"
        self._straight = motions_of(config)[1] if interacting else None
        self._able = config.manoeuvre_speed_sd_mps > 0.0
        self._stamp_ns, self._begun_ns = 0, -1
        self._state: Hypotheses | None = None

    @property
    def present(self) -> bool:
        """Whether there is one; none comes with an epoch of several measurements."""
        return self._state is not None

    def level(
        self,
        level: float,
        stamp_ns: int,
        estimate: Estimate,
        epoch: FusedEpoch,
        bias: Array,
    ) -> float:
        """``hypothesis_level`` after an epoch of the ``estimate``."""
        dt, self._stamp_ns = (stamp_ns - self._stamp_ns) * 1e-9, stamp_ns
        if self._begun_ns < 0:
            self._begun_ns = stamp_ns
        early = stamp_ns - self._begun_ns < _PERIOD_NS
        usual = epoch.accepted.size > 1 or (early and epoch.nis <= _UNUSUAL * epoch.dof)
        if not self._able or (usual and self._state is None):
            return level
        state, n = self._state, epoch.mean.size
        if state is None or state.means.shape[1] != n:
            # anew where a bias has joined the states
            state = self._state = no_hypotheses(n, self._begun_ns)
        motion = self._motion(estimate)
        reached: float = hypothesis_level(
            level, stamp_ns, dt, epoch, motion, bias, self._options, state
        )
        self._begun_ns = int(state.marks[BEGUN])
        if math.isinf(state.odds.max()):
            self._state = None
        return reached

    def reported(self, stamp_ns: int, estimate: Estimate, bias: Array) -> tuple[Array, Array]:
        """Mean (n,) and covariance (n, n) to report at ``stamp_ns``: of the hypothesis that has
        won, moved there, or of ``estimate``. A bank of sectors speaks for itself."""
        told = estimate.mean, estimate.cov
        if self._state is None or isinstance(estimate, PhaseAmbiguityBank):
            return told
        means, covs, _, marks = self._state
        selected = marks[SELECTED]
        if selected < 0 or means.shape[1] != told[0].size:
            return told
        mean, cov, motion = (
            means[selected].copy(),
            covs[selected].copy(),
            self._motion(estimate).copy(),
        )
        motion[Parameter.VELOCITY_STEP_SD] = 0.0
        ekf.predict(mean, cov, (stamp_ns - self._stamp_ns) * 1e-9, motion, bias)
        return mean, cov

    def _motion(self, estimate: Estimate) -> Array:
        return estimate.motion if self._straight is None else self._straight

    def copy(self) -> ManoeuvreHypotheses:
        """An independent copy: a track that goes back in time goes back to it."""
        twin = copy.copy(self)
        if self._state is not None:
            means, covs, odds, marks = self._state
            twin._state = Hypotheses(means.copy(), covs.copy(), odds.copy(), marks.copy())
        return twin
