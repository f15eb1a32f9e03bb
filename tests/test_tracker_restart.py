"""The tracker is killed in mid-run; a new one takes over from what the RSUs say."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from graph import Graph, wait_until
from nav_msgs.msg import Odometry
from netpos_msgs.msg import TrackStatus
from runs import (
    ODOMETRY,
    TRACK_STATUS,
    TRUTH,
    horizontal_errors,
    long_road,
    stamps,
)

AFTER = 40  # estimates watched before the kill and after the restart
SETTLED = 20  # of these, the first ones do not count


@pytest.mark.parametrize("name", ["long_road", "metis_madrid"])
def test_a_restarted_tracker_finds_the_device_again(
    graph: Graph, tmp_path: Path, name: str
) -> None:
    """In METIS the tracker is given a pose, at a start that it has not seen the second time."""
    scenario = str(long_road(tmp_path / "long_road.yaml")) if name == "long_road" else name
    truth = graph.collect(TRUTH, Odometry)
    odometry = graph.collect(ODOMETRY, Odometry)
    status = graph.collect(TRACK_STATUS, TrackStatus)
    tracker = graph.run("ekf_tracker", "ekf_tracker", parameters={"scenario": scenario})
    graph.run("rsu_sensor", "rsu_sensor", parameters={"scenario": scenario, "subscribers": 1})
    graph.wait_for_nodes("ekf_tracker", "rsu_sensor")
    simulator = graph.run("vue_sim", "vue_sim", parameters={"scenario": scenario})
    before = odometry.wait_for(AFTER, 90.0)
    assert tracker.kill() == -9
    graph.processes.remove(tracker)
    killed_ns = stamps(truth.messages)[-1]
    seen, statuses = len(odometry.messages), len(status.messages)

    # the others go on without it
    wait_until(lambda: stamps(truth.messages)[-1] > killed_ns + 10**9, "the simulator to go on")
    graph.run("ekf_tracker", "ekf_tracker", parameters={"scenario": scenario})
    try:
        odometry.wait_for(seen + AFTER, 90.0)
    except TimeoutError as error:
        raise AssertionError(
            f"{error}; the last status: {status.messages[statuses:][-1:]}"
        ) from error
    after = odometry.messages[seen:]
    assert simulator.running, simulator.describe()

    gap_s = (stamps(after)[0] - stamps(before)[-1]) * 1e-9
    assert gap_s > 1.0
    waiting = [s for s in status.messages[statuses:] if s.state == TrackStatus.WAITING]
    assert len(waiting) <= 20  # epochs without a fix
    wait_until(lambda: stamps(truth.messages)[-1] >= stamps(after)[-1], "the truth of the end")
    errors = horizontal_errors(list(truth.messages), after)
    assert len(errors) >= AFTER
    late = list(errors.values())[SETTLED:]
    rmse = math.sqrt(sum(e * e for e in late) / len(late))
    assert rmse < 1.5
    assert max(late) < 4.0
    assert len(set(stamps(after))) == len(after)
    assert status.messages[-1].state == TrackStatus.TRACKING
