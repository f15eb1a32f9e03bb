"""Rows of the two-antenna anchor: phase with wrap, range to the master antenna."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from netpos.estimation.forms import ekf, srukf
from netpos.estimation.measurement import (
    AXES,
    KIND,
    LEVER,
    ORIGIN,
    VALUE,
    Kind,
    innovation_row,
    predict_row,
)
from netpos.estimation.rows import array_direction, rsu_axes, rsu_rows
from netpos.estimation.state import POSITION, X
from netpos.messages.values import Array, Field, RsuInfo, RsuMeasurement
from scipy.spatial.transform import Rotation

BASELINE, WAVELENGTH = 0.4, 0.05
HEIGHT = 1.1
MEASURED = RsuMeasurement(
    stamp_ns=1,
    rsu_id="a",
    vue_id="v",
    fields=Field.RANGE | Field.TOA | Field.PHASE,
    range_m=1.0,
    range_var=1e-3,
    toa_s=1e-8,
    toa_var=1e-18,
    phase_difference_rad=0.3,
    phase_difference_var=0.01,
    lever_arm=(0.3, -0.2, 0.1),
)


def anchor(rng: np.random.Generator) -> RsuInfo:
    turn = Rotation.from_euler("zyx", rng.uniform(-1, 1, 3) * [3.0, 0.5, 0.5])
    return RsuInfo(
        rsu_id="a",
        position=rng.uniform(-3, 3, 3),
        quaternion=turn.as_quat(),
        baseline_m=BASELINE,
        wavelength_m=WAVELENGTH,
    )


def antennas(info: RsuInfo) -> tuple[Array, Array]:
    """Positions of master and slave, by SciPy."""
    y_axis = Rotation.from_quat(info.quaternion).apply([0.0, 1.0, 0.0])
    return info.position - BASELINE / 2 * y_axis, info.position + BASELINE / 2 * y_axis


def rows_by_kind(info: RsuInfo, heading: int = -1) -> dict[Kind, Array]:
    rows = rsu_rows(MEASURED, info, rsu_axes(info), 0, heading=heading)
    return {Kind(int(row[KIND])): row for row in rows}


@pytest.mark.parametrize("seed", range(5))
def test_range_and_toa_count_from_the_master(seed: int) -> None:
    rng = np.random.default_rng(seed)
    info = anchor(rng)
    master, _ = antennas(info)
    rows, x = rows_by_kind(info), rng.normal(size=6) * 5.0
    distance = np.linalg.norm([*x[POSITION], HEIGHT + 0.1] - master)
    h = np.empty(6)
    assert predict_row(rows[Kind.RANGE], x, HEIGHT, h) == pytest.approx(distance, abs=1e-12)
    toa = predict_row(rows[Kind.TOA], x, HEIGHT, h)
    assert toa == pytest.approx(distance + x[X.CLOCK], abs=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_far_away_the_phase_is_the_path_difference(seed: int) -> None:
    """Slave minus master over the wavelength, in turns; the plane wave leaves (L/r)^2 out."""
    rng = np.random.default_rng(seed)
    info = anchor(rng)
    master, slave = antennas(info)
    x = np.append(rng.normal(size=2) * 400.0, np.zeros(4))
    there = np.array([*x[POSITION], HEIGHT + 0.1])
    path = np.linalg.norm(there - slave) - np.linalg.norm(there - master)
    phase = predict_row(rows_by_kind(info)[Kind.PHASE], x, HEIGHT, np.empty(6))
    assert phase == pytest.approx(2 * math.pi * path / WAVELENGTH, abs=1e-3)


def test_the_paper_s_signs() -> None:
    """Boresight along y: x to the right is positive, theta = atan2(x, y) (petukhov:eq.5)."""
    info = RsuInfo(
        rsu_id="a",
        position=np.zeros(3),
        quaternion=Rotation.from_euler("z", 90, degrees=True).as_quat(),
        baseline_m=BASELINE,
        wavelength_m=WAVELENGTH,
    )
    np.testing.assert_allclose(array_direction(rsu_axes(info)), [1.0, 0.0, 0.0], atol=1e-12)
    rows = rows_by_kind(info)
    np.testing.assert_allclose(rows[Kind.RANGE][ORIGIN:AXES], [BASELINE / 2, 0, 0], atol=1e-12)
    for row in rows.values():
        row[LEVER:] = 0.0
    phase = predict_row(rows[Kind.PHASE], np.array([2.0, 3.0, 0, 0, 0, 0]), 0.0, np.empty(6))
    expected = 2 * math.pi * BASELINE / WAVELENGTH * math.sin(math.atan2(2.0, 3.0))
    assert phase == pytest.approx(expected, abs=1e-12)


def test_only_a_phase_without_its_turns_wraps_its_innovation() -> None:
    row = rows_by_kind(anchor(np.random.default_rng(2)))[Kind.PHASE]
    x, h = np.array([3.0, 4.0, 0, 0, 0, 0]), np.empty(6)
    predicted = predict_row(row, x, HEIGHT, h)
    for turns in (-3, 0, 2):
        row[VALUE] = predicted + 0.25 + 2 * math.pi * turns
        row[KIND] = Kind.PHASE
        assert innovation_row(row, x, HEIGHT, h) == pytest.approx(0.25, abs=1e-9)
        row[KIND] = Kind.UNWRAPPED_PHASE
        expected = 0.25 + 2 * math.pi * turns
        assert innovation_row(row, x, HEIGHT, h) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("filter_name", ["ekf", "srukf"])
def test_an_update_moves_to_the_near_side_of_the_wrap(filter_name: str) -> None:
    """Predicted phase just below an odd multiple of pi, measured just above: a small step."""
    info = RsuInfo(rsu_id="a", position=np.zeros(3), baseline_m=BASELINE, wavelength_m=WAVELENGTH)
    measured = replace(MEASURED, fields=Field.PHASE, lever_arm=(0.0, 0.0, 0.0))
    rows = rsu_rows(measured, info, rsu_axes(info), 0)
    scale = 2 * math.pi * BASELINE / WAVELENGTH
    angle = math.asin((3 * math.pi - 0.1) / scale)
    x = np.array([4.0 * math.cos(angle), -4.0 * math.sin(angle), 0, 0, 0, 0])
    rows[0, VALUE] = -math.pi + 0.1  # 3 pi + 0.1 unwrapped
    P = np.diag([0.002, 0.002, 1.0, 1.0, 1.0, 1.0])
    gate, accepted = np.full(5, 1e9), np.zeros(1)
    if filter_name == "ekf":
        work = ekf.workspace(6, 1)
        ekf.update(x, P.copy(), rows, 0.0, gate, 1, accepted, work)
    else:
        srukf.update(x, np.linalg.cholesky(P), rows, 0.0, gate, accepted)
    after = predict_row(rows[0], x, 0.0, np.empty(6))
    assert 3 * math.pi - 0.05 < after < 3 * math.pi + 0.1
