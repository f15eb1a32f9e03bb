"""What is learned of one quantity of one RSU: how far values scatter, how large the slow error is
and how long, or how far, it lasts.

What is declared is the prior. A grid of candidates (scale of the variance, sd of the bias, rates
at which it is forgotten per second and per metre of way) is weighed by the likelihood of the
studentised residuals, each candidate by a Kalman filter of its own for the bias, with a Student
tail. The update takes the mean variance and the mean sd of the bias of all candidates: what is not
known yet makes the track less sure. The scale of single values, for the gate, is learned apart
(variational Bayes, Särkkä and Nummenmaa 2009).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from netpos.messages.values import Array

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


def _grid() -> Array:
    """Scale, spread, rates of forgetting per second and per metre of each candidate, (4, G)."""
    no_bias = [(s, 0.0, 0.0, 0.0) for s in _SCALES]
    biased = [(s, b, 1 / t, 1 / d) for s in _SCALES for b in _SPREADS for t, d in _LASTING]
    return np.array(no_bias + biased).T


SCALE, SPREAD, RATE, RATE_PER_M = _grid()


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
    """Probabilities (G,) of the candidates, by all that is known."""
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
