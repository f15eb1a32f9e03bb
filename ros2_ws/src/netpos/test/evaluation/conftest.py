"""A synthetic recording with known errors: a street, a turn, a second street."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from netpos.bags import BagWriter, codec
from netpos.messages.values import (
    Array,
    ClockState,
    Odometry,
    RsuInfo,
    RsuMeasurement,
    TrackState,
    TrackStatus,
)

T0_NS = 1_700_000_000_000_000_000
SPEED_MPS = 8.0
SD_M = np.array([0.3, 0.6])
CLOCK_SD_S = 4e-9


def truth_at(t: Array) -> tuple[Array, Array]:
    """East for 10 s, a quarter circle of 8 m radius, then north: position (n, 2) m and heading
    (n,) rad.
    """
    radius, straight = 8.0, 80.0
    s = SPEED_MPS * t
    arc = np.clip((s - straight) / radius, 0.0, np.pi / 2)
    east = np.minimum(s, straight) + radius * np.sin(arc)
    north = radius * (1 - np.cos(arc)) + np.maximum(s - straight - radius * np.pi / 2, 0.0)
    return np.column_stack([east, north]), arc


def odometry(stamp_ns: int, xy: Array, heading: float, cov: Array | None = None) -> Odometry:
    pose_cov = np.zeros((6, 6))
    if cov is not None:
        pose_cov[:2, :2] = cov
    return Odometry(
        stamp_ns=stamp_ns,
        vue_id="vue_1",
        position=np.array([xy[0], xy[1], 1.5]),
        quaternion=np.array([0.0, 0.0, np.sin(heading / 2), np.cos(heading / 2)]),
        linear_velocity=np.array([SPEED_MPS, 0.0, 0.0]),
        pose_cov=pose_cov,
    )


@dataclass(frozen=True, kw_only=True)
class Drive:
    """The values that were recorded, for oracles that do not read the bag."""

    truth: list[Odometry]
    estimates: list[Odometry]
    clock_errors_ns: Array


def make_drive(seed: int = 3, n: int = 200) -> Drive:
    """Truth at 50 Hz, estimates at 10 Hz between the truth's stamps with independent errors of sd
    ``SD_M``.
    """
    rng = np.random.default_rng(seed)
    t_truth = np.arange(n * 5 + 1) * 0.02
    t = np.arange(n) * 0.1 + 0.053
    xy, heading = truth_at(t_truth)
    truth = [
        odometry(T0_NS + round(ti * 1e9), p, h)
        for ti, p, h in zip(t_truth, xy, heading, strict=True)
    ]
    xy, heading = truth_at(t)
    xy = xy + rng.normal(size=(n, 2)) * SD_M
    estimates = [
        odometry(T0_NS + round(ti * 1e9), p, h + np.deg2rad(0.5), np.diag(SD_M**2))
        for ti, p, h in zip(t, xy, heading, strict=True)
    ]
    return Drive(
        truth=truth, estimates=estimates, clock_errors_ns=rng.normal(size=n) * CLOCK_SD_S * 1e9
    )


Row = tuple[int, str, object]


def _truth_rows(drive: Drive) -> list[Row]:
    convert = codec()
    rows: list[Row] = []
    for pose in drive.truth:
        clock = ClockState(stamp_ns=pose.stamp_ns, vue_id="vue_1", offset_s=2e-5, drift=0.0)
        rows.append((pose.stamp_ns, "/vue_1/ground_truth", convert.odometry_to_msg(pose)))
        rows.append(
            (pose.stamp_ns, "/vue_1/ground_truth_clock", convert.clock_state_to_msg(clock))
        )
    return rows


def _measurement_rows(drive: Drive) -> list[Row]:
    """Two RSUs each estimate; one measurement is lost."""
    measurements = [
        RsuMeasurement(stamp_ns=pose.stamp_ns, rsu_id=rsu, vue_id="vue_1", sequence=k, expected=2)
        for k, pose in enumerate(drive.estimates)
        for rsu in ("rsu_0", "rsu_1")
        if (k, rsu) != (7, "rsu_1")
    ]
    return [(m.stamp_ns, "/rsu/measurements", codec().measurement_to_msg(m)) for m in measurements]


def _estimate_rows(drive: Drive) -> list[Row]:
    convert = codec()
    rows: list[Row] = []
    for k, pose in enumerate(drive.estimates):
        stamp = pose.stamp_ns
        clock = ClockState(
            stamp_ns=stamp,
            vue_id="vue_1",
            offset_s=2e-5 + drive.clock_errors_ns[k] * 1e-9,
            drift=0.0,
        )
        status = TrackStatus(
            stamp_ns=stamp,
            vue_id="vue_1",
            state=TrackState.TRACKING if k >= 5 else TrackState.INITIALISING,
            nis=4.0,
            nis_dof=4,
            rejected={"gate": k // 50},
            sources=("rsu_0", "rsu_1"),
        )
        rows.append((stamp, "/vue_1/odometry", convert.odometry_to_msg(pose)))
        rows.append((stamp, "/vue_1/clock_state", convert.clock_state_to_msg(clock)))
        rows.append((stamp, "/vue_1/track_status", convert.track_status_to_msg(status)))
    return rows


def write_drive(
    path: Path,
    drive: Drive,
    *,
    truth: bool = True,
    estimates: bool = True,
    measurements: Sequence[RsuMeasurement] | None = None,
    others: Mapping[str, Sequence[Odometry]] | None = None,
) -> Path:
    """Record a drive in time order with RSUs, measurements, clocks and status.

    ``measurements`` replaces those of the drive; they are recorded in the given order. ``others``:
    odometry on other topics.
    """
    convert = codec()
    rows: list[Row] = []
    for k, rsu_xy in enumerate([(20.0, 6.0), (70.0, 6.0), (95.0, 40.0)]):
        info = RsuInfo(rsu_id=f"rsu_{k}", position=np.array([*rsu_xy, 5.0]), stamp_ns=T0_NS)
        rows.append((T0_NS, "/rsu/info", convert.rsu_info_to_msg(info)))
    if truth:
        rows += _truth_rows(drive)
    if estimates and measurements is None:
        rows += _measurement_rows(drive)
    if estimates:
        rows += _estimate_rows(drive)
    rows += [
        (T0_NS, "/rsu/measurements", convert.measurement_to_msg(m)) for m in measurements or ()
    ]
    for topic, odometry in (others or {}).items():
        rows += [(o.stamp_ns, topic, convert.odometry_to_msg(o)) for o in odometry]
    with BagWriter(path, metadata={"tracker": "{}"}) as bag:
        for stamp, topic, message in sorted(rows, key=lambda row: row[0]):
            bag.write(topic, message, stamp)
    return path


@pytest.fixture(name="drive")
def _drive() -> Drive:
    return make_drive()


@pytest.fixture
def drive_bag(tmp_path: Path, drive: Drive) -> Path:
    return write_drive(tmp_path / "drive", drive)


@pytest.fixture
def record() -> Callable[..., Path]:
    return write_drive
