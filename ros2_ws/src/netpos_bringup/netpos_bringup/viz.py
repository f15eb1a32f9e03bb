"""Markers and paths for RViz and Foxglove: ``ros2 run netpos_bringup viz``."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path as FilePath
from typing import Any

from nav_msgs.msg import Path
from netpos.live.scene import Scene, SceneConfig
from netpos.live.shapes import Numbers
from netpos.messages import topics
from netpos_node import CDR, CODEC, STREAM, declare_config, message_class, run
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from visualization_msgs.msg import MarkerArray

from netpos_bringup.listening import LOOK_S, Arrived, ListeningNode, call_until_stopped
from netpos_bringup.viz_messages import deletion, deletion_of_all, markers, path_cdr

_PAUSE_S = 0.01
_SCENARIO = "scenario"
_NEWEST = QoSProfile(  # who comes late has the whole map in one message
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class VizConfig:
    """How often is drawn, and how long it lasts."""

    rate_hz: float = field(
        default=5.0, metadata={"low": 0.1, "high": 50.0, "text": "frames per second of real time"}
    )
    path_rate_hz: float = field(
        default=1.0, metadata={"low": 0.1, "high": 50.0, "text": "paths per second of real time"}
    )
    lifetime_s: float = field(
        default=5.0,
        metadata={"low": 0.0, "high": 3600.0, "text": "markers vanish after so long without viz"},
    )


class VizNode(ListeningNode):
    """Feeds a ``Scene`` with what trackers, RSUs and the simulator publish, and draws it."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__("viz", **node_options)
        self.config = declare_config(self, VizConfig)
        self._scene = Scene(declare_config(self, SceneConfig))
        self._numbers, self._map_numbers = Numbers(), Numbers()
        self._markers_pub = self.create_publisher(
            MarkerArray, topics.to_resolve(topics.VIZ_MARKERS), 10
        )
        self._map_pub = self.create_publisher(
            MarkerArray, topics.to_resolve(topics.VIZ_MAP), _NEWEST
        )
        self._path_pubs: dict[tuple[str, str], Publisher] = {}
        self._map_changed = False

    def draw_until_stopped(self) -> None:
        """Draw until SIGINT or SIGTERM."""
        tasks: dict[Callable[[], None], float] = {
            self.look: LOOK_S,
            self.draw: 1.0 / self.config.rate_hz,
            self.draw_paths: 1.0 / self.config.path_rate_hz,
        }
        call_until_stopped(tasks, _PAUSE_S)

    def look(self) -> None:
        """Listen to what is published by now, and no longer to what is not."""
        published = self.published()
        for topic, type_name in published.items():
            name = self._below(topic)
            if _reader(name, type_name) is None or topic in self.heard:
                continue
            if name == topics.RSU_INFO:
                self._scene.clear_rsus()  # those of a run that is over
            self.listen(topic, type_name)
        for topic in self.heard:
            if topic not in published:
                self.forget(topic)

    def _below(self, topic: str) -> str:
        return topics.below(topic, self.get_namespace())

    def draw(self) -> None:
        """Take what has arrived; publish what is on the map now."""
        now_s = time.monotonic()
        refused = sum(self._scene.refused.values())
        for arrived in self.take():
            self._read(replace(arrived, topic=self._below(arrived.topic)), now_s)
        if sum(self._scene.refused.values()) > refused:
            self.get_logger().warning(
                f"not drawn: {self._scene.refused}", throttle_duration_sec=10.0
            )
        if self._map_changed:
            shown, _ = self._map_numbers.frame(self._scene.map_shapes())
            self._map_pub.publish(MarkerArray(markers=[deletion_of_all(), *markers(shown)]))
            self._map_changed = False
        if self._markers_pub.get_subscription_count():
            shown, gone = self._numbers.frame(self._scene.shapes(now_s))
            deleted = [deletion(number, group) for number, group in gone]
            made = deleted + markers(shown, self.config.lifetime_s)
            self._markers_pub.publish(MarkerArray(markers=made))

    def draw_paths(self) -> None:
        """Publish the path of every device; the topics of those that are gone go."""
        paths = self._scene.paths(time.monotonic())
        for device, points in paths.items():
            if device not in self._path_pubs:
                network, vue_id = device
                topic = topics.to_resolve(topics.path_of(vue_id, network))
                self._path_pubs[device] = self.create_publisher(Path, topic, STREAM)
            if self._path_pubs[device].get_subscription_count():
                self._path_pubs[device].publish(path_cdr(points))
        for device in self._path_pubs.keys() - paths.keys():
            self.destroy_publisher(self._path_pubs.pop(device))

    def _read(self, arrived: Arrived, now_s: float) -> None:
        reader = _reader(arrived.topic, arrived.type_name)
        assert reader is not None
        try:
            changed = reader(self._scene, arrived, now_s)
        except (ValueError, rclpy_implementation.RMWError) as error:
            self.get_logger().warning(
                f"{arrived.topic}: not drawn: {error}", throttle_duration_sec=10.0
            )
            return
        self._map_changed = self._map_changed or changed


