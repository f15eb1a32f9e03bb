"""An RSU that floods the node: it is limited and named, the honest ones are heard."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from ekf_tracker.node import EkfTrackerNode
from feed import DOMAIN, T0, arrive, drive, keep, know_rsus, measurement
from netpos.messages.values import Field, InitialPose
from netpos_node import CODEC
from nodes import Kept, nodes_of
from rclpy.time import Time

APART_S = 0.26
"""Between the topics of two devices; a node makes them no faster."""


@pytest.fixture
def make() -> Iterator[Any]:
    with nodes_of(EkfTrackerNode, DOMAIN) as found:
        yield found


def test_a_flood_of_an_rsu_is_refused_and_named(make: Any) -> None:
    """Two seconds of stamps: 20 of each are heard of the flooder, the rest is counted."""
    node = make(max_rate_hz=20)
    know_rsus(node)
    odometry, _, _ = keep(node)
    for k in range(20):
        for name in ("a", "b", "c"):
            arrive(node, "/rsu/measurements", measurement(name, 0.1 * k))
        flooding = measurement("a", 0.1 * k, rsu_id="flooder")
        for _ in range(50):
            arrive(node, "/rsu/measurements", flooding)
    assert len(odometry.messages) >= 15
    door = node._tracker.refusals.rsus()["flooder"]
    assert door.counts["rate"] == 20 * 50 - 2 * 20
    assert door.counts["unknown_rsu"] == 2 * 20
    findings = {f.subject: f for f in node._tracker.findings(node._statuses, {})}
    assert findings["rsu flooder"].level.name == "ERROR"
    assert "max_rate_hz" in findings["rsu flooder"].message


def test_a_flood_makes_no_device_known(make: Any) -> None:
    node = make(max_rate_hz=20, max_rsu_rate_hz=20)
    know_rsus(node)
    for k in range(40):
        arrive(node, "/rsu/measurements", measurement("a", 0.1, f"device_{k // 10}"))
    assert {"device_0", "device_1"} == set(node.tracker.rejected())


def topics_of(node: EkfTrackerNode, device: str) -> set[str]:
    published = dict(node.get_publisher_names_and_types_by_node("ekf_tracker", "/"))
    heard = dict(node.get_subscriber_names_and_types_by_node("ekf_tracker", "/"))
    return {name for name in (*published, *heard) if name.startswith(f"/{device}/")}


def test_a_device_of_which_nothing_sound_came_has_no_topics(make: Any) -> None:
    """It has a line in the diagnostics, until it is silent."""
    node = make()
    know_rsus(node)
    for k in range(20):
        arrive(node, "/rsu/measurements", measurement("a", 0.1 * k, "made_up", rsu_id="nobody"))
    assert not topics_of(node, "made_up")
    (line,) = [s for s in said(node) if s.name == "ekf_tracker: made_up"]
    assert "unknown_rsu" in line.message
    drive(node, range(20, 22), "made_up")
    assert {"/made_up/odometry", "/made_up/initialpose"} <= topics_of(node, "made_up")


def said(node: EkfTrackerNode) -> list[Any]:
    """The lines of the diagnostics of a tick."""
    node._diagnostics_pub = Kept()
    node._on_diagnostics_tick()
    return list(node._diagnostics_pub.messages[-1].status)


def test_a_device_that_is_silent_gives_its_topics_back(
    make: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After the time that ends its track, by the node's clock; it has them again when it is heard
    again. One of which nothing was ever taken is forgotten, one that was asked for keeps them."""
    node = make(max_gap_s=10.0, use_sim_time=True)
    know_rsus(node)
    drive(node, range(5), "car")
    drive(node, range(5))
    arrive(node, "/rsu/measurements", measurement("a", 0.1, "made_up", rsu_id="nobody"))
    time.sleep(APART_S)
    drive(node, range(2), "once")
    assert "once" in node._outputs
    begun_s = time.monotonic()

    def after(seconds: float) -> set[str]:
        node.get_clock().set_ros_time_override(Time(nanoseconds=T0 + round(1e9 * seconds)))
        monkeypatch.setattr(
            "netpos_node.estimating.time.monotonic", lambda: begun_s + max(seconds, 0.0)
        )
        return {s.name.removeprefix("ekf_tracker: ") for s in said(node)}

    assert {"vue_1", "car", "made_up"} <= after(0.0)
    assert {"vue_1", "car", "made_up"} <= after(9.9)
    assert "/car/odometry" in topics_of(node, "car")
    assert after(10.1) & {"vue_1", "car", "made_up"} == {"vue_1", "car"}
    assert not topics_of(node, "car")
    assert not topics_of(node, "once")
    assert {"/vue_1/odometry", "/vue_1/initialpose"} <= topics_of(node, "vue_1")
    drive(node, range(105, 110), "car")
    assert {"/car/odometry", "/car/initialpose"} <= topics_of(node, "car")
    assert {"vue_1", "car"} <= after(11.0)


