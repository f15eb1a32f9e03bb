"""The examples in the help: every command has one, and every one is understood."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from typing import Any

import pytest
from netpos.cli.examples import EXAMPLES
from netpos.cli.main import app
from typer.main import get_command
from typer.testing import CliRunner


def leaves(command: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Commands that do something, by their words after ``netpos``."""
    inner = getattr(command, "commands", None)
    if inner is None:
        yield name, command
        return
    for word, below in inner.items():
        yield from leaves(below, f"{name} {word}".strip())


COMMANDS = dict(leaves(get_command(app)))


def test_every_command_has_an_example_and_nothing_else_has() -> None:
    assert set(EXAMPLES) == set(COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
def test_the_help_shows_examples_that_are_understood(name: str) -> None:
    shown = CliRunner().invoke(app, [*name.split(), "-h"], env={"COLUMNS": "400"}).stdout
    for example in EXAMPLES[name]:
        assert example in shown
        words = shlex.split(example)
        assert words[: 1 + len(name.split())] == ["netpos", *name.split()]
        COMMANDS[name].make_context(name, words[1 + len(name.split()) :])


def test_a_word_that_the_command_does_not_know_would_be_noticed() -> None:
    with pytest.raises(Exception, match="--frobnicate"):
        COMMANDS["run"].make_context("run", ["fast_pass", "--frobnicate"])
