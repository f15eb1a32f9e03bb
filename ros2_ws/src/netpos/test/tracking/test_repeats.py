"""A sensor that repeats its values is refused where neither its noise nor its past explains it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from netpos.messages.values import (
    Field,
    GroundSpeed,
    ImuSample,
    RsuInfo,
    RsuMeasurement,
    Velocity,
)
from netpos.tracking import Tracker, TrackerConfig
from netpos.tracking.door.repeats import Repeats
from netpos.tracking.health.diagnosis import Level
from scipy.stats import norm

NS = 1_000_000_000
RISK = 1e-9
PLACES = {"a": (0.0, 0.0), "b": (60.0, 0.0), "c": (30.0, 50.0)}


def ranged(range_m: float, k: int, sd_m: float = 1.0, rsu_id: str = "a") -> RsuMeasurement:
    return RsuMeasurement(
        stamp_ns=NS + k * NS // 10,
        rsu_id=rsu_id,
        vue_id="v",
        fields=Field.RANGE,
        range_m=range_m,
        range_var=sd_m**2,
    )


def refused(
    repeats: Repeats, ranges: list[float], first: int = 0, sd_m: float = 1.0
) -> list[bool]:
    return [repeats.stuck(ranged(r, first + k, sd_m)) for k, r in enumerate(ranges)]


def first_refused(chance: float) -> int:
    """The shortest run of repeats that is less likely than the risk."""
    run = 1
    while chance**run >= RISK:
        run += 1
    return run


@pytest.mark.parametrize("step", [0.001, 0.3, 1.0, 3.0])
def test_a_rounded_sensor_whose_device_stands_is_never_refused(step: float) -> None:
    """It repeats itself as often as its noise lets it: in half of 20,000 messages and more."""
    noise = np.random.default_rng(3).standard_normal(20_000)
    ranges = (step * np.round((7.0 + noise) / step)).tolist()
    assert not any(refused(Repeats(), ranges))
    repeated = np.mean(np.diff(ranges) == 0.0)
    assert (repeated > 0.5) == (step == 3.0)


def test_a_sensor_quieter_than_it_says_is_believed_by_its_past() -> None:
    """It never repeats itself on the way; then the device stands, and its sd is 60 times that of
    what is left of the noise."""
    rng = np.random.default_rng(4)
    moving = np.round(0.7 * np.arange(300) + rng.standard_normal(300), 2)
    standing = np.round(200.0 + 0.5 * 0.01 * rng.standard_normal(5000), 2)
    said = refused(Repeats(), [*moving.tolist(), *standing.tolist()], sd_m=0.3)
    assert not any(said[:300])
    assert sum(said[300:]) < 0.02 * 5000
    assert not any(said[2800:])


def test_a_sensor_whose_repeats_come_in_runs_is_soon_believed() -> None:
    """A person walks for ten seconds and stands for ten, again and again; one repeat in five
    messages, but 40 in a row: as they were independent, a run of 14 would be less likely than the
    risk."""
    rng, values = np.random.default_rng(10), [0.0]
    while len(values) < 20_000:
        values += rng.standard_normal(160).tolist()
        values += [values[-1]] * int(rng.geometric(1.0 / 40.0))
    said = refused(Repeats(), values)
    share = float(np.mean(np.diff(values) == 0.0))
    assert first_refused(share) < 15
    assert sum(said) < 0.01 * len(said)
    assert sum(said[10_000:]) < 0.001 * len(said)


def test_the_first_repeat_too_many_by_what_is_usual() -> None:
    """98 other values, by Laplace's rule one repeat in 100: the fifth in a row."""
    repeats = Repeats()
    assert not any(refused(repeats, [0.1 * k * k * 1e-3 for k in range(99)], sd_m=1e3))
    said = refused(repeats, [0.1 * 98 * 98 * 1e-3] * 8, first=99, sd_m=1e3)
    assert said.index(True) + 1 == first_refused(1.0 / 100.0) == 5
    assert all(said[4:])


