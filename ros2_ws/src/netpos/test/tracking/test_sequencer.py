"""Stamp order and epochs whatever the order of arrival."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from netpos.messages.values import Field, GroundSpeed, InitialPose, RsuMeasurement, Velocity
from netpos.tracking.ordering.history import merge
from netpos.tracking.ordering.sequencer import IMU, Epoch, Item, Sequencer, channel_and_source

MS = 1_000_000
HOLD = 250 * MS


def rsu(stamp_ms: int, rsu_id: str = "a", expected: int = 0) -> RsuMeasurement:
    return RsuMeasurement(stamp_ns=stamp_ms * MS, rsu_id=rsu_id, vue_id="v", expected=expected)


def velocity(stamp_ms: int, source: str = "step_velocity") -> Velocity:
    return Velocity(
        stamp_ns=stamp_ms * MS, vue_id="v", velocity=np.zeros(2), cov=np.eye(2), source=source
    )


def speed(stamp_ms: int) -> GroundSpeed:
    return GroundSpeed(stamp_ns=stamp_ms * MS, vue_id="v", speed_mps=1.0, speed_var=1.0)


def pose(stamp_ms: int) -> InitialPose:
    return InitialPose(stamp_ns=stamp_ms * MS, vue_id="v", position=np.zeros(3), cov=np.eye(3))


def feed(sequencer: Sequencer, items: list[Item]) -> list[list[Item]]:
    """Items of the epochs in order of release; releases after each arrival, then the end."""
    epochs: list[Epoch] = []
    for item in items:
        assert sequencer.add(item) is None
        epochs += sequencer.release()
    epochs += sequencer.flush()
    return [list(epoch.sorted()) for epoch in epochs]


def stamps_ms(epochs: list[Epoch]) -> list[int]:
    return [e.stamp_ns // MS for e in epochs]


def test_channels() -> None:
    assert channel_and_source(rsu(1, "b")) == ("rsu", "b")
    assert channel_and_source(velocity(1, "shoe")) == ("shoe", "shoe")
    assert channel_and_source(speed(1)) == ("ground_speed", "ground_speed")
    assert channel_and_source(pose(1)) == ("initial_pose", "")


def test_order_within_an_epoch_is_by_channel_and_source() -> None:
    items = [rsu(1, "b"), velocity(1), rsu(1, "a"), pose(1), speed(1)]
    for order in permutations(items):
        sequencer = Sequencer(HOLD)
        for item in order:
            assert sequencer.add(item) is None
        (epoch,) = sequencer.flush()
        assert epoch.stamp_ns == MS
        assert [channel_and_source(i) for i in epoch.sorted()] == [
            ("ground_speed", "ground_speed"),
            ("initial_pose", ""),
            ("rsu", "a"),
            ("rsu", "b"),
            ("step_velocity", "step_velocity"),
        ]


# when an epoch is complete


@pytest.mark.parametrize(
    ("measured", "complete"),
    [
        ([], True),  # no RSU in it
        ([0], False),  # nobody said how many
        ([1], True),
        ([2], False),
        ([2, 2], True),
        ([2, 3], False),  # the largest announcement counts
        ([0, 2], True),
        ([1, 1], True),  # more than announced
    ],
)
def test_expected_counts(measured: list[int], complete: bool) -> None:
    epoch = Epoch(MS)
    for i, expected in enumerate(measured):
        item = rsu(1, str(i), expected)
        epoch.put(channel_and_source(item), item)
    epoch.put(channel_and_source(velocity(1)), velocity(1))
    assert epoch.rsu_complete() is complete


def test_complete_epoch_is_released_at_once() -> None:
    s = Sequencer(HOLD)
    s.add(rsu(100, "a", 2))
    assert s.release() == []
    s.add(rsu(100, "b", 2))
    (epoch,) = s.release()
    assert [i.rsu_id for i in epoch.sorted()] == ["a", "b"]
    assert s.release() == []


def test_unannounced_epoch_waits_for_the_next_stamp_of_the_rsus() -> None:
    s = Sequencer(HOLD)
    s.add(rsu(100, "a"))
    s.add(rsu(100, "b"))
    assert s.release() == []
    s.add(rsu(101, "a"))
    assert stamps_ms(s.release()) == [100]
    assert stamps_ms(s.flush()) == [101]


def test_a_live_channel_is_waited_for() -> None:
    s = Sequencer(HOLD)
    s.add(velocity(50))
    assert stamps_ms(s.release()) == [50]
    s.add(rsu(100, expected=1))
    assert s.release() == []  # a velocity of stamp 100 or before may come
    s.add(velocity(99))
    assert stamps_ms(s.release()) == [99]  # its own epoch is free of RSUs and reached by them
    s.add(velocity(100))
    (epoch,) = s.release()
    assert len(epoch.items) == 2


@pytest.mark.parametrize(("hold_ms", "limit_ms"), [(250, 1000), (5000, 5000)])
def test_a_channel_silent_for_a_second_and_the_hold_is_not_waited_for(
    hold_ms: int, limit_ms: int
) -> None:
    for silence_ns, waits in ((limit_ms * MS, True), (limit_ms * MS + 1, False)):
        s = Sequencer(hold_ms * MS)
        s.add(velocity(50))
        s.release()
        s.add(replace(rsu(50, expected=1), stamp_ns=50 * MS + silence_ns))
        assert (s.release() == []) is waits


def test_an_initial_pose_is_never_waited_for() -> None:
    s = Sequencer(HOLD)
    s.add(pose(10))
    s.add(rsu(20, expected=1))
    assert stamps_ms(s.release()) == [10, 20]
    s.add(rsu(30, expected=1))
    assert stamps_ms(s.release()) == [30]


def test_an_initial_pose_shares_the_epoch_of_the_measurements_of_its_stamp() -> None:
    """However long they take to follow it: one epoch, not two of one stamp."""
    s = Sequencer(HOLD)
    s.add(pose(10))
    assert s.release() == []
    s.add(rsu(10, "a", 2))
    assert s.release() == []
    s.add(rsu(10, "b", 2))
    (epoch,) = s.release()
    assert len(epoch.items) == 3


@pytest.mark.parametrize(("ahead_ms", "released"), [(249, False), (250, True), (251, True)])
def test_hold_at_its_boundary(ahead_ms: int, released: bool) -> None:
    """What is missing is waited for until the newest stamp is ``hold`` ahead."""
    s = Sequencer(HOLD)
    s.add(velocity(90))
    s.release()
    s.add(rsu(100, "a", 2))
    s.add(velocity(100 + ahead_ms))
    assert stamps_ms(s.release()) == ([100] if released else [])


def test_hold_counts_from_each_epoch() -> None:
    s = Sequencer(HOLD)
    s.add(rsu(100, "a", 9))
    s.add(rsu(200, "a", 9))
    s.add(rsu(300, "a", 9))
    assert stamps_ms(s.release()) == [100, 200]  # a later stamp of the RSUs closes an epoch
    s.add(velocity(549))
    assert s.release() == []
    s.add(velocity(550))
    assert stamps_ms(s.release()) == [300]  # 550 waits for the RSUs, which are live


def test_hold_zero_waits_for_nothing() -> None:
    s = Sequencer(0)
    s.add(velocity(50))
    assert stamps_ms(s.release()) == [50]
    s.add(rsu(100, "a", 5))
    assert stamps_ms(s.release()) == [100]
    assert s.add(rsu(100, "b", 5)) is None  # same stamp again: another epoch
    assert stamps_ms(s.release()) == [100]
    assert s.add(velocity(99)) == "late"


def test_flush_releases_everything_in_order() -> None:
    s = Sequencer(HOLD)
    for stamp in (300, 100, 200):
        s.add(velocity(stamp, f"source {stamp}"))
    assert stamps_ms(s.flush()) == [100, 200, 300]
    assert s.flush() == []
    assert s.release() == []
    assert s.add(velocity(299)) == "late"
    assert s.add(velocity(300, "other")) is None


# refusals


def test_duplicates_are_refused_before_and_after_release() -> None:
    s = Sequencer(HOLD)
    assert s.add(rsu(100, "a", 2)) is None
    assert s.add(rsu(100, "a", 2)) == "duplicate"
    assert s.add(rsu(100, "b", 2)) is None
    s.release()
    assert s.add(rsu(100, "b", 2)) == "duplicate"
    assert s.add(rsu(100, "c", 2)) is None
    assert s.add(rsu(100, "c", 2)) == "duplicate"
    assert len(s.flush()[0].items) == 1


def measured(stamp_ms: int, rsu_id: str, range_m: float, expected: int = 2) -> RsuMeasurement:
    return replace(rsu(stamp_ms, rsu_id, expected), range_m=range_m, fields=Field.RANGE)


def test_two_that_differ_are_both_refused() -> None:
    """Nobody knows which of them is the RSU's; a third one changes nothing, and nobody waits."""
    s = Sequencer(HOLD)
    first = measured(100, "a", 5.0)
    assert s.add(first) is None
    assert s.add(replace(first, sequence=7, rssi_dbm=-80.0)) == "duplicate"
    assert s.add(measured(100, "a", 6.0)) == "conflict"
    assert s.take_refused() == [(first, "conflict")]
    assert s.add(measured(100, "a", 5.0)) == "conflict"
    assert s.take_refused() == []
    assert s.add(measured(100, "b", 5.0)) is None
    (epoch,) = s.release()
    assert [item.rsu_id for item in epoch.items.values()] == ["b"]  # type: ignore[union-attr]


