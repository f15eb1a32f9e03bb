"""The notebooks run, and are kept without outputs."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import nbformat
import pytest

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))


@pytest.fixture(name="executed")
def _executed(monkeypatch: pytest.MonkeyPatch) -> Any:
    """What runs a notebook when the site is built."""
    monkeypatch.syspath_prepend(str(ROOT / "scripts" / "site"))
    from notebooks import executed  # noqa: PLC0415

    yield executed
    sys.modules.pop("notebooks", None)


def test_there_are_two() -> None:
    assert [path.stem for path in NOTEBOOKS] == ["arrays_to_track", "sweep_to_plot"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_to_a_picture(path: Path, executed: Any, tmp_path: Path) -> None:
    cells = executed(path, tmp_path).cells
    outputs = [output for cell in cells for output in cell.get("outputs", [])]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert not [output for output in outputs if output.get("name") == "stderr"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_kept_without_outputs(path: Path) -> None:
    kept = nbformat.read(path, as_version=4)
    nbformat.validate(kept)
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in kept.cells)
