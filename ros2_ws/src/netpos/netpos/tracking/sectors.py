"""The estimate of a device whose phase difference is ambiguous: a weighted filter per sector."""

from __future__ import annotations

import copy
import math

import numpy as np

from netpos.estimation import engine, fusion
from netpos.estimation.compile import leaf
from netpos.estimation.measurement import BIAS, COMMON, GROUP, KIND, Kind
from netpos.estimation.protection import protection_level
from netpos.estimation.state import N_CORE, POSITION, X
from netpos.messages.values import Array, TrackMode
from netpos.tracking import sector_bank
from netpos.tracking.config import TrackerConfig
from netpos.tracking.estimates import OneModel
from netpos.tracking.models import augmented, motions_of, options_of, start_state
from netpos.tracking.phase_fix import TWO_PI, init_hypothesis, phase_scale
from netpos.tracking.sector_bank import Bank, BankResult

_DOUBT = 0.9  # a decision is taken back below this probability


@leaf
def phase_place(rows: Array) -> int:
    """Index of the first phase in ``rows`` (m, ROW_WIDTH) with a range of the same measurement
    just before it; -1: there is none."""
    for i in range(1, rows.shape[0]):
        ranged = int(rows[i - 1, KIND]) == Kind.RANGE and rows[i - 1, GROUP] == rows[i, GROUP]
        if ranged and int(rows[i, KIND]) == Kind.PHASE:
            return i
    return -1


def sectors_of(phase: Array) -> int:
    """Slots a bank needs for a phase row: every number of turns, and what noise adds at both
    ends."""
    turns = phase_scale(phase) / TWO_PI
    return int(2 * math.ceil(turns + 0.5) + 1)


def _copy_of(bank: Bank) -> Bank:
    return Bank(bank.means.copy(), bank.covs_or_sqrts.copy(), bank.weights.copy())


