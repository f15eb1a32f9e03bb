"""The factor of an unknown noise scale against a hidden Markov model written in probabilities, and
simulated filters."""

from __future__ import annotations

import math

import numpy as np
import pytest
from netpos.estimation.chi_square import chi_square_bound
from netpos.estimation.noise_scale import SCALES2, NoiseScale
from netpos.messages.values import Array
from scipy import optimize, stats

RISK = 1e-4
GATE = {rows: float(stats.chi2.isf(1e-4, rows)) for rows in (1, 2, 3)}
Epoch = tuple[float, int, list[int]]


def expected_weights(epochs: list[Epoch]) -> Array:
    """Forward probabilities by a matrix of transitions, in plain probabilities."""
    size = SCALES2.size
    moves = np.full((size, size), 0.0)
    moves[0, 0], moves[0, 1:] = 1.0 - 1e-3, 1e-3 / (size - 1)
    for j in range(1, size):
        moves[j, j], moves[j, 0] = 1.0 - 1.0 / 50.0, 1.0 / 50.0
    weights = np.eye(size)[0]
    for nis, dof, refused in epochs:
        if dof == 0 and not refused:
            continue
        weights = weights @ moves
        weights *= SCALES2 ** (-dof / 2.0) * np.exp(-nis / (2.0 * SCALES2))
        for rows in refused:
            weights *= stats.chi2.sf(GATE[rows] / SCALES2, rows)
        weights /= weights.sum()
    return weights


def expected_factor(weights: Array) -> float:
    """Of a circular error whose scale is unknown, by SciPy's root finder."""
    u = -math.log(RISK)

    def excess(factor: float) -> float:
        tails = [w * math.exp(-u * factor**2 / s) for w, s in zip(weights, SCALES2, strict=True)]
        return math.log(math.fsum(tails)) - math.log(RISK)

    return float(optimize.brentq(excess, 1.0, 12.0, xtol=1e-13)) if excess(1.0) > 0.0 else 1.0


def epochs_of(rng: np.random.Generator, count: int) -> list[Epoch]:
    """Epochs of different size, some refused in part, some as a whole, some without rows."""
    epochs: list[Epoch] = []
    for _ in range(count):
        dof = int(rng.integers(0, 7))
        refused = [int(rows) for rows in rng.integers(1, 4, size=rng.integers(0, 3))]
        nis = float(rng.chisquare(dof) * rng.uniform(0.5, 3.0)) if dof else 0.0
        epochs.append((nis, dof, refused if rng.random() < 0.1 else []))
    return epochs


def taken(epochs: list[Epoch]) -> NoiseScale:
    scale = NoiseScale()
    for nis, dof, refused in epochs:
        scale.add(nis, dof, [(rows, GATE[rows]) for rows in refused])
    return scale


@pytest.mark.parametrize("seed", range(5))
def test_weights_and_factor_are_those_of_a_hidden_markov_model(seed: int) -> None:
    epochs = epochs_of(np.random.default_rng(seed), 60)
    for k in (1, 5, 60):
        scale, expected = taken(epochs[:k]), expected_weights(epochs[:k])
        np.testing.assert_allclose(scale.weights, expected, rtol=1e-9, atol=1e-15)
        assert scale.inflation(RISK) == pytest.approx(expected_factor(expected), rel=1e-9)


def test_a_run_is_its_epochs_one_by_one() -> None:
    """A run has groups of one size in an epoch."""
    rng = np.random.default_rng(3)
    dof = rng.integers(0, 4, size=200) * 2
    nis = np.where(dof > 0, rng.chisquare(np.maximum(dof, 1)) * rng.uniform(0.5, 2.2, 200), 0.0)
    number = np.where(rng.random(200) < 0.05, rng.integers(1, 3, size=200), 0)
    rows = rng.integers(1, 4, size=200)
    refused = np.column_stack([number, rows, [GATE[size] for size in rows.tolist()]])
    scale, expected = NoiseScale(), []
    for k in range(200):
        scale.add(float(nis[k]), int(dof[k]), [(int(rows[k]), refused[k, 2])] * int(number[k]))
        expected.append(scale.inflation(RISK))
    np.testing.assert_allclose(NoiseScale.of_run(nis, dof, refused, RISK), expected, rtol=1e-12)


def test_one_bad_epoch_counts_at_once_and_is_forgotten() -> None:
    """What one epoch in a hundred exceeds widens the level by a half and more; after ten good
    epochs by less than a tenth."""
    scale = taken([(3.0, 3, [])] * 30)
    assert scale.inflation(RISK) < 1.1
    scale.add(float(stats.chi2.isf(0.01, 3)), 3)
    assert 1.5 < scale.inflation(RISK) < 4.0
    for _ in range(10):
        scale.add(3.0, 3)
    assert scale.inflation(RISK) < 1.1


