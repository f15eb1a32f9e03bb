"""A small campaign of scripts/fuzz.py, and every seed that once failed."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

SCRIPT = Path(__file__).parents[1] / "scripts" / "fuzz.py"


def _load() -> ModuleType:
    spec = importlib.util.spec_from_file_location("fuzz", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


fuzz = _load()


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fuzz.example(tmp_path_factory.mktemp("fuzz"))


def test_small_campaign(bag: Path, tmp_path: Path) -> None:
    walk = fuzz.example(tmp_path, "pedestrian_walk")
    counts = {"messages": 4000, "bags": 48, "contents": 20, "yaml": 60}
    found, failures = fuzz.fuzz(counts, 500, [bag, walk])
    assert not failures
    assert found["messages"].total() == 4000
    assert min(found["messages"][kind] for kind in ("bytes refused", "refused", "taken")) > 100
    assert found["bags"].total() == 48
    assert {what.partition(":")[0] for what in found["bags"]} == set(fuzz.COMMANDS)
    assert found["contents"].total() == 20
    assert {what.partition(":")[0] for what in found["contents"]} == set(fuzz.CONTENT_COMMANDS)
    assert found["yaml"].total() == 60


@pytest.mark.parametrize("seed", [15, 4852])
def test_bags_that_once_failed(bag: Path, seed: int) -> None:
    """15: import of a bag with a damaged chunk. 4852: a description that describes nothing."""
    assert fuzz.one_bag(bag, fuzz.content(bag), seed).endswith((": refused", ": done"))


@pytest.mark.parametrize("seed", [118])
def test_contents_that_once_failed(bag: Path, seed: int) -> None:
    """118: rsus load with a nanosec of more than a second."""
    assert fuzz.one_content(bag, seed).endswith((": refused", ": done"))


@pytest.mark.parametrize("seed", [174, 278, 20560, 32871])
def test_scenarios_that_once_failed(seed: int) -> None:
    """A beacon_interval_s of 1e308, twice; a speed whose square is no number; a list as a key."""
    assert fuzz.one_yaml(seed) == "refused"


def test_the_campaign_sees_what_is_wrong(bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A reader that changes a byte, and one that fails."""
    original = fuzz.content(bag)
    messages, definitions, facts = original
    one = next(iter(messages))
    other = {**messages, (*one[:3], one[3] + b"x"): 1}
    monkeypatch.setattr(fuzz, "content", lambda _: (fuzz.Counter(other), definitions, facts))
    with pytest.raises(fuzz.FuzzError, match="a message is not as it was"):
        fuzz.compare(bag, original)
    monkeypatch.setattr(fuzz, "content", lambda _: (messages, definitions, {"seed": "7"}))
    with pytest.raises(fuzz.FuzzError, match="a definition or a fact"):
        fuzz.compare(bag, original)
    counts, failed = fuzz.campaign("x", range(2), lambda seed: "ok" if seed else 1 // 0)
    assert counts == {"ok": 1, "FAILED": 1}
    assert failed == ["x seed 0: ZeroDivisionError: integer division or modulo by zero"]
