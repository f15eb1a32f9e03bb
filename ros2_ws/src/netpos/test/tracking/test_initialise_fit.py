"""The first fix from within: cost, starts, rivals, covariance."""

from __future__ import annotations

import math

import numpy as np
import pytest
from error_cases import Case, messages, tracker_of, true_values, walk
from first_fix import at, fix_of, measure, rsu, solve
from netpos.estimation.measurement import (
    BIAS,
    COMMON,
    GROUP,
    REFERENCE,
    VALUE,
    VARIANCE,
    linearise,
)
from netpos.estimation.mixture.gaussians import Mixture
from netpos.estimation.mixture.ridge import across
from netpos.estimation.mixture.window import Problem, Window, normal_equations
from netpos.estimation.rows import speed_row
from netpos.messages.values import AngleConvention, Array, Field, RsuInfo, RsuMeasurement
from netpos.tracking import Tracker
from netpos.tracking.config import TrackerConfig
from netpos.tracking.first_fix.fit import Start, is_sound, minima, minimum
from netpos.tracking.first_fix.initialise import Initialiser, has_modes
from netpos.tracking.first_fix.starts import clock_at, starts_of
from netpos.tracking.rsus.rsu import Rsu, SlowErrors
from scipy.optimize import minimize
from scipy.stats import chi2, norm
from track_cases import KNOWN_CLOCK, T0


def mixed_rows() -> tuple[list[Rsu], Array, Array]:
    """Every kind of row, at different ages; one bearing on the far side of +-pi."""
    cone = rsu(-5, 8, 20, angle_convention=AngleConvention.CONE, rsu_id="cone")
    stations = [rsu(0, 0), rsu(40, 0), rsu(0, 40), cone]
    truth = np.array([-12.0, 0.4, 3.0, -2.0, 500.0, 40.0])
    rng = np.random.default_rng(6)
    fields = Field.AZIMUTH | Field.TOA | Field.RANGE | Field.POSITION
    rows = [measure(s, truth, fields, rng, group=i) for i, s in enumerate(stations)]
    rows[0][0, 1] += 2 * math.pi
    rows += [speed_row(3.5, 0.04, 4)]
    out = np.vstack(rows)
    out[:, 4:6] = -1
    return stations, out, np.linspace(-1.5, 0.0, len(out))


def problem_of(rows: Array, prior: Array, prior_var: Array) -> Problem:
    """Rows of one instant, that tell nothing of accelerations."""
    none = np.zeros(len(rows))
    window = Window(none, rows, 0.0, len(prior), 1.0, 1, none)
    return Problem(window, np.append(prior, np.zeros(3)), np.append(prior_var, np.ones(3)))


def still(*values: float) -> Array:
    """The state of a device at rest that does not accelerate either."""
    return np.append(at(*values), np.zeros(3))


def linearised(state: Array, window: Window) -> tuple[Array, Array]:
    """Innovations (m,) and Jacobian (m, n), row by row, through the public model."""
    left, J = [], []
    for age, row in zip(window.ages_s, window.rows, strict=True):
        F = np.eye(state.size)
        F[0, 2] = F[1, 3] = F[4, 5] = age
        for k in range(window.parts):
            end, start = (-window.part_s * part for part in (k, k + 1))
            start, at = max(start, age), window.first + 3 * k
            if start < end:  # back from the end: over the part, then evenly
                F[[2, 3, 5], [at, at + 1, at + 2]] = start - end
                over = 0.5 * (end - start) ** 2 + (start - end) * (age - start)
                F[[0, 1, 4], [at, at + 1, at + 2]] = over
        innovation, H = linearise(row[None], F @ state, window.height_m)
        left.append(innovation[0])
        J.append((H @ F)[0])
    return np.array(left), np.array(J)


def cost_of(state: Array, problem: Problem) -> float:
    """Twice the negative log posterior, over that of errors of 0: a measurement is Gaussian or,
    for a share of them, from a tail in which each octave up to 1000 sd is as likely."""
    window, cost = problem.window, float(np.sum((state - problem.prior) ** 2 / problem.prior_var))
    sizes = np.abs(linearised(state, window)[0]) / np.sqrt(window.rows[:, VARIANCE])
    groups = window.rows[:, GROUP]
    for group in np.unique(groups):
        size, share = sizes[groups == group], window.outliers[groups == group][0]
        tail = 1.0 / (2.0 * (1.0 + math.log(1000.0)) * np.maximum(size, 1.0))
        log_tail = math.log(share) + np.log(tail / norm.pdf(0.0)).sum() if share else -math.inf
        cost -= 2.0 * float(np.logaddexp(-0.5 * np.sum(size**2), log_tail))
    return cost


