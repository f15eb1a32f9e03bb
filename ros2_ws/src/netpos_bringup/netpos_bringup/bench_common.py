"""What every measurement of a running tracker needs: a node that publishes and listens without an
executor, and processes that end with their block."""

from __future__ import annotations

import struct
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped
from netpos.messages import topics
from netpos.messages.values import RsuInfo as Description
from netpos_msgs.msg import RsuInfo, RsuMeasurement
from netpos_node import BACKLOG, CODEC, LATCHED
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription

from netpos_bringup.bench_process import Measured
from netpos_bringup.bench_traffic import RSUS

START_S = 60.0
"""How long a process may take to be there [s]."""
_STAMP = struct.Struct("<iI")  # the first field of a serialised message with a header


class Probe:
    """Publishers and raw subscriptions, taken from without an executor: its time is not ours.
    ``rsus`` are described."""

    def __init__(self, rsus: Iterable[Description] = RSUS) -> None:
        self.node = Node("bench_probe", start_parameter_services=False)
        info = self.node.create_publisher(RsuInfo, topics.RSU_INFO, LATCHED)
        for rsu in rsus:
            info.publish(CODEC.rsu_info_to_msg(rsu))
        self.tracker = self.node.create_publisher(RsuMeasurement, topics.RSU_MEASUREMENTS, BACKLOG)

    def pose_publisher(self, vue_id: str) -> Publisher:
        """Publisher of a device's initial pose."""
        topic = topics.of_vue(vue_id, topics.INITIAL_POSE)
        return self.node.create_publisher(PoseWithCovarianceStamped, topic, BACKLOG)

    def listen(self, message_type: Any, topic: str) -> Subscription:
        """Raw subscription that nobody spins."""
        return self.node.create_subscription(
            message_type, topic, lambda _: None, BACKLOG, raw=True
        )


def taken(subscription: Subscription) -> Iterator[bytes]:
    """Serialised messages that have arrived."""
    with subscription.handle:
        while True:
            message = subscription.handle.take_message(subscription.msg_type, True)
            if message is None:
                return
            yield message[0]


def stamp_of(message: bytes) -> int:
    """Stamp [ns] of a serialised message that begins with a header."""
    sec, nanosec = _STAMP.unpack_from(message, 4)
    return int(sec) * 1_000_000_000 + int(nanosec)


def wait_for(condition: Callable[[], Any], what: str, processes: list[Measured]) -> None:
    """Poll until true; ``TimeoutError`` names ``what``."""
    end = time.monotonic() + START_S
    while not condition():
        for process in processes:
            process.check()
        if time.monotonic() > end:
            raise TimeoutError(f"waited {START_S:g} s in vain for {what}")
        time.sleep(0.01)


@contextmanager
def started(*commands: list[str]) -> Iterator[list[Measured]]:
    """Processes that end with the block."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        yield [
            stack.enter_context(Measured(command, Path(folder) / f"{i}.log"))
            for i, command in enumerate(commands)
        ]
