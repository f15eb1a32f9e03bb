"""The kernels of a bank of filters one by one, in NumPy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from anchor_walk import Walk, rows_at
from engine_cases import opened
from netpos.estimation import engine
from netpos.estimation.engine import GATE_SIZE
from netpos.estimation.forms import ekf
from netpos.estimation.measurement import KIND, VALUE, VARIANCE, Kind, predict_row
from netpos.estimation.motion import NO_BIAS
from netpos.estimation.rows import linear_rows
from netpos.estimation.sigma import innovation_cov, regress
from netpos.messages.values import Array
from netpos.tracking import TrackerConfig, sector_bank
from netpos.tracking.models import motions_of, options_of
from netpos.tracking.phase_fix import init_hypothesis, place
from netpos.tracking.sector_bank import Bank, BankResult
from scipy.special import logsumexp

SLOTS, MIDDLE = 11, 5
TURN = 2.0 * math.pi
FIXED = {"filter": "iekf", "initial_speed_sd_mps": 1.5}


def informed(mean: Array, cov: Array, z: Array, H: Array) -> tuple[Array, Array]:
    """What a measurement of unit variances makes of a state: the information form."""
    posterior = np.linalg.inv(np.linalg.inv(cov) + H.T @ H)
    return mean + posterior @ H.T @ (z - H @ mean), posterior


def test_weights_follow_the_likelihood_and_outliers_decide_nothing() -> None:
    """Three filters, the first of them not there. Of three groups the second and the third, of
    more rows than the gate has bounds for, are refused: each counts as one at its gate."""
    options, rng = options_of(TrackerConfig(**FIXED)), np.random.default_rng(4)
    sizes = (2, 3, 70)
    H = [rng.normal(size=(m, 6)) for m in sizes]
    means = np.vstack([np.full(6, np.nan), 0.3 * rng.normal(size=(2, 6))])
    A = rng.normal(size=(2, 6, 6))
    covs = np.concatenate([np.full((1, 6, 6), np.nan), A @ A.transpose(0, 2, 1) / 6.0])
    z = [np.ones(m) + 1e3 * (g > 0) for g, m in enumerate(sizes)]
    rows = np.vstack([linear_rows(z[g], np.eye(m), H[g], g) for g, m in enumerate(sizes)])
    weights = np.array([-math.inf, math.log(0.3), math.log(0.7)])
    logs, expected = (
        weights.copy(),
        [(x.copy(), P.copy()) for x, P in zip(means, covs, strict=True)],
    )
    nis_expected = np.full(3, 9.0)
    for s in (1, 2):
        x, P = expected[s]
        for g, m in enumerate(sizes):
            S, off = H[g] @ P @ H[g].T + np.eye(m), z[g] - H[g] @ x
            distance = off @ np.linalg.solve(S, off)
            bound = options.gate_nis[min(m, GATE_SIZE - 1)]
            assert bool(distance > bound) is (g > 0)
            logs[s] -= 0.5 * (min(distance, bound) + np.linalg.slogdet(S)[1])
            nis_expected[s] = distance if g == 0 else nis_expected[s]
        all_H, off = np.vstack(H), np.concatenate(z) - np.vstack(H) @ x
        S, flags = all_H @ P @ all_H.T + np.eye(len(rows)), np.zeros(3)
        evidence = sector_bank._evidence(rows, off, S, options.gate_nis, flags)
        assert evidence == pytest.approx(logs[s] - weights[s], rel=1e-9)
        expected[s] = informed(x, P, z[0], H[0])
    accepted, nis, used = np.full((3, 3), 9.0), np.full(3, 9.0), np.full(3, 9.0)
    bank, result = Bank(means, covs, weights), BankResult(accepted, nis, used)
    sector_bank.update(bank, rows, options, result, ekf.workspace(6, len(rows)))
    np.testing.assert_allclose(weights[1:], (logs - logsumexp(logs))[1:], rtol=1e-7, atol=1e-9)
    assert weights[0] == -math.inf
    assert accepted.tolist() == [[9.0] * 3, [1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    np.testing.assert_allclose(nis, nis_expected, rtol=1e-9)
    assert used.tolist() == [9.0, 2.0, 2.0]
    for s in range(3):
        np.testing.assert_allclose(means[s], expected[s][0], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(covs[s], expected[s][1], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("velocity_step_sd", [0.0, 3.0])
def test_all_filters_that_are_there_move(velocity_step_sd: float) -> None:
    config, rng = TrackerConfig(**FIXED), np.random.default_rng(1)
    motion, options = motions_of(config)[0], options_of(config)
    means, covs = rng.normal(size=(3, 6)), np.array([np.eye(6) * k for k in (1.0, 2.0, 3.0)])
    weights = np.array([math.log(0.5), -math.inf, math.log(0.5)])
    expected, spread = means.copy(), covs.copy()
    for s in (0, 2):
        ekf.predict(expected[s], spread[s], 0.2, motion, NO_BIAS)
        spread[s] = opened(spread[s], velocity_step_sd, 1.7)
    bank = Bank(means, covs, weights)
    sector_bank.advance(bank, 0.2, velocity_step_sd, 1.7, motion, NO_BIAS, options)
    np.testing.assert_allclose(means, expected, rtol=1e-12)
    np.testing.assert_allclose(covs, spread, rtol=1e-12, atol=1e-14)


def test_weights_sum_to_one_above_their_floor() -> None:
    """However small all are: only their ratios count."""
    for scale in (0.0, -5000.0, 5000.0):
        weights = np.array([0.0, -100.0, -math.inf, math.log(0.25)]) + scale
        sector_bank.normalise(weights, 1e-4)
        share = np.array([0.8, 1e-4, 0.0, 0.2]) / (1.0 + 1e-4)
        share[1] = 1e-4
        np.testing.assert_allclose(np.exp(weights), share, rtol=1e-9)


class Epoch:
    """One epoch of a walk, as a bank sees it that knows of one sector, the one before; slots that
    are not there hold no numbers."""

    def __init__(
        self, sd: float, height_m: float, range_off_m: float = 0.0, name: str = "iekf"
    ) -> None:
        self.walk = Walk(np.array([-0.8, 4.5]), 0.3, 0.2, 1)
        self.rows = rows_at(self.walk, 0, 0.05)
        self.height_m = height_m
        self.options = options_of(
            TrackerConfig(filter=name, initial_speed_sd_mps=1.5, device_height_m=height_m)
        )
        self.rows[1, KIND] = Kind.UNWRAPPED_PHASE
        for row in self.rows[:2]:
            state = np.array([-0.8, 4.5, 0.0, 0.0, 0.0, 0.0])
            row[VALUE] = predict_row(row, state, height_m, np.empty(6))
        turns = round(self.rows[1, VALUE] / TURN)
        self.leader, self.home = MIDDLE + turns, MIDDLE + turns + 1
        self.rows[1, KIND] = Kind.PHASE
        self.rows[:2, VALUE] += range_off_m, -TURN * turns
        self.prior = np.array([-0.79, 4.48, *self.walk.velocity, 0.0, 0.0])
        self.cov = np.diag([sd, sd, 0.1, 0.1, 1.0, 1.0]) ** 2
        self.means, self.covs = np.full((SLOTS, 6), np.nan), np.full((SLOTS, 6, 6), np.nan)
        self.means[self.home] = self.prior
        self.covs[self.home] = engine.to_cov_or_sqrt(self.cov, self.options)
        self.weights = np.full(SLOTS, -math.inf)
        self.weights[self.home] = 0.0
        self.heirs = np.full(SLOTS, 9, dtype=np.int64)
        self.accepted, self.nis, self.used = np.full((SLOTS, 2), 9.0), *np.full((2, SLOTS), 9.0)

    def turned(self, slot: int) -> Array:
        rows = self.rows.copy()
        rows[1, KIND] = Kind.UNWRAPPED_PHASE
        rows[1, VALUE] += TURN * (slot - MIDDLE)
        return rows

    def resolve(self) -> None:
        before = self.rows.copy()
        bank = Bank(self.means, self.covs, self.weights)
        result, work = BankResult(self.accepted, self.nis, self.used), ekf.workspace(6, 4)
        sector_bank.resolve(bank, self.rows, 1, self.options, 1e-4, self.heirs, result, work)
        np.testing.assert_array_equal(self.rows, before)

    def placed(self, slot: int) -> tuple[Array, Array] | None:
        """A filter put where range and phase say, then told the velocity."""
        mean, cov, rows = self.prior.copy(), self.cov.copy(), self.turned(slot)
        if init_hypothesis(mean, cov, rows[0], rows[1], 0, 1.5, self.height_m) == -math.inf:
            return None
        H = np.eye(2, 6, k=2) / 0.05
        return informed(mean, cov, self.walk.velocity / 0.05, H)

    def fixed(self, slot: int) -> tuple[Array, Array]:
        """The filter told where range and phase say, and the velocity."""
        point, R, rows = np.empty(2), np.empty((2, 2)), self.turned(slot)
        assert place(rows[0], rows[1], 0, self.height_m, point, R)
        root = np.linalg.inv(np.linalg.cholesky(R))
        H = np.vstack([root @ np.eye(2, 6), np.eye(2, 6, k=2) / 0.05])
        told = np.concatenate([root @ point, self.walk.velocity / 0.05])
        return informed(self.prior, self.cov, told, H)


@pytest.mark.parametrize(
    ("name", "sd", "height_m"),
    [("iekf", 0.03, 0.0), ("iekf", 0.03, 3.0), ("iekf", 0.6, 0.0), ("srukf", 0.03, 0.0)],
)
def test_sectors_nobody_knows_of_are_placed_anew(name: str, sd: float, height_m: float) -> None:
    """The filter that is there takes the measurement, or the fix it gives where the tangent does
    not reach; what it does not explain is put where range and phase say, at the floor, if that is
    a place at all."""
    epoch = Epoch(sd, height_m, name=name)
    leader, mean, cov = epoch.leader, epoch.prior.copy(), epoch.covs[epoch.home].copy()
    accepted, own, used = np.zeros(2), epoch.turned(leader), 4
    epoch.resolve()
    if sd < 0.1:
        nis, used = engine.update(mean, cov, own, epoch.options, accepted, ekf.workspace(6, 4))
        assert epoch.nis[leader] == pytest.approx(nis, rel=1e-9)
    else:
        mean, cov = epoch.fixed(leader)
    np.testing.assert_allclose(epoch.means[leader], mean, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(epoch.covs[leader], cov, rtol=1e-7, atol=1e-9)
    covs = [engine.to_cov(P, epoch.options) for P in epoch.covs]
    assert (epoch.used[leader], epoch.accepted[leader].tolist()) == (used, [1.0, 1.0])
    assert epoch.heirs[leader] == epoch.home
    there = 0
    for slot in set(range(SLOTS)) - {leader}:
        explained = epoch.heirs[slot] != -1  # a neighbour the wide filter reaches
        assert sd > 0.1 or not (explained or epoch.nis[slot] or epoch.used[slot])
        expected = epoch.fixed(slot) if explained else epoch.placed(slot)
        assert math.isfinite(epoch.weights[slot]) is (expected is not None)
        if expected is None:
            continue
        there += 1
        np.testing.assert_allclose(epoch.means[slot], expected[0], rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(covs[slot], expected[1], rtol=1e-7, atol=1e-9)
        assert epoch.accepted[slot].tolist() == [1.0, 1.0]
        assert sd > 0.1 or epoch.weights[slot] == pytest.approx(math.log(1e-4), abs=2e-3)
    assert there == (5 if height_m > 0.0 else 7)
    assert logsumexp(epoch.weights) == pytest.approx(0.0, abs=1e-2)
    for slot in (0, 10):  # five turns are none of the array's
        assert np.isnan(epoch.means[slot]).all()
        assert epoch.accepted[slot].tolist() == [0.0, 0.0]


@pytest.mark.parametrize(("variance", "is_wide"), [(0.995, 0.0), (1.005, 1.0)])
def test_a_tangent_reaches_as_far_as_a_radian(variance: float, is_wide: float) -> None:
    """Of the prior alone, without the noise of the phase; beyond it, the fix is weighed."""
    epoch = Epoch(0.03, 0.0)
    rows, gate = epoch.turned(epoch.leader), epoch.options.gate_nis

    def phase_variance() -> float:
        L = np.linalg.cholesky(epoch.covs[epoch.home])
        _, G, E = regress(epoch.prior, L, rows, 0.0)
        return float(innovation_cov(G, E, np.zeros(4))[1, 1])

    for _ in range(9):
        epoch.covs[epoch.home][:2, :2] *= variance / phase_variance()
    assert phase_variance() == pytest.approx(variance, abs=1e-6)
    bank = Bank(epoch.means, epoch.covs, epoch.weights)
    gains, wide = sector_bank._gains(bank, epoch.turned(MIDDLE), 1, epoch.options)
    assert wide[epoch.home] == is_wide
    L, turns = np.linalg.cholesky(epoch.covs[epoch.home]), epoch.leader - MIDDLE
    innovation, G, E = regress(epoch.prior, L, rows, 0.0)
    S = innovation_cov(G, E, rows[:, VARIANCE].copy())
    by_tangent = sector_bank._evidence(rows, innovation, S, gate, np.zeros(2))
    by_fix = sector_bank._fix_evidence(
        epoch.prior, L, epoch.turned(MIDDLE), 1, turns, epoch.options
    )
    assert abs(by_fix - by_tangent) > 1e-3
    expected = by_fix if is_wide else by_tangent
    assert gains[epoch.home, epoch.leader] == pytest.approx(expected, rel=1e-9)


def test_what_the_leader_refuses_places_nobody() -> None:
    epoch = Epoch(0.03, 0.0, range_off_m=3.0)
    epoch.resolve()
    assert epoch.accepted[epoch.leader].tolist() == [0.0, 1.0]
    weights = np.full(SLOTS, -math.inf)
    weights[epoch.leader] = 0.0
    np.testing.assert_array_equal(epoch.weights, weights)
    np.testing.assert_array_equal(epoch.means[epoch.home], epoch.prior)
    assert np.isnan(np.delete(epoch.means, [epoch.leader, epoch.home], axis=0)).all()
    assert epoch.used[epoch.leader] == 2


@pytest.mark.parametrize("alone", [True, False])
def test_who_is_placed_anew_may_refuse_the_rest(alone: bool) -> None:
    """A velocity ten metres per second off, or none at all: the place stays as it was put."""
    epoch = Epoch(0.03, 0.0)
    if alone:
        epoch.rows, epoch.accepted = epoch.rows[:2].copy(), epoch.accepted[:, :1].copy()
    else:
        epoch.rows[2:, VALUE] += 10.0 / 0.05
    epoch.resolve()
    slot, rows = epoch.leader - 1, epoch.turned(epoch.leader - 1)
    mean, cov = epoch.prior.copy(), epoch.cov.copy()
    assert math.isfinite(init_hypothesis(mean, cov, rows[0], rows[1], 0, 1.5, 0.0))
    np.testing.assert_array_equal(epoch.means[slot], mean)
    np.testing.assert_array_equal(epoch.covs[slot], cov)
    for s in (slot, epoch.leader):
        assert epoch.accepted[s].tolist() == [1.0, 0.0][: 1 if alone else 2]


@pytest.mark.parametrize("name", ["iekf", "srukf"])
def test_the_whole_bank_has_the_moments_of_its_filters(name: str) -> None:
    """Eastings and northings: to the digits of a metre and not of its product with a northing."""
    options, rng = options_of(TrackerConfig(filter=name)), np.random.default_rng(8)
    away, A = rng.integers(-9, 10, size=(3, 6)) / 8.0, rng.normal(size=(3, 6, 6))
    means = away + np.array([500_000.0, 6_600_000.0, 0.0, 0.0, 0.0, 0.0])
    covs, share = A @ A.transpose(0, 2, 1) + np.eye(6), np.array([0.3, 0.0, 0.7])
    spreads = np.array([engine.to_cov_or_sqrt(P, options) for P in covs])
    means[1], spreads[1] = np.nan, np.nan
    weights = np.array([math.log(0.3), -math.inf, math.log(0.7)])
    mean, cov = sector_bank.combine(Bank(means, spreads, weights), options)
    means[1], covs[1] = 0.0, 0.0
    np.testing.assert_allclose(mean, share @ means, rtol=1e-12, atol=1e-14)
    expected = np.einsum("k,kab->ab", share, covs) + np.cov(away.T, aweights=share, ddof=0)
    np.testing.assert_allclose(cov, expected, rtol=1e-9, atol=1e-12)
