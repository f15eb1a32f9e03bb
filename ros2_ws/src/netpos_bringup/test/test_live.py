"""Options of the server, and what it says where it cannot serve; with a graph:
tests/test_live_view.py."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest
import rclpy
from netpos_bringup import live
from netpos_bringup.live import LiveNode, live_flags
from rclpy.context import Context

DOMAIN = 63


@pytest.fixture
def context() -> Iterator[Context]:
    """A context of its own."""
    own = Context()
    rclpy.init(context=own, domain_id=DOMAIN)
    yield own
    rclpy.shutdown(context=own)


def test_this_machine_only_unless_told() -> None:
    flags = live_flags([])
    assert (flags.host, flags.port) == ("127.0.0.1", 8765)
    flags = live_flags(["--host", "0.0.0.0", "--port", "0"])
    assert (flags.host, flags.port) == ("0.0.0.0", 0)


@pytest.mark.parametrize("port", ["-1", "65536", "http"])
def test_a_bad_port_is_bad_usage(port: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        live_flags(["--port", port])
    assert ended.value.code == 2
    assert "port" in capsys.readouterr().err


def test_a_taken_port_is_one_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        monkeypatch.setattr("sys.argv", ["live", "--port", str(port)])
        with pytest.raises(SystemExit) as ended:
            live.main()
    assert ended.value.code == 1
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1
    assert f"127.0.0.1:{port}" in said[0]
    assert "Address already in use" in said[0]


@pytest.mark.parametrize(
    ("host", "loopback"),
    [
        ("127.0.0.1", True),
        ("::1", True),
        ("localhost", True),
        ("0.0.0.0", False),
        ("10.1.2.3", False),
        ("edge.example", False),
    ],
)
def test_who_can_be_reached_from_elsewhere(host: str, loopback: bool) -> None:
    assert live.is_loopback(host) is loopback


def test_any_free_port(context: Context) -> None:
    node = LiveNode("127.0.0.1", 0, context=context)
    try:
        with socket.create_connection(("127.0.0.1", node.port), timeout=10.0):
            pass
    finally:
        node.stop()
        node.destroy_node()
