"""What the terminal shows of messages: values, words, order, and nothing a terminal obeys."""

from __future__ import annotations

import io
from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
from netpos.bags import codec, typestore
from netpos.live.board import Board
from netpos.live.screen import plain, screen
from netpos.messages.values import (
    ClockState,
    Odometry,
    RsuInfo,
    TrackMode,
    TrackState,
    TrackStatus,
)
from rich.console import Console

NS = 1_000_000_000


def odometry(at_s: float, vue: str = "vue_1") -> Any:
    cov = np.zeros((6, 6))
    cov[:2, :2] = [[4.0, 0.0], [0.0, 9.0]]
    value = Odometry(
        stamp_ns=round(NS * at_s),
        vue_id=vue,
        position=np.array([12.345, -6.789, 1.5]),
        quaternion=np.array([0.0, 0.0, 0.0, 1.0]),
        linear_velocity=np.zeros(3),
        pose_cov=cov,
    )
    return codec().odometry_to_msg(value)


def status(at_s: float, state: TrackState, **values: Any) -> Any:
    value = TrackStatus(stamp_ns=round(NS * at_s), vue_id="vue_1", state=state, **values)
    return codec().track_status_to_msg(value)


def diagnostics(lines: Iterable[tuple[int, str, str, dict[str, str]]]) -> Any:
    types = typestore().types
    entry, pair = (
        types[f"diagnostic_msgs/msg/{name}"] for name in ("DiagnosticStatus", "KeyValue")
    )
    made = [
        entry(
            level=level,
            name=name,
            message=message,
            hardware_id="",
            values=[pair(key=key, value=value) for key, value in values.items()],
        )
        for level, name, message, values in lines
    ]
    return types["diagnostic_msgs/msg/DiagnosticArray"](header=codec().header(0, ""), status=made)


def shown(board: Board, now_s: float, width: int = 160) -> str:
    console = Console(file=io.StringIO(), width=width)
    console.print(screen(board, "here", now_s))
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert isinstance(text, str)
    return text


def row(text: str, of: str) -> list[str]:
    """Cells of the row whose first or second cell is ``of``."""
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip("│┃").replace("┃", "│").split("│")]
        if of in cells[:2]:
            return cells
    raise AssertionError(f"no row {of} in\n{text}")


def test_a_device_has_all_its_figures() -> None:
    board = Board()
    board.add("/vue_1/odometry", odometry(3.0), 3 * NS, 10.0)
    tracking = status(
        3.0,
        TrackState.TRACKING,
        protection_level_m=7.5,
        sources=("b", "a"),
        rejected={"gate": 3, "late": 1},
    )
    board.add("/vue_1/track_status", tracking, 3 * NS, 10.0)
    clock = ClockState(
        stamp_ns=3 * NS, vue_id="vue_1", offset_s=1.5e-6, drift=0.0, cov=np.diag([4e-18, 0.0])
    )
    board.add("/vue_1/clock_state", codec().clock_state_to_msg(clock), 3 * NS, 10.0)
    text = shown(board, 10.25)
    assert row(text, "device") == [
        *("device", "state", "RSUs", "position [m]", "sd [m]", "level [m]", "clock [ns]"),
        *("refused", "age [s]"),
    ]
    assert row(text, "vue_1") == [
        *("vue_1", "TRACKING", "2: a, b", "12.35, -6.79, 1.50", "3.00", "7.50", "1500.0 ± 2.0"),
        *("4: gate 3", "0.2"),
    ]
    assert "network time 3.0 s" in text


def test_why_it_is_not_tracking_is_below_the_state() -> None:
    board = Board()
    waiting = status(3.0, TrackState.WAITING, reason="another RSU is needed")
    board.add("/vue_1/track_status", waiting, 0, 0.0)
    assert row(shown(board, 0.0), "another RSU is needed")[0] == ""
    modes = (TrackMode(weight=0.75, x_m=1.0, y_m=2.0), TrackMode(weight=0.25, x_m=9.0, y_m=2.0))
    board.add("/vue_1/track_status", status(3.0, TrackState.AMBIGUOUS, modes=modes), 0, 0.0)
    assert "75 % at 1.0, 2.0; 25 % at 9.0, 2.0" in shown(board, 0.0, 200)


