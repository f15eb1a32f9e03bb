"""How a node starts, joins the graph and is stopped: real processes, real signals."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from types import SimpleNamespace
from typing import Any

import pytest
from netpos_node import patience, see_delivered

DOMAIN = 36

_STARTING = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job ignores it
import rclpy
from netpos_node import LATCHED, run, wait_until_heard
from std_msgs.msg import String

def factory():
    node = rclpy.create_node("starting")
    pub = node.create_publisher(String, "/nobody_listens", LATCHED)
    print("starts", flush=True)
    if sys.argv[1] == "computes":
        end = time.monotonic() + 30
        while time.monotonic() < end:
            time.sleep(0.05)
            node.count_publishers("/nobody_listens")
    wait_until_heard({"t": pub}, {"t": 1}, 30.0)
    return node

run(factory)
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("how", ["waits", "computes"])
def test_a_node_stopped_while_it_starts_ends_quietly(how: str, number: signal.Signals) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", _STARTING, how],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "starts\n"
        process.send_signal(number)
        _, error = process.communicate(timeout=20.0)
    assert process.returncode == 0, error
    assert "Traceback" not in error


def test_a_missing_parameter_file_is_one_sentence_and_code_2() -> None:
    program = "import netpos_node; netpos_node.run(lambda: None)"
    arguments = ["--ros-args", "--params-file", "/no/such/file.yaml"]
    result = subprocess.run(
        [sys.executable, "-c", program, *arguments], capture_output=True, text=True, check=False
    )
    assert result.returncode == 2
    last = result.stderr.splitlines()[-1]  # after what rcl says itself
    assert last.startswith("error: ")
    assert "/no/such/file.yaml" in last
    assert "Traceback" not in result.stderr


def test_a_long_start_is_explained(capsys: Any) -> None:
    with patience("compiling", after_s=0.05):
        until_s = time.process_time() + 0.5
        while time.process_time() < until_s:
            sum(range(1000))
    with patience("waiting for others", after_s=0.1):
        time.sleep(0.5)
    with patience("nothing", after_s=60.0):
        pass
    assert capsys.readouterr().err == "netpos: compiling\n"


class Deaf:
    """Publishes to who never acknowledges anything."""

    def __init__(self, waited_s: list[float]) -> None:
        self._waited_s = waited_s

    def wait_for_all_acked(self, at_most: Any) -> None:
        self._waited_s.append(at_most.nanoseconds * 1e-9)


def test_who_listens_no_more_is_not_waited_for_again_and_again(monkeypatch: Any) -> None:
    waited_s: list[float] = []
    monkeypatch.setattr("netpos_node.time.monotonic", lambda: 100.0 + sum(waited_s))
    see_delivered(SimpleNamespace(publishers=[Deaf(waited_s) for _ in range(20)]))
    assert len(waited_s) == 20
    assert waited_s[0] == 1.0
    assert sum(waited_s) == pytest.approx(4.0)


_LAST_PARTICIPANT = 7400 + 250 * DOMAIN + 10 + 2 * 31  # its port by the RTPS standard, section 9.6


def test_participants_keep_announcing_themselves() -> None:
    """What a newcomer misses it hears again soon. Within a host the announcement goes to the ports
    of 32 participants, whether they exist or not."""
    program = f"""
import time
import netpos_node, rclpy
netpos_node.init(domain_id={DOMAIN})
node = rclpy.create_node("announced")
time.sleep(60)
"""
    environment = {k: v for k, v in os.environ.items() if "FASTRTPS" not in k}
    environment |= {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    environment |= {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}  # else shared memory
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ears,
        subprocess.Popen([sys.executable, "-c", program], env=environment) as process,
    ):
        try:
            ears.bind(("127.0.0.1", _LAST_PARTICIPANT))
            ears.settimeout(30.0)
            heard_s: list[float] = []
            while not heard_s or heard_s[-1] < heard_s[0] + 4.0:
                assert ears.recv(65536).startswith(b"RTPS")
                heard_s.append(time.monotonic())
        finally:
            process.kill()
    later = [at_s for at_s in heard_s if heard_s[0] + 1.0 <= at_s < heard_s[0] + 4.0]
    assert len(later) >= 4, "expected six, one every half second; usual is one in three seconds"
