"""The first paper: its rows on a few seeds, the same for any number of processes."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from netpos.reproduction import Reproduction, Row, reproduce
from netpos.reproduction.fokin2020.pictures import line_of_sight

RUNS = 8
HEADLINES = (  # with a figure of the paper's own filter and one of the default parameters
    "METIS, N_T = 100, two RSUs: RMSE",
    "METIS, N_T = 500, two RSUs: RMSE",
    "METIS, N_T = 1000, two RSUs: RMSE",
    "METIS, N_T = 500, two RSUs: largest error",
    "METIS, N_T = 500, two RSUs: routes with an error above 5 m or lost",
    "Fig. 5, T = 0.1 s: RMSE between the RSUs",
    "Fig. 5, T = 0.01 s: RMSE between the RSUs",
    "Fig. 6, d_los = 40 m, IMU: RMSE from the turn on",
    "Fig. 6, d_los = 30 m, IMU: RMSE from the turn on",
)


@pytest.fixture(scope="module")
def result() -> Reproduction:
    return reproduce("fokin2020", runs=RUNS, seed=1, workers=1)


def _row(result: Reproduction, name: str) -> Row:
    (row,) = [row for row in result.rows if row.name == name]
    return row


def test_same_rows_on_two_processes(result: Reproduction) -> None:
    assert reproduce("fokin2020", runs=RUNS, seed=1, workers=2).rows == result.rows


def test_names_are_unique(result: Reproduction) -> None:
    names = [row.name for row in result.rows]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize(
    ("name", "unit", "paper"),
    [
        ("METIS, N_T = 100, two RSUs: RMSE", "m", 0.4),
        ("METIS, N_T = 500, two RSUs: RMSE", "m", 0.6),
        ("METIS, N_T = 1000, two RSUs: RMSE", "m", 1.0),
        ("METIS, N_T = 100, one RSU: RMSE", "m", 3.0),
        ("METIS, N_T = 100, two RSUs: clock offset sd", "ns", 4.0),
        ("METIS, N_T = 1000, two RSUs: clock offset sd", "ns", 4.0),
        ("METIS, N_T = 100, one RSU: clock offset sd", "ns", 10.3),
        ("Fig. 5, T = 0.01 s: RMSE between the RSUs", "m", 1.0),
        ("TSP, Fig. 5, T = 0.01 s: position RMSE", "m", 1.0),
        ("TSP, METIS, N_T = 100, two RSUs: heading RMSE", "deg", 1.0),
    ],
)
def test_rows_with_a_target_say_whether_it_is_kept(
    result: Reproduction, name: str, unit: str, paper: float
) -> None:
    row = _row(result, name)
    assert (row.unit, row.paper) == (unit, paper)
    assert row.ours is not None
    assert row.ok is (row.ours <= paper)


@pytest.mark.parametrize("name", HEADLINES)
def test_headlines_have_the_other_columns(result: Reproduction, name: str) -> None:
    row = _row(result, name)
    assert row.baseline is not None
    assert row.defaults is not None
    assert len({row.ours, row.baseline, row.defaults}) > 1


def test_metis_with_two_rsus_is_better_than_the_papers_filter(result: Reproduction) -> None:
    for frames, limit in ((100, 0.4), (500, 0.6), (1000, 1.0)):
        name = f"METIS, N_T = {frames}, two RSUs"
        rmse = _row(result, f"{name}: RMSE")
        assert rmse.ours is not None
        assert rmse.baseline is not None
        assert 0.05 < rmse.ours < rmse.baseline
        assert 0.5 * limit < rmse.baseline < 2.0 * limit  # the scenario is calibrated by it
        mean = _row(result, f"{name}: mean error (eq. 34)").ours
        assert mean is not None
        assert mean < rmse.ours  # the mean of |e| is never above its root mean square


@pytest.mark.parametrize("frames", [100, 500, 1000])
def test_the_strong_signal_is_no_target(result: Reproduction, frames: int) -> None:
    """Its measurements are better than the paper's: shown beside its figures, not judged."""
    name = f"N_T = {frames}, two RSUs: RMSE"
    strong = _row(result, f"METIS, strong signal, {name}")
    calibrated = _row(result, f"METIS, {name}")
    assert (strong.paper, strong.ok) == (calibrated.paper, None)
    for a, b in ((strong.ours, calibrated.ours), (strong.baseline, calibrated.baseline)):
        assert a is not None
        assert b is not None
        assert a < b


def test_every_experiment_says_what_was_lost(result: Reproduction) -> None:
    names = {row.name for row in result.rows}
    experiments = {name.removesuffix(": routes") for name in names if name.endswith(": routes")}
    assert len(experiments) > 15
    for name in experiments:
        lost = _row(result, f"{name}: tracks lost per route").ours
        astray = _row(result, f"{name}: routes with an error above 5 m or lost").ours
        availability = _row(result, f"{name}: availability").ours
        assert lost is not None
        assert astray is not None
        assert availability is not None
        assert lost >= 0.0
        assert astray >= (lost > 0.0) / RUNS
        assert 0.0 < availability <= 1.0


