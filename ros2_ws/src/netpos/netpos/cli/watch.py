"""``netpos watch``: a running graph as a table in a terminal."""

from __future__ import annotations

import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated

import typer

from netpos.cli.errors import WorkFailedError
from netpos.cli.interrupts import CTRL_C

if TYPE_CHECKING:
    from netpos.live.board import Board
    from netpos.live.client import Viewer

_LIVE = ("ros2", "run", "netpos_bringup", "live", "--port", "0")
_START_S = 30.0
_RECEIVE_S = 0.05
_SETTLE_S = 1.5  # diagnostics come every second


def watch(
    url: Annotated[
        str | None,
        typer.Argument(
            metavar="[URL]",
            help="Server of the graph, such as ws://127.0.0.1:8765, which ros2 run netpos_bringup "
            "live starts. Default: start one for this shell's ROS domain.",
        ),
    ] = None,
    namespace: Annotated[
        str, typer.Option(help="Namespace of the nodes to show, such as /site_a. Default: none.")
    ] = "",
    once: Annotated[bool, typer.Option("--once", help="Print one frame and exit.")] = False,
    period: Annotated[float, typer.Option(help="Seconds between frames.")] = 1.0,
    wait: Annotated[
        float, typer.Option(help="With --once: longest wait for the graph, in seconds.")
    ] = 10.0,
) -> None:
    """Show devices and RSUs of a running graph in this terminal.

    Exit status 1 if --once hears no device.
    """
    from netpos.live.client import ViewError, full_url  # noqa: PLC0415

    for name, value in (("--period", period), ("--wait", wait)):
        if not 0.0 < value < 1e6:
            raise ValueError(f"{name} must be > 0 s, got {value}")
    try:
        if url is not None:
            _watch(full_url(url), period, wait if once else None, namespace)
            return
        with _served() as own:
            _watch(own, period, wait if once else None, namespace)
    except ViewError as error:
        raise WorkFailedError(str(error)) from error


@contextmanager
def _served() -> Iterator[str]:
    """The address of a server of our own, for the ROS domain of this shell."""
    if shutil.which("ros2") is None:
        raise ValueError(
            "ros2 is not on PATH; source env.sh or your ROS 2 installation, or name a server: "
            "netpos watch ws://HOST:8765"
        )
    # A group of its own: a Ctrl-C in the terminal is for us, who then end it.
    with subprocess.Popen(
        _LIVE, stdout=subprocess.PIPE, stdin=subprocess.DEVNULL, process_group=0, text=True
    ) as server:
        try:
            assert server.stdout is not None
            said = server.stdout.readline()
            _, _, address = said.strip().rpartition(" at ")
            if not address:
                raise WorkFailedError("ros2 run netpos_bringup live did not start; see above")
            yield address
        finally:
            server.terminate()
            try:
                server.wait(_START_S)
            except subprocess.TimeoutExpired:
                server.kill()


def _watch(url: str, period_s: float, once_within_s: float | None, namespace: str) -> None:
    from netpos.live.board import Board  # noqa: PLC0415
    from netpos.live.client import Viewer  # noqa: PLC0415

    board = Board(namespace)
    with Viewer(url, board.wants) as viewer:
        if once_within_s is not None:
            _print_once(viewer, board, once_within_s)
        else:
            _show(viewer, board, period_s)


def _print_once(viewer: Viewer, board: Board, wait_s: float) -> None:
    """Print one frame as soon as devices and diagnostics have been heard, or the time is over."""
    from rich.console import Console  # noqa: PLC0415

    from netpos.live.screen import screen  # noqa: PLC0415

    begun_s = time.monotonic()
    while (passed_s := time.monotonic() - begun_s) < wait_s:
        _hear(viewer, board, _RECEIVE_S)
        if board.complete and passed_s >= min(_SETTLE_S, wait_s):
            break
    now_s = time.monotonic()
    Console().print(screen(board, viewer.url, now_s))
    if not board.devices(now_s):
        raise WorkFailedError(
            f"no device heard within {wait_s:g} s at {viewer.url}; is a tracker running in "
            "its ROS domain?"
        )


def _show(viewer: Viewer, board: Board, period_s: float) -> None:
    """Show frames until Ctrl-C: in place on a terminal, one below the other elsewhere."""
    from rich.console import Console  # noqa: PLC0415
    from rich.live import Live  # noqa: PLC0415

    from netpos.live.screen import screen  # noqa: PLC0415

    console = Console()
    if not console.is_terminal:
        while True:
            _hear(viewer, board, period_s)
            console.print(screen(board, viewer.url, time.monotonic()))
    with Live(console=console, auto_refresh=False, screen=True) as live:
        while True:
            live.update(screen(board, viewer.url, time.monotonic()), refresh=True)
            _hear(viewer, board, period_s)


def _hear(viewer: Viewer, board: Board, seconds: float) -> None:
    """Take messages for so many seconds."""
    end_s = time.monotonic() + seconds
    while (left_s := end_s - time.monotonic()) > 0.0:
        CTRL_C.check()
        received = viewer.receive(min(left_s, _RECEIVE_S))
        if received is not None:
            board.add(received.topic, received.message, received.log_time_ns, time.monotonic())
