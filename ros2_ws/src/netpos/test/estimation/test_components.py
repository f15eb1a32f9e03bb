"""The Gaussian mixture against densities on a grid, the plain filter and its own moments."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from filter_rows import make_cov, row
from netpos.estimation.engine import EpochInput
from netpos.estimation.forms import ekf
from netpos.estimation.measurement import GROUP, SAME_BEND, VARIANCE, Kind
from netpos.estimation.mixture import epoch as epochs
from netpos.estimation.mixture.candidates import candidates
from netpos.estimation.mixture.gaussians import (
    Mixture,
    fuse_value,
    leaders,
    log_densities,
    mode_of,
    moments,
    one_component,
)
from netpos.estimation.mixture.reduction import PART_MERGE_COST, reduced
from netpos.estimation.mixture.splits import paths
from netpos.estimation.mixture.splits.ring import cut_along_ring, divides
from netpos.estimation.motion import NO_BIAS
from netpos.estimation.rows import linear_rows
from netpos.estimation.update.predicted import predicted_rows
from netpos.messages.values import Array
from netpos.tracking import TrackerConfig
from netpos.tracking.estimators.estimates import Estimate
from netpos.tracking.estimators.models import dynamics_of, options_of
from scipy.stats import exponnorm, multivariate_normal, norm

OPTIONS = options_of(TrackerConfig(filter="ekf"))
ANCHORS = np.array([[2.6, 0.0, 1.0], [0.0, 2.6, 1.0], [-2.6, 0.0, 1.0], [0.0, -2.6, 1.0]])


def prior(
    mean: tuple[float, float], sd: tuple[float, float], rho: float = 0.0
) -> tuple[Array, Array]:
    """Position and velocity that hang together by ``rho``; a clock that nobody sees."""
    x = np.array([*mean, 0.3, -0.2, 0.0, 0.0])
    P = np.diag([sd[0] ** 2, sd[1] ** 2, 1.0, 1.0, 1.0, 1.0])
    for a in (0, 1):
        P[a, a + 2] = P[a + 2, a] = rho * sd[a]
    return x, P


def after(parts: Mixture, *rows: Array) -> tuple[Mixture, int]:
    """The mixture after one epoch, and the number of rows taken."""
    epoch = EpochInput(0.0, 0.0, 0.0, 0, np.array(rows))
    found = epochs.apply_epoch(parts, epoch, OPTIONS, np.zeros(len(rows)))
    return found.components, found.used


def along_ring(x: Array, P: Array, measured: Array) -> Mixture:
    """The prior, cut along the ring of the row ``measured``, with that fused."""
    pieces = cut_along_ring(x, P, measured, 0.0)
    means, covs, logs = (part.copy() for part in pieces.components)
    for k, (h, innovation) in enumerate(zip(pieces.H, pieces.innovation, strict=True)):
        logs[k] += fuse_value(means[k], covs[k], h, innovation, measured[VARIANCE])
    return Mixture(means, covs, logs)


def on_grid(
    x: Array, P: Array, rows: list[Array], reach_m: float, step_m: float
) -> tuple[float, Array, Array]:
    """Evidence, mean and covariance of the position by summing prior times likelihoods."""
    axis = np.arange(-reach_m, reach_m, step_m)
    grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    away = grid - x[:2]
    log = -0.5 * np.einsum("ni,ij,nj->n", away, np.linalg.inv(P[:2, :2]), away)
    log -= np.log(2 * np.pi) + 0.5 * np.log(np.linalg.det(P[:2, :2]))
    for r in rows:
        d = np.linalg.norm(np.column_stack([grid, np.zeros(len(grid))]) - r[7:10], axis=1)
        log -= 0.5 * ((r[1] - d) ** 2 / r[2] + np.log(2 * np.pi * r[2]))
    weight = np.exp(log)
    total = weight.sum()
    mean = weight @ grid / total
    centred = grid - mean
    return float(total * step_m**2), mean, (centred * weight[:, None]).T @ centred / total


@pytest.mark.parametrize("centre", [(0.0, 0.0), (12.0, 3.0), (35.0, -10.0)])
@pytest.mark.parametrize("sd", [(12.0, 12.0), (20.0, 4.0)])
def test_a_ring_is_the_product_of_prior_and_range(
    centre: tuple[float, float], sd: tuple[float, float]
) -> None:
    """Evidence and moments of the position, also where the prior lies on the RSU."""
    x, P = prior(centre, sd)
    measured = row(Kind.RANGE, 15.0, 0.3**2)
    parts = along_ring(x, P, measured)
    evidence, mean, cov = on_grid(x, P, [measured], 30.0, 0.1)
    assert np.exp(parts[2]).sum() == pytest.approx(evidence, rel=0.03)
    parts = Mixture(parts[0], parts[1], parts[2] - np.log(np.exp(parts[2]).sum()))
    found, found_cov = moments(parts)
    scale = np.sqrt(np.trace(cov))
    np.testing.assert_allclose(found[:2], mean, atol=0.03 * scale)
    np.testing.assert_allclose(found_cov[:2, :2], cov, atol=0.05 * scale**2)


@pytest.mark.parametrize("measured_m", [0.0, 1e-9, -3.0])
def test_a_ring_without_a_radius_is_finite(measured_m: float) -> None:
    """A range of nothing, and one that biases would have to make longer."""
    x, P = prior((5.0, 0.0), (8.0, 8.0))
    for part in along_ring(x, P, row(Kind.RANGE, measured_m, 0.2**2)):
        assert np.isfinite(part).all()


def test_the_other_states_follow_the_position() -> None:
    """A velocity that hangs together with the position is told by it, component by component."""
    x, P = prior((14.0, 0.0), (6.0, 6.0), rho=0.8)
    means, covs, logs = along_ring(x, P, row(Kind.RANGE, 15.0, 0.3**2))
    gain = P[2:4, :2] @ np.linalg.inv(P[:2, :2])
    np.testing.assert_allclose(means[:, 2:4] - x[2:4], (means[:, :2] - x[:2]) @ gain.T, atol=1e-9)
    rest = P[2:4, 2:4] - gain @ P[:2, 2:4]
    expected = rest + gain @ covs[:, :2, :2] @ gain.T
    np.testing.assert_allclose(covs[:, 2:4, 2:4], expected, atol=1e-9)
    assert np.isfinite(logs).all()


@pytest.mark.parametrize("seed", range(3))
def test_ranges_of_four_near_anchors_after_silence(seed: int) -> None:
    """A device 25 m from anchors that are 5 m apart, known to 20 m: the posterior of eight
    asynchronous ranges against the grid."""
    rng = np.random.default_rng(seed)
    truth = rng.uniform(-20.0, 20.0, 2)
    x, P = prior(tuple(truth + 8.0 * rng.normal(size=2)), (20.0, 20.0))
    rows = []
    for k in range(8):
        anchor = ANCHORS[k % 4] * (1.0, 1.0, 0.0)
        value = np.linalg.norm(np.append(truth, 0.0) - anchor) + 0.2 * rng.normal()
        rows.append(row(Kind.RANGE, value, 0.2**2, origin=anchor))
    parts = one_component(x, P)
    for r in rows:
        parts, used = after(parts, r)
        assert used == 1
    _, mean, cov = on_grid(x, P, rows, 60.0, 0.1)
    found, found_cov = moments(parts)
    assert np.linalg.norm(found[:2] - mean) < 0.15 * np.sqrt(np.trace(cov))
    assert np.trace(found_cov[:2, :2]) == pytest.approx(np.trace(cov), rel=0.15)
    assert not mode_of(parts).any()


def test_two_anchors_leave_two_modes_of_equal_weight() -> None:
    x, P = prior((0.0, 0.0), (25.0, 25.0))
    truth = np.array([4.0, 18.0])
    parts = one_component(x, P)
    for anchor in np.tile([[2.5, 0.0, 0.0], [-2.5, 0.0, 0.0]], (4, 1)):
        value = np.linalg.norm(np.append(truth, 0.0) - anchor)
        r = row(Kind.RANGE, value, 0.2**2, origin=anchor)
        parts, _ = after(parts, r)
    mode, weights = mode_of(parts), np.exp(parts[2])
    assert set(mode.tolist()) == {0, 1}
    np.testing.assert_allclose(np.bincount(mode, weights), 0.5, atol=0.05)
    for side in (0, 1):
        place = np.average(parts[0][mode == side, :2], axis=0, weights=weights[mode == side])
        np.testing.assert_allclose(np.abs(place), np.abs(truth), atol=2.0)


def test_one_narrow_component_is_the_extended_filter() -> None:
    rng = np.random.default_rng(2)
    x, P = np.array([3.0, 4.0, 1.0, 0.0, 0.0, 0.0]), make_cov(rng, 6, 0.01)
    rows = np.vstack(
        [
            row(Kind.RANGE, 5.1, 0.04, 0),
            row(Kind.AZIMUTH, 0.95, 1e-4, 1),
            row(Kind.SPEED, 1.1, 0.01, 2),
        ]
    )
    accepted = np.zeros(3)
    epoch = EpochInput(0.0, 0.0, 0.0, 0, rows)
    found = epochs.apply_epoch(one_component(x, P), epoch, OPTIONS, accepted)
    means, covs, logs = found.components
    assert (logs.tolist(), found.used, accepted.tolist()) == ([0.0], 3, [1.0, 1.0, 1.0])
    expected, expected_cov, work = x.copy(), P.copy(), ekf.workspace(6, 3)
    nis, _ = ekf.update(expected, expected_cov, rows, 0.0, OPTIONS.gate_nis, 1, np.zeros(3), work)
    np.testing.assert_allclose(means[0], expected, atol=1e-12)
    np.testing.assert_allclose(covs[0], expected_cov, atol=1e-12)
    assert found.nis == pytest.approx(nis)


def test_merging_keeps_the_moments_and_what_is_alike_becomes_one() -> None:
    rng = np.random.default_rng(4)
    means = rng.normal(0.0, 0.01, (6, 6)) + np.repeat([[0.0] * 6, [50.0] * 6], 3, axis=0)
    covs = np.array([make_cov(rng, 6, 4.0)] * 6)
    logs = np.log(np.full(6, 1.0 / 6.0)) + 3.0  # not normalised
    parts = reduced(Mixture(means, covs, logs), PART_MERGE_COST)
    assert parts[2].size == 2
    np.testing.assert_allclose(np.exp(parts[2]).sum(), 1.0)
    for ours, expected in zip(
        moments(parts), moments(Mixture(means, covs, logs - 3.0)), strict=True
    ):
        np.testing.assert_allclose(ours, expected, rtol=1e-10, atol=1e-10)


def test_components_without_weight_go_and_never_too_many_stay() -> None:
    rng = np.random.default_rng(5)
    means = np.column_stack([100.0 * np.arange(100.0), *rng.normal(size=(5, 100))])
    covs, logs = np.tile(np.eye(6), (100, 1, 1)), np.zeros(100)
    logs[7] = -30.0
    kept, _, weights = reduced(Mixture(means, covs, logs), PART_MERGE_COST)
    assert weights.size == 64
    assert not (np.abs(kept[:, 0] - 700.0) < 1.0).any()


def crowd(rng: np.random.Generator, count: int) -> Mixture:
    """Components round a ring of 5 m."""
    angle = rng.uniform(0.0, 2.0 * np.pi, count)
    means = np.column_stack(
        [5.0 * np.cos(angle), 5.0 * np.sin(angle), *rng.normal(0.0, 0.3, (4, count))]
    )
    covs = np.array([0.2 * make_cov(rng, 6, 1.0) for _ in range(count)])
    return Mixture(means, covs, rng.normal(0.0, 1.0, count))


def merged_step_by_step(parts: Mixture, cost: float) -> list[tuple[float, Array]]:
    """Weights and means after Runnalls' algorithm as he writes it: all pairs, each time."""
    weights = np.exp(parts.log_weights)
    left = list(zip(weights / weights.sum(), parts.means, parts.covs, strict=True))

    def together(a: Any, b: Any) -> Any:
        w = a[0] + b[0]
        u, v, d = a[0] / w, b[0] / w, a[1] - b[1]
        return w, u * a[1] + v * b[1], u * a[2] + v * b[2] + u * v * np.outer(d, d)

    def log_det(P: Array) -> float:
        return float(np.linalg.slogdet(P[:4, :4])[1])

    while True:
        costs = {}
        for i, j in itertools.combinations(range(len(left)), 2):
            w, _, P = together(left[i], left[j])
            parts_of = left[i][0] * log_det(left[i][2]) + left[j][0] * log_det(left[j][2])
            costs[i, j] = 0.5 * (w * log_det(P) - parts_of)
        i, j = min(costs, key=lambda pair: costs[pair])
        if costs[i, j] > cost:
            return [(w, mean) for w, mean, _ in left]
        left[i] = together(left[i], left[j])
        del left[j]


