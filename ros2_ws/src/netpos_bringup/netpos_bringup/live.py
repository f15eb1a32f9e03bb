"""Serve a running graph to Foxglove and ``netpos watch``: ``ros2 run netpos_bringup live``.

Viewers read and nothing else: they cannot publish, call services or set parameters. A topic is
subscribed to while somebody looks at it.
"""

from __future__ import annotations

import argparse
import ipaddress
import os
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from queue import SimpleQueue
from typing import Any

import foxglove
from foxglove.websocket import Capability, ServerListener
from netpos.bags import BagError
from netpos.bags.types import definition
from netpos.messages.topics import CLOCK
from netpos_bag.conversions import clock_ns
from netpos_node import run
from rclpy.utilities import remove_ros_args

from netpos_bringup.listening import LOOK_S, ListeningNode, call_until_stopped

PORT = 8765
_TAKE_S = 0.01
_JOIN_S = 0.1  # the server tells of a viewer a moment before it hands anything to them
_TIME_S = 0.1  # viewers are told the time so often
_BACKLOG = 10_000  # messages for a viewer that is slow; the oldest are dropped


class _Viewers(ServerListener):
    """Notes, in the server's threads, who looks at what."""

    def __init__(self) -> None:
        self.changes: SimpleQueue[tuple[float, str, int]] = SimpleQueue()

    def on_subscribe(self, client: Any, channel: Any) -> None:
        """Somebody looks at a topic."""
        self.changes.put((time.monotonic(), channel.topic, 1))

    def on_unsubscribe(self, client: Any, channel: Any) -> None:
        """Somebody looks at it no longer."""
        self.changes.put((time.monotonic(), channel.topic, -1))


class LiveNode(ListeningNode):
    """The topics of the graph as channels of a Foxglove WebSocket server."""

    def __init__(self, host: str, port: int, **node_options: Any) -> None:
        super().__init__("netpos_live", start_parameter_services=False, **node_options)
        self._context_of_channels = foxglove.Context()
        self._channels: dict[str, foxglove.Channel] = {}
        self._viewers = _Viewers()
        self._next: tuple[float, str, int] | None = None
        self._looking: dict[str, int] = {}
        self._left_out: set[str] = set()
        self._clock_ns: int | None = None
        self._server = foxglove.start_server(
            name="netpos",
            host=host,
            port=port,
            capabilities=[Capability.Time],
            supported_encodings=["cdr"],
            server_listener=self._viewers,
            context=self._context_of_channels,
            message_backlog_size=_BACKLOG,
        )

    @property
    def port(self) -> int:
        """The port it listens on."""
        return int(self._server.port)

    def serve_until_stopped(self) -> None:
        """Serve until SIGINT or SIGTERM."""
        tasks: dict[Callable[[], None], float] = {
            self.look: LOOK_S,
            self.pass_on: _TAKE_S,
            self.tell_time: _TIME_S,
        }
        call_until_stopped(tasks, _TAKE_S)
        self.stop()

    def stop(self) -> None:
        """End the server and its connections."""
        self._server.stop()

    def look(self) -> None:
        """Offer what is published by now, and no longer what is not."""
        published = self.published()
        for topic, type_name in published.items():
            if topic not in self._channels and topic not in self._left_out:
                self._offer(topic, type_name)
        for topic in self._channels.keys() - published.keys():
            self.forget(topic)
            self._channels.pop(topic).close()
        if CLOCK in published:
            self.listen(CLOCK, published[CLOCK])

    def pass_on(self) -> None:
        """Hand what has arrived to those who look at it."""
        self._follow_viewers()
        arrived = self.take()
        wall_ns = time.time_ns()
        for message in arrived:
            if message.topic == CLOCK:
                self._clock_ns = clock_ns(message.cdr)
            if self._looking.get(message.topic) and message.topic in self._channels:
                stamp_ns = wall_ns if self._clock_ns is None else self._clock_ns
                self._channels[message.topic].log(message.cdr, log_time=stamp_ns)

    def tell_time(self) -> None:
        """Tell viewers the network time, or that of the system where no /clock is published."""
        self._server.broadcast_time(time.time_ns() if self._clock_ns is None else self._clock_ns)

    def _offer(self, topic: str, type_name: str) -> None:
        try:
            text = definition(type_name)
        except BagError as error:
            self._left_out.add(topic)
            self.get_logger().warning(f"{topic} is not served: {error}")
            return
        schema = foxglove.Schema(name=type_name, encoding="ros2msg", data=text.encode())
        self._channels[topic] = foxglove.Channel(
            topic, schema=schema, message_encoding="cdr", context=self._context_of_channels
        )

    def _follow_viewers(self) -> None:
        """Listen to what is looked at; what is latched is given out anew to those who come
        later."""
        changes = self._viewers.changes
        while self._next is not None or not changes.empty():
            self._next = self._next or changes.get()
            at_s, topic, change = self._next
            if time.monotonic() - at_s < _JOIN_S:
                return
            self._next = None
            count = self._looking.get(topic, 0) + change
            self._looking[topic] = max(count, 0)
            joined_later = change > 0 and self.is_latched(topic)
            if topic != CLOCK and (joined_later or not self._looking[topic]):
                self.forget(topic)
            channel = self._channels.get(topic)
            schema = channel.schema() if channel is not None else None
            if schema is not None and self._looking[topic]:
                self.listen(topic, schema.name)


def live_flags(arguments: Sequence[str]) -> argparse.Namespace:
    """Host and port of the command line; exit 2 for bad ones."""
    parser = argparse.ArgumentParser(
        prog="ros2 run netpos_bringup live",
        description="Serve the topics of the running graph to Foxglove and netpos watch.",
    )
    parser.add_argument(
        "--host",
        default="127.0.0.1",
        help="address to listen on (127.0.0.1: this machine only); whoever reaches it reads all",
    )
    parser.add_argument("--port", type=_port, default=PORT, help=f"port ({PORT}); 0: any free one")
    return parser.parse_args(arguments)


def _port(text: str) -> int:
    port = int(text)
    if not 0 <= port <= 65535:
        raise argparse.ArgumentTypeError(f"a port is 0 to 65535, got {port}")
    return port


def is_loopback(host: str) -> bool:
    """Whether an address can be reached from this machine only."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _started(host: str, port: int) -> LiveNode:
    try:
        node = LiveNode(host, port)
    except RuntimeError as error:  # of the server; those of ROS are of other kinds
        reason = str(error).removeprefix("FoxgloveError: ")
        print(f"live: cannot serve at {host}:{port}: {reason}; choose --port", file=sys.stderr)
        sys.exit(1)
    domain = os.environ.get("ROS_DOMAIN_ID", "0")
    print(f"serving ROS domain {domain} at ws://{host}:{node.port}", flush=True)
    if not is_loopback(host):
        print(f"live: everybody who reaches {host} can read all topics", file=sys.stderr)
    return node


def main() -> None:
    """Serve until SIGINT or SIGTERM; exit 1 where the port is taken, 2 for bad options."""
    flags = live_flags(remove_ros_args(sys.argv)[1:])
    foxglove.set_log_level("CRITICAL")  # nothing: who comes and goes is no news, viewers are told
    run(partial(_started, flags.host, flags.port), LiveNode.serve_until_stopped)
