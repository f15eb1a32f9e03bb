"""Every real recording that an importer reads keeps the figures of its committed baseline."""

from __future__ import annotations

from pathlib import Path

import pytest
from netpos.evaluation.guard import figures_of, losses, read_baselines
from netpos.evaluation.guarded_runs import RECORDINGS, cases

BASELINES = read_baselines(Path(__file__).parents[5] / "tests" / "baselines")


@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", RECORDINGS)
def test_recording_keeps_its_baseline(name: str) -> None:
    case = cases()[name]
    if case.missing:
        pytest.skip(case.missing)
    left = losses(name, BASELINES[name], figures_of(case))
    assert not left, "\n".join(left)


def test_absent_recordings_say_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("NETPOS_DATA", str(tmp_path))
    for name, (folder, _) in RECORDINGS.items():
        case = cases()[name]
        assert folder in case.missing
        assert "NETPOS_DATA" in case.missing
        assert list(case.materials()) == []
