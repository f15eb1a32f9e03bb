"""One track: gate, recovery, gaps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from netpos.messages.values import (
    Array,
    Field,
    InitialPose,
    TrackState,
)
from netpos.tracking import TrackOutput

T0 = 1_000_000_000


ALL = Field.AZIMUTH | Field.TOA


STILL = {"accel_density_mps2_sqrthz": 1e-6}


def standing(x: float = 40.0, y: float = 2.0) -> Array:
    return np.array([x, y, 0.0, 0.0, 0.0, 0.0])


def pose(t_s: float, x: float, y: float, var: float = 1.0) -> InitialPose:
    return InitialPose(
        stamp_ns=T0 + round(t_s * 1e9),
        vue_id="vue_1",
        position=np.array([x, y, 0.0]),
        cov=var * np.eye(3),
    )


def error(output: TrackOutput, truth: Array) -> float:
    assert output.odometry is not None
    return float(np.linalg.norm(output.odometry.position[:2] - truth[:2]))


def settled(world: Any, feed: Any, fields: Field = ALL, **config: Any) -> Any:
    tracker = world.tracker(**(STILL | config))
    for k in range(20):
        feed(tracker, world.measure(0.1 * k, standing(), fields))
    return tracker


def test_gate_counts_and_leaves_the_others(world: Any, feed: Any) -> None:
    tracker = settled(world, feed)
    items = world.measure(2.0, standing())
    items[1] = replace(items[1], azimuth_rad=items[1].azimuth_rad + 1.0)
    (output,) = feed(tracker, items)
    assert output.status.rejected == {"gate": 1}
    assert output.status.sources == ("a", "c")
    assert (output.status.used, output.status.nis_dof) == (2, 4)
    assert output.status.accepted == 62
    assert error(output, standing()) < 0.05


def test_gate_probability_one_accepts_everything(world: Any, feed: Any) -> None:
    tracker = settled(world, feed, gate_probability=1.0)
    items = [replace(m, azimuth_rad=m.azimuth_rad + 1.0) for m in world.measure(2.0, standing())]
    (output,) = feed(tracker, items)
    assert output.status.rejected == {}
    assert output.status.used == 3


def test_lost_track_finds_itself_again(world: Any, feed: Any) -> None:
    """The device is somewhere else: 10 epochs are rejected, then a new first fix is taken."""
    tracker = settled(world, feed, max_rejected_epochs=10, inflate_after_epochs=10000)
    elsewhere, outputs = standing(80.0, 30.0), []
    for k in range(12):
        outputs += feed(tracker, world.measure(2.0 + 0.1 * k, elsewhere))
    assert [o.status.used for o in outputs] == [0] * 10 + [3, 3]
    assert [o.status.rejected["gate"] for o in outputs[:10]] == list(range(3, 31, 3))
    assert [o.odometry is None for o in outputs] == [False] * 9 + [True, False, False]
    assert [o.status.rejected.get("track_lost", 0) for o in outputs] == [0] * 9 + [1] * 3
    assert error(outputs[-1], elsewhere) < 0.5
    # rejected epochs leave the estimate where it was, and it only widens
    assert error(outputs[8], standing()) < 0.05
    sds = [o.status.position_sd_m for o in outputs[:9]]
    assert sds == sorted(sds)
    assert outputs[0].status.nis_dof == 0


def test_an_initial_pose_counts_rejected_epochs_from_none(world: Any, feed: Any) -> None:
    config = {"max_rejected_epochs": 3, "inflate_after_epochs": 10000}
    tracker = settled(world, feed, **config)
    elsewhere = standing(80.0, 30.0)
    for k in range(2):
        feed(tracker, world.measure(2.0 + 0.1 * k, elsewhere))
    feed(tracker, [pose(2.2, 40.0, 2.0, 0.01)])
    states = []
    for k in range(3):
        (output,) = feed(tracker, world.measure(2.3 + 0.1 * k, elsewhere))
        states.append(output.status.state)
    # the pose is news of the device: no coasting for a second after it
    assert states == [TrackState.TRACKING, TrackState.TRACKING, TrackState.WAITING]


def test_rejected_epochs_do_not_leave_the_velocity_opened(world: Any, feed: Any) -> None:
    """Opening is a trial: where nothing passes even then, the covariance is the prediction's."""
    sds = []
    for after in (1, 10000):
        tracker = settled(world, feed, inflate_after_epochs=after, max_rejected_epochs=100)
        for k in range(5):
            far = standing(40.0, 900.0)
            (output,) = feed(tracker, world.measure(2.0 + 0.1 * k, far, Field.RANGE))
        assert output.status.used == 0
        sds.append(output.status.position_sd_m)
    assert sds[0] == sds[1]


def test_an_accepted_epoch_ends_the_row_of_rejected_ones(world: Any, feed: Any) -> None:
    tracker = settled(world, feed, max_rejected_epochs=3, inflate_after_epochs=10000)
    for k in range(12):
        place = standing() if k % 3 == 2 else standing(80.0, 30.0)
        (output,) = feed(tracker, world.measure(2.0 + 0.1 * k, place))
    assert "track_lost" not in output.status.rejected
    assert output.status.rejected["gate"] == 24


