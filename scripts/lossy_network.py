#!/usr/bin/env python3
"""What a bad network does to what the RSUs send: two hosts on this machine, a relay between them.

The hosts are network namespaces with one interface each (TUN). The relay carries their packets,
with a delay, drops a share of them, and may carry none for a while. One host sends RsuMeasurements
as an RSU does, the other notes when they arrive. Needs root and Linux. Prints a row of a table.
"""

from __future__ import annotations

import argparse
import ctypes
import fcntl
import heapq
import json
import os
import random
import select
import struct
import subprocess
import sys
import time
from pathlib import Path

PREFIX = f"netpos{os.getpid()}"
RATE_HZ = 20.0
NS = 1_000_000_000
_TUN, _TUNSETIFF, _NEWNET = 0x1001, 0x400454CA, 0x40000000


def interface(namespace: str, address: str) -> int:
    """The packets of a new host: its one interface, which multicast goes through as well."""
    subprocess.run(["ip", "netns", "add", namespace], check=True)
    libc = ctypes.CDLL(None, use_errno=True)
    with open("/proc/self/ns/net", "rb") as own, open(f"/run/netns/{namespace}", "rb") as other:
        if libc.setns(other.fileno(), _NEWNET):
            raise OSError(ctypes.get_errno(), "setns")
        try:
            tun = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
            fcntl.ioctl(tun, _TUNSETIFF, struct.pack("16sH14x", b"tun0", _TUN))
        finally:
            libc.setns(own.fileno(), _NEWNET)
    for command in (
        "link set lo up",
        f"addr add {address}/24 dev tun0",
        "link set tun0 up multicast on",
        "route add 224.0.0.0/4 dev tun0",
    ):
        subprocess.run(["ip", "-n", namespace, *command.split()], check=True)
    return tun


class Relay:
    """Carries packets between two interfaces."""

    def __init__(self, ends: tuple[int, int], loss: float, delay_s: float, seed: int) -> None:
        self._ends, self._loss, self._delay_s = ends, loss, delay_s
        self._draw = random.Random(seed)
        self._under_way: list[tuple[float, int, int, bytes]] = []
        self._count = 0
        self.cut = False

    def carry(self, until_s: float) -> None:
        """Until a time of the monotonic clock."""
        while (now_s := time.monotonic()) < until_s:
            due_s = self._under_way[0][0] if self._under_way else until_s
            ready, _, _ = select.select(self._ends, [], [], max(0.0, min(due_s - now_s, 0.02)))
            for end in ready:
                self._take(end)
            while self._under_way and self._under_way[0][0] <= time.monotonic():
                _, _, end, packet = heapq.heappop(self._under_way)
                os.write(end, packet)

    def _take(self, end: int) -> None:
        packet = os.read(end, 65536)
        if self.cut or self._draw.random() < self._loss:
            return
        self._count += 1
        to = self._ends[1 - self._ends.index(end)]
        heapq.heappush(
            self._under_way, (time.monotonic() + self._delay_s, self._count, to, packet)
        )


def send(seconds: float) -> None:
    """As an RSU does; the stamp is the time of sending, the sequence counts."""
    from netpos_msgs.msg import RsuMeasurement  # noqa: PLC0415
    from netpos_node import STREAM, init  # noqa: PLC0415
    from rclpy.node import Node  # noqa: PLC0415

    init()
    node = Node("sender", start_parameter_services=False)
    publisher = node.create_publisher(RsuMeasurement, "/rsu/measurements", STREAM)
    while not publisher.get_subscription_count():
        time.sleep(0.02)
    print("heard", flush=True)
    time.sleep(1.0)
    message = RsuMeasurement(rsu_id="rsu_1", vue_id="vue_1")
    begin_s, cpu_s = time.monotonic(), time.process_time()
    for sequence in range(round(seconds * RATE_HZ)):
        time.sleep(max(0.0, begin_s + sequence / RATE_HZ - time.monotonic()))
        stamp = time.monotonic_ns()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, NS)
        message.sequence = sequence
        publisher.publish(message)
    spent = (time.process_time() - cpu_s) / seconds
    print(json.dumps({"cpu": spent}), flush=True)
    time.sleep(15.0)  # what was lost is asked for again


