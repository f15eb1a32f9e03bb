"""What the fusion refuses, each fault by itself; and what it must not refuse."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from netpos.messages.values import Array, NetworkTrack
from netpos.tracking.networks.config import FusionConfig
from netpos.tracking.networks.validation import network_track_fault

Maker = Callable[..., NetworkTrack]


def with_entry(i: int, j: int, value: float) -> Array:
    cov = np.diag([1.0, 1.0, 0.25, 0.25, 0.0625, 0.0625])
    cov[i, j] = value
    return cov


INDEFINITE = with_entry(0, 1, 1.5)
INDEFINITE[1, 0] = 1.5


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"network": "wi fi"}, "name"),
        ({"vue_id": ""}, "name"),
        ({"stamp_ns": 0}, "zero_stamp"),
        ({"stamp_ns": -5}, "zero_stamp"),
        ({"frame_id": "odom"}, "frame"),
        ({"mean": np.zeros(4)}, "shape"),
        ({"mean": np.array([np.nan, 0, 0, 0, 0, 0])}, "not_finite"),
        ({"mean": np.array([0, 0, 0, 0, 0, 2e9])}, "not_finite"),
        ({"height_m": np.inf}, "not_finite"),
        ({"cov": with_entry(2, 2, np.nan)}, "not_finite"),
        ({"own_cov": with_entry(0, 0, np.inf)}, "not_finite"),
        ({"cov": with_entry(3, 3, 0.0)}, "covariance"),
        ({"cov": with_entry(3, 3, -1.0)}, "covariance"),
        ({"cov": with_entry(0, 0, 2e12)}, "covariance"),
        ({"cov": with_entry(0, 1, 0.3)}, "covariance"),
        ({"cov": INDEFINITE}, "covariance"),
        ({"own_cov": with_entry(0, 0, 1.1)}, "own_covariance"),
        ({"own_cov": with_entry(0, 0, -0.1)}, "own_covariance"),
    ],
)
def test_faults(track: Maker, change: dict[str, Any], reason: str) -> None:
    assert network_track_fault(replace(track("wifi", 0.0), **change)) == reason


def test_sound_tracks(track: Maker) -> None:
    assert network_track_fault(track("wifi", 0.0)) is None
    assert network_track_fault(track("wifi", 0.0, own_cov=np.zeros((6, 6)))) is None
    tight = np.diag([1e-6, 1e6, 1.0, 1.0, 1.0, 1e-3])
    assert network_track_fault(track("wifi", 0.0, cov=tight, own_cov=0.5 * tight)) is None


def test_tracks_are_in_the_frame_of_the_map(track: Maker) -> None:
    assert network_track_fault(track("wifi", 0.0, frame_id="site"), "site") is None
    assert network_track_fault(track("wifi", 0.0), "site") == "frame"


def test_two_names_of_one_frame_are_refused() -> None:
    with pytest.raises(ValueError, match="must differ"):
        FusionConfig(map_frame="world", odom_frame="world")
