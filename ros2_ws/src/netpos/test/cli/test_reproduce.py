"""``netpos reproduce``: exit status, messages, files."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
from netpos.evaluation.work import Work
from netpos.reproduction import frame
from netpos.reproduction.frame import Outcome, at_most, shown
from typer.testing import Result

Netpos = Callable[..., Result]


def _seeds(offset: int, seeds: range) -> int:
    return sum(seeds) + offset


def _die(_: int, seeds: range) -> int:
    os._exit(3)


@pytest.fixture
def paper(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """A paper with one job; ``job`` may be replaced."""

    def reproduce(work: Work) -> Outcome:
        total = sum(work.over_seeds("all seeds", module.job, 0))
        rows = (at_most("sum [of seeds]", "1", total, 10.0), shown("untold", "m", None))
        return Outcome(rows=rows, draw=_draw)

    module = SimpleNamespace(job=_seeds, warm_up=lambda: None, reproduce=reproduce)
    monkeypatch.setitem(frame.PAPERS, "some2026", "some.module")
    monkeypatch.setattr(frame, "import_module", {"some.module": module}.__getitem__)
    return module


def _draw(folder: Path) -> list[Path]:
    folder.mkdir()
    (folder / "fig1.png").write_bytes(b"picture")
    return [folder / "fig1.png"]


@pytest.mark.parametrize("workers", [1, 2])
def test_rows_json_and_pictures(
    netpos: Netpos, paper: SimpleNamespace, tmp_path: Path, workers: int
) -> None:
    file, folder = tmp_path / "new" / "rows.json", tmp_path / "pictures"
    options = ("--runs", 4, "--seed", 2, "--workers", workers, "--json", file, "--out", folder)
    result = netpos("reproduce", "some2026", *options)
    assert result.exit_code == 0, result.output
    content = json.loads(file.read_text())
    assert content.keys() == {"paper", "runs", "seed", "wall_s", "rows"}
    assert (content["paper"], content["runs"], content["seed"]) == ("some2026", 4, 2)
    beside = {"baseline": None, "defaults": None}
    assert content["rows"] == [
        {"name": "sum [of seeds]", "unit": "1", "paper": 10.0, "ours": 14, "ok": False} | beside,
        {"name": "untold", "unit": "m", "paper": None, "ours": None, "ok": None} | beside,
    ]
    row = next(line for line in result.stdout.splitlines() if "sum [of seeds]" in line)
    assert [cell.strip() for cell in row.split("│")[2:8]] == [*("1", "10", "–", "14", "–", "NO")]
    assert f"wrote {folder / 'fig1.png'}" in result.stdout.replace("\n", "")
    assert "all seeds" in result.stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("none1999",), ("no paper 'none1999'", "known: ", "fokin2020")),
        (("fokin2020", "--runs", 0), ("runs must be at least 1",)),
        (("fokin2020", "--workers", 0), ("workers must be at least 1",)),
        (("fokin2020", "--seed", -3), ("seed must be at least 0",)),
        (("fokin2020", "--out", __file__), ("is a file; give a folder",)),
    ],
)
def test_bad_usage(netpos: Netpos, arguments: tuple[object, ...], words: tuple[str, ...]) -> None:
    result = netpos("reproduce", *arguments)
    assert result.exit_code == 2, result.output
    assert result.stderr.count("\n") == 1
    for word in words:
        assert word in result.stderr


def test_a_dead_worker_is_failed_work(netpos: Netpos, paper: SimpleNamespace) -> None:
    paper.job = _die
    result = netpos("reproduce", "some2026", "--runs", 20, "--workers", 2)
    assert result.exit_code == 1
    assert "a worker process died" in result.stderr
    assert "Traceback" not in result.output
