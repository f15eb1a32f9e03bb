"""Late measurements: applied in stamp order, with the same result as if they had been in time."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from netpos.estimation.state import POSITION
from netpos.messages.values import (
    Array,
    Field,
    GroundSpeed,
    ImuSample,
    InitialPose,
    RsuInfo,
    RsuMeasurement,
    TrackState,
    Velocity,
)
from netpos.tracking import Tracker, TrackerConfig, TrackOutput
from street_run import epochs, fed, ran, truth

T0 = 1_000_000_000
MS = 1_000_000
VARIANTS: dict[str, dict[str, Any]] = {
    "ekf": {"filter": "ekf", "process_noise": "werner"},
    "iekf": {"manoeuvre_speed_sd_mps": 3.0},
    "ukf": {"filter": "ukf", "robust": "huber"},
    "srukf": {"filter": "srukf"},
    "interacting": {"motion_model": "interacting"},
    "inertial": {"motion_model": "inertial"},
}


def noisy(world: Any, seed: int) -> Any:
    """The street with slow sensor errors of every kind."""
    world.rng = np.random.default_rng(seed)
    slow = {
        "range_bias_sd_m": 0.4,
        "azimuth_bias_sd_rad": 0.01,
        "bias_correlation_time_s": 20.0,
        "common_range_bias_sd_m": 0.3,
        "common_bias_correlation_time_s": 9.0,
        "noise_correlation_time_s": 0.05,
    }
    world.rsus = {n: replace(info, **slow) for n, info in world.rsus.items()}
    return world


def drive(world: Any, seed: int, seconds: float = 5.0) -> list[Any]:
    """A run in stamp order: RSUs of changing number, velocities, speeds, outliers, a jump."""
    rng = np.random.default_rng(seed)
    items: list[Any] = []
    for k in range(round(seconds / 0.1)):
        t = 0.1 * k
        state = truth(t)
        jumped = 1.0 <= t < 1.45
        if jumped:
            state[POSITION] += 250.0  # nobody believes it
        names = [n for n in "abc" if rng.random() < 0.9] or ["a"]
        found = world.measure(t, state, Field.AZIMUTH | Field.TOA, names)
        if rng.random() < 0.15 and t > 0.5:
            found[0] = replace(found[0], azimuth_rad=found[0].azimuth_rad + 1.0)
        items += [replace(m, expected=0) for m in found]
        stamp = found[0].stamp_ns
        if k % 3 == 0 and not jumped:
            v = np.array([8.0, 0.0]) + 0.3 * rng.normal(size=2)
            items.append(Velocity(stamp_ns=stamp, vue_id="vue_1", velocity=v, cov=0.1 * np.eye(2)))
        if k % 4 == 1 and not jumped:
            stamp += 13 * MS
            items.append(GroundSpeed(stamp_ns=stamp, vue_id="vue_1", speed_mps=8.1, speed_var=0.1))
    return items


def imu(seconds: float) -> list[ImuSample]:
    return [
        ImuSample(
            stamp_ns=T0 + round(k * 1e7),
            vue_id="vue_1",
            angular_velocity=np.array([0.0, 0.0, 0.02 * math.sin(k)]),
            specific_force=np.array([0.1 * math.cos(k), 0.0, 9.8]),
        )
        for k in range(round(seconds * 100) + 10)
    ]


def delayed(items: list[Any], delay_s: Iterable[float]) -> list[Any]:
    """Order of arrival when each item is under way for so long."""
    arrival = [i.stamp_ns + round(d * 1e9) for i, d in zip(items, delay_s, strict=True)]
    return [items[i] for i in np.argsort(arrival, kind="stable")]


def applied(tracker: Tracker, items: list[Any], often: float = 1.0, seed: int = 0) -> Any:
    """All outputs; ``process`` after a share of the items."""
    rng, outputs = np.random.default_rng(seed), []
    for item in items:
        assert tracker.add(item) is None
        if rng.random() < often:
            outputs += tracker.process()
    return outputs + tracker.flush()


def report(output: TrackOutput) -> list[Any]:
    """Every number of an output, bit by bit."""
    out: list[Any] = [repr(replace(output.status, rejected={})), output.status.rejected]
    for part in (output.odometry, output.clock):
        if part is not None:
            fields = [getattr(part, name) for name in part.__slots__]
            out += [f.tobytes() if isinstance(f, np.ndarray) else repr(f) for f in fields]
    return out


def state(tracker: Tracker) -> list[Any]:
    """All that a later epoch depends on, bit by bit."""
    s = tracker._tracks["vue_1"]._state
    e, b = s.estimator, s.estimator.biases
    estimate = [e.estimate.stamp_ns, e.estimate.mean.tobytes(), e.estimate.cov.tobytes()]
    biases = [b.sd, b.tau_s, b._slots, b._last_ns, e.bias.tobytes()]
    counts = [s.accepted, dict(s.rejected), s.rejected_in_row, s.last_accepted_ns, s.has_clock]
    scales = [s.rsus_scale.weights.tobytes(), s.device_scale.weights.tobytes()]
    return [estimate, biases, counts, e._yaw, scales]


def config_of(name: str, **change: Any) -> dict[str, Any]:
    short = {"hold_s": 0.1, "max_rejected_epochs": 3, "initial_window_s": 0.4}
    return short | VARIANTS[name] | change


@pytest.mark.parametrize("name", VARIANTS)
def test_late_within_the_history_is_as_good_as_in_time(world: Any, name: str) -> None:
    """Up to 0.95 s late, in random orders: estimate, counts, biases and last report are those
    of the orderly run to the last bit."""
    items = drive(noisy(world, 1), 2)
    if name == "inertial":
        items = sorted([*imu(5.0), *items], key=lambda item: item.stamp_ns)
    slow = np.array([not isinstance(item, ImuSample) for item in items])

    def run(order: list[Any], often: float, seed: int) -> tuple[Tracker, list[TrackOutput]]:
        tracker = world.tracker(**config_of(name))
        return tracker, applied(tracker, order, often, seed)

    orderly, outputs = run(items, 1.0, 0)
    expected, last = state(orderly), report(outputs[-1])
    assert outputs[-1].status.state is TrackState.TRACKING
    assert outputs[-1].status.rejected["gate"] > 8
    assert not any(o.revised for o in outputs)
    assert outputs[-1].status.rejected["track_lost"] >= 1
    for seed in range(4 if name in ("ekf", "iekf") else 2):
        rng = np.random.default_rng(seed)
        order = delayed(items, 0.95 * slow * rng.random(len(items)) ** 2)
        assert order != items
        tracker, outputs = run(order, (1.0, 0.3)[seed % 2], seed)
        assert state(tracker) == expected
        assert report(outputs[-1]) == last
        assert any(o.revised for o in outputs)
        stamps = [o.status.stamp_ns for o in outputs]
        assert stamps == sorted(stamps)  # what is published never goes back


@settings(max_examples=25, deadline=None)
@given(data=st.data(), hold_s=st.sampled_from([0.0, 0.1]), history_s=st.sampled_from([0.3, 0.7]))
def test_any_order_within_the_history(data: Any, hold_s: float, history_s: float) -> None:
    """Hypothesis looks for an order, and moments to process, that make a difference."""
    items, places = [], {"a": (0.0, 10.0), "b": (60.0, -10.0)}
    rng = np.random.default_rng(3)
    for k in range(14):
        for name, (x, y) in places.items():
            dx, dy = 20.0 + 0.8 * k - x, -y
            items.append(
                RsuMeasurement(
                    stamp_ns=T0 + 100 * MS * k,
                    rsu_id=name,
                    vue_id="vue_1",
                    expected=int(rng.integers(0, 3)),
                    fields=Field.AZIMUTH | Field.RANGE,
                    azimuth_rad=math.atan2(dy, dx) + rng.choice([0.01, 0.01, 2.0]) * rng.normal(),
                    azimuth_var=1e-4,
                    range_m=math.hypot(dx, dy),
                    range_var=0.09,
                )
            )

    def tracker() -> Tracker:
        out = Tracker(TrackerConfig(hold_s=hold_s, history_s=history_s, filter="ekf"))
        for name, xy in places.items():
            out.add_rsu(RsuInfo(rsu_id=name, position=np.array([*xy, 0.0])))
        return out

    orderly = tracker()
    last = report(applied(orderly, items)[-1])
    n = len(items)
    steps = int(history_s * 100)
    delays = data.draw(st.lists(st.integers(0, steps), min_size=n, max_size=n))
    flags = data.draw(st.lists(st.booleans(), min_size=n, max_size=n))
    shuffled, outputs = tracker(), []
    for item, flag in zip(delayed(items, [d / 100.0 for d in delays]), flags, strict=True):
        assert shuffled.add(item) is None
        outputs += shuffled.process() if flag else []
    outputs += shuffled.flush()
    assert state(shuffled) == state(orderly)
    assert report(outputs[-1]) == last


def test_order_does_not_decide_who_is_isolated(world: Any) -> None:
    """RSU b turns its array by 20 degrees: found by two devices, isolated, and the same tracks in
    any order."""
    world.rng = np.random.default_rng(5)
    items = []
    for k in range(120):
        for vue_id in ("vue_1", "vue_2"):
            fields = Field.AZIMUTH | Field.RANGE
            found = world.measure(0.1 * k, truth(0.1 * k), fields, vue_id=vue_id)
            if k > 30:
                found[1] = replace(found[1], azimuth_rad=found[1].azimuth_rad + 0.35)
            items += found

    def run(delays: Array) -> Any:
        tracker = world.tracker(hold_s=0.1)
        outputs = applied(tracker, delayed(items, delays))
        last = [next(o for o in outputs[::-1] if o.status.vue_id == v) for v in ("vue_1", "vue_2")]
        texts = [r.text for r in tracker.rsu_reports()]
        return last, [state(tracker), [report(o) for o in last], texts]

    last, orderly = run(np.zeros(len(items)))
    assert all(o.status.rejected["isolated_rsu"] > 30 for o in last)
    for seed in range(3):
        assert run(0.9 * np.random.default_rng(seed).random(len(items)))[1] == orderly


# one late item


def test_a_late_item_joins_the_epoch_it_belongs_to(world: Any) -> None:
    world.rng = np.random.default_rng(7)
    batches = epochs(world, 10)
    late = batches[4].pop(1)
    tracker = ran(world, batches)
    assert tracker._tracks["vue_1"]._state.accepted == 29
    (output,) = fed(tracker, [late])
    assert output.revised
    assert output.status.stamp_ns == batches[-1][0].stamp_ns  # of the newest epoch, once more
    assert output.status.accepted == 30
    assert output.status.sources == ("a", "b", "c")
    world.rng = np.random.default_rng(7)
    assert state(tracker) == state(ran(world, epochs(world, 10)))


def test_a_late_item_makes_an_epoch_of_its_own(world: Any) -> None:
    world.rng = np.random.default_rng(8)
    batches = epochs(world, 10)
    between = world.measure(0.45, truth(0.45), names=["b"])
    tracker = ran(world, batches)
    (output,) = fed(tracker, between)
    assert (output.revised, output.status.accepted) == (True, 31)
    assert state(tracker) == state(ran(world, [*batches[:5], between, *batches[5:]]))
    # and more of the same stamp joins it
    (more,) = fed(tracker, [replace(between[0], rsu_id="a", azimuth_rad=2.0)])
    assert more.status.accepted + more.status.rejected.get("gate", 0) == 32
    assert tracker.add(between[0]) == "duplicate"


def test_late_and_new_at_once_say_only_what_is_new(world: Any) -> None:
    """Each stamp is reported once; ``revised`` only where nothing newer is there to say."""
    batches = epochs(world, 10)
    late = batches[4].pop(0)
    tracker = ran(world, batches[:9])
    outputs = fed(tracker, [late, *batches[9]])
    assert [(o.status.stamp_ns, o.revised) for o in outputs] == [(batches[9][0].stamp_ns, False)]
    assert state(tracker) == state(ran(world, epochs(world, 10)))


def test_late_before_the_first_epoch(world: Any) -> None:
    """The first fix, too, is taken again."""
    batches = epochs(world, 6)
    tracker = ran(world, batches[1:])
    fed(tracker, batches[0])
    assert state(tracker) == state(ran(world, batches))


@pytest.mark.parametrize("history_s", [0.0, 0.5, 1.0])
def test_older_than_the_history_is_refused_and_counted(world: Any, history_s: float) -> None:
    batches = epochs(world, 30)
    tracker = ran(world, batches, history_s=history_s)
    tracker.add_rsu(replace(world.rsus["a"], rsu_id="z"))  # whose other stamps are not near
    newest = batches[-1][0].stamp_ns
    before = state(tracker)
    at_the_edge = newest - round(history_s * 1e9)
    item = replace(batches[-1][0], rsu_id="z", fields=Field.RANGE, stamp_ns=at_the_edge - 1)
    assert tracker.add(item) == "late"
    assert tracker.process() == []
    assert state(tracker) == before
    assert tracker.rejected()["vue_1"]["late"] == 1
    if history_s > 0.0:
        (output,) = fed(tracker, [replace(item, stamp_ns=at_the_edge + 1)])
        assert output.status.rejected["late"] == 1
        assert output.revised


def test_duplicates_among_late_items(world: Any) -> None:
    batches = epochs(world, 10)
    late = batches[4].pop(1)
    tracker = ran(world, batches)
    assert tracker.add(late) is None
    assert tracker.add(late) == "duplicate"  # of one that waits
    tracker.process()
    assert tracker.add(late) == "duplicate"  # of one that was merged
    assert tracker.add(batches[4][0]) == "duplicate"  # of one that was in time
    assert tracker.process() == []
    assert tracker.rejected()["vue_1"] == {"duplicate": 3}
    assert state(tracker) == state(ran(world, epochs(world, 10)))


@pytest.mark.parametrize("merged", [False, True])
def test_a_measurement_that_another_contradicts_is_taken_back(world: Any, merged: bool) -> None:
    """The track is then that of a run without either of them."""
    batches = epochs(world, 10)
    lie = replace(batches[4][1], azimuth_rad=batches[4][1].azimuth_rad + 0.1)
    late = batches[4].pop(1)
    tracker = ran(world, batches)
    assert tracker.add(late) is None
    if merged:
        tracker.process()
    assert tracker.add(lie) == "conflict"
    tracker.process()
    assert tracker.add(late) == "conflict"
    assert tracker.process() == []
    assert tracker.rejected()["vue_1"] == {"conflict": 3}
    words = tracker.refusals.rsus()[late.rsu_id].words()
    assert "neither is used" in words
    assert state(tracker) == state(ran(world, batches))


def test_without_history_nothing_goes_back(world: Any) -> None:
    batches = epochs(world, 10)
    tracker = ran(world, batches, history_s=0.0)
    before = state(tracker)
    assert tracker.add(world.measure(0.45, truth(0.45))[0]) == "late"
    again = replace(batches[-1][0], rsu_id="a")
    assert tracker.add(again) == "duplicate"
    assert tracker.process() == []
    assert state(tracker) == before
    history = tracker._tracks["vue_1"]._history
    assert not history._epochs  # and nothing is kept
    assert not history._snapshots
    # dt = 0: the missing RSU of the last stamp is an epoch of its own; alone it may show a turn
    straight = {"history_s": 0.0, "manoeuvre_speed_sd_mps": 0.0}
    tracker = ran(world, batches, **straight)
    partial = ran(world, [*batches[:9], batches[9][:2]], **straight)
    (output,) = fed(partial, batches[9][2:])
    assert (output.status.used, output.revised) == (1, False)
    np.testing.assert_allclose(
        partial._tracks["vue_1"]._state.estimator.estimate.mean[:4],
        tracker._tracks["vue_1"]._state.estimator.estimate.mean[:4],
        atol=1e-3,
    )


def test_history_is_bounded(world: Any) -> None:
    """No more is kept than the history needs, however long the run."""
    tracker = ran(world, epochs(world, 60), history_s=0.5)
    track, sequencer = tracker._tracks["vue_1"], tracker._sequencers["vue_1"]
    assert 6 <= len(track._history._epochs) <= 8
    assert len(track._history._snapshots) <= 6
    assert len(sequencer._applied) == 6


# a late initial pose


BESIDE = np.array([7.7, -0.5, 0.0])


def pose(t_s: float) -> InitialPose:
    """Where the device is 0.9 s after the start, to a metre: the measurements permit it."""
    position = BESIDE
    stamp = T0 + round(t_s * 1e9)
    return InitialPose(stamp_ns=stamp, vue_id="vue_1", position=position, cov=np.eye(3))


def test_a_late_initial_pose_counts_from_the_newest_epoch_on(world: Any) -> None:
    """It tells where the device is, whatever its stamp: the running track is replaced."""
    for stamp_s in (0.2, -1.0):
        tracker = ran(world, epochs(world, 10))
        (output,) = fed(tracker, [pose(stamp_s)]) or tracker.flush()
        assert output.status.stamp_ns == T0 + 900 * MS
        np.testing.assert_allclose(output.odometry.position, BESIDE)
        assert output.status.accepted == 30


def test_a_late_pose_outlives_a_late_measurement(world: Any) -> None:
    """What is late is merged into the past; the pose given after it still holds."""
    batches = epochs(world, 10)
    late = batches[7].pop()
    tracker = ran(world, batches)
    fed(tracker, [pose(0.2)])
    tracker.flush()
    (output,) = fed(tracker, [late])
    np.testing.assert_allclose(output.odometry.position, BESIDE)
    assert output.status.accepted == 30
    assert tracker.add(batches[9][0]) == "duplicate"


@pytest.mark.parametrize(
    ("late_s", "expected"),
    [(0.05, 3), (0.05, 0), (0.0, 1), (0.0, 9), (0.05, 1)],
    ids=["late", "late, nobody says how many", "one said", "nine said", "late, one said"],
)
def test_a_late_rsu_or_a_wrong_number_does_not_multiply_the_odometry(
    world: Any, late_s: float, expected: int
) -> None:
    """Three RSUs hear a beacon 50 times a second; what one sends comes late."""
    sent = []
    for k in range(200):
        t = 0.02 * k
        for name in "abc":
            (found,) = world.measure(t, truth(t), Field.AZIMUTH | Field.TOA, [name])
            delay = late_s if name == "c" else 0.0
            sent.append((t + delay, len(sent), replace(found, expected=expected)))
    tracker = Tracker(TrackerConfig())
    for info in world.rsus.values():
        tracker.add_rsu(info)
    given_out: list[TrackOutput] = []
    for _, _, item in sorted(sent, key=lambda entry: entry[:2]):
        tracker.add(item)
        given_out += tracker.process()
    given_out += tracker.flush()
    stamps = [out.odometry.stamp_ns for out in given_out if out.odometry is not None]
    assert len(set(stamps)) >= 198
    assert len(stamps) <= len(set(stamps)) + 6
