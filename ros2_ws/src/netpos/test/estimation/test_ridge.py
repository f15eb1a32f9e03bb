"""A posterior around its minima as a row of Gaussians: against sums on a polar grid."""

from __future__ import annotations

import math

import numpy as np
import pytest
from netpos.common.least_squares import minimise
from netpos.estimation.mixture.gaussians import Mixture
from netpos.estimation.mixture.ridge import Equations, Fit, components_of, inverse
from netpos.messages.values import Array

ANCHORS = np.array([[1.3, 2.2], [-1.3, 2.2], [1.3, -2.2], [-1.3, -2.2]])
SD_M, PRIOR_M, SPEED_MPS = 0.2, 25.0, 1.5


def ranges(seed: int, anchors: Array = ANCHORS) -> tuple[Array, Array]:
    """Anchors (m, 2) and their ranges (m,) to a device within about 25 m."""
    rng = np.random.default_rng(seed)
    heard = anchors[np.arange(len(anchors) + 1) % len(anchors)]
    place = PRIOR_M * rng.standard_normal(2)
    return heard, np.hypot(*(place - heard).T) + SD_M * rng.standard_normal(len(heard))


def equations_of(anchors: Array, measured: Array) -> Equations:
    """Of [x, y, vx, vy], the velocity known by its prior only."""
    information = np.diag(np.array([PRIOR_M, PRIOR_M, SPEED_MPS, SPEED_MPS]) ** -2.0)

    def equations(state: Array) -> tuple[float, Array, Array]:
        d = state[:2] - anchors
        distance = np.hypot(*d.T)
        H = np.hstack([d / distance[:, None], np.zeros((len(d), 2))])
        error = measured - distance
        cost = state @ information @ state + error @ error / SD_M**2
        return cost, H.T @ error / SD_M**2 - information @ state, information + H.T @ H / SD_M**2

    return equations


def minima(equations: Equations, radius: float) -> list[Fit]:
    fits = []
    for angle in 0.1 + 2.0 * math.pi * np.arange(12) / 12:
        start = np.array([radius * math.cos(angle), radius * math.sin(angle), 0.0, 0.0])
        cost, state, A = minimise(equations, start, lambda A, b: inverse(A) @ b)
        fits.append((cost, state, inverse(A)))
    return sorted(fits, key=lambda fit: fit[0])


def on_grid(anchors: Array, measured: Array) -> tuple[Array, Array, float]:
    """Mean and covariance of the position, and the share of it with y > 0."""
    radii = np.linspace(0.05, measured.max() + 6.0, 1500)
    angles = np.linspace(-math.pi, math.pi, 2000, endpoint=False)
    r, angle = np.meshgrid(radii, angles, indexing="ij")
    xy = np.array([r * np.cos(angle), r * np.sin(angle)])
    cost = (xy**2).sum(axis=0) / PRIOR_M**2
    for anchor, value in zip(anchors, measured, strict=True):
        cost += ((np.hypot(*(xy - anchor[:, None, None])) - value) / SD_M) ** 2
    weight = np.exp(-0.5 * (cost - cost.min())) * r
    weight /= weight.sum()
    mean = np.einsum("ij,kij->k", weight, xy)
    away = xy - mean[:, None, None]
    cov = np.einsum("ij,kij,lij->kl", weight, away, away)
    return mean, cov, float(weight[xy[1] > 0.0].sum())


def moments(mixture: Mixture) -> tuple[Array, Array, Array]:
    """Weights, mean and covariance of the position, by NumPy."""
    weights = np.exp(mixture.log_weights - mixture.log_weights.max())
    weights /= weights.sum()
    mean = weights @ mixture.means[:, :2]
    away = mixture.means[:, :2] - mean
    cov = np.einsum("k,kij->ij", weights, mixture.covs[:, :2, :2])
    return weights, mean, cov + np.einsum("k,ki,kj->ij", weights, away, away)


@pytest.mark.parametrize("seed", [1, 3, 5, 6, 8])
def test_a_thin_arc_is_a_row_of_gaussians(seed: int) -> None:
    """The figures for one Gaussian at the minimum are 0.3 to 0.4 sd."""
    anchors, measured = ranges(seed)
    equations = equations_of(anchors, measured)
    found = components_of(equations, minima(equations, measured.mean()), lambda _: True)
    weights, mean, cov = moments(found)
    expected, expected_cov, _ = on_grid(anchors, measured)
    away = mean - expected
    assert len(weights) > 5
    assert math.sqrt(away @ np.linalg.solve(expected_cov, away) / 2.0) < 0.1
    assert np.trace(cov) == pytest.approx(np.trace(expected_cov), rel=0.05)
    assert np.linalg.det(cov) == pytest.approx(np.linalg.det(expected_cov), rel=0.05)


def test_two_places_have_the_weights_of_their_evidence() -> None:
    """Two anchors 30 m apart on a line that is off the centre of the prior: one of the two mirror
    images lies nearer to it."""
    anchors = np.array([[-15.0, 4.0], [15.0, 4.0]])
    measured = np.hypot(*(np.array([3.0, -14.0]) - anchors).T)
    equations = equations_of(anchors, measured)
    found = components_of(equations, minima(equations, 18.0), lambda _: True)
    weights, _, _ = moments(found)
    _, _, above = on_grid(anchors, measured)
    assert 0.2 < above < 0.5
    assert weights[found.means[:, 1] > 0.0].sum() == pytest.approx(above, abs=0.01)


def test_a_straight_posterior_is_its_one_gaussian() -> None:
    """Linear measurements: mean and covariance are those of the normal equations."""
    A = np.diag([4.0, 0.5, 1.0, 1.0])
    A[0, 1] = A[1, 0] = 0.9
    centre = np.array([3.0, -2.0, 0.0, 1.0])

    def equations(state: Array) -> tuple[float, Array, Array]:
        off = centre - state
        return float(off @ A @ off), A @ off, A

    found = components_of(equations, [(0.0, centre, np.linalg.inv(A))], lambda _: True)
    np.testing.assert_allclose(found.means, [centre])
    np.testing.assert_allclose(found.covs, [np.linalg.inv(A)], rtol=1e-9)
    evidence = 0.5 * math.log(np.linalg.det(2.0 * math.pi * np.linalg.inv(A)))
    assert found.log_weights[0] == pytest.approx(evidence)


def test_what_is_impossible_is_left_out() -> None:
    anchors, measured = ranges(3)
    equations = equations_of(anchors, measured)
    fits = minima(equations, measured.mean())
    side = float(fits[0][1][0])
    found = components_of(equations, fits, lambda state: bool(state[0] > side - 1e-6))
    assert (found.means[:, 0] > side - 1e-6).all()