@pytest.mark.parametrize("shares", [False, True])
def test_cost_gradient_and_curvature_of_the_fit(shares: bool) -> None:
    """Without and with errors that some rows share. The covariance of the device's states is that
    of generalised least squares with correlated errors."""
    _, rows, ages = mixed_rows()
    prior = np.array([1.0, 2.0, 0.5, -0.5, 300.0, 20.0])
    prior_var, errors_var = np.array([900.0, 900.0, 25.0, 25.0, 1e4, 400.0]), np.zeros(0)
    signs, named = np.zeros((len(rows), 2 * shares)), [6, 7][: 2 * shares]
    if shares:
        errors_var = np.array([0.5, 2.0])
        for column, of_it, error in (
            (BIAS, [0, 3, 4], 0),
            (COMMON, [6, 7], 1),
            (REFERENCE, [5], 0),
        ):
            rows[of_it, column] = 6 + error
            signs[of_it, error] = -1.0 if column == REFERENCE else 1.0
    window = Window(ages, rows, 0.7, 6 + errors_var.size, 0.8, 2, np.zeros(len(rows)))
    behind = np.append(errors_var, [4.0, 1.0, 9.0, 2.0, 3.0, 5.0])
    problem = Problem(window, np.append(prior, 0.0 * behind), np.append(prior_var, behind))
    rng = np.random.default_rng(2)
    for _ in range(5):
        state = np.array([-12.0, 0.5, 3.0, -2.0, 500.0, 40.0]) + rng.normal(size=6)
        state = np.append(state, rng.normal(size=behind.size))
        cost, half_gradient, hessian = normal_equations(state, problem)
        assert cost == pytest.approx(cost_of(state, problem), rel=1e-10)
        numeric = np.empty(state.size)
        for i, e in enumerate(np.eye(state.size) * 1e-5):
            numeric[i] = (cost_of(state + e, problem) - cost_of(state - e, problem)) / 2e-5
        np.testing.assert_allclose(half_gradient, -numeric / 2, rtol=1e-5, atol=1e-3)
        J, turns = np.split(np.delete(linearised(state, window)[1], named, axis=1), [6], axis=1)
        R = np.diag(rows[:, VARIANCE]) + signs @ np.diag(errors_var) @ signs.T
        R += turns @ np.diag(behind[-6:]) @ turns.T
        expected = np.linalg.inv(np.diag(1 / prior_var) + J.T @ np.linalg.solve(R, J))
        np.testing.assert_allclose(np.linalg.inv(hessian)[:6, :6], expected, rtol=1e-7, atol=1e-9)


def test_an_outlier_costs_hardly_more_the_farther_off_it_is() -> None:
    """Cost and gradient are those of the density, near and far; ten times as far off, an outlier
    costs 2 ln 10 more for each of its values."""
    _, rows, ages = mixed_rows()
    shares = np.where(rows[:, GROUP] == 1, 0.0, 0.02)
    window = Window(ages, rows, 0.7, 6, 0.8, 2, shares)
    prior = np.append([1.0, 2.0, 0.5, -0.5, 300.0, 20.0], np.zeros(6))
    prior_var = np.array([900.0, 900.0, 25.0, 25.0, 1e4, 400.0, 4.0, 1.0, 9.0, 2.0, 3.0, 5.0])
    problem, rng = Problem(window, prior, prior_var), np.random.default_rng(3)
    for far in (1.0, 1.0, 30.0, 30.0, 1000.0):
        state = np.append([-12.0, 0.5, 3.0, -2.0, 500.0, 40.0], np.zeros(6))
        state[:6] += far * rng.normal(size=6)
        cost, half_gradient, _ = normal_equations(state, problem)
        assert cost == pytest.approx(cost_of(state, problem), rel=1e-9)
        numeric = np.empty(state.size)
        for i, e in enumerate(np.eye(state.size) * 1e-5):
            numeric[i] = (cost_of(state + e, problem) - cost_of(state - e, problem)) / 2e-5
        np.testing.assert_allclose(half_gradient, -numeric / 2, rtol=1e-4, atol=1e-3)
    alone = measure(rsu(0, 0), at(12.0, 5.0), Field.RANGE)
    costs = []
    for sds in (100.0, 1000.0):
        alone[0, VALUE] = 13.0 + 0.3 * sds
        window = Window(np.zeros(1), alone, 0.0, 6, 1.0, 1, np.full(1, 0.02))
        there = Problem(window, still(12.0, 5.0), np.ones(9))
        costs.append(normal_equations(there.prior, there)[0])
    assert costs[1] - costs[0] == pytest.approx(2.0 * math.log(10.0))


