"""deng2022: the drives' bookkeeping by other routes, and every cell of both tables."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from netpos.estimation.engine import Epochs
from netpos.estimation.fixes.position_fix import FixStatus
from netpos.estimation.measurement import ORIGIN, ROW_WIDTH
from netpos.estimation.state import Err, Nav
from netpos.evaluation.work import Work
from netpos.reproduction.deng2022 import blocked_drive as drives
from netpos.reproduction.deng2022 import bounds as drive_bounds
from netpos.reproduction.deng2022 import car_drive
from netpos.reproduction.deng2022 import paper as deng2022
from netpos.reproduction.deng2022 import rows as drive_rows
from netpos.reproduction.deng2022 import tally as tallies
from netpos.reproduction.deng2022.blocked_drive import (
    DEFAULT,
    DEFAULT_VEHICLE,
    FIX,
    FIX_HEIGHT,
    LOOSE,
    LOOSE_DIAGONAL,
    LOOSE_FIXED,
    TIGHT,
    VEHICLE,
    Run,
    run,
)
from netpos.reproduction.deng2022.drives import Drive, drive
from netpos.reproduction.deng2022.tally import Tally, tally_seeds
from netpos.tracking.estimators.models import gate_thresholds
from netpos.tracking.estimators.strapdown_models import sensors_of
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
    error = tallies.error_of(blocked, blocked.drives[VEHICLE])
    estimate = Rotation.from_quat(blocked.drives[VEHICLE].nav[:, 6:10])
    angle = (estimate * blocked.attitude.inv()).magnitude()
    np.testing.assert_allclose(np.linalg.norm(error[:, 6:], axis=1), angle, atol=1e-9)
    assert np.degrees(np.sqrt(np.mean(angle[100:] ** 2))) < 2.0


def test_couplings_stand_in_their_order(tally: dict[str, Tally]) -> None:
    """KalmanEstimate epochs, then the filter, then what vehicles do not do."""
    plane = {name: np.hypot(*t.rms_m[:2]) for name, t in tally.items()}
    loose, tight = {LOOSE, LOOSE_DIAGONAL, LOOSE_FIXED}, {TIGHT, VEHICLE, DEFAULT, DEFAULT_VEHICLE}
    assert set(tally) == {FIX, FIX_HEIGHT} | loose | tight
    assert plane[VEHICLE] < plane[TIGHT] < 0.5 * plane[FIX]
    assert plane[LOOSE] < 0.5 * plane[FIX]
    assert plane[TIGHT] < plane[DEFAULT] < plane[FIX]
    assert plane[VEHICLE] < plane[DEFAULT_VEHICLE] < plane[DEFAULT]


def test_tallies_add(tally: dict[str, Tally]) -> None:
    twice = tally[TIGHT] + tally[TIGHT]
    assert twice.n == 2 * tally[TIGHT].n
    assert twice.rms_m == pytest.approx(tally[TIGHT].rms_m)
    np.testing.assert_array_equal(twice.nees_sum[1], tally[TIGHT].nees_sum[0])
    assert twice.worst_m.tolist() == 2 * tally[TIGHT].worst_m.tolist()


def test_errors_that_are_no_numbers_are_not_scored() -> None:
    error = np.array([[3.0, 4.0, 0.0], [np.nan, 0.0, 0.0], [0.0, 0.0, 12.0]])
    bad, good = tallies.tally_errors(error, lost=True), tallies.tally_errors(np.full((1, 3), 2.0))
    both = bad + good
    assert (both.n, both.solved) == (4, 3)
    assert both.rms_m == pytest.approx(np.sqrt([13 / 3, 20 / 3, 148 / 3]))
    assert both.worst_m.tolist() == pytest.approx([12.0, np.sqrt(12.0)])
    assert both.large_percent == 50.0
    assert both.lost_percent == 50.0
    assert 100.0 - both.success_percent == 25.0


@pytest.mark.parametrize(("refused", "lost"), [(9, False), (10, True)])
def test_a_track_is_lost_after_ten_refused_epochs(refused: int, lost: bool) -> None:
    """Epochs of four rows; one row of four is a minority. Silence between them does not end the
    row of refused epochs, an accepted epoch does."""
    dof = np.array([4, 1, 0] + [1] * (refused - 1) + [2] + [1] * 5)
    rows = np.full(dof.size, 4)
    rows[2] = 0
    row_start = np.append(0, np.cumsum(rows))
    epochs = Epochs(np.arange(dof.size), row_start, np.zeros((int(row_start[-1]), 1)))
    nav, cov = np.zeros((dof.size, 16)), np.zeros((dof.size, 15, 15))
    assert tallies.is_lost(epochs, Drive(nav, cov, np.zeros(dof.size), dof)) is lost
    nav[5, 3] = np.nan
    assert tallies.is_lost(epochs, Drive(nav, cov, np.zeros(dof.size), dof))


@pytest.mark.parametrize("case", [deng2022.OUTAGES, deng2022.LONG_OUTAGES])
def test_an_outage_is_read_just_before_it_ends(case: drives.Case) -> None:
    """By the stamps: from the last heard epoch to the next one and to the reading."""
    done = run(case, SEED)
    assert case.outage_s in (10, 30)
    rows = np.diff(done.epochs[VEHICLE].row_start)
    ends = np.flatnonzero(done.silence_end)
    assert len(ends) == 10
    for end in ends:
        last_heard = np.flatnonzero(rows[:end])[-1]
        silence_ns = done.stamps_ns[end] - done.stamps_ns[last_heard]
        assert silence_ns == case.outage_s * 1_000_000_000
        assert (rows[end], rows[end + 1] > 0) == (0, True)
        assert done.stamps_ns[end + 1] == done.stamps_ns[end]
    result = tallies.tally_drive(done, VEHICLE)
    assert result.n == 604
    error = (done.drives[VEHICLE].nav[:, :3] - done.position)[ends]
    np.testing.assert_allclose(result.outage_m[:, 0], np.hypot(error[:, 0], error[:, 1]))
    np.testing.assert_allclose(result.outage_m[:, 1], np.linalg.norm(error, axis=1))


def test_reading_before_the_end_changes_nothing() -> None:
    """The filter with the added epochs is the filter without them, to the last bit."""
    simulation = drives.simulation_of(deng2022.OUTAGES).with_seed(SEED)
    plain = drives.epochs_of(simulation, deng2022.OUTAGES)
    marked = drives.with_silence_ends(plain)
    ends = drives.silence_ends(marked)
    np.testing.assert_array_equal(marked.stamps_ns[~ends], plain.stamps_ns)
    config = drives.config_of(deng2022.OUTAGES)
    begin = (int(plain.stamps_ns[0]), *drives.started(simulation, deng2022.OUTAGES, config))
    imu, gate = drives.imu_of(simulation), gate_thresholds(config.gate_probability)
    without = drive(*begin, imu, plain, sensors_of(config), gate)
    with_ends = drive(*begin, imu, marked, sensors_of(config), gate)
    np.testing.assert_array_equal(with_ends.nav[~ends], without.nav)
    np.testing.assert_array_equal(with_ends.cov[~ends], without.cov)


def test_the_known_height_is_wrong_by_its_sd() -> None:
    """Over many seeds the prior of the height alone says N(1.5, 3 m), the same at all epochs."""
    simulation, heights = drives.simulation_of(deng2022.BLOCKED), []
    for seed in range(SEED, SEED + 200):
        nothing = Epochs(np.arange(2), np.zeros(3, dtype=np.int64), np.zeros((0, ROW_WIDTH)))
        start = drives.fixes_of(simulation.with_seed(seed), nothing)[FIX_HEIGHT].position
        assert start[0, 2] == start[1, 2]
        heights.append(start[0, 2])
    assert np.mean(heights) == pytest.approx(1.5, abs=3 * 3.0 / np.sqrt(200))
    assert np.std(heights) == pytest.approx(3.0, rel=0.15)


def test_a_fix_starts_on_the_street() -> None:
    """Stations stand 5 to 15 m above the street at 0, which no truth is needed for."""
    simulation = drives.simulation_of(deng2022.OPEN_TOA).with_seed(SEED)
    assert drives.ground_height_m(simulation.rsus) == pytest.approx(0.0, abs=0.7)
    higher = tuple(
        replace(r, position=r.position + np.array([0.0, 0.0, 80.0])) for r in simulation.rsus
    )
    lift = drives.ground_height_m(higher) - drives.ground_height_m(simulation.rsus)
    assert lift == pytest.approx(80.0)


def test_dilution_of_three_stations_by_hand() -> None:
    """Along the axes at 45 degrees up: u = (1, 0, -1)/sqrt 2, (0, 1, -1)/sqrt 2, (-1, 0, -1)/sqrt
    2; two stations are no epoch."""
    rows = np.zeros((5, ROW_WIDTH))
    rows[:3, ORIGIN : ORIGIN + 3] = [[-9.0, 0.0, 9.0], [0.0, -9.0, 9.0], [9.0, 0.0, 9.0]]
    epochs = Epochs(np.arange(2), np.array([0, 3, 5]), rows)
    dilution = drive_bounds.dilution(epochs, np.zeros((2, 3)))
    np.testing.assert_allclose(dilution, [[2.0, 1.0]])


def test_every_cell_has_its_row(monkeypatch: pytest.MonkeyPatch) -> None:
    """All cells of Tables 1 and 2 with the paper's values; without the recording the real rows
    are empty and say why."""
    monkeypatch.setattr(car_drive, "recording", lambda: None)
    with Work(1, SEED, 1) as work:
        outcome = deng2022.reproduce(work)
    assert outcome.notes[0] == drive_rows.ABOUT_COLUMNS
    assert "no recording" in outcome.notes[1]
    rows = {row.name: row for row in outcome.rows}
    assert len(rows) == len(outcome.rows)
    json.dumps([row.ours for row in outcome.rows], allow_nan=False)
    for case, fix, ins in deng2022.TABLES:
        for name, cells in ((FIX, fix), (f"SINS, {LOOSE}", ins), (f"SINS, {VEHICLE}", ins)):
            label = f"{case.name}, {name}"
            cell_rows = [rows[f"{label}: success"]]
            cell_rows += [rows[f"{label}: RMS {axis}"] for axis in ("north", "east", "down")]
            assert tuple(row.paper for row in cell_rows) == cells
            assert all(row.ok is not None for row in cell_rows)
            assert all(row.baseline is not None for row in cell_rows)
            assert all((row.defaults is not None) == (VEHICLE in name) for row in cell_rows)
            for what in ("time not scored", "drives with a 3-D error above 5 m"):
                assert rows[f"{label}: {what}"].ours is not None
    one_way = f"{deng2022.ONE_WAY.name}, SINS, {TIGHT}"
    for axis in ("north", "east", "down"):
        assert rows[f"{one_way}: RMS {axis}"].ours is not None
    beside = rows[f"{deng2022.BLOCKED.name}, SINS, {TIGHT}: RMS north"]
    paper = rows[f"{deng2022.BLOCKED.name}, SINS, {LOOSE}: RMS north"]
    assert (beside.baseline, paper.baseline) == (paper.ours, paper.ours)
    for what in ("position (expected 3)", "clock offset (expected 1)"):
        assert rows[f"{one_way}: NEES of {what}"].ok is not None
    real = [row for row in outcome.rows if row.name.startswith("Real")]
    assert len(real) == 40
    assert all(row.ours is None for row in real)


def test_the_bound_is_kept_and_nearly_reached(tally: dict[str, Tally]) -> None:
    """No unbiased filter is better than its posterior Cramér-Rao bound; the tight one reaches it
    but for chance, and the filter that made it never left the true way."""
    epochs, results = drive_bounds.bound_drives(deng2022.BLOCKED, SEED)
    states = drive_bounds.true_states(
        drives.simulation_of(deng2022.BLOCKED).with_seed(SEED), epochs
    )
    for variant in (TIGHT, VEHICLE):
        assert np.abs(results[variant].nav[:, :3] - states[:, :3]).max() < 0.02
        bound = np.sqrt(
            np.diagonal(results[variant].cov, axis1=1, axis2=2)[:, :2].mean(axis=0).sum()
        )
        ratio = np.hypot(*tally[variant].rms_m[:2]) / bound
        assert 0.8 < ratio < 1.3
    exact = np.diagonal(results[drive_bounds.EXACT].cov, axis1=1, axis2=2)[:, :3].sum()
    assert exact < np.diagonal(results[VEHICLE].cov, axis1=1, axis2=2)[:, :3].sum()


def test_a_reduced_covariance_costs(tally: dict[str, Tally], blocked: Run) -> None:
    plane = {name: np.hypot(*t.rms_m[:2]) for name, t in tally.items()}
    assert plane[LOOSE] < plane[LOOSE_DIAGONAL] < plane[LOOSE_FIXED]
    fixes = blocked.fixes[FIX]
    reduced = drives.reduced_covariances(fixes)
    np.testing.assert_array_equal(reduced[LOOSE_DIAGONAL].cov[:, 0, 0], fixes.cov[:, 0, 0])
    assert not reduced[LOOSE_DIAGONAL].cov[:, 0, 1].any()
    good = fixes.status == FixStatus.CONVERGED
    np.testing.assert_allclose(reduced[LOOSE_FIXED].cov[7], fixes.cov[good].mean(axis=0))


def test_one_way_times_find_the_clock() -> None:
    tallies = tally_seeds(deng2022.ONE_WAY, range(SEED + 2, SEED + 3))
    assert set(tallies) == {FIX, FIX_HEIGHT, TIGHT, VEHICLE, DEFAULT, DEFAULT_VEHICLE}
    error, stated = tallies[TIGHT].clock_ns
    assert stated < 6.0
    assert error == pytest.approx(stated, rel=0.2)
    assert tallies[TIGHT].nees_test(1).consistent
    assert np.hypot(*tallies[TIGHT].rms_m[:2]) < 3.0


def test_the_clock_is_judged_by_its_own_variance() -> None:
    done = run(deng2022.ONE_WAY, SEED + 2)
    drive_tally = tally_seeds(deng2022.ONE_WAY, range(SEED + 2, SEED + 3))[VEHICLE]
    result = done.drives[VEHICLE]
    error, sd = (
        result.nav[:, Nav.CLOCK] - done.clock_m,
        np.sqrt(result.cov[:, Err.CLOCK, Err.CLOCK]),
    )
    assert drive_tally.nees_test(1).mean == pytest.approx(np.mean((error / sd) ** 2))
    to_ns = 1e9 / 299_792_458.0
    assert drive_tally.clock_ns[0] == pytest.approx(to_ns * np.sqrt(np.mean(error**2)))
    assert drive_tally.clock_ns[1] == pytest.approx(to_ns * np.sqrt(np.mean(sd**2)))


def test_smoothing_bridges_outages() -> None:
    """Given what comes after, the error inside is a fraction of the filter's."""
    with Work(1, SEED, 1) as work:
        bounds = drive_bounds.in_outages(work, deng2022.OUTAGES)
    for variant in (TIGHT, VEHICLE):
        filtered, smoothed = (
            np.hypot(*bounds[f"{variant}, {what}"].rms_m[:2]) for what in ("filtered", "smoothed")
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
    rms = {name: tally.plane_m for name, tally in car_drive.station_tally(few, SEED).items()}
    assert rms[VEHICLE] < rms[TIGHT] < 2.0
