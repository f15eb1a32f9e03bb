"""The first fix: what determines a position and what waits."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from first_fix import at, fix_of, measure, rsu, solve
from netpos.estimation.measurement import KIND, VALUE, VARIANCE, Kind
from netpos.estimation.mixture.gaussians import Mixture, moments
from netpos.estimation.rows import linear_rows, speed_row
from netpos.messages.values import AngleConvention, Array, Field
from netpos.tracking.config import TrackerConfig
from netpos.tracking.first_fix.initialise import Initialiser
from scipy.constants import speed_of_light
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from track_cases import KNOWN_CLOCK, T0


@pytest.mark.parametrize("target", [(20.0, 30.0), (-40.0, 20.0), (55.0, -25.0), (10.0, 3.0)])
def test_two_directions(target: tuple[float, float]) -> None:
    """Mean and covariance of the posterior, summed on a grid: more of a wedge lies far away."""
    config = TrackerConfig(initial_position_sd_max_m=20.0)
    stations = [rsu(0, 0), rsu(30, 5, 70)]
    solution = solve(config, stations, at(*target), Field.AZIMUTH)
    assert solution is not None
    mean, cov = solution
    axis = np.linspace(-60.0, 60.0, 1201)
    xy = np.stack(np.meshgrid(axis + target[0], axis + target[1], indexing="ij"))
    log = -0.5 * ((xy - np.array([15.0, 2.5])[:, None, None]) ** 2).sum(axis=0) / 150.0**2
    for station in stations:
        x, y = station.info.position[:2]
        off = np.arctan2(xy[1] - y, xy[0] - x) - math.atan2(target[1] - y, target[0] - x)
        log -= 0.5 * (np.remainder(off + math.pi, 2.0 * math.pi) - math.pi) ** 2 / 0.02**2
    weight = np.exp(log - log.max())
    weight /= weight.sum()
    expected = np.einsum("ij,kij->k", weight, xy)
    away = xy - expected[:, None, None]
    expected_cov = np.einsum("ij,kij,lij->kl", weight, away, away)
    error = mean[:2] - expected
    assert math.sqrt(error @ np.linalg.solve(expected_cov, error) / 2.0) < 0.15
    assert np.trace(cov[:2, :2]) == pytest.approx(np.trace(expected_cov), rel=0.15)


@pytest.mark.parametrize("target", [(20.0, 30.0), (-40.0, -10.0), (-3.0, 25.0)])
def test_direction_and_time_with_a_known_clock(target: tuple[float, float]) -> None:
    config = TrackerConfig(**KNOWN_CLOCK)
    solution = solve(config, [rsu(0, 0, -30)], at(*target), Field.AZIMUTH | Field.TOA)
    assert solution is not None
    mean, cov = solution
    np.testing.assert_allclose(mean[:2], target, atol=0.05)
    d = np.array(target) / np.linalg.norm(target)
    assert d @ cov[:2, :2] @ d == pytest.approx(0.3**2, rel=0.01)  # along: the range's
    across = np.array([-d[1], d[0]])
    expected = (0.02 * math.hypot(*target)) ** 2
    assert across @ cov[:2, :2] @ across == pytest.approx(expected, rel=0.01)


def test_direction_and_time_with_an_unknown_clock_waits() -> None:
    """30 km of clock: the distance is open."""
    config = TrackerConfig(initial_position_sd_max_m=10.0)
    assert solve(config, [rsu(0, 0)], at(20.0, 30.0, 5000.0), Field.AZIMUTH | Field.TOA) is None


@pytest.mark.parametrize("heard", [2, 3])
@pytest.mark.parametrize("clock_m", [0.0, 6000.0, -9000.0, 3e5, -9e5, 3e7])
def test_directions_and_times_give_the_clock(clock_m: float, heard: int) -> None:
    """Also where it is not the declared one, 30 km: it has run for long."""
    stations = [rsu(0, 0), rsu(60, 0), rsu(30, 50)][:heard]
    solution = solve(TrackerConfig(), stations, at(25.0, 20.0, clock_m), Field.AZIMUTH | Field.TOA)
    assert solution is not None
    mean, cov = solution
    np.testing.assert_allclose(mean[:2], [25.0, 20.0], atol=0.1)
    assert abs(mean[4] - clock_m) < 0.2
    assert 0.0 < cov[4, 4] < 1.0
    assert mean[5] == pytest.approx(25e-6 * speed_of_light, rel=1e-3)  # nothing says otherwise
    assert cov[5, 5] == pytest.approx((30e-6 * speed_of_light) ** 2, rel=1e-3)


def test_another_clock_does_not_excuse_a_wrong_rsu() -> None:
    """A clock that is known contradicts a time that is 60 m late: that of one RSU of three, with
    which three times and any clock would fit a wrong place."""
    stations = [rsu(0, 0), rsu(60, 0), rsu(30, 50)]
    rows = [
        measure(s, at(25.0, 20.0), Field.AZIMUTH | Field.TOA, group=i)
        for i, s in enumerate(stations)
    ]
    rows[1][rows[1][:, KIND] == Kind.TOA, VALUE] += 60.0
    initialiser = Initialiser(TrackerConfig(**KNOWN_CLOCK))
    initialiser.add(T0, np.vstack(rows), tuple(stations))
    solution = fix_of(initialiser)
    assert solution is not None
    np.testing.assert_allclose(solution[0][:2], [25.0, 20.0], atol=0.2)
    assert abs(solution[0][4]) < 1.0


@pytest.mark.parametrize("seed", range(5))
def test_one_direction_that_is_wrong_puts_no_device_beside_its_rsu(seed: int) -> None:
    """Eight RSUs hear a device seven times. One direction of the 56 is 70 degrees off, and what is
    stated of them is so uncertain that the sum of all residuals does not show it: beside the RSU
    that measured it any direction fits."""
    rng, config = np.random.default_rng(seed), TrackerConfig(initial_position_sd_max_m=20.0)
    stations = [rsu(150.0 * math.cos(a), 150.0 * math.sin(a)) for a in np.arange(8) * math.pi / 4]
    truth, initialiser = at(85.0, -75.0), Initialiser(config)
    for k in range(7):
        rows = np.vstack(
            [
                measure(s, truth, Field.AZIMUTH, rng, math.radians(2.0), group=i)
                for i, s in enumerate(stations)
            ]
        )
        rows[:, VARIANCE] = math.radians(5.0) ** 2
        rows[7, VALUE] -= math.radians(70.0) * (k == 6)
        initialiser.add(T0 + k * 100_000_000, rows, tuple(stations))
    fix = fix_of(initialiser)
    assert fix is not None
    error, cov = fix[0][:2] - truth[:2], fix[1][:2, :2]
    assert error @ np.linalg.solve(cov, error) < chi2.ppf(0.999, 2)
    assert np.hypot(*error) < 10.0


@pytest.mark.parametrize(("stamps_ms", "is_told"), [((0, 200), False), ((0, 100, 200), True)])
def test_of_two_values_that_differ_nobody_can_tell_which_is_wrong(
    stamps_ms: tuple[int, ...], is_told: bool
) -> None:
    """Two anchors hear a device that stands; the first range is 4 m too long. Of three the other
    two say so, of two the place is between them, and less certain."""
    config = TrackerConfig(
        initial_window_s=0.2, initial_speed_sd_mps=0.01, accel_density_mps2_sqrthz=0.01
    )
    stations, initialiser = [rsu(0, 0), rsu(40, 0)], Initialiser(config)
    for ms in stamps_ms:
        rows = np.vstack(
            [measure(s, at(12.0, 25.0), Field.RANGE, group=i) for i, s in enumerate(stations)]
        )
        rows[0, VALUE] += 4.0 * (ms == 0)
        initialiser.add(T0 + ms * 1_000_000, rows, tuple(stations))
    fix = initialiser.solve()
    assert fix is not None
    above = fix.means[:, 1] > 0.0
    mean, cov = moments(Mixture(*(part[above] for part in fix)))
    distance, sd = float(np.hypot(*mean[:2])), math.sqrt(np.linalg.eigvalsh(cov[:2, :2])[-1])
    assert distance == pytest.approx(math.hypot(12.0, 25.0) + (0.0 if is_told else 2.0), abs=0.1)
    assert (sd < 0.3) is is_told


def test_three_ranges() -> None:
    stations = [rsu(0, 0), rsu(40, 0), rsu(0, 40)]
    all_right = TrackerConfig(isolate_rsus=False)
    solution = solve(all_right, stations, at(12.0, 25.0), Field.RANGE)
    assert solution is not None
    np.testing.assert_allclose(solution[0][:2], [12.0, 25.0], atol=0.02)
    H = np.array([(np.array([12.0, 25.0]) - s.info.position[:2]) for s in stations])
    H /= np.linalg.norm(H, axis=1)[:, None]
    expected = np.linalg.inv(H.T @ H / 0.3**2 + np.eye(2) / 150.0**2)
    np.testing.assert_allclose(solution[1][:2, :2], expected, rtol=1e-3, atol=1e-6)


def test_a_fix_that_is_too_wide_names_the_parameter() -> None:
    initialiser = Initialiser(TrackerConfig(initial_position_sd_max_m=0.1))
    stations = [rsu(0, 0), rsu(40, 0), rsu(0, 40)]
    rows = np.vstack(
        [measure(s, at(12.0, 25.0), Field.RANGE, group=i) for i, s in enumerate(stations)]
    )
    initialiser.add(T0, rows, tuple(stations))
    assert initialiser.solve() is None
    assert re.search(r"sd of 0\.[34] m \(initial_position_sd_max_m: 0\.1\)", initialiser.missing)


def test_two_ranges_wait_between_their_two_solutions() -> None:
    stations = [rsu(0, 0), rsu(40, 0)]
    assert solve(TrackerConfig(), stations, at(12.0, 25.0), Field.RANGE) is None


def test_one_direction_waits() -> None:
    assert solve(TrackerConfig(), [rsu(0, 0)], at(12.0, 25.0), Field.AZIMUTH) is None


def test_a_fix_far_from_the_origin_needs_no_rsu_nearby() -> None:
    config = TrackerConfig()
    initialiser = Initialiser(config)
    rows = linear_rows(np.array([3e5, -2e5]), np.eye(2), np.eye(2, 6), 0)
    initialiser.add(T0, rows, ())
    solution = fix_of(initialiser)
    assert solution is not None
    np.testing.assert_allclose(solution[0][:2], [3e5, -2e5], atol=1e-3)
    np.testing.assert_allclose(solution[1][:2, :2], np.eye(2), rtol=1e-3, atol=1e-6)


def test_a_speed_alone_waits() -> None:
    initialiser = Initialiser(TrackerConfig())
    initialiser.add(T0, speed_row(3.0, 0.1, 0), ())
    assert initialiser.solve() is None


@pytest.mark.parametrize("yaw_deg", [0.0, 90.0, -135.0])
def test_cone_arrays_put_the_device_before_them(yaw_deg: float) -> None:
    """Two linear arrays on one wall: their cones also meet behind it."""
    turn = Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix()[:2, :2]
    stations = [
        rsu(*(turn @ [0.0, y]), yaw_deg, angle_convention=AngleConvention.CONE)
        for y in (-10.0, 10.0)
    ]
    front = turn @ [14.0, 3.0]
    solution = solve(TrackerConfig(), stations, at(*front), Field.AZIMUTH)
    assert solution is not None
    assert np.linalg.norm(solution[0][:2] - front) < 0.3


def test_spherical_arrays_see_behind_themselves() -> None:
    stations = [rsu(0, -10), rsu(0, 10)]
    solution = solve(TrackerConfig(), stations, at(-14.0, 3.0), Field.AZIMUTH)
    assert solution is not None
    np.testing.assert_allclose(solution[0][:2], [-14.0, 3.0], atol=0.3)


def test_motion_within_the_window_is_part_of_the_fit() -> None:
    """A moving device, ranges of one anchor per epoch: position and velocity at the newest stamp,
    against SciPy's solution of the same least-squares problem. In each half of the 1.5 s the
    acceleration, a constant, moves the device as far as white acceleration would."""
    rng = np.random.default_rng(3)
    stations = [rsu(0, 0), rsu(40, 0), rsu(0, 40), rsu(40, 40)]
    accel = {"accel_density_mps2_sqrthz": 0.7, "initial_window_s": 2.0}
    initialiser = Initialiser(TrackerConfig(initial_position_sd_max_m=1e-3, **accel))
    velocity, end = np.array([6.0, -3.0]), np.array([22.0, 17.0])
    observed = []
    for k in range(16):
        age = (k - 15) * 0.1
        state = np.array([*(end + velocity * age), *velocity, 0.0, 0.0])
        station = stations[k % 4]
        stamp = T0 + k * 100_000_000
        rows = measure(station, state, Field.RANGE, rng)
        initialiser.add(stamp, rows, (station,))
        observed.append((age, station.info.position[:2], rows[0, 1]))
        if k < 15:
            assert initialiser.solve() is None  # the sd limit is out of reach

    centre = np.mean([o for _, o, _ in observed], axis=0)

    def residuals(x: Array) -> Array:
        place, speed, late, early = x.reshape(4, 2)
        fit = []
        for age, origin, value in observed:
            last = max(age, -0.75)
            there = place + speed * last + late * last**2 / 2.0
            if age < -0.75:
                first = age + 0.75
                there += (speed - 0.75 * late) * first + early * first**2 / 2.0
            fit.append((np.hypot(*(there - origin)) - value) / 0.3)
        turned = np.array([late, early]) * 0.75**2 / 2.0 / (0.7 * math.sqrt(0.75**3 / 3.0))
        prior = [(place - centre) / 150.0, speed / 5.0, *turned]
        return np.array([*fit, *np.ravel(prior)])

    start = [20.0, 20.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    oracle = least_squares(residuals, start, xtol=1e-14, ftol=1e-14)
    rows_of_last = Initialiser(TrackerConfig(**accel))
    for stamp, rows, rsus in initialiser._window:
        rows_of_last.add(stamp, rows, rsus)
    solution = fix_of(rows_of_last)
    assert solution is not None
    np.testing.assert_allclose(solution[0][:4], oracle.x[:4], atol=1e-3)
    cov = np.linalg.inv(oracle.jac.T @ oracle.jac) * max(1.0, 2 * oracle.cost / len(observed))
    np.testing.assert_allclose(solution[1][:4, :4], cov[:4, :4], rtol=2e-2, atol=1e-3)


def test_clock_drift_within_the_window_is_part_of_the_fit() -> None:
    """Over 1 s of TOA the offset at the newest stamp and its rate (30 ppm) both show."""
    stations = [rsu(0, 0), rsu(40, 0), rsu(0, 40)]
    steady = {"accel_density_mps2_sqrthz": 1e-3, "clock_walk_density": 1e-12}
    config = TrackerConfig(initial_position_sd_max_m=0.3, isolate_rsus=False, **steady)
    initialiser = Initialiser(config)
    solution = None
    for k in range(11):
        age = (k - 10) * 0.1
        state = at(15.0, 12.0, 4000.0 + 9000.0 * age)
        rows = np.vstack([measure(s, state, Field.TOA) for s in stations])
        initialiser.add(T0 + k * 100_000_000, rows, tuple(stations))
        solution = fix_of(initialiser) if k == 10 else None
    assert solution is not None
    mean, cov = solution
    np.testing.assert_allclose(mean[:2], [15.0, 12.0], atol=0.1)
    assert mean[4] == pytest.approx(4000.0, abs=0.3)
    assert mean[5] == pytest.approx(9000.0, abs=0.5)
    # sd of the slope of 11 epochs of three ranges each, 0.3 m, 0.1 s apart, clock and place open
    assert math.sqrt(cov[5, 5]) == pytest.approx(0.3 / math.sqrt(3 * 110 * 0.01), rel=0.2)
    assert cov[4, 5] > 0.0  # later is larger


def test_a_fit_on_top_of_an_rsu_is_refused() -> None:
    """Where angles alone place a device within a metre of an antenna, anything fits: the other
    solution is taken, or none. Ranges may place it there."""
    config = TrackerConfig(initial_position_sd_max_m=50.0)
    stations = [rsu(0, 0), rsu(40, 0), rsu(0, 40)]
    for fields, distance, found in (
        (Field.AZIMUTH, 0.9, False),
        (Field.AZIMUTH, 1.1, True),
        (Field.RANGE, 0.9, True),
    ):
        solution = solve(config, stations, at(0.0, distance), fields)
        assert (solution is not None) is found
    # the distance is from the antenna, wherever it and the device are
    level = TrackerConfig(initial_position_sd_max_m=50.0, device_height_m=3.0)
    shifted = [
        rsu(x, y, position=np.array([x, y, 3.0])) for x, y in ((40, 20), (80, 20), (40, 60))
    ]
    for distance, found in ((0.9, False), (1.1, True)):
        solution = solve(level, shifted, at(40.0, 20.0 + distance), Field.AZIMUTH)
        assert (solution is not None) is found
    # straight below an RSU on a mast is no such place
    high = [rsu(x, y, position=np.array([x, y, 5.0])) for x, y in ((0, 0), (40, 0), (0, 40))]
    rows = []
    for station in high:
        row = measure(station, at(0.0, 0.5), Field.RANGE)
        row[:, 1] = np.linalg.norm([*(np.array([0.0, 0.5]) - station.info.position[:2]), 5.0])
        rows.append(row)
    initialiser = Initialiser(config)
    initialiser.add(T0, np.vstack(rows), tuple(high))
    solution = fix_of(initialiser)
    assert solution is not None
    np.testing.assert_allclose(solution[0][:2], [0.0, 0.5], atol=0.1)


def test_one_rsu_and_an_unknown_clock_tell_no_distance_of_a_device_that_stands() -> None:
    """Beside the RSU any angle fits, and a metre along the ray is worth nothing there: the most
    probable state is a metre away, with an sd of centimetres."""
    config = TrackerConfig(initial_speed_sd_mps=1.5)
    for seed in range(5):
        initialiser, station = Initialiser(config), rsu(0, 0)
        rng = np.random.default_rng(seed)
        for k in range(12):
            rows = measure(station, at(9.0, 7.0, 5000.0), Field.AZIMUTH | Field.TOA, rng)
            initialiser.add(T0 + k * 250_000_000, rows, (station,))
            assert initialiser.solve() is None
        assert float(initialiser.missing.split("sd of ")[1].split(" m")[0]) > 20.0


def test_who_waits_for_long_is_tried_less_often() -> None:
    """After a twentieth of the time it has waited; after a silence as often as at first."""
    initialiser, a, b = Initialiser(TrackerConfig()), rsu(0, 0), rsu(40, 0)

    def solved_after(first_s: float, count: int) -> float:
        """Seconds from when ``b`` is heard, after ``count`` epochs of ``a`` alone."""
        for k in range(count + 100):
            stamp_ns = T0 + round(1e9 * (first_s + 0.1 * k))
            rows = [measure(s, at(12, 25), Field.AZIMUTH) for s in (a, b)[: 1 + (k >= count)]]
            initialiser.add(stamp_ns, np.vstack(rows), (a, b)[: len(rows)])
            if initialiser.solve() is not None:
                return 0.1 * (k - count)
        return math.inf

    assert 0.1 <= solved_after(0.0, 400) <= 2.1
    assert solved_after(100.0, 1) <= 0.11


def test_the_fix_of_a_device_that_accelerates_is_as_wide_as_its_errors() -> None:
    """White acceleration of 2 m/s^2/sqrt(Hz) in the three seconds in which four RSUs measure one
    after the other: NEES of position and velocity, 4 expected. It is 900 where the device is
    thought to move straight, and 76 with one acceleration for all the time."""
    config = TrackerConfig(accel_density_mps2_sqrthz=2.0, initial_window_s=3.0)
    stations, dt, nees = [rsu(0, 0), rsu(40, 0), rsu(0, 40), rsu(40, 40)], 0.1, []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        initialiser, truth = Initialiser(config), at(18.0, 15.0)
        truth[2:4] = rng.normal(0.0, 3.0, 2)
        for k in range(31):
            station = stations[k % 4]
            rows = measure(station, truth, Field.RANGE, rng)
            initialiser.add(T0 + k * 100_000_000, rows, (station,))
            if k < 30:
                kick = rng.normal(0.0, 2.0 * math.sqrt(dt), 2)
                truth[:2] += truth[2:4] * dt + 0.5 * dt * kick
                truth[2:4] += kick
        solution = fix_of(initialiser)
        assert solution is not None
        error = solution[0][:4] - truth[:4]
        nees.append(float(error @ np.linalg.solve(solution[1][:4, :4], error)))
    assert 3.0 < np.mean(nees) < 6.0
