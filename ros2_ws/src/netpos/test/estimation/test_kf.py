"""The linear filter against the information form, and the gain floor of dvornikov2017."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from netpos.estimation.forms import ekf, kf
from netpos.estimation.measurement import Kind
from netpos.estimation.motion import NO_BIAS, Model, motion_parameters
from netpos.estimation.state import X
from netpos.messages.values import Array

Maker = Callable[..., Array]
OPEN = np.array([np.inf])
H = np.array(
    [[0.5, 0, 0, 0, 0, 0], [0.2, -0.7, 0, 0, 0, 0], [0, 0, 1, 0.3, 0, 0], [0, 0, 0, 0, 1, 0.0]]
)
VALUES = np.array([1.0, -2.0, 0.5, 3.0])
VARIANCES = np.array([1.0, 0.5, 0.2, 4.0])


def linear(row: Maker, gates: Array = VARIANCES) -> Array:
    return np.array(
        [
            row(Kind.LINEAR, VALUES[i], VARIANCES[i], i // 2, h=H[i], gate_variance=gates[i])
            for i in range(4)
        ]
    )


def information_form(mean: Array, cov: Array, keep: slice) -> tuple[Array, Array]:
    h = np.zeros((4, mean.size))
    h[:, :6] = H
    R_inv = np.diag(1.0 / VARIANCES[keep])
    post = np.linalg.inv(np.linalg.inv(cov) + h[keep].T @ R_inv @ h[keep])
    return mean + post @ h[keep].T @ R_inv @ (VALUES[keep] - h[keep] @ mean), post


def distance(mean: Array, cov: Array, keep: slice, gates: Array) -> float:
    h = np.zeros((4, mean.size))
    h[:, :6] = H
    residual = VALUES[keep] - h[keep] @ mean
    S = h[keep] @ cov @ h[keep].T + np.diag(gates[keep])
    return float(residual @ np.linalg.inv(S) @ residual)


@pytest.mark.parametrize("seed", range(3))
def test_update_equals_the_information_form(seed: int, row: Maker, random_cov: Maker) -> None:
    rng = np.random.default_rng(seed)
    mean, cov, gates = rng.normal(size=8), random_cov(rng, 8), VARIANCES / 2
    expected, expected_cov = information_form(mean, cov, slice(None))
    nis_expected = distance(mean, cov, slice(None), gates)
    accepted = np.full(2, 9.0)
    nis, dof = kf.update(
        mean, cov, linear(row, gates), 0.0, OPEN, accepted, kf.NO_FLOOR, kf.NOTHING
    )
    np.testing.assert_allclose(mean, expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(cov, expected_cov, rtol=1e-9, atol=1e-12)
    assert (nis, dof) == (pytest.approx(nis_expected, rel=1e-12), 4)
    assert accepted.tolist() == [1.0, 1.0]
    assert (cov == cov.T).all()


def test_groups_pass_or_fall_whole(row: Maker, random_cov: Maker) -> None:
    rng = np.random.default_rng(4)
    prior, prior_cov, gates = rng.normal(size=6), random_cov(rng, 6), VARIANCES / 3
    first, second = (distance(prior, prior_cov, g, gates) for g in (slice(2), slice(2, 4)))
    small = slice(2) if first < second else slice(2, 4)
    limit = min(first, second) * (1.0 + 1e-9)
    mean, cov, accepted = prior.copy(), prior_cov.copy(), np.full(2, 9.0)
    gate_nis = np.array([0.0, 0.0, limit])
    nis, dof = kf.update(
        mean, cov, linear(row, gates), 0.0, gate_nis, accepted, kf.NO_FLOOR, kf.NOTHING
    )
    assert (nis, dof) == (pytest.approx(min(first, second), rel=1e-12), 2)
    assert accepted.tolist() == [float(first < second), float(second < first)]
    expected, expected_cov = information_form(prior, prior_cov, small)
    np.testing.assert_allclose(mean, expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(cov, expected_cov, rtol=1e-9, atol=1e-12)
    gate_nis[2] = limit * (1.0 - 2e-9)
    mean, cov = prior.copy(), prior_cov.copy()
    result = kf.update(
        mean, cov, linear(row, gates), 0.0, gate_nis, accepted, kf.NO_FLOOR, kf.NOTHING
    )
    assert result == (0.0, 0)
    assert accepted.tolist() == [0.0, 0.0]
    assert (mean == prior).all()
    assert (cov == prior_cov).all()


def test_other_rows_are_rejected_with_their_group(row: Maker) -> None:
    """A position beside an azimuth of the same measurement falls with it."""
    rows = linear(row)
    rows[1] = row(Kind.AZIMUTH, 0.1, 1.0, 0, origin=(9.0, 0.0, 0.0))
    mean, cov, accepted = np.zeros(6), np.eye(6), np.full(2, 9.0)
    expected, expected_cov = information_form(mean, cov, slice(2, 4))
    assert kf.update(mean, cov, rows, 0.0, OPEN, accepted, kf.NO_FLOOR, kf.NOTHING)[1] == 2
    assert accepted.tolist() == [0.0, 1.0]
    np.testing.assert_allclose(mean, expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(cov, expected_cov, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("scale", [1.0, -0.1])
def test_floor_under_the_gain(axis: int, scale: float, row: Maker, random_cov: Maker) -> None:
    """The row's own scale does not matter; gains above the floor and of other states stay."""
    cov = random_cov(np.random.default_rng(2), 8) * 1e-3
    floor = np.array([0.3, 0.2, 0.1])
    floor[1] = -1.0 + cov[axis + 2, axis] / (cov[axis, axis] + 1.0)  # below the Kalman gain
    h = np.zeros(6)
    h[axis] = scale
    mean, start = np.zeros(8), cov.copy()
    rows = np.array([row(Kind.LINEAR, 2.0 * scale, scale**2, h=h)])
    kf.update(mean, cov, rows, 0.0, OPEN, np.zeros(1), floor, kf.NOTHING)
    K = start[:, axis] / (start[axis, axis] + 1.0)
    K[axis], K[6 + axis] = 0.3, 0.1
    A = np.eye(8)
    A[:, axis] -= K
    np.testing.assert_allclose(mean, 2.0 * K, rtol=1e-9, atol=1e-14)
    np.testing.assert_allclose(cov, A @ start @ A.T + np.outer(K, K), rtol=1e-9, atol=1e-14)
    floor = np.array([0.0, 0.25, 0.0])
    mean, cov = np.zeros(8), start.copy()
    kf.update(mean, cov, rows, 0.0, OPEN, np.zeros(1), floor, kf.NOTHING)
    assert mean[axis + 2] == pytest.approx(0.5, rel=1e-12)
    assert mean[axis] == pytest.approx(2.0 * start[axis, axis] / (start[axis, axis] + 1.0))


