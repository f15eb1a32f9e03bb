"""One track: gate, recovery, gaps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from netpos.messages.values import (
    Field,
    GroundSpeed,
    TrackState,
)
from track_cases import error, pose, standing

ALL = Field.AZIMUTH | Field.TOA


STILL = {"accel_density_mps2_sqrthz": 1e-6}


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


@pytest.mark.parametrize("rolling", [False, True])
def test_a_displaced_device_is_found_again_with_the_defaults(
    world: Any, feed: Any, rolling: bool
) -> None:
    """49 m away all at once, as three RSUs agree; a wheel sensor goes on saying 0 m/s."""
    tracker = world.tracker()
    for k in range(20):
        feed(tracker, world.measure(0.1 * k, standing()))
    elsewhere = standing(80.0, 30.0)
    for k in range(20, 120):
        items: list[Any] = world.measure(0.1 * k, elsewhere)
        if rolling:
            speed = {"speed_mps": 0.0, "speed_var": 0.01}
            items.append(GroundSpeed(stamp_ns=items[0].stamp_ns, vue_id="vue_1", **speed))
        (output,) = feed(tracker, items)
    assert error(output, elsewhere) < 1.0


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
            world,
            feed,
            Field.RANGE,
            inflate_after_epochs=after,
            max_rejected_epochs=10000,
            manoeuvre_speed_sd_mps=0.0,
        )
        outputs = []
        for k in range(20):
            moved = standing(40.0 + 0.4 * k, 2.0)
            outputs += feed(tracker, world.measure(2.0 + 0.1 * k, moved, Field.RANGE))
        lost[after] = error(outputs[-1], moved)
        first_rejected = next(i for i, o in enumerate(outputs) if o.status.used < 2)
        if after == 2:
            used = [o.status.used for o in outputs[first_rejected:]]
            assert max(used[:2]) < 2
            assert used[2] == 3
    assert lost[2] < 1.0
    assert lost[10000] > 3.0


@pytest.mark.parametrize("silent_s", [1.0, 2.0])
def test_opening_the_velocity_is_a_step_since_the_last_accepted(
    world: Any, feed: Any, matrices: Any, silent_s: float
) -> None:
    """After s seconds a velocity step of sd v adds v^2 [[s^2, s], [s, 1]] per axis, whenever
    epochs were rejected meanwhile. Position fixes: the posterior is the linear filter's."""
    tracker = settled(
        world, feed, Field.POSITION, filter="ekf", initial_speed_sd_mps=3.0, isolate_rsus=False
    )
    start = tracker._tracks["vue_1"]._state.estimator.estimate.copy()  # last accepted at 1.9 s
    for k in range(2):
        far = world.measure(2.0 + 0.1 * k, standing(40.0, 900.0), Field.POSITION)
        (output,) = feed(tracker, far)
        assert output.status.used == 0
    moved = standing(43.0, 1.0)
    (output,) = feed(tracker, world.measure(1.9 + silent_s, moved, Field.POSITION))
    assert output.status.used == 3
    c = 299_792_458.0
    F, Q = matrices("continuous", silent_s, 1e-6, 0.0, 1e-10 * c, 2.5e-7 * c, 0.0)
    mean, cov = F @ start.mean, F @ start.cov @ F.T + Q
    for p in (0, 1):
        block = np.ix_([p, p + 2], [p, p + 2])
        cov[block] += 9.0 * np.array([[silent_s**2, silent_s], [silent_s, 1.0]])
    H = np.tile(np.eye(2, 6), (3, 1))
    K = cov @ H.T @ np.linalg.inv(H @ cov @ H.T + world.range_sd**2 * np.eye(6))
    estimate = tracker._tracks["vue_1"]._state.estimator.estimate
    np.testing.assert_allclose(
        estimate.mean[:4], (mean + K @ (np.tile(moved[:2], 3) - H @ mean))[:4], rtol=1e-9
    )
    np.testing.assert_allclose(
        estimate.cov[:4, :4], (cov - K @ H @ cov)[:4, :4], rtol=1e-8, atol=1e-12
    )


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
        tracker = settled(world, feed, manoeuvre_speed_sd_mps=sd, clock_walk_density=5e-7)
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
    assert track._state.estimator.biases.sd == [0.5] * 3
    (output,) = feed(tracker, world.measure(9.1, standing(), Field.RANGE))
    assert output.status.used == 3
    assert track._state.estimator.estimate.mean.size == 9


@pytest.mark.parametrize(
    ("after_s", "state"), [(2.9, TrackState.TRACKING), (2.9 + 1e-9, TrackState.COASTING)]
)
def test_coasting_after_silence(world: Any, feed: Any, after_s: float, state: TrackState) -> None:
    tracker = settled(world, feed, coast_after_s=1.0, inflate_after_epochs=10000)
    (output,) = feed(tracker, world.measure(after_s, standing(80.0, 30.0)))
    assert output.status.state is state
    assert output.odometry is not None


def with_errors(world: Any, **change: Any) -> None:
    world.rsus = {n: replace(info, **change) for n, info in world.rsus.items()}
