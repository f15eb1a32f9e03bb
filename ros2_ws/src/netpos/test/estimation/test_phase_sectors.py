"""Components of the sectors of a phase difference: against the posterior on a grid, and one by one
in NumPy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from anchor_walk import (
    CONFIG,
    DT_NS,
    PHASE_SD,
    RANGE_SD,
    SCALE,
    T0,
    Walk,
    rows_at,
    true_values,
    wrap,
)
from netpos.estimation.engine import EpochInput, FilterOptions
from netpos.estimation.fixes.phase_fix import init_hypothesis, place
from netpos.estimation.measurement import GROUP, KIND, VALUE, VARIANCE, Kind, predict_row
from netpos.estimation.mixture.candidates import Update
from netpos.estimation.mixture.epoch import apply_epoch
from netpos.estimation.mixture.gaussians import Mixture, one_component
from netpos.estimation.mixture.sectors import most_turns, phase_place, sectors_of_fix, turns_of
from netpos.estimation.motion import NO_BIAS
from netpos.messages.values import Array
from netpos.tracking import TrackerConfig
from netpos.tracking.estimators import estimates
from netpos.tracking.estimators.models import options_of, pose_state
from netpos.tracking.first_fix.phase_start import PhaseStart
from scipy import stats
from scipy.special import logsumexp

TURN = 2.0 * math.pi
SLIP = 1e-4


def grid_posterior(walk: Walk, k: int, velocity: Array) -> dict[int, float]:
    """Probability of each number of turns at epoch ``k`` for a device anywhere in front whose
    velocity is known: every place of a fine polar grid, wrapped normal phases."""
    radius = walk.ranges[k] + np.linspace(-0.12, 0.12, 25)
    sine = np.linspace(-0.9999, 0.9999, 6001)
    r, s = np.meshgrid(radius, sine, indexing="ij")
    now = np.stack([r * s, r * np.sqrt(1 - s * s)], axis=-1)
    log_p = np.log(r / np.sqrt(1 - s * s))  # area of a cell
    for i in range(k + 1):
        xy = now + (i - k) * 0.1 * velocity
        ranges, phases = true_values(xy.reshape(-1, 2))
        range_error = (walk.ranges[i] - ranges).reshape(r.shape) / RANGE_SD
        off = (walk.phases[i] - phases).reshape(r.shape)
        turned = [-0.5 * ((wrap(off) + TURN * j) / PHASE_SD) ** 2 for j in (-1, 0, 1)]
        log_p += -0.5 * range_error**2 + logsumexp(turned, axis=0)
        log_p[xy[..., 1] <= 0.0] = -np.inf
    turns = np.round((SCALE * s - walk.phases[k]) / TURN).astype(int)
    weights = {int(m): float(logsumexp(log_p[turns == m])) for m in np.unique(turns)}
    total = logsumexp(list(weights.values()))
    return {m: math.exp(w - total) for m, w in weights.items()}


def probabilities(components: Mixture, phase: Array) -> dict[int, float]:
    """Weight of each number of turns of a phase row."""
    found: dict[int, float] = {}
    turns = turns_of(components.means, phase, 0.0)
    for m, weight in zip(turns.tolist(), np.exp(components.log_weights), strict=True):
        found[m] = found.get(m, 0.0) + float(weight)
    return found


@pytest.mark.parametrize(("seed", "heading"), [(1, 0.3), (2, 2.0), (3, 1.5), (4, -1.0)])
def test_probabilities_are_those_of_the_posterior(seed: int, heading: float) -> None:
    walk = Walk(np.array([0.8, 4.5]), heading, 0.6, seed)
    expected = {k: grid_posterior(walk, k, walk.velocity) for k in (2, 5)}
    for name in ("srukf", "ukf", "iekf"):
        config = TrackerConfig(filter=name, accel_density_mps2_sqrthz=1e-4)
        estimate = PhaseStart(config).add(T0, rows_at(walk, 0, 1e-3), np.zeros(4))
        assert estimate is not None
        for k in range(1, 6):
            rows = rows_at(walk, k, 1e-3)
            estimate.step(T0 + k * DT_NS, 0.1, 0, rows, NO_BIAS)
            if k not in expected:
                continue
            ours = probabilities(estimate.components, rows[1])
            assert sum(ours.values()) == pytest.approx(1.0, abs=1e-9)
            for turns in range(-4, 5):
                # half a sector at each end-fire, where a Gaussian is a poor shape
                slack = 0.03 if abs(turns) < 4 else 0.1
                difference = ours.get(turns, 0.0) - expected[k].get(turns, 0.0)
                assert abs(difference) < slack, (name, k, turns)


def test_where_a_phase_with_its_range_is_found() -> None:
    walk = Walk(np.array([0.8, 4.5]), 0.3, 0.2, 1)
    rows = rows_at(walk, 0, 0.1)
    assert phase_place(rows) == 1
    assert phase_place(rows[[2, 3, 0, 1]]) == 3
    assert phase_place(rows[1:]) == -1
    assert phase_place(rows[:1]) == -1
    assert most_turns(rows[1]) == 5


def test_a_fix_has_a_component_in_every_sector_as_probable_as_its_area() -> None:
    """Place, covariance and area of each number of turns; nothing behind the ends."""
    walk = Walk(np.array([0.8, 4.5]), 0.3, 0.2, 1)
    rows, config = rows_at(walk, 0, 0.1), TrackerConfig(**CONFIG)
    start = pose_state(config, np.zeros(2), np.eye(2))
    fix = sectors_of_fix(*start, rows, 1, options_of(config))
    places, logs = [], []
    for turns in range(-6, 7):
        point, cov = np.empty(2), np.empty((2, 2))
        if place(rows[0], rows[1], turns, config.device_height_m, point, cov):
            places.append(point)
            logs.append(0.5 * np.linalg.slogdet(cov)[1])
    np.testing.assert_allclose(fix.means[:, :2], places, rtol=1e-12)
    np.testing.assert_allclose(fix.log_weights, logs - logsumexp(logs), rtol=1e-9)
    nearest = np.hypot(*(np.array(places) - walk.position[0]).T).min()
    assert nearest < 0.3
    rows[0, VALUE] = 0.01  # nearer than half the baseline
    assert sectors_of_fix(*start, rows, 1, options_of(config)).log_weights.size == 0


def informed(mean: Array, cov: Array, z: Array, H: Array) -> tuple[Array, Array]:
    """What a measurement of unit variances makes of a state: the information form."""
    posterior = np.linalg.inv(np.linalg.inv(cov) + H.T @ H)
    return mean + posterior @ H.T @ (z - H @ mean), posterior


class Epoch:
    """One epoch of a walk, as an estimate sees it that knows the place to ``sd``."""

    def __init__(self, sd: float, range_off_m: float = 0.0, name: str = "iekf") -> None:
        self.walk = Walk(np.array([-0.8, 4.5]), 0.3, 0.2, 1)
        self.rows = rows_at(self.walk, 0, 0.05)
        config = {"filter": name, "initial_speed_sd_mps": 1.5, "device_height_m": 0.0}
        self.options: FilterOptions = options_of(
            TrackerConfig(**config, sector_slip_probability=SLIP, manoeuvre_speed_sd_mps=0.0)
        )
        for row in self.rows[:2]:
            state = np.array([-0.8, 4.5, 0.0, 0.0, 0.0, 0.0])
            row[VALUE] = predict_row(row, state, 0.0, np.empty(6))
        self.turns = round(self.rows[1, VALUE] / TURN)
        self.rows[:2, VALUE] += range_off_m, -TURN * self.turns
        self.prior = np.array([-0.79, 4.48, *self.walk.velocity, 0.0, 0.0])
        self.cov = np.diag([sd, sd, 0.1, 0.1, 1.0, 1.0]) ** 2
        self.accepted = np.full(int(self.rows[-1, GROUP]) + 1, 9.0)

    def unwrapped(self, turns: int) -> Array:
        rows = self.rows.copy()
        rows[1, KIND] = Kind.UNWRAPPED_PHASE
        rows[1, VALUE] += TURN * turns
        return rows

    def applied(self) -> Update:
        before = self.rows.copy()
        prior, epoch = one_component(self.prior, self.cov), EpochInput(0.1, 0.1, 0.1, 0, self.rows)
        found: Update = apply_epoch(prior, epoch, self.options, self.accepted)
        np.testing.assert_array_equal(self.rows, before)
        return found

    def placed(self, turns: int) -> tuple[Array, Array] | None:
        """A device put where range and phase say, then told the velocity."""
        mean, cov, rows = self.prior.copy(), self.cov.copy(), self.unwrapped(turns)
        if init_hypothesis(mean, cov, rows[0], rows[1], 0, 1.5, 0.0) == -math.inf:
            return None
        H = np.eye(2, 6, k=2) / 0.05
        return informed(mean, cov, self.walk.velocity / 0.05, H)

    def fixed(self, turns: int) -> tuple[Array, Array, float]:
        """The device told where range and phase say, and the velocity; the log density of range
        and phase."""
        point, R, rows = np.empty(2), np.empty((2, 2)), self.unwrapped(turns)
        assert place(rows[0], rows[1], 0, 0.0, point, R)
        root = np.linalg.inv(np.linalg.cholesky(R))
        H = np.vstack([root @ np.eye(2, 6), np.eye(2, 6, k=2) / 0.05])
        told = np.concatenate([root @ point, self.walk.velocity / 0.05])
        S = self.cov[:2, :2] + R
        density = stats.multivariate_normal.logpdf(point, self.prior[:2], S)
        area = 0.5 * np.linalg.slogdet(R)[1] - 0.5 * math.log(np.prod(rows[:2, VARIANCE]))
        return *informed(self.prior, self.cov, told, H), float(density + area)


@pytest.mark.parametrize("name", ["iekf", "srukf"])
def test_sectors_nobody_knows_of_are_placed_anew(name: str) -> None:
    """The component that is there takes the measurement; every other sector is put where range and
    phase say, as probable as a slip, if that is a place at all."""
    epoch = Epoch(0.03, name=name)
    found = epoch.applied()
    assert (found.used, epoch.accepted.tolist()) == (4, [1.0, 1.0])
    turns = turns_of(found.components.means, epoch.rows[1], 0.0).tolist()
    assert len(set(turns)) == len(turns) == 8
    for m in set(range(-5, 6)) - {epoch.turns}:
        expected = epoch.placed(m)
        assert (expected is not None) is (m in turns)
        if expected is None:
            continue
        k = turns.index(m)
        np.testing.assert_allclose(found.components.means[k], expected[0], rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(found.components.covs[k], expected[1], rtol=1e-7, atol=1e-9)
        assert math.exp(found.components.log_weights[k]) == pytest.approx(SLIP, rel=2e-3)


def test_a_component_that_reaches_several_sectors_is_weighed_in_each() -> None:
    """Within 0.6 m a tangent does not hold: the fix of each number of turns is fused, by its
    density; the sectors out of reach are as probable as a slip."""
    epoch = Epoch(0.6)
    found = epoch.applied()
    turns = turns_of(found.components.means, epoch.rows[1], 0.0).tolist()
    weights = np.exp(found.components.log_weights)
    near = [m for m in turns if weights[turns.index(m)] > 10.0 * SLIP]
    assert len(near) > 1
    logs = np.array([epoch.fixed(m)[2] for m in near])
    share = weights[[turns.index(m) for m in near]]
    np.testing.assert_allclose(
        share / share.sum(), np.exp(logs - logsumexp(logs)), rtol=1e-3, atol=1e-6
    )
    for m in near:
        mean, cov, _ = epoch.fixed(m)
        k = turns.index(m)
        np.testing.assert_allclose(found.components.means[k], mean, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(found.components.covs[k], cov, rtol=1e-7, atol=1e-9)
    assert weights.min() > 0.9 * SLIP


def test_what_the_leader_refuses_places_nobody() -> None:
    """A range 3 m off is an outlier of the one component that is there."""
    epoch = Epoch(0.03, range_off_m=3.0)
    found = epoch.applied()
    assert epoch.accepted.tolist() == [0.0, 1.0]
    assert found.components.log_weights.tolist() == [0.0]
    assert found.used == 2


def test_a_wrong_sector_that_is_sure_of_itself_gives_way() -> None:
    """No sector is less probable than a slip, so that the right one wins within some steps."""
    walk = Walk(np.array([0.5, 4.0]), 0.2, 4.0, 1)
    sine = math.sin(math.atan2(*walk.start)) + 1.0 / 4.0
    wrong = np.hypot(*walk.start) * np.array([sine, math.sqrt(1 - sine**2)])
    mean = np.array([*wrong, *walk.velocity, 0.0, 0.0])
    cov = np.diag([0.1, 0.1, 0.2, 0.2, 1.0, 1.0]) ** 2
    estimate = estimates.Estimate(TrackerConfig(**CONFIG), T0, mean, cov)
    for k in range(40):
        rows = rows_at(walk, k, 0.05)
        estimate.step(T0 + k * DT_NS, 0.1, 0, rows, NO_BIAS)
        ours = probabilities(estimate.components, rows[1])
        truth = np.array([[*walk.position[k], 0.0, 0.0, 0.0, 0.0]])
        right = ours[int(turns_of(truth, rows[1], 0.0)[0])]
        assert right > 0.9e-6
        assert k > 0 or right < 1e-5
    assert right > 0.99
    assert estimate.modes == ()
