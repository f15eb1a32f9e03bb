"""The tracker of one network among several: whose measurements it takes, where it publishes."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from ekf_tracker.node import EkfTrackerNode
from netpos.messages.network_tracks import network_track_from_msg
from netpos.messages.values import Field, RsuInfo, RsuMeasurement
from netpos_node import CODEC
from nodes import Kept, nodes_of
from rclpy.serialization import serialize_message

DOMAIN = 44
SETTINGS = {
    "network": "wifi",
    "filter": "kf",
    "motion_model": "constant_acceleration",
    "initial_position_sd_max_m": 20.0,
    "hold_s": 0.0,
}


@pytest.fixture
def make() -> Iterator[Any]:
    with nodes_of(EkfTrackerNode, DOMAIN) as node:
        yield node


def fix(rsu: str, t_s: float, vue: str) -> bytes:
    value = RsuMeasurement(
        stamp_ns=1_000_000_000 + round(t_s * 1e9),
        rsu_id=rsu,
        vue_id=vue,
        expected=1,
        fields=Field.POSITION,
        position=np.array([3.0 * t_s, 1.0, 0.0]),
        position_cov=np.diag([4.0, 4.0, 4.0]),
    )
    return serialize_message(CODEC.measurement_to_msg(value))


def feed(node: EkfTrackerNode) -> None:
    inputs = {s.topic_name: s for s, _ in node._inputs}
    for rsu, network in (("ap", "wifi"), ("base", "wimax")):
        info = RsuInfo(rsu_id=rsu, position=np.zeros(3), network=network)
        inputs["/rsu/info"].callback(CODEC.rsu_info_to_msg(info))
    for k in range(20):
        inputs["/rsu/measurements"].callback(fix("ap", 0.5 * k, "phone"))
        inputs["/rsu/measurements"].callback(fix("base", 0.5 * k + 0.1, "modem"))


def test_only_the_networks_own_devices_are_tracked(make: Any) -> None:
    node = make(**SETTINGS)
    tracks = node._track_pub = Kept()
    feed(node)
    assert set(node._outputs) == {"vue_1", "phone"}
    assert node._tracker.rejected() == {"phone": {}}
    published = dict(node.get_publisher_names_and_types_by_node("ekf_tracker", "/"))
    assert "/networks/wifi/phone/odometry" in published
    assert published["/networks/wifi/tracks"] == ["netpos_msgs/msg/NetworkTrack"]
    assert "/tf" not in published
    newest = network_track_from_msg(tracks.messages[-1])
    assert (newest.network, newest.vue_id, newest.frame_id) == ("wifi", "phone", "map")
    assert newest.mean[0] == pytest.approx(28.5, abs=0.5)
    assert newest.mean[2] == pytest.approx(3.0, abs=0.5)
    assert 0.0 < newest.own_cov[0, 0] <= newest.cov[0, 0]


def test_diagnostics_name_the_network(make: Any) -> None:
    node = make(**SETTINGS)
    diagnostics = node._diagnostics_pub = Kept()
    feed(node)
    node._publish_diagnostics()
    names = {status.name for status in diagnostics.messages[-1].status}
    assert {"ekf_tracker wifi: phone", "ekf_tracker wifi: rsus"} <= names


def test_names_of_a_scenario_are_the_networks_own(make: Any) -> None:
    node = make(scenario="two_networks", network="wifi")
    assert set(node._outputs) == {"wifi_1"}


def test_without_a_network_all_count(make: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    seconds = itertools.count(1000)  # the topics of two devices are not made at once
    monkeypatch.setattr("ekf_tracker.node.time.monotonic", lambda: float(next(seconds)))
    node = make(**(SETTINGS | {"network": ""}))
    assert node._track_pub is None
    feed(node)
    assert {"phone", "modem"} <= set(node._outputs)


def test_a_network_needs_a_name(make: Any) -> None:
    with pytest.raises(ValueError, match="network: 'wi fi' is no name of a network"):
        make(network="wi fi")
