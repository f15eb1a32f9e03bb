"""Life, parameters that change, frames and datum of the tracker node, fed by its callbacks."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import yaml
from ekf_tracker.node import EkfTrackerNode
from feed import DOMAIN, PLACES, T0, arrive, drive, keep, know_rsus, measurement
from geometry_msgs.msg import TransformStamped
from netpos.messages.values import RsuInfo
from netpos_node import CODEC
from nodes import Kept, nodes_of
from pyproj import Geod
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from sensor_msgs.msg import NavSatFix
from tf2_msgs.msg import TFMessage

DONE = TransitionCallbackReturn.SUCCESS


@pytest.fixture
def make() -> Iterator[Any]:
    with nodes_of(EkfTrackerNode, DOMAIN) as node:
        yield node


def state(node: Any) -> str:
    return str(node._state_machine.current_state[1])


def test_it_starts_by_itself_unless_told_otherwise(make: Any) -> None:
    assert state(make()) == "active"
    node = make(autostart=False)
    assert state(node) == "unconfigured"
    assert node._inputs == []
    assert node._outputs == {}


def test_a_life(make: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tracks outlive a pause, not a cleaning up; nothing is heard meanwhile."""
    node = make(autostart=False, vues=["vue_1"])
    assert node.trigger_configure() is DONE
    assert list(node._outputs) == ["vue_1"]
    assert node._inputs == []
    assert node.trigger_activate() is DONE
    told: list[Any] = []
    monkeypatch.setattr(node, "_publish_one", told.append)
    know_rsus(node)
    drive(node, range(10))
    assert len(told) == 10

    arrive(node, "/rsu/measurements", measurement("a", 1.0))  # its epoch waits for b and c
    assert node.trigger_deactivate() is DONE
    assert len(told) == 11, "what was waiting is given out"
    assert node._inputs == []
    assert node.trigger_activate() is DONE
    drive(node, range(12, 20))
    assert len(told) == 19
    assert all(output.odometry is not None for output in told[1:]), "the track went on"

    assert node.trigger_deactivate() is DONE
    assert node.trigger_cleanup() is DONE
    assert state(node) == "unconfigured"
    assert list(node.publishers) == [p for p in node.publishers if "vue_1" not in p.topic_name]
    assert node.trigger_configure() is DONE
    assert node.trigger_activate() is DONE
    assert node.tracker.rsu_count == 0


def test_a_fault_at_configuring_is_said_and_can_be_mended(make: Any, tmp_path: Any) -> None:
    node = make(autostart=False, trust="listed")
    assert node.trigger_configure() is not DONE
    assert state(node) == "unconfigured"
    assert "rsus_file" in str(node._fault)
    file = tmp_path / "rsus.yaml"
    file.write_text("rsus: {a: [0, 0, 5]}\n")
    (result,) = node.set_parameters([Parameter("rsus_file", value=str(file))])
    assert result.successful, result.reason
    assert node.trigger_configure() is DONE
    assert node.tracker.rsu_count == 1


# parameters


def changed(node: Any, **values: Any) -> Any:
    wanted = [Parameter(name, value=value) for name, value in values.items()]
    return node.set_parameters_atomically(wanted)


