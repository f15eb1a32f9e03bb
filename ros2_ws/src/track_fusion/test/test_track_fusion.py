"""Fusion node, built in this process and fed by its callbacks; nothing sleeps."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from netpos.messages.network_tracks import network_track_to_msg
from netpos.messages.policy import ENCLAVES, allows
from netpos.messages.values import NetworkTrack
from netpos_msgs.msg import ClockState, TrackStatus
from netpos_node import CODEC
from nodes import Kept, nodes_of
from std_srvs.srv import SetBool, Trigger
from tf2_msgs.msg import TFMessage
from track_fusion.node import TrackFusionNode

DOMAIN = 44
T0 = 1_000_000_000
AT_ONCE = {"networks": ["wimax", "wifi"], "hold_s": 0.0, "confirm_s": 0.0, "jerk_density": 0.0}


@pytest.fixture
def make() -> Iterator[Any]:
    with nodes_of(TrackFusionNode, DOMAIN) as node:
        yield node


def arrive(node: TrackFusionNode, network: str, t_s: float, x: float, **change: Any) -> None:
    """As the executor does when a track has arrived."""
    values: dict[str, Any] = {
        "stamp_ns": T0 + round(t_s * 1e9),
        "network": network,
        "vue_id": "vue_1",
        "mean": np.array([x, 0.0, 5.0, 0.0, 0.0, 0.0]),
        "cov": np.eye(6),
        "own_cov": np.eye(6),
        "height_m": 1.5,
    }
    topic = f"/networks/{network}/tracks"
    (callback,) = (s.callback for s, _ in node._inputs if s.topic_name == topic)
    callback(network_track_to_msg(CODEC, NetworkTrack(**(values | change))))


def keep(node: TrackFusionNode) -> tuple[Kept, Kept, Kept]:
    kept = Kept(Odometry), Kept(ClockState), Kept(TrackStatus)
    node._outputs["vue_1"] = kept  # type: ignore[assignment]
    return kept


def test_the_security_policy_permits_what_the_node_does(make: Any) -> None:
    """Also its life cycle: change_state, get_state and what else rclpy offers."""
    node, rights = make(scenario="two_networks"), ENCLAVES["/netpos/fusion"]
    published = dict(node.get_publisher_names_and_types_by_node("track_fusion", "/"))
    heard = dict(node.get_subscriber_names_and_types_by_node("track_fusion", "/"))
    served = dict(node.get_service_names_and_types_by_node("track_fusion", "/"))
    assert {"/track_fusion/change_state", "/track_fusion/get_transition_graph"} <= served.keys()
    assert "/track_fusion/transition_event" in published
    assert [name for name in published if not allows(rights.published, name)] == []
    assert [name for name in heard if not allows(rights.subscribed, name)] == []
    assert [name for name in served if not allows(rights.replied, name)] == []
    operator = ENCLAVES["/netpos/operator"].request
    assert allows(operator, "/track_fusion/change_state")
    assert not allows(operator, "/track_fusion/set_parameters")


def test_topics_of_a_scenario(make: Any) -> None:
    node = make(scenario="two_networks")
    published = dict(node.get_publisher_names_and_types_by_node("track_fusion", "/"))
    assert published["/vue_1/odometry"] == ["nav_msgs/msg/Odometry"]
    assert published["/vue_1/track_status"] == ["netpos_msgs/msg/TrackStatus"]
    assert "/tf" in published
    heard = {s.topic_name for s, _ in node._inputs}
    assert heard == {"/networks/wifi/tracks", "/networks/wimax/tracks"}
    assert node._fusion._config.hold_s == 2.0


def test_two_tracks_make_one_odometry(make: Any) -> None:
    node = make(**AT_ONCE)
    odometry, clock, status = keep(node)
    node._tf_pub = Kept(TFMessage)
    arrive(node, "wimax", 0.0, 0.0)
    arrive(node, "wifi", 0.0, 2.0)
    fused = odometry.messages[-1]
    assert fused.header.frame_id == "map"
    assert fused.child_frame_id == "vue_1/base_link"
    position = fused.pose.pose.position
    assert (position.x, position.y, position.z) == pytest.approx((1.0, 0.0, 1.5))
    assert fused.pose.covariance[0] == pytest.approx(0.5)
    assert fused.twist.twist.linear.x == pytest.approx(5.0)
    assert status.messages[-1].sources == ["wimax/vue_1", "wifi/vue_1"]
    assert not clock.messages
    assert node._tf_pub.messages[-1].transforms[0].child_frame_id == "vue_1/base_link"


def test_refused_tracks_publish_nothing_and_are_told(make: Any) -> None:
    node = make(**AT_ONCE)
    odometry, _, _ = keep(node)
    arrive(node, "wifi", 0.0, 0.0, cov=-np.eye(6))
    arrive(node, "wifi", 0.0, float("nan"))
    assert not odometry.messages
    diagnostics = Kept()
    node._diagnostics_pub = diagnostics
    arrive(node, "wimax", 10.0, 0.0)
    arrive(node, "wifi", 10.0, 0.0)
    arrive(node, "wimax", 13.0, 15.0)
    node._publish_diagnostics()
    by_name = {status.name: status for status in diagnostics.messages[-1].status}
    wifi = by_name["track_fusion: network wifi"]
    assert wifi.level == DiagnosticStatus.ERROR
    assert wifi.message == "silent: left out"
    values = {value.key: value.value for value in wifi.values}
    assert values["refused: covariance"] == "1"
    assert values["refused: not_finite"] == "1"
    assert values["age_s"] == "3.0"
    assert by_name["track_fusion: network wimax"].level == DiagnosticStatus.OK
    assert by_name["track_fusion: vue_1"].message == "from wimax/vue_1"


def test_a_device_not_expected_gets_its_topics(make: Any) -> None:
    node = make(**AT_ONCE)
    arrive(node, "wimax", 0.0, 0.0, vue_id="vue_9")
    published = dict(node.get_publisher_names_and_types_by_node("track_fusion", "/"))
    assert "/vue_9/odometry" in published


def test_silence_gives_out_what_waits(make: Any) -> None:
    node = make(**(AT_ONCE | {"hold_s": 5.0}))
    odometry, _, _ = keep(node)
    arrive(node, "wimax", 0.0, 0.0)
    node._on_silence_tick()
    assert not odometry.messages
    node._on_silence_tick()
    assert len(odometry.messages) == 1


def test_services(make: Any) -> None:
    node = make(**AT_ONCE)
    odometry, _, status = keep(node)
    arrive(node, "wimax", 0.0, 0.0)
    arrive(node, "wifi", 0.0, 0.0)
    assert node._on_reset(Trigger.Request(), Trigger.Response()).success
    arrive(node, "wimax", 0.1, 0.0)
    assert status.messages[-1].used == 1
    node._on_enable(SetBool.Request(data=False), SetBool.Response())
    arrive(node, "wimax", 0.2, 0.0)
    assert len(odometry.messages) == 3


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({}, "networks: '' is no name"),
        ({"networks": ["a b"]}, "networks: 'a b' is no name"),
        ({"networks": ["a", "a"]}, "networks must name each network once"),
        ({"networks": ["a"], "method": "mean"}, "method must be one of"),
        ({"networks": ["a"], "vues": ["1"]}, "vues: '1' is no name"),
        ({"scenario": "nowhere"}, "no scenario 'nowhere'"),
    ],
)
def test_bad_parameters(make: Any, overrides: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(**overrides)


def test_frames_have_the_names_they_are_given(make: Any) -> None:
    node = make(**AT_ONCE, map_frame="site", base_frame="{vue}_body")
    odometry, _, _ = keep(node)
    node._tf_pub = Kept(TFMessage)
    arrive(node, "wimax", 0.0, 0.0)
    assert not odometry.messages
    assert node._fusion.rejected() == {"wimax: frame": 1}
    arrive(node, "wimax", 1.0, 0.0, frame_id="site")
    arrive(node, "wifi", 1.0, 2.0, frame_id="site")
    fused = odometry.messages[-1]
    assert (fused.header.frame_id, fused.child_frame_id) == ("site", "vue_1_body")
    sent = node._tf_pub.messages[-1].transforms[0]
    assert (sent.header.frame_id, sent.child_frame_id) == ("site", "vue_1_body")


def test_odom_frame_listens_to_dead_reckoning(make: Any) -> None:
    """/tf is joined as the tracker joins it (its tests); without a transform nothing is sent."""
    node = make(**AT_ONCE, odom_frame="{vue}/odom")
    keep(node)
    node._tf_pub = Kept(TFMessage)
    arrive(node, "wimax", 0.0, 0.0)
    arrive(node, "wifi", 0.0, 2.0)
    assert not node._tf_pub.messages
    for t_s, x in ((0.9, 4.0), (1.1, 6.0)):
        message = TransformStamped()
        message.header.frame_id, message.child_frame_id = "vue_1/odom", "vue_1/base_link"
        message.header.stamp = CODEC.time(T0 + round(t_s * 1e9))
        message.transform.translation.x = x
        message.transform.rotation.w = 1.0
        node._on_transforms(TFMessage(transforms=[message]))
    arrive(node, "wimax", 1.0, 5.0)
    arrive(node, "wifi", 1.0, 7.0)
    (sent,) = node._tf_pub.messages[-1].transforms
    assert (sent.header.frame_id, sent.child_frame_id) == ("map", "vue_1/odom")
    assert sent.transform.translation.x == pytest.approx(1.0)  # the device at 6, 5 in odom