def test_the_solver_finds_what_most_say_from_anywhere() -> None:
    """Six ranges at each of four RSUs, of which three are wrong by far; the start is anywhere."""
    rng = np.random.default_rng(4)
    stations = [rsu(0, 0), rsu(40, 0), rsu(0, 40), rsu(40, 40)]
    rows = np.vstack(6 * [measure(s, at(25.0, 18.0), Field.RANGE) for s in stations])
    rows[:, GROUP] = np.arange(len(rows))
    rows[:, VALUE] += rng.normal(0.0, 0.3, len(rows))
    rows[[2, 7, 16], VALUE] += [9.0, -7.0, 60.0]
    ages = np.repeat(np.arange(-5, 1) * 0.1, 4)
    prior_var = np.array([150.0**2, 150.0**2, 1e-4, 1e-4, 1e4, 1e4, 1e-6, 1e-6, 1e-6])
    prior = np.append([20.0, 20.0], np.zeros(7))
    shares = np.full(len(rows), 0.01)
    problem = Problem(Window(ages, rows, 0.0, 6, 1.0, 1, shares), prior, prior_var)
    expected = minimize(
        lambda place: cost_of(still(*place), problem), [25.0, 18.0], method="Nelder-Mead"
    ).x
    for _ in range(30):
        found = minima([Start(still(*rng.uniform(-60, 100, 2)))], problem)
        _, state, cov = min(found, key=lambda fit: fit[0])
        np.testing.assert_allclose(state[:2], expected, atol=0.01)
        assert np.sqrt(np.diag(cov)[:2]).max() < 0.15


@pytest.mark.parametrize("seed", range(10))
def test_the_solver_ends_in_a_minimum_from_anywhere(seed: int) -> None:
    """Steps that do not go down are damped until they do: the gradient vanishes at the end."""
    rng = np.random.default_rng(seed)
    stations = [rsu(0, 0), rsu(40, 0), rsu(0, 40)]
    fields = Field.AZIMUTH | Field.RANGE
    rows = np.vstack([measure(s, at(25.0, 18.0), fields, rng) for s in stations])
    prior_var = np.array([150.0**2, 150.0**2, 25.0, 25.0, 1e4, 1e4])
    problem = problem_of(rows, np.array([13.0, 13.0, 0, 0, 0, 0]), prior_var)
    start = still(*rng.uniform(-60, 60, 2))
    cost, state, cov = minimum(Start(start), problem)
    assert cost <= cost_of(start, problem)
    _, half_gradient, hessian = normal_equations(state, problem)
    # in units of the sd of the solution
    assert math.sqrt(half_gradient @ np.linalg.solve(hessian, half_gradient)) < 0.02
    np.testing.assert_allclose(cov @ hessian, np.eye(9), atol=1e-8)


def test_a_line_keeps_the_distance_and_what_is_across_is_fitted() -> None:
    """A bearing: 20 m away from its array the most probable place is 20 m along the ray."""
    row = measure(rsu(0, 0), at(30.0, 40.0), Field.AZIMUTH)
    prior_var = np.array([150.0**2, 150.0**2, 25.0, 25.0, 1e4, 1e4])
    problem = problem_of(row, np.zeros(6), prior_var)
    start = still(20.0, 0.0)
    _, state, cov = minimum(Start(start, across(start, np.array([0.6, 0.8]))), problem)
    assert state[:2] @ [0.6, 0.8] == pytest.approx(12.0, abs=1e-3)
    np.testing.assert_allclose(state[:2], [7.2, 9.6], atol=2e-3)
    assert math.sqrt([0.6, 0.8] @ cov[:2, :2] @ [0.6, 0.8]) > 100.0  # without the line


