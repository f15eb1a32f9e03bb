"""Files the command line writes: no recording is touched, and a bad place is told at once."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from netpos.bags import BagWriter, codec
from netpos.messages.values import Field, RsuInfo, RsuMeasurement
from typer.testing import Result

Netpos = Callable[..., Result]


def test_figures_never_replace_a_recording(netpos: Netpos, bag: Path) -> None:
    (storage,) = bag.glob("*.mcap")
    before = storage.read_bytes()
    for place in (storage, bag / "metadata.yaml", bag / "new.json"):
        result = netpos("evaluate", bag, "--json", place)
        assert result.exit_code == 2
        assert "is inside a recording, and recordings are never changed" in result.stderr
    assert netpos("report", bag, "--out", storage).exit_code == 2
    assert storage.read_bytes() == before
    assert sorted(p.name for p in bag.iterdir()) == ["metadata.yaml", storage.name]


def test_figures_replace_figures_and_nothing_else(
    netpos: Netpos, bag: Path, tmp_path: Path
) -> None:
    scenario, figures = tmp_path / "own.yaml", tmp_path / "new/figures.json"
    scenario.write_text("name: mine")
    result = netpos("evaluate", bag, "--json", scenario)
    assert result.exit_code == 2
    assert f"{scenario} exists and is no .json file" in result.stderr
    assert scenario.read_text() == "name: mine"
    for _ in range(2):
        assert netpos("evaluate", bag, "--json", figures).exit_code == 0
        assert json.loads(figures.read_text())


@pytest.mark.parametrize(
    ("command", "work"),
    [
        (("reproduce", "fokin2020"), "netpos.reproduction.reproduce"),
        (("bench",), "netpos.bench.bench"),
    ],
)
def test_a_folder_for_figures_is_told_before_the_work(
    netpos: Netpos, tmp_path: Path, monkeypatch: Any, command: tuple[str, ...], work: str
) -> None:
    done: list[object] = []
    monkeypatch.setattr(work, lambda *a, **k: done.append(a))
    result = netpos(*command, "--json", tmp_path)
    assert result.exit_code == 2
    assert "is a folder" in result.stderr
    assert done == []


def test_ctrl_c_is_one_word(netpos: Netpos, bag: Path, monkeypatch: Any) -> None:
    def interrupted(*_: Any, **__: Any) -> SimpleNamespace:
        raise KeyboardInterrupt

    monkeypatch.setattr("netpos.evaluation.assess_bag", interrupted)
    result = netpos("evaluate", bag)
    assert result.exit_code == 130
    assert result.stderr == "netpos: interrupted\n"


def test_report_tells_of_a_recording_without_metadata(
    netpos: Netpos, bag: Path, tmp_path: Path
) -> None:
    crashed = tmp_path / "crashed"
    crashed.mkdir()
    (storage,) = bag.glob("*.mcap")
    (crashed / storage.name).write_bytes(storage.read_bytes()[:-2000])
    result = netpos("report", tmp_path, "--out", tmp_path / "all.html")
    assert "crashed" in result.stderr
    assert "1 of 2 bags" in result.stdout


def test_a_replay_without_estimates_says_so(netpos: Netpos, tmp_path: Path) -> None:
    with BagWriter(tmp_path / "in", metadata={"tracker": "{}"}) as writer:
        known = RsuInfo(rsu_id="a", position=np.zeros(3), stamp_ns=1)
        writer.write("/rsu/info", codec().rsu_info_to_msg(known), 1)
        measured = RsuMeasurement(
            stamp_ns=1, rsu_id="nobody", vue_id="v", fields=Field.RANGE, range_m=1.0, range_var=1.0
        )
        writer.write("/rsu/measurements", codec().measurement_to_msg(measured), 1)
    result = netpos("replay", tmp_path / "in", "--out", tmp_path / "out")
    assert result.exit_code == 0
    assert "out has no estimate" in result.stderr
    assert "unknown_rsu 1" in result.stdout
