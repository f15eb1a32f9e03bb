"""What RSUs really measure, learned from how they contradict each other.

Per RSU and quantity there are three unknowns: how far values scatter, how large the slow error is
and how long, or how far, it lasts. What is declared is their prior. Every second the residuals of
all RSUs are compared: what a shift of the position and of the clock explains is taken out of them,

    r = h(x + d) - h(x) + b + n,   y = (r - h(x + d^) + h(x)) / sqrt(1 - leverage),

with d^ of least squares (``shift``), so that y scatters as b + n does (studentised residuals,
Cook and Weisberg 1982) and neither the motion model nor what the track believes of the position is
in it: a track that is wrong must not take its own error for that of the RSUs. A grid
of candidates (scale of the variance, sd of the bias, rates at which it is forgotten per second and
per metre of way) is weighed by the likelihood of y, each candidate by a Kalman filter of its own
for b, with a Student tail. The update takes the mean variance and the mean sd of the bias of all
candidates: what is not known yet makes the track less sure. The scale of single values, for the
gate, is learned apart (variational Bayes, Särkkä and Nummenmaa 2009). Whether distances are too
long by a share that all have in common is learned beside it (``stretch``).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import add
from typing import NamedTuple, Protocol

import numpy as np

from netpos.estimation.measurement import KIND, VALUE
from netpos.estimation.sensors.table import SENSORS
from netpos.messages.values import Array
from netpos.tracking.rsus.shift import unshifted
from netpos.tracking.rsus.stretch import NONE_SEEN, Stretch, together

WINDOW_S = 1.0
"""Values of an RSU within it count as one until their scatter says otherwise."""
_WINDOW_NS = round(WINDOW_S * 1e9)
_SCALES = 2.0 ** np.arange(-9, 7)
_SPREADS = 2.0 ** np.arange(-3, 4)
_LASTING = [  # correlation time [s] and length [m]
    *((t, math.inf) for t in (3.0, 15.0, 75.0, 400.0)),
    *((t, d) for t in (75.0, 400.0) for d in (0.25, 1.0, 4.0, 16.0)),
]
_RATES, _RATES_PER_M = (1.0 / np.array(_LASTING)).T
_AHEAD_S = 10.0
_NO_BIAS = 0.3  # probability where nothing is declared
_LOG_SCALE_SD = 0.7
_LARGEST_OVERSTATED = 4.0  # of variances: no more is believed without seeing it within windows
_LOG_SPREAD_SD = 1.1
_LOG_TIME_SD = 1.5
_MEMORY = 300.0  # windows
_TAIL = 5.0  # degrees of freedom of the errors of windows
_GATE_STRENGTH, _GATE_MEMORY = 20.0, 1000.0  # values
_WITHIN_STRENGTH, _WITHIN_MEMORY = 5.0, 1000.0  # values, windows' worth of them
_LEAST_STEP = 0.05  # of successive values, over their scatter
_GAUSSIAN = 0.72  # of a variance: what the tail's distribution makes of a Gaussian's
_ALONE = 0.05  # 1 - leverage of a row that nobody checks
_STRETCHING = [s.kind for s in SENSORS if s.stretches]


def _grid() -> Array:
    """Scale, spread, rates of forgetting per second and per metre of each candidate, (4, G)."""
    no_bias = [(s, 0.0, 0.0, 0.0) for s in _SCALES]
    biased = [(s, b, 1 / t, 1 / d) for s in _SCALES for b in _SPREADS for t, d in _LASTING]
    return np.array(no_bias + biased).T


SCALE, SPREAD, RATE, RATE_PER_M = _grid()

Name = tuple[str, str]
_STRETCH: Name = "distances", "stretch"
Sums = tuple[float, ...]
"""Of the rows of a window: information, and that times residual; number, residual and its square
over the sd stated; half the square of the step from the value before; that value."""


@dataclass(frozen=True, slots=True, eq=False)
class ErrorModel:
    """What is learned of one quantity of one RSU; arrays are replaced, never changed."""

    unit: float  # of SPREAD
    prior: Array  # (G,) log
    evidence: Array  # (G,) log-likelihood, fading
    mean: Array  # (G,) of the bias
    var: Array  # (G,)
    last_ns: int = -1
    last_m: float = 0.0
    scatter: tuple[float, float] = (_GATE_STRENGTH, _GATE_STRENGTH)  # sum, count
    within: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Of values about the mean of their window: sum of squares over what is stated, their number
    less one a window, half the sum of squared steps, number of windows."""
    scale: float = 1.0
    bias_sd: float = 0.0
    lasting: Array = field(default_factory=lambda: np.ones(len(_LASTING)))
    """Weights (12,) of how long the bias lasts."""
    weights: Array = field(default_factory=lambda: np.ones(SCALE.size) / SCALE.size)
    """(G,)"""
    log_fit: float = 0.0
    """Log-likelihood of all windows, each as it was foreseen."""

    @property
    def gate_scale(self) -> float:
        """Variance of single values over what they state."""
        return self.scatter[0] / self.scatter[1]

    @property
    def window_scale(self) -> float:
        """Variance of the mean of a window over that which one value states, by how values scatter
        within windows.

        What is stated and not seen within windows lasts as long as they do. What is seen there is
        first-order Gauss-Markov noise, as its steps say (von Neumann 1941): with the correlation
        rho of successive values, the mean of n of them has (1 + rho) / (1 - rho) / n of their
        variance.
        """
        total, count, _, windows = self.within
        seen = total / (_WITHIN_STRENGTH + count)
        if total <= 0.0:
            return 1.0
        step, n = self._step, 1.0 + count / windows
        return max(1.0 - seen, 0.0) + seen * min((2.0 - step) / step / n, 1.0)

    @property
    def _step(self) -> float:
        """Half the mean squared step from value to value over their variance within windows: 1 of
        white noise, 1 less their correlation."""
        total, _, steps, _ = self.within
        return min(max(steps / total, _LEAST_STEP), 1.0) if total > 0.0 else _LEAST_STEP

    @property
    def least_scale(self) -> float:
        """What is stated is believed to a quarter of ``window_scale`` where successive values have
        half of their variance or more in common: what changes that slowly may change more slowly
        still. Down to nothing where they have nothing in common. No more than the largest
        candidate."""
        count = self.within[1]
        common = 1.0 - self._step * count / (_WITHIN_STRENGTH + count)
        least = min(2.0 * common, 1.0) * self.window_scale / _LARGEST_OVERSTATED
        return min(least, float(_SCALES[-1]))

    def scattering(
        self, gate_scale: float, within: tuple[float, float, float, float]
    ) -> ErrorModel:
        """With these as what is known of the scatter beforehand."""
        return replace(self, scatter=(gate_scale * _GATE_STRENGTH, _GATE_STRENGTH), within=within)

    @classmethod
    def declared(cls, noise_sd: float, bias_sd: float, time_s: float) -> ErrorModel:
        """With what is declared as prior; ``bias_sd`` 0: nothing is."""
        log_prior = np.zeros_like(SCALE)
        biased = SPREAD > 0.0
        spread = np.where(biased, SPREAD, 1.0)
        if bias_sd > 0.0:
            shape = np.exp(-0.5 * (np.log(spread) / _LOG_SPREAD_SD) ** 2)
            shape *= np.exp(-0.5 * (np.log(np.maximum(RATE, 1e-3) * time_s) / _LOG_TIME_SD) ** 2)
            none = 0.02
        else:
            shape = spread / (1.0 + spread**2)  # half-Cauchy (Gelman 2006), per log
            none = _NO_BIAS
        share = shape / shape[biased].sum() * len(_SCALES)
        log_prior = log_prior + np.log(np.where(biased, (1.0 - none) * share, none))
        unit = bias_sd if bias_sd > 0.0 else noise_sd
        size = np.zeros_like(SCALE)
        model = cls(unit, log_prior, size, size, (unit * SPREAD) ** 2)
        return model.weighed(log_prior)

    def weighed(self, log_weights: Array) -> ErrorModel:
        """With the means of the candidates under ``log_weights`` (G,) and what the scatter within
        windows says of the scale."""
        ratio = np.log(SCALE / self.window_scale) / _LOG_SCALE_SD
        log_weights = log_weights - 0.5 * (ratio + 0.5 * _LOG_SCALE_SD) ** 2
        log_weights = np.where(self.least_scale > SCALE, -np.inf, log_weights)
        w = np.exp(log_weights - log_weights.max())
        w /= w.sum()
        ws = w * SPREAD
        total = float(ws.sum())
        return replace(
            self,
            weights=w,
            scale=float(w @ SCALE),
            bias_sd=self.unit * total,
            lasting=ws[len(_SCALES) :].reshape(-1, len(_LASTING)).sum(axis=0) / total,
        )

    def time_s(self, speed_mps: float) -> float:
        """Correlation time of the bias for a device that moves at ``speed_mps``: of what is
        expected to be left of it after ``_AHEAD_S``."""
        left = self.lasting @ np.exp(-_AHEAD_S * (_RATES + speed_mps * _RATES_PER_M))
        return -_AHEAD_S / math.log(left)

    def heard(self, ratio: float) -> ErrorModel:
        """With one more value: its squared residual over the variance stated is ``ratio``."""
        total, count = self.scatter
        new = (1.0 / _GATE_MEMORY) * _GATE_STRENGTH
        fade = 1.0 - 1.0 / _GATE_MEMORY
        return replace(self, scatter=(fade * total + new + ratio, fade * count + new + 1.0))

    def scattered(self, total: float, count: float, steps: float) -> ErrorModel:
        """With the scatter of ``count`` + 1 values of a window about their mean, and half the sum
        of their squared steps."""
        fade = (1.0 - 1.0 / _WITHIN_MEMORY) ** count
        old, windows = self.within[:3], fade * self.within[3] + 1.0
        a, b, c = (fade * w + v for w, v in zip(old, (total, count, steps), strict=True))
        return replace(self, within=(a, b, c, windows))

    def weigh(
        self, stamp_ns: int, moved_m: float, y: float, variance: float, share: float
    ) -> ErrorModel:
        """With the studentised residual ``y`` of a window, of ``variance`` by what is stated, that
        counts for ``share`` of a measurement."""
        dt = 0.0 if self.last_ns < 0 else (stamp_ns - self.last_ns) * 1e-9
        sd2 = (self.unit * SPREAD) ** 2
        decay = np.exp(-dt * RATE - (moved_m - self.last_m) * RATE_PER_M)
        mean, var = decay * self.mean, decay**2 * self.var + sd2 * (1.0 - decay**2)
        v = SCALE * variance
        S = var + v
        d2 = (y - mean) ** 2 / (_GAUSSIAN * S)
        log_likelihood = -0.5 * np.log(S) - 0.5 * (_TAIL + 1.0) * np.log1p(d2 / _TAIL)
        largest = float(log_likelihood.max())
        log_likelihood -= largest
        foreseen = largest + math.log(float(self.weights @ np.exp(log_likelihood)))
        weight = np.minimum((_TAIL + 1.0) / (_TAIL + d2), 1.0)
        gain = var / (var + v / (weight * share))
        return replace(
            self,
            evidence=(1.0 - 1.0 / _MEMORY) * self.evidence + share * log_likelihood,
            mean=mean + gain * (y - mean),
            var=(1.0 - gain) * var,
            last_ns=stamp_ns,
            last_m=moved_m,
            log_fit=self.log_fit + share * foreseen,
        )


