"""Many devices in real time: what the tracker handles, how late it answers, what it needs."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from netpos.messages import topics
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription

from netpos_bringup.bench_common import Probe, stamp_of, started, taken, wait_for
from netpos_bringup.bench_process import Measured
from netpos_bringup.bench_traffic import FLOODER, PERIOD_S, Device

_POLL_S = 0.002
_SETTLE_S = 2.0

Turn = tuple[float, int, tuple[bytes, bytes]]
"""When [s], of which device, the messages of both RSUs."""


class Fleet:
    """Many devices: who publishes for them and who hears the answers."""

    def __init__(self, count: int) -> None:
        self.devices = [Device.draw(f"vue_{i + 1}", i) for i in range(count)]
        self.probe = Probe()
        self.answers = [
            self.probe.listen(Odometry, topics.of_vue(d.vue_id, topics.ODOMETRY))
            for d in self.devices
        ]
        self.diagnostics = self.probe.node.create_subscription(
            DiagnosticArray, topics.DIAGNOSTICS, lambda _: None, 10, raw=True
        )
        self._poses = [self.probe.pose_publisher(d.vue_id) for d in self.devices]

    @property
    def arguments(self) -> list[str]:
        """What tells a tracker to expect them."""
        names = ",".join(f"'{d.vue_id}'" for d in self.devices)
        return ["--ros-args", "-p", f"vues:=[{names}]"]

    def begin(self, processes: list[Measured]) -> None:
        """Wait for the tracker, and give it the first positions."""
        wait_for(
            lambda: (
                self.probe.tracker.get_subscription_count()
                and all(pub.get_subscription_count() for pub in self._poses)
                and all(self.probe.node.count_publishers(a.topic_name) for a in self.answers)
            ),
            "the tracker",
            processes,
        )
        for pub, device in zip(self._poses, self.devices, strict=True):
            pub.publish(device.pose(0))
        time.sleep(_SETTLE_S)

    def script(self, first: int, last: int) -> Iterator[Turn]:
        """Epochs ``first`` to ``last``, the devices one after the other within each."""
        count = len(self.devices)
        for epoch in range(first, last):
            for i, device in enumerate(self.devices):
                due_s = (epoch - first + i / count) * PERIOD_S
                yield due_s, i, device.measurements(epoch)


def load(
    tracker: str, count: int, seconds: float, idle_s: float, flood_hz: float = 0.0
) -> dict[str, Any]:
    """Feed ``count`` devices at 10 Hz with two RSUs each in real time; a third RSU repeats itself
    ``flood_hz`` times a second."""
    fleet = Fleet(count)
    script = list(fleet.script(0, round(seconds / PERIOD_S)))
    with started([tracker, *fleet.arguments]) as (process,):
        fleet.begin([process])
        traffic = Traffic(fleet.probe, script, fleet.answers)
        with flooded(fleet.probe, flood_hz):
            cost = _cost(process, traffic, seconds, idle_s)
        handled = handled_messages(fleet.diagnostics, 2 * len(script))
        refused = refused_of(fleet.diagnostics, FLOODER) if flood_hz else 0
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
    """Publishes a script and hears the answers; ``seen`` gets each with its device."""

    def __init__(
        self,
        probe: Probe,
        script: Iterable[Turn],
        answers: list[Subscription],
        seen: Callable[[int, bytes], None] = lambda _device, _message: None,
    ) -> None:
        self._probe, self._script, self._answers = probe, script, answers
        self._seen = seen
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
                    self._seen(device, message)
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
