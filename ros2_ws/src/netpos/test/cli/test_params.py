"""``netpos params``: a description of every parameter, and a file that sets them."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import yaml
from netpos.cli.main import app
from netpos.scenario.settings import settings_from
from netpos.tracking.config import TrackerConfig
from typer.testing import CliRunner


def params(*arguments: object) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["params", *map(str, arguments)])
    return result.exit_code, result.output


def test_every_parameter_is_described() -> None:
    code, said = params()
    assert code == 0
    for entry in fields(TrackerConfig):
        assert f"{entry.name}: {entry.default!r}" in said
        assert entry.metadata["text"] in said


def test_a_word_finds_its_parameters() -> None:
    _, said = params("HOLD_S")
    assert "hold_s: 0.25  (0 to 10)" in said
    assert "integrity_risk" not in said


def test_a_file_sets_what_its_source_says(tmp_path: Path) -> None:
    for source in ("metis_madrid", "pedestrian_rectangle", ""):
        file = tmp_path / f"{source or 'defaults'}.yaml"
        code, said = params("--dump", file, "--from", source)
        assert code == 0
        assert f"--params-file {file}" in said.replace("\n", "")
        values = yaml.safe_load(file.read_text())["/**"]["ros__parameters"]
        settings = settings_from(source)
        assert tuple(values.pop("vues")) == settings.vue_ids
        wanted = TrackerConfig.from_mapping(settings.parameters)
        assert TrackerConfig.from_mapping(values) == wanted
        assert max(map(len, file.read_text().splitlines())) <= 90


def test_a_file_that_is_there_stays(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("mine")
    code, said = params("--dump", file)
    assert code == 2
    assert "exists" in said
    assert file.read_text() == "mine"
