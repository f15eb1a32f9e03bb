"""The problem that a first fix solves: the rows of a window, and what is known before them.

The prior is as wide as the coverage of the RSUs, the initial speed and the clock allow; in parts
of the window device and clock accelerate as the process noise says.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from netpos.estimation.densities import Density, held
from netpos.estimation.measurement import (
    AXES,
    BIAS,
    COMMON,
    GROUP,
    HEIGHT,
    KIND,
    ORIGIN,
    REFERENCE,
    Kind,
)
from netpos.estimation.mixture.outliers import share_of_outliers
from netpos.estimation.mixture.window import Problem, Window
from netpos.estimation.motion import SPEED_OF_LIGHT_MPS
from netpos.estimation.sensors.table import BY_KIND
from netpos.estimation.state import N_CORE
from netpos.messages.values import Array
from netpos.tracking.config import TrackerConfig
from netpos.tracking.rsus.rsu import Rsu, SlowErrors

_LEAST_SPAN_S = 0.1  # of a window
_PART_S, _PARTS_MAX = 0.75, 8  # of the window, in which accelerations are constant
_TELLING = 3  # values of an RSU, of which one can be told to be an outlier
_LEAST_SD = 1e-9  # of a slow error
_ANY_WALK_S = 1e-5  # by which a clock is off its line within a window
_INSTANTS = 30  # at which the clock is free: each is a state of the fit
_ANYWHERE_M = 1e6  # of a fix without RSUs


class Heard(NamedTuple):
    """The rows (m, ROW_WIDTH) of one epoch, and the RSUs that measured them."""

    stamp_ns: int
    rows: Array
    rsus: tuple[Rsu, ...]


def stacked(heard: Collection[Heard], slow: SlowErrors) -> tuple[Array, Array, Array]:
    """The rows (m, ROW_WIDTH) of a window, their groups numbered through, their ages [s] (m,),
    <= 0, against the newest, and the sd of the ``slow`` errors that are states of the fit."""
    newest_ns = max(one.stamp_ns for one in heard)
    rows = np.vstack([one.rows for one in heard])
    ages_s = np.concatenate(
        [np.full(len(one.rows), (one.stamp_ns - newest_ns) * 1e-9) for one in heard]
    )
    measurements = np.column_stack([ages_s, rows[:, GROUP]])
    rows[:, GROUP] = np.unique(measurements, axis=0, return_inverse=True)[1].reshape(-1)
    return rows, ages_s, _name_states_of_fit(rows, ages_s, slow)


def with_free_clock(
    rows: Array, ages_s: Array, errors_sd: Array
) -> tuple[Array, Array, Array] | None:
    """The same as ``stacked`` gives it if the clock of the device is anything at each instant: an
    error of all times of that instant. Where there are many instants the times of some of them
    are left out. None where no two RSUs hear the device at one instant: times say nothing then."""
    timed = np.flatnonzero([BY_KIND[int(kind)].has_clock for kind in rows[:, KIND]])
    instants, which = np.unique(ages_s[timed], return_inverse=True)
    if instants.size == timed.size:
        return None
    every = math.ceil(instants.size / _INSTANTS)
    keep, own = np.ones(len(rows), bool), which.reshape(-1) // every
    keep[timed] = which.reshape(-1) % every == 0
    rows = rows.copy()
    rows[timed, REFERENCE] = N_CORE + errors_sd.size + own
    free = np.full(int(own.max()) + 1, SPEED_OF_LIGHT_MPS * _ANY_WALK_S)
    return rows[keep], ages_s[keep], np.append(errors_sd, free)


def problem_of(
    cfg: TrackerConfig, rsus: Sequence[Rsu], rows: Array, ages_s: Array, errors_sd: Array
) -> Problem:
    """The fit of ``rows`` (m, ROW_WIDTH), some of those that ``stacked`` gives."""
    c = SPEED_OF_LIGHT_MPS
    origins = np.array([rsu.info.position[:2] for rsu in rsus])
    fixes = rows[rows[:, KIND] == Kind.LINEAR]
    centre = origins.mean(axis=0) if len(origins) else np.zeros(2)
    reach = cfg.coverage_radius_m if len(origins) or not len(fixes) else _ANYWHERE_M
    if len(origins):
        reach = max(reach, float(np.linalg.norm(origins - centre, axis=1).max()))
    prior = np.array([*centre, 0.0, 0.0, 0.0, c * cfg.clock_drift_mean])
    sd = np.array([reach, reach, *([cfg.initial_speed_sd_mps] * 2)])
    clock_sd = c * np.array([cfg.clock_offset_sd_s, max(cfg.clock_drift_sd, 1e-15)])
    span_s = max(-float(ages_s.min()), _LEAST_SPAN_S)
    parts = min(math.ceil(span_s / _PART_S), _PARTS_MAX)
    accel = held(cfg.accel_density_mps2_sqrthz, Density.ACCEL)
    walk = c * cfg.clock_walk_density  # 0 where nobody knows it
    turns_sd = parts * [_acceleration_sd(q, span_s / parts) for q in (accel, accel, walk)]
    errors_sd = np.maximum([*errors_sd, *turns_sd], _LEAST_SD)
    prior_var = np.concatenate([sd, np.maximum(clock_sd, 1e-6), errors_sd]) ** 2
    prior = np.append(prior, np.zeros(errors_sd.size))
    first = prior.size - len(turns_sd)
    height_m, outliers = cfg.device_height_m, _outlier_shares(rows)
    window = Window(ages_s, rows, height_m, first, span_s / parts, parts, outliers)
    return Problem(window, prior, prior_var)


def _outlier_shares(rows: Array) -> Array:
    """The probability of each of ``rows`` (m, ROW_WIDTH) that it is an outlier (m,): 0 where its
    RSU has measured the quantity fewer than three times. Nobody can tell an outlier from a wrong
    RSU then."""
    sources = np.column_stack([rows[:, KIND], rows[:, ORIGIN:AXES]])
    _, which, counts = np.unique(sources, axis=0, return_inverse=True, return_counts=True)
    shares = np.array([share_of_outliers(row) for row in rows])
    return np.where(counts[which.reshape(-1)] < _TELLING, 0.0, shares)


def _acceleration_sd(density: float, part_s: float) -> float:
    """Sd of a constant acceleration [m/s^2] that moves as far in ``part_s`` seconds as white
    acceleration of the ``density`` q does: q^2 T^3 / 3 = (a T^2 / 2)^2."""
    return 2.0 * density / math.sqrt(3.0 * part_s)


def _name_states_of_fit(rows: Array, ages_s: Array, slow: SlowErrors) -> Array:
    """Let ``rows`` (m, ROW_WIDTH) name the ``slow`` errors as states of the fit, in place: behind
    those of the device first those that last, then the others, of every epoch its own. Their
    sd."""
    sd, rank = slow.sd[slow.lasts], np.cumsum(slow.lasts) - 1
    for column in (BIAS, COMMON, REFERENCE, HEIGHT):
        named = np.flatnonzero(rows[:, column] >= slow.first)
        error = rows[named, column].astype(int) - slow.first
        lasts = slow.lasts[error]
        rows[named[lasts], column] = N_CORE + rank[error[lasts]]
        new, error = named[~lasts], error[~lasts]
        if new.size:
            epochs = np.column_stack([error, ages_s[new]])
            _, first, which = np.unique(epochs, axis=0, return_index=True, return_inverse=True)
            rows[new, column] = N_CORE + sd.size + which.reshape(-1)
            sd = np.append(sd, slow.sd[error[first]])
    return sd