def test_two_late_ones_that_differ_are_both_refused() -> None:
    s = Sequencer(HOLD, history_ns=HOLD)
    s.add(measured(100, "a", 5.0, 1))
    s.add(measured(200, "a", 5.0, 1))
    s.release()
    late = measured(150, "b", 5.0)
    assert s.add(late) is None
    assert s.add(measured(150, "b", 6.0)) == "conflict"
    assert s.take_refused() == [(late, "conflict")]
    assert s.add(measured(150, "b", 7.0)) == "conflict"
    assert [item.range_m for _, item in s.take_late()] == [5.0, 6.0]  # type: ignore[union-attr]


def test_late_is_before_the_last_released_epoch() -> None:
    s = Sequencer(HOLD)
    s.add(rsu(100, "a", 1))
    s.release()
    assert s.add(velocity(99)) == "late"
    assert s.add(velocity(100)) is None


def test_older_than_pending_but_not_released_is_in_time() -> None:
    s = Sequencer(HOLD)
    s.add(rsu(100, "a", 2))
    assert s.add(velocity(90)) is None
    assert stamps_ms(s.flush()) == [90, 100]


def test_late_initial_pose_is_applied_at_the_last_released_stamp() -> None:
    """Tools stamp it 0 or with another clock's time."""
    for stamp in (0, 50):
        t = Sequencer(HOLD)
        t.add(velocity(100))
        t.flush()
        assert t.add(pose(stamp)) is None
        t.add(velocity(110))
        assert stamps_ms(t.flush()) == [100, 110]


