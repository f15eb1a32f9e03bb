"""The running record and play processes: nothing lost, nothing changed, killed and recovered."""

from __future__ import annotations

import signal
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from builtin_interfaces.msg import Time
from graph import LATCHED, Graph, Process
from nav_msgs.msg import Odometry
from netpos.bags import BagReader, BagWriter, codec
from netpos.bags.qos import is_latched, is_reliable
from netpos.bags.recover import recover
from netpos.messages.values import ClockState, RsuInfo
from netpos.messages.values import RsuMeasurement as Measured
from netpos_msgs.msg import RsuInfo as RsuInfoMessage
from netpos_msgs.msg import RsuMeasurement
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock

NS = 1_000_000_000
BEST_EFFORT = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)


def payloads(path: Path) -> dict[str, list[bytes]]:
    """Serialised messages per topic, in order."""
    found: dict[str, list[bytes]] = defaultdict(list)
    with BagReader(path) as bag:
        for entry in bag.messages():
            found[entry.topic].append(entry.cdr)
    return dict(found)


def stamp(ns: int) -> Time:
    return Time(sec=ns // NS, nanosec=ns % NS)


def record(graph: Graph, output: Path, *flags: str) -> Process:
    process = graph.run("netpos_bag", "record", "--output", str(output), *flags)
    process.wait_for_output("recording to")
    return process


def paced(seconds: float, hz: float) -> Iterator[int]:
    """Counts at ``hz`` for ``seconds``."""
    begin = time.monotonic()
    for index in range(round(seconds * hz)):
        time.sleep(max(0.0, begin + index / hz - time.monotonic()))
        yield index


def test_record_catches_latched_qos_and_simulated_time(graph: Graph, tmp_path: Path) -> None:
    """Latched messages from before the start; none stamped 0 before the first /clock."""
    info = graph.publisher("/rsu/info", RsuInfoMessage, LATCHED)
    for name in ("a", "b"):
        info.publish(RsuInfoMessage(rsu_id=name))
    measurements = graph.publisher("/rsu/measurements", RsuMeasurement)
    lossy = graph.publisher("/vue_1/ground_truth", Odometry, BEST_EFFORT)
    clock = graph.publisher("/clock", Clock)
    recorder = record(graph, tmp_path / "run")
    for topic in ("/rsu/measurements", "/vue_1/ground_truth", "/clock"):
        graph.wait_for_subscribers(topic)
    time.sleep(0.5)
    measurements.publish(RsuMeasurement(sequence=0))
    for index in paced(1.0, 100.0):
        clock.publish(Clock(clock=stamp(1000 * NS + index * NS // 10)))  # ten times real time
        measurements.publish(RsuMeasurement(sequence=index + 1))
        lossy.publish(Odometry())
    time.sleep(0.3)
    assert recorder.interrupt() == 0
    assert "/rsu/measurements: 101" in recorder.output
    with BagReader(tmp_path / "run") as bag:
        assert is_latched(bag.topics["/rsu/info"].qos)
        assert is_reliable(bag.topics["/rsu/measurements"].qos)
        assert not is_reliable(bag.topics["/vue_1/ground_truth"].qos)
        assert [e.message.rsu_id for e in bag.messages(["/rsu/info"])] == ["a", "b"]
        entries = list(bag.messages(["/rsu/measurements"]))
        assert [e.message.sequence for e in entries] == list(range(101))
        assert bag.start_ns >= 1000 * NS
        assert 1009 * NS < bag.end_ns <= 1009_900_000_000


def test_record_refuses_an_existing_output(graph: Graph, tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    process = graph.run("netpos_bag", "record", parameters={"output": str(tmp_path / "run")})
    assert process.wait() == 2
    assert "exists and is never overwritten" in process.output
    assert not list((tmp_path / "run").iterdir())


def test_play_refuses_a_damaged_bag(graph: Graph, tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run_0.mcap").write_bytes(b"x")
    process = graph.run("netpos_bag", "play", str(tmp_path / "run"))
    assert process.wait() == 2
    assert "netpos recover" in process.output


def source_bag(path: Path) -> Path:
    """20 s at 200 messages per second, two latched messages, estimates in between."""
    make = codec()
    with BagWriter(path) as bag:
        for name in ("a", "b"):
            info = RsuInfo(rsu_id=name, position=[1.0, 2.0, 3.0])
            bag.write("/rsu/info", make.rsu_info_to_msg(info), 1000 * NS)
        for index in range(4000):
            ns = 1000 * NS + index * NS // 200
            measured = Measured(stamp_ns=ns, rsu_id="a", vue_id="vue_1", sequence=index)
            topic = f"/{('rsu', 'x', 'y')[index % 3]}/measurements"
            bag.write(topic, make.measurement_to_msg(measured), ns)
            if index % 100 == 0:
                bag.write("/vue_1/clock_state", clock_state(make, ns), ns)
    return path


def clock_state(make: Any, ns: int) -> Any:
    return make.clock_state_to_msg(
        ClockState(stamp_ns=ns, vue_id="vue_1", offset_s=1e-6, drift=1e-9)
    )


def test_play_and_record_keep_every_byte_at_ten_times_real_time(
    graph: Graph, tmp_path: Path
) -> None:
    """2000 messages per second through both processes, twice; then without the estimates."""
    bags = [source_bag(tmp_path / "run0")]
    for number in (1, 2):
        bags.append(tmp_path / f"run{number}")
        recorder = record(graph, bags[-1])
        player = graph.run("netpos_bag", "play", str(bags[-2]), "--rate", "10")
        assert player.wait() == 0, player.describe()
        assert recorder.interrupt() == 0
        assert "LOST" not in recorder.output
    wanted = payloads(bags[0])
    for bag in bags[1:]:
        found = payloads(bag)
        for topic, messages in wanted.items():
            assert found[topic] == messages, topic
        with BagReader(bag) as reader:
            assert is_latched(reader.topics["/rsu/info"].qos)
            assert reader.start_ns >= 1000 * NS
            assert 1019 * NS < reader.end_ns < 1021 * NS
    recorder = record(graph, tmp_path / "inputs")
    assert (
        graph.run("netpos_bag", "play", str(bags[0]), "--rate", "20", "--input-only").wait() == 0
    )
    recorder.interrupt()
    inputs = payloads(tmp_path / "inputs")
    assert "/vue_1/clock_state" not in inputs
    assert inputs["/rsu/measurements"] == wanted["/rsu/measurements"]


def test_play_waits_for_a_subscriber_that_is_behind(graph: Graph, tmp_path: Path) -> None:
    source, copy = source_bag(tmp_path / "run"), tmp_path / "copy"
    recorder = record(graph, copy)
    player = graph.run("netpos_bag", "play", str(source), "--rate", "10")
    heard = graph.collect("/rsu/measurements", RsuMeasurement)
    heard.wait_for(100)
    recorder.signal(signal.SIGSTOP)
    heard.wait_for(1300)  # of 1334
    time.sleep(8.0)
    recorder.signal(signal.SIGCONT)
    assert player.wait() == 0, player.describe()
    assert recorder.interrupt() == 0
    found = payloads(copy)
    for topic, messages in payloads(source).items():
        assert found[topic] == messages, topic


@pytest.mark.parametrize("seconds", [1.3, 2.1])
def test_killed_recorder_loses_at_most_a_second(
    graph: Graph, tmp_path: Path, seconds: float
) -> None:
    measurements = graph.publisher("/rsu/measurements", RsuMeasurement)
    clock = graph.publisher("/clock", Clock)
    recorder = record(graph, tmp_path / "run")
    graph.wait_for_subscribers("/rsu/measurements")
    graph.wait_for_subscribers("/clock")
    time.sleep(0.5)
    sent = 0
    for index in paced(seconds, 500.0):
        now = time.time_ns()
        clock.publish(Clock(clock=stamp(now)))
        message = RsuMeasurement(sequence=index)
        message.header.stamp = stamp(now)
        measurements.publish(message)
        sent += 1
    killed_ns = time.time_ns()
    assert recorder.kill() != 0
    report = recover(tmp_path / "run")
    assert report.output == tmp_path / "run_recovered"
    with BagReader(report.output) as bag:
        saved = [e.message for e in bag.messages(["/rsu/measurements"])]
    assert [m.sequence for m in saved] == list(range(len(saved)))
    last = saved[-1].header.stamp
    assert killed_ns - (last.sec * NS + last.nanosec) < NS
    assert len(saved) > sent / 4