def test_the_sd_of_a_silent_device_is_that_of_its_status() -> None:
    board = Board()
    board.add("/vue_1/odometry", odometry(3.0), 0, 0.0)
    board.add("/vue_1/track_status", status(9.0, TrackState.COASTING, position_sd_m=55.0), 0, 6.0)
    cells = row(shown(board, 6.5), "vue_1")
    assert (cells[1], cells[4], cells[8]) == ("COASTING", "55.00", "6.5")


def test_a_device_nobody_speaks_of_leaves() -> None:
    board = Board()
    board.add("/vue_1/odometry", odometry(3.0), 0, 0.0)
    assert [line.name for line in board.devices(59.0)] == ["vue_1"]
    assert board.devices(61.0) == []
    assert "no device heard" in shown(board, 61.0)


def test_devices_of_networks_have_names_of_their_own() -> None:
    board = Board()
    for topic in ("/networks/wifi/phone/odometry", "/phone/odometry"):
        assert board.wants(topic, "nav_msgs/msg/Odometry")
        board.add(topic, odometry(3.0, "phone"), 0, 0.0)
    assert [line.name for line in board.devices(0.0)] == ["phone", "wifi/phone"]


@pytest.mark.parametrize(
    ("topic", "type_name"),
    [
        ("/vue_1/odometry", "std_msgs/msg/String"),
        ("/vue_1/imu", "sensor_msgs/msg/Imu"),
        ("/viz/odometry", "nav_msgs/msg/Odometry"),
        ("/odometry", "nav_msgs/msg/Odometry"),
        ("/diagnostics", "std_msgs/msg/String"),
    ],
)
def test_other_topics_are_not_wanted(topic: str, type_name: str) -> None:
    assert not Board().wants(topic, type_name)


def test_health_begins_with_the_worst() -> None:
    board = Board()
    board.add(
        "/rsu/info", codec().rsu_info_to_msg(RsuInfo(rsu_id="a", position=np.zeros(3))), 0, 0
    )
    figures = {"rate_hz": "10.0", "accept_ratio": "0.25", "age_s": "0.1"}
    lines = [
        (0, "ekf_tracker: vue_1", "tracking", {}),  # has its table
        (0, "ekf_tracker: rsus", "2 RSUs known", {}),
        (0, "ekf_tracker: rsu a", "ok", figures | {"accept_ratio": "-1.00"}),
        (2, "ekf_tracker: rsu b", "azimuth off by 20.1 deg", figures),
        (1, "track_fusion: network wifi", "silent: left out", {}),
    ]
    board.add("/diagnostics", diagnostics(lines), 0, 0.0)
    subjects = [line.subject for line in board.health()]
    assert subjects == ["rsu b", "track_fusion: network wifi", "rsus", "rsu a"]
    text = shown(board, 0.0)
    assert row(text, "b") == ["ERROR", "b", "azimuth off by 20.1 deg", "10.0", "25 %"]
    assert row(text, "a") == ["ok", "a", "ok", "10.0", ""]  # nothing judged yet
    assert "1 RSUs" in text


def test_many_rsus_do_not_push_devices_off_the_screen() -> None:
    board = Board()
    lines = [
        (0 if k else 2, f"ekf_tracker: rsu r{k}", "ok", {"age_s": f"{k}.0"}) for k in range(100)
    ]
    board.add("/diagnostics", diagnostics(lines), 0, 0.0)
    text = shown(board, 0.0)
    assert row(text, "r0")[0] == "ERROR"
    assert row(text, "r11")[0] == "ok"
    assert row(text, "88 more")[0] == "ok"
    assert "r12" not in text


def test_a_message_without_a_meaning_is_counted_and_told() -> None:
    board = Board()
    strange = status(3.0, TrackState.TRACKING)
    strange.state = 77
    board.add("/vue_1/track_status", strange, 0, 0.0)
    assert "1 messages of /vue_1/track_status could not be understood" in shown(board, 0.0)


def test_nothing_from_the_network_commands_the_terminal() -> None:
    assert plain("a\x1b[2Jb\r\nc\x07") == "a�[2Jb��c�"
    board = Board()
    board.add(
        "/vue_1/track_status",
        status(3.0, TrackState.WAITING, reason="\x1b[2J [red]no markup[/red]"),
        0,
        0.0,
    )
    text = shown(board, 0.0)
    assert "\x1b" not in text
    assert "[red]no markup[/red]" in text