def test_a_pose_waits_for_a_measurement_through_any_silence() -> None:
    """Both are then one epoch, however long the first measurement takes to come."""
    s = Sequencer(HOLD)
    assert s.add(pose(100)) is None
    assert s.release() == []
    assert s.flush() == []
    assert s.add(rsu(100, "a", 1)) is None
    assert [len(epoch.items) for epoch in s.release() + s.flush()] == [2]


# the property


def stream(name: str, stamps: list[int]) -> list[Item]:
    if name == "rsu":
        return [rsu(t, i, 2) for t in stamps for i in ("a", "b")]
    return [velocity(t, name) for t in stamps]


@st.composite
def interleavings(draw: st.DrawFn) -> tuple[list[Item], list[Item]]:
    """Channels with stamps 40..60 ms apart, and two orders of arrival.

    In both, each channel is in stamp order and never lags the newest stamp by the hold.
    """
    channels = []
    for name in ("rsu", "shoe", "wheel"):
        steps = draw(st.lists(st.integers(40, 60), min_size=3, max_size=6))
        channels.append(stream(name, [int(t) for t in np.cumsum([100, *steps])]))

    def merged() -> list[Item]:
        queues = [list(c) for c in channels]
        out = [q.pop(0) for q in queues]  # every channel is known from the start
        newest = max(i.stamp_ns for i in out)
        while any(queues):
            ready = [q for q in queues if q]
            oldest = min(q[0].stamp_ns for q in ready)
            allowed = [
                q
                for q in ready
                if max(newest, q[0].stamp_ns) - oldest < HOLD or q[0].stamp_ns == oldest
            ]
            q = draw(st.sampled_from(allowed))
            out.append(q.pop(0))
            newest = max(newest, out[-1].stamp_ns)
        return out

    return merged(), merged()


