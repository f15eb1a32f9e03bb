"""Put a fault between sensors and tracker of a running graph: ``ros2 run netpos_bringup faults``.

Sensors publish below ``input`` (remapped), the node passes everything on under the usual names,
and does to it what ``netpos faults`` does to a recording.
"""

from __future__ import annotations

import heapq
import sys
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import count
from typing import Any

import numpy as np
from geometry_msgs.msg import TwistWithCovarianceStamped
from nav_msgs.msg import Odometry
from netpos.common.parameters import nearest
from netpos.evaluation.faults.piecewise import Piecewise, possible_live
from netpos.evaluation.faults.stream import NS, Arrival, Hit
from netpos.evaluation.pairing import Trajectory
from netpos.messages import topics
from netpos.messages.values import ImuSample, RsuInfo, RsuMeasurement, Velocity
from netpos_msgs.msg import RsuInfo as RsuInfoMsg
from netpos_msgs.msg import RsuMeasurement as RsuMeasurementMsg
from netpos_node import BACKLOG, CODEC, LATCHED, STREAM, declare_config, run, see_delivered
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import Imu

_PERIOD_S = 0.005
_KNOWN = 100  # true poses of a device that are remembered


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultConfig:
    """Which fault, of whom, when and how strong."""

    fault: str = field(default="drop", metadata={"text": "name, as netpos faults --list tells"})
    size: float = field(
        default=0.0, metadata={"low": -1e9, "high": 1e9, "text": "in the unit of the fault"}
    )
    rsus: str = field(default="", metadata={"text": "names with commas between; empty: all"})
    start_s: float = field(
        default=10.0, metadata={"low": 0.0, "high": 1e6, "text": "after the first measurement"}
    )
    lasts_s: float = field(
        default=10.0, metadata={"low": 1e-3, "high": 1e6, "text": "how long it strikes"}
    )
    seed: int = field(default=1, metadata={"low": 0, "high": 2**31 - 1, "text": "of its draws"})
    input: str = field(default="/sensed", metadata={"text": "below it the sensors publish"})
    vues: str = field(default="vue_1", metadata={"text": "devices, with commas between"})

    def __post_init__(self) -> None:
        known = possible_live()
        if self.fault not in known:
            close = nearest(self.fault, known)
            raise ValueError(
                f"no fault {self.fault!r} of a running graph{close}; known: {', '.join(known)}"
            )


class Recent(Mapping[str, Trajectory]):
    """The newest true poses of devices, as trajectories."""

    def __init__(self, vues: list[str]) -> None:
        self._poses: dict[str, deque[Any]] = {vue: deque(maxlen=_KNOWN) for vue in vues}

    def add(self, pose: Any) -> None:
        """Take a pose."""
        self._poses[pose.vue_id].append(pose)

    def __getitem__(self, vue: str) -> Trajectory:
        return Trajectory.of(self._poses[vue])

    def __iter__(self) -> Iterator[str]:
        return iter(self._poses)

    def __len__(self) -> int:
        return len(self._poses)