@pytest.mark.parametrize("start", [(-59.4, 38.5), (43.2, 50.2), (22.7, 41.0), (-5.2, 57.1)])
def test_a_step_uphill_is_tried_again_shorter(start: tuple[float, float]) -> None:
    """Two bearings from afar: the first step overshoots."""
    stations = [rsu(0, 0), rsu(40, 0)]
    rows = np.vstack([measure(s, at(25.0, 18.0), Field.AZIMUTH) for s in stations])
    prior_var = np.array([150.0**2, 150.0**2, 25.0, 25.0, 1e4, 1e4])
    problem = problem_of(rows, np.array([13.0, 13.0, 0, 0, 0, 0]), prior_var)
    cost, b, A = normal_equations(still(*start), problem)
    first = still(*start) + np.linalg.solve(A + 1e-3 * np.diag(np.diag(A)), b)
    assert cost_of(first, problem) > cost
    end, state, _ = minimum(Start(still(*start)), problem)
    assert end < 0.02
    np.testing.assert_allclose(state[:2], [25.0, 18.0], atol=1.0)


def test_one_rsu_and_an_unknown_clock_leave_the_distance_open() -> None:
    """Three seconds of a walk in front of one RSU: the cost is nearly the same from 1 m before it
    to 40 m away, where the device is. Solvers stop in this flat valley, and the cheapest place of
    those where they do is 1.4 m from the RSU, with an sd of 2.7 m."""
    station = rsu(24.6716473, 0.0822178)
    azimuths = [-2.757215, -2.793667, -2.878833, -2.810284, -2.872668, -2.858685, -2.884354]
    times_m = [-153.73055, -159.16988, -164.42721, -168.25301, -171.93788, -175.39257, -180.2176]
    initialiser = Initialiser(
        TrackerConfig(accel_density_mps2_sqrthz=0.6, initial_speed_sd_mps=1.5)
    )
    for k, values in enumerate(zip(azimuths, times_m, strict=True)):
        rows = measure(station, at(0.0, 0.0), Field.AZIMUTH | Field.TOA)
        rows[:, VALUE], rows[:, VARIANCE], rows[:, BIAS] = values, [0.00246586, 0.18213588], [6, 7]
        initialiser.add(T0 + k * 500_000_000, rows, (station,))
    slow = SlowErrors(6, np.array([0.04240559, 0.36444918]), np.array([True, True]))
    assert initialiser.solve(slow) is None
    assert "another RSU or quantity is needed" in initialiser.missing


def test_starts_lie_where_the_measurements_point() -> None:
    centre = np.array([1.0, 2.0])
    turned = rsu(10, 20, 90)
    d = np.array([0.6, 0.8])
    azimuth = measure(turned, at(*(np.array([10, 20]) + 30 * d)), Field.AZIMUTH)
    starts = starts_of(np.vstack([azimuth, azimuth]), centre, 150.0)
    np.testing.assert_array_equal(starts[0], centre)
    along = np.array(starts[1:]) - [10, 20]
    assert len(along) == 5  # the second row of the same sensor adds none
    np.testing.assert_allclose(along / np.linalg.norm(along, axis=1)[:, None], [d] * 5, atol=1e-12)
    assert np.linalg.norm(along, axis=1)[-1] >= 100.0
    cone = rsu(10, 20, 90, angle_convention=AngleConvention.CONE)
    row = measure(cone, at(*(np.array([10, 20]) + 30 * d)), Field.AZIMUTH)
    np.testing.assert_allclose(
        np.array(starts_of(row, centre, 150.0)[1:]) - [10, 20], along, atol=1e-9
    )
    row[0, 1] = 1.2  # noise beyond the end-fire direction
    assert np.isfinite(np.array(starts_of(row, centre, 150.0))).all()

    circle = np.array(starts_of(measure(turned, at(10, 27), Field.RANGE), centre, 150.0)[1:]) - [
        10,
        20,
    ]
    np.testing.assert_allclose(np.linalg.norm(circle, axis=1), 7.0)
    angles = np.sort(np.arctan2(circle[:, 1], circle[:, 0]))
    np.testing.assert_allclose(np.diff(angles), 2 * math.pi / 12, atol=1e-9)
    toa = np.array(starts_of(measure(turned, at(10, 27), Field.TOA), centre, 150.0)[1:]) - [10, 20]
    np.testing.assert_allclose(np.linalg.norm(toa, axis=1), 30.0)
    assert len(toa) == 4

    fix = starts_of(measure(turned, at(7, -8), Field.POSITION), centre, 150.0)
    np.testing.assert_allclose(fix, [centre, [7.0, -8.0]], atol=1e-9)
    assert len(starts_of(speed_row(3.0, 1.0, 0), centre, 150.0)) == 1


