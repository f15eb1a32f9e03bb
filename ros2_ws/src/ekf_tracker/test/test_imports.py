"""What the tracker's node loads: every tracker pays for it at its start and in memory."""

from __future__ import annotations

import subprocess
import sys

HEAVY = (
    *("scipy.linalg", "scipy.optimize", "scipy.signal", "scipy.spatial", "scipy.special"),
    *("pydantic", "netpos.scenario.load"),
    *("mcap", "zstandard", "rosbags.rosbag2", "netpos.bags.reader"),
)


def test_the_node_does_without_simulator_files_and_scipys_parts() -> None:
    code = f"import sys, ekf_tracker.node; print([m for m in {HEAVY} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
