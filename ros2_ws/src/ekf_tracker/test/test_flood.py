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
