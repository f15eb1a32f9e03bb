"""Dead-reckoning node, built in this process and fed by its callbacks."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from netpos.inertial.pdr_config import PdrConfig
from netpos.inertial.pdr_output import StepEvent, StepVelocity
from netpos.inertial.pdr_values import frame_of, step_value, velocity_value
from netpos.inertial.steps import StepConfig
from netpos.messages.values import ImuSample, MagneticSample
from netpos_node import BACKLOG, CODEC, wait_until_heard
from nodes import Kept, nodes_of
from pdr_node.node import PdrNode
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from sensor_msgs.msg import Imu, MagneticField

DOMAIN = 36
G = 9.80665
T0 = 1_700_000_000_000_000_000


@pytest.fixture
def make() -> Iterator[Any]:
    with nodes_of(PdrNode, DOMAIN) as node:
        yield node


def samples(magnetic: bool, stop_s: float) -> Iterator[Any]:
    """Messages of 3 s of rest, then 1.8 steps per second, heading 30 deg."""
    rng = np.random.default_rng(3)
    yaw = math.radians(30.0)
    c, s = math.cos(yaw), math.sin(yaw)
    field = np.array([s * 18e-6, c * 18e-6, -45e-6])  # north seen from the body
    for k in range(int(stop_s * 100)):
        stamp = T0 + k * 10_000_000
        u = max(k / 100 - 3.0, 0.0) * 1.8
        force = np.array([0.0, 0.0, G - 2.5 * min(u, 1.0) * math.cos(2 * math.pi * u)])
        sample = ImuSample(
            stamp_ns=stamp,
            vue_id="vue_1",
            angular_velocity=0.01 * rng.normal(size=3),
            specific_force=force + 0.02 * rng.normal(size=3),
        )
        if magnetic:
            mag = MagneticSample(stamp_ns=stamp, vue_id="vue_1", magnetic_field=field)
            yield CODEC.magnetic_field_to_msg(mag)
        yield CODEC.imu_to_msg(sample)


def walk(node: PdrNode, magnetic: bool, stop_s: float = 16.0) -> tuple[list[Any], list[Any]]:
    """Steps and velocities published of ``samples``."""
    node._step_pub, node._velocity_pub = Kept(), Kept()  # type: ignore[assignment]
    for msg in samples(magnetic, stop_s):
        (node._on_imu if isinstance(msg, Imu) else node._on_magnetic_field)(msg)
    return node._step_pub.messages, node._velocity_pub.messages  # type: ignore[attr-defined]


def test_frame_of() -> None:
    assert frame_of("vue_1", "map") == "map"
    assert frame_of("vue_1", "relative") == "vue_1/pdr_start"


def test_what_waits_when_the_node_is_stopped_is_used(make: Any) -> None:
    """Ten seconds of samples that nobody took yet: the same steps and velocities as in order."""
    expected = walk(make(), magnetic=True, stop_s=10.0)
    node = make()
    node._step_pub, node._velocity_pub = Kept(), Kept()
    publishers = {
        Imu: node.create_publisher(Imu, "/vue_1/imu", BACKLOG),
        MagneticField: node.create_publisher(MagneticField, "/vue_1/mag", BACKLOG),
    }
    unheard = {p.topic_name: p for p in publishers.values()}
    assert not wait_until_heard(unheard, dict.fromkeys(unheard, 1), 20.0, settle_s=0.0)
    for msg in samples(magnetic=True, stop_s=10.0):
        publishers[type(msg)].publish(msg)
    for publisher in publishers.values():
        assert publisher.wait_for_all_acked(Duration(seconds=20))
    node.finish()
    assert len(expected[0]) > 5
    assert (node._step_pub.messages, node._velocity_pub.messages) == expected


def test_step_conversion() -> None:
    event = StepEvent(
        stamp_ns=30,
        start_ns=10,
        end_ns=20,
        count=4,
        length_m=0.7,
        heading_rad=1.2,
        heading_sd_rad=0.1,
        length_sd_m=0.2,
        cadence_hz=1.9,
        heading_reference="relative",
    )
    step = step_value("v", event)
    assert (step.stamp_ns, step.start_ns, step.end_ns, step.count) == (30, 10, 20, 4)
    assert (step.vue_id, step.frame_id) == ("v", "v/pdr_start")
    assert (step.length_m, step.heading_rad, step.cadence_hz) == (0.7, 1.2, 1.9)
    assert step.length_var == pytest.approx(0.04)
    assert step.heading_var == pytest.approx(0.01)


def test_velocity_conversion() -> None:
    v, cov = np.array([1.0, 2.0]), np.array([[3.0, 1.0], [1.0, 4.0]])
    value = velocity_value("v", StepVelocity(7, v, cov, True, "map"))
    assert (value.stamp_ns, value.vue_id, value.frame_id) == (7, "v", "map")
    assert value.source == "step_velocity"
    np.testing.assert_array_equal(value.velocity, v)
    np.testing.assert_array_equal(value.cov, cov)


def test_topics_types_and_qos(make: Any) -> None:
    node = make(vue="walker")
    published = dict(node.get_publisher_names_and_types_by_node("pdr_node", "/"))
    assert published["/walker/step"] == ["netpos_msgs/msg/Step"]
    assert published["/walker/step_velocity"] == ["geometry_msgs/msg/TwistWithCovarianceStamped"]
    read = dict(node.get_subscriber_names_and_types_by_node("pdr_node", "/"))
    assert read["/walker/imu"] == ["sensor_msgs/msg/Imu"]
    assert read["/walker/mag"] == ["sensor_msgs/msg/MagneticField"]
    ends = [
        *node.get_publishers_info_by_topic("/walker/step"),
        *node.get_publishers_info_by_topic("/walker/step_velocity"),
        *node.get_subscriptions_info_by_topic("/walker/imu"),
        *node.get_subscriptions_info_by_topic("/walker/mag"),
    ]
    assert len(ends) == 4
    for end in ends:
        assert end.qos_profile.reliability == ReliabilityPolicy.RELIABLE
        assert end.qos_profile.durability == DurabilityPolicy.VOLATILE


def test_every_entry_of_the_config_is_a_read_only_parameter(make: Any) -> None:
    node, plain = make(), PdrConfig().flat()
    assert {"height_m", "attitude.declination_rad", "steps.signal"} < set(plain)
    for name, value in plain.items():
        given = node.get_parameter(name).value
        assert (tuple(given) if isinstance(value, tuple) else given) == value
        assert node.describe_parameter(name).read_only
    assert node.describe_parameter("steps.bout_steps").description == (
        "peaks in a row that start a bout"
    )
    assert node.get_parameter("vue").value == "vue_1"
    changed = {"weinberg_k": 0.5, "steps.bout_steps": 4, "hard_iron_t": [1e-6, 0.0, 2e-6]}
    assert make(**changed)._core.config == PdrConfig(
        weinberg_k=0.5, steps=StepConfig(bout_steps=4), hard_iron_t=(1e-6, 0.0, 2e-6)
    )


def test_placement_and_scenario_choose_defaults_that_explicit_values_override(make: Any) -> None:
    assert make(placement="waist")._core.config == PdrConfig.of("waist")
    core = make(scenario="pedestrian_walk", height_m=1.9)._core
    declination = math.radians(11.0)  # of the scenario's magnetometer
    assert core.config == PdrConfig.from_mapping(
        {"placement": "waist", "attitude.declination_rad": declination, "height_m": 1.9}
    )


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"vue": "a b"}, "vue: 'a b' is no device name"),
        ({"weinberg_k": -1.0}, r"pdr.weinberg_k must be in \[1e-09, 1e\+09\], got -1.0"),
        ({"subscribers": -1}, "subscribers must be >= 0, got -1"),
        ({"placement": "ankle"}, "placement must be carried or waist, got 'ankle'"),
        ({"length_model": "guess"}, "length_model must be one of frequency, weinberg"),
        ({"steps.smooth_sd_s": -1.0}, r"steps.smooth_sd_s must be in \[1e-09, 1e\+09\], got -1.0"),
        ({"scenario": "absent"}, "no scenario 'absent'"),
        ({"scenario": "pedestrian_walk", "vue": "vue_7"}, "has vue_1, not vue_7"),
    ],
)
def test_bad_parameter_is_one_clear_error(
    make: Any, parameters: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        make(**parameters)


def test_a_walk_with_magnetometer_gives_velocities_in_map(make: Any) -> None:
    steps, velocities = walk(make(), magnetic=True)
    assert len(steps) == pytest.approx(13 * 1.8, abs=3)
    assert [s.count for s in steps] == list(range(1, len(steps) + 1))
    walking = [v for v in velocities if v.header.stamp.sec >= T0 // 10**9 + 3]
    assert {m.header.frame_id for m in (*steps, *walking)} == {"map"}
    # before the first second of samples there is no north yet, and nobody claims it
    assert all(
        v.header.stamp.sec <= T0 // 10**9 + 1 for v in velocities if v.header.frame_id != "map"
    )
    last = velocities[-1].twist.twist.linear
    assert math.atan2(last.y, last.x) == pytest.approx(math.radians(30.0), abs=0.15)
    assert 0.5 < math.hypot(last.x, last.y) < 2.5
    cov = np.array(velocities[-1].twist.covariance).reshape(6, 6)[:2, :2]
    assert np.linalg.eigvalsh(cov)[0] > 0.0
    stamps = [CODEC.velocity_from_msg(v, "vue_1").stamp_ns for v in velocities]
    assert np.diff(stamps).min() > 0


def test_a_walk_without_magnetometer_is_not_called_map(make: Any) -> None:
    steps, velocities = walk(make(), magnetic=False)
    assert len(steps) > 15
    assert {m.header.frame_id for m in (*steps, *velocities)} == {"vue_1/pdr_start"}


def test_broken_samples_publish_nothing_and_are_told_once(
    make: Any, capfd: pytest.CaptureFixture[str]
) -> None:
    node = make()
    node._step_pub, node._velocity_pub = Kept(), Kept()
    bad = ImuSample(
        stamp_ns=T0,
        vue_id="vue_1",
        angular_velocity=np.full(3, math.nan),
        specific_force=np.array([0.0, 0.0, G]),
    )
    for _ in range(5):
        node._on_imu(CODEC.imu_to_msg(bad))
    assert node._step_pub.messages == node._velocity_pub.messages == []
    assert node._core.counters == {"not_finite": 5}
    assert capfd.readouterr().err.count("not_finite: IMU samples without three finite values") == 1


def test_a_missing_magnetometer_is_told_once(make: Any, capfd: pytest.CaptureFixture[str]) -> None:
    walk(make(), magnetic=False)
    assert capfd.readouterr().err.count("no magnetic field is heard") == 1
