"""What a graph says of its devices and RSUs: the content of a terminal view."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from netpos.bags import codec
from netpos.messages import topics
from netpos.messages.values import ClockState, Odometry, TrackStatus

_TYPES = {
    topics.ODOMETRY: "nav_msgs/msg/Odometry",
    topics.TRACK_STATUS: "netpos_msgs/msg/TrackStatus",
    topics.CLOCK_STATE: "netpos_msgs/msg/ClockState",
}
_FORGET_S = 60.0  # a device that was not heard for so long leaves the board


@dataclass(slots=True)
class DeviceLine:
    """The newest messages of one device.

    ``heard_s``: when the last one came; ``estimated_s``: the last odometry; viewer's clock [s].
    """

    name: str
    odometry: Odometry | None = None
    status: TrackStatus | None = None
    clock: ClockState | None = None
    estimated_s: float = -math.inf
    heard_s: float = -math.inf

    @property
    def refused(self) -> int:
        """Measurements refused since the tracker started."""
        return sum(self.status.rejected.values()) if self.status is not None else 0


@dataclass(frozen=True, slots=True)
class HealthLine:
    """A line of /diagnostics. level : 0 ok, 1 warning, 2 error, 3 stale."""

    level: int
    subject: str
    message: str
    values: dict[str, str] = field(default_factory=dict)

    @property
    def age_s(self) -> float:
        """Seconds since the RSU was heard; 0 if the line is not about an RSU."""
        return number(self.values.get("age_s", "0"))


class Board:
    """Collects messages by topic. ``now_s``: the viewer's steady clock [s]; ``namespace``: only
    topics of nodes in it count."""

    def __init__(self, namespace: str = "") -> None:
        self._namespace = namespace.strip("/")
        self._devices: dict[str, DeviceLine] = {}
        self._health: dict[str, HealthLine] = {}
        self.rsus: set[str] = set()
        self.network_time_ns: int | None = None
        self.unread: dict[str, int] = {}
        """Number of messages that could not be understood, by topic."""

    def wants(self, topic: str, type_name: str) -> bool:
        """Whether the board shows messages of this topic."""
        topic = topics.below(topic, self._namespace)
        if topic == topics.DIAGNOSTICS:
            return type_name == "diagnostic_msgs/msg/DiagnosticArray"
        if topic == topics.RSU_INFO:
            return type_name == "netpos_msgs/msg/RsuInfo"
        device, name = _device(topic)
        return bool(device) and _TYPES.get(name) == type_name

    def add(self, topic: str, message: Any, log_time_ns: int, now_s: float) -> None:
        """Take a message of a wanted topic; ``unread`` counts those not understood."""
        self.network_time_ns = log_time_ns
        try:
            self._add(topics.below(topic, self._namespace), message, now_s)
        except ValueError:
            self.unread[topic] = self.unread.get(topic, 0) + 1

    def _add(self, topic: str, message: Any, now_s: float) -> None:
        if topic == topics.DIAGNOSTICS:
            self._add_diagnostics(message)
        elif topic == topics.RSU_INFO:
            self.rsus.add(str(message.rsu_id))
        else:
            self._add_of_device(*_device(topic), message, now_s)

    def devices(self, now_s: float) -> list[DeviceLine]:
        """Devices by name, without those that were not heard for a minute."""
        for name in [n for n, d in self._devices.items() if now_s - d.heard_s > _FORGET_S]:
            del self._devices[name]
        return [self._devices[name] for name in sorted(self._devices)]

    def health(self) -> list[HealthLine]:
        """Lines of RSUs, networks and the input as a whole: the worst first; of equals the one
        that was heard last."""
        return sorted(
            self._health.values(), key=lambda line: (-line.level, line.age_s, line.subject)
        )

    @property
    def complete(self) -> bool:
        """Whether devices and their health have been heard."""
        return bool(self._devices and self._health)

    def _add_of_device(self, device: str, name: str, message: Any, now_s: float) -> None:
        line = self._devices.setdefault(device, DeviceLine(device))
        line.heard_s = now_s
        if name == topics.ODOMETRY:
            line.odometry, line.estimated_s = codec().odometry_from_msg(message), now_s
        elif name == topics.TRACK_STATUS:
            line.status = codec().track_status_from_msg(message)
        else:
            line.clock = codec().clock_state_from_msg(message)

    def _add_diagnostics(self, message: Any) -> None:
        """Lines of devices are left out: their table says more."""
        above = f"{self._namespace}/" if self._namespace else ""
        for status in message.status:
            if not status.name.startswith(above):
                continue
            name = status.name.removeprefix(above)
            source, _, subject = name.partition(": ")
            if not topics.is_vue_id(subject) or subject == "rsus":
                key = subject if source == "ekf_tracker" else name
                values = {pair.key: pair.value for pair in status.values}
                self._health[key] = HealthLine(_level(status.level), key, status.message, values)


def number(text: str) -> float:
    """A number in /diagnostics; infinity if the text is not a finite number."""
    try:
        value = float(text)
    except ValueError:
        return math.inf
    return value if math.isfinite(value) else math.inf


def _level(value: Any) -> int:
    """A byte, as a number or as bytes."""
    return value[0] if isinstance(value, bytes) else int(value)


def _device(topic: str) -> tuple[str, str]:
    """``vue_1`` or ``wifi/phone``, and the topic's name; two empty texts for another topic."""
    network, vue_id, name = topics.split_network(topic)
    if vue_id:
        return f"{network}/{vue_id}", name
    device, name = topics.split(topic)
    return (device, name) if topics.is_vue_id(device) else ("", "")