@pytest.mark.parametrize("sds", [0.5, 1.0, 2.0])
def test_the_first_repeat_too_many_by_noise(sds: float) -> None:
    """A grid of 1 m: no cell holds more than the one about the mean."""
    repeats = Repeats()
    assert not any(refused(repeats, [float(k) for k in range(99)], sd_m=sds))
    said = refused(repeats, [98.0] * 200, first=99, sd_m=sds)
    chance = float(norm.cdf(0.5 / sds) - norm.cdf(-0.5 / sds))
    assert said.index(True) + 1 == first_refused(chance)


def test_it_is_taken_again_with_the_next_other_value() -> None:
    repeats = Repeats()
    refused(repeats, [float(k % 50) + 1e-3 * k for k in range(300)])
    assert refused(repeats, [7.0] * 30, first=300)[-1]
    assert refused(repeats, [7.001, 7.001], first=330) == [False, False]


def test_a_message_that_comes_twice_is_no_repeat() -> None:
    repeats = Repeats()
    refused(repeats, [float(k % 50) + 1e-3 * k for k in range(300)])
    assert not any(repeats.stuck(ranged(7.0, 300)) for _ in range(30))


def test_of_a_sensor_that_has_never_said_anything_else_nothing_is_known() -> None:
    assert not any(refused(Repeats(), [7.0] * 1000))
    still = ImuSample(
        stamp_ns=NS, vue_id="v", angular_velocity=np.zeros(3), specific_force=np.ones(3)
    )
    imu = Repeats()
    assert not any(imu.stuck(replace(still, stamp_ns=NS + k)) for k in range(1000))


def test_a_pair_that_is_new_has_the_past_of_its_rsu() -> None:
    repeats, rng = Repeats(), np.random.default_rng(5)

    def tdoa(value: float, reference: str, k: int) -> RsuMeasurement:
        return replace(
            ranged(0.0, k),
            fields=Field.TDOA,
            tdoa_s=value,
            tdoa_var=1e-16,
            reference_rsu_id=reference,
        )

    for k in range(99):
        assert not repeats.stuck(tdoa(1e-8 * float(rng.standard_normal()), "b", k))
    said = [repeats.stuck(tdoa(3e-9, "c", 99 + k)) for k in range(8)]
    assert said.index(True) == 5


def test_every_value_has_to_be_repeated() -> None:
    """An azimuth that is stuck beside a range that is not."""
    repeats, rng = Repeats(), np.random.default_rng(6)
    both = {"fields": Field.RANGE | Field.AZIMUTH, "azimuth_var": 1e-4}
    for k in range(500):
        azimuth = float(rng.standard_normal()) if k < 200 else 0.5
        m = replace(ranged(float(rng.standard_normal()), k), azimuth_rad=azimuth, **both)  # type: ignore[arg-type]
        assert not repeats.stuck(m)


def test_positions_are_compared_too() -> None:
    repeats, rng = Repeats(), np.random.default_rng(7)
    said = []
    for k in range(120):
        position = np.append(rng.standard_normal(2) if k < 100 else [1.0, 2.0], 0.0)
        m = replace(
            ranged(0.0, k), fields=Field.POSITION, position=position, position_cov=np.eye(3)
        )
        said.append(repeats.stuck(m))
    assert not any(said[:104])
    assert all(said[106:])


def measured(
    k: int, rng: np.random.Generator, frozen: bool, kept: dict[str, float]
) -> list[RsuMeasurement]:
    """Ranges of a device at 2 m/s, 10 times a second."""
    at = np.array([10.0 + 0.2 * k, 20.0])
    items = []
    for name, place in PLACES.items():
        if not frozen:
            kept[name] = float(np.hypot(*(at - place))) + 0.1 * float(rng.standard_normal())
        items.append(replace(ranged(kept[name], k, 0.1, name), expected=3))
    return items


def run(seconds: tuple[float, float], **parameters: object) -> Tracker:
    """A tracker after so many seconds, and after so many more in which all RSUs are stuck."""
    tracker = Tracker(TrackerConfig(hold_s=0.0, **parameters))  # type: ignore[arg-type]
    for name, (x, y) in PLACES.items():
        tracker.add_rsu(RsuInfo(rsu_id=name, position=np.array([x, y, 0.0])))
    rng, kept = np.random.default_rng(8), {}
    healthy, stuck = (round(10 * s) for s in seconds)
    for k in range(healthy + stuck):
        for item in measured(k, rng, k >= healthy, kept):
            tracker.add(item)
        tracker.process()
    return tracker


