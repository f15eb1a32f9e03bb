"""Attackers beside a live tracker: the device they speak of is tracked, and they are named."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from runs import ROOT

SECONDS = 9.0  # the attack begins after 5
ERROR_M = 3.0  # range sd 0.5 m, azimuth sd 2 degrees at 60 m, four RSUs


def trial(folder: Path, name: str) -> dict[str, Any]:
    file = folder / "trial.json"
    command = [sys.executable, ROOT / "scripts" / "hostile_trials.py", "--trial", name]
    options = ["--seconds", str(SECONDS), "--json", file]
    done = subprocess.run([*command, *options], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (found,) = json.loads(file.read_text(encoding="utf-8"))
    return dict(found)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("known", "rsu a: all refused: conflict"),
        ("names", "devices not admitted (too_many_devices"),
        ("moved", "RsuInfo of a refused: a says it is 50 m from"),
        ("rsus", "rsu new_0"),
        ("pose", "initialpose"),
    ],
)
def test_an_attack_moves_nothing_and_is_named(tmp_path: Path, name: str, words: str) -> None:
    found = trial(tmp_path, name)
    for side in ("victim", "others"):
        assert found[side]["missing"] == 0
        assert found[side]["error_m"] < ERROR_M
        assert found[side]["beyond"] == 0
        assert found[side]["tracking"] > 30
    assert any(words in line for line in found["named"]), found["named"]
    assert found["odometry_topics"] == 5  # of the honest devices; invented ones have none
