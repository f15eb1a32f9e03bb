"""``netpos watch`` where there is nothing to watch; with a graph: tests/test_live_view.py."""

from __future__ import annotations

import socket

import pytest
from netpos.cli.main import app
from typer.testing import CliRunner


def run(*arguments: str) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["watch", *arguments])
    return done.exit_code, done.output


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("http://here",), "ws://HOST:PORT"),
        (("localhost:1", "--period", "0"), "--period must be > 0 s, got 0"),
        (("localhost:1", "--once", "--wait", "nan"), "--wait must be > 0 s, got nan"),
    ],
)
def test_bad_usage_is_one_sentence(arguments: tuple[str, ...], words: str) -> None:
    status, said = run(*arguments)
    assert status == 2
    assert words in said
    assert len(said.splitlines()) == 1


def test_a_server_that_is_not_there_is_failed_work() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # and nobody listens
        status, said = run(f"127.0.0.1:{taken.getsockname()[1]}", "--once")
    assert status == 1
    assert "ros2 run netpos_bringup live" in said
    assert len(said.splitlines()) == 1


def test_without_ros_an_address_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    status, said = run("--once")
    assert status == 2
    assert "ros2 is not on PATH" in said
    assert "netpos watch ws://HOST:8765" in said
