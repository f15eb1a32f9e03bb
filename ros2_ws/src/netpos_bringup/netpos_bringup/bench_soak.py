"""Hours of devices in real time: a tracker and a recorder, looked at every minute."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from typing import Any

from nav_msgs.msg import Odometry
from netpos.bags import BagReader
from netpos.messages import topics
from rclpy.serialization import deserialize_message

from netpos_bringup.bench_common import stamp_of, started
from netpos_bringup.bench_load import Fleet, Traffic, cpu_of, handled_messages
from netpos_bringup.bench_process import Measured
from netpos_bringup.bench_traffic import PERIOD_S, START_NS, Device


class Check:
    """Compares odometry with the truth."""

    def __init__(self, devices: list[Device]) -> None:
        self._devices = devices
        self.not_finite, self.largest_m = 0, 0.0

    def __call__(self, device: int, message: bytes) -> None:
        """One serialised odometry of a device."""
        odometry = deserialize_message(message, Odometry)
        at = odometry.pose.pose.position
        x, y = self._devices[device].position((stamp_of(message) - START_NS) * 1e-9)
        error = math.hypot(at.x - x, at.y - y)
        if not math.isfinite(error + float(odometry.pose.covariance.sum())):
            self.not_finite += 1
        else:
            self.largest_m = max(self.largest_m, error)


def soak(
    tracker: str, recorder: str, count: int, seconds: float, every_s: float
) -> dict[str, Any]:
    """Feed ``count`` devices at 10 Hz with two RSUs each and record all; one sample each
    ``every_s``.

    Samples: memory of both processes [MB], lag of odometry [s], processor time of the tracker
    [s/s], epochs without odometry, odometry that is not finite, largest error [m].
    """
    fleet = Fleet(count)
    per_stretch = round(every_s / PERIOD_S)
    stretches = max(round(seconds / every_s), 1)
    sent = 2 * count * per_stretch * stretches
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "soak"
        command = [tracker, *fleet.arguments]
        with started(command, [recorder, "--output", str(bag)]) as processes:
            fleet.begin(processes)
            samples = [
                _stretch(fleet, processes, i * per_stretch, (i + 1) * per_stretch)
                for i in range(stretches)
            ]
            handled = handled_messages(fleet.diagnostics, sent)
        with BagReader(bag) as reader:
            kept = {name: info.count for name, info in reader.topics.items()}
            lost = reader.metadata["lost"]
    missing = sum(sample["missing"] for sample in samples)
    odometry = [topics.of_vue(d.vue_id, topics.ODOMETRY) for d in fleet.devices]
    return {
        "devices": count,
        "seconds": stretches * every_s,
        "sent": sent,
        "handled": handled,
        "odometry": sent // 2 - missing,
        "recorded_measurements": kept.get(topics.RSU_MEASUREMENTS, 0),
        "recorded_odometry": sum(kept.get(topic, 0) for topic in odometry),
        "recorder_lost": lost,
        "samples": samples,
    }


def _stretch(fleet: Fleet, processes: list[Measured], first: int, last: int) -> dict[str, float]:
    check = Check(fleet.devices)
    traffic = Traffic(fleet.probe, fleet.script(first, last), fleet.answers, check)
    spent = cpu_of(processes[0], traffic.run)
    for process in processes:
        process.check()
    return {
        "hours": last * PERIOD_S / 3600.0,
        "memory_mb": processes[0].memory_mb(),
        "recorder_memory_mb": processes[1].memory_mb(),
        "cpu": spent / ((last - first) * PERIOD_S),
        **traffic.lags(),
        "missing": (last - first) * len(fleet.devices) - sum(traffic.received),
        "not_finite": check.not_finite,
        "largest_error_m": check.largest_m,
    }
