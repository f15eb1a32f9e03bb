"""A posterior around its minima as a row of Gaussians: against sums on a polar grid."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from netpos.common.least_squares import minimiser
from netpos.estimation.factor import inverse, solve
from netpos.estimation.mixture.gaussians import Mixture
from netpos.estimation.mixture.ridge import Fit, Line, across, components_of, on_line
from netpos.messages.values import Array

Equations = Callable[[Array], tuple[float, Array, Array]]

ANCHORS = np.array([[1.3, 2.2], [-1.3, 2.2], [1.3, -2.2], [-1.3, -2.2]])
SD_M, PRIOR_M, SPEED_MPS = 0.2, 25.0, 1.5


class Density:
    """A posterior by its cost, gradient and normal matrix at a state."""

    def __init__(self, equations: Equations) -> None:
        self.equations = equations
        self._minimise = minimiser(self._on_line, solve)

    def _on_line(self, state: Array, line: Line | None) -> tuple[float, Array, Array]:
        cost, b, A = self.equations(state)
        if line is None:
            return cost, b, A
        u = np.append(line.direction, np.zeros(state.size - 2))
        off = float(line.direction @ (line.centre - state[:2])) / line.sd
        return cost + off**2, b + off / line.sd * u, A + np.outer(u, u) / line.sd**2

    def minimum(self, start: Array, line: Line | None = None) -> tuple[float, Array, Array]:
        return self._minimise(start, line)


def ranges(seed: int, anchors: Array = ANCHORS) -> tuple[Array, Array]:
    """Anchors (m, 2) and their ranges (m,) to a device within about 25 m."""
    rng = np.random.default_rng(seed)
    heard = anchors[np.arange(len(anchors) + 1) % len(anchors)]
    place = PRIOR_M * rng.standard_normal(2)
    return heard, np.hypot(*(place - heard).T) + SD_M * rng.standard_normal(len(heard))


def density_of(anchors: Array, measured: Array) -> Density:
    """Of [x, y, vx, vy], the velocity known by its prior only."""
    information = np.diag(np.array([PRIOR_M, PRIOR_M, SPEED_MPS, SPEED_MPS]) ** -2.0)

    def equations(state: Array) -> tuple[float, Array, Array]:
        d = state[:2] - anchors
        distance = np.hypot(*d.T)
        H = np.hstack([d / distance[:, None], np.zeros((len(d), 2))])
        error = measured - distance
        cost = state @ information @ state + error @ error / SD_M**2
        return cost, H.T @ error / SD_M**2 - information @ state, information + H.T @ H / SD_M**2

    return Density(equations)


def minima(density: Density, radius: float) -> list[Fit]:
    fits = []
    for angle in 0.1 + 2.0 * math.pi * np.arange(12) / 12:
        start = np.array([radius * math.cos(angle), radius * math.sin(angle), 0.0, 0.0])
        cost, state, A = density.minimum(start)
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


def posterior_of(
    density: Density,
    fits: list[Fit],
    is_possible: Callable[[Array], bool] = lambda _: True,
) -> Mixture:
    found = components_of(density, fits, [], is_possible)
    assert found is not None
    return found


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
    density = density_of(anchors, measured)
    found = posterior_of(density, minima(density, measured.mean()))
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
    density = density_of(anchors, measured)
    found = posterior_of(density, minima(density, 18.0))
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

    found = posterior_of(Density(equations), [(0.0, centre, np.linalg.inv(A))])
    np.testing.assert_allclose(found.means, [centre])
    np.testing.assert_allclose(found.covs, [np.linalg.inv(A)], rtol=1e-9)
    evidence = 0.5 * math.log(np.linalg.det(2.0 * math.pi * np.linalg.inv(A)))
    assert found.log_weights[0] == pytest.approx(evidence)


def test_what_is_impossible_is_left_out() -> None:
    anchors, measured = ranges(3)
    density = density_of(anchors, measured)
    fits = minima(density, measured.mean())
    side = float(fits[0][1][0])
    found = posterior_of(density, fits, lambda state: bool(state[0] > side - 1e-6))
    assert (found.means[:, 0] > side - 1e-6).all()


@pytest.mark.parametrize("sd_deg", [0.5, 2.0, 8.0])
@pytest.mark.parametrize("start_m", [2.0, 15.0, 100.0])
def test_a_ray_is_followed_from_anywhere_on_it(start_m: float, sd_deg: float) -> None:
    """One angle, of a device about 150 m from the array: the distance is of a Rayleigh
    distribution, and what is a metre from the array counts as much as what is 300 m away, for the
    area it has."""
    sd, reach = math.radians(sd_deg), 150.0

    def equations(state: Array) -> tuple[float, Array, Array]:
        x, y = state
        h = np.array([-y, x]) / (x * x + y * y)
        error = 0.4 - math.atan2(y, x)
        cost = state @ state / reach**2 + error**2 / sd**2
        return (
            cost,
            h * error / sd**2 - state / reach**2,
            np.outer(h, h) / sd**2 + np.eye(2) / reach**2,
        )

    towards = np.array([math.cos(0.4), math.sin(0.4)])
    density, start = Density(equations), start_m * towards
    fit = on_line(density, start, across(start, towards))
    found = components_of(density, [], [fit], lambda state: bool(np.hypot(*state) > 1.0))
    assert found is not None
    weights, mean, cov = moments(found)
    along = np.array([towards, [-towards[1], towards[0]]])
    kept = math.exp(-0.5 * sd**2)  # mean of the cosine of an angle
    distance = reach * math.sqrt(math.pi / 2.0)
    assert (np.hypot(*found.means.T) > 1.0).all()
    np.testing.assert_allclose(along @ mean, [kept * distance, 0.0], atol=0.02 * distance)
    square = reach**2 * np.array([1.0 + kept**4, 1.0 - kept**4]) - [(kept * distance) ** 2, 0.0]
    np.testing.assert_allclose(np.sqrt(np.diag(along @ cov @ along.T)), np.sqrt(square), rtol=0.1)
    near = np.hypot(*found.means.T) < 20.0
    assert weights[near].sum() == pytest.approx(-math.expm1(-0.5 * (20.0 / reach) ** 2), abs=0.01)


def test_nothing_that_is_possible_is_no_posterior() -> None:
    anchors, measured = ranges(3)
    density = density_of(anchors, measured)
    assert components_of(density, minima(density, 10.0), [], lambda _: False) is None
