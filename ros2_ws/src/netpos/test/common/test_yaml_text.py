"""YAML of others: read as the safe loader reads it, or refused at once."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from netpos.bags import BagWriter, codec
from netpos.cli.main import app
from netpos.common.yaml_text import DEPTH_MAX, YamlError, load_yaml
from typer.testing import CliRunner

# Nine lines that describe 10^9 values.
BOMB = "a0: &a0 [0, 0, 0, 0, 0, 0, 0, 0, 0, 0]\n" + "".join(
    f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]\n" for k in range(1, 9)
)
DEEP = "[" * 100_000
TEXTS = {
    "bomb": (BOMB, "more than 1000000 values"),
    "deep": (DEEP, f"nested deeper than {DEPTH_MAX}"),
    "itself": ("a: &a [1, *a]", r"\*a is a part of itself"),
    "object": ("a: !!python/object/apply:os.getcwd []", "could not determine a constructor"),
    "date": ("a: 2026-13-45", "month must be in 1..12"),
    "large": ("a: " + "x" * 17 * 1024**2, "characters; at most"),
    "cut": ("a: [1, ", "not valid YAML"),
}

plain = st.none() | st.booleans() | st.integers(-(10**9), 10**9) | st.text(max_size=8)
nested = st.recursive(
    plain,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=30,
)


@given(nested)
def test_it_reads_what_the_safe_loader_reads(value: object) -> None:
    text = yaml.safe_dump(value)
    assert load_yaml(text) == yaml.safe_load(text)


def test_aliases_and_types() -> None:
    text = "a: &x [1, 2.5, null, true, '1', 2026-01-01]\nb: {c: .inf, d: *x, e: *x}"
    assert load_yaml(text) == yaml.safe_load(text)


@pytest.mark.timeout(60)
@pytest.mark.parametrize("name", TEXTS)
def test_what_is_refused_does_not_hang(name: str) -> None:
    text, words = TEXTS[name]
    with pytest.raises(YamlError, match=words):
        load_yaml(text)


def test_the_error_names_the_line() -> None:
    with pytest.raises(YamlError, match=r"^line 3: "):
        load_yaml("a: 1\nb: 2\nc: [1, }\n")


@pytest.mark.parametrize("name", ["bomb", "deep", "object", "date"])
@pytest.mark.timeout(120)
def test_commands_answer_with_one_sentence(name: str, tmp_path: Path) -> None:
    """A scenario, the metadata of a bag, and what a bag says of its tracker."""
    text, _ = TEXTS[name]
    scenario = tmp_path / "bad.yaml"
    scenario.write_text(f"seed: 1\n{text}\n", encoding="utf-8")
    bag_dir = tmp_path / "said"
    with BagWriter(bag_dir, metadata={"tracker": text}) as bag:
        bag.write("/rsu/measurements", codec().clock_to_msg(1), 1)
    inside = tmp_path / "inside"
    shutil.copytree(bag_dir, inside)
    whole = (inside / "metadata.yaml").read_text(encoding="utf-8")
    (inside / "metadata.yaml").write_text(f"{text}\n{whole}", encoding="utf-8")
    for command in (
        ("run", scenario, "--offline", "--bag", tmp_path / "out"),
        *(("evaluate", bag) for bag in (bag_dir, inside)),
        *(("replay", bag, "--out", tmp_path / "out") for bag in (bag_dir, inside)),
        *(("report", bag, "--out", tmp_path / "r.html") for bag in (bag_dir, inside)),
    ):
        result = CliRunner().invoke(app, list(map(str, command)))
        assert result.exit_code == 2, (command, result.output, result.exception)
        assert result.stderr.startswith("netpos: "), command
    assert not (tmp_path / "out").exists()
