"""The Gaussian mixture against densities on a grid, the plain filter and its own moments."""

from __future__ import annotations

import numpy as np
import pytest
from filter_rows import make_cov, row
from netpos.filters import ekf, imm, mixture
from netpos.filters.chi_square import chi_square_bound
from netpos.filters.measurement import Kind
from netpos.messages.values import Array

GATE = np.array([0.0, *(chi_square_bound(dof, 1e-4) for dof in range(1, 13))])
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


def moments(parts: mixture.Mixture) -> tuple[Array, Array]:
    means, covs, logs = parts
    mean, cov = np.empty(means.shape[1]), np.empty(covs.shape[1:])
    imm.combine(means, covs, np.exp(logs), mean, cov)
    return mean, cov


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
    parts = mixture.split_along_ring(x, P, measured, 0.0)
    evidence, mean, cov = on_grid(x, P, [measured], 30.0, 0.1)
    assert np.exp(parts[2]).sum() == pytest.approx(evidence, rel=0.03)
    parts = (parts[0], parts[1], parts[2] - np.log(np.exp(parts[2]).sum()))
    found, found_cov = moments(parts)
    scale = np.sqrt(np.trace(cov))
    np.testing.assert_allclose(found[:2], mean, atol=0.03 * scale)
    np.testing.assert_allclose(found_cov[:2, :2], cov, atol=0.05 * scale**2)


def test_the_other_states_follow_the_position() -> None:
    """A velocity that hangs together with the position is told by it, component by component."""
    x, P = prior((14.0, 0.0), (6.0, 6.0), rho=0.8)
    means, covs, logs = mixture.split_along_ring(x, P, row(Kind.RANGE, 15.0, 0.3**2), 0.0)
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
    parts: mixture.Mixture = (x[None], P[None], np.zeros(1))
    for r in rows:
        *parts, _, dof = mixture.update(*parts, r[None], 0.0, GATE, np.zeros(1))  # type: ignore[assignment]
        assert dof == 1
    _, mean, cov = on_grid(x, P, rows, 60.0, 0.1)
    found, found_cov = moments(parts)
    assert np.linalg.norm(found[:2] - mean) < 0.15 * np.sqrt(np.trace(cov))
    assert np.trace(found_cov[:2, :2]) == pytest.approx(np.trace(cov), rel=0.15)
    assert not mixture.mode_of(*parts).any()


def test_two_anchors_leave_two_modes_of_equal_weight() -> None:
    x, P = prior((0.0, 0.0), (25.0, 25.0))
    truth = np.array([4.0, 18.0])
    parts: mixture.Mixture = (x[None], P[None], np.zeros(1))
    for anchor in np.tile([[2.5, 0.0, 0.0], [-2.5, 0.0, 0.0]], (4, 1)):
        value = np.linalg.norm(np.append(truth, 0.0) - anchor)
        r = row(Kind.RANGE, value, 0.2**2, origin=anchor)
        *parts, _, _ = mixture.update(*parts, r[None], 0.0, GATE, np.zeros(1))  # type: ignore[assignment]
    mode, weights = mixture.mode_of(*parts), np.exp(parts[2])
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
    means, covs, logs, nis, dof = mixture.update(
        x[None], P[None], np.zeros(1), rows, 0.0, GATE, accepted
    )
    assert (logs.tolist(), dof, accepted.tolist()) == ([0.0], 3, [1.0, 1.0, 1.0])
    expected, expected_cov, total = x.copy(), P.copy(), 0.0
    for r in rows:
        single = r[None].copy()
        single[:, 6] = 0
        one, _ = ekf.update(
            expected, expected_cov, single, 0.0, GATE, 1, np.zeros(1), ekf.workspace(6, 1)
        )
        total += one
    np.testing.assert_allclose(means[0], expected, atol=1e-12)
    np.testing.assert_allclose(covs[0], expected_cov, atol=1e-12)
    assert nis == pytest.approx(total)


def test_merging_keeps_the_moments_and_what_is_alike_becomes_one() -> None:
    rng = np.random.default_rng(4)
    means = rng.normal(0.0, 0.01, (6, 6)) + np.repeat([[0.0] * 6, [50.0] * 6], 3, axis=0)
    covs = np.array([make_cov(rng, 6, 4.0)] * 6)
    logs = np.log(np.full(6, 1.0 / 6.0)) + 3.0  # not normalised
    parts = mixture.reduced(means, covs, logs)
    assert parts[2].size == 2
    np.testing.assert_allclose(np.exp(parts[2]).sum(), 1.0)
    for ours, expected in zip(moments(parts), moments((means, covs, logs - 3.0)), strict=True):
        np.testing.assert_allclose(ours, expected, rtol=1e-10, atol=1e-10)


def test_components_without_weight_go_and_never_too_many_stay() -> None:
    rng = np.random.default_rng(5)
    means = np.column_stack([100.0 * np.arange(100.0), *rng.normal(size=(5, 100))])
    covs, logs = np.tile(np.eye(6), (100, 1, 1)), np.zeros(100)
    logs[7] = -30.0
    kept, _, weights = mixture.reduced(means, covs, logs)
    assert weights.size == 64
    assert not (np.abs(kept[:, 0] - 700.0) < 1.0).any()


def test_an_outlier_leaves_the_wide_prior_as_it_was_with_its_weight() -> None:
    """A first range that is 40 m wrong: the ranges of the other anchors find the device."""
    x, P = prior((5.0, 12.0), (15.0, 15.0))
    truth = np.array([3.0, 16.0])
    parts: mixture.Mixture = (x[None], P[None], np.zeros(1))
    for k in range(12):
        anchor = ANCHORS[k % 4] * (1.0, 1.0, 0.0)
        value = np.linalg.norm(np.append(truth, 0.0) - anchor) + (40.0 if k == 0 else 0.0)
        r = row(Kind.RANGE, value, 0.2**2, origin=anchor)
        *parts, _, _ = mixture.update(*parts, r[None], 0.0, GATE, np.zeros(1))  # type: ignore[assignment]
    found, cov = moments(parts)
    assert np.linalg.norm(found[:2] - truth) < 3.0 * np.sqrt(np.trace(cov[:2, :2]))
    assert np.trace(cov[:2, :2]) < 4.0


@pytest.mark.parametrize(
    ("distance", "sd", "wide"),
    [
        # range sd 0.2 m at 30 m: 0.5 (sd^2 / 30)^2 = 0.04 / 4 at sd = 2.06 m
        (30.0, 2.05, False),
        (30.0, 2.07, True),
        (30.0, 0.5, False),
        (1.0, 0.7, False),  # narrow, however it bends
    ],
)
def test_a_component_is_wide_where_the_tangent_costs_a_quarter_of_the_noise(
    distance: float, sd: float, wide: bool
) -> None:
    x, P = prior((distance, 0.0), (0.1, sd))
    assert mixture.is_wide(row(Kind.RANGE, distance, 0.04), x, P, 0.0) is wide
    assert not mixture.is_wide(row(Kind.AZIMUTH, 0.0, 0.04), x, P, 0.0)


def test_modes_are_chains_of_components() -> None:
    means = np.zeros((5, 6))
    means[:, 0] = 0.0, 3.0, 6.0, 9.0, 40.0
    covs = np.tile(np.eye(6), (5, 1, 1))
    mode = mixture.mode_of(means, covs, np.log([0.1, 0.1, 0.1, 0.1, 0.6]))
    assert mode.tolist() == [1, 1, 1, 1, 0]
