"""How much larger errors are than the covariance says, by the NIS of the epochs so far."""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import lru_cache

import numpy as np

from netpos.estimation.chi_square import log_survival
from netpos.estimation.compile import kernel, leaf
from netpos.messages.values import Array

SCALES2 = 2.0 ** np.arange(8)
"""Ratios of true to stated variances: beyond the last a gate of 0.9999 refuses three rows in
four."""
_LOG_SCALES2 = np.log(SCALES2)
_BEGIN = 1e-3
_END = 1.0 / 50.0
_STEPS = 60


class NoiseScale:
    """Probability of each of ``SCALES2``, a Markov chain over the epochs.

    Before an epoch the stated variances, where they were true, stop being true with probability
    1e-3 (any larger scale is as likely), and are true again with probability 1/50 where they were
    not. Each epoch is weighed by the chi-square density of its NIS under each scale; a refused
    group, of which nothing is known but that its NIS is above the gate, by the probability of
    that (a censored observation). This is the forward recursion of a hidden Markov model
    (Rabiner 1989).
    """

    def __init__(self) -> None:
        self.weights = np.zeros(SCALES2.size)
        self.weights[0] = 1.0

    def add(self, nis: float, dof: int, refused: Iterable[tuple[int, float]] = ()) -> None:
        """Take an epoch: ``nis`` of its ``dof`` accepted rows, and rows and gate of each refused
        group. One without measurements says nothing."""
        censored = np.zeros(SCALES2.size)
        for rows, gate_nis in refused:
            censored += _log_refused(rows, gate_nis)
        if dof > 0 or censored[0] < 0.0:
            _add(self.weights, nis, float(dof), censored)

    def inflation(self, risk: float) -> float:
        """Factor on the radius that a Gaussian error leaves with probability ``risk``, >= 1, so
        that an error of unknown scale leaves it with this probability.

        Exact for a circular error, and nearly so (above all where it is large) for any other.
        """
        factor: float = _factor(self.weights, risk)
        return factor

    @staticmethod
    def of_run(nis: Array, dof: Array, refused: Array, risk: float) -> Array:
        """``inflation`` (N,) after each epoch of a run.

        nis, dof : (N,) of accepted rows; refused : (N, 3) number of refused groups, rows of each,
        and their gate
        """
        censored = np.zeros((nis.size, SCALES2.size))
        for kind in np.unique(refused[refused[:, 0] > 0.0], axis=0):
            number, rows, gate_nis = kind.tolist()
            censored[(refused == kind).all(axis=1)] = number * _log_refused(int(rows), gate_nis)
        factors: Array = _of_run(nis, dof.astype(float), censored, risk)
        return factors

    def copy(self) -> NoiseScale:
        """An independent copy: a track that goes back in time goes back to it."""
        twin = NoiseScale.__new__(NoiseScale)
        twin.weights = self.weights.copy()
        return twin


@lru_cache(1024)
def _log_refused(rows: int, gate_nis: float) -> Array:
    """Logarithm of the probability that the NIS of ``rows`` is above the gate, for each scale."""
    return np.array([log_survival(rows, gate_nis / (2.0 * scale2))[0] for scale2 in SCALES2])


@leaf
def _add(weights: Array, nis: float, dof: float, censored: Array) -> None:
    """One step of the recursion, in place. censored : (len(SCALES2),) log-likelihood of what was
    refused."""
    true = weights[0]
    weights[0] = (1.0 - _BEGIN) * true + _END * (1.0 - true)
    best = -math.inf
    for j in range(weights.size):
        if j > 0:
            weights[j] = (1.0 - _END) * weights[j] + _BEGIN * true / (weights.size - 1)
        log_likelihood = censored[j] - 0.5 * (dof * _LOG_SCALES2[j] + nis / SCALES2[j])
        weights[j] = math.log(weights[j]) + log_likelihood
        best = max(best, weights[j])
    total = 0.0
    for j in range(weights.size):
        weights[j] = math.exp(weights[j] - best)
        total += weights[j]
    for j in range(weights.size):
        weights[j] /= total


@leaf
def _factor(weights: Array, risk: float) -> float:
    """Factor f >= 1 with sum of weights exp(-u f^2 / scale^2) = exp(-u) = risk.

    The logarithm of the sum is convex in f^2 and falls: Newton's steps from f = 1 never pass the
    root.
    """
    log_risk, factor2 = math.log(risk), 1.0
    for _ in range(_STEPS):
        outside, slope = 0.0, 0.0
        for j in range(weights.size):
            term = weights[j] * math.exp(log_risk * factor2 / SCALES2[j])
            outside += term
            slope -= log_risk / SCALES2[j] * term
        step = (math.log(outside) - log_risk) * outside / slope
        if step > 0.0:
            factor2 += step
        if step <= 1e-6 * factor2:  # the next one would be its square
            break
    return math.sqrt(factor2)


@kernel
def _of_run(nis: Array, dof: Array, censored: Array, risk: float) -> Array:
    weights, factors = np.zeros(SCALES2.size), np.ones(nis.size)
    weights[0], factor = 1.0, 1.0
    for k in range(nis.size):
        if dof[k] > 0.0 or censored[k, 0] < 0.0:
            _add(weights, nis[k], dof[k], censored[k])
            factor = _factor(weights, risk)
        factors[k] = factor
    return factors
