"""Truths, poses and errors for the tests of one track."""

from __future__ import annotations

import numpy as np
from netpos.estimation.state import POSITION
from netpos.messages.values import Array, InitialPose
from netpos.tracking import TrackOutput

T0 = 1_000_000_000
KNOWN_CLOCK = {"clock_offset_sd_s": 1e-12, "clock_drift_mean": 0.0, "clock_drift_sd": 1e-12}


def straight(t_s: float, clock_m: float = 0.0, drift_mps: float = 0.0) -> Array:
    """East along the street at 8 m/s."""
    return np.array([8.0 * t_s, 0.0, 8.0, 0.0, clock_m + drift_mps * t_s, drift_mps])


def standing(x: float = 40.0, y: float = 2.0) -> Array:
    return np.array([x, y, 0.0, 0.0, 0.0, 0.0])


def pose(t_s: float, x: float, y: float, var: float = 1.0) -> InitialPose:
    return InitialPose(
        stamp_ns=T0 + round(t_s * 1e9),
        vue_id="vue_1",
        position=np.array([x, y, 0.0]),
        cov=var * np.eye(3),
    )


def error(output: TrackOutput, truth: Array) -> float:
    """Distance of the published position from the truth."""
    assert output.odometry is not None
    return float(np.linalg.norm(output.odometry.position[:2] - truth[POSITION]))