def test_starts_reach_as_far_as_devices_may_be() -> None:
    centre, far = np.array([1.0, 2.0]), measure(rsu(0, 0), at(3e4, 4e4), Field.AZIMUTH)
    near, wide = (np.array(starts_of(far, centre, reach)[1:]) for reach in (10.0, 6e4))
    np.testing.assert_allclose(near, starts_of(far, centre, 150.0)[1:])
    np.testing.assert_allclose(wide, 400.0 * near, rtol=1e-12)


def test_clock_start_is_the_weighted_mean_of_what_the_times_leave() -> None:
    stations = [rsu(0, 0, position=np.array([0.0, 0.0, 6.0])), rsu(40, 0)]
    rows = np.vstack([measure(s, at(12.0, 9.0), Field.TOA | Field.AZIMUTH) for s in stations])
    rows[:, 1] = 0.3, 100.0, 0.3, 230.0
    rows[:, 2] = 1.0, 1.0, 1.0, 4.0
    left = [100.0 - math.sqrt(12**2 + 9**2 + 4**2), 230.0 - math.hypot(math.hypot(28, 9), 2)]
    expected = (left[0] + left[1] / 4) / 1.25
    assert clock_at(at(12.0, 9.0), rows, 2.0) == pytest.approx(expected)
    assert clock_at(at(12.0, 9.0), rows[[0, 2]], 2.0) == 0.0


@pytest.mark.parametrize(
    ("share", "apart", "several"),
    [
        (0.011, 10.0, True),
        (0.009, 10.0, False),  # too improbable to be waited for
        (0.4, 4.2, False),  # 4.2 sd of 1.4 m each: the same place
        (0.4, 4.3, True),
    ],
)
def test_a_mode_is_elsewhere_and_probable(share: float, apart: float, several: bool) -> None:
    means = np.array([at(0.0, 0.0), at(0.0, apart)])
    mixture = Mixture(means, np.tile(np.eye(6), (2, 1, 1)), np.log([1.0 - share, share]))
    assert has_modes(mixture, 0.01) is several


def test_no_fit_whose_covariance_drowned_in_rounding() -> None:
    assert is_sound((1.0, np.zeros(6), np.eye(6)))
    assert not is_sound((math.nan, np.zeros(6), np.eye(6)))
    assert not is_sound((math.inf, np.zeros(6), np.eye(6)))
    assert not is_sound((1.0, np.zeros(6), np.diag([1.0, -1e-12, 1, 1, 1, 1])))
    assert not is_sound((1.0, np.zeros(6), np.diag([-1e-12, 1.0, 1, 1, 1, 1])))


def test_old_measurements_leave_the_window() -> None:
    config = TrackerConfig(initial_window_s=1.0)
    initialiser = Initialiser(config)
    a, b = rsu(0, 0), rsu(40, 0)
    initialiser.add(T0, measure(a, at(12, 25), Field.AZIMUTH), (a,))
    on_time = T0 + 1_000_000_000
    initialiser.add(on_time, measure(b, at(12, 25), Field.AZIMUTH), (b,))
    assert len(initialiser._window) == 2
    initialiser.add(on_time + 1, measure(b, at(12, 25), Field.AZIMUTH), (b,))
    assert [entry[0] for entry in initialiser._window] == [on_time, on_time + 1]