def test_the_tracker_refuses_names_and_counts() -> None:
    assert not run((15.0, 0.0)).rejected()["v"]["repeated"]
    tracker = run((10.0, 5.0))
    assert tracker.rejected()["v"]["repeated"] == 3 * (50 - 4)
    findings = {finding.subject: finding for finding in tracker.findings({}, {})}
    for name in PLACES:
        assert findings[f"rsu {name}"].level >= Level.WARN
        assert "repeated: its values stay the same" in findings[f"rsu {name}"].message


def test_it_can_be_switched_off() -> None:
    assert not run((10.0, 5.0), isolate_rsus=False).rejected()["v"]["repeated"]


def test_a_stuck_imu_is_left_out() -> None:
    tracker = Tracker(TrackerConfig(motion_model="inertial"))
    rng = np.random.default_rng(9)
    sample = ImuSample(
        stamp_ns=NS, vue_id="v", angular_velocity=np.zeros(3), specific_force=np.zeros(3)
    )
    for k in range(200):
        values = rng.standard_normal((2, 3)) if k < 100 else np.ones((2, 3))
        moved = replace(
            sample,
            stamp_ns=NS + k * NS // 100,
            angular_velocity=values[0],
            specific_force=values[1],
        )
        reason = tracker.add(moved)
        assert (reason == "repeated") == (k > 104)
    assert tracker.rejected()["v"] == {"imu_repeated": 95}


