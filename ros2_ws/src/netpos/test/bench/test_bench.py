"""The benchmark's arithmetic, parts and JSON; never how fast something is."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
from netpos import bench as package
from netpos.bench import ONLY_ASKED, PARTS, as_json, bench, chosen
from netpos.bench.common import (
    LeftOut,
    Row,
    Unavailable,
    faster,
    growth_exponent,
    side_by_side,
    within,
)
from netpos.cli.main import app
from netpos.cli.results import bench_remarks
from netpos.common.quantity import quantity
from typer.testing import CliRunner

ROW_KEYS = {
    "name",
    "ours",
    "unit",
    "reference",
    "reference_value",
    "ratio",
    "relation",
    "target",
    "note",
    "ok",
}


@pytest.mark.parametrize(("ours", "ok"), [(1.0, True), (2.0, True), (2.1, False)])
def test_faster_wants_the_reference_to_take_longer(ours: float, ok: bool) -> None:
    row = faster("f", ours, "theirs", 120.0, 60.0)
    assert row.ratio == pytest.approx(120.0 / ours)
    assert row.ok is ok


@pytest.mark.parametrize(("ours", "ok"), [(2.9, True), (3.0, True), (3.1, False)])
def test_within_wants_ours_to_stay_below(ours: float, ok: bool) -> None:
    row = within("f", ours, "theirs", 2.0, 1.5)
    assert row.ratio == pytest.approx(ours / 2.0)
    assert row.ok is ok


@pytest.mark.parametrize("make", [faster, within])
def test_what_is_not_a_number_is_not_ok(make: Any) -> None:
    assert not make("f", math.nan, "theirs", 2.0, 1.5).ok


@pytest.mark.parametrize("exponent", [0.5, 1.0, 2.0])
def test_exponent_of_a_power_law(exponent: float) -> None:
    sizes = [25, 50, 100]
    assert growth_exponent(sizes, [0.3 * n**exponent for n in sizes]) == pytest.approx(exponent)


def test_exponent_needs_costs_above_zero() -> None:
    with pytest.raises(ValueError, match="must be > 0"):
        growth_exponent([1, 2], [0.1, -0.1])


def test_operations_take_turns_after_one_call_that_is_not_timed() -> None:
    calls: list[str] = []
    cost = side_by_side(
        {"a": (lambda: calls.append("a"), 1), "b": (lambda: calls.append("b"), 10)}, 2
    )
    assert "".join(calls) == "ab" * 3
    assert set(cost) == {"a", "b"}
    assert all(0.0 < seconds < math.inf for seconds in cost.values())


def test_seconds_are_per_operation(monkeypatch: pytest.MonkeyPatch) -> None:
    ticks = iter([0.0, 6.0, 10.0, 14.0])
    monkeypatch.setattr("netpos.bench.common.time.perf_counter", lambda: next(ticks))
    assert side_by_side({"a": (lambda: None, 2)}, 2) == {"a": 2.0}


def test_parts_keep_their_order_and_unknown_ones_are_named() -> None:
    assert chosen([]) == [name for name in PARTS if name not in ONLY_ASKED]
    assert chosen(["soak"]) == ["soak"]
    assert chosen(["load", "ekf"]) == ["ekf", "load"]
    with pytest.raises(ValueError, match=r"'speed'.*ekf, srukf"):
        chosen(["speed"])


@pytest.mark.parametrize("part", PARTS)
def test_every_part_names_a_function_that_exists(part: str) -> None:
    module, function = PARTS[part]
    source = Path(str(package.__file__)).with_name(f"{module}.py").read_text()
    assert f"def {function}(quick: bool)" in source


def replace(monkeypatch: pytest.MonkeyPatch, part: str, measure: Any) -> None:
    monkeypatch.setattr("netpos.bench.common.measure", measure, raising=False)
    monkeypatch.setitem(PARTS, part, ("common", "measure"))


def no_rows(quick: bool) -> list[Any]:
    raise Unavailable(f"there is no clock, quick or not ({quick}).")


def test_a_part_that_cannot_be_measured_gives_its_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    replace(monkeypatch, "ekf", no_rows)
    reason = "there is no clock, quick or not (True)."
    assert list(bench(["ekf"], quick=True)) == [("ekf", [LeftOut("ekf", reason)])]


def test_json_has_all_of_a_row_and_what_was_left_out() -> None:
    row = within("f", 1.0, "theirs", 2.0, 1.5, unit="MB", note="n")
    figures = as_json([row, LeftOut("g", "no compiler.")], {"cores": 2})
    assert figures["surroundings"] == {"cores": 2}
    assert figures["left_out"] == [{"name": "g", "reason": "no compiler."}]
    (written,) = figures["rows"]
    assert set(written) == ROW_KEYS
    assert written["ok"] is True
    assert written["ratio"] == 0.5
    assert written["unit"] == "MB"


def test_command_writes_the_chosen_part(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    asked: list[bool] = []

    def measure(quick: bool) -> list[Any]:
        asked.append(quick)
        return [faster("f", 1e-6, "theirs", 1e-3, 60.0), LeftOut("g", "no compiler.")]

    replace(monkeypatch, "srukf", measure)
    file = tmp_path / "ratios.json"
    result = CliRunner().invoke(app, ["bench", "--only", "srukf", "--quick", "--json", str(file)])
    assert result.exit_code == 0, result.output
    assert asked == [True]
    assert "left out: g: no compiler." in result.output
    figures = json.loads(file.read_text())
    assert [row["ratio"] for row in figures["rows"]] == [pytest.approx(1000.0)]
    assert figures["surroundings"]["quick"] is True


def test_command_refuses_an_unknown_part() -> None:
    result = CliRunner().invoke(app, ["bench", "--only", "speed"])
    assert result.exit_code == 2
    assert "the parts are ekf" in result.output


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (4.2e-7, "s", "0.42 µs"),
        (0.0042, "s", "4.2 ms"),
        (42.0, "s", "42 s"),
        (0.42, "MB", "0.42 MB"),
        (1.0, "", "1"),
    ],
)
def test_quantities_read_well(value: float, unit: str, text: str) -> None:
    assert quantity(value, unit) == text


def test_remarks_are_notes_and_reasons() -> None:
    rows = [
        faster("f", 1.0, "theirs", 2.0, 1.0),
        faster("g", 1.0, "theirs", 2.0, 1.0, note="warm."),
        LeftOut("h", "no compiler."),
    ]
    assert bench_remarks(rows) == ["g: warm.", "left out: h: no compiler."]
    assert isinstance(rows[0], Row)
