"""ManoeuvreHypotheses of the estimate: the rules once more in plain NumPy."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import pytest
from netpos.filters import ekf
from netpos.filters.manoeuvre import detection_delay_s
from netpos.filters.measurement import GROUP
from netpos.filters.motion import Model, Parameter
from netpos.filters.rows import linear_rows
from netpos.filters.state import X
from netpos.messages.values import Array
from netpos.tracking import TrackerConfig
from netpos.tracking import manoeuvre_hypotheses as module
from netpos.tracking.engine import GATE_SIZE
from netpos.tracking.estimates import KalmanEstimate
from netpos.tracking.manoeuvre_hypotheses import (
    BEGUN,
    SELECTED,
    Hypotheses,
    ManoeuvreHypotheses,
    hypothesis_level,
    is_needed,
    no_hypotheses,
)
from netpos.tracking.models import motions_of, options_of
from netpos.tracking.protection import FusedEpoch, gaussian_radius
from scipy.stats import multivariate_normal

CONFIG = TrackerConfig(
    manoeuvre_speed_sd_mps=5.0, accel_density_mps2_sqrthz=0.1, integrity_risk=1e-4
)
MOTION, OPTIONS, NO_BIAS = motions_of(CONFIG)[0], options_of(CONFIG), np.zeros((2, 0))
H = np.eye(6)[[0, 1]] + 0.3 * np.eye(6)[[4, 4]]
R = np.diag([0.2, 0.3]) ** 2
DT, RISK = 0.1, 1e-4


def neg2_log_likelihood(z: Array, mean: Array, cov: Array) -> float:
    """Minus twice the log density, the distance cut off at the gate."""
    S = H @ cov @ H.T + R
    distance = float((z - H @ mean) @ np.linalg.solve(S, z - H @ mean))
    density = multivariate_normal(H @ mean, S).logpdf(z)
    return float(-2.0 * density - distance + min(distance, OPTIONS.gate_nis[2]))


def updated(z: Array, mean: Array, cov: Array) -> tuple[Array, Array]:
    S = H @ cov @ H.T + R
    K = np.linalg.solve(S, H @ cov).T
    return mean + K @ (z - H @ mean), cov - K @ S @ K.T


def opened(cov: Array, within_s: float) -> Array:
    """A velocity step of 5 m/s per axis at any time of the last ``within_s`` seconds: the mean
    over the times, by quadrature."""
    nodes, weights = np.polynomial.legendre.leggauss(3)
    total = cov.copy()
    for s, w in zip(within_s * (nodes + 1.0) / 2.0, weights / 2.0, strict=True):
        G = np.zeros((6, 2))
        G[[0, 1], [0, 1]], G[[2, 3], [0, 1]] = s, 1.0
        total += w * 25.0 * G @ G.T
    return total


@dataclass
class Plain:
    """The hypotheses by the rules: means, covariances and log odds in eight places."""

    hypotheses: list[tuple[Array, Array, float] | None] = field(default_factory=lambda: [None] * 8)
    begun_ns: int = 0
    selected: int | None = None

    def step(self, stamp_ns: int, z: Array, rows: Array, prior: tuple[Array, Array]) -> None:
        mean, cov = prior
        own = neg2_log_likelihood(z, mean, cov)
        for i, hypothesis in enumerate(self.hypotheses):
            if hypothesis is None:
                continue
            x, P, odds = hypothesis
            ekf.predict(x, P, DT, MOTION.copy(), NO_BIAS)
            odds = min(odds + (own - neg2_log_likelihood(z, x, P)) / 2.0, 50.0)
            self.hypotheses[i] = (x, P, odds) if odds >= math.log(RISK) else None
        self._begin(stamp_ns, z, rows, prior)
        for i, hypothesis in enumerate(self.hypotheses):
            if hypothesis is not None:
                self.hypotheses[i] = (*updated(z, *hypothesis[:2]), hypothesis[2])
        odds = [
            -math.inf if hypothesis is None else hypothesis[2] for hypothesis in self.hypotheses
        ]
        if self.selected is None or odds[self.selected] <= 0.0:
            best = int(np.argmax(odds))
            self.selected = best if odds[best] > -math.log(RISK) else None

    def _begin(self, stamp_ns: int, z: Array, rows: Array, prior: tuple[Array, Array]) -> None:
        mean, cov = prior
        S = H @ cov @ H.T + R
        unusual = (z - H @ mean) @ np.linalg.solve(S, z - H @ mean) > 4.0
        since_s = (stamp_ns - self.begun_ns) * 1e-9
        if not unusual and since_s < 0.25:
            return
        window_s = max(DT, min(since_s, 0.25))
        if unusual:
            args = (rows, 0.0, OPTIONS.gate_nis[2], 5.0, np.empty(6))
            window_s = max(window_s, detection_delay_s(mean, cov, *args)[1])
        wide = opened(cov, window_s)
        own, fresh = neg2_log_likelihood(z, mean, cov), neg2_log_likelihood(z, mean, wide)
        odds = math.log(window_s / 30.0) + (own - fresh) / 2.0
        known = [
            -math.inf if hypothesis is None else hypothesis[2] for hypothesis in self.hypotheses
        ]
        least = int(np.argmin(known))
        if odds > max(known[least], math.log(RISK)):
            self.hypotheses[least], self.begun_ns = (mean.copy(), wide, odds), stamp_ns
            self.selected = None if self.selected == least else self.selected

    def reach(self, level: float, mean: Array) -> float:
        """Radius round what is reported, ``level`` being one round ``mean``."""
        selected = None if self.selected is None else self.hypotheses[self.selected]
        middle = mean if selected is None else selected[0]
        radius = level + math.hypot(*(middle - mean)[:2])
        for hypothesis in self.hypotheses:
            if hypothesis is None:
                continue
            x, P, odds = hypothesis
            share = RISK / min(math.exp(odds), 1.0)
            if share < 0.5:
                own = gaussian_radius(P[X.PX, X.PX], P[X.PX, X.PY], P[X.PY, X.PY], share)
                radius = max(radius, math.hypot(*(x - middle)[:2]) + own)
        return float(radius)


def drifting(k: int) -> float:
    """A device that drifts away, jumps back and forth, and is then where the estimate says."""
    return 0.02 * max(k - 20, 0) ** 1.5 if k < 45 else 3.0 * (50 <= k < 53)


def wrong_epoch(rows: Array, nis: float = 200.0) -> FusedEpoch:
    """All groups of ``rows`` accepted by an estimate at the origin, sure of it."""
    accepted = np.ones(int(rows[-1, GROUP]) + 1)
    return FusedEpoch(np.zeros(6), 0.01 * np.eye(6), rows, accepted, DT, np.zeros(6), nis, 2)


def test_hypotheses_follow_the_rules() -> None:
    """The estimate goes straight on, sure of it."""
    rng = np.random.default_rng(11)
    hypotheses, plain = no_hypotheses(6, 0), Plain()
    mean, cov = np.zeros(6), np.diag([0.1, 0.1, 0.05, 0.05, 0.3, 0.1]) ** 2
    seen = []
    for k in range(120):
        ekf.predict(mean, cov, DT, MOTION.copy(), NO_BIAS)
        prior, stamp_ns = (mean.copy(), cov.copy()), 100_000_000 * (k + 1)
        away = drifting(k)
        z = H @ mean + [away, -0.3 * away] + rng.multivariate_normal(np.zeros(2), R)
        rows = linear_rows(z, R, H, 0)
        S = H @ cov @ H.T + R
        nis = float((z - H @ mean) @ np.linalg.solve(S, z - H @ mean))
        cov = updated(z, mean, cov)[1]  # the estimate learns nothing of where it is
        epoch = FusedEpoch(*prior, rows, np.ones(1), DT, mean, nis, 2)
        got = hypothesis_level(1.0, stamp_ns, DT, epoch, MOTION, NO_BIAS, OPTIONS, hypotheses)
        plain.step(stamp_ns, z, rows, prior)
        assert got == pytest.approx(plain.reach(1.0, mean), rel=1e-6)
        assert hypotheses.marks[SELECTED] == (-1 if plain.selected is None else plain.selected)
        assert hypotheses.marks[BEGUN] == plain.begun_ns
        for i, hypothesis in enumerate(plain.hypotheses):
            odds = -math.inf if hypothesis is None else hypothesis[2]
            assert hypotheses.odds[i] == pytest.approx(odds, rel=1e-6, abs=1e-6)
        led = hypotheses.marks[SELECTED]
        apart = 0.0 if led < 0 else math.hypot(*(hypotheses.means[led] - mean)[:2])
        seen.append((hypotheses.odds.max(), got, led, apart))
    odds, levels, chosen, apart = np.array(seen).T
    assert odds[:20].max() < 0.0
    assert odds[44] == 50.0
    assert levels[44] > 3.0
    assert chosen[:20].max() == -1.0
    assert apart[44] == pytest.approx(math.hypot(1.0, 0.3) * drifting(44), abs=0.5)
    assert chosen[-1] == -1.0


def test_an_inertial_model_has_no_hypotheses() -> None:
    motion, hypotheses = MOTION.copy(), no_hypotheses(6, 0)
    motion[Parameter.MODEL] = Model.INERTIAL
    epoch = wrong_epoch(linear_rows(np.array([3.0, 3.0]), R, H, 0))
    args = 1.0, 100_000_000, DT, epoch
    assert hypothesis_level(*args, motion, NO_BIAS, OPTIONS, hypotheses) == 1.0
    assert hypothesis_level(*args, MOTION, NO_BIAS, OPTIONS, hypotheses) > 1.0


def test_no_hypothesis_begins_where_two_measurements_tell_the_place() -> None:
    """One that has begun is carried on."""
    rows, twice = linear_rows(np.array([3.0, 3.0]), R, H, 0), linear_rows(np.full(2, 3.0), R, H, 0)
    twice[1, GROUP] = 1
    hypotheses = no_hypotheses(6, 0)
    for k, (own, begins) in enumerate(((twice, False), (rows, True), (twice, True))):
        stamp_ns = 100_000_000 * (k + 1)
        epoch = wrong_epoch(own)
        assert is_needed(stamp_ns, epoch, hypotheses) is begins
        level = hypothesis_level(1.0, stamp_ns, DT, epoch, MOTION, NO_BIAS, OPTIONS, hypotheses)
        assert (level > 1.0) is begins


def test_two_measurements_end_a_hypothesis_within_the_level() -> None:
    rows, twice = linear_rows(np.array([3.0, 3.0]), R, H, 0), linear_rows(np.full(2, 3.0), R, H, 0)
    twice[1, GROUP] = 1
    hypotheses = no_hypotheses(6, 0)
    for k, (level, own) in enumerate(((1.0, rows), (99.0, rows), (1.0, twice), (99.0, twice))):
        stamp_ns, epoch = 100_000_000 * (k + 1), wrong_epoch(own)
        reached = hypothesis_level(
            level, stamp_ns, DT, epoch, MOTION, NO_BIAS, OPTIONS, hypotheses
        )
        gone = level == 99.0 and own is twice
        assert math.isinf(hypotheses.odds.max()) is gone
    assert hypotheses.marks[SELECTED] == -1
    assert reached == 99.0


@pytest.mark.parametrize(("stamp_ns", "begins"), [(249_999_999, False), (250_000_000, True)])
def test_a_hypothesis_begins_from_time_to_time(stamp_ns: int, begins: bool) -> None:
    """Of single measurements that fit, and of none where nothing was accepted."""
    fits, hypotheses = wrong_epoch(linear_rows(np.zeros(2), R, H, 0), nis=1.0), no_hypotheses(6, 0)
    assert is_needed(stamp_ns, fits, hypotheses) is begins
    assert not is_needed(stamp_ns, fits._replace(nis=0.0, dof=0), hypotheses)


def test_hypotheses_are_held_while_nothing_is_accepted() -> None:
    """They move on, and the level with them."""
    hypotheses, rows = no_hypotheses(6, 0), linear_rows(np.array([3.0, 3.0]), R, H, 0)
    levels, epoch = [], wrong_epoch(rows)
    nothing = epoch._replace(accepted=np.zeros(1), nis=0.0, dof=0)
    for k, some in enumerate((epoch, nothing, nothing)):
        stamp_ns = 100_000_000 * (k + 1)
        levels.append(
            hypothesis_level(1.0, stamp_ns, DT, some, MOTION, NO_BIAS, OPTIONS, hypotheses)
        )
    assert 1.0 < levels[0] < levels[1] < levels[2]


def _turned(
    estimate: KalmanEstimate, hypotheses: ManoeuvreHypotheses, away: float, stamps: range
) -> None:
    """Measurements ``away`` of an estimate that does not move."""
    for k in stamps:
        rows, stamp_ns = linear_rows(np.array([away, 0.0]), R, H, 0), 100_000_000 * k
        before = estimate.mean.copy(), estimate.cov.copy()
        nis, dof, taken = estimate.step(stamp_ns, DT, 0, rows, NO_BIAS)
        epoch = FusedEpoch(*estimate.prior, rows, taken.copy(), DT, estimate.mean, nis, dof)
        hypotheses.level(1.0, stamp_ns, estimate, epoch, NO_BIAS)
        estimate.mean[:], estimate.cov[:] = before


def test_the_hypothesis_that_has_won_is_reported() -> None:
    estimate, hypotheses = (
        KalmanEstimate(CONFIG, 0, np.zeros(6), 0.01 * np.eye(6)),
        ManoeuvreHypotheses(CONFIG),
    )
    _turned(estimate, hypotheses, 0.0, range(1, 3))
    mean, cov = hypotheses.reported(200_000_000, estimate, NO_BIAS)
    assert mean is estimate.mean
    assert cov is estimate.cov
    _turned(estimate, hypotheses, 0.8, range(3, 60))
    mean, cov = hypotheses.reported(5_900_000_000, estimate, NO_BIAS)
    assert mean[X.PX] == pytest.approx(0.8 - 0.3 * mean[X.CLOCK], abs=0.05)
    later, wider = hypotheses.reported(6_900_000_000, estimate, NO_BIAS)
    ekf.predict(mean, cov, 1.0, MOTION.copy(), NO_BIAS)
    np.testing.assert_allclose(later, mean)
    np.testing.assert_allclose(wider, cov)
    estimate.augment(np.array([1.0]))
    assert hypotheses.reported(5_900_000_000, estimate, NO_BIAS)[0] is estimate.mean


@pytest.mark.parametrize(
    ("odds", "before", "after"),
    [
        ([9.2, -math.inf], -1, -1),
        ([9.22, -math.inf], -1, 0),
        ([9.22, 9.3], -1, 1),
        ([9.3, 9.22], -1, 0),
        ([0.01, 9.3], 0, 0),
        ([0.0, 9.3], 0, 1),
        ([0.0, 9.2], 0, -1),
        ([-math.inf, -math.inf], 1, -1),
    ],
)
def test_a_hypothesis_leads_from_certain_to_even(
    odds: list[float], before: int, after: int
) -> None:
    """-ln(1e-4) is 9.21."""
    marks = np.array([before, 0])
    module._select(RISK, np.array(odds), marks)
    assert marks.tolist() == [after, 0]


@pytest.mark.parametrize(("nis", "begins"), [(5.99, False), (6.01, True)])
def test_a_hypothesis_begins_where_twice_the_usual_is_exceeded(nis: float, begins: bool) -> None:
    rows, hypotheses, mean = linear_rows(np.zeros(2), R, H, 0), no_hypotheses(6, 0), np.zeros(6)
    epoch = FusedEpoch(mean, np.eye(6), rows, np.ones(1), DT, mean, nis, 3)
    assert is_needed(1, epoch, hypotheses) is begins
    hypotheses.odds[1] = 0.0
    assert is_needed(1, epoch, hypotheses)


def test_a_turn_that_shows_at_once_may_lie_since_the_last_beginning() -> None:
    """0.1 s, where 5 ms are enough to show one of 500 m/s and 20 ms have passed unheard."""
    hypotheses, z, mean, cov = (
        no_hypotheses(6, 900_000_000),
        np.full(2, 3.0),
        np.zeros(6),
        np.eye(6) / 100,
    )
    options, rows = OPTIONS._replace(manoeuvre_speed_sd=500.0), linear_rows(z, R, H, 0)
    epoch = FusedEpoch(mean, cov, rows, np.ones(1), 0.02, mean, 200.0, 2)
    hypothesis_level(0.0, 1_000_000_000, DT, epoch, MOTION, NO_BIAS, options, hypotheses)
    wide = cov + 100.0**2 * (opened(cov, 0.1) - cov)
    odds = (
        math.log(0.1 / 30.0)
        + (neg2_log_likelihood(z, mean, cov) - neg2_log_likelihood(z, mean, wide)) / 2.0
    )
    assert hypotheses.odds.max() == pytest.approx(odds)


def present(mean: Array) -> Hypotheses:
    """The second hypothesis, at ``mean``."""
    hypotheses = no_hypotheses(6, 0)
    hypotheses.means[1], hypotheses.covs[1], hypotheses.odds[1] = mean, 0.01 * np.eye(6), 3.0
    return hypotheses


@pytest.mark.parametrize(("margin", "ends"), [(-1e-9, False), (1e-9, True)])
def test_a_hypothesis_ends_within_the_level(margin: float, ends: bool) -> None:
    mean = np.array([700.0, -300.0, 4.0, 1.0, 2.0, 0.1])
    hypotheses = present(mean + np.array([3.0, -4.0, 0.0, 0.0, 0.0, 0.0]))
    level = 5.0 + gaussian_radius(0.01, 0.0, 0.01, RISK) + margin
    module._dismiss(level, mean, RISK, hypotheses)
    assert math.isinf(hypotheses.odds[1]) is ends


def test_the_level_about_a_selected_holds_that_about_the_estimate() -> None:
    mean = np.array([700.0, -300.0, 4.0, 1.0, 2.0, 0.1])
    hypotheses = present(mean + np.array([3.0, -4.0, 0.0, 0.0, 0.0, 0.0]))
    hypotheses.marks[SELECTED] = 1
    assert module._reach(2.0, mean, RISK, hypotheses) == pytest.approx(7.0)


def test_a_selected_whose_place_is_taken_leads_no_more() -> None:
    rows, cov = linear_rows(np.array([3.0, 3.0]), R, H, 0), np.eye(6) * 0.01
    hypotheses = no_hypotheses(6, 0)
    hypotheses.odds[:] = [0.3, 0.1, *([0.4] * 6)]
    for selected, after in ((0, 0), (1, -1)):
        hypotheses.odds[1], hypotheses.marks[SELECTED] = 0.1, selected
        args = (np.zeros(6), cov, rows, 30.0, 100.0, OPTIONS, hypotheses)
        assert module._begin(*args)
        assert hypotheses.marks[SELECTED] == after


def carried_on(hypotheses: Hypotheses, mean: Array, motion: Array, dof: int = 0) -> float:
    """Level of an epoch with all or nothing accepted, an own one of half a metre."""
    rows = linear_rows(np.zeros(2), R, H, 0)
    accepted = np.full(1, 1.0 if dof else 0.0)
    epoch = FusedEpoch(mean, 0.01 * np.eye(6), rows, accepted, DT, mean, 0.0, dof)
    return float(
        hypothesis_level(0.5, 100_000_000, DT, epoch, motion, NO_BIAS, OPTIONS, hypotheses)
    )


def test_the_level_reaches_from_the_estimate_to_the_far_side_of_a_hypothesis() -> None:
    """Anywhere; the velocity step of the estimate's own second look is none of the
    hypothesis's."""
    mean = np.array([700.0, -300.0, 4.0, 1.0, 2.0, 0.1])
    hypotheses, motion = present(mean), MOTION.copy()
    hypotheses.means[1, :4] += 30.0, 40.0, 1.0, -2.0
    expected, cov = hypotheses.means[1].copy(), 0.01 * np.eye(6)
    ekf.predict(expected, cov, DT, MOTION.copy(), NO_BIAS)
    motion[Parameter.VELOCITY_STEP_SD] = 50.0
    kept = motion.copy()
    level = carried_on(hypotheses, mean, motion)
    apart = math.hypot(30.0 + 5.0 * DT, 40.0 - 1.0 * DT)
    assert level == pytest.approx(apart + gaussian_radius(*cov[[0, 0, 1], [0, 1, 1]], RISK))
    np.testing.assert_allclose(hypotheses.means[1], expected, rtol=1e-12)
    np.testing.assert_allclose(hypotheses.covs[1], cov, rtol=1e-12)
    assert hypotheses.odds[:3].tolist() == [-math.inf, 3.0, -math.inf]
    assert hypotheses.marks.tolist() == [-1, 0]
    np.testing.assert_array_equal(motion, kept)