def stepped(k: int, east: float, north: float, var: float = 0.04) -> Velocity:
    """What dead reckoning says, 10 times a second."""
    velocity, cov = np.array([east, north]), var * np.eye(2)
    return Velocity(stamp_ns=NS + k * NS // 10, vue_id="v", velocity=velocity, cov=cov)


def steps(number: int, seed: int) -> list[tuple[float, float]]:
    """Velocities of a walker, each of a step that lasts 0.4 to 0.8 s."""
    rng, said = np.random.default_rng(seed), []
    while len(said) < number:
        heading, speed = 0.3 * rng.standard_normal(), 1.2 + 0.1 * rng.standard_normal()
        east, north = float(speed * np.cos(heading)), float(speed * np.sin(heading))
        said += [(east, north)] * int(rng.integers(4, 9))
    return said[:number]


def test_a_velocity_that_is_held_with_a_growing_covariance_is_no_repeat() -> None:
    repeats = Repeats()
    for k in range(500):
        assert not repeats.stuck(stepped(k, 1.0 + 0.1 * (k // 250), 0.2, var=0.04 + 1e-4 * k))


def test_steps_that_repeat_too_often_are_refused() -> None:
    """98 that differ in value or covariance, as of an RSU: the fifth repeat in a row."""
    repeats = Repeats()
    for k, (east, north) in enumerate(steps(99, seed=11)):
        assert not repeats.stuck(stepped(k, east, north, var=0.04 + 1e-3 * k))
    said = [repeats.stuck(stepped(99 + k, 1.0, 0.5)) for k in range(9)]
    assert said == [False] * 5 + [True] * 4
    assert not repeats.stuck(stepped(108, 1.0, 0.4))


def test_a_source_that_holds_every_step_with_its_covariance_is_believed() -> None:
    """Most of its messages are repeats; then it is stuck."""
    repeats = Repeats()
    said = [repeats.stuck(stepped(k, *v)) for k, v in enumerate(steps(20_000, seed=12))]
    assert not any(said)
    stuck = [repeats.stuck(stepped(20_000 + k, 0.9, 0.1)) for k in range(300)]
    assert 50 < stuck.index(True) < 150


def test_a_pedometer_with_one_speed_and_rounded_headings_is_believed() -> None:
    """It says the same on every straight leg, most of which last half a minute."""
    repeats, rng, k = Repeats(), np.random.default_rng(13), 0
    for _ in range(300):
        heading = np.deg2rad(15.0 * rng.integers(24))
        for _ in range(int(rng.geometric(1.0 / 300.0))):
            east, north = float(1.2 * np.cos(heading)), float(1.2 * np.sin(heading))
            assert not repeats.stuck(stepped(k, east, north))
            k += 1
    assert k > 50_000


def test_who_rests_may_rest_for_hours() -> None:
    """And nothing is learned from it: a step that is stuck later is refused as soon as ever."""
    repeats, k = Repeats(), 0
    for east, north in steps(99, seed=11):
        assert not repeats.stuck(stepped(k, east, north, var=0.04 + 1e-3 * k))
        k += 1
    for _ in range(36_000):
        assert not repeats.stuck(stepped(k, 2e-15, 0.0))
        k += 1
    said = [repeats.stuck(stepped(k + j, 1.0, 0.5)) for j in range(9)]
    assert said == [False] * 5 + [True] * 4


@pytest.mark.parametrize(("var", "judged"), [(0.499, True), (0.501, False)])
def test_rest_is_a_velocity_within_its_standard_deviation(var: float, judged: bool) -> None:
    repeats = Repeats()
    for k, (east, north) in enumerate(steps(99, seed=11)):
        repeats.stuck(stepped(k, 2.0 * east, 2.0 * north, var=0.04 + 1e-3 * k))
    said = [repeats.stuck(stepped(99 + k, 0.6, 0.8, var)) for k in range(20)]
    assert any(said) == judged


def test_a_ground_speed_is_judged_likewise() -> None:
    repeats, rng = Repeats(), np.random.default_rng(14)
    speeds = [*(10.0 + rng.standard_normal(99)).tolist(), *[0.0] * 500, *[9.0] * 9]
    said = [
        repeats.stuck(
            GroundSpeed(stamp_ns=NS + k * NS // 10, vue_id="v", speed_mps=s, speed_var=0.01)
        )
        for k, s in enumerate(speeds)
    ]
    assert said == [False] * (99 + 500 + 5) + [True] * 4


def walked(seconds: tuple[float, float], **parameters: object) -> Tracker:
    """A tracker after so many seconds of a walk to the north, with ranges each second and steps;
    then so many to the east, in which the steps are stuck at what was said last."""
    tracker = Tracker(TrackerConfig(hold_s=0.0, **parameters))  # type: ignore[arg-type]
    for name, (x, y) in PLACES.items():
        tracker.add_rsu(RsuInfo(rsu_id=name, position=np.array([x, y, 0.0])))
    rng, (healthy, stuck) = np.random.default_rng(15), (round(10 * s) for s in seconds)
    said = (0.0, 0.0)
    for k in range(healthy + stuck):
        north, east = 0.1 * min(k, healthy), 0.1 * max(k - healthy, 0)
        at = np.array([20.0 + east, 5.0 + north])
        if k < healthy:
            said = 0.05 * float(rng.standard_normal()), 1.0 + 0.05 * float(rng.standard_normal())
        tracker.add(stepped(k, *said, var=0.01))
        for name, place in PLACES.items() if k % 10 == 0 else ():
            range_m = float(np.hypot(*(at - place))) + 0.1 * float(rng.standard_normal())
            tracker.add(replace(ranged(range_m, k, 0.1, name), expected=3))
        tracker.process()
    return tracker


def test_the_tracker_refuses_stuck_steps() -> None:
    assert not walked((15.0, 0.0)).rejected()["v"]["repeated"]
    tracker = walked((10.0, 8.0))
    assert tracker.rejected()["v"]["repeated"] == 80 - 4
    words = tracker.refusals.of_device("v").words()
    assert "repeated: its values stay the same" in words
    assert words.endswith("(from step_velocity)")
    assert not walked((10.0, 8.0), isolate_rsus=False).rejected()["v"]["repeated"]


def test_the_memory_has_an_end() -> None:
    repeats = Repeats()
    for k in range(3000):
        repeats.stuck(replace(ranged(1.0, k), vue_id=f"v{k}"))
    assert len(repeats._sources) == 1000
