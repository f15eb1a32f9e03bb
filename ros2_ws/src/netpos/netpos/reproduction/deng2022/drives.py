"""Whole drives at once: what the strapdown track does epoch by epoch, and fixes of every epoch."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from netpos.estimation.compile import kernel
from netpos.estimation.engine import Epochs
from netpos.estimation.fixes.position_fix import fix_position, start_of
from netpos.estimation.measurement import KIND, ORIGIN, ROW_WIDTH, VALUE, VARIANCE, Kind
from netpos.estimation.sensors.row import group_count
from netpos.estimation.spatial.error_state import (
    MEMORY,
    Imu,
    Sensors,
    advance,
    correct,
    doubt_standstill,
)
from netpos.messages.values import Array
from netpos.tracking.smoothing.strapdown import Recorder

Ints = NDArray[np.int64]
_PLACE = int(Kind.PLACE)


class Drive(NamedTuple):
    """After each of N epochs: nav (N, n + 1), cov (N, n, n), nis and the rows behind it (N,)."""

    nav: Array
    cov: Array
    nis: Array
    dof: Ints


@kernel
def drive(
    start_ns: int,
    nav: Array,
    cov: Array,
    imu: Imu,
    epochs: Epochs,
    sensors: Sensors,
    gate_nis: Array,
) -> Drive:
    """Filter a drive from ``nav`` (n + 1,) and ``cov`` (n, n) at ``start_ns``."""
    n = epochs.stamps_ns.size
    navs, covs = np.empty((n, nav.size)), np.empty((n, cov.shape[0], cov.shape[0]))
    nis, dof = np.zeros(n), np.zeros(n, np.int64)
    state, P, memory, now = nav.copy(), cov.copy(), np.zeros(MEMORY), start_ns
    for i in range(n):
        stamp = epochs.stamps_ns[i]
        advance(state, P, memory, now, stamp, imu, sensors)
        now = stamp
        rows = epochs.rows[epochs.row_start[i] : epochs.row_start[i + 1]]
        if rows.shape[0] > 0:
            accepted = np.zeros(group_count(rows))
            nis[i], dof[i] = correct(state, P, rows, gate_nis, accepted)
            if dof[i] == 0:
                doubt_standstill(memory)
        navs[i], covs[i] = state, P
    return Drive(navs, covs, nis, dof)


class Fixes(NamedTuple):
    """One fix per epoch: position (N, 3), cov (N, 3, 3), status (N,) of ``FixStatus``."""

    position: Array
    cov: Array
    status: Ints


@kernel
def fix_each(epochs: Epochs, height_m: float, height_sd_m: float) -> Fixes:
    """Least-squares fixes of all epochs, each on its own.

    height_m : where they start, and what the antenna's height is known to be within
        ``height_sd_m``; 0: it is not known
    """
    n = epochs.stamps_ns.size
    position, cov, status = np.empty((n, 3)), np.empty((n, 3, 3)), np.empty(n, np.int64)
    for i in range(n):
        measured = epochs.rows[epochs.row_start[i] : epochs.row_start[i + 1]]
        rows = measured
        if height_sd_m > 0.0:
            rows = np.zeros((measured.shape[0] + 1, ROW_WIDTH))
            rows[:-1] = measured
            rows[-1, KIND], rows[-1, VALUE] = _PLACE, height_m
            rows[-1, VARIANCE], rows[-1, ORIGIN + 2] = height_sd_m**2, 1.0
        fix = fix_position(rows, start_of(measured, height_m))
        position[i], cov[i], status[i] = fix.position, fix.cov, fix.status
    return Fixes(position, cov, status)


def smoothed_drive(
    start_ns: int,
    nav: Array,
    cov: Array,
    imu: Imu,
    epochs: Epochs,
    sensors: Sensors,
    gate_nis: Array,
) -> tuple[Array, Array]:
    """``drive`` given all measurements: nav (N, n + 1) and cov (N, n, n) of every
    epoch after ``start_ns``."""
    recorder, memory, now = Recorder(), np.zeros(MEMORY), start_ns
    nav, cov = nav.copy(), cov.copy()
    recorder.begin(start_ns, nav, cov)
    for i, stamp in enumerate(epochs.stamps_ns.tolist()):
        recorder.advance(nav, cov, memory, now, stamp, imu, sensors)
        rows, now = epochs.rows[epochs.row_start[i] : epochs.row_start[i + 1]], stamp
        if len(rows):
            _, used = correct(nav, cov, rows, gate_nis, np.zeros(group_count(rows)))
            if used == 0:
                doubt_standstill(memory)
        recorder.note(nav, cov, None, sensors.slow.biases[0])
    found = recorder.smoothed()
    return np.array([i.nav for i in found]), np.array([i.cov for i in found])
