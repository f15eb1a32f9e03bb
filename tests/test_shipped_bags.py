"""The two recordings in bags/: small, and re-estimated to what was recorded live."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from netpos.bags import BagReader, codec
from netpos.scenario.replay import replay_bag

BAGS = Path(__file__).resolve().parents[1] / "bags"
NAMES = ("fast_pass", "intersection_turn")


def positions(bag: Path) -> np.ndarray:
    with BagReader(bag) as reader:
        found = [
            codec().odometry_from_msg(e.message) for e in reader.messages(["/vue_1/odometry"])
        ]
    return np.array([o.position for o in found])


def test_they_are_small() -> None:
    assert sum(f.stat().st_size for f in BAGS.rglob("*") if f.is_file()) <= 5 * 1024**2


@pytest.mark.parametrize("name", NAMES)
def test_a_replay_gives_the_recorded_estimates(name: str, tmp_path: Path) -> None:
    """To a micrometre: another processor may round differently."""
    replay_bag(BAGS / name, tmp_path / "out")
    recorded = positions(BAGS / name)
    assert len(recorded) >= 40
    np.testing.assert_allclose(positions(tmp_path / "out"), recorded, rtol=0.0, atol=1e-6)
