"""What is reported of an estimate: its protection level, of one epoch of a track and of a whole
run."""

from __future__ import annotations

import numpy as np

from netpos.estimation.compile import kernel, leaf
from netpos.estimation.engine import GATE_SIZE, Epochs, FilterOptions, Run
from netpos.estimation.level.protection import gaussian_radius, radius_limit
from netpos.estimation.measurement import GROUP
from netpos.estimation.noise_scale import NoiseScale
from netpos.estimation.state import X
from netpos.messages.values import Array

LEVEL_MAX_M = 1e6
"""Protection level of a track whose error nothing bounds."""


@leaf
def level_of(
    radius_m: float,
    inflation: float,
    undetected_m: float,
    manoeuvre_sd_mps: float,
    unheard_s: float,
) -> float:
    """Protection level [m] of an estimate that is one Gaussian.

    radius_m : that its error leaves with ``integrity_risk``; inflation : factor on it
    undetected_m : where a manoeuvre that nothing has shown may have taken the device, at the last
        measurement that was accepted, ``unheard_s`` ago; it goes on at ``manoeuvre_sd_mps``.
        Larger errors hide a larger manoeuvre.
    """
    moved_m = inflation * undetected_m + manoeuvre_sd_mps * unheard_s
    return max(inflation * radius_m, min(moved_m, LEVEL_MAX_M))


def run_levels(epochs: Epochs, run: Run, options: FilterOptions) -> Array:
    """Protection levels [m] (N,) that a track reports of the ``epochs`` of which
    ``mixture.epoch.run_epochs`` made ``run``, or of the first N of them; the groups of an epoch
    have equally many rows."""
    fit = run.nis, *_rows_of_groups(epochs, run, options)
    inflation = NoiseScale.of_run(*fit, options.integrity_risk)
    levels: Array = _levels(run, inflation, _unheard_s(epochs, run), options)
    return levels


def _unheard_s(epochs: Epochs, run: Run) -> Array:
    """Seconds (N,) since the last epoch of which something was accepted."""
    stamps_ns = epochs.stamps_ns[: run.nis.size]
    heard = np.where(run.groups > 0, stamps_ns, stamps_ns[0])
    return np.asarray((stamps_ns - np.maximum.accumulate(heard)) * 1e-9, dtype=np.float64)


def _rows_of_groups(epochs: Epochs, run: Run, options: FilterOptions) -> tuple[Array, Array]:
    """Number of accepted rows (N,) of the epochs; number of groups that their gate refused, rows
    of each, and the gate (N, 3)."""
    row_start, rows = epochs.row_start[: run.nis.size + 1], epochs.rows
    count = np.diff(row_start)
    groups = np.where(count > 0, rows[row_start[1:] - 1, GROUP].astype(int) + 1, 1)
    size = count // groups
    gate_nis = options.gate_nis[np.minimum(size, GATE_SIZE - 1)]
    gated = (count > 0) & np.isfinite(gate_nis)
    refused = np.where(gated, groups - run.groups, 0.0)
    return run.groups * size, np.column_stack([refused, size, gate_nis])


@kernel
def _levels(run: Run, inflation: Array, unheard_s: Array, options: FilterOptions) -> Array:
    """Level (N,) of each epoch: ``level_of``, and that of a mixture."""
    level, risk = run.radius.copy(), options.integrity_risk
    speed = options.manoeuvre_speed_sd
    for k in range(level.size):
        cov, factor = run.covs[k], inflation[k]
        xx, xy, yy = cov[X.PX, X.PX], cov[X.PX, X.PY], cov[X.PY, X.PY]
        at_most = factor * radius_limit(xx, xy, yy, risk)
        moved_m = level_of(0.0, factor, run.undetected_m[k], speed, unheard_s[k])
        level[k] = max(level[k], moved_m)
        if level[k] < at_most:
            level[k] = max(level[k], factor * gaussian_radius(xx, xy, yy, risk))
    return level
