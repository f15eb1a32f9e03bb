"""Measure a running tracker from outside, for ``netpos bench``; prints figures as JSON.

``latency``  measurement to odometry, tracker and relay in turns
``load``     many devices: messages handled, processor time, lag, memory
``flood``    the same while one RSU sends far more than it measures
``ready``    time from the start of the process until it takes measurements, and to the first
             odometry
"""

from __future__ import annotations

import argparse
import json
import signal
import struct
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from netpos.messages import topics
from netpos_msgs.msg import RsuInfo, RsuMeasurement
from netpos_node import BACKLOG, CODEC, LATCHED, init
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription

from netpos_bringup import bench_relay
from netpos_bringup.bench_process import Measured
from netpos_bringup.bench_traffic import FLOODER, PERIOD_S, RSUS, Device

_START_S = 60.0
_ANSWER_S = 1.0
_APART_S = 0.002  # between the measurements of two RSUs, and before the next epoch
_POLL_S = 0.002
_ATTEMPT_S = 0.01
_SETTLE_S = 2.0
_READY_WORDS = "tracking vue_1"
_STAMP = struct.Struct("<iI")  # the first field of a serialised message with a header


class Probe:
    """Publishers and raw subscriptions, taken from without an executor: its time is not ours."""

    def __init__(self) -> None:
        self.node = Node("bench_probe", start_parameter_services=False)
        info = self.node.create_publisher(RsuInfo, topics.RSU_INFO, LATCHED)
        for rsu in RSUS:
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
    end = time.monotonic() + _START_S
    while not condition():
        for process in processes:
            process.check()
        if time.monotonic() > end:
            raise TimeoutError(f"waited {_START_S:g} s in vain for {what}")
        time.sleep(0.01)