def test_attempts_are_at_least_a_tenth_of_a_second_apart() -> None:
    initialiser = Initialiser(TrackerConfig())
    a, b = rsu(0, 0), rsu(40, 0)
    initialiser.add(T0, measure(a, at(12, 25), Field.AZIMUTH), (a,))
    assert initialiser.solve() is None
    for ms, solved in ((99, False), (100, True)):
        rows = measure(b, at(12, 25), Field.AZIMUTH)
        initialiser.add(T0 + ms * 1_000_000, rows, (b,))
        assert (initialiser.solve() is not None) is solved


def test_an_ambiguity_is_waited_for_most_of_the_window_only() -> None:
    """Two anchors: then both mirror images are modes, one as probable as the other."""
    config = TrackerConfig(initial_window_s=2.0)
    initialiser = Initialiser(config)
    single = Initialiser(TrackerConfig(initial_window_s=2.0, motion_model="interacting"))
    stations = [rsu(0, 0), rsu(40, 0)]
    for ms in range(0, 1700, 100):
        rows = np.vstack([measure(s, at(12, 25), Field.RANGE, range_sd=0.3) for s in stations])
        initialiser.add(T0 + ms * 1_000_000, rows, tuple(stations))
        single.add(T0 + ms * 1_000_000, rows, tuple(stations))
        fix = initialiser.solve()
        assert (fix is None) is (ms < 1600)
        assert single.solve() is None  # one Gaussian cannot be at two places
    assert fix is not None
    above, weights = fix.means[:, 1] > 0.0, np.exp(fix.log_weights)
    np.testing.assert_allclose(abs(fix.means[:, 1]), 25.0, atol=0.2)
    assert weights[above].sum() == pytest.approx(0.5, abs=1e-6)


def test_covariance_is_consistent_over_many_seeds() -> None:
    """DOA and TOA of two RSUs, truth from the prior: mean NEES of the position within its
    chi-square bounds."""
    config = TrackerConfig(**KNOWN_CLOCK)
    stations = [rsu(0, 0), rsu(50, 10)]
    nees = []
    for seed in range(300):
        rng = np.random.default_rng(seed)
        truth = at(*rng.uniform([10, 20], [40, 60]))
        solution = solve(config, stations, truth, Field.AZIMUTH, rng)
        assert solution is not None
        error = solution[0][:2] - truth[:2]
        nees.append(error @ np.linalg.solve(solution[1][:2, :2], error))
    low, high = chi2.ppf([0.0005, 0.9995], 2 * 300) / 300
    assert low < np.mean(nees) < high


def test_inconsistent_measurements_widen_the_covariance() -> None:
    """Four ranges that do not meet by far more than their noise, whichever one is left out."""
    stations = [rsu(0, 0), rsu(40, 0), rsu(0, 40), rsu(40, 40)]
    rows = np.vstack([measure(s, at(20.0, 21.0), Field.RANGE) for s in stations])
    good, bad = rows.copy(), rows.copy()
    bad[0, 1] += 6.0
    bad[1, 1] += 6.0
    results = []
    for values in (good, bad):
        initialiser = Initialiser(TrackerConfig(initial_position_sd_max_m=50.0))
        initialiser.add(T0, values, tuple(stations))
        solution = fix_of(initialiser)
        assert solution is not None
        results.append(solution)
    sds = [math.sqrt(np.linalg.eigvalsh(cov[:2, :2])[-1]) for _, cov in results]
    assert sds[1] > 3.0 * sds[0]
    # The limit is for the best place alone, of which the other minima are part in the mixture.
    for limit, found in ((0.9 * sds[1], False), (1.01 * sds[1], True)):
        strict = Initialiser(TrackerConfig(initial_position_sd_max_m=limit))
        strict.add(T0, bad, tuple(stations))
        assert (strict.solve() is not None) is found
    error = results[1][0][:2] - [20.0, 21.0]
    assert error @ np.linalg.solve(results[0][1][:2, :2], error) > 20.0
    assert error @ np.linalg.solve(results[1][1][:2, :2], error) < 9.0


