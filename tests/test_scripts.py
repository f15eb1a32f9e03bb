"""scripts/run_graph.sh and play_bag.sh with stubs for nodes: order, failures, Ctrl-C.

Each stub notes in one file what it was started with and that it was stopped.
"""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import pytest
from graph import Graph, Process, wait_until

STUB = """#!{python}
import sys, time
from pathlib import Path
import rclpy
from rclpy.signals import SignalHandlerOptions
name, ends, code, notes = {name!r}, {ends}, {code}, Path({notes!r})
def note(text):
    with notes.open("a") as file:
        file.write(name + " " + text + "\\n")
rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
node = rclpy.create_node(name)
note("started " + " ".join(sys.argv[1:]))
try:
    while not ends:
        time.sleep(0.02)
except KeyboardInterrupt:
    note("stopped")
rclpy.shutdown()
if code:
    print(name + " has had enough")
sys.exit(code)
"""
NODES = {
    "netpos_record": "netpos_bag/record",
    "netpos_play": "netpos_bag/play",
    "ekf_tracker": "ekf_tracker/ekf_tracker",
    "rsu_sensor": "rsu_sensor/rsu_sensor",
    "vue_sim": "vue_sim/vue_sim",
}


class Stubs:
    """Stubs of all nodes in an install prefix that comes before the real one."""

    def __init__(self, folder: Path, graph: Graph) -> None:
        self.prefix = folder / "prefix"
        self.notes_file = folder / "notes"
        index = self.prefix / "share/ament_index/resource_index/packages"
        index.mkdir(parents=True)
        for name, place in NODES.items():
            (index / place.split("/")[0]).touch()
            self.write(name, ends=name in ("vue_sim", "netpos_play"))
        path = graph.environment["AMENT_PREFIX_PATH"]
        graph.environment["AMENT_PREFIX_PATH"] = f"{self.prefix}:{path}"

    def write(self, name: str, *, ends: bool, code: int = 0) -> None:
        program = self.prefix / "lib" / NODES[name]
        program.parent.mkdir(parents=True, exist_ok=True)
        program.write_text(
            STUB.format(
                python=sys.executable, name=name, ends=ends, code=code, notes=str(self.notes_file)
            )
        )
        program.chmod(0o755)

    @property
    def notes(self) -> list[str]:
        return self.notes_file.read_text().splitlines() if self.notes_file.exists() else []

    def started(self, name: str) -> bool:
        return any(line.startswith(f"{name} started") for line in self.notes)

    def stopped(self) -> list[str]:
        """Names in the order in which they were stopped."""
        return [line.split()[0] for line in self.notes if line.endswith(" stopped")]


@pytest.fixture
def stubs(tmp_path: Path, graph: Graph) -> Stubs:
    return Stubs(tmp_path, graph)


def run_graph(graph: Graph, repository: Path, bag: Path, *more: str) -> Process:
    script = str(repository / "scripts" / "run_graph.sh")
    return graph.start("run_graph", [script, "metis_madrid", str(bag), *more])


def test_order_and_arguments(graph: Graph, stubs: Stubs, repository: Path, tmp_path: Path) -> None:
    """The recorder is first up and last down; scenario, rate and seed reach who needs them."""
    bag = tmp_path / "bag"
    process = run_graph(graph, repository, bag, "10", "7", "--", "-p", "hold_s:=0.1")
    assert process.wait() == 0, process.describe()
    started = [line.split()[0] for line in stubs.notes if " started" in line]
    assert started[0] == "netpos_record"
    assert started[-1] == "vue_sim"
    assert sorted(started) == sorted(set(NODES) - {"netpos_play"})
    assert stubs.stopped() == ["rsu_sensor", "ekf_tracker", "netpos_record"]
    said = {line.split()[0]: line for line in stubs.notes if " started" in line}
    assert f"--output {bag}" in said["netpos_record"]
    assert said["ekf_tracker"].endswith(
        "-p scenario:=metis_madrid -p subscribers:=1 -p hold_s:=0.1"
    )
    assert "-p scenario:=metis_madrid -p seed:=7" in said["rsu_sensor"]
    assert "-p rate:=10.000000" in said["vue_sim"]


def test_play_order_and_arguments(
    graph: Graph, stubs: Stubs, repository: Path, tmp_path: Path
) -> None:
    recorded = repository / "bags" / "fast_pass"
    script = str(repository / "scripts" / "play_bag.sh")
    command = [script, str(recorded), str(tmp_path / "out"), "5", "--", "-p", "hold_s:=0.25"]
    process = graph.start("play_bag", command)
    assert process.wait() == 0, process.describe()
    assert stubs.stopped() == ["ekf_tracker", "netpos_record"]
    (said,) = [line for line in stubs.notes if line.startswith("netpos_play started")]
    assert f"started {recorded} --rate 5 --input-only" in said
    (said,) = [line for line in stubs.notes if line.startswith("ekf_tracker started")]
    assert said.endswith("-p hold_s:=0.25")


@pytest.mark.parametrize("victim", ["netpos_record", "rsu_sensor", "vue_sim"])
def test_node_that_fails_is_named(
    graph: Graph, stubs: Stubs, repository: Path, tmp_path: Path, victim: str
) -> None:
    """Exit code 1, its name, the end of its log, and nothing left running."""
    stubs.write(victim, ends=True, code=3)
    process = run_graph(graph, repository, tmp_path / "bag")
    assert process.wait() == 1
    assert f"{victim} failed with exit code 3" in process.output
    assert f"{victim} has had enough" in process.output
    running = [line.split()[0] for line in stubs.notes if " started" in line]
    assert sorted(stubs.stopped()) == sorted(set(running) - {victim, "vue_sim"})


def test_node_that_is_killed_ends_the_run(
    graph: Graph, stubs: Stubs, repository: Path, tmp_path: Path
) -> None:
    stubs.write("vue_sim", ends=False)
    process = run_graph(graph, repository, tmp_path / "bag")
    wait_until(lambda: stubs.started("vue_sim"), "the simulator", 60.0)
    program = str(stubs.prefix / "lib" / NODES["ekf_tracker"])
    for entry in Path("/proc").glob("[0-9]*/cmdline"):
        if program.encode() in entry.read_bytes().split(b"\0"):
            os.kill(int(entry.parent.name), signal.SIGKILL)
    assert process.wait() == 1
    assert "ekf_tracker failed with exit code 137" in process.output


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_interrupt_stops_every_node(
    graph: Graph,
    stubs: Stubs,
    repository: Path,
    tmp_path: Path,
    number: signal.Signals,
    code: int,
) -> None:
    stubs.write("vue_sim", ends=False)
    process = run_graph(graph, repository, tmp_path / "bag")
    wait_until(lambda: stubs.started("vue_sim"), "the simulator", 60.0)
    process.signal(number)
    assert process.wait() == code
    assert sorted(stubs.stopped()) == sorted(set(NODES) - {"netpos_play"})


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["metis_madrid", "."], 1, "never overwritten"),
        (["metis_madrid"], 2, "scripts/run_graph.sh SCENARIO BAG"),
        (["metis_madrid", "new", "1", "2", "3"], 2, "scripts/run_graph.sh SCENARIO BAG"),
    ],
)
def test_bad_call_starts_nothing(
    graph: Graph,
    stubs: Stubs,
    repository: Path,
    tmp_path: Path,
    arguments: list[str],
    code: int,
    said: str,
) -> None:
    script = str(repository / "scripts" / "run_graph.sh")
    process = graph.start("run_graph", [script, *arguments], cwd=tmp_path)
    assert process.wait() == code
    assert said in process.output
    assert stubs.notes == []