@contextmanager
def started(*commands: list[str]) -> Iterator[list[Measured]]:
    """Processes that end with the block."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        yield [
            stack.enter_context(Measured(command, Path(folder) / f"{i}.log"))
            for i, command in enumerate(commands)
        ]


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


# load


def load(
    tracker: str, count: int, seconds: float, idle_s: float, flood_hz: float = 0.0
) -> dict[str, Any]:
    """Feed ``count`` devices at 10 Hz with two RSUs each in real time; a third RSU repeats itself
    ``flood_hz`` times a second."""
    devices = [Device.draw(f"vue_{i + 1}", i) for i in range(count)]
    epochs = round(seconds / PERIOD_S)
    probe = Probe()
    answers = [probe.listen(Odometry, topics.of_vue(d.vue_id, topics.ODOMETRY)) for d in devices]
    diagnostics = probe.node.create_subscription(
        DiagnosticArray, topics.DIAGNOSTICS, lambda _: None, 10, raw=True
    )
    poses = [probe.pose_publisher(d.vue_id) for d in devices]
    script = [
        (epoch * PERIOD_S + i * PERIOD_S / count, i, device.measurements(epoch))
        for epoch in range(epochs)
        for i, device in enumerate(devices)
    ]
    names = ",".join(f"'{d.vue_id}'" for d in devices)
    with started([tracker, "--ros-args", "-p", f"vues:=[{names}]"]) as (process,):
        wait_for(
            lambda: (
                probe.tracker.get_subscription_count()
                and all(pub.get_subscription_count() for pub in poses)
                and all(probe.node.count_publishers(a.topic_name) for a in answers)
            ),
            "the tracker",
            [process],
        )
        for pub, device in zip(poses, devices, strict=True):
            pub.publish(device.pose(0))
        time.sleep(_SETTLE_S)
        traffic = Traffic(probe, script, answers)
        with flooded(probe, flood_hz):
            cost = _cost(process, traffic, seconds, idle_s)
        handled = handled_messages(diagnostics, 2 * len(script))
        refused = refused_of(diagnostics, FLOODER) if flood_hz else 0
        memory = process.memory_mb()
    return {
        "devices": count,
        "seconds": seconds,
        "sent": 2 * len(script),
        "handled": handled,
        "epochs": len(script),
        "odometry": sum(traffic.received),
        "fewest_odometry": min(traffic.received),
        **cost,
        **traffic.lags(),
        "flood_hz": flood_hz,
        "refused_of_flood": refused,
        "memory_mb": memory,
    }


@contextmanager
def flooded(probe: Probe, rate_hz: float) -> Iterator[None]:
    """While the block runs another process sends ``rate_hz`` messages a second; 0: nobody does."""
    if not rate_hz:
        yield
        return
    topic = probe.tracker.topic_name
    publishers = probe.node.count_publishers(topic)
    code = "from netpos_bringup.bench_flood import main; main()"
    with started([sys.executable, "-c", code, f"{rate_hz:g}"]) as processes:
        wait_for(lambda: probe.node.count_publishers(topic) > publishers, "the flooder", processes)
        yield


def refused_of(diagnostics: Subscription, rsu_id: str) -> int:
    """How many measurements of an RSU the newest diagnostics say were refused; 0 where it is not
    named."""
    refused, end = 0, time.monotonic() + 1.5
    while time.monotonic() < end:
        for message in taken(diagnostics):
            refused = sum(
                int(value.value)
                for status in deserialize_message(message, DiagnosticArray).status
                if status.hardware_id == rsu_id
                for value in status.values
                if value.key.startswith("refused")
            )
        time.sleep(0.05)
    return refused


def _cost(process: Measured, traffic: Traffic, seconds: float, idle_s: float) -> dict[str, float]:
    """Processor time per second of the tracker, idle and beside that in ``traffic``, until it has
    answered all; and of the probe."""
    idle = cpu_of(process, lambda: time.sleep(idle_s)) / idle_s
    begin, own = time.perf_counter(), time.process_time()
    spent = cpu_of(process, traffic.run)
    elapsed = time.perf_counter() - begin
    return {
        "cpu_idle": idle,
        "cpu_traffic": (spent - idle * elapsed) / seconds,
        "cpu_probe": (time.process_time() - own) / elapsed,
    }


def cpu_of(process: Measured, work: Callable[[], None]) -> float:
    """Processor seconds the process uses while ``work`` runs."""
    before = process.cpu_s()
    work()
    return process.cpu_s() - before


class Traffic:
    """Publishes a script of (time [s], device, two messages) and hears the answers."""

    def __init__(
        self,
        probe: Probe,
        script: list[tuple[float, int, tuple[bytes, bytes]]],
        answers: list[Subscription],
    ) -> None:
        self._probe, self._script, self._answers = probe, script, answers
        self._sent_at: dict[tuple[int, int], float] = {}
        self._lags: list[float] = []
        self.received = [0] * len(answers)
        self._late_s = 0.0

    def run(self) -> None:
        """Publish in real time, then hear what is still under way."""
        publish = self._probe.tracker.publish
        start, next_poll = time.perf_counter(), 0.0
        for due, device, messages in self._script:
            while (wait := start + due - time.perf_counter()) > 0.0:
                if start + next_poll <= time.perf_counter():
                    self._hear()
                    next_poll = time.perf_counter() - start + _POLL_S
                else:
                    time.sleep(min(wait, 0.0005))
            if start + next_poll <= time.perf_counter():  # also when it is late
                self._hear()
                next_poll = time.perf_counter() - start + _POLL_S
            self._late_s = max(self._late_s, -wait)
            publish(messages[0])
            self._sent_at[device, stamp_of(messages[1])] = time.perf_counter()
            publish(messages[1])
        self._drain()

    def _drain(self) -> None:
        """Hear until all is there, or nothing has come for a while."""
        quiet_since = time.perf_counter()
        while self._sent_at and time.perf_counter() - quiet_since < _SETTLE_S:
            before = len(self._sent_at)
            self._hear()
            if len(self._sent_at) < before:
                quiet_since = time.perf_counter()
            time.sleep(_POLL_S)

    def _hear(self) -> None:
        for device, subscription in enumerate(self._answers):
            for message in taken(subscription):
                sent_at = self._sent_at.pop((device, stamp_of(message)), None)
                if sent_at is not None:
                    self._lags.append(time.perf_counter() - sent_at)
                    self.received[device] += 1

    def lags(self) -> dict[str, float]:
        """Lag of the odometry behind its measurement, and of the probe behind its script [s]."""
        if not self._lags:
            raise RuntimeError("the tracker published no odometry")
        median, p99 = np.percentile(self._lags, [50, 99])
        return {
            "lag_median_s": float(median),
            "lag_p99_s": float(p99),
            "lag_max_s": max(self._lags),
            "probe_late_s": self._late_s,
        }


def handled_messages(diagnostics: Subscription, sent: int) -> int:
    """Measurements the tracker says it has accepted or rejected, once these are all or no more
    come."""
    handled, end = 0, time.monotonic() + 2.0 * _SETTLE_S
    while handled < sent and time.monotonic() < end:
        for message in taken(diagnostics):
            handled = sum(
                int(value.value)
                for status in deserialize_message(message, DiagnosticArray).status
                for value in status.values
                if value.key == "accepted" or value.key.startswith("rejected")
            )
        time.sleep(0.05)
    return handled


# ready


def ready(tracker: str, starts: int) -> dict[str, Any]:
    """Start the tracker and send measurements until it answers with an odometry; ``ready_s``: when
    it says that it tracks."""
    probe, device = Probe(), Device.draw("vue_1", 1)
    answer = probe.listen(Odometry, topics.of_vue("vue_1", topics.ODOMETRY))
    poses = probe.pose_publisher("vue_1")
    attempts = range(round(_START_S / _ATTEMPT_S))
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
                raise TimeoutError(f"no odometry within {_START_S:g} s")
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
