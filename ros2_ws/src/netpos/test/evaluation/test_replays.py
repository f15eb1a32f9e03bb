"""Several bags tracked anew."""

from __future__ import annotations

from pathlib import Path

import pytest
from netpos.bags import BagReader
from netpos.cli.main import app
from netpos.messages import topics
from netpos.scenario import load_scenario
from netpos.scenario.offline import simulate_to_bag
from netpos.scenario.replay import replay_bag
from typer.testing import CliRunner, Result


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("bags")
    paths = []
    for seed in (1, 2, 3):
        paths.append(folder / f"run_{seed}")
        simulate_to_bag(load_scenario("fast_pass", seed, {"max_duration_s": 2.0}), paths[-1])
    return paths


def replay(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["replay", *map(str, arguments)])


def estimates(bag: Path) -> list[bytes]:
    with BagReader(bag) as reader:
        return [entry.cdr for entry in reader.messages([topics.of_vue("vue_1", "odometry")])]


@pytest.mark.parametrize("where", [("--workers", 2), ("--cluster", "local")])
def test_each_track_is_that_of_its_own_replay(
    bags: list[Path], tmp_path: Path, where: tuple[str, object]
) -> None:
    result = replay(*bags, "--out", tmp_path / "tracks", *where)
    assert result.exit_code == 0, result.output
    assert "3 of 3 bags tracked" in result.stdout
    for bag in bags:
        replay_bag(bag, tmp_path / bag.name)
        assert estimates(tmp_path / "tracks" / bag.name) == estimates(tmp_path / bag.name)


def test_it_goes_on_where_it_stopped(bags: list[Path], tmp_path: Path) -> None:
    first = replay(*bags[:2], "--out", tmp_path, "--workers", 1)
    assert first.exit_code == 0, first.output
    written = (tmp_path / "run_1" / "run_1_0.mcap").stat().st_mtime_ns
    second = replay(*bags, "--out", tmp_path, "--workers", 1)
    assert "1 of 3 bags tracked, 2 existed already" in second.stdout
    assert (tmp_path / "run_1" / "run_1_0.mcap").stat().st_mtime_ns == written
    other = replay(*bags, "--out", tmp_path, "--workers", 1, "--set", "hold_s=0.5")
    assert other.exit_code == 2
    assert "tracked with other parameters" in other.stderr


def test_one_that_cannot_be_tracked_leaves_the_others(bags: list[Path], tmp_path: Path) -> None:
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
    result = replay(*bags[:2], broken, "--out", tmp_path / "tracks", "--workers", 1)
    assert result.exit_code == 1
    assert "2 of 3 bags tracked, 0 existed already, 1 refused" in result.stdout
    assert "broken" in result.stderr


def test_two_bags_of_one_name_are_refused(bags: list[Path], tmp_path: Path) -> None:
    result = replay(bags[0], bags[0], "--out", tmp_path / "tracks")
    assert result.exit_code == 2
    assert "2 bags are called run_1" in result.stderr