def test_a_misfit_says_nothing_of_speeds_and_slow_errors() -> None:
    """Ranges that do not meet are worse than stated; biases and speeds are as declared. An error
    of one epoch is a part of the noise and grows with it."""
    stations = [rsu(0, 0), rsu(40, 0), rsu(0, 40), rsu(40, 40)]
    rows = np.vstack([measure(s, at(20.0, 21.0), Field.RANGE) for s in stations])
    rows[:2, 1] += 6.0
    rows[:, BIAS], rows[:, COMMON] = (6, 7, 8, 9), 10
    slow = SlowErrors(6, np.array([0.2] * 4 + [0.1]), np.array([True] * 4 + [False]))
    config = TrackerConfig(initial_position_sd_max_m=50.0, initial_speed_sd_mps=1.5)
    initialiser = Initialiser(config)
    initialiser.add(T0, rows, tuple(stations))
    solution = fix_of(initialiser, slow)
    assert solution is not None
    mean, cov = solution
    assert math.sqrt(np.linalg.eigvalsh(cov[:2, :2])[-1]) > 1.5
    np.testing.assert_allclose(cov.diagonal()[2:4], 1.5**2)
    assert (cov.diagonal()[6:10] <= 0.2**2).all()
    assert (np.abs(mean[6:10]) < 0.05).all()


def test_two_late_ranges_at_the_start_are_forgotten_with_the_next_epoch() -> None:
    """A device that stands among five anchors of slow errors of 0.1 m, of which the first epoch
    hears two over detours of 5 and 6 m."""
    case, times = Case(moving=False), np.arange(10) / 5.0
    places, rng, errors = walk(case, times), np.random.default_rng(1), []
    tracker, variance = tracker_of(case, places, told=True, learn=False)
    seen = true_values(case, places) + rng.normal(0.0, 0.1, (10, 5, 1))
    seen[0, [0, 2], 0] += 6.0, 5.0
    for k, place in enumerate(places):
        for item in messages(case, T0 + k * 200_000_000, k, seen[k], variance):
            tracker.add(item)
        found = [o.odometry for o in tracker.process() if o.odometry is not None]
        errors += [float(np.linalg.norm(o.position[:2] - place)) for o in found]
    assert errors[0] > 1.0
    assert max(errors[2:]) < 0.4


@pytest.mark.parametrize("liar", range(4))
def test_the_one_of_four_that_contradicts_the_others_is_left_out(liar: int) -> None:
    """The fix is that of the three others, with the covariance of three."""
    stations = [rsu(0, 0), rsu(40, 0), rsu(0, 40), rsu(40, 40)]
    fields = Field.AZIMUTH | Field.RANGE
    rows = np.vstack([measure(s, at(20.0, 21.0), fields, group=i) for i, s in enumerate(stations)])
    rows[2 * liar + 1, 1] += 30.0
    full = Initialiser(TrackerConfig(initial_position_sd_max_m=50.0))
    full.add(T0, rows, tuple(stations))
    solution = fix_of(full)
    assert solution is not None
    np.testing.assert_allclose(solution[0][:2], [20.0, 21.0], atol=0.02)
    information = np.eye(2) / 150.0**2
    for i, s in enumerate(stations):
        d = np.array([20.0, 21.0]) - s.info.position[:2]
        r, across = np.hypot(*d), np.array([-d[1], d[0]])
        if i != liar:
            information += np.outer(d, d) / (0.3 * r) ** 2
            information += np.outer(across, across) / (0.02 * r * r) ** 2
    np.testing.assert_allclose(
        solution[1][:2, :2], np.linalg.inv(information), rtol=0.02, atol=1e-4
    )


