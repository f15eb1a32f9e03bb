"""Protection level against integration, Monte Carlo and its limits; what widens it."""

from __future__ import annotations

import math

import filter_rows
import numpy as np
import pytest
from curved_rows import bends, values_of_a_bend
from engine_cases import opened
from hypothesis import given, settings
from hypothesis import strategies as st
from netpos.estimation.engine import FilterOptions
from netpos.estimation.level.manoeuvre import detection_delay_s
from netpos.estimation.level.protection import (
    RISK_MIN,
    FusedEpoch,
    gaussian_radius,
    gaussian_tail,
    level_scratch,
    manoeuvre_level,
    mixture_radius,
    protection_level,
    radius_limit,
)
from netpos.estimation.measurement import (
    GROUP,
    SAME_BEND,
    VALUE,
    VARIANCE,
    Kind,
    curvature_variance,
    linearise,
)
from netpos.estimation.mixture.gaussians import Mixture
from netpos.estimation.motion import NO_BIAS
from netpos.estimation.rows import linear_rows, rsu_axes, rsu_rows
from netpos.estimation.state import POSITION, X
from netpos.estimation.update.fit import innovations_with_sd
from netpos.estimation.update.predicted import predicted_rows
from netpos.messages.values import Array, Field, RsuInfo, RsuMeasurement
from netpos.tracking import TrackerConfig
from netpos.tracking.estimators import estimates
from netpos.tracking.estimators.models import options_of
from scipy import integrate, optimize, stats

RISKS = [0.5, 0.1, 1e-2, 1e-4, 1e-7, 1e-12]


def exceedance(sd_x: float, sd_y: float, r: float) -> float:
    """P(|e| > r) of independent components: the tail in x, and for each x inside the tail in y."""

    def tail_in_y(t: float) -> float:
        x = r * math.sin(t)
        return (2 * stats.norm.pdf(x, 0, sd_x) * 2 * stats.norm.sf(r * math.cos(t), 0, sd_y)) * (
            r * math.cos(t)
        )

    inside, _ = integrate.quad(tail_in_y, 0.0, math.pi / 2, epsabs=0.0, epsrel=1e-10, limit=400)
    return float(2 * stats.norm.sf(r, 0, sd_x) + inside)