def test_safe_parameters_change_while_it_runs(make: Any) -> None:
    node = make()
    told = node._run_pub = Kept()
    know_rsus(node)
    drive(node, range(3))
    result = changed(node, gate_probability=0.99, max_devices=3)
    assert result.successful, result.reason
    config = node.tracker.config
    assert (config.gate_probability, config.max_devices) == (0.99, 3)
    assert node.get_parameter("gate_probability").value == 0.99
    (fact,) = told.messages
    assert fact.key == "tracker_change"
    assert yaml.safe_load(fact.value) == {
        "stamp_ns": T0 + 200_000_000,
        "gate_probability": 0.99,
        "max_devices": 3,
    }


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"hold_s": 0.5}, "hold_s cannot change while the tracker is configured"),
        ({"filter": "ukf", "max_devices": 9}, "filter cannot change"),
        ({"vues": ["car"]}, "vues cannot change while the tracker is configured"),
        ({"allowed_devices": "("}, "no regular expression"),
        ({"gate_probability": 0.99, "map_frame": "a b"}, "map_frame 'a b' is no name of a frame"),
        ({"gate_probability": 2.0}, "gate_probability"),
        ({"max_devices": 2, "gate_probability": "high"}, "Wrong parameter type"),
        ({"scenario": "fast_pass"}, "read-only"),
    ],
)
def test_others_are_refused_with_the_reason_and_nothing_changes(
    make: Any, values: dict[str, Any], reason: str
) -> None:
    node = make()
    before = node.tracker.config
    names = [*values, "max_devices", "gate_probability"]
    stood = {name: node.get_parameter(name).value for name in names}
    result = changed(node, **values)
    assert not result.successful
    assert reason in result.reason
    assert node.tracker.config is before
    assert {name: node.get_parameter(name).value for name in names} == stood


def test_all_can_change_before_it_is_configured(make: Any) -> None:
    node = make(autostart=False)
    assert changed(node, hold_s=0.5, filter="ukf", vues=["car"]).successful
    assert "filter must be one of" in changed(node, filter="ukff").reason
    assert node.trigger_configure() is DONE
    assert (node.tracker.config.hold_s, node.tracker.config.filter) == (0.5, "ukf")
    assert list(node._outputs) == ["car"]


# frames


def test_frames_have_the_names_they_are_given(make: Any) -> None:
    node = make(map_frame="site", base_frame="{vue}_body")
    odometry, _, status = keep(node)
    node._tf_pub = Kept(TFMessage)
    for name, (x, y) in PLACES.items():
        msg = CODEC.rsu_info_to_msg(RsuInfo(rsu_id=name, position=np.array([x, y, 0.0])))
        msg.header.frame_id = "site" if name != "c" else "map"
        arrive(node, "/rsu/info", msg)
    assert node.tracker.rsu_count == 2, "that of c is not in site"
    assert "give it in 'site'" in node.tracker.refused_rsus()["c"]
    for k in range(10):
        for name in ("a", "b"):
            arrive(node, "/rsu/measurements", measurement(name, 0.1 * k, expected=2))
    last = odometry.messages[-1]
    assert (last.header.frame_id, last.child_frame_id) == ("site", "vue_1_body")
    assert status.messages[-1].header.frame_id == "vue_1_body"
    sent = node._tf_pub.messages[-1].transforms[0]
    assert (sent.header.frame_id, sent.child_frame_id) == ("site", "vue_1_body")


def odom(t_s: float, angle: float, origin: tuple[float, float]) -> Any:
    """odom -> base of the drive of ``feed`` along x at 8 m/s, where odom lies at ``origin`` in the
    map and is turned by ``angle``."""
    dx, dy = 8.0 * t_s - origin[0], -origin[1]
    msg = TransformStamped()
    msg.header.stamp = CODEC.time(T0 + round(t_s * 1e9))
    msg.header.frame_id, msg.child_frame_id = "vue_1/odom", "vue_1/base_link"
    msg.transform.translation.x = math.cos(angle) * dx + math.sin(angle) * dy
    msg.transform.translation.y = -math.sin(angle) * dx + math.cos(angle) * dy
    msg.transform.rotation.z, msg.transform.rotation.w = (
        math.sin(-angle / 2.0),
        math.cos(-angle / 2.0),
    )
    return msg