def test_averaging_never_beats_the_bias() -> None:
    """Ten epochs with a 1 m bias in each range: the mean keeps the variance of the bias."""
    stations = [rsu(0, 0), rsu(40, 0), rsu(0, 40)]
    stands = {"initial_speed_sd_mps": 1e-3, "accel_density_mps2_sqrthz": 1e-3}
    config = TrackerConfig(initial_position_sd_max_m=0.2, **stands)
    wide = TrackerConfig(isolate_rsus=False, **stands)
    slow = SlowErrors(6, np.ones(3), np.ones(3, np.bool_))
    biased, free, open_ = Initialiser(config), Initialiser(config), Initialiser(wide)
    for k in range(10):
        rows = np.vstack([measure(s, at(15.0, 15.0), Field.RANGE) for s in stations])
        stamp = T0 + k * 100_000_000
        free.add(stamp, rows, tuple(stations))
        rows[:, BIAS] = 6, 7, 8
        biased.add(stamp, rows, tuple(stations))
        open_.add(stamp, rows, tuple(stations))
    assert free.solve() is not None
    assert biased.solve(slow) is None  # its sd never gets below a metre or so
    solution = fix_of(open_, slow)
    assert solution is not None
    H = np.array([(np.array([15.0, 15.0]) - s.info.position[:2]) for s in stations])
    H /= np.linalg.norm(H, axis=1)[:, None]
    expected = np.linalg.inv(H.T @ H / (1.0 + 0.3**2 / 10) + np.eye(2) / 150.0**2)
    np.testing.assert_allclose(solution[1][:2, :2], expected, rtol=1e-2, atol=1e-4)
    # A range that is longer than it should be is as much nearer to the RSU: the ranges are known.
    of_ranges = (
        np.column_stack([H, np.eye(3)]) @ solution[1][np.ix_([0, 1, 6, 7, 8], [0, 1, 6, 7, 8])]
    )
    known = of_ranges @ np.column_stack([H, np.eye(3)]).T
    np.testing.assert_allclose(np.diag(known), 0.3**2 / 10, rtol=0.02)


def test_errors_of_a_track_are_states_behind_its_own() -> None:
    """Of a motion model with two states of its own; an error of one epoch is not known later. The
    caller's rows survive."""
    stations = [rsu(0, 0), rsu(40, 0), rsu(0, 40)]
    rows = np.vstack([measure(s, at(15.0, 15.0), Field.RANGE) for s in stations])
    rows[:, BIAS], rows[:, COMMON] = (8, 8, 10), (9, 9, -1)
    slow = SlowErrors(8, np.array([1.0, 0.5, 2.0]), np.array([True, False, True]))
    initialiser = Initialiser(TrackerConfig(motion_model="constant_acceleration"))
    initialiser.add(T0, rows, tuple(stations))
    before = rows.copy()
    solution = fix_of(initialiser, slow)
    assert solution is not None
    np.testing.assert_array_equal(rows, before)
    mean, cov = solution
    assert mean.size == 11
    np.testing.assert_allclose(mean[:2], 15.0, atol=0.05)
    np.testing.assert_allclose(cov[9, 9], 0.25)
    assert np.count_nonzero(cov[9]) == 1
    assert abs(cov[8, 0]) > 0.01
    assert abs(cov[10, 0]) > 0.01


def test_a_bias_counts_once_in_first_fix_and_track() -> None:
    """A device that stands, and biases that stay: what the first fix has made of them is not heard
    a second time."""
    sites = np.array([(0.0, 0.0), (40.0, 0.0), (0.0, 40.0)])
    place, draws, nees = np.array([15.0, 18.0]), 60, 0.0
    for seed in range(draws):
        rng = np.random.default_rng(seed)
        tracker = Tracker(
            TrackerConfig(
                hold_s=0.0,
                accel_density_mps2_sqrthz=1e-3,
                initial_speed_sd_mps=1e-2,
                isolate_rsus=False,
                device_height_m=0.0,
            )
        )
        for name, site in zip("abc", sites, strict=True):
            info = RsuInfo(
                rsu_id=name,
                position=np.array([*site, 0.0]),
                range_bias_sd_m=0.5,
                bias_correlation_time_s=1e5,
            )
            tracker.add_rsu(info)
        ranges = np.linalg.norm(place - sites, axis=1) + rng.normal(0.0, 0.5, 3)
        for k in range(30):
            for name, value in zip("abc", ranges, strict=True):
                item = RsuMeasurement(
                    stamp_ns=T0 + k * 100_000_000,
                    rsu_id=name,
                    vue_id="v",
                    fields=Field.RANGE,
                    range_m=float(value + rng.normal(0.0, 0.05)),
                    range_var=0.05**2,
                )
                tracker.add(item)
        odometry = tracker.flush()[-1].odometry
        assert odometry is not None
        away = (odometry.position - [*place, 0.0])[:2]
        nees += float(away @ np.linalg.solve(odometry.pose_cov[:2, :2], away))
    assert chi2.ppf(0.001, 2 * draws) < nees < chi2.ppf(0.999, 2 * draws)
