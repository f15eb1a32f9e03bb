"""Interacting multiple models over models that share one state (Bar-Shalom, Li and Kirubarajan
2001, section 11.6), each an extended Kalman filter. Everything works in place.

``Models`` is the state; ``motions`` (K, Parameter) are the models, of equal EXTRAS.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from netpos.estimation.compile import kernel
from netpos.estimation.fit import neg2_log_likelihood
from netpos.estimation.forms import ekf
from netpos.estimation.gate import accepted_rows
from netpos.messages.values import Array

# No model is ever ruled out: its way back would take this many e-folds less.
_LEAST_WEIGHT = 1e-12
_NO_GATE = np.array([np.inf])


class Models(NamedTuple):
    """What each of K models knows, and how probable it is."""

    means: Array  # (K, n)
    covs: Array  # (K, n, n)
    weights: Array  # (K,), their sum is 1


@kernel
def transition_matrix(sojourn_s: Array, dt: float) -> Array:
    """Probabilities (K, K) of passing from model i to j within ``dt`` seconds: exp(rates dt).

    sojourn_s : (K,) mean time in each model before it is left for any other alike
    """
    count = sojourn_s.size
    step = np.zeros((count, count))
    if count == 1:
        step[0, 0] = 1.0
        return step
    fastest = dt / sojourn_s.min()
    doublings = max(0, math.ceil(math.log2(max(fastest, 1e-300))) + 7)
    for i in range(count):
        rate = dt / sojourn_s[i] / 2.0**doublings
        step[i, :] = rate / (count - 1)
        step[i, i] = -rate
    result = np.eye(count)
    for order in range(6, 0, -1):
        result = np.eye(count) + step @ result / order
    for _ in range(doublings):
        result = result @ result
        for i in range(count):
            result[i] /= result[i].sum()
    return result


@kernel
def mix(means: Array, covs: Array, weights: Array, transition: Array) -> None:
    """Start each model from the mixture of all that may have passed to it: eq. 11.6.6-7..9;
    ``weights`` become those after the passage. transition (K, K): from row to column."""
    count = weights.size
    old_means, old_covs = means.copy(), covs.copy()
    share = np.empty((count, count))
    for j in range(count):
        for i in range(count):
            share[j, i] = transition[i, j] * weights[i]
    for j in range(count):
        weights[j] = share[j].sum()
    _keep_alive(weights)
    for j in range(count):
        combine(old_means, old_covs, share[j] / share[j].sum(), means[j], covs[j])


@kernel
def combine(means: Array, covs: Array, weights: Array, mean: Array, cov: Array) -> None:
    """Mean and covariance of the mixture, the spread of the means included: eq. 11.6.6-14, 15;
    written to ``mean`` (n,) and ``cov`` (n, n)."""
    count, n = means.shape
    mean[:] = 0.0
    cov[:] = 0.0
    for k in range(count):
        for a in range(n):
            mean[a] += weights[k] * means[k, a]
    for k in range(count):
        for a in range(n):
            for b in range(a + 1):
                away = (means[k, a] - mean[a]) * (means[k, b] - mean[b])
                cov[a, b] += weights[k] * (covs[k, a, b] + away)
    for a in range(n):
        for b in range(a):
            cov[b, a] = cov[a, b]


@kernel
def reweigh(weights: Array, log_likelihoods: Array) -> None:
    """Bayes' rule for the probabilities of the models, (K,) each: eq. 11.6.6-13."""
    largest = log_likelihoods.max()
    if not math.isfinite(largest):
        return  # beyond all models: evidence for none
    for k in range(weights.size):
        weights[k] *= math.exp(log_likelihoods[k] - largest)
    _keep_alive(weights)


@kernel
def _keep_alive(weights: Array) -> None:
    total = weights.sum()
    for k in range(weights.size):
        weights[k] = max(weights[k] / total, _LEAST_WEIGHT)
    weights /= weights.sum()


@kernel
def log_likelihood(mean: Array, cov: Array, rows: Array, height_m: float) -> float:
    """Log density of ``rows`` (m, ROW_WIDTH) as the extended Kalman filter at mean, cov sees
    them."""
    distance, size = neg2_log_likelihood(mean, cov, rows, height_m, True)
    return float(-0.5 * (distance + size))


@kernel
def predict(models: Models, dt: float, motions: Array, sojourn_s: Array, bias: Array) -> None:
    """Mix, then move each model by ``dt`` seconds. Nothing happens for dt <= 0.

    sojourn_s : (K,) mean time in each model; bias : (2, k) as for ``ekf.predict``
    """
    if dt <= 0.0:
        return
    means, covs, weights = models
    mix(means, covs, weights, transition_matrix(sojourn_s, dt))
    for k in range(weights.size):
        ekf.predict(means[k], covs[k], dt, motions[k], bias)


@kernel
def update(
    models: Models,
    rows: Array,
    height_m: float,
    gate_nis: Array,
    iterations: int,
    accepted: Array,
    work: Array,
) -> tuple[float, int]:
    """One epoch: groups are gated once, against the mixture; every model fuses the same rows and
    is weighed by their likelihood. Arguments and result as ``ekf.update``; the NIS is the
    mixture's."""
    means, covs, weights = models
    mean, cov = np.empty_like(means[0]), np.empty_like(covs[0])
    combine(means, covs, weights, mean, cov)
    nis, used = ekf.update(mean, cov, rows, height_m, gate_nis, iterations, accepted, work)
    if used == 0:
        return 0.0, 0
    kept = rows[accepted_rows(rows, accepted)]
    likelihoods = np.empty(weights.size)
    unused = accepted.copy()
    for k in range(weights.size):
        likelihoods[k] = log_likelihood(means[k], covs[k], kept, height_m)
        ekf.update(means[k], covs[k], kept, height_m, _NO_GATE, iterations, unused, work)
    reweigh(weights, likelihoods)
    return nis, used
