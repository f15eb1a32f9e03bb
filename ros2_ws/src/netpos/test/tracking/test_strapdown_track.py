"""The strapdown track behind the tracker: start, accuracy, refusals, late data, holes."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
import pytest
from netpos.estimation.spatial.error_state import MEMORY
from netpos.inertial.strapdown import ERR, NAV
from netpos.messages.values import (
    Array,
    Beacon,
    Field,
    GroundSpeed,
    ImuSample,
    InitialPose,
    Odometry,
    RsuInfo,
    RsuMeasurement,
    TrackState,
    Velocity,
)
from netpos.scenario import Simulation, load_scenario
from netpos.tracking import Tracker, TrackerConfig, TrackOutput
from netpos.tracking.estimators.spatial import odometry_of
from scipy.spatial.transform import Rotation

NS = 1_000_000_000
VUE = "vue_1"
Item = RsuMeasurement | ImuSample


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    """A minute of the drive, three to five stations, twice a second."""
    changes = {
        "max_duration_s": 40.0,
        "measurement.fewest": 3,
        "measurement.nearest": 5,
        "devices.0.beacon_interval_s": 0.5,
    }
    return Simulation(load_scenario("blocked_5g_drive", changes=changes))


@pytest.fixture(scope="module")
def items(simulation: Simulation) -> list[Item]:
    """IMU and measurements in the order of time."""
    return items_of(simulation)


def items_of(simulation: Simulation) -> list[Item]:
    beacons = [e for e in simulation.events() if isinstance(e, Beacon)]
    measured = [m for beacon in beacons for m in simulation.measure(beacon)]
    return sorted([*simulation.imu(VUE), *measured], key=lambda item: item.stamp_ns)


def tracker_of(simulation: Simulation, **changes: object) -> Tracker:
    parameters = {**simulation.scenario.tracker, **changes}
    tracker = Tracker(TrackerConfig.from_mapping(parameters))
    for rsu in simulation.rsus:
        tracker.add_rsu(rsu)
    return tracker


def run(tracker: Tracker, items: Iterable[object]) -> list[TrackOutput]:
    outputs = []
    for item in items:
        tracker.add(item)  # type: ignore[arg-type]
        outputs += tracker.process()
    return outputs + tracker.flush()


def errors(simulation: Simulation, outputs: list[TrackOutput]) -> Array:
    """(n, 3) of the odometry."""
    found = [o.odometry for o in outputs if o.odometry is not None]
    truth = simulation.truth(VUE, np.array([o.stamp_ns for o in found]))
    return np.array([o.position for o in found]) - truth.position


def estimates(outputs: list[TrackOutput]) -> list[Odometry]:
    return [o.odometry for o in outputs if o.odometry is not None]


def test_start_from_motion_and_track_in_three_dimensions(
    simulation: Simulation, items: list[Item]
) -> None:
    outputs = run(tracker_of(simulation), items)
    found = estimates(outputs)
    error = errors(simulation, outputs)
    assert found[0].stamp_ns - simulation.scenario.start_ns <= 10 * NS
    assert outputs[0].status.state is TrackState.WAITING
    assert outputs[-1].status.state is TrackState.TRACKING
    assert outputs[-1].status.rejected == {}
    late = error[len(error) // 2 :]
    assert np.sqrt((late[:, :2] ** 2).sum(axis=1).mean()) < 1.2
    assert np.abs(late[:, 2]).max() < 1.5
    truth = simulation.truth(VUE, np.array([found[-1].stamp_ns]))
    yaw = Rotation.from_quat(found[-1].quaternion).as_euler("ZYX")[0]
    assert math.remainder(yaw - truth.rotation[0].as_euler("ZYX")[0], math.tau) == pytest.approx(
        0.0, abs=0.1
    )
    np.testing.assert_allclose(found[-1].linear_velocity, [8.0, 0.0, 0.0], atol=0.5)


def test_the_first_estimates_know_how_good_they_are() -> None:
    """NEES of the position (3 expected) over eight blocked starts, at the start and 5 s later."""
    changes = {"max_duration_s": 25.0}
    nees = []
    for seed in range(8):
        simulation = Simulation(load_scenario("blocked_5g_drive", seed=seed, changes=changes))
        outputs = run(tracker_of(simulation), items_of(simulation))
        found, error = estimates(outputs), errors(simulation, outputs)
        values = [
            e @ np.linalg.solve(o.pose_cov[:3, :3], e) for e, o in zip(error, found, strict=True)
        ]
        nees.append([values[0], values[5]])
    mean = np.mean(nees, axis=0)
    sd = math.sqrt(2 * 3 / 8)  # of the mean of eight chi-square values of 3 degrees
    assert (mean > 3 - 3 * sd).all()
    assert (mean < 3 + 4 * sd).all()


def test_late_measurements_end_in_the_same_estimate(
    simulation: Simulation, items: list[Item]
) -> None:
    """Every seventh measurement comes 0.6 s late, after its epoch was applied."""

    def delayed() -> Iterator[Item]:
        shifted = [
            (item.stamp_ns + (600_000_000 if i % 7 == 0 else 0), i, item)
            for i, item in enumerate(items)
            if isinstance(item, RsuMeasurement)
        ]
        samples = [(s.stamp_ns, -1, s) for s in items if isinstance(s, ImuSample)]
        for _, _, item in sorted(shifted + samples, key=lambda entry: entry[:2]):
            yield replace(item, expected=0) if isinstance(item, RsuMeasurement) else item

    in_time = run(tracker_of(simulation), items)
    late = run(tracker_of(simulation, history_s=2.0, hold_s=0.0), delayed())
    assert any(o.revised for o in late)
    last_in_time = estimates(in_time)[-1]
    last_late = [o for o in estimates(late) if o.stamp_ns == last_in_time.stamp_ns][-1]
    np.testing.assert_allclose(last_late.position, last_in_time.position, atol=1e-6)


def test_a_lying_station_is_refused(simulation: Simulation, items: list[Item]) -> None:
    """From 20 s on one station adds 60 m: its measurements do not move the track."""
    stamps = [i.stamp_ns for i in items if isinstance(i, RsuMeasurement)]
    liar = max({i.rsu_id for i in items if isinstance(i, RsuMeasurement) and i.stamp_ns > 20 * NS},
               key=lambda name: sum(i.rsu_id == name for i in items
                                    if isinstance(i, RsuMeasurement)))  # fmt: skip

    def bent(item: Item) -> Item:
        if isinstance(item, RsuMeasurement) and item.rsu_id == liar and item.stamp_ns > 20 * NS:
            return replace(item, range_m=item.range_m + 60.0)
        return item

    outputs = run(tracker_of(simulation), map(bent, items))
    assert outputs[-1].status.rejected["gate"] > 0
    assert np.abs(errors(simulation, outputs)[-10:]).max() < 3.0
    assert outputs[-1].status.stamp_ns == max(stamps)


def test_a_silent_imu_widens_the_estimate_and_breaks_nothing(
    simulation: Simulation, items: list[Item]
) -> None:
    def without(item: Item) -> bool:
        return not (isinstance(item, ImuSample) and 22 * NS < item.stamp_ns < 24 * NS)

    whole = run(tracker_of(simulation), items)
    holed = run(tracker_of(simulation), filter(without, items))
    stamp = 1 * NS + 22_500_000_000

    def sd(outputs: list[TrackOutput]) -> float:
        return next(o.status.position_sd_m for o in outputs if o.status.stamp_ns == stamp)

    assert sd(holed) > 1.2 * sd(whole)
    assert np.isfinite(errors(simulation, holed)).all()
    assert np.abs(errors(simulation, holed)[-1]).max() < 3.0


def test_a_velocity_in_map_is_not_taken(simulation: Simulation) -> None:
    velocity = Velocity(stamp_ns=2 * NS, vue_id=VUE, velocity=np.ones(2), cov=np.eye(2))
    phase = RsuMeasurement(
        stamp_ns=NS, rsu_id="pair", vue_id=VUE, fields=Field.PHASE, phase_difference_rad=0.1,
        phase_difference_var=0.01,
    )  # fmt: skip
    tracker = tracker_of(simulation)
    pair = replace(simulation.rsus[0], rsu_id="pair", baseline_m=1.0, wavelength_m=0.1)
    tracker.add_rsu(pair)
    outputs = run(tracker, [phase, velocity])
    assert outputs[-1].odometry is None
    assert outputs[-1].status.rejected == {"unsupported_fields": 2}


def test_ground_speed_is_forward_speed(simulation: Simulation, items: list[Item]) -> None:
    """A wheel that says 7 m/s, very sure of it."""
    extra = [
        GroundSpeed(stamp_ns=k * NS + 250_000_000, vue_id=VUE, speed_mps=8.0, speed_var=1e-4)
        for k in range(15, 40)
    ]
    merged = sorted([*items, *extra], key=lambda item: item.stamp_ns)
    found = estimates(run(tracker_of(simulation), merged))
    assert found[-1].linear_velocity[0] == pytest.approx(8.0, abs=0.03)
    free = estimates(run(tracker_of(simulation), items))
    assert found[-1].twist_cov[0, 0] < 0.5 * free[-1].twist_cov[0, 0]


def test_a_lost_track_starts_anew(simulation: Simulation, items: list[Item]) -> None:
    """From 20 s on the device is said to be a kilometre away: the track gives up and follows."""
    shift = np.array([1000.0, 0.0, 0.0])
    config = {"max_rejected_epochs": 4}
    tracker = tracker_of(simulation, **config)
    for rsu in simulation.rsus:
        moved = f"far_{rsu.rsu_id}"
        tracker.add_rsu(replace(rsu, rsu_id=moved, position=rsu.position + shift))

    def far(item: Item) -> Item:
        if isinstance(item, RsuMeasurement) and item.stamp_ns > 20 * NS:
            return replace(item, rsu_id=f"far_{item.rsu_id}")
        return item

    outputs = run(tracker, map(far, items))
    assert outputs[-1].status.rejected["track_lost"] == 1
    assert np.abs(errors(simulation, outputs)[-1] - shift).max() < 4.0


def test_a_required_pose_is_waited_for(simulation: Simulation, items: list[Item]) -> None:
    tracker = tracker_of(simulation, require_initial_pose=True, initial_pose_wait_s=1e3)
    outputs = run(tracker, items[: len(items) // 2])
    assert all(o.odometry is None for o in outputs)
    assert outputs[-1].status.rejected["no_initial_pose"] > 0
    assert outputs[-1].status.reason.startswith("waits for a pose on /")
    tracker = tracker_of(simulation, require_initial_pose=True)
    position = np.array([*simulation.beacons(VUE).position[0]])
    pose = InitialPose(stamp_ns=NS, vue_id=VUE, position=position, cov=np.diag([1.0, 1.0, 0.0]))
    outputs = run(tracker, [pose, *items])
    assert outputs[-1].odometry is not None


def with_pose(
    simulation: Simulation, items: list[Item], stamp_ns: int, aside_m: float
) -> list[Item | InitialPose]:
    """The items and a pose ``aside_m`` east of the device, said to be right to a millimetre."""
    position = simulation.truth(VUE, np.array([stamp_ns])).position[0] + [aside_m, 0.0, 0.0]
    pose = InitialPose(stamp_ns=stamp_ns, vue_id=VUE, position=position, cov=1e-6 * np.eye(3))
    return sorted([*items, pose], key=lambda item: item.stamp_ns)


@pytest.mark.parametrize("at_s", [2, 25])
@pytest.mark.parametrize("aside_m", [30.0, 1e5])
def test_a_pose_that_the_measurements_exclude_is_refused(
    simulation: Simulation, items: list[Item], at_s: int, aside_m: float
) -> None:
    """Before the first fix and after it; the track goes on as if there had been no pose: it is
    predicted in two steps once, which moves it by less than a millimetre."""
    stamp_ns = simulation.scenario.start_ns + at_s * NS + 1
    outputs = run(tracker_of(simulation), with_pose(simulation, items, stamp_ns, aside_m))
    assert outputs[-1].status.rejected["initialpose"] == 1
    untouched = run(tracker_of(simulation), items)
    moved = outputs[-1].odometry.position - untouched[-1].odometry.position
    assert np.abs(moved).max() < 1e-3
    assert len(estimates(outputs)) >= len(estimates(untouched))


def test_a_pose_that_the_measurements_permit_starts_anew(
    simulation: Simulation, items: list[Item]
) -> None:
    stamp_ns = simulation.scenario.start_ns + 25 * NS + 1
    outputs = run(tracker_of(simulation), with_pose(simulation, items, stamp_ns, 0.5))
    assert "initialpose" not in outputs[-1].status.rejected
    (first, *_) = [o for o in outputs if o.status.stamp_ns > stamp_ns]
    assert first.odometry is None
    assert np.abs(errors(simulation, outputs)[-1]).max() < 4.0


def test_an_unsound_estimate_ends_the_track(simulation: Simulation, items: list[Item]) -> None:
    """At 15 s the estimate is made faster than light; nothing of it is published."""
    tracker = tracker_of(simulation)
    late = simulation.scenario.start_ns + 15 * NS
    outputs = run(tracker, [item for item in items if item.stamp_ns <= late])
    tracker._tracks[VUE]._state.estimator.estimate.nav[3] = 1e9
    outputs += run(tracker, [item for item in items if item.stamp_ns > late])
    assert outputs[-1].status.rejected["diverged"] == 1
    assert np.abs(errors(simulation, outputs)).max() < 10.0
    assert outputs[-1].odometry is not None


def test_a_track_of_a_network_names_it(simulation: Simulation, items: list[Item]) -> None:
    tracker = tracker_of(simulation, network="one", trust="any")
    for rsu in simulation.rsus:
        tracker.add_rsu(replace(rsu, network="one"))
    outputs = run(tracker, items)
    assert len(estimates(outputs)) > 20
    assert {o.network for o in outputs} == {"one"}


def test_reset_forgets(simulation: Simulation, items: list[Item]) -> None:
    tracker = tracker_of(simulation)
    accepted = run(tracker, items)[-1].status.accepted
    tracker.reset()
    first = run(tracker, items)[0]
    assert first.odometry is None
    assert first.status.accepted == accepted


def test_the_twist_is_that_of_the_body() -> None:
    """Its covariance by sampling the error state."""
    rng = np.random.default_rng(3)
    nav = np.zeros(NAV)
    nav[3:6] = 5.0, -2.0, 1.0
    turn = Rotation.from_euler("ZYX", [2.0, 0.3, -0.2])
    nav[6:10] = turn.as_quat()
    A = 0.02 * rng.normal(size=(ERR, ERR))
    cov = A @ A.T
    odometry = odometry_of(1, VUE, nav, cov, np.array([0.1, 0.2, 0.3]), 1e-3)
    np.testing.assert_allclose(odometry.linear_velocity, turn.inv().apply(nav[3:6]))
    samples = rng.multivariate_normal(np.zeros(ERR), cov, 20000)
    true = (Rotation.from_rotvec(samples[:, 6:9]) * turn).inv().apply(nav[3:6] + samples[:, 3:6])
    expected = np.cov(true.T)
    np.testing.assert_allclose(odometry.twist_cov[:3, :3], expected, atol=0.05 * expected.max())
    np.testing.assert_allclose(odometry.pose_cov[:3, :3], cov[:3, :3])
    np.testing.assert_allclose(odometry.pose_cov[3:, 3:], cov[6:9, 6:9])
    assert MEMORY == 11


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"filter": "ukf"}, "error-state filter"),
        ({"fixed_lag_s": 1.0}, "replay --smooth"),
    ],
)
def test_combinations_that_do_not_exist_are_refused(changes: dict[str, object], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        TrackerConfig.from_mapping({"motion_model": "strapdown", **changes})


def test_an_rsu_may_look_anywhere(simulation: Simulation, items: list[Item]) -> None:
    """Angles are turned by the pose of the RSU: all turned alike give the same track."""
    turn = Rotation.from_euler("ZYX", [1.0, 0.2, -0.1])
    tracker = tracker_of(simulation, trust="any")
    for rsu in simulation.rsus:
        tracker.add_rsu(replace(rsu, quaternion=turn.as_quat()))

    def seen(item: Item) -> Item:
        if not isinstance(item, RsuMeasurement):
            return item
        a, e = item.azimuth_rad, item.elevation_rad
        u = [math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)]
        x, y, z = turn.inv().apply(u).tolist()
        return replace(item, azimuth_rad=math.atan2(y, x), elevation_rad=math.asin(z))

    outputs = run(tracker, map(seen, items))
    assert np.abs(errors(simulation, outputs)[-10:]).max() < 2.5
    assert isinstance(simulation.rsus[0], RsuInfo)


def test_a_planar_tracker_does_without_rotations() -> None:
    """SciPy's rotations cost time and memory at the start of every tracker."""
    code = (
        "import sys; from netpos.tracking import Tracker; Tracker();"
        "print([m for m in sys.modules if 'strapdown' in m or 'spatial.transform' in m])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
