"""What the recorder keeps, and needs, beside many devices: four measurements and three estimates
of each device, so many times a second. Prints what was sent and kept, memory and processor time.

    python scripts/recorder_load.py --devices 100 --rate 10 --seconds 240
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import rclpy
from nav_msgs.msg import Odometry
from netpos.bags import BagReader
from netpos_msgs.msg import ClockState, RsuMeasurement, TrackStatus
from netpos_node import STREAM
from rclpy.serialization import serialize_message

MEASUREMENTS, KINDS = (
    4,
    {"odometry": Odometry, "clock_state": ClockState, "track_status": TrackStatus},
)
READY_S, SAMPLE_S = 5.0, 30.0


def publish(node: Any, devices: int, rate_hz: float, seconds: float, recorder: int) -> int:
    """Send at the rate; returns the number of messages."""
    measured = node.create_publisher(RsuMeasurement, "/rsu/measurements", STREAM)
    estimates = [
        (node.create_publisher(kind, f"/vue_{d}/{name}", STREAM), serialize_message(kind()))
        for d in range(devices)
        for name, kind in KINDS.items()
    ]
    measurement = serialize_message(RsuMeasurement(rsu_id="rsu_1", vue_id="vue_1"))
    time.sleep(READY_S)
    start_s, reported_s, epochs = time.monotonic(), 0.0, round(seconds * rate_hz)
    for epoch in range(1, epochs + 1):
        for _ in range(MEASUREMENTS * devices):
            measured.publish(measurement)
        for publisher, message in estimates:
            publisher.publish(message)
        passed_s = time.monotonic() - start_s
        if passed_s - reported_s >= SAMPLE_S:
            reported_s = passed_s
            tell(recorder, passed_s)
        time.sleep(max(epoch / rate_hz - passed_s, 0.0))
    return epochs * devices * (MEASUREMENTS + len(KINDS))


def tell(recorder: int, passed_s: float) -> None:
    """Memory and processor time of the recorder."""
    status = Path(f"/proc/{recorder}/status").read_text(encoding="utf-8")
    (memory,) = [line for line in status.splitlines() if line.startswith("VmRSS")]
    spent = Path(f"/proc/{recorder}/stat").read_text(encoding="utf-8").split()[13:15]
    cpu_s = sum(map(int, spent)) / os.sysconf("SC_CLK_TCK")
    print(
        f"{passed_s:5.0f} s: {int(memory.split()[1]) / 1000:.1f} MB, {cpu_s:.1f} s of a processor"
    )


def main() -> None:
    """Record a load of its own."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--devices", type=int, default=100)
    parser.add_argument("--rate", type=float, default=10.0)
    parser.add_argument("--seconds", type=float, default=30.0)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "load"
        command = ["ros2", "run", "netpos_bag", "record", "--output", str(bag)]
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, start_new_session=True) as run:
            time.sleep(READY_S)
            rclpy.init()
            node = rclpy.create_node("recorder_load", start_parameter_services=False)
            of_it = subprocess.run(
                ["pgrep", "-f", f"record --output {bag}"],
                capture_output=True,
                text=True,
                check=True,
            )
            recorder = int(of_it.stdout.split()[-1])
            sent = publish(node, asked.devices, asked.rate, asked.seconds, recorder)
            time.sleep(READY_S)
            os.killpg(run.pid, signal.SIGINT)
        with BagReader(bag) as reader:
            mine = [
                i.count for name, i in reader.topics.items() if name.startswith(("/vue_", "/rsu"))
            ]
            print(
                f"sent {sent}, kept {sum(mine)}, lost as the bag says: {reader.metadata['lost']}"
            )
    rclpy.shutdown()


if __name__ == "__main__":
    main()
