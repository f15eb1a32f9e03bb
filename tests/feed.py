"""A tracker node is fed, and what it publishes kept."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from ekf_tracker.node import EkfTrackerNode
from nav_msgs.msg import Odometry
from netpos.messages.values import Field, RsuInfo, RsuMeasurement
from netpos_msgs.msg import ClockState
from netpos_msgs.msg import TrackStatus as TrackStatusMsg
from netpos_node import CODEC
from nodes import Kept
from rclpy.serialization import serialize_message

DOMAIN = 36
T0 = 1_000_000_000
PLACES = {"a": (0.0, 10.0), "b": (60.0, -10.0), "c": (120.0, 10.0)}


def arrive(node: EkfTrackerNode, topic: str, msg: Any) -> None:
    """As the executor does when a message has arrived."""
    subscription = next(s for s, _ in node._inputs if s.topic_name == topic)
    subscription.callback(serialize_message(msg) if subscription.raw else msg)


def know_rsus(node: EkfTrackerNode) -> None:
    for name, (x, y) in PLACES.items():
        info = RsuInfo(rsu_id=name, position=np.array([x, y, 0.0]))
        arrive(node, "/rsu/info", CODEC.rsu_info_to_msg(info))


def measurement(name: str, t_s: float, vue_id: str = "vue_1", **change: Any) -> Any:
    """What an RSU measures of a device that drives east along y = 0 at 8 m/s."""
    d = np.array([8.0 * t_s, 0.0]) - PLACES[name]
    values = {
        "stamp_ns": T0 + round(t_s * 1e9),
        "rsu_id": name,
        "vue_id": vue_id,
        "expected": 3,
        "fields": Field.AZIMUTH | Field.TOA,
        "azimuth_rad": math.atan2(d[1], d[0]),
        "azimuth_var": 3e-4,
        "toa_s": float(np.linalg.norm(d)) / 299_792_458.0,
        "toa_var": 1e-18,
    }
    return CODEC.measurement_to_msg(RsuMeasurement(**(values | change)))


def drive(node: EkfTrackerNode, epochs: range, vue_id: str = "vue_1") -> None:
    for k in epochs:
        for name in PLACES:
            arrive(node, "/rsu/measurements", measurement(name, 0.1 * k, vue_id))


def keep(node: EkfTrackerNode, vue_id: str = "vue_1") -> tuple[Kept, Kept, Kept]:
    if vue_id not in node._outputs:
        node._add_device(vue_id)
    kept = Kept(Odometry), Kept(ClockState), Kept(TrackStatusMsg)
    node._outputs[vue_id] = kept  # type: ignore[assignment]
    return kept