def test_a_hypothesis_that_cannot_be_a_device_is_given_up() -> None:
    hypotheses = present(np.array([0.0, 0.0, 3.1e8, 0.0, 0.0, 0.0]))
    assert carried_on(hypotheses, np.zeros(6), MOTION, dof=2) == 0.5
    assert hypotheses.odds.max() == -math.inf


def test_an_array_of_many_antennas_is_weighed_by_the_last_bound() -> None:
    """Seventy rows of one measurement of a device that has turned: more than the gate has bounds
    for."""
    rng, m = np.random.default_rng(3), 70
    wide_H = rng.normal(size=(m, 6))
    z, hypotheses = wide_H @ np.array([0.0, 0.0, 3.0, -2.0, 0.0, 0.0]), no_hypotheses(6, 0)
    rows, cov, prior = linear_rows(z, np.eye(m), wide_H, 0), 0.01 * np.eye(6), np.zeros(6)
    epoch = FusedEpoch(prior, cov, rows, np.ones(1), DT, prior, 1e4, m)
    hypothesis_level(1.0, 100_000_000, DT, epoch, MOTION, NO_BIAS, OPTIONS, hypotheses)
    _, longest_s = detection_delay_s(prior, cov, rows, 0.0, OPTIONS.gate_nis[2], 5.0, np.empty(6))
    window_s, sizes = max(DT, longest_s), []
    for P in (cov, opened(cov, window_s)):
        S = wide_H @ P @ wide_H.T + np.eye(m)
        distance = min(z @ np.linalg.solve(S, z), OPTIONS.gate_nis[GATE_SIZE - 1])
        sizes.append(distance + np.linalg.slogdet(2.0 * math.pi * S)[1])
    gained = (sizes[0] - sizes[1]) / 2.0
    assert gained > 0.0
    assert hypotheses.odds[0] == pytest.approx(gained + math.log(window_s / 30.0), rel=1e-9)


