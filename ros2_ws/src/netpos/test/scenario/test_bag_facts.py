"""What a bag says of its run is text: it names no file that is then read, and has limits."""

from __future__ import annotations

from pathlib import Path

import pytest
from netpos.bags import BagError, BagReader, BagWriter
from netpos.evaluation.scene import buildings_of
from netpos.scenario.load import load_scenario, scenario_text
from netpos.scenario.settings import bag_settings

BOMB = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]\n" for k in range(1, 12)
)


def bag_of(tmp_path: Path, **facts: str) -> BagReader:
    with BagWriter(tmp_path / "bag", metadata=facts):
        pass
    return BagReader(tmp_path / "bag")


def test_a_fact_that_is_a_path_reads_no_file(tmp_path: Path) -> None:
    """The file would be understood: as a fact its text has buildings."""
    secret = tmp_path / "secret.yaml"
    secret.write_text(scenario_text(load_scenario("metis_madrid")))
    with bag_of(tmp_path, scenario=str(secret), tracker=str(secret)) as bag:
        assert len(buildings_of(bag)) == 0
        with pytest.raises(BagError, match="'tracker' is not a mapping of parameters") as refused:
            bag_settings(bag)
    assert "metis" not in str(refused.value)
    (tmp_path / "second").mkdir()
    with bag_of(tmp_path / "second", scenario=secret.read_text()) as bag:
        assert len(buildings_of(bag)) > 0


def test_aliases_in_facts_are_not_followed_for_ever(tmp_path: Path) -> None:
    with bag_of(tmp_path, scenario=BOMB, tracker=BOMB) as bag:
        assert len(buildings_of(bag)) == 0
        with pytest.raises(BagError, match="more than 1000000 values, aliases followed"):
            bag_settings(bag)
