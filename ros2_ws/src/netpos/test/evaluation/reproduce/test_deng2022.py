"""deng2022: the drives' bookkeeping by other routes, and every cell of both tables."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from netpos.evaluation.reproduce import blocked_drive as drives
from netpos.evaluation.reproduce import car_drive, deng2022, drive_bounds
from netpos.evaluation.reproduce.blocked_drive import (
    FIX,
    FIX_HEIGHT,
    LOOSE,
    LOOSE_DIAGONAL,
    LOOSE_FIXED,
    TIGHT,
    VARIANTS,
    VEHICLE,
    Run,
    Tally,
    run,
    tally_seeds,
)
from netpos.evaluation.reproduce.frame import Work
from netpos.filters.position_fix import FixStatus
from netpos.filters.space import CLOCK
from scipy.spatial.transform import Rotation

SEED = 5001


@pytest.fixture(scope="module")
def blocked() -> Run:
    return run(deng2022.BLOCKED, SEED)


@pytest.fixture(scope="module")
def tally() -> dict[str, Tally]:
    return tally_seeds(deng2022.BLOCKED, range(SEED, SEED + 1))


def test_figures_are_those_of_the_run(blocked: Run, tally: dict[str, Tally]) -> None:
    """RMS by axis of the vehicle's drive, written out."""
    error = blocked.drives[TIGHT].nav[:, :3] - blocked.position
    north, east, down = tally[TIGHT].rms_m
    assert north == pytest.approx(np.sqrt(np.mean(error[:, 1] ** 2)))
    assert east == pytest.approx(np.sqrt(np.mean(error[:, 0] ** 2)))
    assert down == pytest.approx(np.sqrt(np.mean(error[:, 2] ** 2)))
    assert tally[TIGHT].n == len(error) == 604
    values = [
        e @ np.linalg.inv(P[:3, :3]) @ e
        for e, P in zip(error, blocked.drives[TIGHT].cov, strict=True)
    ]
    assert tally[TIGHT].nees_test(3).mean == pytest.approx(np.mean(values))
    fixes = blocked.fixes[FIX]
    good = fixes.status == FixStatus.CONVERGED
    assert tally[FIX].success_percent == pytest.approx(100 * good.mean())
    misses = (fixes.position - blocked.antenna)[good]
    assert tally[FIX].rms_m[1] == pytest.approx(np.sqrt(np.mean(misses[:, 0] ** 2)))


def test_attitude_errors_are_small_rotations(blocked: Run) -> None:
    error = drives.error_of(blocked, blocked.drives[VEHICLE])
    estimate = Rotation.from_quat(blocked.drives[VEHICLE].nav[:, 6:10])
    angle = (estimate * blocked.attitude.inv()).magnitude()
    np.testing.assert_allclose(np.linalg.norm(error[:, 6:], axis=1), angle, atol=1e-9)
    assert np.degrees(np.sqrt(np.mean(angle[100:] ** 2))) < 2.0


def test_couplings_stand_in_their_order(tally: dict[str, Tally]) -> None:
    """Single epochs, then the filter, then what vehicles do not do."""
    plane = {name: np.hypot(*t.rms_m[:2]) for name, t in tally.items()}
    assert set(tally) == set(VARIANTS)
    assert plane[VEHICLE] < plane[TIGHT] < 0.5 * plane[FIX]
    assert plane[LOOSE] < 0.5 * plane[FIX]
    assert tally[FIX_HEIGHT].rms_m[2] < tally[FIX].rms_m[2]


def test_tallies_add(tally: dict[str, Tally]) -> None:
    twice = tally[TIGHT] + tally[TIGHT]
    assert twice.n == 2 * tally[TIGHT].n
    assert twice.rms_m == pytest.approx(tally[TIGHT].rms_m)
    np.testing.assert_allclose(twice.nees, 2 * tally[TIGHT].nees)


def test_outages_are_ten_silent_seconds() -> None:
    done = run(deng2022.OUTAGES, SEED)
    silent = ~done.heard
    edges = np.flatnonzero(np.diff(silent.astype(int)))
    lengths = np.diff(edges)[::2]
    assert set(lengths.tolist()) == {
        deng2022.OUTAGES.outage_s - 1
    }  # silent epochs between heard ones
    result = tally_seeds(deng2022.OUTAGES, range(SEED, SEED + 1))[VEHICLE]
    assert result.outage_m.shape == (len(lengths), 2)
    ends = edges[1::2]
    error = (done.drives[VEHICLE].nav[:, :3] - done.position)[ends]
    np.testing.assert_allclose(result.outage_m[:, 0], np.hypot(error[:, 0], error[:, 1]))
    np.testing.assert_allclose(result.outage_m[:, 1], np.linalg.norm(error, axis=1))


def test_every_cell_has_its_row(monkeypatch: pytest.MonkeyPatch) -> None:
    """All cells of Tables 1 and 2 with the paper's values; without the recording the real rows
    are empty and say why."""
    monkeypatch.setattr(car_drive, "recording", lambda: None)
    with Work(1, SEED, 1) as work:
        outcome = deng2022.reproduce(work)
    assert len(outcome.notes) == 1
    rows = {row.name: row for row in outcome.rows}
    assert len(rows) == len(outcome.rows)
    json.dumps([row.ours for row in outcome.rows], allow_nan=False)
    for case, fix, ins in deng2022.TABLES:
        for name, cells in ((FIX, fix), (f"SINS, {LOOSE}", ins), (f"SINS, {VEHICLE}", ins)):
            label = f"{case.name}, {name}"
            found = [rows[f"{label}: success"]]
            found += [rows[f"{label}: RMS {axis}"] for axis in ("north", "east", "down")]
            assert tuple(row.paper for row in found) == cells
            assert all(row.ok is not None for row in found)
    one_way = f"{deng2022.ONE_WAY.name}, SINS, {TIGHT}"
    for axis in ("north", "east", "down"):
        assert rows[f"{one_way}: RMS {axis}"].ours is not None
    for what in ("position (expected 3)", "clock offset (expected 1)"):
        assert rows[f"{one_way}: NEES of {what}"].ok is not None
    real = [row for row in outcome.rows if row.name.startswith("Real")]
    assert len(real) == 22
    assert all(row.ours is None for row in real)