def test_a_copy_goes_its_own_way_and_a_new_state_starts_anew() -> None:
    estimate, hypotheses = (
        KalmanEstimate(CONFIG, 0, np.zeros(6), 0.01 * np.eye(6)),
        ManoeuvreHypotheses(CONFIG),
    )

    def epoch(of: ManoeuvreHypotheses, on: KalmanEstimate, k: int, z: float) -> float:
        rows, stamp_ns = linear_rows(np.array([z, 0.0]), R, H, 0), 100_000_000 * k
        bias = np.tile([[1.0], [100.0]], (1, on.mean.size - 6))
        nis, dof, taken = on.step(stamp_ns, DT, 0, rows, bias)
        fused = FusedEpoch(*on.prior, rows, taken.copy(), DT, on.mean, nis, dof)
        return of.level(1.0, stamp_ns, on, fused, bias)

    for k in (1, 2):
        epoch(hypotheses, estimate, k, 1.2)
    kept = epoch(hypotheses.copy(), estimate.copy(), 3, 1.2)
    epoch(hypotheses.copy(), estimate.copy(), 3, -2.0)
    assert epoch(hypotheses.copy(), estimate.copy(), 3, 1.2) == kept
    assert epoch(ManoeuvreHypotheses(CONFIG), estimate.copy(), 3, 1.2) != kept
    estimate.augment(np.array([1.0]))
    new = epoch(ManoeuvreHypotheses(CONFIG), estimate.copy(), 3, 1.2)
    assert epoch(hypotheses, estimate, 3, 1.2) == new