class FaultNode(Node):
    """Passes on what sensors publish, spoilt while the fault lasts."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__("faults", **node_options)
        self.config = declare_config(self, FaultConfig)
        self._fault: Piecewise | None = None
        self._scene: dict[str, RsuInfo] = {}
        self._rsus: set[str] = set(filter(None, self.config.rsus.split(",")))
        vues = self.config.vues.split(",")
        self._truth = Recent(vues)
        self._due: list[tuple[int, int, str, Any]] = []
        self._number = count()
        self._own: list[Arrival] = []
        self._pubs: dict[str, Any] = {}
        self._relay(topics.RSU_INFO, RsuInfoMsg, CODEC.rsu_info_from_msg, LATCHED)
        self._relay(
            topics.RSU_MEASUREMENTS, RsuMeasurementMsg, CODEC.measurement_from_msg, BACKLOG
        )
        for vue in vues:
            self._relay_device(vue)
        self.create_timer(_PERIOD_S, self.publish_due)

    def _relay_device(self, vue: str) -> None:
        def velocity(msg: Any) -> Velocity:
            return CODEC.velocity_from_msg(msg, vue)

        self._relay(topics.of_vue(vue, topics.IMU), Imu, CODEC.imu_from_msg, BACKLOG)
        steps = topics.of_vue(vue, topics.STEP_VELOCITY)
        self._relay(steps, TwistWithCovarianceStamped, velocity, BACKLOG)
        self.create_subscription(
            Odometry,
            topics.of_vue(vue, topics.GROUND_TRUTH),
            lambda msg: self._truth.add(CODEC.odometry_from_msg(msg)),
            BACKLOG,
        )

    def _relay(self, topic: str, kind: Any, read: Callable[[Any], Any], qos: Any) -> None:
        self._pubs[topic] = self.create_publisher(kind, topic, qos if qos is LATCHED else STREAM)
        self.create_subscription(
            kind,
            self.config.input + topic,
            lambda cdr: self.take(topic, cdr, read(deserialize_message(cdr, kind))),
            qos,
            raw=True,
        )

    def now_ns(self) -> int:
        """Time of this node's clock."""
        return int(self.get_clock().now().nanoseconds)

    def take(self, topic: str, cdr: bytes, value: Any) -> None:
        """Something of a sensor arrived."""
        now_ns = self.now_ns()
        if isinstance(value, RsuInfo):
            self._scene[value.rsu_id] = value
            if not self.config.rsus:
                self._rsus.add(value.rsu_id)
        elif self._fault is None and isinstance(value, RsuMeasurement):
            self._begin(now_ns)
        arrival = Arrival(now_ns, value)
        found = [arrival] if self._fault is None else self._fault.of(arrival)
        for one in found:
            payload = cdr if one.what is value else one.what
            heapq.heappush(self._due, (one.at_ns, next(self._number), topic, payload))
        self.publish_due()

    def _begin(self, now_ns: int) -> None:
        start_ns = now_ns + round(self.config.start_s * NS)
        hit = Hit(
            start_ns=start_ns,
            end_ns=start_ns + round(self.config.lasts_s * NS),
            rsus=frozenset(self._rsus),
            size=self.config.size,
            rng=np.random.default_rng(self.config.seed),
            scene=self._scene,
            truth=self._truth,
        )
        self._fault = Piecewise(possible_live()[self.config.fault], hit)
        for one in self._fault.own():
            item = one.at_ns, next(self._number), topics.RSU_INFO, one.what
            heapq.heappush(self._due, item)
        self.get_logger().info(
            f"{self.config.fault} of {', '.join(sorted(self._rsus))} in {self.config.start_s:g} s,"
            f" for {self.config.lasts_s:g} s"
        )

    def publish_due(self) -> None:
        """Pass on what is due by now."""
        now_ns = self.now_ns()
        while self._due and self._due[0][0] <= now_ns:
            _, _, topic, payload = heapq.heappop(self._due)
            self._pubs[topic].publish(_message(payload))

    def finish(self) -> None:
        """Nothing is kept back at the end."""
        for _, _, topic, payload in sorted(self._due, key=lambda due: due[:2]):
            self._pubs[topic].publish(_message(payload))
        see_delivered(self)


def _message(payload: Any) -> Any:
    """What to publish: bytes as they came or were spoilt, or the message of a value."""
    match payload:
        case RsuMeasurement():
            return CODEC.measurement_to_msg(payload)
        case RsuInfo():
            return CODEC.rsu_info_to_msg(payload)
        case ImuSample():
            return CODEC.imu_to_msg(payload)
        case Velocity():
            return CODEC.velocity_to_msg(payload)
    return payload


def main() -> None:
    """Entry point of ``ros2 run netpos_bringup faults``."""
    run(FaultNode, arguments=sys.argv[1:])