def test_fast_passage_is_several_times_worse_at_ten_times_the_interval(
    result: Reproduction,
) -> None:
    ratio = _row(result, "Fig. 5: RMSE at T = 0.1 s over that at 0.01 s, between the RSUs")
    slow = _row(result, "Fig. 5, T = 0.1 s: RMSE between the RSUs")
    fast = _row(result, "Fig. 5, T = 0.01 s: RMSE between the RSUs")
    assert ratio.ours == pytest.approx(slow.ours / fast.ours)
    assert ratio.baseline == pytest.approx(slow.baseline / fast.baseline)
    assert (ratio.paper, ratio.ok) == (2.0, ratio.ours >= 2.0)


@pytest.mark.parametrize("interval", ["0.1", "0.01"])
def test_convergence_is_judged_and_its_bound_is_shown(result: Reproduction, interval: str) -> None:
    ours = _row(result, f"Fig. 5, T = {interval} s: updates until within 1 m")
    bound = _row(
        result, f"Fig. 5, T = {interval} s: updates until the posterior bound is within 1 m"
    )
    assert ours.paper == 20.0
    assert bound.ours is not None
    assert ours.ok is (ours.ours is not None and ours.ours <= 1.15 * bound.ours)
    assert bound.ours > 1.0
    assert (bound.ok, bound.baseline) == (None, None)


@pytest.mark.parametrize("d_los_m", [40, 30])
def test_the_inertial_sensor_bridges_the_turn(result: Reproduction, d_los_m: int) -> None:
    name = f"Fig. 6, d_los = {d_los_m} m"
    without = _row(result, f"{name}: RMSE from the turn on")
    bridged = _row(result, f"{name}, IMU: RMSE from the turn on")
    assert without.ours is not None
    assert bridged.ours is not None
    assert bridged.ours < 0.7 * without.ours
    assert (without.ok, bridged.ok) == (None, True)


@pytest.mark.parametrize("d_los_m", [40, 30])
def test_a_filter_that_knows_of_turns_turns(result: Reproduction, d_los_m: int) -> None:
    name = f"Fig. 6, d_los = {d_los_m} m"
    straight = _row(result, f"{name}: RMSE from the turn on")
    turning = _row(result, f"{name}, turns told: RMSE from the turn on")
    assert straight.ours is not None
    assert turning.ours is not None
    assert turning.ours < straight.ours


@pytest.mark.parametrize("start", ["", ", start drawn from its covariance"])
@pytest.mark.parametrize("interval", ["0.1", "0.01"])
def test_the_fast_passage_is_held_to_its_bound(
    result: Reproduction, interval: str, start: str
) -> None:
    ratio = _row(result, f"Fig. 5, T = {interval} s{start}: RMSE over bound")
    assert ratio.ours is not None
    assert 0.5 < ratio.ours < 2.0  # eight runs
    assert ratio.ok is (ratio.ours <= 1.15)


def test_line_of_sight_rows_are_those_of_the_table(result: Reproduction) -> None:
    """Table 1 at 30 m, computed by hand; the text's 'over 80 % everywhere outdoors' is false."""
    umi = 18 / 30 + math.exp(-30 / 36) * (1 - 18 / 30)
    assert _row(result, "Table 1, LOS probability at 30 m: UMi").ours == pytest.approx(umi)
    uma = 18 / 30 + math.exp(-30 / 63) * (1 - 18 / 30)
    assert _row(result, "Table 1, LOS probability at 30 m: UMa").ours == pytest.approx(uma)
    rma = _row(result, "Table 1, LOS probability at 30 m: RMa")
    assert rma.ours == pytest.approx(math.exp(-0.02))
    assert rma.ok is True
    lowest = _row(result, "Section 3.2, LOS probability at 30 m: the lowest outdoors")
    assert (lowest.paper, lowest.ours, lowest.ok) == (0.8, pytest.approx(umi), False)


def test_pictures(result: Reproduction, tmp_path: Path) -> None:
    paths = result.outcome.draw(tmp_path / "new")
    assert [path.name for path in paths] == [
        "fig4_line_of_sight.png",
        "fig5_fast_pass.png",
        "fig6_turn.png",
        "metis_madrid.png",
    ]
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in paths)


def test_fig_4_has_the_papers_curves() -> None:
    (axes,) = line_of_sight().axes
    curves = {
        line.get_label(): line.get_xydata() for line in axes.lines if len(line.get_xdata()) > 2
    }
    assert set(curves) == {"UMa", "UMi", "RMa", "InH"}
    assert "distance" in axes.get_xlabel()
    assert "[m]" in axes.get_xlabel()
    assert curves["UMi"][0, 1] == 1.0
    assert (curves["UMi"][:, 1] <= curves["UMa"][:, 1]).all()
