"""The disk of a recording, and of results, is full: one sentence, an exit code, nothing cut."""

from __future__ import annotations

import errno
import os
import subprocess
import time
from collections.abc import Iterator
from io import FileIO
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from graph import Graph
from netpos.bags import BagReader
from netpos.bags.recover import recover
from netpos_msgs.msg import RsuMeasurement

SIZE_MB = 6
BAGS = Path(__file__).parents[1] / "bags"


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of a few megabytes."""
    folder = tmp_path / "disk"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={SIZE_MB}m", "tmpfs", str(folder)]
    if os.geteuid() != 0 or subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("needs the right to mount a tmpfs (root)")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def fill(graph: Graph, ended: float = 60.0) -> list[int]:
    """Publish random text, of which no compression makes less, until the recorder has ended;
    the numbers published."""
    publisher = graph.publisher("/rsu/measurements", RsuMeasurement)
    (recorder,) = graph.processes
    sent, end_s = [], time.monotonic() + ended
    while recorder.running and time.monotonic() < end_s:
        number = len(sent) + 1
        publisher.publish(RsuMeasurement(rsu_id=os.urandom(10_000).hex(), sequence=number))
        sent.append(number)
        time.sleep(0.01)
    return sent


def filler_takes(file: FileIO) -> bool:
    """Whether there is still room."""
    try:
        return file.write(bytes(4096)) == 4096
    except OSError as error:
        assert error.errno == errno.ENOSPC  # noqa: PT017
        return False


def numbers(path: Path) -> list[int]:
    with BagReader(path) as bag:
        return [e.message.sequence for e in bag.messages(["/rsu/measurements"])]


def test_recorder_warns_and_ends_with_a_whole_bag(graph: Graph, small_disk: Path) -> None:
    said = graph.collect("/diagnostics", DiagnosticArray)
    recorder = graph.run(
        "netpos_bag", "record", "--output", str(small_disk / "bag"), "--min-free-mb", "1"
    )
    recorder.wait_for_output("recording to")
    sent = fill(graph)
    assert recorder.wait() == 1, recorder.describe()
    assert "less than 1 (--min-free-mb); make room there" in recorder.output
    assert "Traceback" not in recorder.output
    found = numbers(small_disk / "bag")
    assert found == list(range(found[0], found[0] + len(found)))
    assert len(found) > len(sent) / 2
    told = [status for message in said.messages for status in message.status]
    assert {status.name for status in told} == {"netpos_record: disk"}
    assert b"\x01" in [status.level for status in told], "a warning before the end"
    assert "recording ends at 1 MB: make room" in told[0].message


def test_recorder_whose_disk_is_full_says_so_and_loses_a_second_at_most(
    graph: Graph, small_disk: Path
) -> None:
    recorder = graph.run(
        "netpos_bag", "record", "--output", str(small_disk / "bag"), "--min-free-mb", "0"
    )
    recorder.wait_for_output("recording to")
    sent = fill(graph)
    assert recorder.wait() == 1, recorder.describe()
    assert "Traceback" not in recorder.output
    last = recorder.output.strip().splitlines()[-1]
    assert "No space left on device; the recording ended. Make room, then: netpos recover" in last
    output = small_disk.parent / "recovered"
    report = recover(small_disk / "bag", output)
    assert report.unverified == 0
    found = numbers(output)
    assert found == list(range(found[0], found[0] + len(found)))
    assert sent[-1] - found[-1] < 100 + 40, "a second, and what is sent before the end is seen"


@pytest.mark.parametrize(
    ("command", "file"),
    [
        (["evaluate", str(BAGS / "fast_pass"), "--json"], "a.json"),
        (["evaluate", str(BAGS / "fast_pass"), "--map"], "a.png"),
        (["evaluate", str(BAGS / "fast_pass"), "--bounds"], "a.svg"),
        (["report", str(BAGS / "fast_pass"), "--out"], "a.html"),
        (["params", "--dump"], "a.yaml"),
        (["rsus", "save", str(BAGS / "fast_pass")], "a.yaml"),
        (["replay", str(BAGS / "fast_pass"), "--out"], "bag"),
    ],
)
def test_results_on_a_full_disk(small_disk: Path, command: list[str], file: str) -> None:
    """Nothing cut stays, what was there stays, and the file is named."""
    old = small_disk / file
    if file in ("a.json", "a.png", "a.svg", "a.html"):
        old.write_text("old")
    with (small_disk / "filler").open("wb", buffering=0) as filler:
        while filler_takes(filler):
            pass
    before = {f.name: f.stat().st_size for f in small_disk.iterdir()}
    done = subprocess.run(
        ["netpos", *command, str(old)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1, done.stderr
    assert "Traceback" not in done.stderr
    (sentence,) = (line for line in done.stderr.splitlines() if line.startswith("netpos: "))
    assert str(old) in sentence
    assert "No space left on device; make room there and run it again" in sentence
    assert {f.name: f.stat().st_size for f in small_disk.iterdir()} == before
