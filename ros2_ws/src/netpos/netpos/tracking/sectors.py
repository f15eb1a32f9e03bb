"""The estimate of a device whose phase difference is ambiguous: a weighted filter per sector."""

from __future__ import annotations

import copy
import math

import numpy as np

from netpos.filters.compile import leaf
from netpos.filters.measurement import BIAS, COMMON, GROUP, KIND, Kind
from netpos.filters.state import N_CORE, POSITION, X
from netpos.messages.values import Array, TrackMode
from netpos.tracking import engine, sector_bank
from netpos.tracking.config import TrackerConfig
from netpos.tracking.engine import Option
from netpos.tracking.estimates import OneModel
from netpos.tracking.models import grown, initial_extra_sd, motions_of, options_of
from netpos.tracking.phase_fix import TWO_PI, phase_scale, spawn
from netpos.tracking.protection import protection_level

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


class Sectors(OneModel):
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
        self._means, self._spreads = np.zeros((slots, n)), np.zeros((slots, n, n))
        self._weights = np.full(slots, -math.inf)
        self._heirs = np.full(slots, -1)
        self._held = -1
        self._decided = False
        self._seen: tuple[Array, Array] | None = None
        self._prior = (np.zeros(n), np.zeros((n, n)))

    @classmethod
    def begin(
        cls, config: TrackerConfig, stamp_ns: int, rows: Array, at: int, start: tuple[Array, Array]
    ) -> Sectors | None:
        """A bank with a filter in every sector of the phase ``rows[at]``, as probable as its area
        is large, the other states from ``start``; None where range and phase have no place.

        The rest of the rows is applied to it; their variances have to hold their biases.
        """
        mean, cov = grown(*start, initial_extra_sd(config))
        bank = cls(config, stamp_ns, sectors_of(rows[at]), mean.size)
        speed, height = config.initial_speed_sd_mps, config.device_height_m
        half = bank._weights.size // 2
        for s in range(bank._weights.size):
            own, P = mean.copy(), cov.copy()
            weight = spawn(own, P, rows[at - 1], rows[at], s - half, speed, height)
            if weight > -math.inf:
                bank._means[s], bank._weights[s] = own, weight
                bank._spreads[s] = engine.to_spread(P, bank._options)
        if not (bank._weights > -math.inf).any():
            return None
        sector_bank.normalise(bank._weights, 0.0)
        rest = rows[rows[:, GROUP] != rows[at, GROUP]].copy()
        if len(rest):
            rest[:, GROUP] = np.unique(rest[:, GROUP], return_inverse=True)[1]
            rest[:, BIAS] = rest[:, COMMON] = -1  # no states yet
            bank._weigh(rest)
        bank._judge()
        return bank

    @classmethod
    def promote(
        cls, config: TrackerConfig, stamp_ns: int, mean: Array, cov: Array, rows: Array, at: int
    ) -> Sectors:
        """A bank with the one estimate known so far."""
        bank = cls(config, stamp_ns, sectors_of(rows[at]), mean.size)
        middle = bank._weights.size // 2
        bank._means[middle], bank._weights[middle] = mean, 0.0
        bank._spreads[middle] = engine.to_spread(cov, bank._options)
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
                x_m=float(self._means[s, X.PX]),
                y_m=float(self._means[s, X.PY]),
            )
            for s in np.argsort(-weights, kind="stable").tolist()
            if weights[s] > risk
        )

    @property
    def probabilities(self) -> Array:
        """Probability of each sector (S,); they sum to one."""
        weights: Array = np.exp(self._weights)
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
        return self._best - self._weights.size // 2

    @property
    def _best(self) -> int:
        return int(np.argmax(self._weights))

    def _view(self) -> tuple[Array, Array]:
        if self._seen is None:
            if self._decided:
                s = self._best
                cov = engine.to_cov(self._spreads[s], self._options)
                self._seen = self._means[s].copy(), cov.copy()
            else:
                self._seen = sector_bank.combine(
                    self._means, self._spreads, self._weights, self._options
                )
        return self._seen

    def radius(self, level_m: float) -> float:
        """Radius [m] round ``mean`` that also holds the rivals, all but the integrity risk of
        them.

        level_m : protection level of the most probable sector alone
        """
        risk = self._config.integrity_risk
        order = np.argsort(self._weights)
        left = risk / 2.0
        radius, centre = level_m, self.mean[POSITION]
        for s in order[:-1].tolist():
            weight = math.exp(self._weights[s])
            left -= weight
            if left < 0.0:
                cov = engine.to_cov(self._spreads[s], self._options)[POSITION, POSITION]
                apart = math.hypot(*(self._means[s, POSITION] - centre))
                radius = max(radius, apart + protection_level(cov, risk))
        return radius

    def grow(self, sd: Array) -> None:
        n = N_CORE + sd.size
        if self._means.shape[1] >= n:
            return
        means, spreads = np.zeros((self._weights.size, n)), np.zeros((self._weights.size, n, n))
        for s in np.flatnonzero(self._weights > -math.inf).tolist():
            cov = engine.to_cov(self._spreads[s], self._options)
            means[s], larger = grown(self._means[s], cov, sd)
            spreads[s] = engine.to_spread(larger, self._options)
        self._means, self._spreads, self._seen = means, spreads, None

    def _advance(self, stamp_ns: int, jump_sd: float, unheard_s: float, bias: Array) -> None:
        dt = (stamp_ns - self.stamp_ns) * 1e-9
        sector_bank.advance(
            self._means,
            self._spreads,
            self._weights,
            dt,
            jump_sd,
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
        opened = rejected_in_row >= self._options[Option.INFLATE_AFTER]
        speed = float(self._options[Option.INITIAL_SPEED]) if opened else 0.0
        at = phase_place(rows)
        if at >= 0:
            self._make_room(sectors_of(rows[at]))
        self._advance(stamp_ns, speed, unheard_s, bias)
        before = self._means.copy(), self._spreads.copy(), self._weights.copy()
        if self._config.robust != "none" or self._config.nlos_probability > 0.0:
            best, work = self._best, engine.scratch(self._means.shape[1], len(rows))[0]
            engine.condition(before[0][best], before[1][best], rows, self._options, work)
        nis, used, accepted = self._look(rows, at)
        manoeuvre = float(self._options[Option.MANOEUVRE_SPEED])
        if manoeuvre > 0.0 and not accepted[self._best].all():
            first = self._means, self._spreads, self._weights, self._heirs
            self._means, self._spreads = before[0].copy(), before[1].copy()
            self._weights = before[2].copy()
            self._heirs = self._heirs.copy()
            probable = self._means[self._best], self._spreads[self._best]
            within_s = engine.manoeuvre_s(*probable, rows, unheard_s, self._options)
            for s in np.flatnonzero(self._weights > -math.inf).tolist():
                engine.allow_manoeuvre(self._spreads[s], within_s, self._options)
            second = self._look(rows, at)
            if second[2][self._best].sum() > accepted[int(np.argmax(first[2]))].sum():
                nis, used, accepted = second
            else:
                self._means, self._spreads, self._weights, self._heirs = first
        self._judge()
        best, parent = self._best, int(self._heirs[self._best])
        means, spreads = before[:2] if parent >= 0 else (self._means, self._spreads)
        origin = parent if parent >= 0 else best
        self._prior = means[origin], engine.to_cov(spreads[origin], self._options)
        return float(nis[best]), int(used[best]), accepted[best]

    def _look(self, rows: Array, at: int) -> tuple[Array, Array, Array]:
        """Apply an epoch, whose phase is in row ``at``, to the predicted bank: NIS (S,), rows used
        (S,), groups accepted (S, groups). Where nothing explains it at all, it is rejected."""
        before = self._means.copy(), self._spreads.copy(), self._weights.copy()
        nis, used, accepted = self._weigh(rows) if at < 0 else self._resolve(rows, at)
        alive = self._weights > -math.inf
        sound = alive.any() and math.isfinite(
            self._weights[alive].sum() + self._means[alive].sum() + self._spreads[alive].sum()
        )
        if not sound:
            self._means, self._spreads, self._weights = before
            self._heirs[:] = np.arange(self._weights.size)
            return np.zeros_like(nis), np.zeros_like(used), np.zeros_like(accepted)
        return nis, used, accepted

    def _filled(self, rows: Array) -> tuple[Array, Array, Array, Array]:
        """Accepted groups, NIS and rows per slot, to be filled, and scratch memory."""
        slots, groups = self._weights.size, int(rows[-1, GROUP]) + 1
        work = engine.scratch(self._means.shape[1], len(rows))[0]
        return np.zeros((slots, groups)), np.zeros(slots), np.zeros(slots), work

    def _weigh(self, rows: Array) -> tuple[Array, Array, Array]:
        accepted, nis, used, work = self._filled(rows)
        bank = self._means, self._spreads, self._weights
        sector_bank.weigh(*bank, rows, self._options, accepted, nis, used, work)
        self._heirs[:] = np.arange(self._weights.size)
        self._seen = None
        return nis, used, accepted

    def _resolve(self, rows: Array, at: int) -> tuple[Array, Array, Array]:
        accepted, nis, used, work = self._filled(rows)
        sector_bank.resolve(
            self._means,
            self._spreads,
            self._weights,
            rows,
            at,
            self._options,
            self._config.sector_slip_probability,
            self._heirs,
            accepted,
            nis,
            used,
            work,
        )
        self._seen = None
        return nis, used, accepted

    def _make_room(self, slots: int) -> None:
        """Empty slots on both sides for an array with more sectors."""
        more = (slots - self._weights.size) // 2
        if more > 0:
            pad = ((more, more), (0, 0))
            self._means = np.pad(self._means, pad)
            self._spreads = np.pad(self._spreads, (*pad, (0, 0)))
            self._weights = np.pad(self._weights, more, constant_values=-math.inf)
            self._heirs = np.pad(self._heirs, more, constant_values=-1)
            self._held += more if self._held >= 0 else 0

    def _judge(self) -> None:
        """Decide, keep a decision, or take it back; follow the sector held."""
        best, probability = self._best, math.exp(self._weights[self._best])
        if self._held >= 0 and self._heirs[best] == self._held:
            self._held = best
        elif self._held >= 0:
            heirs = np.flatnonzero(self._heirs == self._held)
            self._held = int(heirs[np.argmax(self._weights[heirs])]) if heirs.size else -2
        if probability >= self._config.sector_probability:
            if self._held not in (-1, best):
                self.corrected += 1
            self._held, self._decided = best, True
        elif probability < _DOUBT or self._held != best:
            self._decided = False
        self._seen = None

    def copy(self) -> Sectors:
        twin = copy.copy(self)
        twin._means, twin._spreads = self._means.copy(), self._spreads.copy()
        twin._weights, twin._heirs = self._weights.copy(), self._heirs.copy()
        twin._motion = self._motion.copy()
        return twin
