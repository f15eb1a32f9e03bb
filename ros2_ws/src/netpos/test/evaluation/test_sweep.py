"""A scenario under several settings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from netpos.cli.main import app
from netpos.evaluation import evaluate_bag
from netpos.evaluation.sweep import Plan, draw_sweep, means, sweep
from netpos.evaluation.work import Work
from netpos.scenario import load_scenario
from netpos.scenario.offline import simulate_to_bag
from netpos.scenario.replay import replay_bag
from typer.testing import CliRunner

SHORT = {"max_duration_s": (3.0,)}
KEYS = ("max_duration_s", "tracker.hold_s", "measurement.errors.azimuth_sd_deg")
PLAN = Plan("fast_pass", {**SHORT, "tracker.hold_s": (0.0, 0.1), KEYS[2]: (1.0, 4.0)}, skip=5)


@pytest.fixture(scope="module")
def table() -> pd.DataFrame:
    with Work(3, 11, 2) as work:
        return sweep(PLAN, work)


def test_a_row_for_each_setting_and_seed_the_seeds_paired(table: pd.DataFrame) -> None:
    assert len(table) == 4 * 3
    by_setting = table.groupby(list(KEYS))["seed"].apply(list)
    assert len(by_setting) == 4
    assert all(seeds == [11, 12, 13] for seeds in by_setting)
    assert set(table["vue"]) == {"vue_1"}


def test_a_row_is_what_the_commands_give_one_by_one(table: pd.DataFrame, tmp_path: Path) -> None:
    changes = {"max_duration_s": 3.0, "tracker.hold_s": 0.1, KEYS[2]: 4.0}
    simulate_to_bag(load_scenario("fast_pass", 12, changes), tmp_path / "run")
    replay_bag(tmp_path / "run", tmp_path / "track")
    figures = evaluate_bag(tmp_path / "track", skip=5).vues["vue_1"].scored.figures
    (row,) = table[
        (table["seed"] == 12) & (table[KEYS[1]] == 0.1) & (table[KEYS[2]] == 4.0)
    ].to_dict("records")
    assert row["rmse_m"] == figures.rmse_m
    assert row["time_to_first_fix_s"] == figures.initial.time_to_first_fix_s


def test_means_have_intervals_and_count_what_has_no_figure(table: pd.DataFrame) -> None:
    holes = table.copy()
    holes.loc[0, "rmse_m"] = None
    cells = means(holes, KEYS, "rmse_m")
    assert [mean.runs for mean in cells] == [2, 3, 3, 3]
    assert [mean.without for mean in cells] == [1, 0, 0, 0]
    for mean in cells:
        rows = holes[np.logical_and.reduce([holes[k] == v for k, v in mean.setting.items()])]
        assert mean.mean == pytest.approx(rows["rmse_m"].mean())
        assert mean.interval is not None
        assert rows["rmse_m"].min() * (1.0 - 1e-12) <= mean.interval[0]
        assert mean.interval[0] <= mean.mean <= mean.interval[1]
    with pytest.raises(ValueError, match=r"no figure 'rms_m'; known: .*rmse_m"):
        means(table, KEYS, "rms_m")


def test_a_picture_has_a_line_for_each_setting_of_the_other_keys(table: pd.DataFrame) -> None:
    (axes,) = draw_sweep(means(table, (KEYS[1], KEYS[2]), "rmse_m"), "rmse_m").axes
    assert axes.get_xlabel() == KEYS[1]
    assert {text.get_text() for text in axes.get_legend().get_texts()} == {
        f"{KEYS[2]} 1.0",
        f"{KEYS[2]} 4.0",
    }


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_the_command_writes_a_table_and_a_picture(tmp_path: Path, suffix: str) -> None:
    out, plot = tmp_path / f"table{suffix}", tmp_path / "plot.svg"
    run = ("sweep", "fast_pass", "--vary", "max_duration_s=3", "--vary", "tracker.hold_s=0,0.1")
    where = ("--out", str(out), "--plot", str(plot), "--resume", str(tmp_path / "kept"))
    for _ in range(2):
        result = CliRunner().invoke(app, [*run, "--runs", "2", "--skip", "5", *where])
        assert result.exit_code == 0, result.output
    table = pd.read_csv(out) if suffix == ".csv" else pd.read_parquet(out)
    assert list(table["tracker.hold_s"]) == [0.0, 0.0, 0.1, 0.1]
    assert table["rmse_m"].notna().all()
    assert " to " in result.stdout  # the interval
    assert b"tracker.hold_s" in plot.read_bytes()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--vary", "tracker.hold_z=0,1"), "hold_z"),
        (("--vary", "tracker.hold_s=-1"), "hold_s"),
        (("--vary", "no.such=1"), "no: unknown key"),
        (("--vary", "tracker.hold_s"), "--vary takes KEY=A,B,C"),
        (("--vary", "tracker.hold_s=0", "--out", "t.txt"), ".csv or a .parquet"),
        (("--vary", "tracker.hold_s=0", "--plot", "p.jpg"), "p.jpg"),
    ],
)
def test_mistakes_are_reported_before_anything_is_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, ["sweep", "fast_pass", "--out", "t.csv", *arguments])
    assert result.exit_code == 2
    assert words in result.stderr
    assert list(tmp_path.iterdir()) == []