@pytest.mark.parametrize("scale", [0.1, 10.0, -3.0])
@pytest.mark.parametrize(("share", "raised"), [(0.999, False), (1.001, True)])
def test_floor_is_compared_with_the_gain_per_metre(
    share: float, raised: bool, scale: float, row: Maker
) -> None:
    """Just under and just over P / (P + R), whatever unit the row has."""
    mean, cov, gain = np.zeros(6), 4.0 * np.eye(6), 4.0 / (4.0 + 9.0)
    rows = np.array([row(Kind.LINEAR, 2.0 * scale, 9.0 * scale**2, h=scale * np.eye(6)[0])])
    floor = np.array([share * gain, 0.0, 0.0])
    kf.update(mean, cov, rows, 0.0, OPEN, np.zeros(1), floor, kf.NOTHING)
    assert mean[X.PX] == pytest.approx(2.0 * gain * (share if raised else 1.0), rel=1e-12)


def test_floor_needs_one_position_alone(row: Maker) -> None:
    """Velocities, clocks and mixtures keep the Kalman gain; six states have no acceleration."""
    floor = np.array([0.5, 0.5, 0.5])
    for h in ([0, 0, 1, 0, 0, 0], [1, 1, 0, 0, 0, 0], [1, 0, 0, 0, 1, 0], [0.0] * 6):
        mean, cov = np.zeros(8), 1e-6 * np.eye(8)
        rows = np.array([row(Kind.LINEAR, 1.0, 1.0, h=h)])
        kf.update(mean, cov, rows, 0.0, OPEN, np.zeros(1), floor, kf.NOTHING)
        assert np.abs(mean).max() < 2e-6
    mean, cov = np.zeros(6), 1e-6 * np.eye(6)
    rows = np.array([row(Kind.LINEAR, 1.0, 1.0, h=[1, 0, 0, 0, 0, 0])])
    kf.update(mean, cov, rows, 0.0, OPEN, np.zeros(1), floor, kf.NOTHING)
    np.testing.assert_allclose(mean, [0.5, 0, 0.5, 0, 0, 0], rtol=1e-9, atol=1e-12)