def rotated(sd_x: float, sd_y: float, angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    R = np.array([[c, -s], [s, c]])
    cov: Array = R @ np.diag([sd_x**2, sd_y**2]) @ R.T
    return cov


@pytest.mark.parametrize("risk", RISKS)
@pytest.mark.parametrize("ratio", [1.0, 0.8, 0.3, 0.1, 0.02])
def test_radius_against_integration(risk: float, ratio: float) -> None:
    level = protection_level(rotated(3.0, 3.0 * ratio, 0.7), risk)
    low, high = 3.0 * stats.norm.isf(risk / 2), 3.0 * math.sqrt(-2 * math.log(risk))
    log_risk = math.log(risk)
    expected = optimize.brentq(
        lambda r: math.log(exceedance(3.0, 3.0 * ratio, r)) - log_risk,
        low * 0.999,
        high * 1.001,
        xtol=1e-12,
    )
    assert level == pytest.approx(expected, rel=1e-5 if risk > 0.01 else 1e-9)


@pytest.mark.parametrize("risk", RISKS)
def test_limits(risk: float) -> None:
    circular = protection_level(4.0 * np.eye(2), risk)
    assert circular == pytest.approx(2.0 * math.sqrt(-2 * math.log(risk)), rel=1e-10)
    line = protection_level(rotated(2.0, 0.0, 1.1), risk)
    assert line == pytest.approx(2.0 * stats.norm.isf(risk / 2), rel=1e-5)
    assert protection_level(np.zeros((2, 2)), risk) == 0.0


@pytest.mark.parametrize("risk", RISKS)
def test_no_radius_exceeds_that_of_a_circle(risk: float) -> None:
    for ratio in (1.0, 0.5, 0.0):
        cov = rotated(3.0, 3.0 * ratio, 0.7)
        sides = cov[X.PX, X.PX], cov[X.PX, X.PY], cov[X.PY, X.PY], risk
        assert radius_limit(*sides) == pytest.approx(3.0 * math.sqrt(-2.0 * math.log(risk)))
        assert gaussian_radius(*sides) <= radius_limit(*sides) * (1.0 + 1e-12)


def test_monte_carlo() -> None:
    rng = np.random.default_rng(11)
    cov = rotated(1.5, 0.4, 2.0)
    errors = np.linalg.norm(rng.multivariate_normal(np.zeros(2), cov, size=1_000_000), axis=1)
    for risk in (0.3, 1e-2, 1e-3):
        count = int((errors > protection_level(cov, risk)).sum())
        low, high = stats.binom.interval(0.9999, errors.size, risk)
        assert low <= count <= high


# An angle below 1e-154 has a square of fewer digits, and the covariance made of both is none.
ANGLES = st.just(0.0) | st.floats(1e-9, math.pi)


@settings(max_examples=200, deadline=None)
@given(
    sd_x=st.floats(1e-3, 1e4),
    ratio=st.floats(0.0, 1.0),
    angle=ANGLES,
    risk=st.floats(RISK_MIN, 0.5),
    more=st.floats(0.0, 1.0),
    direction=ANGLES,
)
def test_monotone_in_covariance_and_risk(
    sd_x: float, ratio: float, angle: float, risk: float, more: float, direction: float
) -> None:
    cov = rotated(sd_x, ratio * sd_x, angle)
    level = protection_level(cov, risk)
    line, circle = stats.norm.isf(risk / 2), math.sqrt(-2 * math.log(risk))
    assert sd_x * line * (1 - 1e-5) <= level <= sd_x * circle * (1 + 1e-9)
    assert protection_level(cov, max(risk * (1 - more), RISK_MIN)) >= level * (1 - 1e-9)
    wider = cov + rotated(more * sd_x, 0.0, direction)
    assert protection_level(wider, risk) >= level * (1 - 1e-7)


@pytest.mark.parametrize(
    ("cov", "risk", "text"),
    [
        (np.diag([1.0, -1.0]), 1e-4, "cov2"),
        (np.array([[1.0, 2.0], [2.0, 1.0]]), 1e-4, "cov2"),
        (np.diag([1.0, np.nan]), 1e-4, "cov2"),
        (np.diag([1.0, np.inf]), 1e-4, "cov2"),
        (np.eye(2), 0.0, "risk"),
        (np.eye(2), 0.6, "risk"),
        (np.eye(2), math.nan, "risk"),
    ],
)
def test_unsound_input_is_refused(cov: Array, risk: float, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        protection_level(cov, risk)


# manoeuvres


def azimuth_row(x: float, y: float, sd_rad: float, mean: Array) -> Array:
    info = RsuInfo(rsu_id="a", position=np.array([x, y, 0.0]))
    m = RsuMeasurement(
        stamp_ns=1,
        rsu_id="a",
        vue_id="vue_1",
        fields=Field.AZIMUTH,
        azimuth_rad=math.atan2(mean[X.PY] - y, mean[X.PX] - x),
        azimuth_var=sd_rad**2,
    )
    return rsu_rows(m, info, rsu_axes(info), 0)


def test_a_manoeuvre_is_noticed_where_the_gate_begins_to_refuse() -> None:
    """Two bearings at right angles, a prior without width: 1 degree at 100 m and at 40 m. The
    weaker bearing alone sees a device that moves across it, and lets it pass until just then."""
    mean, cov, sd, gate = np.array([100.0, 0, 0, 0, 0, 0]), np.zeros((6, 6)), math.radians(1), 9.0
    rows = np.vstack([azimuth_row(0.0, 0.0, sd, mean), azimuth_row(100.0, 40.0, sd, mean)])
    speed = 2.5
    predicted = predicted_rows(mean, cov, rows, 0.0)
    typical, longest = detection_delay_s(rows, predicted, 6, gate, speed)
    assert longest == pytest.approx(3.0 * sd * 100.0 / speed, rel=1e-9)
    moved = mean.copy()
    moved[1] += longest * speed
    assert ((linearise(rows, moved, 0.0)[0] / sd) ** 2).sum() == pytest.approx(gate, rel=5e-3)
    # in no known direction: gate = speed^2 t^2 (1/a^2 + 1/b^2) / 2
    a, b = 100.0 * sd, 40.0 * sd
    expected = math.sqrt(gate / ((1 / a**2 + 1 / b**2) / 2)) / speed
    assert typical == pytest.approx(expected, rel=1e-9)
    wider = detection_delay_s(rows, predicted_rows(mean, np.eye(6), rows, 0.0), 6, gate, speed)
    assert wider[0] > typical
    assert wider[1] > longest


def options(gate_probability: float = 0.9999, speed: float = 4.0) -> FilterOptions:
    return options_of(
        TrackerConfig(
            gate_probability=gate_probability, manoeuvre_speed_sd_mps=speed, integrity_risk=1e-4
        )
    )


def fused(
    prior: Array, cov: Array, rows: Array, accepted: Array, unheard_s: float, mean: Array
) -> FusedEpoch:
    return FusedEpoch(prior, cov, rows, accepted, unheard_s, mean)


def level_of(epoch: FusedEpoch, said: FilterOptions) -> float:
    """``manoeuvre_level`` of an epoch."""
    predicted = predicted_rows(epoch.prior_mean, epoch.prior_cov, epoch.rows, said.height_m)
    _, longest_s = detection_delay_s(
        epoch.rows, predicted, epoch.mean.size, said.gate_nis[2], said.manoeuvre_speed_sd
    )
    memory = level_scratch(epoch.mean.size, len(epoch.rows))
    return float(manoeuvre_level(epoch, longest_s, said, memory))


@pytest.mark.parametrize("unheard_s", [0.1, 5.0])
def test_level_of_a_manoeuvre_is_a_second_answer_and_how_far_it_is(unheard_s: float) -> None:
    """Two position fixes, the second refused: the linear filter in NumPy."""
    prior = np.array([10.0, 20.0, 3.0, -1.0, 0.0, 0.0])
    cov = np.diag([0.04, 0.09, 0.2, 0.3, 1.0, 1.0])
    R, fix = np.diag([0.25, 0.16]), np.array([10.8, 19.5])
    first = linear_rows(fix, R, np.eye(2, 6), 0)
    second = linear_rows(fix + 100.0, R, np.eye(2, 6), 1)
    rows, accepted, mean = np.vstack([first, second]), np.array([1.0, 0.0]), prior + 0.1
    gate = stats.chi2.ppf(0.9999, 2)
    information = np.diag([1.0 / (0.04 + 0.25 / 2.0), 1.0 / (0.09 + 0.16 / 2.0)])
    within_s = max(unheard_s, math.sqrt(gate / information.diagonal().min()) / 4.0)
    wide = cov.copy()
    for p in (0, 1):
        wide[p, p] += 16.0 * within_s**2 / 3.0
        wide[p, p + 2] += 16.0 * within_s / 2.0
        wide[p + 2, p] += 16.0 * within_s / 2.0
        wide[p + 2, p + 2] += 16.0
    K = wide[:, :2] @ np.linalg.inv(wide[:2, :2] + R)
    x, P = prior + K @ (fix - prior[POSITION]), wide - K @ wide[:2]
    expected = np.linalg.norm(x[POSITION] - mean[POSITION]) + protection_level(
        P[POSITION, POSITION], 1e-4
    )
    level = level_of(fused(prior, cov, rows, accepted, unheard_s, mean), options())
    assert level == pytest.approx(expected, rel=1e-6)


def test_level_of_a_manoeuvre_with_biases_that_tell_nothing() -> None:
    """States beyond the six, known exactly: the level of six states."""
    prior, cov = np.array([10.0, 20.0, 3.0, -1.0, 0.0, 0.0]), np.diag([4.0, 9.0, 0.2, 0.3, 1, 1])
    rows = np.vstack([azimuth_row(-50.0, 0.0, 0.05, prior), azimuth_row(9.0, -80.0, 0.02, prior)])
    rows[:, VALUE] += 0.03, -0.01
    levels = []
    for n in (6, 8):
        mean, P = np.zeros(n), np.zeros((n, n))
        mean[:6], P[:6, :6] = prior, cov
        state = mean.copy()
        state[POSITION] += 0.7, -0.4
        epoch = fused(mean, P, rows, np.ones(2), 0.3, state)
        levels.append(level_of(epoch, options()))
        assert np.array_equal(mean[:6], prior)
        assert np.array_equal(P[:6, :6], cov)
    assert levels[0] == pytest.approx(levels[1], rel=1e-9)


def test_level_of_a_manoeuvre_is_linearised_at_its_own_answer() -> None:
    """RSUs some metres away, where bearings and ranges bend: the answer from the estimate, and
    once more from that answer with the curvature left at it, that of the range shared with
    another value. A third group is refused."""
    rng, said = np.random.default_rng(7), options()
    prior, cov = np.array([10.0, 20.0, 3.0, -1.0, 0.5, 0.1]), filter_rows.make_cov(rng, 6)
    rows = np.array(
        [
            filter_rows.row(Kind.AZIMUTH, 1.2, 0.02, 0, (7.0, 15.0, 0.0)),
            filter_rows.row(Kind.RANGE, 6.5, 0.3, 1, (12.0, 14.0, 3.0)),
            filter_rows.row(Kind.RANGE, 90.0, 0.3, 2, (0.0, 0.0, 3.0)),
        ]
    )
    rows[1, SAME_BEND] = 1.0
    accepted, mean, height_m = np.array([1.0, 1.0, 0.0]), prior + 0.4, said.height_m
    predicted = predicted_rows(prior, cov, rows, height_m)
    _, longest_s = detection_delay_s(rows, predicted, mean.size, said.gate_nis[2], 4.0)
    nodes, weights = np.polynomial.legendre.leggauss(3)
    times_s = longest_s * (nodes + 1.0) / 2.0
    wide = sum(w / 2.0 * opened(cov, 4.0, s) for s, w in zip(times_s, weights, strict=True))
    x, bent, longer, used = mean, np.zeros(2), np.zeros(2), rows[:2]
    for _ in range(2):
        z, H = linearise(used, x, height_m)
        z -= longer
        S = H @ wide @ H.T + np.diag(used[:, VARIANCE] + bent)
        x = prior + wide @ H.T @ np.linalg.solve(S, z + H @ (x - prior))
        P = wide - wide @ H.T @ np.linalg.solve(S, H @ wide)
        bent = np.array([curvature_variance(row, x, P, height_m) for row in used])
        bent *= values_of_a_bend(x, used)
        longer = bends(x, P, used, height_m)
    assert (bent[1:] > 0.01 * used[1:, VARIANCE]).all()
    expected = np.linalg.norm(x[POSITION] - mean[POSITION]) + protection_level(
        P[POSITION, POSITION], 1e-4
    )
    level = level_of(fused(prior, cov, rows, accepted, 0.1, mean), said)
    assert level == pytest.approx(expected, rel=1e-9)


def test_a_manoeuvre_nobody_could_notice() -> None:
    """Along a single bearing, or without a gate."""
    mean, accepted = np.array([100.0, 0, 0, 0, 0, 0]), np.ones(1)
    row = azimuth_row(0.0, 0.0, 0.01, mean)
    level = level_of(fused(mean, np.eye(6), row, accepted, 0.1, mean), options())
    assert math.isinf(level)
    fix = linear_rows(mean[POSITION], np.eye(2), np.eye(2, 6), 0)
    for probability, finite in ((1.0, False), (0.9999, True)):
        epoch = fused(mean, np.eye(6), fix, accepted, 0.1, mean)
        level = level_of(epoch, options(probability))
        assert math.isfinite(level) is finite


@pytest.mark.parametrize("speed", [0.0, 4.0])
def test_an_epoch_tells_its_innovations_and_the_level_of_a_manoeuvre(speed: float) -> None:
    """Both of the prediction, whose second group is refused: as each by itself."""
    prior, cov = np.array([10.0, 20.0, 3.0, -1.0, 0.0, 0.0]), np.diag([4.0, 9.0, 0.2, 0.3, 1, 1])
    rows = np.vstack([azimuth_row(-50.0, 0.0, 0.05, prior), azimuth_row(9.0, -80.0, 0.02, prior)])
    rows[:, GROUP] = 0, 1
    config = TrackerConfig(filter="ekf", manoeuvre_speed_sd_mps=speed, integrity_risk=1e-4)
    estimate, said = estimates.Estimate(config, 0, prior, cov), options_of(config)
    step = estimate.step(0, 0.0, 0, rows.copy(), NO_BIAS)
    fits = innovations_with_sd(prior, cov, rows, said.height_m)
    np.testing.assert_allclose(step.innovations, fits, rtol=1e-12)
    epoch = fused(prior, cov, rows, np.ones(2), 0.0, estimate.mean)
    assert step.undetected_m == pytest.approx(level_of(epoch, said) if speed else 0.0, rel=1e-9)


@pytest.mark.parametrize("where", ["mean", "cov"])
def test_nothing_is_told_of_what_is_not_sound(where: str) -> None:
    mean, cov = np.zeros(6), np.eye(6)
    if where == "mean":
        mean[X.VX] = 3e9
    else:
        cov[X.PY, X.PX] = cov[X.PX, X.PY] = 2.0
    row = azimuth_row(-50.0, 0.0, 0.05, np.zeros(6))
    estimate = estimates.Estimate(TrackerConfig(filter="ekf"), 0, mean, cov)
    assert math.isnan(estimate.step(0, 0.0, 0, row, NO_BIAS).undetected_m)


@pytest.mark.parametrize("risk", [0.3, 1e-2, 1e-4, 1e-8])
@pytest.mark.parametrize("sides", [(1.0, 0.0, 1.0), (4.0, 1.5, 1.0), (9.0, 0.0, 1e-6)])
def test_the_tail_beyond_a_radius_is_its_risk(
    sides: tuple[float, float, float], risk: float
) -> None:
    assert gaussian_tail(*sides, gaussian_radius(*sides, risk)) == pytest.approx(risk, rel=1e-4)
    assert gaussian_tail(*sides, 0.0) == 1.0
    assert gaussian_tail(0.0, 0.0, 0.0, 1.0) == 0.0


def test_the_radius_of_one_component_is_that_of_its_gaussian() -> None:
    cov = np.array([[4.0, 1.5], [1.5, 1.0]])
    found = mixture_radius(Mixture(np.zeros((1, 2)), cov[None], np.zeros(1)), np.zeros(2), 1e-3)
    assert found == pytest.approx(protection_level(cov, 1e-3), rel=1e-3)


@pytest.mark.parametrize("weights", [(0.5, 0.5), (0.9, 0.1), (0.999, 0.001)])
def test_the_radius_of_a_mixture_holds_its_samples(weights: tuple[float, float]) -> None:
    """At least as many as promised, and not by a radius much too large."""
    rng, risk, draws = np.random.default_rng(8), 1e-2, 400_000
    means = np.array([[0.0, 0.0], [6.0, -8.0]])
    covs = np.array([[[1.0, 0.3], [0.3, 0.5]], [[0.4, 0.0], [0.0, 2.0]]])
    chosen = rng.random(draws) < weights[1]
    first, second = (
        rng.multivariate_normal(m, P, draws) for m, P in zip(means, covs, strict=True)
    )
    drawn = np.where(chosen[:, None], second, first)
    centre = np.average(means, axis=0, weights=weights)
    radius = mixture_radius(Mixture(means, covs, np.log(weights)), centre, risk)
    reached = np.quantile(np.linalg.norm(drawn - centre, axis=1), 1.0 - risk)
    assert reached * 0.99 <= radius <= 1.2 * reached
