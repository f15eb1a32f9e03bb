"""The board as tables for a terminal."""

from __future__ import annotations

import math

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from netpos.live.board import Board, DeviceLine, HealthLine, number
from netpos.messages.values import TrackState

STATE_STYLES = {
    TrackState.WAITING: "dim",
    TrackState.INITIALISING: "yellow",
    TrackState.TRACKING: "green",
    TrackState.COASTING: "red",
    TrackState.AMBIGUOUS: "magenta",
}
LEVEL_NAMES = ("ok", "WARN", "ERROR", "STALE")
_LEVEL_STYLES = ("green", "yellow", "red", "magenta")
_NAMED = 4  # RSUs
_HEALTH_LINES = 12
_WORDS = 3  # columns
_NOTHING = "-"


def plain(text: str) -> str:
    """Text from the network without control characters, which a terminal would obey."""
    return "".join(char if char.isprintable() else "�" for char in text)


def screen(board: Board, title: str, now_s: float) -> RenderableType:
    """A table of devices, and one of RSUs and the input as a whole."""
    time_ns = board.network_time_ns
    when = "nothing heard yet" if time_ns is None else f"network time {time_ns / 1e9:.1f} s"
    head = Text(plain(f"netpos watch  {title}  {when}, {len(board.rsus)} RSUs"), style="bold")
    for topic, count in sorted(board.unread.items()):
        head.append(plain(f"\n{count} messages of {topic} could not be understood"), style="red")
    return Group(head, _devices(board, now_s), _health(board.health()))


def _devices(board: Board, now_s: float) -> RenderableType:
    lines = board.devices(now_s)
    if not lines:
        return Text("no device heard", style="dim")
    table = _table("device", "state", "RSUs", "position [m]", "sd [m]", "level [m]", "clock [ns]")
    for name in ("refused", "age [s]"):
        table.add_column(Text(name), justify="right")
    for line in lines:
        table.add_row(*_cells(line, now_s))
    return table


def _cells(line: DeviceLine, now_s: float) -> list[Text]:
    status, clock = line.status, line.clock
    place = level = sd = clock_words = refused = _NOTHING
    if line.odometry is not None:
        x, y, z = (float(value) for value in line.odometry.position)
        place = f"{x:.2f}, {y:.2f}, {z:.2f}"
        sd = f"{_horizontal_sd(line):.2f}"
    if status is not None:
        level = f"{status.protection_level_m:.2f}" if status.protection_level_m >= 0 else _NOTHING
        refused = _counts(line)
    if clock is not None:
        offset_sd = math.sqrt(max(float(clock.cov[0, 0]), 0.0))
        clock_words = f"{1e9 * clock.offset_s:.1f} ± {1e9 * offset_sd:.1f}"
    age = now_s - line.estimated_s
    words = (_sources(line), place, sd, level, clock_words, refused)
    return [
        Text(plain(line.name)),
        _state(line),
        *(Text(plain(word)) for word in words),
        Text(f"{age:.1f}" if math.isfinite(age) else _NOTHING),
    ]


def _horizontal_sd(line: DeviceLine) -> float:
    """The largest one. Of a silent device, whose status is newer than its estimate, that of the
    status."""
    odometry, status = line.odometry, line.status
    assert odometry is not None
    if status is not None and status.stamp_ns > odometry.stamp_ns and status.position_sd_m > 0:
        return status.position_sd_m
    largest = float(np.linalg.eigvalsh(odometry.pose_cov[:2, :2])[-1])
    return math.sqrt(max(largest, 0.0))


def _state(line: DeviceLine) -> Text:
    if line.status is None:
        return Text(_NOTHING)
    state = line.status.state
    words = Text(state.name, style=STATE_STYLES[state])
    places = [f"{100 * m.weight:.0f} % at {m.x_m:.1f}, {m.y_m:.1f}" for m in line.status.modes]
    why = "; ".join(places) or line.status.reason
    return words.append(f"\n{plain(why)}", style="dim") if why else words


def _sources(line: DeviceLine) -> str:
    if line.status is None or not line.status.sources:
        return _NOTHING
    names = sorted(line.status.sources)
    more = f" +{len(names) - _NAMED}" if len(names) > _NAMED else ""
    return f"{len(names)}: {', '.join(names[:_NAMED])}{more}"


def _counts(line: DeviceLine) -> str:
    """All refusals, and the most frequent reason."""
    assert line.status is not None
    counts = {reason: count for reason, count in line.status.rejected.items() if count}
    if not counts:
        return "0"
    most = max(counts, key=lambda reason: (counts[reason], reason))
    return f"{line.refused}: {most} {counts[most]}"


def _health(lines: list[HealthLine]) -> RenderableType:
    if not lines:
        return Text("no /diagnostics heard", style="dim")
    table = _table("", "RSU", "what", "rate [Hz]", "accepted")
    for line in lines[:_HEALTH_LINES]:
        level = _level_of(line)
        ratio = number(line.values.get("accept_ratio", ""))
        table.add_row(
            Text(LEVEL_NAMES[level], style=_LEVEL_STYLES[level]),
            Text(plain(line.subject.removeprefix("rsu "))),
            Text(plain(line.message)),
            Text(plain(line.values.get("rate_hz", ""))),
            Text(f"{100 * ratio:.0f} %" if 0.0 <= ratio <= 1.0 else ""),
        )
    left = lines[_HEALTH_LINES:]
    if left:
        worst = LEVEL_NAMES[_level_of(left[0])]
        table.add_row(Text(worst), Text(f"{len(left)} more"), Text("not shown"))
    return table


def _table(*names: str) -> Table:
    """An empty table with these columns: the first three hold words, the others figures."""
    table = Table()
    for k, name in enumerate(names):
        table.add_column(Text(name), justify="left" if k < _WORDS else "right")
    return table


def _level_of(line: HealthLine) -> int:
    return min(max(line.level, 0), len(LEVEL_NAMES) - 1)
