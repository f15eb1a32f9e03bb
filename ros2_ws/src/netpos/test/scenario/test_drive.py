"""Drives in space: grids of stations, hills, lever arms, a perfect IMU that leads back to them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from netpos.inertial.strapdown import NAV, mechanise, still_earth
from netpos.messages.values import Beacon, Odometry
from netpos.scenario import Simulation, load_scenario
from netpos.scenario.along_path import observe_along, stations_along
from netpos.scenario.load import ScenarioError
from scipy.spatial.transform import Rotation

VUE = "vue_1"
DRIVE = "blocked_5g_drive"
PERFECT = {
    f"devices.0.imu.{name}": 0.0
    for name in (
        "gyro_noise_density_radps_sqrthz",
        "accel_noise_density_mps2_sqrthz",
        "gyro_bias_sd_radps",
        "accel_bias_sd_mps2",
    )
}


def simulation(**changes: object) -> Simulation:
    return Simulation(load_scenario(DRIVE, changes={"max_duration_s": 30.0, **changes}))


def test_the_drive_is_that_of_the_paper() -> None:
    """4.8 km in about 10 min, height within 2 m, climb below 0.04 m/s, stations at 5 to 15 m."""
    whole = Simulation(load_scenario(DRIVE))
    stamps = whole.beacons(VUE).stamp_ns
    truth = whole.truth(VUE, stamps)
    assert whole.scenario.duration_s == pytest.approx(600.0, abs=10.0)
    way = np.linalg.norm(np.diff(truth.position[:, :2], axis=0), axis=1).sum()
    assert way == pytest.approx(4800.0, rel=0.01)
    assert np.ptp(truth.position[:, 2]) < 2.0
    assert np.abs(truth.velocity[:, 2]).max() < 0.04
    heights = np.array([rsu.position[2] for rsu in whole.rsus])
    assert heights.min() > 5.0
    assert heights.max() < 15.0
    counts = np.bincount(whole.observations(VUE).heard_by)
    assert counts[0] == 0
    assert abs(counts[1] / counts.sum() - 0.5) < 4 * math.sqrt(0.25 / counts.sum())
    assert counts.size == 3


def test_a_grid_is_square_and_its_heights_follow_the_seed() -> None:
    first, second = simulation(), simulation().with_seed(2)
    places = np.array([rsu.position for rsu in first.rsus])
    assert len(places) == 196
    np.testing.assert_array_equal(np.unique(places[:, 0]), 100.0 * np.arange(-1, 13))
    assert [r.rsu_id for r in first.rsus] == [r.rsu_id for r in second.rsus]
    others = np.array([rsu.position for rsu in second.rsus])
    np.testing.assert_array_equal(places[:, :2], others[:, :2])
    assert (places[:, 2] != others[:, 2]).all()
    again = Simulation(load_scenario(DRIVE, seed=2))
    np.testing.assert_array_equal(others, [rsu.position for rsu in again.rsus])


def test_height_climb_and_pitch_belong_together() -> None:
    simulated = simulation()
    stamps = simulated.scenario.start_ns + np.arange(0, 30 * 10**9, 10**7, dtype=np.int64)
    truth = simulated.truth(VUE, stamps)
    climb = np.gradient(truth.position[:, 2], 0.01)
    np.testing.assert_allclose(climb[1:-1], truth.velocity[1:-1, 2], atol=1e-6)
    body = truth.rotation.inv().apply(truth.velocity)
    np.testing.assert_allclose(body[:, 0], np.hypot(8.0, truth.velocity[:, 2]), atol=1e-9)
    np.testing.assert_allclose(body[:, 1:], 0.0, atol=1e-9)
    turned = (truth.rotation[:-1].inv() * truth.rotation[1:]).as_rotvec() / 0.01
    middle = (truth.angular_velocity[1:] + truth.angular_velocity[:-1]) / 2
    steady = np.abs(np.diff(truth.angular_velocity[:, 2])) < 1e-3  # not where a curve begins
    np.testing.assert_allclose(turned[steady], middle[steady], atol=1e-6)


def test_the_antenna_is_at_its_lever_arm() -> None:
    simulated = simulation()
    odometry = {e.stamp_ns: e for e in simulated.events() if isinstance(e, Odometry)}
    for beacon in (e for e in simulated.events() if isinstance(e, Beacon)):
        pose = odometry[beacon.stamp_ns]
        arm = Rotation.from_quat(pose.quaternion).apply([0.4, 0.2, 0.9])
        np.testing.assert_allclose(beacon.position, pose.position + arm, atol=1e-9)
        assert simulated.measure(beacon)[0].lever_arm == (0.4, 0.2, 0.9)
        np.testing.assert_allclose(pose.linear_velocity[1:], 0.0, atol=1e-12)


def test_a_perfect_imu_leads_along_the_true_way() -> None:
    """The mechanisation of what the IMU says is the motion in closed form, pitch and all."""
    simulated = simulation(**PERFECT, max_duration_s=120.0)
    samples = simulated.imu_arrays(VUE)
    kept = samples.stamp_ns <= simulated.scenario.start_ns + 120 * 10**9
    start = simulated.truth(VUE, np.array([simulated.scenario.start_ns]))
    nav = np.zeros(NAV)
    nav[:3], nav[3:6] = start.position[0], start.velocity[0]
    nav[6:10] = start.rotation[0].as_quat()
    last, gained = np.zeros(7), np.zeros(3)
    rates = np.hstack([samples.angular_velocity, samples.specific_force])[kept]
    for rate in rates:
        mechanise(nav, 0.01 * rate, 0.01, last, still_earth(), gained)
    end = simulated.truth(VUE, samples.stamp_ns[kept][-1:])
    np.testing.assert_allclose(nav[:3], end.position[0], atol=0.02)
    np.testing.assert_allclose(nav[3:6], end.velocity[0], atol=2e-3)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"measurement.fewest": 3}, "fewest must be at most nearest"),
        ({"rsus.layout": "list"}, "layout"),
        ({"rsus.grid.height_min_m": 20.0}, "height_min_m <= height_max_m"),
        ({"devices.0.route.pauses_s": [5.0] + [0.0] * 11}, "hills"),
        ({"devices.0.hill_period_s": 0.0}, "greater than 0"),
    ],
)
def test_what_cannot_be_is_refused(changes: dict[str, object], complaint: str) -> None:
    with pytest.raises(ScenarioError, match=complaint):
        load_scenario(DRIVE, changes=changes)


def test_an_imu_is_asked_for_by_name() -> None:
    with pytest.raises(ValueError, match="vue_1 has no imu"):
        Simulation(load_scenario("fast_pass")).imu_arrays(VUE)


def test_stations_along_a_way() -> None:
    """On the grid, near the way, above it; what they measure scatters as it says."""
    t = np.linspace(0.0, 1.0, 2000)
    way = np.column_stack([500 * t, 300 * np.sin(3 * t), -20 * t])
    stations = stations_along(way, 3)
    places = np.array([s.position for s in stations])
    np.testing.assert_array_equal(places[:, :2] % 100.0, 0.0)
    away = np.linalg.norm(places[:, None, :2] - way[None, :, :2], axis=2)
    assert away.min(axis=1).max() <= 200.0
    above = places[:, 2] - way[away.argmin(axis=1), 2]
    assert above.min() >= 5.0
    assert above.max() <= 15.0
    stamps = np.arange(1, 2001, dtype=np.int64) * 10**9
    seen = observe_along(stations, stamps, way, 3, VUE, fewest=1, nearest=2)
    d = way - places[seen.rsu[:, 0]]
    errors = np.column_stack(
        [
            np.remainder(seen.values[:, 0, 0] - np.arctan2(d[:, 1], d[:, 0]) + np.pi, 2 * np.pi)
            - np.pi,
            seen.values[:, 0, 1] - np.arctan2(d[:, 2], np.hypot(d[:, 0], d[:, 1])),
            seen.values[:, 0, 3] - np.linalg.norm(d, axis=1),
        ]
    )
    expected = [math.radians(8.5), math.radians(2.5), 1.0]
    np.testing.assert_allclose(errors.std(axis=0), expected, rtol=0.08)