def test_the_pair_that_costs_least_is_merged_first() -> None:
    parts = crowd(np.random.default_rng(8), 25)
    parts.covs[:, :2, :2] *= 4.0
    assert not mode_of(parts).any()
    expected = merged_step_by_step(parts, 0.05)
    means, _, logs = reduced(parts, 0.05)
    assert 3 < len(expected) == logs.size < 20
    np.testing.assert_allclose(np.exp(logs), [w for w, _ in expected], rtol=1e-9)
    np.testing.assert_allclose(means, [mean for _, mean in expected], rtol=1e-9)


@pytest.mark.parametrize("count", [25, 80])
def test_of_two_places_none_is_described_more_coarsely(count: int) -> None:
    """The same components at two places 1 km apart, with weights of 0.99 and 0.01."""
    one = crowd(np.random.default_rng(8), count)
    other = one.means + np.array([1000.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    means, covs = np.concatenate([one.means, other]), np.concatenate([one.covs, one.covs])
    logs = np.concatenate([one.log_weights + np.log(0.99), one.log_weights + np.log(0.01)])
    found, _, log_weights = reduced(Mixture(means, covs, logs), 0.05)
    here, weights = found[:, 0] < 500.0, np.exp(log_weights)
    assert 3 < here.sum() == (~here).sum() <= 32
    np.testing.assert_allclose(found[~here, 0] - found[here, 0], 1000.0, atol=1e-6)
    np.testing.assert_allclose(found[~here, 1:], found[here, 1:], atol=1e-6)
    np.testing.assert_allclose(weights[~here] * 99.0, weights[here], rtol=1e-9)


def test_very_many_are_merged_in_parts_and_keep_their_moments() -> None:
    parts = crowd(np.random.default_rng(9), 1500)
    few = reduced(parts, 1e-5)
    assert few.log_weights.size <= 64
    weights = np.exp(parts.log_weights)
    normal = Mixture(parts.means, parts.covs, np.log(weights / weights.sum()))
    for ours, expected in zip(moments(few), moments(normal), strict=True):
        np.testing.assert_allclose(ours, expected, rtol=1e-9, atol=1e-9)


def test_an_outlier_leaves_the_wide_prior_as_it_was_with_its_weight() -> None:
    """A first range that is 40 m wrong: the ranges of the other anchors find the device."""
    x, P = prior((5.0, 12.0), (15.0, 15.0))
    truth = np.array([3.0, 16.0])
    parts = one_component(x, P)
    for k in range(12):
        anchor = ANCHORS[k % 4] * (1.0, 1.0, 0.0)
        value = np.linalg.norm(np.append(truth, 0.0) - anchor) + (40.0 if k == 0 else 0.0)
        r = row(Kind.RANGE, value, 0.2**2, origin=anchor)
        parts, _ = after(parts, r)
    found, cov = moments(parts)
    assert np.linalg.norm(found[:2] - truth) < 3.0 * np.sqrt(np.trace(cov[:2, :2]))
    assert np.trace(cov[:2, :2]) < 4.0


@pytest.mark.parametrize(
    ("distance", "sd", "wide"),
    [
        # range sd 0.2 m at 30 m: 0.5 (sd^2 / 30)^2 = 0.04 / 20 at sd = 1.377 m
        (30.0, 1.37, False),
        (30.0, 1.38, True),
        (30.0, 0.5, False),
        (1.0, 0.7, False),  # narrow, however it bends
    ],
)
@pytest.mark.parametrize("blocked", [0.0, 0.1])
def test_a_component_is_wide_where_the_tangent_costs_a_share_of_the_noise(
    blocked: float, distance: float, sd: float, wide: bool
) -> None:
    options = options_of(TrackerConfig(filter="ekf", nlos_probability=blocked))
    x, P = prior((distance, 0.0), (0.1, sd))
    alone = row(Kind.RANGE, distance, 0.04)[None]
    assert divides(alone, x, P, options) is wide
    assert not divides(row(Kind.AZIMUTH, 0.0, 0.04)[None], x, P, options)
    assert not divides(np.vstack([alone, alone]), x, P, options)


def test_modes_are_chains_of_components_without_a_valley() -> None:
    means = np.zeros((5, 6))
    means[:, 0] = 0.0, 3.0, 6.0, 9.0, 40.0
    covs = np.tile(np.eye(6), (5, 1, 1))
    parts = Mixture(means, covs, np.log([0.1, 0.05, 0.15, 0.1, 0.6]))
    assert mode_of(parts).tolist() == [1, 1, 1, 1, 0]
    assert leaders(parts).tolist() == [4, 2]


@pytest.mark.parametrize(("weight", "modes"), [(1e-2, 1), (1e-3, 2)])
def test_a_row_of_components_joins_two_places_where_it_is_probable(
    weight: float, modes: int
) -> None:
    """Between two components of one half each: exp(-4.5) of that is 0.0056."""
    means = np.zeros((7, 6))
    means[:, 0] = 0.0, 3.0, 6.0, 9.0, 12.0, 15.0, 18.0
    covs = np.tile(np.eye(6), (7, 1, 1))
    weights = np.full(7, weight)
    weights[[0, -1]] = 0.5
    found = mode_of(Mixture(means, covs, np.log(weights / weights.sum())))
    assert found.max() + 1 == modes
    assert (found[0] == found[-1]) == (modes == 1)


def test_densities_are_those_of_scipy() -> None:
    rng = np.random.default_rng(11)
    parts, at = crowd(rng, 30), rng.normal(0.0, 4.0, (20, 2))
    weights = np.exp(parts.log_weights)
    expected = sum(
        w * multivariate_normal(m[:2], P[:2, :2]).pdf(at)
        for w, m, P in zip(weights, parts.means, parts.covs, strict=True)
    )
    found = log_densities(parts, at) - np.log(2.0 * np.pi)
    np.testing.assert_allclose(np.exp(found), expected, rtol=1e-9)


# a measurement that the gate refuses

TURNING = options_of(TrackerConfig(filter="ekf", manoeuvre_speed_sd_mps=5.0))
H = np.eye(2, 6)
R = np.diag([0.04, 0.09])


def updated(z: Array, mean: Array, cov: Array) -> tuple[float, Array, Array]:
    """Log likelihood of a fix and the Kalman filter's answer."""
    S = H @ cov @ H.T + R
    K = np.linalg.solve(S, H @ cov).T
    density = multivariate_normal(H @ mean, S).logpdf(z)
    return float(density), mean + K @ (z - H @ mean), cov - K @ S @ K.T


def with_turn(cov: Array, within_s: float) -> Array:
    """A velocity step of 5 m/s per axis at any time of the last ``within_s`` seconds."""
    nodes, weights = np.polynomial.legendre.leggauss(3)
    total = cov.copy()
    for s, w in zip(within_s * (nodes + 1.0) / 2.0, weights / 2.0, strict=True):
        G = np.zeros((6, 2))
        G[[0, 1], [0, 1]], G[[2, 3], [0, 1]] = s, 1.0
        total += w * 25.0 * G @ G.T
    return total


def passes(z: Array, mean: Array, cov: Array) -> bool:
    off = z - H @ mean
    return bool(off @ np.linalg.solve(H @ cov @ H.T + R, off) <= TURNING.gate_nis[2])


def with_side_turn(mean: Array, cov: Array, side: float, within_s: float) -> tuple[Array, Array]:
    """The velocity turned to a side at any time of the last ``within_s`` seconds, with a quarter
    of the speed and 25 degrees more or less."""
    nodes, weights = np.polynomial.legendre.leggauss(3)
    left = np.array([[0.0, -side], [side, 0.0]])
    way = left @ mean[2:4]
    parts = []
    for s in within_s * (nodes + 1.0) / 2.0:
        F, G = np.eye(6), np.zeros((6, 2))
        F[2:4, 2:4], F[:2, 2:4] = left, s * (left - np.eye(2))
        for k, d in enumerate((0.25 * way, np.radians(25.0) * (left @ way))):
            G[:2, k], G[2:4, k] = s * d, d
        parts.append((F @ mean, F @ cov @ F.T + G @ G.T))
    return moments(Mixture(*map(np.array, zip(*parts, strict=True)), np.log(weights / 2.0)))


def turned_priors(x: Array, P: Array, within_s: float) -> list[tuple[float, Array, Array]]:
    """Probability, mean and covariance: any step, and to either side."""
    ratio2 = 2.0 * (x[2:4] @ x[2:4]) / 5.0**2
    to_side = 0.35 * ratio2 * np.exp(-0.5 * ratio2)
    if to_side < 0.005 or np.trace(P[2:4, 2:4]) > np.radians(25.0) ** 2 * (x[2:4] @ x[2:4]):
        return [(1.0, x, with_turn(P, within_s))]
    sides = [(to_side, *with_side_turn(x, P, side, within_s)) for side in (1.0, -1.0)]
    return [(1.0 - 2.0 * to_side, x, with_turn(P, within_s)), *sides]


@pytest.mark.parametrize("velocity", [(0.3, -0.2), (0.0, 4.0)])
@pytest.mark.parametrize(
    ("off_m", "unheard_s", "open_s"),
    [(1.8, 0.4, 9.0), (2.5, 0.4, 9.0), (1.8, 0.4, 0.5), (6.0, 3.0, 0.1)],
)
def test_a_refused_fix_is_an_outlier_a_tail_or_a_turn(
    off_m: float, unheard_s: float, open_s: float, velocity: tuple[float, float]
) -> None:
    """Weights and moments of the explanations, by the Kalman filter's own formulas; a fast device
    may have turned to the side where the fix is, since a component says so or it was heard."""
    x, P = prior((1.0, 2.0), (0.2, 0.3), rho=0.5)
    x[2:4] = velocity
    P[2:4, 2:4] *= 0.25
    P[0:2, 2:4] *= 0.5
    P[2:4, 0:2] *= 0.5
    z = x[:2] + off_m * np.array([1.0, 0.0])
    rows, accepted = linear_rows(z, R, H, 0), np.zeros(1)
    epoch = EpochInput(0.1, unheard_s, open_s, 0, rows)
    found = epochs.apply_epoch(one_component(x, P), epoch, TURNING, accepted)
    S = H @ P @ H.T + R
    delay_s = np.sqrt(2.0 * TURNING.gate_nis[2] / np.trace(np.linalg.inv(S))) / 5.0
    within_s = max(unheard_s, min(delay_s, open_s))
    whitened = np.linalg.slogdet(np.linalg.cholesky(R))[1]  # rows are decorrelated fixes
    root = np.linalg.cholesky(R)
    innovation = np.abs(np.linalg.solve(root, z - x[:2]))
    sd = np.sqrt(np.diag(np.linalg.solve(root, np.linalg.solve(root, S).T)))
    octaves = 1.0 + np.log(1e3)
    outlier = np.log(1e-2) - np.log(2.0 * octaves * np.maximum(innovation, sd)).sum()
    priors = turned_priors(x, P, within_s)
    turns = [(share, *updated(z, m, C)) for share, m, C in priors if passes(z, m, C)]
    assert (len(turns) > 1) is (velocity[0] == 0.0)
    tail = updated(z, x, P)
    logs = [outlier, tail[0] + whitened]
    logs += [t[1] + whitened + np.log(t[0] * within_s / 30.0) for t in turns]
    weights = np.exp(np.array(logs) - max(logs))
    weights /= weights.sum()
    means = np.array([x, tail[1], *(t[2] for t in turns)])
    covs = np.array([P, tail[2], *(t[3] for t in turns)])
    mean, cov = moments(Mixture(means, covs, np.log(weights)))
    ours, our_cov = moments(found.components)
    np.testing.assert_allclose(ours, mean, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(our_cov, cov, rtol=1e-5, atol=1e-6)
    assert found.turned == pytest.approx(weights[2:].sum(), abs=1e-6)
    assert found.within_s == pytest.approx(within_s)
    assert accepted[0] == (0.0 if np.argmax(weights) == 0 else 1.0)


def test_a_fix_within_the_gate_leaves_one_component_and_without_manoeuvres_so_does_any() -> None:
    x, P = prior((1.0, 2.0), (0.2, 0.3))
    straight = options_of(TrackerConfig(filter="ekf", manoeuvre_speed_sd_mps=0.0))
    for options, off_m in ((TURNING, 0.5), (straight, 6.0)):
        rows = linear_rows(x[:2] + off_m * np.array([1.0, 0.0]), R, H, 0)
        rows = np.vstack([rows, linear_rows(x[:2], R, H, 1)])
        epoch = EpochInput(0.1, 0.1, 9.0, 0, rows)
        found = epochs.apply_epoch(one_component(x, P), epoch, options, np.zeros(2))
        assert found.components.log_weights.size == 1
        assert found.turned == 0.0


@pytest.mark.parametrize(("since_s", "begins"), [(0.249, False), (0.251, True)])
def test_one_rsu_lets_a_turn_begin_every_quarter_of_a_second(since_s: float, begins: bool) -> None:
    x, P = prior((1.0, 2.0), (0.2, 0.3))
    rows = linear_rows(x[:2], R, H, 0)
    epoch = EpochInput(0.1, 0.1, since_s, 0, rows)
    found = epochs.apply_epoch(one_component(x, P), epoch, TURNING, np.zeros(1))
    assert found.begun is begins
    assert (found.components.log_weights.size > 1) is begins
    if begins:
        priors = turned_priors(x, P, since_s)
        turned = sum(share * np.exp(updated(x[:2], m, C)[0]) for share, m, C in priors)
        turned *= since_s / 30.0
        straight = np.exp(updated(x[:2], x, P)[0])
        assert found.turned == pytest.approx(turned / (turned + straight), rel=1e-6)


@pytest.mark.parametrize("name", ["ekf", "iekf", "ukf", "srukf"])
def test_every_filter_follows_a_turn_and_forgets_an_outlier(name: str) -> None:
    """Straight on at 4 m/s with fixes of 0.2 m; one fix 5 m off, then a turn by 90 degrees."""
    config = TrackerConfig(filter=name, manoeuvre_speed_sd_mps=5.0, accel_density_mps2_sqrthz=0.1)
    rng = np.random.default_rng(3)
    truth, velocity = np.array([0.0, 0.0]), np.array([4.0, 0.0])
    start = np.diag([0.04, 0.04, 0.04, 0.04, 1.0, 1.0])
    estimate = Estimate(config, 0, np.array([0.0, 0.0, 4.0, 0.0, 0.0, 0.0]), start)
    errors = []
    for k in range(1, 120):
        velocity = np.array([4.0, 0.0]) if k < 80 else np.array([0.0, 4.0])
        truth = truth + 0.1 * velocity
        z = truth + 0.2 * rng.normal(size=2) + ([0.0, 5.0] if k == 40 else [0.0, 0.0])
        rows = linear_rows(z, 0.04 * np.eye(2), H, 0)
        rows = np.vstack(
            [rows, linear_rows(truth + 0.5 * rng.normal(size=2), np.eye(2) / 4, H, 1)]
        )
        estimate.step(k * 100_000_000, 0.1, 0, rows, NO_BIAS)
        errors.append(float(np.hypot(*(estimate.mean[:2] - truth))))
    assert max(errors[30:40]) < 0.5
    assert max(errors[41:78]) < 0.6  # one epoch later the outlier is one
    assert max(errors[79:]) < 2.0
    assert max(errors[95:]) < 0.6
    assert estimate.modes == ()
    assert rows[-1, GROUP] == 1


@pytest.mark.parametrize("name", ["ekf", "srukf"])
def test_rows_are_reweighted_by_the_most_probable_component(name: str) -> None:
    """Huber's factor of a fix 4 m off the heavier of two components, and 40 m off the other."""
    config = TrackerConfig(
        filter=name, robust="huber", robust_parameter=1.5, manoeuvre_speed_sd_mps=5.0
    )
    x, P = prior((1.0, 2.0), (0.2, 0.3))
    two = Mixture(np.array([x + 40.0, x]), np.array([P, P]), np.log(np.array([0.1, 0.9])))
    off = np.array([4.0, 0.0])
    rows = linear_rows(x[:2] + off, R, H, 0)
    variance = rows[:, VARIANCE].copy()
    dynamics = dynamics_of(config, NO_BIAS)
    epoch = EpochInput(0.0, 0.1, 0.0, 0, rows)
    epochs.moved_to_epoch(two, epoch, dynamics, options_of(config))
    distance = np.sqrt(off @ np.linalg.solve(H @ P @ H.T + R, off) / 2.0)
    np.testing.assert_allclose(rows[:, VARIANCE] / variance, distance / 1.5, rtol=1e-9)


@pytest.mark.parametrize("since_s", [0.1, 60.0])
def test_an_epoch_says_the_same_to_a_component_and_to_its_two_halves(since_s: float) -> None:
    """With robust weights and blocked paths, also after a silence: rows are re-weighted once."""
    config = TrackerConfig(
        filter="ekf",
        robust="student_t",
        robust_parameter=4.0,
        nlos_probability=0.2,
        manoeuvre_speed_sd_mps=0.0,
        gate_probability=1.0,
    )
    options, dynamics = options_of(config), dynamics_of(config, NO_BIAS)
    x, P = prior((14.0, 0.0), (1.5, 1.5))
    halves = Mixture(np.array([x, x]), np.array([P, P]), np.log(np.array([0.5, 0.5])))
    found = []
    for parts in (one_component(x, P), halves):
        mean, cov = x.copy(), P.copy()
        measured = [row(Kind.AZIMUTH, 0.4, 0.05**2, 0), row(Kind.RANGE, 17.0, 0.3**2, 1)]
        epoch = EpochInput(since_s, since_s, 0.0, 0, np.array(measured))
        memory = epochs.memory_of(6, 2)
        epochs.advance(mean, cov, parts, epoch, dynamics, options, memory)
        found.append((mean, cov, epoch.rows))
    for one, two in zip(*found, strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-3, atol=1e-3)


def blocked_on_grid(
    x: Array, P: Array, rows: list[Array], share: float, excess_m: float
) -> tuple[Array, Array]:
    """Mean and covariance of the position, each range direct or late, by sums."""
    axis = np.arange(-8.0, 8.0, 0.04)
    grid = np.stack(np.meshgrid(axis + x[0], axis + x[1], indexing="ij"), axis=-1).reshape(-1, 2)
    log = multivariate_normal(x[:2], P[:2, :2]).logpdf(grid)
    for r in rows:
        off = r[1] - np.linalg.norm(grid - r[7:9], axis=1)
        late = exponnorm(excess_m / np.sqrt(r[2]), scale=np.sqrt(r[2])).pdf(off)
        log += np.log((1.0 - share) * norm(scale=np.sqrt(r[2])).pdf(off) + share * late + 1e-300)
    weight = np.exp(log - log.max())
    weight /= weight.sum()
    mean = weight @ grid
    away = grid - mean
    return mean, (away * weight[:, None]).T @ away


FAR = ((60.0, 0.0), (0.0, 60.0), (-40.0, -40.0))
NEAR = ((6.0, 0.0), (0.0, 5.0), (-4.0, -5.0))  # a range is a ring to the prior


@pytest.mark.parametrize(("sites", "apart_sd"), [(FAR, 0.15), (NEAR, 0.2)])
@pytest.mark.parametrize("late_m", [(0.0, 0.0, 0.0), (2.5, 0.0, 0.0), (1.2, 0.0, 3.0)])
def test_blocked_paths_against_the_grid(
    late_m: tuple[float, float, float], sites: tuple[tuple[float, float], ...], apart_sd: float
) -> None:
    """A device known to 2 m, ranges of three anchors, the first of them late. What is left near
    the anchors: a piece of a ring is as wide at one end as at the other."""
    share, excess_m = 0.3, 2.0
    options = options_of(
        TrackerConfig(
            filter="ekf",
            nlos_probability=share,
            nlos_mean_excess_m=excess_m,
            manoeuvre_speed_sd_mps=0.0,
        )
    )
    x, P = prior((1.0, -2.0), (2.0, 2.0))
    x[2:4] = 0.0
    truth, parts, rows = x[:2] + np.array([0.7, -0.5]), one_component(x, P), []
    for origin, late in zip(sites, late_m, strict=True):
        value = float(np.hypot(*(truth - origin))) + late
        rows.append(row(Kind.RANGE, value, 0.2**2, origin=np.array([*origin, 0.0])))
        epoch = EpochInput(0.0, 0.0, 0.0, 0, np.array(rows[-1:]))
        parts = epochs.apply_epoch(parts, epoch, options, np.zeros(1)).components
    found, found_cov = moments(parts)
    mean, cov = blocked_on_grid(x, P, rows, share, excess_m)
    off = found[:2] - mean
    assert np.sqrt(off @ np.linalg.solve(cov, off) / 2.0) < apart_sd
    # The excess of a blocked path is exponential; a component takes its moments.
    assert np.trace(found_cov[:2, :2]) == pytest.approx(np.trace(cov), rel=0.4)


@pytest.mark.parametrize("more", [0.0, 30.0])
def test_a_blocked_path_shares_what_linearising_leaves_out(more: float) -> None:
    """A late range of ``more`` others with the same bend, in NumPy: half of 0.07^2 each."""
    options = options_of(TrackerConfig(filter="ekf", nlos_probability=0.3))
    x, P = prior((0.0, 0.0), (2.0, 2.0))
    rows = np.array([row(Kind.RANGE, 63.0, 0.2**2, origin=np.array([60.0, 0.0, 0.0]))])
    rows[0, SAME_BEND] = more
    found, predicted = candidates(2, 6, 1), predicted_rows(x, P, rows, options.height_m)
    assert paths.add(0, 0, one_component(x, P), rows, options, found) == 2
    blocked = paths.paths_in(0, rows, predicted, options.robust).blocked
    gain = -P[0] / (P[0, 0] + 0.2**2 + (1.0 + more) * (4.0 / 60.0) ** 2 / 2.0)
    innovation = 3.0 - 4.0 / 2.0 / 60.0 - blocked.excess
    np.testing.assert_allclose(found.means[1], x + gain * innovation, rtol=1e-9)
    expected = P + np.outer(gain, P[0]) + blocked.excess_var * np.outer(gain, gain)
    np.testing.assert_allclose(found.covs[1], expected, atol=1e-9)


def test_the_candidates_of_a_late_range_and_an_azimuth() -> None:
    """Against NumPy: one by a direct path and one by a blocked path. A component of little weight
    has one for both."""
    options = options_of(TrackerConfig(filter="ekf", nlos_probability=0.3))
    x, P = prior((0.0, 0.0), (2.0, 2.0))
    site, variances = np.array([600.0, 0.0, 0.0]), np.array([0.01**2, 0.2**2])
    for late_m, log_weight, count in ((3.0, 0.0, 2), (0.3, -14.0, 1)):
        values = np.pi - 0.001, 600.0 + late_m
        rows = np.array(
            [
                row(kind, value, var, origin=site)
                for kind, value, var in zip(
                    (Kind.AZIMUTH, Kind.RANGE), values, variances.tolist(), strict=True
                )
            ]
        )
        predicted = predicted_rows(x, P, rows, options.height_m)
        seen = paths.paths_in(1, rows, predicted, options.robust)
        found = candidates(2, 6, 1)
        part = Mixture(x[None], P[None], np.array([log_weight]))
        assert paths.add(0, 0, part, rows, options, found) == count
        bent = predicted.second_order_var
        H, z = predicted.H, predicted.innovation
        S = H @ P @ H.T + np.diag(variances + bent)
        fits = multivariate_normal(np.zeros(2), S).logpdf(z)
        ways = (seen.direct, seen.blocked) if count == 2 else (seen.either,)
        for k, way in enumerate(ways):
            shift = np.array([0.0, way.excess])
            gain = P @ H.T @ np.linalg.inv(S)
            expected = P - gain @ H @ P + way.excess_var * np.outer(gain[:, 1], gain[:, 1])
            assert found.log_weights[k] == pytest.approx(log_weight + fits + way.log, abs=1e-3)
            np.testing.assert_allclose(found.means[k], x + gain @ (z - shift), atol=2e-3)
            np.testing.assert_allclose(found.covs[k], expected, atol=2e-3)
            if count == 2:
                nis = (z - shift) @ np.linalg.solve(S, z - shift)
                assert found.nis[k] == pytest.approx(nis, rel=0.02)
            assert (found.accepted[k, 0], found.used[k]) == (1.0, 2.0)
            assert found.blocked[k] == way.blocked
            assert found.within_s[k] == 0.0
