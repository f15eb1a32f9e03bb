"""Measure a running tracker from outside, for ``netpos bench``; prints figures as JSON.

``latency``  measurement to odometry, tracker and relay in turns
``load``     many devices: messages handled, processor time, lag, memory
``flood``    the same while one RSU sends far more than it measures
``soak``     ten devices and a recorder for an hour: memory, lag, what is lost, minute by minute
``ready``    time from the start of the process until it takes measurements, and to the first
             odometry
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
import time
from typing import Any

import numpy as np
import rclpy
from nav_msgs.msg import Odometry
from netpos.messages import topics
from netpos_msgs.msg import RsuMeasurement
from netpos_node import BACKLOG, init
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription

from netpos_bringup import bench_relay
from netpos_bringup.bench_common import START_S, Probe, stamp_of, started, taken, wait_for
from netpos_bringup.bench_load import load
from netpos_bringup.bench_soak import soak
from netpos_bringup.bench_traffic import Device

_ANSWER_S = 1.0
_APART_S = 0.002  # between the measurements of two RSUs, and before the next epoch
_ATTEMPT_S = 0.01
_READY_WORDS = "tracking vue_1"


# latency


class Side:
    """One of the two that answer: where to publish and where the answer comes."""

    def __init__(self, node: Node, publisher: Publisher, answer: Subscription) -> None:
        self.publisher, self.answer = publisher, answer
        self.seconds: list[float] = []
        self.lost = 0
        self._context = node.context
        self._wait_set = rclpy_implementation.WaitSet(1, 0, 0, 0, 0, 0, node.context.handle)

    def time_epoch(self, messages: tuple[bytes, bytes]) -> None:
        """Publish one RSU's measurement, then the other's, and time the answer to the second."""
        self.publisher.publish(messages[0])
        time.sleep(_APART_S)
        for _ in taken(self.answer):
            pass
        stamp = stamp_of(messages[1])
        start = time.perf_counter()
        self.publisher.publish(messages[1])
        while time.perf_counter() - start < _ANSWER_S:
            self._wait_set.clear_entities()
            self._wait_set.add_subscription(self.answer.handle)
            self._wait_set.wait(int(_ANSWER_S * 1e9))
            if any(stamp_of(message) == stamp for message in taken(self.answer)):
                self.seconds.append(time.perf_counter() - start)
                return
        self.lost += 1

    def figures(self) -> dict[str, float]:
        """Median and 99th percentile [s], and how many epochs had no answer."""
        median, p99 = np.percentile(self.seconds, [50, 99])
        return {"median_s": float(median), "p99_s": float(p99), "lost": self.lost}


def latency(tracker: str, epochs: int) -> dict[str, Any]:
    """Time the same traffic through the tracker and through the relay, epoch by epoch in turns."""
    probe, device = Probe(), Device.draw("vue_1", 1)
    odometry = probe.listen(Odometry, topics.of_vue("vue_1", topics.ODOMETRY))
    relayed = probe.listen(Odometry, bench_relay.ODOMETRY)
    to_relay = probe.node.create_publisher(RsuMeasurement, bench_relay.MEASUREMENTS, BACKLOG)
    poses = probe.pose_publisher("vue_1")
    sides = [
        Side(probe.node, probe.tracker, odometry),
        Side(probe.node, to_relay, relayed),
    ]
    relay = [sys.executable, "-c", "from netpos_bringup.bench_relay import main; main()"]
    with started([tracker], relay) as processes:
        ends = [probe.tracker, to_relay, poses]
        wait_for(
            lambda: (
                all(pub.get_subscription_count() for pub in ends)
                and all(probe.node.count_publishers(s.answer.topic_name) for s in sides)
            ),
            "the tracker and the relay",
            processes,
        )
        poses.publish(device.pose(0))
        time.sleep(_ANSWER_S)
        for epoch in range(epochs):
            plain = device.measurements(epoch)
            apart = device.measurements(epoch, (-1, 0))  # the relay answers each: tell them apart
            for side, messages in zip(sides, (plain, apart), strict=True):
                side.time_epoch(messages)
                time.sleep(_APART_S)
        memory = processes[0].memory_mb()
    tracked, relayed_figures = (side.figures() for side in sides)
    return {"epochs": epochs, "tracker": tracked, "relay": relayed_figures, "memory_mb": memory}


# ready


def ready(tracker: str, starts: int) -> dict[str, Any]:
    """Start the tracker and send measurements until it answers with an odometry; ``ready_s``: when
    it says that it tracks."""
    probe, device = Probe(), Device.draw("vue_1", 1)
    answer = probe.listen(Odometry, topics.of_vue("vue_1", topics.ODOMETRY))
    poses = probe.pose_publisher("vue_1")
    attempts = range(round(START_S / _ATTEMPT_S))
    ready_s, seconds, cpu, memory = [], [], [], 0.0
    for start in range(starts):
        begin = time.perf_counter()
        with started([tracker]) as (process,):
            for epoch in attempts:
                if len(ready_s) == start and process.has_said(_READY_WORDS):
                    ready_s.append(time.perf_counter() - begin)
                poses.publish(device.pose(epoch))
                for measurement in device.measurements(epoch):
                    probe.tracker.publish(measurement)
                if any(True for _ in taken(answer)):
                    seconds.append(time.perf_counter() - begin)
                    cpu.append(process.cpu_s())
                    memory = process.memory_mb()
                    break
                process.check()
                time.sleep(_ATTEMPT_S)
            else:
                raise TimeoutError(f"no odometry within {START_S:g} s")
        for _ in taken(answer):
            pass
        if len(ready_s) == start:
            raise RuntimeError(f"the tracker answered and never said {_READY_WORDS!r}")
    return {"ready_s": ready_s, "odometry_s": seconds, "cpu_s": cpu, "memory_mb": memory}


def main() -> int:
    """Entry point of ``ros2 run netpos_bringup bench_probe``."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tracker", required=True, help="executable of the tracker")
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("latency").add_argument("--epochs", type=int, default=1000)
    loading = commands.add_parser("load")
    loading.add_argument("--devices", type=int, default=100)
    loading.add_argument("--seconds", type=float, default=20.0)
    loading.add_argument("--idle", type=float, default=2.0)
    flooding_ = commands.add_parser("flood")
    flooding_.add_argument("--devices", type=int, default=10)
    flooding_.add_argument("--seconds", type=float, default=10.0)
    flooding_.add_argument("--rate", type=float, default=20_000.0)
    soaking = commands.add_parser("soak")
    soaking.add_argument("--recorder", required=True, help="executable of the recorder")
    soaking.add_argument("--devices", type=int, default=10)
    soaking.add_argument("--seconds", type=float, default=3600.0)
    soaking.add_argument("--every", type=float, default=60.0)
    commands.add_parser("ready").add_argument("--starts", type=int, default=3)
    given = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # ends what it has started
    init(signal_handler_options=SignalHandlerOptions.NO)
    try:
        match given.command:
            case "latency":
                figures = latency(given.tracker, given.epochs)
            case "load":
                figures = load(given.tracker, given.devices, given.seconds, given.idle)
            case "soak":
                count, seconds, every = given.devices, given.seconds, given.every
                figures = soak(given.tracker, given.recorder, count, seconds, every)
            case "flood":
                figures = load(given.tracker, given.devices, given.seconds, 2.0, given.rate)
            case _:
                figures = ready(given.tracker, given.starts)
    finally:
        rclpy.try_shutdown()
    print(json.dumps(figures))
    return 0


if __name__ == "__main__":
    sys.exit(main())
