"""What a bag says of its run is text: no command opens a file that it names."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import netpos as library
import pytest
from netpos.bags import BagReader, BagWriter

SECRET = "the_hash_of_root"
FACTS = ("scenario", "tracker", "rsus", "fusion")
_opened: list[str] = []
_listening: list[bool] = []


def _hear(event: str, arguments: tuple[Any, ...]) -> None:
    if event == "open" and _listening and isinstance(arguments[0], str | os.PathLike):
        _opened.append(os.fspath(arguments[0]))


sys.addaudithook(_hear)


@contextmanager
def opened() -> Iterator[list[str]]:
    """The files that anything in this process opens meanwhile."""
    _opened.clear()
    _listening.append(True)
    try:
        yield _opened
    finally:
        _listening.clear()


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("paths")
    run = library.Scenario.load("fast_pass", seed=1).simulate(folder / "run")
    run.track(folder / "tracked")
    return folder / "tracked"


@pytest.mark.parametrize("fact", FACTS)
@pytest.mark.parametrize("form", ["{secret}", "file: {secret}", "scenario: {secret}"])
def test_a_file_that_a_bag_names_is_never_opened(
    run: Path, tmp_path: Path, netpos: Any, fact: str, form: str
) -> None:
    secret = tmp_path / "secret.yaml"
    secret.write_text(f"{SECRET}: 1\nseed: 7\n", encoding="utf-8")
    bag = tmp_path / "bag"
    with BagReader(run) as source:
        facts = {**source.metadata, fact: form.format(secret=secret)}
        with BagWriter(bag, metadata=facts) as copy:
            for name, info in source.topics.items():
                copy.add_topic(name, info.type_name, info.qos)
            for entry in source.messages():
                copy.write_raw(entry.topic, entry.type_name, entry.cdr, entry.log_time_ns)
    with opened() as files:
        secret.read_text(encoding="utf-8")
    assert str(secret) in files, "the hook hears nothing"
    for command in (
        ("evaluate", bag, "--json", tmp_path / "figures.json"),
        ("replay", bag, "--out", tmp_path / "out"),
        ("report", bag, "--out", tmp_path / "report.html"),
        ("compare", run, bag),
        ("rsus", "save", bag, tmp_path / "rsus.yaml"),
    ):
        with opened() as files:
            result = netpos(*command)
        assert str(secret) not in files, command
        assert SECRET not in result.output + result.stderr, command
        assert result.exit_code in (0, 2), (command, result.output)
    shutil.rmtree(tmp_path / "out", ignore_errors=True)
    for file in tmp_path.glob("*.html"):
        assert SECRET not in file.read_text(encoding="utf-8")
