"""A gait played through pdr_node into the tracker: fused in map, refused in a frame of its own."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import TwistWithCovarianceStamped
from graph import Collector, Graph, wait_until
from nav_msgs.msg import Odometry
from netpos.bags import BagWriter, codec
from netpos.messages.fields import stamp_ns
from netpos.messages.values import (
    Field,
    ImuSample,
    InitialPose,
    MagneticSample,
    RsuInfo,
    RsuMeasurement,
    TrackState,
)
from netpos_msgs.msg import ClockState, Step, TrackStatus
from netpos_msgs.msg import RsuMeasurement as RsuMeasurementMessage
from netpos_node import CODEC
from runs import graphs
from scipy.spatial.transform import Rotation

NS = 1_000_000_000
START_NS = 100 * NS
RATE_HZ, CADENCE_HZ = 100, 1.8
REST_S, WALK_S = 3.0, 20.0
LAST_NS = START_NS + 30 * NS  # of a measurement after the walk
STEPS = round(WALK_S * CADENCE_HZ)
HEADING_RAD = math.radians(50.0)
FIELD_MAP_T = np.array([0.0, 18e-6, -45e-6])
G = 9.80665
VUES = ("vue_1", "vue_2")  # with and without magnetometer
UNALIGNED = 3  # velocities that may be given out before the first magnetic sample has come
BEGIN = np.array([4.0, -3.0, 0.0])


def gait_bag(path: Path) -> None:
    """Two devices rest, walk north-east and rest; the second hears an RSU as well."""
    make, rng = codec(), np.random.default_rng(5)
    t = np.arange(0.0, 2 * REST_S + WALK_S, 1 / RATE_HZ)
    steps = (t - REST_S) * CADENCE_HZ
    ramp = np.clip(np.minimum(steps, WALK_S * CADENCE_HZ - steps) + 0.25, 0.0, 1.0)
    vertical = G - 2.5 * ramp * np.cos(2 * np.pi * steps)
    field = Rotation.from_rotvec([0.0, 0.0, HEADING_RAD]).inv().apply(FIELD_MAP_T)
    with BagWriter(path) as bag:
        rsu = RsuInfo(rsu_id="rsu_1", position=np.array([0.0, 0.0, 0.0]))
        bag.write("/rsu/info", make.rsu_info_to_msg(rsu), START_NS)
        for vue in VUES:
            pose = InitialPose(stamp_ns=START_NS, vue_id=vue, position=BEGIN, cov=np.eye(3))
            bag.write(f"/{vue}/initialpose", make.initial_pose_to_msg(pose), START_NS)
        for index, force in enumerate(vertical):
            ns = START_NS + index * NS // RATE_HZ
            for vue in VUES:
                imu = ImuSample(
                    stamp_ns=ns,
                    vue_id=vue,
                    angular_velocity=rng.normal(scale=0.01, size=3),
                    specific_force=np.array([0.0, 0.0, force]) + rng.normal(scale=0.02, size=3),
                )
                bag.write(f"/{vue}/imu", make.imu_to_msg(imu), ns)
            if index % 2 == 0:
                magnetic = MagneticSample(stamp_ns=ns, vue_id="vue_1", magnetic_field=field)
                bag.write("/vue_1/mag", make.magnetic_field_to_msg(magnetic), ns)
            if index % 100 == 50:
                bag.write("/rsu/measurements", make.measurement_to_msg(heard(ns)), ns)


def heard(ns: int) -> RsuMeasurement:
    return RsuMeasurement(
        stamp_ns=ns,
        rsu_id="rsu_1",
        vue_id="vue_2",
        expected=1,
        fields=Field.RANGE,
        range_m=5.0,
        range_var=1.0,
    )


@dataclass(frozen=True)
class Heard:
    """What came out, by device."""

    velocities: dict[str, list[Any]]
    steps: dict[str, list[Any]]
    odometry: dict[str, list[Any]]
    status: dict[str, list[Any]]


def send_last(graph: Graph, status: Collector) -> None:
    """One more measurement: what was refused shows in the status of the next epoch."""
    out = graph.publisher("/rsu/measurements", RsuMeasurementMessage)
    wait_until(lambda: out.get_subscription_count() > 0, "the tracker to listen")
    out.publish(CODEC.measurement_to_msg(heard(LAST_NS)))
    wait_until(lambda: stamp_ns(status.messages[-1].header.stamp) == LAST_NS, "the last status")


@pytest.fixture(scope="module")
def walked(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Heard]:
    folder = tmp_path_factory.mktemp("pdr")
    bag = folder / "gait"
    gait_bag(bag)
    with graphs(folder) as (graph,):

        def listen(name: str, kind: type[Any]) -> dict[str, Collector]:
            return {vue: graph.collect(f"/{vue}/{name}", kind) for vue in VUES}

        velocities = listen("step_velocity", TwistWithCovarianceStamped)
        steps, odometry = listen("step", Step), listen("odometry", Odometry)
        status = listen("track_status", TrackStatus)
        listen("clock_state", ClockState)
        listened = (velocities, steps, odometry, status)
        graph.run("ekf_tracker", "ekf_tracker", parameters={"vues": list(VUES), "subscribers": 1})
        for vue in VUES:
            graph.run("pdr_node", "pdr_node", parameters={"vue": vue})
        needed = [f"/{vue}/{name}" for vue in VUES for name in ("imu", "step_velocity")]
        for topic in needed:
            graph.wait_for_subscribers(topic, 2 if topic.endswith("velocity") else 1)
        for vue in VUES:
            graph.wait_for_publishers(f"/{vue}/step_velocity")
        waited = ["/rsu/measurements", "/vue_1/mag", *needed[::2]]
        waited += [f"/{vue}/initialpose" for vue in VUES]
        player = graph.run(
            *("netpos_bag", "play", str(bag), "--rate", "10", "--wait-timeout", "60"),
            *("--wait-for-subscribers", *waited),
        )
        assert player.wait() == 0, player.describe()
        end_ns = START_NS + round((2 * REST_S + WALK_S - 0.3) * NS)
        for vue in VUES:
            wait_until(
                lambda vue=vue: (
                    velocities[vue].messages
                    and stamp_ns(velocities[vue].messages[-1].header.stamp) >= end_ns
                ),
                f"the last step velocity of {vue}",
            )
        last = velocities["vue_1"].messages[-1].header.stamp
        wait_until(
            lambda: last in [m.header.stamp for m in odometry["vue_1"].messages[-1:]],
            "the last odometry",
        )
        send_last(graph, status["vue_2"])
        found = ({vue: list(c.messages) for vue, c in group.items()} for group in listened)
        yield Heard(*found)


def test_every_step_is_counted_once(walked: Heard) -> None:
    for vue in VUES:
        counts = [step.count for step in walked.steps[vue]]
        assert counts == list(range(1, len(counts) + 1))
        assert abs(len(counts) - STEPS) <= 1
        for step in walked.steps[vue][2:-2]:
            assert step.cadence == pytest.approx(CADENCE_HZ, rel=0.15)
            assert 0.3 < step.length < 1.2


def test_frames_follow_the_heading_reference(walked: Heard) -> None:
    """A magnetometer gives north, so map from its first sample on; without one the frame is the
    device's own."""
    frames = {v: [m.header.frame_id for m in walked.velocities[v]] for v in VUES}
    assert set(frames["vue_1"][UNALIGNED:]) == {"map"}
    assert set(frames["vue_2"]) == {"vue_2/pdr_start"}
    assert {step.header.frame_id for step in walked.steps["vue_1"]} == {"map"}