def hear() -> None:
    """Print the delay [s] of what arrives."""
    from netpos_msgs.msg import RsuMeasurement  # noqa: PLC0415
    from netpos_node import BACKLOG, run  # noqa: PLC0415
    from rclpy.node import Node  # noqa: PLC0415

    class Ear(Node):
        def __init__(self) -> None:
            super().__init__("ear", start_parameter_services=False)
            self.create_subscription(RsuMeasurement, "/rsu/measurements", self._note, BACKLOG)

        def _note(self, message: RsuMeasurement) -> None:
            sent = message.header.stamp.sec * NS + message.header.stamp.nanosec
            print((time.monotonic_ns() - sent) / NS, flush=True)

        def finish(self) -> None:
            pass

    run(Ear)


def measure(options: argparse.Namespace) -> str:
    """Start both hosts and the relay; a row of the table."""
    names = (f"{PREFIX}a", f"{PREFIX}b")
    ends: list[int] = []
    processes: list[subprocess.Popen[str]] = []
    environment = {**os.environ, "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4", "ROS_DOMAIN_ID": "1"}
    environment["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "SUBNET"
    if options.profile is not None:
        environment["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(options.profile.resolve())
        environment["RMW_FASTRTPS_USE_QOS_FROM_XML"] = "1"

    def start(namespace: str, *arguments: str) -> subprocess.Popen[str]:
        command = ["ip", "netns", "exec", namespace, sys.executable, __file__, *arguments]
        process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
        processes.append(process)
        return process

    try:
        for name, address in zip(names, ("10.77.0.1", "10.77.0.2"), strict=True):
            ends.append(interface(name, address))
        relay = Relay((ends[0], ends[1]), options.loss, options.delay, options.seed)
        ear, sender = start(names[1], "hear"), start(names[0], "send", str(options.seconds))
        assert ear.stdout is not None
        assert sender.stdout is not None
        os.set_blocking(sender.stdout.fileno(), False)
        end_s = time.monotonic() + 60.0
        while not (sender.stdout.readline() or "").startswith("heard"):
            if time.monotonic() > end_s:
                raise TimeoutError("the two hosts did not find each other within 60 s")
            relay.carry(time.monotonic() + 0.05)
        begin_s = time.monotonic()
        if options.cut:
            relay.carry(begin_s + 5.0)
            relay.cut = True
            relay.carry(begin_s + 5.0 + options.cut)
            relay.cut = False
        relay.carry(begin_s + 1.0 + options.seconds + 12.0)
        said = sender.stdout.readline()
        ear.send_signal(2)
        delays = sorted(map(float, ear.communicate(timeout=20.0)[0].split()))
        return row(options, delays, json.loads(said)["cpu"])
    finally:
        for process in processes:
            process.kill()
            process.wait()
        for end in ends:
            os.close(end)
        for name in names:
            subprocess.run(["ip", "netns", "del", name], check=False, stderr=subprocess.DEVNULL)


def row(options: argparse.Namespace, delays: list[float], cpu: float) -> str:
    """Median, 95 % and largest delay, what never came, and the sender's processor time."""
    sent = round(options.seconds * RATE_HZ)
    profile = "ours" if options.profile is None else options.profile.name
    cut = f", cut for {options.cut:g} s" if options.cut else ""
    figures = (
        [
            f"{1e3 * delays[min(int(share * len(delays)), len(delays) - 1)]:.0f}"
            for share in (0.5, 0.95, 1.0)
        ]
        if delays
        else ["–"] * 3
    )
    return (
        f"| {profile} | {100 * options.loss:g} %{cut} | {' | '.join(figures)} | "
        f"{sent - len(delays)} of {sent} | {100 * cpu:.2f} % |"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    measuring = commands.add_parser("measure", help="measure one setting")
    measuring.add_argument("--loss", type=float, default=0.0, help="share of the packets")
    measuring.add_argument("--delay", type=float, default=0.05, help="one way [s]")
    measuring.add_argument("--cut", type=float, default=0.0, help="no packet for so long [s]")
    measuring.add_argument("--seconds", type=float, default=30.0)
    measuring.add_argument("--seed", type=int, default=1)
    measuring.add_argument("--profile", type=Path, help="of Fast DDS; default: that of netpos")
    commands.add_parser("hear")
    commands.add_parser("send").add_argument("seconds", type=float)
    options = parser.parse_args()
    match options.command:
        case "send":
            send(options.seconds)
        case "hear":
            hear()
        case _:
            if os.geteuid():
                parser.error("network namespaces need root")
            print(measure(options))
    return 0


if __name__ == "__main__":
    sys.exit(main())
