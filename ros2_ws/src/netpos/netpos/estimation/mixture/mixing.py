"""Interacting models: the mixing of components of which each has a motion model of its own (Blom
and Bar-Shalom 1988; Bar-Shalom, Li and Kirubarajan 2001, section 11.6). Everything works in place.

What a component does at a measurement, and what its likelihood makes of its weight, is the same as
for all other components (``epoch``). None is merged.
"""

from __future__ import annotations

import math

import numpy as np

from netpos.estimation.compile import kernel
from netpos.estimation.mixture.gaussians import Mixture, combine
from netpos.messages.values import Array

# No model is ever ruled out: its way back would take this many e-folds less.
_LEAST_WEIGHT = 1e-12


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
    keep_alive(weights)
    for j in range(count):
        combine(old_means, old_covs, share[j] / share[j].sum(), means[j], covs[j])


@kernel
def keep_alive(weights: Array) -> None:
    """Weights (K,) made to sum to one, none of them 0."""
    total = weights.sum()
    for k in range(weights.size):
        weights[k] = max(weights[k] / total, _LEAST_WEIGHT)
    weights /= weights.sum()


@kernel
def one_of_each(components: Mixture) -> Mixture:
    """Components of interacting models after an epoch: none is merged, and none dies. One that is
    no longer sound begins anew as the most probable one."""
    means, covs, log_weights = components
    best = int(np.argmax(log_weights))
    weights = np.exp(log_weights - log_weights[best])
    for k in range(weights.size):
        if log_weights[k] == -math.inf:
            means[k], covs[k] = means[best], covs[best]
    keep_alive(weights)
    return Mixture(means, covs, np.log(weights))