class PhaseAmbiguityBank(OneModel):
    """Bank of filters of ``sector_bank`` with the interface of ``estimates.Estimate``.

    Decided once a sector has the probability ``sector_probability``: then mean and covariance are
    its own, before they are those of all sectors together.
    """

    def __init__(self, config: TrackerConfig, stamp_ns: int, slots: int, n: int) -> None:
        """An empty bank; ``begin`` and ``promote`` fill one."""
        self.stamp_ns = stamp_ns
        self.corrected = 0
        """How often a decision was replaced by another."""
        self._config = config
        self._options = options_of(config)
        self._motion: Array = motions_of(config)[0].copy()
        weights = np.full(slots, -math.inf)
        self._bank = Bank(np.zeros((slots, n)), np.zeros((slots, n, n)), weights)
        self._parent_index = np.full(slots, -1)
        self._locked = -1
        self._decided = False
        self._seen: tuple[Array, Array] | None = None
        self._prior = (np.zeros(n), np.zeros((n, n)))

    @classmethod
    def begin(
        cls, config: TrackerConfig, stamp_ns: int, rows: Array, at: int, start: tuple[Array, Array]
    ) -> PhaseAmbiguityBank | None:
        """A bank with a filter in every sector of the phase ``rows[at]``, as probable as its area
        is large, the other states from ``start``; None where range and phase have no place.

        The rest of the rows is applied to it; their variances have to hold their biases.
        """
        mean, cov = start_state(config, *start)
        bank = cls(config, stamp_ns, sectors_of(rows[at]), mean.size)
        speed, height = config.initial_speed_sd_mps, config.device_height_m
        half = bank._bank.weights.size // 2
        for s in range(bank._bank.weights.size):
            own, P = mean.copy(), cov.copy()
            weight = init_hypothesis(own, P, rows[at - 1], rows[at], s - half, speed, height)
            if weight > -math.inf:
                bank._bank.means[s], bank._bank.weights[s] = own, weight
                bank._bank.covs_or_sqrts[s] = engine.to_cov_or_sqrt(P, bank._options)
        if not (bank._bank.weights > -math.inf).any():
            return None
        sector_bank.normalise(bank._bank.weights, 0.0)
        rest = rows[rows[:, GROUP] != rows[at, GROUP]].copy()
        if len(rest):
            rest[:, GROUP] = np.unique(rest[:, GROUP], return_inverse=True)[1]
            rest[:, BIAS] = rest[:, COMMON] = -1  # no states yet
            bank._update(rest)
        bank._judge()
        return bank

    @classmethod
    def promote(
        cls, config: TrackerConfig, stamp_ns: int, mean: Array, cov: Array, rows: Array, at: int
    ) -> PhaseAmbiguityBank:
        """A bank with the one estimate known so far."""
        bank = cls(config, stamp_ns, sectors_of(rows[at]), mean.size)
        middle = bank._bank.weights.size // 2
        bank._bank.means[middle], bank._bank.weights[middle] = mean, 0.0
        bank._bank.covs_or_sqrts[middle] = engine.to_cov_or_sqrt(cov, bank._options)
        bank._judge()
        return bank

    @property
    def decided(self) -> bool:
        """Whether the sector is known."""
        return self._decided

    @property
    def modes(self) -> tuple[TrackMode, ...]:
        """The sectors that carry more than the integrity risk while none is decided."""
        if self._decided:
            return ()
        weights, risk = self.probabilities, self._config.integrity_risk
        return tuple(
            TrackMode(
                weight=float(weights[s]),
                x_m=float(self._bank.means[s, X.PX]),
                y_m=float(self._bank.means[s, X.PY]),
            )
            for s in np.argsort(-weights, kind="stable").tolist()
            if weights[s] > risk
        )

    @property
    def probabilities(self) -> Array:
        """Probability of each sector (S,); they sum to one."""
        weights: Array = np.exp(self._bank.weights)
        return weights

    @property
    def mean(self) -> Array:
        return self._view()[0]

    @property
    def cov(self) -> Array:
        return self._view()[1]

    @property
    def prior(self) -> tuple[Array, Array]:
        return self._prior

    @property
    def sector(self) -> int:
        """Whole turns of the last phase in the most probable sector."""
        return self._best - self._bank.weights.size // 2

    @property
    def _best(self) -> int:
        return int(np.argmax(self._bank.weights))

    def _view(self) -> tuple[Array, Array]:
        if self._seen is None:
            if self._decided:
                s = self._best
                cov = engine.to_cov(self._bank.covs_or_sqrts[s], self._options)
                self._seen = self._bank.means[s].copy(), cov.copy()
            else:
                self._seen = sector_bank.combine(self._bank, self._options)
        return self._seen

    def radius(self, level_m: float) -> float:
        """Radius [m] round ``mean`` that also holds the other sectors, all but the integrity risk
        of them.

        level_m : protection level of the most probable sector alone
        """
        risk = self._config.integrity_risk
        order = np.argsort(self._bank.weights)
        left = risk / 2.0
        radius, centre = level_m, self.mean[POSITION]
        for s in order[:-1].tolist():
            weight = math.exp(self._bank.weights[s])
            left -= weight
            if left < 0.0:
                cov = engine.to_cov(self._bank.covs_or_sqrts[s], self._options)[POSITION, POSITION]
                apart = math.hypot(*(self._bank.means[s, POSITION] - centre))
                radius = max(radius, apart + protection_level(cov, risk))
        return radius

    def augment(self, sd: Array) -> None:
        n = N_CORE + sd.size
        if self._bank.means.shape[1] >= n:
            return
        means, covs_or_sqrts = (
            np.zeros((self._bank.weights.size, n)),
            np.zeros((self._bank.weights.size, n, n)),
        )
        for s in np.flatnonzero(self._bank.weights > -math.inf).tolist():
            cov = engine.to_cov(self._bank.covs_or_sqrts[s], self._options)
            means[s], larger = augmented(self._bank.means[s], cov, sd)
            covs_or_sqrts[s] = engine.to_cov_or_sqrt(larger, self._options)
        self._bank, self._seen = Bank(means, covs_or_sqrts, self._bank.weights), None

    def _advance(
        self, stamp_ns: int, velocity_step_sd: float, unheard_s: float, bias: Array
    ) -> None:
        dt = (stamp_ns - self.stamp_ns) * 1e-9
        sector_bank.advance(
            self._bank,
            dt,
            velocity_step_sd,
            unheard_s,
            self._motion,
            bias,
            self._options,
        )
        self.stamp_ns, self._seen = stamp_ns, None

    def predict(self, stamp_ns: int, bias: Array) -> None:
        if stamp_ns > self.stamp_ns:
            self._advance(stamp_ns, 0.0, 0.0, bias)

    def step(
        self, stamp_ns: int, unheard_s: float, rejected_in_row: int, rows: Array, bias: Array
    ) -> tuple[float, int, Array]:
        opened = rejected_in_row >= self._options.inflate_after
        speed = self._options.initial_speed_sd if opened else 0.0
        at = phase_place(rows)
        if at >= 0:
            self._make_room(sectors_of(rows[at]))
        self._advance(stamp_ns, speed, unheard_s, bias)
        before = _copy_of(self._bank)
        if self._config.robust != "none" or self._config.nlos_probability > 0.0:
            best, work = self._best, fusion.workspace(before.means.shape[1], len(rows))
            engine.reweight(
                before.means[best], before.covs_or_sqrts[best], rows, self._options, work
            )
        nis, used, accepted = self._apply(rows, at)
        manoeuvre = self._options.manoeuvre_speed_sd
        if manoeuvre > 0.0 and not accepted[self._best].all():
            first, first_parent_index = self._bank, self._parent_index
            self._bank, self._parent_index = _copy_of(before), self._parent_index.copy()
            mean, cov_or_sqrt = self._bank.means[self._best], self._bank.covs_or_sqrts[self._best]
            cov = engine.to_cov(cov_or_sqrt, self._options)
            within_s = engine.manoeuvre_s(mean, cov, rows, unheard_s, self._options)
            for s in np.flatnonzero(self._bank.weights > -math.inf).tolist():
                engine.inflate_for_manoeuvre(self._bank.covs_or_sqrts[s], within_s, self._options)
            second = self._apply(rows, at)
            if second[2][self._best].sum() > accepted[int(np.argmax(first.weights))].sum():
                nis, used, accepted = second
            else:
                self._bank, self._parent_index = first, first_parent_index
        self._judge()
        best, parent = self._best, int(self._parent_index[self._best])
        bank, origin = (before, parent) if parent >= 0 else (self._bank, best)
        self._prior = bank.means[origin], engine.to_cov(bank.covs_or_sqrts[origin], self._options)
        return float(nis[best]), int(used[best]), accepted[best]

    def _apply(self, rows: Array, at: int) -> tuple[Array, Array, Array]:
        """Apply an epoch, whose phase is in row ``at``, to the predicted bank: NIS (S,), rows used
        (S,), groups accepted (S, groups). Where nothing explains it at all, it is rejected."""
        before = _copy_of(self._bank)
        nis, used, accepted = self._update(rows) if at < 0 else self._resolve(rows, at)
        alive = self._bank.weights > -math.inf
        sound = alive.any() and math.isfinite(
            self._bank.weights[alive].sum()
            + self._bank.means[alive].sum()
            + self._bank.covs_or_sqrts[alive].sum()
        )
        if not sound:
            self._bank = before
            self._parent_index[:] = np.arange(self._bank.weights.size)
            return np.zeros_like(nis), np.zeros_like(used), np.zeros_like(accepted)
        return nis, used, accepted

    def _filled(self, rows: Array) -> tuple[BankResult, Array]:
        """A result to be filled, and scratch memory."""
        slots, groups = self._bank.weights.size, int(rows[-1, GROUP]) + 1
        work = fusion.workspace(self._bank.means.shape[1], len(rows))
        return BankResult(np.zeros((slots, groups)), np.zeros(slots), np.zeros(slots)), work

    def _update(self, rows: Array) -> tuple[Array, Array, Array]:
        result, work = self._filled(rows)
        sector_bank.update(self._bank, rows, self._options, result, work)
        self._parent_index[:] = np.arange(self._bank.weights.size)
        self._seen = None
        return result.nis, result.used, result.accepted

    def _resolve(self, rows: Array, at: int) -> tuple[Array, Array, Array]:
        result, work = self._filled(rows)
        slip = self._config.sector_slip_probability
        sector_bank.resolve(
            self._bank, rows, at, self._options, slip, self._parent_index, result, work
        )
        self._seen = None
        return result.nis, result.used, result.accepted

    def _make_room(self, slots: int) -> None:
        """Empty slots on both sides for an array with more sectors."""
        more = (slots - self._bank.weights.size) // 2
        if more > 0:
            pad = ((more, more), (0, 0))
            means, covs_or_sqrts = (
                np.pad(self._bank.means, pad),
                np.pad(self._bank.covs_or_sqrts, (*pad, (0, 0))),
            )
            weights = np.pad(self._bank.weights, more, constant_values=-math.inf)
            self._bank = Bank(means, covs_or_sqrts, weights)
            self._parent_index = np.pad(self._parent_index, more, constant_values=-1)
            self._locked += more if self._locked >= 0 else 0

    def _judge(self) -> None:
        """Decide, keep a decision, or take it back; follow the sector held."""
        best, probability = self._best, math.exp(self._bank.weights[self._best])
        if self._locked >= 0 and self._parent_index[best] == self._locked:
            self._locked = best
        elif self._locked >= 0:
            children = np.flatnonzero(self._parent_index == self._locked)
            self._locked = (
                int(children[np.argmax(self._bank.weights[children])]) if children.size else -2
            )
        if probability >= self._config.sector_probability:
            if self._locked not in (-1, best):
                self.corrected += 1
            self._locked, self._decided = best, True
        elif probability < _DOUBT or self._locked != best:
            self._decided = False
        self._seen = None

    def change_prior(self, index: int, before: float, after: float) -> None:
        """Nothing: sectors keep the priors they began with."""

    def copy(self) -> PhaseAmbiguityBank:
        twin = copy.copy(self)
        twin._bank, twin._parent_index = _copy_of(self._bank), self._parent_index.copy()
        twin._motion = self._motion.copy()
        return twin
