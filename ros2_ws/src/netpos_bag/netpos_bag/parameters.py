"""Options of record and play: flags after the executable's name, or parameters."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from enum import StrEnum
from pathlib import Path
from typing import Any

from netpos_node import declare
from rclpy.node import Node


class LogTime(StrEnum):
    """Where a recorded message's log time comes from."""

    AUTO = "auto"
    CLOCK = "clock"
    SYSTEM = "system"


@dataclass(frozen=True, kw_only=True)
class RecordConfig:
    """Options of record."""

    output: Path
    topics: tuple[str, ...] = ()  # empty: all
    log_time: LogTime = LogTime.AUTO
    metadata: tuple[str, ...] = ()  # KEY=VALUE, kept in the bag
    min_free_mb: float = 100.0  # free on the disk: with less the recording ends

    def __post_init__(self) -> None:
        if str(self.output) in ("", "."):
            raise ValueError("no output; name the new bag: --output DIR")
        if self.output.exists():
            raise ValueError(
                f"{self.output} exists and is never overwritten; choose another --output"
            )
        _require_absolute(self.topics)
        if not 0.0 <= self.min_free_mb < math.inf:
            raise ValueError(f"--min-free-mb must be >= 0, got {self.min_free_mb}")
        for item in self.metadata:
            if not item.partition("=")[1]:
                raise ValueError(f"--metadata {item!r} is not KEY=VALUE")


@dataclass(frozen=True, kw_only=True)
class PlayConfig:
    """Options of play. Topics may be patterns such as ``/*/imu``."""

    bag: Path
    rate: float = 1.0  # bag seconds per second
    start_offset: float = 0.0  # s of the bag to skip
    loop: bool = False
    topics: tuple[str, ...] = ()  # empty: all
    exclude_topics: tuple[str, ...] = ()
    input_only: bool = False  # leave out what the tracker publishes
    wait_for_subscribers: tuple[str, ...] = ("/rsu/measurements",)
    subscribers: int = 1  # that each of them shall have
    wait_timeout: float = 10.0  # s
    clock_hz: float = 100.0  # /clock messages per second of real time

    def __post_init__(self) -> None:
        if str(self.bag) in ("", "."):
            raise ValueError("no bag; name it: play BAG")
        for name, low in (
            ("rate", 0),
            ("clock_hz", 0),
            ("start_offset", -1),
            ("subscribers", -1),
            ("wait_timeout", -1),
        ):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > low and (low == 0 or value >= 0)):
                rule = "> 0" if low == 0 else ">= 0"
                raise ValueError(f"--{name.replace('_', '-')} must be {rule}, got {value}")
        _require_absolute(self.topics + self.exclude_topics + self.wait_for_subscribers)


def _require_absolute(topics: Sequence[str]) -> None:
    for topic in topics:
        if not topic.startswith("/"):
            raise ValueError(f"topic {topic!r} must start with /, such as /rsu/measurements")


def _parser(name: str, description: str) -> argparse.ArgumentParser:
    return argparse.ArgumentParser(
        prog=f"ros2 run netpos_bag {name}",
        description=description,
        argument_default=argparse.SUPPRESS,
        epilog="Every option is also a ROS parameter: --ros-args -p topics:=[/rsu/info]",
    )


def record_flags(arguments: Sequence[str]) -> dict[str, Any]:
    """Flags of record that were given."""
    parser = _parser("record", "Record topics of the running graph into a new MCAP bag.")
    parser.add_argument("-o", "--output", help="folder of the new bag; must not exist")
    parser.add_argument("--topics", nargs="+", help="record these only (default: all)")
    parser.add_argument("--all", "-a", action="store_true", help="record all topics (default)")
    parser.add_argument(
        "--log-time",
        choices=list(LogTime),
        help="auto: /clock where one is published, else system time",
    )
    parser.add_argument("--metadata", nargs="+", help="KEY=VALUE pairs kept in the bag")
    parser.add_argument(
        "--min-free-mb", type=float, help="end the recording when the disk has less room (100)"
    )
    flags = vars(parser.parse_args(arguments))
    if flags.pop("all", False):
        if "topics" in flags:
            parser.error("give --all or --topics, not both")
        flags["topics"] = []
    return flags


def play_flags(arguments: Sequence[str]) -> dict[str, Any]:
    """Flags of play that were given."""
    parser = _parser("play", "Publish a bag's messages and a /clock that follows their log times.")
    parser.add_argument("bag", nargs="?", help="bag folder or .mcap file")
    parser.add_argument("-r", "--rate", type=float, help="bag seconds per second (1)")
    parser.add_argument("--start-offset", type=float, help="seconds of the bag to skip (0)")
    parser.add_argument("-l", "--loop", action="store_true", help="start again at the end")
    parser.add_argument("--topics", nargs="+", help="play these only; patterns such as /*/imu")
    parser.add_argument("--exclude-topics", nargs="+", help="leave these out")
    parser.add_argument(
        "--input-only", action="store_true", help="leave out what the tracker publishes"
    )
    parser.add_argument(
        "--wait-for-subscribers",
        nargs="*",
        help="wait until these topics have a subscriber (/rsu/measurements, if it is played)",
    )
    parser.add_argument(
        "--subscribers", type=int, help="how many subscribers each of them shall have (1)"
    )
    parser.add_argument("--wait-timeout", type=float, help="wait so many seconds at most (10)")
    parser.add_argument("--clock-hz", type=float, help="/clock messages per real second (100)")
    return vars(parser.parse_args(arguments))


def record_config(node: Node, flags: dict[str, Any]) -> RecordConfig:
    """Flags where given, parameters else; ValueError for a bad value."""
    values = _merge(node, RecordConfig, flags, {"output": ""})
    values["output"] = Path(values["output"])
    values["log_time"] = LogTime(values["log_time"])
    return RecordConfig(**values)


def play_config(node: Node, flags: dict[str, Any]) -> PlayConfig:
    """Flags where given, parameters else; ValueError for a bad value."""
    values = _merge(node, PlayConfig, flags, {"bag": ""})
    values["bag"] = Path(values["bag"])
    return PlayConfig(**values)


def _merge(
    node: Node, kind: type[Any], flags: dict[str, Any], required: dict[str, str]
) -> dict[str, Any]:
    """Declare every field as a parameter; ROS has no empty list of strings, [""] stands for it."""
    values: dict[str, Any] = {}
    for entry in fields(kind):
        default = required.get(entry.name, entry.default)
        if isinstance(default, tuple):
            given = declare(node, entry.name, list(default) or [""], "")
            chosen = flags.get(entry.name, given)
            values[entry.name] = tuple(item for item in chosen if item)
        else:
            plain = str(default) if isinstance(default, StrEnum) else default
            given = declare(node, entry.name, plain, "")
            values[entry.name] = flags.get(entry.name, given)
    return values
