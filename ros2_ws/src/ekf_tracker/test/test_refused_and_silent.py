"""What reaches a tracker node and is none of its business: bad names, bytes, frames; silence."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from ekf_tracker.node import EkfTrackerNode
from feed import DOMAIN, T0, arrive, drive, keep, know_rsus, measurement
from netpos.messages.values import Field, InitialPose, RsuInfo, TrackState
from netpos_node import CODEC
from nodes import Kept, nodes_of
from rclpy.serialization import serialize_message
from rclpy.time import Time
from std_srvs.srv import SetBool


@pytest.fixture
def make() -> Iterator[Any]:
    with nodes_of(EkfTrackerNode, DOMAIN) as node:
        yield node


@pytest.mark.parametrize(
    "vue_id", ["", "no spaces", "1st", "a//b", "ü", "a/b", "{x}", 101 * "x", 240 * "x"]
)
def test_a_name_that_is_no_topic_is_refused_and_the_node_lives_on(make: Any, vue_id: str) -> None:
    node = make()
    know_rsus(node)
    arrive(node, "/rsu/measurements", measurement("a", 0.0, vue_id))
    assert set(node._outputs) == {"vue_1"}
    assert node._tracker.rejected() == {vue_id: {"vue_id": 1}}
    odometry, _, _ = keep(node)
    drive(node, range(3))
    assert len(odometry.messages) == 3


def test_the_longest_name_is_a_topic(make: Any) -> None:
    node = make()
    know_rsus(node)
    drive(node, range(2), 100 * "x")
    assert node._statuses[100 * "x"].state is TrackState.TRACKING


@pytest.mark.parametrize("length", [0, 3, 60])
def test_bytes_that_are_no_message_are_refused_and_the_node_lives_on(
    make: Any, length: int
) -> None:
    node = make(motion_model="inertial")
    odometry, _, _ = keep(node)
    know_rsus(node)
    for topic in ("/rsu/measurements", "/vue_1/imu"):
        (callback,) = (s.callback for s, _ in node._inputs if s.topic_name == topic)
        callback(serialize_message(measurement("a", 0.0))[:length])
    assert node._tracker.rejected() == {}
    drive(node, range(3))
    assert len(odometry.messages) == 3


def test_places_in_another_frame_are_refused(make: Any) -> None:
    node = make()
    know_rsus(node)
    moved = CODEC.rsu_info_to_msg(RsuInfo(rsu_id="a", position=np.array([500.0, 0.0, 0.0])))
    moved.header.frame_id = "mount"
    arrive(node, "/rsu/info", moved)
    pose = InitialPose(stamp_ns=T0, vue_id="vue_1", position=np.ones(3), cov=np.eye(3))
    said = CODEC.initial_pose_to_msg(pose)
    said.header.frame_id = "base_link"
    arrive(node, "/vue_1/initialpose", said)
    fix = measurement(
        "a", 0.0, expected=1, fields=Field.POSITION, position=np.ones(3), position_cov=np.eye(3)
    )
    fix.header.frame_id = "odom"
    arrive(node, "/rsu/measurements", fix)
    assert node._tracker.rejected() == {"vue_1": {"frame": 2}}
    odometry, _, _ = keep(node)
    drive(node, range(1, 4))
    east = [m.pose.pose.position.x for m in odometry.messages]
    assert east == pytest.approx([0.8, 1.6, 2.4], abs=0.2)


def test_refusals_are_counted_not_raised(make: Any) -> None:
    node = make()
    know_rsus(node)
    arrive(node, "/rsu/measurements", measurement("a", 0.0, rsu_id="nobody"))
    arrive(node, "/rsu/measurements", measurement("a", 0.0, azimuth_rad=math.nan))
    broken = CODEC.rsu_info_to_msg(RsuInfo(rsu_id="x", position=np.full(3, math.nan)))
    arrive(node, "/rsu/info", broken)
    broken = CODEC.rsu_info_to_msg(RsuInfo(rsu_id="x", position=np.zeros(3)))
    broken.angle_convention = 9
    arrive(node, "/rsu/info", broken)
    assert node._tracker.rejected() == {"vue_1": {"unknown_rsu": 1, "not_finite": 1}}
    assert node._tracker.rsu_count == 3


def test_silence_flushes_what_waits(make: Any) -> None:
    node = make(hold_s=1.0)
    _, _, status = keep(node)
    know_rsus(node)
    arrive(node, "/rsu/measurements", measurement("a", 0.0))
    node._on_silence_tick()  # something was heard since the last tick
    assert status.messages == []
    node._on_silence_tick()
    assert len(status.messages) == 1


def test_silence_is_that_of_the_simulated_clock_unless_it_stands_still(make: Any) -> None:
    node = make(hold_s=10.0, use_sim_time=True)
    _, _, status = keep(node)
    know_rsus(node)
    clock = node.get_clock()

    def tick_at(seconds: float) -> int:
        clock.set_ros_time_override(Time(nanoseconds=T0 + round(1e9 * seconds)))
        node._on_silence_tick()
        return len(status.messages)

    arrive(node, "/rsu/measurements", measurement("a", 0.0))
    assert [tick_at(s) for s in (0.0, 0.5, 1.9)] == [0, 0, 0]  # played slowly
    assert tick_at(2.0) == 1
    arrive(node, "/rsu/measurements", measurement("a", 3.0))
    assert [tick_at(s) for s in (2.1, 2.2)] == [1, 1]
    assert tick_at(2.2) == 2  # the player has ended


def test_diagnostics_are_published(make: Any) -> None:
    node = make()
    node._diagnostics_pub = Kept()
    node._publish_diagnostics()
    know_rsus(node)
    drive(node, range(3))
    node._publish_diagnostics()
    first, second = node._diagnostics_pub.messages
    assert [s.name for s in first.status] == ["ekf_tracker: rsus"]
    assert [s.message for s in second.status[:2]] == ["tracking", "3 RSUs known"]
    assert [(s.hardware_id, s.message) for s in second.status[2:]] == [
        ("a", "ok"),
        ("b", "ok"),
        ("c", "ok"),
    ]


def test_diagnostics_tell_of_silence(make: Any, monkeypatch: Any) -> None:
    node = make()
    node._diagnostics_pub = Kept()
    know_rsus(node)
    drive(node, range(3))
    now_s = time.monotonic()

    def told(after_s: float) -> list[tuple[bytes, str]]:
        monkeypatch.setattr("netpos_node.estimating.time.monotonic", lambda: now_s + after_s)
        node._publish_diagnostics()
        return [(s.level, s.message) for s in node._diagnostics_pub.messages[-1].status]

    ok = DiagnosticStatus.OK
    assert told(2.5)[:2] == [(ok, "tracking"), (ok, "3 RSUs known")]
    device, rsus, *each = told(12.2)
    assert device == (DiagnosticStatus.STALE, "silent for 12 s; was tracking")
    assert rsus == (DiagnosticStatus.WARN, "3 RSUs known; nothing heard for 12 s")
    assert [message for _, message in each] == ["no device heard for 12 s"] * 3
    drive(node, range(3, 4))
    assert told(12.2)[:2] == [(ok, "tracking"), (ok, "3 RSUs known")]
    drive(node, range(4, 5), "vue_2")
    device = told(24.6)[0]
    assert device == (DiagnosticStatus.STALE, "silent for 12 s; was tracking")
    node._on_enable(SetBool.Request(data=False), SetBool.Response())
    message = "3 RSUs known; disabled: measurements are refused"
    assert (DiagnosticStatus.WARN, message) in told(0.0)