def test_the_bound_is_kept_and_nearly_reached(tally: dict[str, Tally]) -> None:
    """No unbiased filter is better than its posterior Cramér-Rao bound; the tight one reaches it
    but for chance, and the filter that made it never left the true way."""
    epochs, made = drive_bounds.bound_drives(deng2022.BLOCKED, SEED)
    states = drive_bounds.true_states(
        drives.simulation_of(deng2022.BLOCKED).with_seed(SEED), epochs
    )
    for variant in (TIGHT, VEHICLE):
        assert np.abs(made[variant].nav[:, :3] - states[:, :3]).max() < 0.02
        bound = np.sqrt(np.diagonal(made[variant].cov, axis1=1, axis2=2)[:, :2].mean(axis=0).sum())
        ratio = np.hypot(*tally[variant].rms_m[:2]) / bound
        assert 0.8 < ratio < 1.3
    exact = np.diagonal(made[drive_bounds.EXACT].cov, axis1=1, axis2=2)[:, :3].sum()
    assert exact < np.diagonal(made[VEHICLE].cov, axis1=1, axis2=2)[:, :3].sum()


def test_less_told_of_a_fix_costs(tally: dict[str, Tally], blocked: Run) -> None:
    plane = {name: np.hypot(*t.rms_m[:2]) for name, t in tally.items()}
    assert plane[LOOSE] < plane[LOOSE_DIAGONAL] < plane[LOOSE_FIXED]
    fixes = blocked.fixes[FIX]
    told = drives.less_told(fixes)
    np.testing.assert_array_equal(told[LOOSE_DIAGONAL].cov[:, 0, 0], fixes.cov[:, 0, 0])
    assert not told[LOOSE_DIAGONAL].cov[:, 0, 1].any()
    good = fixes.status == FixStatus.CONVERGED
    np.testing.assert_allclose(told[LOOSE_FIXED].cov[7], fixes.cov[good].mean(axis=0))


def test_one_way_times_find_the_clock() -> None:
    found = tally_seeds(deng2022.ONE_WAY, range(SEED + 2, SEED + 3))
    assert set(found) == {FIX, FIX_HEIGHT, TIGHT, VEHICLE}
    error, said = found[TIGHT].clock_ns
    assert said < 6.0
    assert error == pytest.approx(said, rel=0.2)
    assert found[TIGHT].nees_test(1).consistent
    assert np.hypot(*found[TIGHT].rms_m[:2]) < 3.0


def test_the_clock_is_judged_by_its_own_variance() -> None:
    done = run(deng2022.ONE_WAY, SEED + 2)
    found = tally_seeds(deng2022.ONE_WAY, range(SEED + 2, SEED + 3))[VEHICLE]
    result = done.drives[VEHICLE]
    error, sd = result.nav[:, CLOCK + 1] - done.clock_m, np.sqrt(result.cov[:, CLOCK, CLOCK])
    assert found.nees_test(1).mean == pytest.approx(np.mean((error / sd) ** 2))
    to_ns = 1e9 / 299_792_458.0
    assert found.clock_ns[0] == pytest.approx(to_ns * np.sqrt(np.mean(error**2)))
    assert found.clock_ns[1] == pytest.approx(to_ns * np.sqrt(np.mean(sd**2)))


def test_smoothing_bridges_outages() -> None:
    """Given what comes after, the error inside is a fraction of the filter's."""
    with Work(1, SEED, 1) as work:
        found = drive_bounds.in_outages(work, deng2022.OUTAGES)
    for variant in (TIGHT, VEHICLE):
        filtered, smoothed = (
            np.hypot(*found[f"{variant}, {what}"].rms_m[:2]) for what in ("filtered", "smoothed")
        )
        assert smoothed < 0.4 * filtered


@pytest.mark.parametrize(("seconds", "limit"), [(10.0, 2.0)])
def test_the_real_imu_holds_an_outage(seconds: float, limit: float) -> None:
    if car_drive.recording() is None:
        pytest.skip("no recording car_imu_rtk; set NETPOS_DATA")
    coasts = car_drive.outages(VEHICLE)
    assert len(coasts.error) >= 40
    assert np.median(coasts.at(seconds)) < limit
    assert coasts.at(0.0).max() < 0.5
    assert np.median(coasts.at(30.0)) > np.median(coasts.at(5.0))


def test_the_real_drive_among_stations() -> None:
    if car_drive.recording() is None:
        pytest.skip("no recording car_imu_rtk; set NETPOS_DATA")
    few = replace(deng2022.BLOCKED, fewest=2)
    errors = car_drive.station_errors(few, SEED)
    rms = {name: float(np.sqrt((e[:, :2] ** 2).sum(axis=1).mean())) for name, e in errors.items()}
    assert rms[VEHICLE] < rms[TIGHT] < 2.0
