"""What viz and live need beside many devices, with a subscriber of the markers and a WebSocket
client that takes all: processor time as a share of one core, and memory.

    python scripts/live_load.py --devices 20 --rate 10 --seconds 20
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from nav_msgs.msg import Odometry as OdometryMsg
from netpos.live.client import Viewer
from netpos.messages import topics
from netpos.messages.values import (
    Field,
    Odometry,
    RsuInfo,
    RsuMeasurement,
    TrackState,
    TrackStatus,
)
from netpos_msgs.msg import RsuInfo as RsuInfoMsg
from netpos_msgs.msg import RsuMeasurement as RsuMeasurementMsg
from netpos_msgs.msg import TrackStatus as TrackStatusMsg
from netpos_node import CODEC, LATCHED, STREAM, init
from rclpy.serialization import serialize_message
from visualization_msgs.msg import MarkerArray

RSUS = ("rsu_1", "rsu_2", "rsu_3", "rsu_4")
DOMAIN = "94"
READY_S = 5.0


def of_device(vue: str, x_m: float) -> dict[str, tuple[Any, bytes]]:
    """Type and bytes of the messages about one device, by topic."""
    stamp_ns = 1_000_000_000
    odometry = Odometry(
        stamp_ns=stamp_ns,
        vue_id=vue,
        position=np.array([x_m, 0.0, 0.0]),
        quaternion=np.array([0.0, 0.0, 0.0, 1.0]),
        linear_velocity=np.zeros(3),
        pose_cov=np.eye(6),
    )
    status = TrackStatus(
        stamp_ns=stamp_ns,
        vue_id=vue,
        state=TrackState.TRACKING,
        sources=RSUS,
        protection_level_m=5.0,
    )
    messages = {
        topics.ODOMETRY: (OdometryMsg, CODEC.odometry_to_msg(odometry)),
        topics.TRACK_STATUS: (TrackStatusMsg, CODEC.track_status_to_msg(status)),
    }
    return {
        topics.of_vue(vue, name): (kind, serialize_message(message))
        for name, (kind, message) in messages.items()
    }


def measurements(vue: str) -> list[bytes]:
    """One of each RSU."""
    return [
        serialize_message(
            CODEC.measurement_to_msg(
                RsuMeasurement(
                    stamp_ns=1_000_000_000,
                    rsu_id=rsu,
                    vue_id=vue,
                    fields=Field.RANGE,
                    range_m=9.0,
                    range_var=0.01,
                )
            )
        )
        for rsu in RSUS
    ]


def publish(node: Any, devices: int, rate_hz: float, stop: threading.Event) -> None:
    """Send at the rate until it is enough."""
    infos = node.create_publisher(RsuInfoMsg, topics.RSU_INFO, LATCHED)
    for k, name in enumerate(RSUS):
        position = np.array([30.0 * k, 20.0, 5.0])
        infos.publish(CODEC.rsu_info_to_msg(RsuInfo(rsu_id=name, position=position)))
    measured = node.create_publisher(RsuMeasurementMsg, topics.RSU_MEASUREMENTS, STREAM)
    names = [f"vue_{k}" for k in range(devices)]
    ranges = [cdr for vue in names for cdr in measurements(vue)]
    estimates = [
        (node.create_publisher(kind, topic, STREAM), cdr)
        for k, vue in enumerate(names)
        for topic, (kind, cdr) in of_device(vue, 10.0 * k).items()
    ]
    begun_s, epoch = time.monotonic(), 0
    while not stop.is_set():
        epoch += 1
        for cdr in ranges:
            measured.publish(cdr)
        for publisher, cdr in estimates:
            publisher.publish(cdr)
        time.sleep(max(begun_s + epoch / rate_hz - time.monotonic(), 0.0))


def processor_s(pid: int) -> float:
    """Processor time of a process until now."""
    spent = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").split()[13:15]
    return sum(map(int, spent)) / os.sysconf("SC_CLK_TCK")


def memory_mb(pid: int) -> float:
    """Memory of a process."""
    status = Path(f"/proc/{pid}/status").read_text(encoding="utf-8")
    (line,) = [line for line in status.splitlines() if line.startswith("VmRSS")]
    return int(line.split()[1]) / 1000


def start(*command: str) -> subprocess.Popen[str]:
    """A node of netpos_bringup."""
    return subprocess.Popen(
        ["ros2", "run", "netpos_bringup", *command], stdout=subprocess.PIPE, text=True
    )


def main() -> None:
    """Load, look, measure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--devices", type=int, default=20)
    parser.add_argument("--rate", type=float, default=10.0)
    parser.add_argument("--seconds", type=float, default=20.0)
    asked = parser.parse_args()
    os.environ |= {"ROS_DOMAIN_ID": DOMAIN, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    init()
    node = rclpy.create_node("live_load", start_parameter_services=False)
    node.create_subscription(MarkerArray, topics.VIZ_MARKERS, lambda _: None, 10, raw=True)
    stop = threading.Event()
    sender = threading.Thread(
        target=publish, args=(node, asked.devices, asked.rate, stop), daemon=True
    )
    viz, live = start("viz"), start("live", "--port", "0")
    try:
        assert live.stdout is not None
        url = live.stdout.readline().split()[-1]
        sender.start()
        count = 0
        with Viewer(url, lambda *_: True) as viewer:
            ready_s = time.monotonic() + READY_S
            while time.monotonic() < ready_s:
                viewer.receive(0.1)
            before = {"viz": processor_s(viz.pid), "live": processor_s(live.pid)}
            begun_s = time.monotonic()
            while (passed_s := time.monotonic() - begun_s) < asked.seconds:
                count += viewer.receive(0.1) is not None
        print(f"{asked.devices} devices at {asked.rate:g} Hz, {count / passed_s:.0f} messages/s")
        for name, process in (("viz", viz), ("live", live)):
            share = (processor_s(process.pid) - before[name]) / passed_s
            print(f"{name}: {100 * share:.0f} % of a core, {memory_mb(process.pid):.0f} MB")
    finally:
        stop.set()
        sender.join()
        for process in (viz, live):
            process.send_signal(signal.SIGINT)
            process.wait()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
