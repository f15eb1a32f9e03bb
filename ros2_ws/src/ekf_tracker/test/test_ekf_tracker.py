"""Tracker node, built in this process and fed by its callbacks; nothing sleeps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ekf_tracker.node import EkfTrackerNode
from feed import DOMAIN, PLACES, T0, arrive, drive, keep, know_rsus, measurement
from netpos.bags import BagWriter, codec, typestore
from netpos.messages.values import (
    Field,
    ImuSample,
    InitialPose,
    RsuInfo,
    TrackState,
    Velocity,
)
from netpos_msgs.msg import TrackStatus
from netpos_node import CODEC
from nodes import Kept, nodes_of
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from rclpy.time import Time
from std_srvs.srv import SetBool, Trigger
from tf2_msgs.msg import TFMessage


@pytest.fixture
def make() -> Iterator[Any]:
    with nodes_of(EkfTrackerNode, DOMAIN) as node:
        yield node


# the graph


def test_topics_types_and_qos(make: Any) -> None:
    node = make(vues=["car"])
    published = dict(node.get_publisher_names_and_types_by_node("ekf_tracker", "/"))
    assert published["/car/odometry"] == ["nav_msgs/msg/Odometry"]
    assert published["/car/clock_state"] == ["netpos_msgs/msg/ClockState"]
    assert published["/car/track_status"] == ["netpos_msgs/msg/TrackStatus"]
    assert published["/diagnostics"] == ["diagnostic_msgs/msg/DiagnosticArray"]
    assert published["/tf"] == ["tf2_msgs/msg/TFMessage"]
    read = dict(node.get_subscriber_names_and_types_by_node("ekf_tracker", "/"))
    assert read["/rsu/info"] == ["netpos_msgs/msg/RsuInfo"]
    assert read["/rsu/measurements"] == ["netpos_msgs/msg/RsuMeasurement"]
    assert read["/car/step_velocity"] == ["geometry_msgs/msg/TwistWithCovarianceStamped"]
    assert read["/car/ground_speed"] == ["geometry_msgs/msg/TwistWithCovarianceStamped"]
    assert read["/car/initialpose"] == ["geometry_msgs/msg/PoseWithCovarianceStamped"]
    services = dict(node.get_service_names_and_types_by_node("ekf_tracker", "/"))
    assert services["/ekf_tracker/reset"] == ["std_srvs/srv/Trigger"]
    assert services["/ekf_tracker/enable"] == ["std_srvs/srv/SetBool"]

    (latched,) = node.get_subscriptions_info_by_topic("/rsu/info")
    assert latched.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
    assert latched.qos_profile.reliability == ReliabilityPolicy.RELIABLE
    kept = {
        e.qos_profile.durability for e in node.get_subscriptions_info_by_topic("/car/initialpose")
    }
    assert kept == {DurabilityPolicy.TRANSIENT_LOCAL, DurabilityPolicy.VOLATILE}
    for topic in ("/rsu/measurements", "/car/step_velocity"):
        (end,) = node.get_subscriptions_info_by_topic(topic)
        assert end.qos_profile.durability == DurabilityPolicy.VOLATILE
        assert end.qos_profile.reliability == ReliabilityPolicy.RELIABLE
    (end,) = node.get_publishers_info_by_topic("/car/odometry")
    assert end.qos_profile.reliability == ReliabilityPolicy.RELIABLE


def test_tf_can_be_switched_off(make: Any) -> None:
    node = make(publish_tf=False)
    assert "/tf" not in dict(node.get_publisher_names_and_types_by_node("ekf_tracker", "/"))
    odometry, _, _ = keep(node)
    know_rsus(node)
    drive(node, range(3))
    assert len(odometry.messages) == 3


def test_unknown_device_gets_its_topics_when_first_heard(make: Any) -> None:
    node = make(vues=["vue_1"])
    know_rsus(node)
    drive(node, range(2), "vue_9")
    published = dict(node.get_publisher_names_and_types_by_node("ekf_tracker", "/"))
    assert {"/vue_1/odometry", "/vue_9/odometry", "/vue_9/track_status"} <= set(published)
    read = dict(node.get_subscriber_names_and_types_by_node("ekf_tracker", "/"))
    assert "/vue_9/step_velocity" in read
    assert node._statuses["vue_9"].state is TrackState.TRACKING


def test_the_imu_is_heard_where_the_motion_model_needs_it(make: Any) -> None:
    """Its topic names the device, whatever its frame is called."""
    node = make(motion_model="inertial")
    read = dict(node.get_subscriber_names_and_types_by_node("ekf_tracker", "/"))
    assert read["/vue_1/imu"] == ["sensor_msgs/msg/Imu"]
    taken: list[Any] = []
    node._tracker.add = taken.append
    sample = ImuSample(
        stamp_ns=T0, vue_id="sensor", angular_velocity=np.ones(3), specific_force=np.ones(3)
    )
    msg = codec().imu_to_msg(sample)
    arrive(node, "/vue_1/imu", CODEC.imu_to_msg(sample))
    (callback,) = (s.callback for s, _ in node._inputs if s.topic_name == "/vue_1/imu")
    callback(bytes(typestore().serialize_cdr(msg, msg.__msgtype__, little_endian=False)))
    assert [repr(one) for one in taken] == [repr(replace(sample, vue_id="vue_1"))] * 2


def test_the_imu_is_not_heard_elsewhere(make: Any) -> None:
    read = dict(make().get_subscriber_names_and_types_by_node("ekf_tracker", "/"))
    assert "/vue_1/imu" not in read


# parameters


def test_parameters_reach_the_tracker(make: Any) -> None:
    node = make(hold_s=0.5, filter="ekf", max_rejected_epochs=7)
    config = node._tracker.config
    assert (config.hold_s, config.filter, config.max_rejected_epochs) == (0.5, "ekf", 7)


@pytest.mark.parametrize(
    ("change", "error", "text"),
    [
        ({"hold_s": 11.0}, InvalidParameterValueException, "hold_s"),
        ({"hold_s": 1}, InvalidParameterTypeException, "hold_s"),
        ({"max_rejected_epochs": 0}, InvalidParameterValueException, "max_rejected_epochs"),
        ({"subscribers": -1}, InvalidParameterValueException, "subscribers"),
        ({"vues": ["vue_1", "a b"]}, ValueError, "vues: 'a b' is no device name"),
        ({"filter": "ukff"}, ValueError, "filter must be one of"),
        ({"process_noise": "none"}, ValueError, "process_noise must be one of"),
    ],
)
def test_bad_parameters(make: Any, change: Any, error: Any, text: str) -> None:
    with pytest.raises(error, match=text):
        make(**change)


def test_a_scenario_that_is_none_is_an_error(make: Any) -> None:
    with pytest.raises(ValueError, match="no_such_scenario"):
        make(scenario="no_such_scenario")


def test_a_bag_gives_defaults_and_explicit_values_win(make: Any, tmp_path: Path) -> None:
    """Also where its metadata says 1 for 1.0; a parameter nobody knows is an error."""
    with BagWriter(tmp_path / "bag", metadata={"tracker": "{hold_s: 1, filter: ekf}"}) as bag:
        bag.write("/clock", codec().clock_to_msg(T0), T0)
    config = make(scenario=str(tmp_path / "bag"), filter="iekf")._tracker.config
    assert (config.hold_s, config.filter) == (1.0, "iekf")
    with BagWriter(tmp_path / "odd", metadata={"tracker": "{hold: 1}"}) as bag:
        bag.write("/clock", codec().clock_to_msg(T0), T0)
    with pytest.raises(ValueError, match="unknown tracker parameter 'hold'"):
        make(scenario=str(tmp_path / "odd"))


# data


def test_a_drive_is_published(make: Any) -> None:
    node = make()
    odometry, clock, status = keep(node)
    node._tf_pub = Kept(TFMessage)
    know_rsus(node)
    drive(node, range(30))
    assert len(odometry.messages) == len(clock.messages) == len(status.messages) == 30
    last = odometry.messages[-1]
    assert (last.header.frame_id, last.child_frame_id) == ("map", "vue_1/base_link")
    assert CODEC.odometry_from_msg(last).stamp_ns == T0 + 2_900_000_000
    assert last.pose.pose.position.x == pytest.approx(23.2, abs=0.3)
    assert last.twist.twist.linear.x == pytest.approx(8.0, abs=0.5)
    assert len(node._tf_pub.messages) == 30
    tf = node._tf_pub.messages[-1].transforms[0]
    assert tf.transform.translation.x == last.pose.pose.position.x
    assert status.messages[-1].sources == ["a", "b", "c"]
    assert abs(clock.messages[-1].offset) < 3e-9


def test_velocity_and_pose_of_a_device_reach_its_track(make: Any) -> None:
    node = make(hold_s=0.0)
    odometry, clock, status = keep(node)
    pose = InitialPose(
        stamp_ns=T0, vue_id="vue_1", position=np.array([5.0, 6.0, 0.0]), cov=np.eye(3)
    )
    arrive(node, "/vue_1/initialpose", CODEC.initial_pose_to_msg(pose))
    assert odometry.messages[-1].pose.pose.position.x == 5.0
    v = Velocity(
        stamp_ns=T0 + 10**8, vue_id="vue_1", velocity=np.array([2.0, 0.0]), cov=0.01 * np.eye(2)
    )
    msg = CODEC.velocity_to_msg(v)
    arrive(node, "/vue_1/step_velocity", msg)
    assert status.messages[-1].sources == ["step_velocity"]
    assert odometry.messages[-1].twist.twist.linear.x == pytest.approx(2.0, abs=0.05)
    msg = CODEC.velocity_to_msg(v)
    msg.header.stamp = CODEC.time(T0 + 2 * 10**8)
    arrive(node, "/vue_1/ground_speed", msg)
    assert status.messages[-1].sources == ["ground_speed"]
    assert clock.messages == []  # no TOA yet


def test_measurements_in_the_other_byte_order_count_too(make: Any) -> None:
    """Their bytes are not read the short way."""
    node = make()
    odometry, _, status = keep(node)
    know_rsus(node)
    drive(node, range(2))
    (on_measurement,) = (
        s.callback for s, _ in node._inputs if s.topic_name == "/rsu/measurements"
    )
    for name in PLACES:
        values = CODEC.measurement_from_msg(measurement(name, 0.2))
        msg = codec().measurement_to_msg(values)
        on_measurement(bytes(typestore().serialize_cdr(msg, msg.__msgtype__, little_endian=False)))
    assert len(odometry.messages) == 3
    assert status.messages[-1].sources == ["a", "b", "c"]
    assert status.messages[-1].rejected == 0


# time and services


def test_reset_service(make: Any) -> None:
    node = make()
    odometry, _, status = keep(node)
    know_rsus(node)
    drive(node, range(3))
    response = node._on_reset(Trigger.Request(), Trigger.Response())
    assert response.success
    assert response.message == "all tracks start anew"
    arrive(node, "/rsu/measurements", measurement("a", 0.05, expected=1, fields=Field.TOA))
    assert status.messages[-1].state == TrackState.WAITING
    assert len(odometry.messages) == 3
    assert node._tracker.rsu_count == 3


def test_accept_rsus_service(make: Any) -> None:
    """An RSU that says it has moved is refused until an operator accepts it."""
    node = make()
    odometry, *_ = keep(node)
    know_rsus(node)
    drive(node, range(10))
    for name, (x, y) in PLACES.items():
        info = RsuInfo(rsu_id=name, position=np.array([x + 50.0, y, 0.0]))
        arrive(node, "/rsu/info", CODEC.rsu_info_to_msg(info))
    drive(node, range(10, 20))
    assert odometry.messages[-1].pose.pose.position.x == pytest.approx(15.2, abs=0.5)
    response = node._on_accept_rsus(Trigger.Request(), Trigger.Response())
    assert (response.success, response.message) == (True, "accepted: a, b, c")
    node._on_reset(Trigger.Request(), Trigger.Response())
    drive(node, range(20, 30))
    assert odometry.messages[-1].pose.pose.position.x == pytest.approx(73.2, abs=0.5)
    response = node._on_accept_rsus(Trigger.Request(), Trigger.Response())
    assert (response.success, response.message) == (False, "no RsuInfo is waiting")


def test_rsus_file(make: Any, tmp_path: Path) -> None:
    """Listed RSUs are known without an RsuInfo; a file that is missing is named."""
    file = tmp_path / "rsus.yaml"
    file.write_text(f"rsus: {{{', '.join(f'{k}: [{x}, {y}]' for k, (x, y) in PLACES.items())}}}")
    node = make(trust="listed", rsus_file=str(file))
    odometry, *_ = keep(node)
    stranger = RsuInfo(rsu_id="x", position=np.zeros(3))
    arrive(node, "/rsu/info", CODEC.rsu_info_to_msg(stranger))
    drive(node, range(10))
    assert odometry.messages[-1].pose.pose.position.x == pytest.approx(7.2, abs=0.5)
    assert node._tracker.rsu_count == 3
    with pytest.raises(ValueError, match="set rsus_file"):
        make(trust="listed")
    with pytest.raises(ValueError, match="does not exist"):
        make(rsus_file=str(tmp_path / "none.yaml"))


def test_enable_service(make: Any) -> None:
    node = make()
    _, _, status = keep(node)
    know_rsus(node)
    response = node._on_enable(SetBool.Request(data=False), SetBool.Response())
    assert (response.success, response.message) == (True, "disabled: measurements are refused")
    drive(node, range(2))
    (said,) = status.messages
    assert said.state == TrackStatus.WAITING
    assert "the tracker is disabled; call its service enable" in said.reason
    assert node._tracker.rejected()["vue_1"]["disabled"] == 6
    response = node._on_enable(SetBool.Request(data=True), SetBool.Response())
    assert (response.success, response.message) == (True, "enabled")
    drive(node, range(2, 4))
    assert len(status.messages) == 3


def test_simulated_clock_that_jumps_back_resets(make: Any) -> None:
    """Through rclpy's own jump callback; a step forward, or the first stamp, does nothing."""
    node = make(use_sim_time=True)
    _, _, status = keep(node)
    know_rsus(node)
    clock = node.get_clock()
    clock.set_ros_time_override(Time(nanoseconds=T0))
    drive(node, range(3))
    clock.set_ros_time_override(Time(nanoseconds=T0 + 10**9))
    drive(node, range(3, 4))
    assert status.messages[-1].state == TrackState.TRACKING
    assert status.messages[-1].accepted == 12
    clock.set_ros_time_override(Time(nanoseconds=T0 + 10**9 - 1))
    arrive(node, "/rsu/measurements", measurement("a", 0.0, expected=1, fields=Field.TOA))
    assert status.messages[-1].state == TrackState.WAITING
    assert status.messages[-1].rejection_reasons == []  # an old stamp is not late any more


# diagnostics