def test_velocity_is_opened_after_rejected_epochs(world: Any, feed: Any) -> None:
    """A parked car drives off at 4 m/s, which the process noise forbids."""
    lost = {}
    for after in (2, 10000):
        tracker = settled(
            world, feed, Field.RANGE, inflate_after_epochs=after, max_rejected_epochs=10000
        )
        outputs = []
        for k in range(20):
            moved = standing(40.0 + 0.4 * k, 2.0)
            outputs += feed(tracker, world.measure(2.0 + 0.1 * k, moved, Field.RANGE))
        lost[after] = error(outputs[-1], moved)
        first_rejected = next(i for i, o in enumerate(outputs) if o.status.used == 0)
        if after == 2:
            used = [o.status.used for o in outputs[first_rejected:]]
            assert used[:2] == [0, 0]
            assert used[2] == 3
    assert lost[2] < 1.0
    assert lost[10000] > 3.0


def test_opening_the_velocity_is_a_step_since_the_last_accepted(world: Any, feed: Any) -> None:
    """After s seconds a velocity step of sd v adds v^2 [[s^2, s], [s, 1]] per axis."""
    tracker = settled(world, feed)
    track = tracker._tracks["vue_1"]
    predicted = track._predict(T0 + 2_900_000_000)  # last accepted at 1.9 s
    opened = track._opened(predicted, 3.0)
    added = opened.cov - predicted.cov
    expected = np.zeros((6, 6))
    for p in (0, 1):
        expected[np.ix_([p, p + 2], [p, p + 2])] = [[9.0, 9.0], [9.0, 9.0]]
    np.testing.assert_allclose(added, expected, atol=1e-7)
    later = track._opened(track._predict(T0 + 3_900_000_000), 3.0)
    added = later.cov - track._predict(T0 + 3_900_000_000).cov
    np.testing.assert_allclose(
        added[np.ix_([1, 3], [1, 3])], [[36.0, 18.0], [18.0, 9.0]], atol=1e-7
    )
    np.testing.assert_array_equal(opened.mean, predicted.mean)


def test_manoeuvre_is_accepted_at_once_where_allowed(world: Any, feed: Any) -> None:
    for sd in (0.0, 10.0):
        tracker = settled(world, feed, Field.RANGE, manoeuvre_speed_sd_mps=sd)
        (output,) = feed(tracker, world.measure(2.4, standing(44.0, 2.0), Field.RANGE))
        assert (output.status.used == 3) is (sd > 0.0)
        assert ("gate" in output.status.rejected) is (sd == 0.0)
    # a small allowance is one too: 1.5 m in half a second
    for sd in (0.0, 0.9):
        tracker = settled(world, feed, Field.RANGE, manoeuvre_speed_sd_mps=sd)
        (output,) = feed(tracker, world.measure(2.4, standing(41.5, 2.0), Field.RANGE))
        assert (output.status.used == 3) is (sd > 0.0)
    # an outlier no manoeuvre explains is rejected all the same, and then nothing is opened
    sds = []
    for sd in (0.0, 1.0):
        tracker = settled(world, feed, manoeuvre_speed_sd_mps=sd)
        items = world.measure(2.0, standing())
        items[1] = replace(items[1], azimuth_rad=items[1].azimuth_rad + 2.0)
        (output,) = feed(tracker, items)
        assert output.status.used == 2
        sds.append(output.status.position_sd_m)
    assert sds[0] == sds[1]


def test_gap_starts_anew(world: Any, feed: Any) -> None:
    for gap, accepted_dof in ((29.9, 6), (30.1, 0)):
        tracker = settled(world, feed, max_gap_s=30.0, gate_probability=1.0)
        (output,) = feed(tracker, world.measure(1.9 + gap, standing()))
        assert output.status.used == 3
        assert output.status.nis_dof == accepted_dof  # 0: a first fix, not an update
        assert error(output, standing()) < 1.0


def test_a_gap_forgets_the_biases_too(world: Any, feed: Any) -> None:
    """The states of RSUs heard before the gap must not be counted for the new track."""
    with_errors(world, range_bias_sd_m=0.5, bias_correlation_time_s=100.0)
    tracker = world.tracker(max_gap_s=1.0)
    feed(tracker, world.measure(0.0, standing(), Field.RANGE))
    feed(tracker, world.measure(9.0, standing(), Field.RANGE | Field.AZIMUTH))
    track = tracker._tracks["vue_1"]
    assert track._biases.sd == [0.5] * 3
    assert track._estimate.mean.size == 9
    (output,) = feed(tracker, world.measure(9.1, standing(), Field.RANGE))
    assert output.status.used == 3


def test_coasting_after_silence(world: Any, feed: Any) -> None:
    tracker = settled(world, feed, coast_after_s=1.0, inflate_after_epochs=10000)
    elsewhere = standing(80.0, 30.0)
    (output,) = feed(tracker, world.measure(2.9, elsewhere))
    assert output.status.state is TrackState.TRACKING
    (output,) = feed(tracker, world.measure(2.9 + 1e-9, elsewhere))
    assert output.status.state is TrackState.COASTING
    assert output.odometry is not None


def with_errors(world: Any, **change: Any) -> None:
    world.rsus = {n: replace(info, **change) for n, info in world.rsus.items()}
