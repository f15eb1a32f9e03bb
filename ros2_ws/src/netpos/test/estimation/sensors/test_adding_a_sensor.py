"""docs/adding_a_sensor.md adds a sensor: one file and one line in the table of a copy."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from library_copy import DRIVE, add_entry, code_of, copy_of_library, run, run_tests
from scipy import stats

EPOCHS = 81

_RUN = """
from dataclasses import replace
from netpos.estimation.measurement import Kind
from netpos.tracking.door.validation import explanation

refused = []


def with_a_bad_one(tracker, measured):
    bad = replace(measured[0], range_m=-1.0)
    reason = tracker.add(bad)
    refused.append([reason, explanation(bad, reason)])
    return measured


settings = {"process_noise": "continuous", "accel_density_mps2_sqrthz": 0.1}
found = drive(street("log_range", range_sd_m=1.0), with_a_bad_one, **settings)
print(json.dumps({"kind": int(Kind.LOG_RANGE), "refused": refused, **found}))
"""


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Copy of the library with the sensor of the page."""
    root = tmp_path_factory.mktemp("with_a_toy")
    sensors = copy_of_library(root) / "estimation/sensors"
    add_entry(sensors, "log_range", *code_of("adding_a_sensor.md"))
    return root


@pytest.fixture(scope="module")
def drive(library: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(run(library, "-c", DRIVE + _RUN))
    return found


def test_its_rows_have_its_number(drive: dict[str, Any]) -> None:
    assert drive["kind"] == 15


def test_a_bad_value_is_refused_with_value_and_remedy(drive: dict[str, Any]) -> None:
    sentence = "range_m is -1 m; send a distance above 0 m"
    assert drive["refused"] == [["distance_not_positive", sentence]] * EPOCHS


def test_its_track_converges(drive: dict[str, Any]) -> None:
    """From 5 m of the initial pose; the error is one that its covariance allows."""
    assert len(drive["errors"]) >= EPOCHS - 1
    assert max(drive["errors"][-40:]) < 2.0
    assert max(drive["sds"][-40:]) < 1.0
    ratio = [(e / s) ** 2 for e, s in zip(drive["errors"], drive["sds"], strict=True)]
    assert sum(ratio[-40:]) / 40 < 3.0


def test_its_innovations_are_as_large_as_they_should_be(drive: dict[str, Any]) -> None:
    """NIS of the whole drive within 99.9 % of chi-square."""
    low, high = stats.chi2(drive["dof"]).ppf([0.0005, 0.9995])
    assert drive["dof"] > 200
    assert low < drive["nis"] < high


def test_it_passes_the_tests_of_all_sensors(library: Path) -> None:
    """Gradient and second-order term against finite differences."""
    tests = Path(__file__).with_name("test_models.py")
    assert run_tests(library, tests, "LOG_RANGE or 15") >= 10
