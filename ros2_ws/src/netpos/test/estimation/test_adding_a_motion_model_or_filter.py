"""docs/adding_a_motion_model_or_filter.md adds a motion model and a filter form: one file and one
line in a table of a copy each."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from library_copy import DRIVE, add_entry, code_of, copy_of_library, run, run_tests
from scipy import stats
from scipy.linalg import expm

EPOCHS = 81

_RUN = """
from dataclasses import fields
from netpos.estimation.motion import NO_BIAS, Model, motion_parameters, noise


def follow(**settings):
    simulation = street("range", range_sd_m=1.0)
    return drive(simulation, accel_density_mps2_sqrthz=0.5, **settings)


Q = np.empty((6, 6))
noise(np.zeros(6), 0.7, motion_parameters(Model.DAMPED, accel=0.4, damping_time=2.0), NO_BIAS, Q)
described = {entry.name: entry.metadata for entry in fields(TrackerConfig)}
plain = {"manoeuvre_speed_sd_mps": 0.0, "filter": "ekf"}
print(json.dumps({
    "number": int(Model.DAMPED),
    "Q": Q[:4, :4].tolist(),
    "texts": [described[name]["text"] for name in ("motion_model", "damping_time_s", "filter")],
    "defaults": [TrackerConfig().damping_time_s, TrackerConfig().information_loss],
    "damped": follow(motion_model="damped", damping_time_s=30.0),
    "damped_little": follow(motion_model="damped", damping_time_s=1e3, **plain),
    "straight": follow(**plain),
    "ekf": follow(filter="ekf"),
    "information": follow(filter="information"),
    "forgetful": follow(filter="information", information_loss=0.1),
    "both": follow(filter="information", motion_model="damped", damping_time_s=30.0),
}))
"""


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Copy of the library with the motion model and the filter form of the page."""
    root = tmp_path_factory.mktemp("with_toys")
    estimation = copy_of_library(root) / "estimation"
    blocks = code_of("adding_a_motion_model_or_filter.md")
    add_entry(estimation / "motion", "damped", *blocks[:2])
    add_entry(estimation / "forms", "information", *blocks[2:])
    return root


@pytest.fixture(scope="module")
def found(library: Path) -> dict[str, Any]:
    result: dict[str, Any] = json.loads(run(library, "-c", DRIVE + _RUN))
    return result


def test_the_tables_name_them_to_users(found: dict[str, Any]) -> None:
    assert found["number"] == 6
    model, parameter, form = found["texts"]
    assert "damped (forgets its velocity)" in model
    assert parameter == "damped: time in which a velocity is forgotten"
    assert "information (the inverse of the covariance)" in form
    assert found["defaults"] == [10.0, 0.0]


def test_noise_is_van_loans(found: dict[str, Any]) -> None:
    """Van Loan 1978 of an Ornstein-Uhlenbeck velocity: tau 2 s, density 0.4, 0.7 s."""
    A, Qc = np.zeros((4, 4)), np.diag([0.0, 0.0, 0.16, 0.16])
    A[0, 2] = A[1, 3] = 1.0
    A[2, 2] = A[3, 3] = -0.5
    E = expm(np.block([[-A, Qc], [np.zeros((4, 4)), A.T]]) * 0.7)
    np.testing.assert_allclose(found["Q"], E[4:, 4:].T @ E[:4, 4:], rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("name", ["damped", "information", "both"])
def test_a_track_with_it_converges(found: dict[str, Any], name: str) -> None:
    """From 5 m of the initial pose; errors are such as the covariance allows, and NIS of the whole
    drive is within 99.9 % of chi-square."""
    drive = found[name]
    assert len(drive["errors"]) >= EPOCHS - 1
    assert max(drive["errors"][-40:]) < 2.0
    assert max(drive["sds"][-40:]) < 1.0
    ratio = [(e / s) ** 2 for e, s in zip(drive["errors"], drive["sds"], strict=True)]
    assert sum(ratio[-40:]) / 40 < 3.0
    low, high = stats.chi2(drive["dof"]).ppf([0.0005, 0.9995])
    assert drive["dof"] > 200
    assert low < drive["nis"] < high


def test_damped_little_is_straight(found: dict[str, Any]) -> None:
    """A velocity forgotten in 1000 s moves the device as a constant one to millimetres."""
    away = np.subtract(found["damped_little"]["positions"], found["straight"]["positions"])
    assert 0.0 < np.abs(away).max() < 0.02


def test_information_is_the_same_filter(found: dict[str, Any]) -> None:
    """Another way to carry the covariance of the extended Kalman filter; a loss makes it wider."""
    for key, atol in (("positions", 1e-6), ("sds", 1e-6)):
        np.testing.assert_allclose(found["information"][key], found["ekf"][key], atol=atol)
    assert found["forgetful"]["sds"][-1] > 1.05 * found["ekf"]["sds"][-1]


def test_the_model_passes_the_tests_of_all_models(library: Path) -> None:
    """Jacobian against finite differences."""
    tests = Path(__file__).with_name("test_motion_models.py")
    assert run_tests(library, tests, "jacobian_by_differences") >= 28
