"""Speed as ratios measured side by side, so that the machine cancels out.

``common``      rows, timing, JSON
``problem``     the problem every filter solves
``filters``     against FilterPy and C (``yardstick``), ``stone_soup`` where it is installed
``replay``      offline replay against real time and rosbags
``memory``      the tracker's core over an hour
``routes``      Monte Carlo over METIS routes
``live``        the running node: latency, load, flood, start
``soak``        a simulated day of the core, an hour of the running node; only where asked for
"""

from __future__ import annotations

import os
import platform
from collections.abc import Iterable, Iterator
from importlib import import_module
from typing import Any

from netpos.bench.common import LeftOut, Result, Row, Unavailable, as_json

__all__ = [
    "ONLY_ASKED",
    "PARTS",
    "LeftOut",
    "Result",
    "Row",
    "as_json",
    "bench",
    "chosen",
    "surroundings",
]

# What can be measured: module and function, imported when its turn comes.
PARTS = {
    "ekf": ("filters", "ekf_rows"),
    "srukf": ("filters", "srukf_rows"),
    "stonesoup": ("stone_soup", "stone_soup_rows"),
    "replay": ("replay", "replay_rows"),
    "memory": ("memory", "memory_rows"),
    "routes": ("routes", "route_rows"),
    "ready": ("live", "ready_rows"),
    "latency": ("live", "latency_rows"),
    "load": ("live", "load_rows"),
    "flood": ("live", "flood_rows"),
    "soak": ("soak", "soak_rows"),
    "live_soak": ("soak", "live_soak_rows"),
}
ONLY_ASKED = ("soak", "live_soak")
"""Parts that take minutes or an hour."""


def chosen(names: Iterable[str]) -> list[str]:
    """The parts named, in the order of the benchmark; where none is named all but the long ones.

    Raises ``ValueError`` for a name that is no part.
    """
    names = list(names)
    unknown = [name for name in names if name not in PARTS]
    if unknown:
        raise ValueError(f"no part {unknown[0]!r} to measure; the parts are {', '.join(PARTS)}")
    return [name for name in PARTS if (name in names if names else name not in ONLY_ASKED)]


def bench(parts: Iterable[str], quick: bool = False) -> Iterator[tuple[str, list[Result]]]:
    """Measure part by part; one that cannot be measured here gives its reason instead of rows."""
    for name in parts:
        try:
            module, function = PARTS[name]
            measure = getattr(import_module(f"{__name__}.{module}"), function)
            results: list[Result] = measure(quick)
        except Unavailable as reason:
            results = [LeftOut(name, str(reason))]
        yield name, results


def surroundings(quick: bool) -> dict[str, Any]:
    """Machine and software of the measurement; ``load_average`` shows other load."""
    return {
        "machine": platform.machine(),
        "python": platform.python_version(),
        "cores": os.cpu_count(),
        "load_average": list(os.getloadavg()),
        "quick": quick,
    }
