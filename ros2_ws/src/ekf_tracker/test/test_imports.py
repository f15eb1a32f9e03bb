"""What the tracker's node loads: every tracker pays for it at its start and in memory."""

from __future__ import annotations

import subprocess
import sys

HEAVY = ("scipy.linalg", "scipy.optimize", "scipy.signal", "scipy.spatial", "scipy.special")


def test_the_node_does_without_the_simulator_and_scipys_parts() -> None:
    code = (
        "import sys, ekf_tracker.node;"
        f"print([m for m in ({', '.join(map(repr, HEAVY))}, 'pydantic', 'netpos.scenario.load')"
        " if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