Learned = ErrorModel | Stretch
Models = dict[Name, ErrorModel]


class Others(Protocol):
    """What other devices have learned of the same RSUs."""

    def note(self, owner: tuple[str, int], stamp_ns: int, name: Name, model: Learned) -> None:
        """Take what ``owner``, a device and the number of its life, has concluded."""

    def of_others(
        self, owner: tuple[str, int], stamp_ns: int, name: Name, unit: float
    ) -> list[Learned]:
        """What all but ``owner`` have concluded of ``name``."""


class _Window(NamedTuple):
    """What was heard in a window: name, last row (m, ROW_WIDTH), mean residual (m,) and its
    variance by what is stated (m,), distance (m,) m, 0 where it is none, and what
    ``ErrorModel.scattered`` takes of each."""

    names: list[Name]
    rows: Array
    residual: Array
    variance: Array
    distance: Array
    scatter: list[tuple[float, float, float]]

    def moved(self, share: float) -> _Window:
        """With the residuals where ``share`` of the distance more had been left in."""
        return self._replace(residual=self.residual + share * self.distance)


@dataclass(slots=True)
class LearnedErrors:
    """Error models by the names of the bias states, of which the first part is the RSU or the
    network and the second the quantity. ``others``: what other devices know, and this one, as
    ``owner``, tells them."""

    others: Others | None = None
    owner: tuple[str, int] = ("", 0)
    models: Models = field(default_factory=dict)
    """Those of the likelier hypothesis on the stretch."""
    unlikelier: Models = field(default_factory=dict)
    """Those of the other one."""
    own_stretch: Stretch = NONE_SEEN
    stretch: Stretch = NONE_SEEN
    """With what others have seen of it."""
    stretched: bool = False
    """Whether it is likelier that there is one; rows leave it out then."""
    moved_m: float = 0.0
    moved_ns: int = -1
    window_ns: int = -1
    window: dict[Name, Sums] = field(default_factory=dict)
    newest: dict[Name, Array] = field(default_factory=dict)
    """The last row (ROW_WIDTH,) of each in the window."""

    def copy(self) -> LearnedErrors:
        """An independent copy."""
        return replace(
            self,
            models=self.models.copy(),
            unlikelier=self.unlikelier.copy(),
            window=self.window.copy(),
            newest=self.newest.copy(),
        )

    def model(
        self, name: Name, noise_sd: float, bias_sd: float, time_s: float, stamp_ns: int = 0
    ) -> ErrorModel:
        """The model of ``name``, from its prior, and what others know by then, where it is new."""
        if name not in self.models:
            if not self.models:
                self._decide(stamp_ns)
            model = ErrorModel.declared(noise_sd, bias_sd, time_s)
            known = self._known(name, stamp_ns, model.unit)
            if known:
                model = model.scattering(
                    float(np.mean([other.gate_scale for other in known])),
                    tuple(np.mean([other.within for other in known], axis=0).tolist()),
                )
            self.models[name] = self.unlikelier[name] = model
            self._choose(self.models, name, known)
            self._choose(self.unlikelier, name, [])
        return self.models[name]

    def _known(self, name: Name, stamp_ns: int, unit: float) -> list[ErrorModel]:
        found = self._of_others(name, stamp_ns, unit)
        return [model for model in found if isinstance(model, ErrorModel)]

    def _of_others(self, name: Name, stamp_ns: int, unit: float) -> list[Learned]:
        if self.others is None:
            return []
        return self.others.of_others(self.owner, stamp_ns, name, unit)

    def _decide(self, stamp_ns: int) -> None:
        """Choose the hypothesis on the stretch by all that is known of it."""
        found = self._of_others(_STRETCH, stamp_ns, self.own_stretch.unit)
        others = [stretch for stretch in found if isinstance(stretch, Stretch)]
        self.stretch = together(self.own_stretch, others)
        if self.stretch.is_one(self.stretched) != self.stretched:
            self.stretched, given_up = not self.stretched, self.models
            self.models = {
                name: replace(model, scatter=given_up[name].scatter)
                for name, model in self.unlikelier.items()
            }
            self.unlikelier = given_up

    def move(self, stamp_ns: int, speed_mps: float) -> None:
        """Note the way since the last call."""
        if self.moved_ns >= 0:
            self.moved_m += speed_mps * (stamp_ns - self.moved_ns) * 1e-9
        self.moved_ns = stamp_ns

    def hear(self, name: Name, row: Array, left: list[float], stated: float) -> None:
        """Note a row (ROW_WIDTH,), what is left of it by ``unexplained``, and the variance
        stated."""
        model = self.models[name]
        information, r = model.scale / left[2], left[0]
        z = r / math.sqrt(stated)
        old = self.window.get(name)
        step = 0.0 if old is None else 0.5 * (z - old[-1]) ** 2
        new = (information, information * r, 1.0, z, z * z, step)
        self.window[name] = (*(new if old is None else map(add, old, new)), z)
        self.newest[name] = row
        self.models[name] = model.heard(left[1] / stated)

    def conclude(self, stamp_ns: int, mean: Array, height_m: float) -> list[Name]:
        """Weigh a window that is over, seen from the mean (n,) of the posterior; whose models
        changed."""
        if self.window_ns < 0:
            self.window_ns = stamp_ns
        if stamp_ns < self.window_ns + _WINDOW_NS:
            return []
        names, window, newest = list(self.window), self.window, self.newest
        self.window, self.newest, self.window_ns = {}, {}, stamp_ns
        if not names:
            return []
        heard = self._heard(names, np.array([window[name] for name in names]), newest)
        seen_from = mean, height_m
        share = self.stretch.share
        changed, left = self._weigh(self.models, heard, stamp_ns, seen_from)
        if heard.distance.any():
            other = heard.moved(share if self.stretched else -share)
            _, other_left = self._weigh(self.unlikelier, other, stamp_ns, seen_from)
            plain, stretched = self.unlikelier, self.models
            if not self.stretched:
                plain, stretched, left = stretched, plain, other_left
            gained = sum(stretched[name].log_fit - plain[name].log_fit for name in stretched)
            self.own_stretch = self.own_stretch.seen(*left, share, gained)
            self._decide(stamp_ns)
            self._tell(stamp_ns, _STRETCH, self.own_stretch)
        for name in changed:
            self._tell(stamp_ns, name, self.models[name])
        return changed

    def _tell(self, stamp_ns: int, name: Name, model: Learned) -> None:
        if self.others is not None:
            self.others.note(self.owner, stamp_ns, name, model)

    @staticmethod
    def _heard(names: list[Name], sums: Array, newest: Mapping[Name, Array]) -> _Window:
        """What ``sums`` (m, 7) of the rows of a window say."""
        variance = 1.0 / sums[:, 0]
        square = sums[:, 4] - sums[:, 3] ** 2 / sums[:, 2]
        scatter = np.column_stack([square, sums[:, 2] - 1.0, sums[:, 5]]).tolist()
        rows = np.array([newest[name] for name in names])
        distance = np.where(np.isin(rows[:, KIND], _STRETCHING), rows[:, VALUE], 0.0)
        return _Window(names, rows, sums[:, 1] * variance, variance, distance, scatter)

    def _weigh(
        self, models: Models, heard: _Window, stamp_ns: int, seen_from: tuple[Array, float]
    ) -> tuple[list[Name], tuple[Array, Array, Array]]:
        """Weigh the candidates of ``models`` by a window. Whose changed; what a shift leaves of
        the residuals (m,) and of the distances (m,), over the sd of a residual, and the part of
        each residual that is news (m,)."""
        mine = [
            models[name].scattered(*of_it)
            for name, of_it in zip(heard.names, heard.scatter, strict=True)
        ]
        noise = np.array([m.scale for m in mine]) * heard.variance
        slow = np.array([m.bias_sd for m in mine]) ** 2
        sd = np.sqrt(noise + slow)
        left, checked, distance = unshifted(
            heard.rows, heard.residual, sd, *seen_from, heard.distance
        )
        changed = []
        for i, name in enumerate(heard.names):
            if checked[i] > _ALONE:
                y = float(left[i] / math.sqrt(checked[i]))
                models[name] = mine[i].weigh(
                    stamp_ns, self.moved_m, y, float(heard.variance[i]), float(checked[i])
                )
                changed.append(name)
        for name in changed:
            known = self._known(name, stamp_ns, models[name].unit) if models is self.models else []
            self._choose(models, name, known)
        lasts = np.array([m.time_s(0.0) for m in mine]) * 2.0 / WINDOW_S
        return changed, (left / sd, distance / sd, sd**2 / (noise + slow * np.maximum(lasts, 1.0)))

    def _choose(self, models: Models, name: Name, known: Sequence[ErrorModel]) -> None:
        """Weigh the candidates of ``name`` by what it measured itself, of any device, those of
        other devices as ``known``, and by the mean of what the others of its kind did, as if it
        were one measurement of theirs."""
        mine = models[name]
        others = [m.evidence for n, m in models.items() if n[1] == name[1] and n != name]
        log_weights = mine.prior + mine.evidence
        if others:
            log_weights = log_weights + np.mean(others, axis=0)
        for of_other in known:
            log_weights = log_weights + of_other.evidence
        models[name] = mine.weighed(log_weights)