def test_many_new_devices_get_their_topics_one_after_the_other(
    make: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To make them stops the others: one device in a quarter of a second, whoever it is."""
    node = make()
    know_rsus(node)
    now_s = [1000.0]
    monkeypatch.setattr("ekf_tracker.node.time.monotonic", lambda: now_s[0])
    for second, count in ((0.0, 1), (0.2, 1), (0.3, 2), (0.5, 2), (0.6, 3)):
        now_s[0] = 1000.0 + second
        first = round(100.0 * second)
        for k in range(8):
            drive(node, range(first, first + 2), f"new_{k}")
        assert len(node._outputs) == 1 + count
    assert len(node.tracker.rejected()) == 8


def test_a_device_that_was_silent_makes_room_and_its_topics_go(make: Any) -> None:
    node = make(max_devices=1, max_gap_s=1.0)
    know_rsus(node)
    drive(node, range(2), "first")
    wanted = {"/first/odometry", "/first/track_status", "/first/initialpose"}
    assert wanted <= topics_of(node, "first")
    time.sleep(APART_S)
    drive(node, range(5, 6), "second")
    assert not topics_of(node, "second")
    drive(node, range(20, 22), "second")
    assert "/second/odometry" in topics_of(node, "second")
    assert not topics_of(node, "first")
    assert list(node.tracker.rejected()) == ["second"]


ALONE = {"expected": 1, "fields": Field.AZIMUTH}
"""What one RSU says of a device that no other hears."""


def test_a_device_has_topics_from_its_first_fix_on(make: Any) -> None:
    """A direction gives none: of names that are heard once, or for two seconds, only the
    diagnostics tell."""
    node = make()
    know_rsus(node)
    for k in range(20):
        arrive(node, "/rsu/measurements", measurement("a", 0.1 * k, "maybe", **ALONE))
        arrive(node, "/rsu/measurements", measurement("a", 0.1 * k, f"once_{k}", **ALONE))
    assert set(node._outputs) == {"vue_1"}
    assert not topics_of(node, "maybe")
    assert not topics_of(node, "once_3")
    (line,) = [s for s in said(node) if s.name == "ekf_tracker: maybe"]
    assert line.message.startswith("waiting: ")
    assert "AZIMUTH of a" in line.message
    drive(node, range(20, 21), "maybe")
    assert not topics_of(node, "maybe")  # a second epoch must agree with the first fix
    drive(node, range(21, 22), "maybe")
    assert {"/maybe/odometry", "/maybe/initialpose"} <= topics_of(node, "maybe")


def test_a_device_that_needs_a_pose_can_be_given_one(make: Any) -> None:
    """Heard for three seconds without a fix, it is listened to; its estimates need the fix."""
    node = make()
    know_rsus(node)
    for k in range(32):
        arrive(node, "/rsu/measurements", measurement("a", 0.1 * k, "needy", **ALONE))
    assert "/needy/initialpose" in topics_of(node, "needy")
    assert "/needy/odometry" not in topics_of(node, "needy")
    pose = InitialPose(
        stamp_ns=T0 + 3_200_000_000,
        vue_id="needy",
        position=np.array([25.6, 0.0, 0.0]),
        cov=np.eye(3),
    )
    time.sleep(APART_S)
    arrive(node, "/needy/initialpose", CODEC.initial_pose_to_msg(pose))
    arrive(node, "/rsu/measurements", measurement("a", 3.2, "needy", **ALONE))
    arrive(node, "/rsu/measurements", measurement("a", 3.3, "needy", **ALONE))
    assert {"/needy/odometry", "/needy/initialpose"} <= topics_of(node, "needy")
