"""Candidates: components before they are reduced, each an explanation of the measurements of an
epoch, weighed by its likelihood."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from netpos.estimation.compile import kernel
from netpos.estimation.engine import (
    FilterOptions,
    cov_of,
    cov_or_sqrt_of,
    is_sound,
    update_with_gate,
)
from netpos.estimation.measurement import GROUP
from netpos.estimation.mixture.gaussians import Mixture
from netpos.estimation.mixture.outliers import outlier_log
from netpos.estimation.sensors.row import group_end
from netpos.estimation.update import fusion
from netpos.estimation.update.fit import neg2_log_likelihood
from netpos.estimation.update.gate import accepted_rows
from netpos.estimation.update.predicted import PredictedRows, predict_rows
from netpos.messages.values import Array


class Update(NamedTuple):
    """What came of an epoch: the components; of the most probable one the NIS of the rows it
    accepted and their number; the probability of each group that it is an outlier (groups,); the
    probability that the device turned in the ``within_s`` seconds before the epoch; whether a
    component "it has turned" has begun."""

    components: Mixture
    nis: float
    used: int
    outliers: Array
    turned: float
    within_s: float
    begun: bool


class Candidates(NamedTuple):
    """Components before they are reduced: states, log weights, which groups (K, groups) each
    accepted, NIS of the accepted rows and their number, for how long the device may have been
    turning (K,), 0 for components without a turn, and the probability of a blocked path (K,)."""

    means: Array
    covs: Array
    log_weights: Array
    accepted: Array
    nis: Array
    used: Array
    within_s: Array
    blocked: Array


@kernel
def candidates(size: int, n: int, groups: int) -> Candidates:
    return Candidates(
        np.empty((size, n)),
        np.empty((size, n, n)),
        np.full(size, -np.inf),
        np.zeros((size, groups)),
        np.zeros(size),
        np.zeros(size),
        np.zeros(size),
        np.zeros(size),
    )


@kernel
def first_of(found: Candidates, end: int) -> Candidates:
    """The first ``end`` candidates."""
    return Candidates(
        found.means[:end],
        found.covs[:end],
        found.log_weights[:end],
        found.accepted[:end],
        found.nis[:end],
        found.used[:end],
        found.within_s[:end],
        found.blocked[:end],
    )


@kernel
def mixture_of(found: Candidates) -> Mixture:
    """The candidates as components."""
    return Mixture(found.means, found.covs, found.log_weights)


@kernel
def log_likelihood(
    mean: Array,
    cov: Array,
    rows: Array,
    height_m: float,
    predicted: PredictedRows,
    accepted: Array,
) -> float:
    """Log density of ``rows`` as mean (n,), cov (n, n) ``predicted`` them; what is not accepted is
    an outlier."""
    total, start = 0.0, 0
    kept = accepted_rows(rows, accepted)
    if kept.size > 0:
        distance, size = neg2_log_likelihood(mean, cov, rows, height_m, predicted, kept)
        total = -0.5 * (distance + size)
    while start < rows.shape[0]:
        stop = group_end(rows, start)
        if accepted[int(rows[start, GROUP])] == 0.0:
            total += outlier_log(rows, predicted, start, stop)
        start = stop
    return float(total)


@kernel
def apply(
    k: int, log_weight: float, rows: Array, options: FilterOptions, found: Candidates, work: Array
) -> None:
    """Gate and apply ``rows`` to the candidate ``k``, which holds its prediction, and weigh it by
    what this says of them. Nothing accepted leaves the prediction. ``work`` keeps the rows as the
    prediction sees them."""
    predict_rows(
        found.means[k],
        found.covs[k],
        rows,
        options.height_m,
        fusion.predicted_in(work, found.means.shape[1], rows.shape[0]),
    )
    apply_predicted(k, log_weight, rows, options, options.gate_nis, found, work)


@kernel
def apply_predicted(
    k: int,
    log_weight: float,
    rows: Array,
    options: FilterOptions,
    gate_nis: Array,
    found: Candidates,
    work: Array,
) -> None:
    """As ``apply``, with rows that are predicted in ``work`` already, and a gate of their own."""
    mean, cov, accepted = found.means[k], found.covs[k], found.accepted[k]
    prior_mean, prior_cov, height_m = mean.copy(), cov.copy(), options.height_m
    cov_or_sqrt = cov_or_sqrt_of(cov, options)
    nis, used = update_with_gate(mean, cov_or_sqrt, rows, options, gate_nis, accepted, work)
    if used > 0:
        cov[:] = cov_of(cov_or_sqrt, options)
    else:
        mean[:] = prior_mean
    found.nis[k], found.used[k], found.within_s[k] = nis, used, 0.0
    predicted = fusion.predicted_in(work, mean.size, rows.shape[0])
    likelihood = log_likelihood(prior_mean, prior_cov, rows, height_m, predicted, accepted)
    sound = math.isfinite(likelihood) and nis >= 0.0 and is_sound(mean, cov)
    found.log_weights[k] = log_weight + likelihood if sound else -math.inf


@kernel
def add_gated(
    limit: float,
    parent: int,
    end: int,
    prior: Mixture,
    rows: Array,
    options: FilterOptions,
    found: Candidates,
    work: Array,
) -> int:
    """Add the component ``parent`` of ``prior`` with the same ``limit`` for every group of
    ``rows``: all are accepted (inf), from the tail of their errors, or all are wrong (-1); the
    number of candidates then. ``work`` holds the rows as ``parent`` predicts them."""
    found.means[end], found.covs[end] = prior.means[parent], prior.covs[parent]
    gate, log_weight = np.full_like(options.gate_nis, limit), prior.log_weights[parent]
    apply_predicted(end, log_weight, rows, options, gate, found, work)
    return end + 1
