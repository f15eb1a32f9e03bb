"""Parameters: ranges, types and the error that names value and remedy."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Any

import pytest
from netpos.estimation.forms.table import form_of
from netpos.tracking.config import FILTERS, TrackerConfig

RANGED = [entry for entry in fields(TrackerConfig) if "low" in entry.metadata]


@pytest.mark.parametrize("entry", RANGED, ids=[e.name for e in RANGED])
def test_ranges_at_their_limits(entry: Any) -> None:
    low, high = entry.metadata["low"], entry.metadata["high"]
    for good in (low, high):
        assert getattr(TrackerConfig(**{entry.name: good}), entry.name) == good
    span = max(abs(low), abs(high))
    for bad in (low - 1e-6 * span, high + 1e-6 * span, math.nan, math.inf, -math.inf):
        with pytest.raises(ValueError, match=rf"{entry.name} must be in \[.*got {bad!r}"):
            TrackerConfig(**{entry.name: bad})


def test_every_parameter_is_described() -> None:
    assert all(entry.metadata["text"] for entry in fields(TrackerConfig))
    assert len(RANGED) >= 20


@pytest.mark.parametrize("name", ["filter", "process_noise"])
def test_choices(name: str) -> None:
    with pytest.raises(ValueError, match=rf"{name} must be one of .*, got 'best'"):
        TrackerConfig(**{name: "best"})  # type: ignore[arg-type]
    for choice in FILTERS if name == "filter" else ("continuous", "werner"):
        assert getattr(TrackerConfig(**{name: choice}), name) == choice  # type: ignore[arg-type]


def test_ekf_linearises_once() -> None:
    assert form_of("ekf").iterations == 1
    assert form_of("iekf").iterations > 1


def test_mapping_takes_what_yaml_writes() -> None:
    config = TrackerConfig.from_mapping(
        {
            "hold_s": 1,
            "drift_step_sd": "1e-4",
            "max_rejected_epochs": 3,
            "require_initial_pose": "true",
            "filter": "ekf",
        }
    )
    assert (config.hold_s, type(config.hold_s)) == (1.0, float)
    assert config.drift_step_sd == 1e-4
    assert config.max_rejected_epochs == 3
    assert config.require_initial_pose is True
    assert config.filter == "ekf"
    assert TrackerConfig.from_mapping({}) == TrackerConfig()
    assert TrackerConfig.from_mapping({"require_initial_pose": False}) == TrackerConfig()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"hold": 1.0}, r"unknown tracker parameter 'hold'; did you mean hold_s\?$"),
        (
            {"hold": 1.0, "filter": "ekf", "device_hight_m": 1.0},
            r"^unknown .* 'hold'; .*\nunknown .* 'device_hight_m'; did you mean device_height_m",
        ),
        ({"xyzzy": 1.0}, "unknown tracker parameter 'xyzzy'$"),
        ({"hold_s": "soon"}, "hold_s must be of type float, got 'soon'"),
        ({"hold_s": None}, "hold_s must be of type float, got None"),
        ({"require_initial_pose": 2}, "require_initial_pose must be true or false, got 2"),
        ({"hold_s": -1}, "hold_s must be in"),
        ({"hold_s": True}, "hold_s must be of type float, got True"),
        ({"max_rejected_epochs": 2.5}, "max_rejected_epochs must be of type int, got 2.5"),
    ],
)
def test_mapping_errors(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        TrackerConfig.from_mapping(values)