Reader = Callable[[Scene, Arrived, float], bool]
"""Puts a message into the scene; whether the map has changed."""


def _odometry(scene: Scene, arrived: Arrived, now_s: float) -> bool:
    network, vue_id, _ = _device(arrived.topic)
    odometry = CODEC.odometry_from_msg(_message(arrived))
    odometry.vue_id = vue_id
    scene.add_odometry(odometry, network, now_s)
    return False


def _status(scene: Scene, arrived: Arrived, now_s: float) -> bool:
    network, vue_id, _ = _device(arrived.topic)
    status = CODEC.track_status_from_msg(_message(arrived))
    status.vue_id = vue_id
    scene.add_status(status, network, now_s)
    return False


def _measurement(scene: Scene, arrived: Arrived, _: float) -> bool:
    measured = CDR.measurement(arrived.cdr)
    scene.add_measurement(measured or CODEC.measurement_from_msg(_message(arrived)))
    return False


def _rsu(scene: Scene, arrived: Arrived, _: float) -> bool:
    scene.add_rsu(CODEC.rsu_info_from_msg(_message(arrived)))
    return True


def _run(scene: Scene, arrived: Arrived, _: float) -> bool:
    """The scenario's text: what stands in it is drawn, no file that it might name is read."""
    from netpos.scenario.build import buildings_of_text  # noqa: PLC0415 - 140 MB: simulations only

    message = _message(arrived)
    if message.key != _SCENARIO:
        return False
    scene.set_buildings(buildings_of_text(message.value, FilePath(arrived.topic)))
    return True


def _message(arrived: Arrived) -> Any:
    return deserialize_message(arrived.cdr, message_class(arrived.type_name))


_READERS: dict[str, tuple[str, Reader]] = {
    topics.RSU_INFO: ("netpos_msgs/msg/RsuInfo", _rsu),
    topics.RSU_MEASUREMENTS: ("netpos_msgs/msg/RsuMeasurement", _measurement),
    topics.RUN_SCENARIO: ("diagnostic_msgs/msg/KeyValue", _run),
}
_DEVICE_READERS: dict[str, tuple[str, Reader]] = {
    topics.ODOMETRY: ("nav_msgs/msg/Odometry", _odometry),
    topics.TRACK_STATUS: ("netpos_msgs/msg/TrackStatus", _status),
}


def _device(topic: str) -> tuple[str, str, str]:
    """Network, device and name of a device's topic."""
    network, vue_id, name = topics.split_network(topic)
    return (network, vue_id, name) if vue_id else ("", *topics.split(topic))


def _reader(topic: str, type_name: str) -> Reader | None:
    """What reads messages of a topic, None where nothing is drawn of it."""
    _, vue_id, name = _device(topic)
    known = _DEVICE_READERS.get(name) if topics.is_vue_id(vue_id) else _READERS.get(topic)
    return known[1] if known is not None and known[0] == type_name else None


def main() -> None:
    """Entry point of ``ros2 run netpos_bringup viz``."""
    run(VizNode, VizNode.draw_until_stopped, arguments=sys.argv[1:])
