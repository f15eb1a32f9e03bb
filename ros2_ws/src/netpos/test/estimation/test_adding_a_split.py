"""docs/adding_a_split.md adds a reason to split: one file and one line in the table of a copy."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from library_copy import DRIVE, add_entry, code_of, copy_of_library, run

_RUN = """
rng = np.random.default_rng(8)


def mirrored(tracker, measured):
    for m in measured:
        if rng.random() < 0.3:
            m.azimuth_rad = -m.azimuth_rad
    return measured


found = drive(street("azimuth", azimuth_sd_deg=2.0), mirrored, accel_density_mps2_sqrthz=0.5)
print(json.dumps(found))
"""


def drives(root: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(run(root, "-c", DRIVE + _RUN))
    return found


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Of a copy with the split of the page."""
    root = tmp_path_factory.mktemp("with_a_split")
    splits = copy_of_library(root) / "estimation/mixture/splits"
    add_entry(splits, "mirrored", *code_of("adding_a_split.md"))
    return drives(root)


def test_its_track_converges(found: dict[str, Any]) -> None:
    """From 5 m of the initial pose; the error is one that its covariance allows."""
    assert len(found["errors"]) >= 80
    assert max(found["errors"][-40:]) < 3.0
    ratio = [(e / s) ** 2 for e, s in zip(found["errors"], found["sds"], strict=True)]
    assert sum(ratio[-40:]) / 40 < 3.0


def test_without_it_the_mirrored_azimuths_are_lost(found: dict[str, Any], tmp_path: Path) -> None:
    """Three in ten are refused, which the split uses."""
    copy_of_library(tmp_path)
    plain = drives(tmp_path)
    assert plain["dof"] < 0.8 * found["dof"]
    assert sum(plain["errors"]) > sum(found["errors"])