@settings(max_examples=150, deadline=None)
@given(interleavings())
def test_any_interleaving_within_the_hold_gives_the_same_epochs(
    orders: tuple[list[Item], list[Item]],
) -> None:
    def epochs(order: list[Item]) -> list[list[tuple[int, str, str]]]:
        s = Sequencer(HOLD)
        out = []
        for k, item in enumerate(order):
            assert s.add(item) is None
            if k >= 2:  # the first item of every channel has come
                out += s.release()
        out += s.flush()
        return [[(i.stamp_ns, *channel_and_source(i)) for i in e.sorted()] for e in out]

    first, second = epochs(orders[0]), epochs(orders[1])
    assert first == second
    flat = [entry[0] for epoch in first for entry in epoch]
    assert flat == sorted(flat)
    assert len(flat) == len(orders[0])
    assert len({epoch[0][0] for epoch in first}) == len(first)  # one epoch per stamp


def test_permutations_of_arrival_within_an_epoch_give_the_same_epochs() -> None:
    later = [rsu(150, "a", 2), rsu(150, "b", 2), velocity(150)]
    results = set()
    for order in permutations([rsu(100, "a", 2), rsu(100, "b", 2), velocity(100)]):
        s = Sequencer(HOLD)
        s.add(velocity(50))
        s.add(rsu(50, "a", 1))
        s.release()
        results.add(str([[channel_and_source(i) for i in e] for e in feed(s, [*order, *later])]))
    assert len(results) == 1


