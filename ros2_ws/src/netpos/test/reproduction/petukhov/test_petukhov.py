"""petukhov: a few seeds of each experiment, and what the rows are made of."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from netpos.evaluation.consistency import MeanTest
from netpos.evaluation.work import Work
from netpos.reproduction.frame import Row, shown
from netpos.reproduction.petukhov import paper as petukhov
from netpos.reproduction.petukhov import rectangle
from netpos.reproduction.petukhov.sector_choice import (
    AREA_M,
    STEPS,
    Conditions,
    SectorShares,
    sector_choice,
    setup_of,
)
from netpos.reproduction.petukhov.walk_bound import known_instants_rmse_m
from netpos.reproduction.petukhov.walk_figures import Figures
from netpos.tracking.config import TrackerConfig

SEED = 7000
PAPER_LONG = petukhov.paper_s(petukhov.LONG)


@pytest.fixture(scope="module")
def walks() -> dict[rectangle.Case, Figures]:
    cases = (petukhov.LONG, petukhov.SHORT, PAPER_LONG, petukhov.HIDDEN)
    with Work(6, SEED, 1) as work:
        return {case: petukhov.figures_of(work, case) for case in cases}


def test_a_long_baseline_is_more_than_twice_as_good(
    walks: dict[rectangle.Case, Figures],
) -> None:
    long, short = walks[petukhov.LONG], walks[petukhov.SHORT]
    assert 0.01 < long.rmse_m < 0.03
    assert short.rmse_m > 2.0 * long.rmse_m
    assert long.lost == short.lost == 0
    assert 1.0 < long.nees.mean < 2.5


def test_a_run_of_equal_steps_keeps_its_speed(
    walks: dict[rectangle.Case, Figures],
) -> None:
    """The same without looking at steadiness is a tenth worse, and both stay above the bound."""
    free = rectangle.Case(
        name="free", wavelengths=4.0, tracker=(("steady_accel_density_mps2_sqrthz", 0.0),)
    )
    with Work(6, SEED, 1) as work:
        worse = petukhov.figures_of(work, free)
    assert walks[petukhov.LONG].rmse_m < 0.93 * worse.rmse_m
    bound = known_instants_rmse_m(rectangle.setup_of(petukhov.LONG), petukhov.DECIDED_S)
    assert bound < walks[petukhov.LONG].rmse_m


def test_the_paper_s_scheme_knows_too_much_of_itself(
    walks: dict[rectangle.Case, Figures],
) -> None:
    """Errors of a step taken as white: worse, and far surer."""
    paper, ours = walks[PAPER_LONG], walks[petukhov.LONG]
    assert paper.nees.mean > 2.0 * ours.nees.mean


def test_a_hidden_anchor_is_missed_while_it_is_hidden(
    walks: dict[rectangle.Case, Figures],
) -> None:
    hidden = walks[petukhov.HIDDEN]
    times = rectangle.setup_of(petukhov.HIDDEN).times_s
    gone = (times >= 13.0) & (times < 15.0)
    back = times >= 17.0
    assert 0.05 < np.sqrt(hidden.error2[:, gone].mean(axis=0)).max() < 0.5
    assert np.sqrt(hidden.error2[:, back].mean(axis=0)).max() < 0.1
    assert hidden.lost == 0


def test_the_truth_of_the_rectangle() -> None:
    setup = rectangle.setup_of(petukhov.LONG)
    rows = list(petukhov._walk(setup))
    assert all(row.ok for row in rows)
    assert setup.truth.min(axis=0).tolist() == [-2.85, 1.5]
    np.testing.assert_allclose(setup.truth.max(axis=0), [2.85, 6.0])


def test_hidden_epochs_hold_no_radio() -> None:
    setup = rectangle.setup_of(petukhov.HIDDEN)
    assert setup.times_s[~setup.heard].min() == pytest.approx(10.0)
    assert setup.times_s[~setup.heard].max() == pytest.approx(14.9)


def test_starts_and_ends_stay_in_the_area() -> None:
    with Work(12, SEED, 1) as work:
        choice = sector_choice(work, petukhov.TARGET)
    assert choice.right.shape == (12, STEPS)
    assert choice.share_right(5) >= 0.9
    assert choice.share_right(1) > choice.rule_share
    assert setup_of(Conditions(defaults=True)).config == TrackerConfig(device_height_m=1.0)
    assert (choice.claimed > 0.1).all()
    assert AREA_M[0][1] > 0.0


def test_measurements_of_a_start_are_those_of_its_conditions() -> None:
    conditions = Conditions(wavelengths=8.0, phase_sd_deg=12.0)
    setup, rng = setup_of(conditions), np.random.default_rng(1)
    places = np.tile([1.0, 3.0], (4000, 1))
    rows, turns = setup.measured(rng, places)
    unwrapped = rows[:, 1, 1] + 2 * np.pi * turns
    assert np.abs(rows[:, 1, 1]).max() <= np.pi
    expected = 2 * np.pi * 8.0 * np.sin(np.arctan2(1.0, 3.0))
    assert unwrapped.mean() == pytest.approx(expected, abs=0.02)
    assert unwrapped.std() == pytest.approx(np.radians(12.0), rel=0.05)
    ranged = np.hypot(1.0 - setup.info.baseline_m / 2, 3.0)
    assert rows[:, 0, 1].mean() == pytest.approx(ranged, abs=2e-3)
    assert rows[:, 0, 1].std() == pytest.approx(0.03, rel=0.05)


def test_shares_count_runs() -> None:
    right = np.array([[True, True], [False, True], [True, False], [True, True]])
    decided = np.array([[True, True], [True, True], [False, True], [False, False]])
    choice = SectorShares(right, decided, right.astype(float), ~right)
    assert choice.share_right(1) == 0.75
    assert choice.share_decided(2) == 0.75
    assert (choice.share_wrong(1), choice.share_wrong(2)) == (0.25, 0.25)
    assert choice.rule_share == 0.25


def figures(rmse_m: float, nees: float) -> Figures:
    """Five instants of one run with the same error."""
    return Figures(
        runs=1,
        rmse_m=rmse_m,
        error_max_m=rmse_m,
        nees=MeanTest(mean=nees, bounds=(1.8, 2.2), n_eff=100.0),
        decided_s=(1.0, 1.0),
        unscored=0.0,
        lost=0,
        error2=np.full((1, 5), rmse_m**2),
    )


@pytest.mark.parametrize(
    ("rmse_m", "nees", "rmse_ok", "ratio_ok", "nees_ok"),
    [(0.031, 1.9, False, False, True), (0.029, 2.3, True, True, False)],
)
def test_rows_miss_their_target_where_they_should(
    rmse_m: float, nees: float, rmse_ok: bool, ratio_ok: bool, nees_ok: bool
) -> None:
    """The NEES is two-sided: 1.7 is refused, too."""
    long = petukhov.Compared(
        ours=figures(rmse_m, nees), paper=figures(0.06, 6.0), defaults=figures(0.02, 2.0)
    )
    short = petukhov.Compared(ours=figures(0.06, 1.7), paper=None, defaults=figures(0.05, 2.0))
    rows = {row.name: row for row in petukhov._baselines(long, short)}
    rmse = rows["L = 4 lambda: RMSE"]
    assert (rmse.ok, rmse.baseline, rmse.defaults) == (rmse_ok, 0.06, 0.02)
    ratio = rows["RMSE of lambda/2 over that of 4 lambda, at the same instants"]
    assert (ratio.ok, ratio.baseline) == (ratio_ok, None)
    assert ratio.defaults == pytest.approx(2.5)
    assert rows["L = 4 lambda: NEES, mean (expected 2)"].ok is nees_ok
    assert rows["L = lambda/2: NEES, mean (expected 2)"].ok is False


def test_every_row_that_no_causal_system_reaches_says_so() -> None:
    row = shown("RMSE", "m", 1.0).beside(2.0, 3.0)
    (labelled,) = petukhov._during([row])
    assert labelled.name == "RMSE; step velocities during the step they describe"
    assert labelled == Row(
        name=labelled.name, unit="m", paper=None, ours=1.0, ok=None, baseline=2.0, defaults=3.0
    )


def test_a_wrong_sector_has_no_column_of_the_paper() -> None:
    case = petukhov.TROUBLES[-1]
    assert case.trouble.wrong_s is not None
    with Work(1, SEED, 1) as work:
        assert petukhov.compared(work, case).paper is None
        assert petukhov.compared(work, petukhov.TROUBLES[0]).paper is not None


def test_defaults_keep_facts_only() -> None:
    ours, defaults = (
        rectangle.setup_of(case).config
        for case in (petukhov.LONG, petukhov.by_default(petukhov.LONG))
    )
    assert defaults == TrackerConfig(device_height_m=1.0)
    assert ours.velocity_correlation_s > defaults.velocity_correlation_s == 0.0


def test_pictures_are_drawn(tmp_path: Path) -> None:
    with Work(2, SEED, 1) as work:
        walked = {c: petukhov.compared(work, c) for c in (petukhov.LONG, petukhov.SHORT)}
    some = SectorShares(
        *(np.ones((2, STEPS), dtype=bool) for _ in range(2)),
        np.ones((2, STEPS)),
        np.ones((2, STEPS), dtype=bool),
    )
    conditions = (petukhov.TARGET, *petukhov.BY_BASELINE, *petukhov.BY_PHASE)
    paths = petukhov._draw(SEED, walked, dict.fromkeys(conditions, some), tmp_path)
    names = {path.stem for path in paths}
    assert names == {"fig7_residuals", "fig8_tracks", "fig9_errors", "sectors"}
    assert all(path.stat().st_size > 10_000 for path in paths)
