"""Options: flags, parameters, refusals."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
from netpos_bag.conversions import profile_to_bag, profile_to_play, profile_to_record, unique
from netpos_bag.parameters import (
    LogTime,
    PlayConfig,
    RecordConfig,
    play_config,
    play_flags,
    record_config,
    record_flags,
)
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy


@pytest.fixture
def context() -> Iterator[rclpy.Context]:
    context = rclpy.Context()
    rclpy.init(context=context)
    yield context
    context.try_shutdown()


def node(context: rclpy.Context, **parameters: Any) -> Node:
    overrides = [Parameter(name, value=value) for name, value in parameters.items()]
    return Node("trial", context=context, parameter_overrides=overrides)


def test_flags_win_over_parameters(context: rclpy.Context, tmp_path: Path) -> None:
    flags = record_flags(["--topics", "/b", "/c", "--metadata", "seed=3"])
    config = record_config(node(context, output=str(tmp_path / "x"), topics=["/a"]), flags)
    assert config == RecordConfig(
        output=tmp_path / "x", topics=("/b", "/c"), metadata=("seed=3",), log_time=LogTime.AUTO
    )


def test_play_defaults_and_flags(context: rclpy.Context) -> None:
    assert play_config(node(context), play_flags(["bag"])) == PlayConfig(bag=Path("bag"))
    flags = play_flags(["bag", "--rate", "10", "--wait-for-subscribers", "--input-only"])
    config = play_config(node(context, clock_hz=50.0), flags)
    assert (config.rate, config.clock_hz, config.input_only) == (10.0, 50.0, True)
    assert config.wait_for_subscribers == ()


def test_record_refuses(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="--output DIR"):
        RecordConfig(output=Path(""))
    with pytest.raises(ValueError, match="exists and is never overwritten"):
        RecordConfig(output=tmp_path)
    with pytest.raises(ValueError, match="must start with /"):
        RecordConfig(output=tmp_path / "x", topics=("a",))
    with pytest.raises(ValueError, match="KEY=VALUE"):
        RecordConfig(output=tmp_path / "x", metadata=("seed",))


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["rate", "clock_hz"])
def test_play_refuses(name: str, value: float) -> None:
    with pytest.raises(ValueError, match="must be > 0"):
        PlayConfig(bag=Path("x"), **{name: value})


@pytest.mark.parametrize("name", ["start_offset", "wait_timeout"])
def test_play_takes_0_but_not_less(name: str) -> None:
    PlayConfig(bag=Path("x"), **{name: 0.0})
    with pytest.raises(ValueError, match="must be >= 0"):
        PlayConfig(bag=Path("x"), **{name: -0.1})


@pytest.mark.parametrize("reliable", [True, False])
@pytest.mark.parametrize("latched", [True, False])
def test_profiles_there_and_back(reliable: bool, latched: bool) -> None:
    offered = QoSProfile(
        depth=7,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
    noted = [profile_to_bag(offered)]
    for profile in (profile_to_record(noted), profile_to_play(noted)):
        assert profile.reliability == offered.reliability
        assert profile.durability == offered.durability
        assert profile.depth >= 1000


def test_the_weakest_publisher_decides() -> None:
    strong = profile_to_bag(QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))
    weak = profile_to_bag(QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))
    assert unique([strong, weak, strong]) == [strong, weak]
    profile = profile_to_record([strong, weak])
    assert profile.reliability == ReliabilityPolicy.BEST_EFFORT
    assert profile.durability == DurabilityPolicy.VOLATILE
