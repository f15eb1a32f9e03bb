"""What several integration tests need: scenarios, commands that must succeed, bags in pieces."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Collection, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from graph import Graph, Process
from netpos.bags import BagReader, codec, typestore
from netpos.bench.domains import claim_domain
from netpos.messages.fields import stamp_ns
from netpos.messages.topics import RSU_INFO, RSU_MEASUREMENTS, of_vue
from netpos.messages.values import TrackState
from netpos.scenario.load import scenario_files

ROOT = Path(__file__).resolve().parents[1]
VUE = "vue_1"
INFOS, MEASUREMENTS = RSU_INFO, RSU_MEASUREMENTS
ODOMETRY, CLOCK_STATE, TRACK_STATUS, TRUTH = (
    of_vue(VUE, name) for name in ("odometry", "clock_state", "track_status", "ground_truth")
)
ESTIMATES = (ODOMETRY, CLOCK_STATE, TRACK_STATUS)
COASTING = int(TrackState.COASTING)
RUN_S = 120.0
PATIENT = {"hold_s": 10.0}
"""Tracker parameters for a run compared bit by bit: longer than a busy machine stalls a node."""


@contextmanager
def graphs(folder: Path, count: int = 1) -> Iterator[list[Graph]]:
    """So many graphs, each on a domain of its own."""
    with ExitStack() as stack:
        made = [
            stack.enter_context(Graph(stack.enter_context(claim_domain()), folder / f"logs_{i}"))
            for i in range(count)
        ]
        try:
            yield made
        finally:
            # a script that is killed leaves its nodes behind; asked to end it takes them along
            for process in [p for graph in made for p in graph.processes if p.running]:
                process.signal(signal.SIGTERM)
                with suppress(TimeoutError):
                    process.wait()


def script(graph: Graph, name: str, *arguments: str | Path) -> Process:
    """Start scripts/NAME.sh in the graph's domain."""
    return graph.start(name, [str(ROOT / "scripts" / f"{name}.sh"), *map(str, arguments)])


def finish(*processes: Process) -> None:
    """Wait for scripts to end well."""
    for process in processes:
        assert process.wait(RUN_S) == 0, process.describe()


def run_netpos(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run the command line and wait for it."""
    command = ["netpos", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=RUN_S, check=False)


def netpos(*arguments: str | Path) -> str:
    """Run the command line, which must succeed; its output."""
    done = run_netpos(*arguments)
    assert done.returncode == 0, f"netpos {arguments} ended with {done.returncode}: {done.stderr}"
    return done.stdout


def changed_scenario(
    path: Path,
    base: str,
    device: dict[str, Any] | None = None,
    *,
    tracker: dict[str, Any] | None = None,
    **changes: Any,
) -> Path:
    """Write a scenario like ``base`` with other values; ``device`` changes its first device,
    ``tracker`` single parameters."""
    content = yaml.safe_load(scenario_files()[base].read_text(encoding="utf-8"))
    content["devices"][0].update(device or {})
    content.setdefault("tracker", {}).update(tracker or {})
    content.update(changes)
    # a number such as 5.0e-08 has a dot and a signed exponent, so any YAML reader sees a number
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return path


def long_road(path: Path) -> Path:
    """The errors of fast_pass on a straight road of 4 km at 20 m/s: as long as a test may need."""
    units = [{"id": f"rsu_{i}", "position": [60.0 * i, 0.0, 0.0]} for i in range(67)]
    route = {"kind": "waypoints", "points": [[0.0, -10.0], [3960.0, -10.0]]}
    device = {"route": route, "speed_mps": 20.0}
    return changed_scenario(path, "fast_pass", device, rsus={"units": units})


def messages(bag: Path, topic: str) -> list[Any]:
    """Decoded messages of a topic, in order."""
    with BagReader(bag) as reader:
        return [entry.message for entry in reader.messages([topic])]


def is_of_measurements(message: Any) -> bool:
    """Whether a message follows from measurements: what a node tells of a silent device by its own
    clock does not."""
    silent = message.__msgtype__.endswith("TrackStatus") and message.state == COASTING
    return not (silent and message.used == message.nis_dof == 0)


def payloads(bag: Path, topics: Collection[str]) -> dict[str, list[bytes]]:
    """Messages per topic, serialised anew: equal bytes are equal bits of every field.

    What a bag holds as it was sent may differ in the padding between fields, which no field owns.
    """
    found: dict[str, list[bytes]] = {topic: [] for topic in topics}
    with BagReader(bag) as reader:
        for entry in reader.messages(topics):
            if not is_of_measurements(entry.message):
                continue
            anew = typestore().serialize_cdr(entry.message, entry.type_name)
            found[entry.topic].append(bytes(anew))
    return found


def assert_same(found: Path, expected: Path, topics: Collection[str], at_least: int = 1) -> None:
    """Bags hold the same messages of these topics, bit by bit, and ``at_least`` so many of each.

    A failure tells the first difference: whole messages would bury it.
    """
    for topic in topics:
        mine, theirs = (
            [m for m in messages(bag, topic) if is_of_measurements(m)] for bag in (found, expected)
        )
        assert len(theirs) >= at_least, f"{topic}: {len(theirs)} messages expected"
        bits = payloads(found, [topic])[topic], payloads(expected, [topic])[topic]
        pairs = enumerate(zip(*bits, strict=False))
        differing = next((i for i, (a, b) in pairs if a != b), None)
        if differing is not None:
            pytest.fail(
                f"{topic}: message {differing} of {len(mine)} and {len(theirs)} differs:\n"
                f"{mine[differing]}\n{theirs[differing]}"
            )
        assert len(mine) == len(theirs), topic


def horizontal_errors(truth: list[Any], odometry: list[Any]) -> dict[int, float]:
    """Distance [m] of each estimate to the truth of the same stamp, by stamp [ns]."""
    true_positions = {t.stamp_ns: t.position for t in map(codec().odometry_from_msg, truth)}
    return {
        o.stamp_ns: float(np.hypot(*(o.position - true_positions[o.stamp_ns])[:2]))
        for o in map(codec().odometry_from_msg, odometry)
        if o.stamp_ns in true_positions
    }


def stamps(received: list[Any]) -> list[int]:
    """Header stamps [ns]."""
    return [stamp_ns(message.header.stamp) for message in received]