def test_velocities_point_along_the_walk(walked: Heard) -> None:
    """10 Hz; 50 degrees from east where north is known, 0 in the device's own frame."""
    for vue, heading in (("vue_1", HEADING_RAD), ("vue_2", 0.0)):
        stamps = [stamp_ns(m.header.stamp) for m in walked.velocities[vue]]
        assert np.diff(stamps) == pytest.approx(NS / 10, abs=NS / RATE_HZ)
        walking = [
            m
            for m, ns in zip(walked.velocities[vue], stamps, strict=True)
            if REST_S + 5 < (ns - START_NS) / NS < REST_S + WALK_S - 1
        ]
        assert len(walking) > 100
        for message in walking:
            linear = message.twist.twist.linear
            assert math.atan2(linear.y, linear.x) == pytest.approx(heading, abs=0.15)
            assert 0.5 < math.hypot(linear.x, linear.y) < 2.0
            cov = np.reshape(message.twist.covariance, (6, 6))[:2, :2]
            assert (cov == cov.T).all()
            assert 1e-4 < np.linalg.eigvalsh(cov)[0] < np.linalg.eigvalsh(cov)[1] < 4.0


def test_map_velocities_carry_the_track(walked: Heard) -> None:
    """Dead reckoning alone from the initial pose: as far as the steps say, in their direction."""
    status = walked.status["vue_1"][-1]
    assert status.rejected <= UNALIGNED
    assert set(status.sources) == {"step_velocity"}
    position = walked.odometry["vue_1"][-1].pose.pose.position
    moved = np.array([position.x, position.y]) - BEGIN[:2]
    length = sum(step.length for step in walked.steps["vue_1"])
    assert np.hypot(*moved) == pytest.approx(length, rel=0.15)
    assert math.atan2(moved[1], moved[0]) == pytest.approx(HEADING_RAD, abs=0.15)


def test_relative_velocities_are_refused_and_counted(walked: Heard) -> None:
    last = walked.status["vue_2"][-1]
    counted = dict(zip(last.rejection_reasons, last.rejection_counts, strict=True))
    assert counted["frame"] >= len(walked.velocities["vue_2"]) - 3
    assert all("step_velocity" not in s.sources for s in walked.status["vue_2"])
    # The range alone, after a silence: anywhere on its ring. The mean lies inside, the level holds
    # the far side, and nobody calls it TRACKING.
    position = walked.odometry["vue_2"][-1].pose.pose.position
    from_anchor = math.hypot(position.x, position.y)
    assert from_anchor < 6.0
    assert last.state in (TrackState.INITIALISING, TrackState.AMBIGUOUS)
    assert last.protection_level > from_anchor + 4.0
