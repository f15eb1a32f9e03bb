"""Recorded figures: names, targets and verdicts, by files made by hand."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from netpos.evaluation.pages.recorded import Entry, Recorded, number, read_recorded, split_name


def paper(rows: list[dict[str, Any]], runs: int = 20) -> dict[str, Any]:
    return {"paper": "some2000", "runs": runs, "seed": 5, "wall_s": 61.6, "rows": rows}


def row(name: str, ours: float | None, ok: bool | None = None, **more: object) -> dict[str, Any]:
    return {"name": name, "unit": "m", "paper": None, "ours": ours, "ok": ok, **more}


def read(tmp_path: Path, name: str, data: object, full_runs: int = 20) -> Recorded:
    file = tmp_path / f"{name}.json"
    file.write_text(json.dumps(data))
    return read_recorded(file, {"some2000": full_runs})


def entry(recorded: Recorded, name: str) -> Entry:
    (match,) = (e for e in recorded.entries if e.name == name)
    return match


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("Fig. 5, T = 0.1 s: RMSE", ("Fig. 5, T = 0.1 s", "RMSE")),
        ("one: two: three", ("one: two", "three")),
        ("chain, loose: RMSE (paper: live)", ("chain, loose", "RMSE (paper: live)")),
        ("Blocked, tight over loose", ("Blocked, tight over loose", "")),
    ],
)
def test_a_row_is_an_experiment_and_a_figure(name: str, expected: tuple[str, str]) -> None:
    assert split_name(name) == expected


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "–"), (0.12345, "0.123"), (20.0, "20"), (98.5513, "98.6"), (1234.5, "1234"),
     (2.2e-4, "0.00022"), (0.0, "0"), ("a|b", "a\\|b")],
)  # fmt: skip
def test_numbers_have_three_digits(value: float | str | None, text: str) -> None:
    assert number(value) == text


def test_a_target_is_the_bounds_the_paper_or_the_promise(tmp_path: Path) -> None:
    rows = [
        row("A: RMSE", 0.7, False, paper=0.6),
        row("A: NEES, mean (expected 2)", 1.5, False, unit="1"),
        row("A: NEES, lower 95 % bound", 1.97, unit="1"),
        row("A: NEES, upper 95 % bound", 2.03, unit="1"),
        row("B: NEES of position (expected 3)", 3.5, False, unit="1"),
        row("B: NEES of position (expected 3), lower 95 % bound", 2.9, unit="1"),
        row("B: NEES of position (expected 3), upper 95 % bound", 3.1, unit="1"),
        row("A: errors above the level (promised 0.0001)", 1e-3, False, unit="1"),
        row("A: better than before", 3.0, False),
        row("A: shown", 3.0, paper=1.0),
    ]
    recorded = read(tmp_path, "some2000", paper(rows))
    assert [(e.name, e.target) for e in recorded.missed] == [
        ("A: RMSE", "0.6 m"),
        ("A: NEES, mean (expected 2)", "1.97 to 2.03"),
        ("B: NEES of position (expected 3)", "2.9 to 3.1"),
        ("A: errors above the level (promised 0.0001)", "at most 0.0001"),
        ("A: better than before", ""),
    ]
    assert recorded.judged == 5


def test_the_method_names_command_seeds_and_few_runs(tmp_path: Path) -> None:
    data = paper([row("A: RMSE", 1.0, baseline=2.0, defaults=3.0)])
    full = read(tmp_path, "some2000", data, full_runs=20)
    assert "`netpos reproduce some2000 --runs 20 --seed 5` in 62 s" in full.method
    assert "(seeds 5 to 24)" in full.method
    assert "Few runs" not in full.method
    assert "**Few runs:** 20 instead of 21" in read(tmp_path, "some2000", data, 21).method
    assert (full.entries[0].baseline, full.entries[0].defaults) == (2.0, 3.0)


def recording(ours: dict[str, Any], **references: object) -> dict[str, Any]:
    return {"rows": [{"name": "walk", **references, "ours": ours}]}


@pytest.mark.parametrize(
    ("ours", "references", "missed"),
    [
        ({"rmse_m": 0.6}, {"reference": 1.0, "snapshot": 0.6, "plain_ekf": None}, []),
        ({"rmse_m": 0.601}, {"reference": 1.0, "snapshot": 0.6}, [("≤ 0.6", "snapshot")]),
        ({"rmse": 0.7}, {"plain_ekf": {"rmse": 0.65}}, [("≤ 0.65", "plain Kalman filter")]),
        ({"rmse_m": 9.0}, {"reference": None}, []),
        ({"nees_mean": 1.5, "nees_bounds": [1.5, 2.5]}, {}, []),
        ({"nees_mean": 1.49, "nees_bounds": [1.5, 2.5]}, {}, [("1.5 to 2.5", "")]),
        ({"nees_mean": 2.51, "nees_bounds": [1.5, 2.5]}, {}, [("1.5 to 2.5", "")]),
        ({"nees_mean": 2.51, "nees_bounds": None}, {}, []),
        ({"availability": 0.99, "lost_tracks": 0, "protection_exceeded": 1e-4}, {}, []),
        ({"availability": 0.989}, {}, [("≥ 0.99", "")]),
        ({"lost_tracks": 1}, {}, [("≤ 0", "")]),
        ({"protection_exceeded": 1.1e-4}, {}, [("≤ 0.0001", "")]),
    ],
)  # fmt: skip
def test_a_recording_is_judged_at_the_boundaries(
    tmp_path: Path,
    ours: dict[str, Any],
    references: dict[str, Any],
    missed: list[tuple[str, str]],
) -> None:
    targets = read(tmp_path, "real_data", recording(ours, **references)).missed
    assert len(targets) == len(missed)
    for entry_, (target, why) in zip(targets, missed, strict=True):
        assert entry_.target.startswith(target)
        assert why in entry_.target


def test_a_speed_ratio_is_judged_and_what_is_left_out_is_named(tmp_path: Path) -> None:
    measured = {
        "name": "update", "ours": 2.4e-7, "unit": "s", "reference": "FilterPy",
        "reference_value": 3e-5, "ratio": 50.0, "relation": ">=", "target": 60.0, "ok": False,
    }  # fmt: skip
    around = {"machine": "x", "python": "3", "cores": 2, "load_average": [0.4], "quick": True}
    left_out = [{"name": "stonesoup", "reason": "not installed"}]
    data = {"surroundings": around, "rows": [measured], "left_out": left_out}
    recorded = read(tmp_path, "speed", data)
    assert [(e.name, e.ours, e.target) for e in recorded.missed] == [
        ("update, against FilterPy: ratio", 50, "≥ 60")
    ]
    assert entry(recorded, "update, against FilterPy: ours").ours == "0.24 µs"
    assert "**Quick run:**" in recorded.method
    assert "**Not measured here:** stonesoup" in recorded.method


def test_a_walking_row_is_judged_by_its_own_verdict(tmp_path: Path) -> None:
    few = {"ours": {"ok": False, "target": "1 %"}}
    rows = [{"name": "steps", "ours": "9 of 10", "error": "-10 %", "targets": few}]
    recorded = read(tmp_path, "walking", {"rows": rows})
    assert [(e.name, e.ours, e.target) for e in recorded.missed] == [
        ("steps: ours", "9 of 10", "1 %")
    ]
    assert recorded.judged == 1


def test_a_row_may_have_several_targets_of_figures_within(tmp_path: Path) -> None:
    targets = {
        "ratio": {"ok": True, "target": "≤ 1.15"},
        "learned.nees_mean": {"ok": False, "target": "1 to 3"},
    }
    row = {"name": "a", "ratio": 1.1, "learned": {"nees_mean": 4.0}, "targets": targets}
    recorded = read(tmp_path, "error_grid", {"runs": 10, "seed": 5, "rows": [row]})
    assert (
        recorded.method == "Measured by `python scripts/error_grid.py`: 10 runs (seeds 5 to 14)."
    )
    assert [(e.name, e.target) for e in recorded.missed] == [("a: learned.nees_mean", "1 to 3")]
    assert recorded.judged == 2


def test_a_note_is_part_of_the_method(tmp_path: Path) -> None:
    recorded = read(tmp_path, "walking", {"note": "No phone.", "rows": []})
    assert recorded.method == "Measured by `python scripts/pdr_results.py`. No phone."


def test_a_file_of_another_kind_is_refused_with_the_remedy(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"lacks .*'runs'.*scripts/results\.sh some2000"):
        read(tmp_path, "some2000", {"paper": "some2000", "rows": []})