def test_dvornikovs_filter(row: Maker) -> None:
    """The paper's run for x: T = 0.5 s, R = 100 m^2, P(0) = 1000, no process noise. Gains start
    near one, end on the floor; steady errors stay within about 5 m."""
    rng = np.random.default_rng(1)
    motion = motion_parameters(Model.CONSTANT_ACCELERATION)
    mean, cov = np.zeros(8), 1e3 * np.eye(8)
    mean[X.PX] = 10_680.0
    h, errors, gains = np.array([1.0, 0, 0, 0, 0, 0]), [], []
    for step in range(360):
        t = 0.5 * step
        truth = 10_680.0 - 8.2 * t - 0.125 * t * t / 2.0
        value = truth + 10.0 * rng.normal()
        if step:
            ekf.predict(mean, cov, 0.5, motion, NO_BIAS)
        prior = mean.copy()
        rows = np.array([row(Kind.LINEAR, value, 100.0, h=h)])
        kf.update(mean, cov, rows, 0.0, OPEN, np.zeros(1), kf.DVORNIKOV_FLOOR, kf.NOTHING)
        gains.append((mean - prior)[[0, 2, 6]] / (value - prior[0]))
        errors.append(mean[X.PX] - truth)
    assert gains[0][0] == pytest.approx(1000.0 / 1100.0)
    np.testing.assert_allclose(gains[-1], [0.0926, 0.008, 0.0003], rtol=1e-6)
    assert np.sqrt(np.mean(np.square(errors[60:]))) < 5.0


def test_an_epoch_without_rows(row: Maker) -> None:
    mean, P = np.arange(6.0), 2.0 * np.eye(6)
    rows = np.array([row(Kind.RANGE, 1.0, 1.0)])[:0]
    assert kf.update(mean, P, rows, 0.0, OPEN, np.zeros(0), kf.NO_FLOOR, kf.NOTHING) == (0.0, 0)
    assert mean.tolist() == [0, 1, 2, 3, 4, 5]
    assert (2.0 * np.eye(6) == P).all()


@pytest.mark.parametrize("gain_floor", [kf.NO_FLOOR, kf.DVORNIKOV_FLOOR])
def test_no_variance_turns_negative(gain_floor: Array, row: Maker) -> None:
    """Priors of 1e12 measured to 1e-10, many times over in random directions."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        root = rng.normal(size=(6, 6)) * 10.0 ** rng.uniform(-6, 6, 6)[:, None]
        mean, cov = np.zeros(6), root @ root.T
        for _ in range(5):
            h = rng.normal(size=6)
            h[1 if rng.random() < 0.3 else 6 :] = 0.0
            rows = np.array([row(Kind.LINEAR, 1.0, 1e-10, h=h)])
            kf.update(mean, cov, rows, 0.0, OPEN, np.zeros(1), gain_floor, kf.NOTHING)
            assert (np.diag(cov) > 0.0).all()
            assert (cov == cov.T).all()
        assert np.isfinite(mean).all()


@pytest.mark.parametrize("gain_floor", [kf.NO_FLOOR, kf.DVORNIKOV_FLOOR])
def test_own_share_is_what_the_noise_alone_makes(
    gain_floor: Array, row: Maker, random_cov: Maker
) -> None:
    """Against a sum over each fix's noise, carried through the gains found by perturbation."""
    rng = np.random.default_rng(8)
    start = random_cov(rng, 8)
    variances = [9.0, 4.0, 1.0]

    def passed(noise: Array) -> Array:
        mean, cov, own = np.zeros(8), start.copy(), np.zeros((8, 8))
        for value, variance in zip(noise, variances, strict=True):
            h = np.eye(6)[0]
            rows = np.array([row(Kind.LINEAR, value, variance, 0, h=h, gate_variance=variance)])
            kf.update(mean, cov, rows, 0.0, OPEN, np.zeros(1), gain_floor, own)
        shares.append(own)
        covs.append(cov)
        return mean

    shares: list[Array] = []
    covs: list[Array] = []
    effect = np.array([passed(unit) for unit in np.eye(3)]) - passed(np.zeros(3))
    expected = sum(v * np.outer(e, e) for v, e in zip(variances, effect, strict=True))
    np.testing.assert_allclose(shares[0], expected, rtol=1e-9, atol=1e-12)
    assert np.linalg.eigvalsh(covs[0] - shares[0])[0] > -1e-9
    mean, cov = np.zeros(8), start.copy()
    for variance in variances:
        h = np.eye(6)[0]
        rows = np.array([row(Kind.LINEAR, 0.0, variance, 0, h=h, gate_variance=variance)])
        kf.update(mean, cov, rows, 0.0, OPEN, np.zeros(1), gain_floor, kf.NOTHING)
    np.testing.assert_array_equal(cov, covs[0])
