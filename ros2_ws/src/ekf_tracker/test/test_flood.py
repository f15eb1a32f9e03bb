"""An RSU that floods the node: it is limited and named, the honest ones are heard."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from ekf_tracker.node import EkfTrackerNode
from feed import DOMAIN, arrive, keep, know_rsus, measurement
from nodes import nodes_of


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
    assert {"device_0", "device_1"} <= set(node._outputs)
    assert not {"device_2", "device_3"} & set(node._outputs)


def test_a_device_that_was_silent_makes_room_and_its_topics_go(make: Any) -> None:
    node = make(max_devices=1, max_gap_s=1.0)
    know_rsus(node)

    def topics_of(device: str) -> set[str]:
        published = dict(node.get_publisher_names_and_types_by_node("ekf_tracker", "/"))
        heard = dict(node.get_subscriber_names_and_types_by_node("ekf_tracker", "/"))
        return {name for name in (*published, *heard) if name.startswith(f"/{device}/")}

    arrive(node, "/rsu/measurements", measurement("a", 0.0, "first"))
    assert {"/first/odometry", "/first/track_status", "/first/initialpose"} <= topics_of("first")
    arrive(node, "/rsu/measurements", measurement("a", 0.5, "second"))
    assert not topics_of("second")
    arrive(node, "/rsu/measurements", measurement("a", 2.0, "second"))
    assert "/second/odometry" in topics_of("second")
    assert not topics_of("first")
    assert list(node.tracker._tracks) == ["second"]