def test_refused_groups_tell_of_a_scale_that_the_accepted_hide() -> None:
    """Errors five times as large as stated: the gate lets the small ones pass, which look good."""
    rng = np.random.default_rng(8)
    scale, accepted_only, factors = NoiseScale(), NoiseScale(), []
    for _ in range(200):
        z2 = (5.0 * rng.standard_normal(4)) ** 2
        passed = z2 <= GATE[1]
        nis, dof = float(z2[passed].sum()), int(passed.sum())
        scale.add(nis, dof, [(1, GATE[1])] * (4 - dof))
        accepted_only.add(nis, dof)
        factors.append((scale.inflation(RISK), accepted_only.inflation(RISK)))
    with_refused, without = np.median(factors[50:], axis=0)
    assert 4.5 < with_refused < 8.0
    assert without < 3.0


@pytest.mark.parametrize(("dof", "most"), [(2, 1.25), (3, 1.12), (4, 1.08), (6, 1.05)])
def test_a_filter_that_is_right_pays_little(dof: int, most: float) -> None:
    rng, scale, factors = np.random.default_rng(12), NoiseScale(), []
    for nis in rng.chisquare(dof, size=5000):
        scale.add(float(nis), dof)
        factors.append(scale.inflation(RISK))
    assert 1.0 < np.mean(factors) < most


def test_errors_of_unknown_scale_leave_the_widened_radius_as_often_as_promised() -> None:
    """Drawn from the chain itself: errors and NIS have the scale of their epoch. A level that
    knows nothing of scales is left more than twice as often as promised."""
    rng, risk, epochs = np.random.default_rng(4), 1e-2, 60_000
    scale, j = NoiseScale(), 0
    left = plain = 0
    radius = math.sqrt(-2.0 * math.log(risk))
    for _ in range(epochs):
        if j == 0 and rng.random() < 1e-3:
            j = int(rng.integers(1, SCALES2.size))
        elif j > 0 and rng.random() < 1.0 / 50.0:
            j = 0
        sd = math.sqrt(SCALES2[j])
        scale.add(float(SCALES2[j] * rng.chisquare(3)), 3)
        error = sd * float(np.hypot(*rng.standard_normal(2)))
        left += error > scale.inflation(risk) * radius
        plain += error > radius
    assert plain > 2.0 * risk * epochs
    assert 0.7 * risk * epochs < left < 1.3 * risk * epochs


def test_the_first_epoch_of_a_fault_is_covered_nine_times_of_ten() -> None:
    """Risk 1e-4 where a fault begins once in a thousand epochs; a level of the stated variances
    alone covers about half of them."""
    rng, radius, before = np.random.default_rng(6), math.sqrt(-2.0 * math.log(RISK)), 30
    left = plain = 0
    for _ in range(2000):
        scale = NoiseScale()
        for nis in rng.chisquare(3, size=before):
            scale.add(float(nis), 3)
        scale2 = float(rng.choice(SCALES2[1:]))
        scale.add(scale2 * float(rng.chisquare(3)), 3)
        error = math.sqrt(scale2) * float(np.hypot(*rng.standard_normal(2)))
        left += error > scale.inflation(RISK) * radius
        plain += error > radius
    assert left < 0.1 * 2000 < 0.25 * 2000 < plain


@pytest.mark.parametrize("seed", range(4))
def test_an_error_along_a_line_leaves_the_widened_radius_hardly_more_often(seed: int) -> None:
    rng = np.random.default_rng(seed)
    radius = float(stats.norm.isf(RISK / 2.0))
    for _ in range(200):
        scale = NoiseScale()
        scale.weights = rng.dirichlet(np.full(SCALES2.size, 0.05)) + 1e-12
        scale.weights /= scale.weights.sum()
        beyond = 2.0 * stats.norm.sf(scale.inflation(RISK) * radius / np.sqrt(SCALES2))
        assert scale.weights @ beyond < 1.1 * RISK


def test_an_epoch_without_measurements_says_nothing_and_a_copy_is_independent() -> None:
    scale = taken([(40.0, 4, [])] * 3)
    factor = scale.inflation(RISK)
    scale.add(0.0, 0)
    assert scale.inflation(RISK) == factor > 2.0
    copy = scale.copy()
    for _ in range(30):
        scale.add(4.0, 4)
    assert scale.inflation(RISK) < 1.1
    assert copy.inflation(RISK) == factor
    assert NoiseScale().inflation(RISK) == 1.0


def test_nothing_overflows() -> None:
    """Where no scale fits, and where everything is refused for long."""
    for nis, dof, refused in ((1e300, 2, 0), (0.0, 64, 0), (0.0, 0, 64), (0.0, 0, 1)):
        scale = NoiseScale()
        for _ in range(1000):
            scale.add(nis, dof, [(2, chi_square_bound(2, 1e-4))] * refused)
        assert scale.weights.sum() == pytest.approx(1.0)
        assert 1.0 <= scale.inflation(1e-12) <= math.sqrt(SCALES2[-1])
