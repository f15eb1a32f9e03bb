"""Draw memory and latency of the soak over the hours:
python scripts/soak_picture.py FILE.json... OUT.svg, with what netpos bench --json wrote."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

LATENCIES = {
    "epoch_s": "one epoch, median",
    "epoch_p99_s": "one epoch, 99 %",
    "lag_median_s": "lag of odometry, median",
    "lag_p99_s": "lag of odometry, 99 %",
}
MEMORIES = {"memory_mb": "tracker", "recorder_memory_mb": "recorder"}


def runs(paths: list[Path]) -> list[tuple[str, dict[str, Any]]]:
    """What was measured, and its series."""
    rows = [row for path in paths for row in json.loads(path.read_text())["rows"]]
    return [(row["name"].partition(":")[0], row["series"]) for row in rows if "series" in row]


def draw(found: list[tuple[str, dict[str, Any]]], out: Path) -> None:
    """A column for each run, memory above latency."""
    picture = Figure(figsize=(5.0 * len(found), 5.0), layout="constrained")
    panels = picture.subplots(2, len(found), sharex="col", squeeze=False)
    for column, (name, series) in enumerate(found):
        memory, latency = panels[0][column], panels[1][column]
        memory.set_title(name)
        for key, text in MEMORIES.items():
            if key in series:
                memory.plot(series["hours"], series[key], label=text)
        for key, text in LATENCIES.items():
            if key in series:
                latency.plot(series["hours"], [1e3 * s for s in series[key]], label=text)
        memory.set_ylabel("resident memory [MB]")
        latency.set_ylabel("[ms]")
        latency.set_xlabel("time [h]")
        for panel in (memory, latency):
            panel.set_ylim(0.0, 1.1 * panel.dataLim.y1)
            panel.legend()
    picture.savefig(out)


if __name__ == "__main__":
    *sources, target = map(Path, sys.argv[1:])
    draw(runs(sources), target)