@pytest.mark.parametrize("pose_first", [True, False])
def test_an_initial_pose_that_is_needed_is_waited_for(pose_first: bool) -> None:
    """Pose and measurement of one stamp are one epoch, whichever topic arrives first."""
    second = 1_000_000_000
    measured = RsuMeasurement(stamp_ns=second, rsu_id="a", vue_id="v", expected=1)
    pose = InitialPose(stamp_ns=second, vue_id="v", position=np.zeros(3), cov=np.eye(3))
    sequencer = Sequencer(max_delay_ns=second // 4, needs_pose=True)
    epochs = []
    for item in (pose, measured) if pose_first else (measured, pose):
        assert sequencer.add(item) is None
        epochs += sequencer.release()
    assert [list(epoch.sorted()) for epoch in epochs] == [[pose, measured]]
    assert sequencer.flush() == []


def test_an_initial_pose_is_not_waited_for_longer_than_hold() -> None:
    sequencer = Sequencer(max_delay_ns=100, needs_pose=True)
    for stamp_ns in (1000, 1099):
        item = RsuMeasurement(stamp_ns=stamp_ns, rsu_id="a", vue_id="v", expected=1)
        assert sequencer.add(item) is None
        assert sequencer.release() == []
    assert sequencer.add(RsuMeasurement(stamp_ns=1100, rsu_id="a", vue_id="v", expected=1)) is None
    assert [epoch.stamp_ns for epoch in sequencer.release()] == [1000]


def test_applied_epochs_are_forgotten_after_the_history() -> None:
    """However long it runs, late items are known as repeated within the history, and what is
    kept of it is bounded."""
    sequencer = Sequencer(0, history_ns=1000 * MS)
    for stamp in range(10, 60_000, 10):
        assert sequencer.add(rsu(stamp)) is None
        assert len(sequencer.release()) == 1
        assert len(sequencer._applied) <= 101
    assert sequencer.add(rsu(58_990)) == "duplicate"
    assert sequencer.add(rsu(58_995)) is None
    assert sequencer.add(rsu(58_989)) == "late"


def test_ticks_are_epochs_once_an_rsu_was_heard_and_wait_for_it() -> None:
    """Every 20 ms of IMU, held for an RSU that measures once a second, 0.1 s late."""
    sequencer = Sequencer(max_delay_ns=500_000_000, history_ns=0, tick_ns=20_000_000)
    second, released = 1_000_000_000, []
    for k in range(100, 310):
        stamp = k * 10_000_000
        sequencer.mark(IMU, stamp)
        if k % 100 == 10:
            assert sequencer.add(rsu(k // 100 * 1000, expected=1)) is None
        released += sequencer.release()
        if k < 210:
            assert all(epoch.stamp_ns < 2 * second for epoch in released)
    stamps = [epoch.stamp_ns for epoch in released]
    assert stamps == sorted(set(stamps))
    assert stamps[0] == second
    assert [e.stamp_ns for e in released if e.items] == [second, 2 * second]
    ticks = [s for s in stamps if 1_100_000_000 < s < 2 * second]
    assert ticks == list(range(1_120_000_000, 2 * second, 20_000_000))


def releases(sequencer: Sequencer, arrivals: list[Item]) -> tuple[list[int], int]:
    """Stamps [ms] of the epochs applied, and how often a late item had one applied again."""
    stamps, again = [], 0
    for item in arrivals:
        assert sequencer.add(item) is None
        again += len({stamp for stamp, _ in sequencer.take_late()})
        stamps += stamps_ms(sequencer.release())
    stamps += stamps_ms(sequencer.flush())
    return stamps, again


def moved(items: list[Item], by_ms: int) -> list[Item]:
    return [replace(item, stamp_ns=item.stamp_ns + by_ms * MS) for item in items]


def by_arrival(late_ms: dict[str, int], expected: int, n: int = 200) -> list[Item]:
    """RSUs at 50 Hz, of each every message so much later than its stamp."""
    sent = [
        (k * 20 + late, k * 20, name) for k in range(1, n + 1) for name, late in late_ms.items()
    ]
    return [rsu(stamp, name, expected) for _, stamp, name in sorted(sent)]


@pytest.mark.parametrize("expected", [0, 4])
@pytest.mark.parametrize("late_ms", [50, 130])
def test_an_rsu_that_is_always_late_is_waited_for(expected: int, late_ms: int) -> None:
    """Stamps of the others pass by meanwhile; no epoch is applied, and published, twice."""
    sequencer = Sequencer(HOLD, history_ns=1000 * MS)
    arrivals = by_arrival({"a": 0, "b": 1, "c": 2, "d": late_ms}, expected)
    stamps, again = releases(sequencer, arrivals)
    assert stamps == [20 * k for k in range(1, 201)]
    assert again <= late_ms // 20 + 1  # until it has been late once


def test_one_that_becomes_punctual_is_waited_for_no_longer() -> None:
    sequencer = Sequencer(HOLD, history_ns=1000 * MS)
    releases(sequencer, by_arrival({"a": 0, "b": 100}, 0))
    later = moved(by_arrival({"a": 0, "b": 1}, 0), 5000)
    for item in later[:200]:
        sequencer.add(item)
        sequencer.release()
    newest = later[199].stamp_ns
    sequencer.add(later[200])
    assert newest in [epoch.stamp_ns for epoch in sequencer.release()]


def test_a_late_one_that_has_gone_is_waited_for_no_longer() -> None:
    sequencer = Sequencer(HOLD, history_ns=1000 * MS)
    releases(sequencer, by_arrival({"a": 0, "b": 100}, 0))
    later = moved(by_arrival({"a": 0, "c": 1}, 0), 6000)
    for item in later[:120]:
        sequencer.add(item)
        sequencer.release()
    newest = later[119].stamp_ns
    sequencer.add(later[120])
    assert newest in [epoch.stamp_ns for epoch in sequencer.release()]


@pytest.mark.parametrize(("expected", "most"), [(1, 6), (2, 3), (4, 0), (9, 0)])
def test_a_wrong_number_announced_is_noticed(expected: int, most: int) -> None:
    """Of 200 epochs a few are applied again; here nobody puts late items into their epochs, so
    that it takes one epoch for each RSU not announced."""
    sequencer = Sequencer(HOLD, history_ns=1000 * MS)
    arrivals = by_arrival({"a": 0, "b": 1, "c": 2, "d": 3}, expected)
    stamps, again = releases(sequencer, arrivals)
    assert stamps == [20 * k for k in range(1, 201)]
    assert again <= most


def test_of_too_few_announced_one_that_goes_away_is_waited_for_once() -> None:
    sequencer = Sequencer(HOLD, history_ns=1000 * MS)
    releases(sequencer, by_arrival({"a": 0, "b": 1, "c": 2}, 1, n=20))
    left = moved(by_arrival({"a": 0, "b": 1}, 1, n=3), 400)
    found = []
    for item in left:
        sequencer.add(item)
        found.append(stamps_ms(sequencer.release()))
    assert found == [[], [], [420], [440], [], [460]]


@pytest.mark.parametrize("expected", [0, 1, 50])
def test_an_rsu_that_is_not_awaited_completes_and_delays_nothing(expected: int) -> None:
    s = Sequencer(HOLD, history_ns=2 * HOLD, awaits=lambda m: m.rsu_id != "new")
    assert s.add(rsu(100, "new", expected)) is None
    assert s.release() == []  # those that are awaited are not late then
    assert s.add(rsu(100, "a", expected=2)) is None
    assert s.release() == []
    assert s.add(rsu(100, "b", expected=2)) is None
    assert [sorted(source for _, source in epoch.items) for epoch in s.release()] == [
        ["a", "b", "new"]
    ]


def test_an_epoch_of_an_rsu_that_is_not_awaited_ends_with_the_next_stamp() -> None:
    s = Sequencer(HOLD, awaits=lambda m: m.rsu_id != "new")
    assert s.add(rsu(100, "new", 1)) is None
    assert s.release() == []
    assert s.add(rsu(150, "a", expected=1)) is None
    assert stamps_ms(s.release()) == [100, 150]


def test_more_measurements_than_announced_make_epochs_wait_only_if_awaited() -> None:
    for awaited in (True, False):
        s = Sequencer(HOLD, history_ns=2 * HOLD, awaits=lambda m, a=awaited: a or m.rsu_id == "a")
        at_once = 0
        for k in range(1, 8):
            assert s.add(rsu(100 * k, "a", expected=1)) is None
            at_once += 100 * k in stamps_ms(s.release())
            for extra in "bcd":
                assert s.add(rsu(100 * k, extra, expected=1)) is None
            s.release()
            s.take_late()
        assert at_once == (1 if awaited else 7)


def test_a_late_item_that_is_not_awaited_does_not_count_in_its_epoch() -> None:
    s = Sequencer(HOLD, history_ns=2 * HOLD, awaits=lambda m: m.rsu_id != "new")
    assert s.add(rsu(100, "a", expected=1)) is None
    (epoch,) = s.release()
    assert s.add(rsu(100, "new", expected=50)) is None
    ((stamp_ns, late),) = s.take_late()
    assert merge([epoch], stamp_ns, late) is None
    assert (len(epoch.items), epoch.measured, epoch.rsu_complete()) == (2, 1, True)