def test_map_to_odom_when_asked(make: Any) -> None:
    """The pose of the frame of dead reckoning, which the test chose, comes out; stamps of odom lie
    between those of the estimates."""
    node = make(odom_frame="{vue}/odom")
    odometry, _, _ = keep(node)
    node._tf_pub = Kept(TFMessage)
    know_rsus(node)
    origin, angle = (3.0, -7.0), 0.6
    for k in range(30):
        node._on_transforms(TFMessage(transforms=[odom(0.1 * k + 0.03, angle, origin)]))
        drive(node, range(k, k + 1))
    sent = [message.transforms[0] for message in node._tf_pub.messages]
    assert len(sent) == 29, "all but the first, which no pose in odom precedes"
    assert {(t.header.frame_id, t.child_frame_id) for t in sent} == {("map", "vue_1/odom")}
    last = sent[-1].transform
    assert last.translation.x == pytest.approx(origin[0], abs=0.3)
    assert last.translation.y == pytest.approx(origin[1], abs=0.3)
    assert 2.0 * math.atan2(last.rotation.z, last.rotation.w) == pytest.approx(angle, abs=0.02)
    stamps = {m.header.stamp.nanosec for m in odometry.messages}
    assert sent[-1].header.stamp.nanosec in stamps


def test_without_odom_it_says_why_nothing_is_published(make: Any) -> None:
    node = make(odom_frame="{vue}/odom")
    node._tf_pub = Kept(TFMessage)
    know_rsus(node)
    drive(node, range(30))
    assert node._tf_pub.messages == []
    (warning,) = (w for w in node._input_warnings() if "on /tf" in w)
    assert "no vue_1/odom -> vue_1/base_link on /tf" in warning


# where on earth


def test_fixes_on_the_earth(make: Any) -> None:
    """A metre in the map is a metre on the geodesic from the datum."""
    latitude, longitude = 55.75, 37.62
    node = make(datum=f"{latitude}, {longitude}, 150", device_height_m=1.5)
    odometry, _, _ = keep(node)
    fixes = node._fix_pubs["vue_1"] = Kept()
    know_rsus(node)
    drive(node, range(20))
    assert len(fixes.messages) == len(odometry.messages) == 20
    fix, pose = fixes.messages[-1], odometry.messages[-1]
    assert isinstance(fix, NavSatFix)
    assert fix.header.stamp == pose.header.stamp
    assert fix.header.frame_id == "vue_1/base_link"
    azimuth, _, metres = Geod(ellps="WGS84").inv(longitude, latitude, fix.longitude, fix.latitude)
    x, y = pose.pose.pose.position.x, pose.pose.pose.position.y
    assert metres == pytest.approx(math.hypot(x, y), rel=1e-4)  # the map is 150 m up
    assert math.radians(azimuth) == pytest.approx(math.atan2(x, y), abs=1e-5)
    assert fix.altitude == pytest.approx(151.5, abs=1e-3)
    covariance = np.array(pose.pose.covariance).reshape(6, 6)[:3, :3]
    assert fix.position_covariance.reshape(3, 3) == pytest.approx(covariance, rel=1e-3, abs=1e-5)
    assert fix.position_covariance_type == NavSatFix.COVARIANCE_TYPE_KNOWN


def test_rsus_by_latitude_and_longitude(make: Any, tmp_path: Any) -> None:
    """Where a geodesic of 60 m leads east from the datum, 60 m stand in the map."""
    east = Geod(ellps="WGS84").fwd(37.62, 55.75, 90.0, 60.0)
    file = tmp_path / "rsus.csv"
    file.write_text(
        f"rsu,latitude,longitude,height\na,55.75,37.62,5\nb,{east[1]!r},{east[0]!r},5\n"
    )
    node = make(datum="55.75 37.62", rsus_file=str(file))
    known = {info.rsu_id: info.position for info in node._chosen.read().rsu_list}
    assert known["a"] == pytest.approx([0.0, 0.0, 5.0], abs=1e-6)
    assert known["b"] == pytest.approx([60.0, 0.0, 5.0], abs=1e-3)
    with pytest.raises(ValueError, match="datum"):
        make(rsus_file=str(file))


def test_two_names_of_one_frame_are_refused(make: Any) -> None:
    with pytest.raises(ValueError, match="must differ"):
        make(map_frame="world", odom_frame="world")
