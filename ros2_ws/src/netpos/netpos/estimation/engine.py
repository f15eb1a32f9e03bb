"""One epoch of one component, compiled: predict, gate, update, recover. The same kernel serves the
live track, the replay and Monte Carlo runs of thousands of routes."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from netpos.estimation.compile import kernel, leaf, spliced
from netpos.estimation.forms import choice
from netpos.estimation.forms.table import FORMS
from netpos.estimation.level.manoeuvre import detection_delay_s
from netpos.estimation.motion import SPEED_OF_LIGHT_MPS, Parameter
from netpos.estimation.sensors.row import group_count
from netpos.estimation.state import X
from netpos.estimation.update import conditioning, fusion, slow_errors
from netpos.estimation.update.conditioning import Robust, RobustOptions
from netpos.estimation.update.predicted import PredictedRows, predict_rows
from netpos.messages.values import Array

Ints = npt.NDArray[np.int64]

GATE_SIZE = 65
_FARTHEST_M = 1e9  # no measurement may say more
_ROUNDING = 1e-15  # of turned axes


class FilterOptions(NamedTuple):
    """What a filter is told once; ``models.options_of`` makes it from the parameters."""

    filter: int  # place in ``forms.table.FORMS``
    iterations: int
    height_m: float  # of the device
    inflate_after: int  # epochs rejected in a row
    lost_after: int  # epochs rejected in a row
    initial_speed_sd: float  # [m/s] to which the velocity opens then
    manoeuvre_speed_sd: float  # [m/s] of a manoeuvre; 0: none
    integrity_risk: float  # share of errors that may exceed the protection level
    robust: RobustOptions
    models: int  # motion models that interact; 1: none
    first_slow_error: int  # index of the state from which on the form follows slow errors
    sector_slip: float  # least probability of a sector of a phase; 0: they are no components
    learns_density: tuple[bool, bool]  # the densities of acceleration and clock (``densities``)
    of_form: Array  # what the form has of its own (``FilterForm.parameters``)
    gate_nis: Array  # (GATE_SIZE,) largest accepted NIS for 0, 1, ... degrees of freedom


class EpochInput(NamedTuple):
    """What one epoch brings: seconds since the last one and since the last accepted measurement,
    the last seconds of which no component says whether the device turned, epochs rejected in a row
    before it, and rows (m, ROW_WIDTH), groups numbered 0, 1, ..."""

    dt_s: float
    unheard_s: float
    open_s: float
    rejected_in_row: int
    rows: Array


class StepResult(NamedTuple):
    """What came of an epoch: NIS of the accepted rows, their number, that of accepted groups."""

    nis: float
    used: int
    groups: int


class Scratch(NamedTuple):
    """Memory of ``predict_epoch`` and ``update_epoch``: of ``update.fusion.workspace``, groups
    accepted (groups,), the prediction (n,), (n, n), and the covariance (n, n) that the rows met:
    that of the prediction with what ``open_velocity`` added."""

    work: Array
    accepted: Array
    prior_mean: Array
    prior_cov_or_sqrt: Array
    prior_cov: Array
    met_cov: Array


class Epochs(NamedTuple):
    """The epochs of a run: stamps_ns (N,) increasing; epoch k has the rows row_start[k] to
    row_start[k + 1], none or more."""

    stamps_ns: Ints
    row_start: Ints  # (N + 1,)
    rows: Array  # (M, ROW_WIDTH)


class Run(NamedTuple):
    """What a filter made of N epochs: means (N, n), covs (N, n, n) of the mixture; of the accepted
    rows nis (N,), dof (N,) their number and groups (N,) that of their groups; radius (N,) [m] that
    a mixture leaves with the integrity risk, 0 where there is one component; undetected_m (N,) how
    far a manoeuvre that an epoch does not show may have taken the device; densities (N, 2) of the
    process noise (``densities``)."""

    means: Array
    covs: Array
    nis: Array
    dof: Array
    groups: Array
    radius: Array
    undetected_m: Array
    densities: Array


def empty_run(epochs: int, n: int) -> Run:
    """A run of ``epochs`` and ``n`` states, to be filled."""
    means, covs = np.full((epochs, n), np.nan), np.full((epochs, n, n), np.nan)
    nis, dof, groups, radius, undetected_m = np.zeros((5, epochs))
    return Run(means, covs, nis, dof, groups, radius, undetected_m, np.zeros((epochs, 2)))


@kernel
def scratch(n: int, m: int) -> Scratch:
    """Memory for one component with ``n`` states and up to ``m`` rows."""
    work, square = fusion.workspace(n, m), np.zeros((3, n, n))
    return Scratch(work, np.zeros(m), np.zeros(n), square[0], square[1], square[2])


def to_cov_or_sqrt(cov: Array, options: FilterOptions) -> Array:
    """What the filter carries instead of the covariance, as a new array."""
    write, cov_or_sqrt = FORMS[options.filter].write_cov_or_sqrt, cov.copy()
    if write is not None:
        write(cov, cov_or_sqrt)
    return cov_or_sqrt


def to_cov(cov_or_sqrt: Array, options: FilterOptions) -> Array:
    """Covariance (n, n) of what the filter carries; the same array where that is a covariance."""
    write = FORMS[options.filter].write_cov
    if write is None:
        return cov_or_sqrt
    cov = np.empty_like(cov_or_sqrt)
    write(cov_or_sqrt, cov)
    return cov


@kernel
def cov_of(cov_or_sqrt: Array, options: FilterOptions) -> Array:
    """Covariance (n, n) of what the filter carries, as a new array."""
    cov = np.empty_like(cov_or_sqrt)
    choice.write_cov(options.filter, cov_or_sqrt, cov)
    return cov


@kernel
def cov_or_sqrt_of(cov: Array, options: FilterOptions) -> Array:
    """``to_cov_or_sqrt``, compiled."""
    cov_or_sqrt = np.empty_like(cov)
    choice.write_cov_or_sqrt(options.filter, cov, cov_or_sqrt)
    return cov_or_sqrt


@leaf
def predict(
    mean: Array, cov_or_sqrt: Array, dt: float, motion: Array, bias: Array, options: FilterOptions
) -> None:
    """Move mean (n,) and cov_or_sqrt (n, n) by ``dt`` seconds in place; nothing happens for dt <=
    0. A velocity step noted in ``motion`` is over."""
    motion[Parameter.VELOCITY_STEP_SD] = 0.0
    choice.predict(options.filter, mean, cov_or_sqrt, dt, motion, bias)


@kernel
def predict_to(
    mean: Array,
    cov_or_sqrt: Array,
    dt: float,
    rows: Array,
    motion: Array,
    bias: Array,
    options: FilterOptions,
) -> None:
    """``predict`` to an epoch of ``rows`` (m, ROW_WIDTH), whose tangents slow errors follow
    (``slow_errors``)."""
    predict(mean, cov_or_sqrt, dt, motion, bias, options)
    first = options.first_slow_error
    if mean.size > first:
        cov = cov_of(cov_or_sqrt, options)
        slow_errors.follow_prediction(mean, cov, first, rows, dt, options.height_m)
        choice.write_cov_or_sqrt(options.filter, cov, cov_or_sqrt)


@spliced
def update_with_gate(
    mean: Array,
    cov_or_sqrt: Array,
    rows: Array,
    options: FilterOptions,
    gate_nis: Array,
    accepted: Array,
    work: Array,
) -> tuple[float, int]:
    """``update`` with another gate than that of the options."""
    nis, used = choice.update(
        options.filter, mean, cov_or_sqrt, rows, options, gate_nis, accepted, work
    )
    return nis, used


@leaf
def update(
    mean: Array,
    cov_or_sqrt: Array,
    rows: Array,
    options: FilterOptions,
    accepted: Array,
    work: Array,
) -> tuple[float, int]:
    """Gate and apply one epoch, in place, the rows of which are predicted in ``work``: NIS of the
    accepted rows and their number; ``accepted`` (groups,) is filled."""
    gate_nis = options.gate_nis
    nis, used = update_with_gate(mean, cov_or_sqrt, rows, options, gate_nis, accepted, work)
    return nis, used


@leaf
def open_velocity(cov_or_sqrt: Array, sd: float, unheard_s: float, options: FilterOptions) -> None:
    """Add, in place, a velocity step of ``sd`` [m/s] per axis at some time in the last
    ``unheard_s`` seconds, and the position it leads to."""
    choice.add_velocity_step(options.filter, sd, unheard_s, 0.0, cov_or_sqrt)


@kernel
def manoeuvre_s(
    cov: Array, rows: Array, predicted: PredictedRows, unheard_s: float, options: FilterOptions
) -> float:
    """Time [s] in which a manoeuvre may have begun, seen from a prediction with cov (n, n): since
    the last accepted measurement, or for as long as it goes unnoticed. A step of the velocity that
    its own sd allows for is followed, and no manoeuvre."""
    speed, gate = options.manoeuvre_speed_sd, options.gate_nis[2]
    if 2.0 * speed * speed <= cov[X.VX, X.VX] + cov[X.VY, X.VY]:
        return unheard_s
    typical_s, _ = detection_delay_s(rows, predicted, cov.shape[0], gate, speed)
    return max(unheard_s, typical_s if math.isfinite(typical_s) else 0.0)


@leaf
def set_velocity_step_noise(
    motion: Array, opened_sd: float, unheard_s: float, manoeuvre_sd: float, within_s: float
) -> None:
    """Leave in ``motion`` the velocity steps allowed for, one ``unheard_s`` ago and one at any
    time of the last ``within_s`` seconds, as one."""
    opened2, manoeuvre2 = opened_sd * opened_sd, manoeuvre_sd * manoeuvre_sd
    speed2 = opened2 + manoeuvre2
    motion[Parameter.VELOCITY_STEP_SD] = math.sqrt(speed2)
    if speed2 == 0.0:
        return
    time_s = (opened2 * unheard_s + manoeuvre2 * within_s / 2.0) / speed2
    position2 = opened2 * unheard_s * unheard_s + manoeuvre2 * within_s * within_s / 3.0
    motion[Parameter.VELOCITY_STEP_AGE] = time_s
    motion[Parameter.VELOCITY_STEP_POSITION_SD] = math.sqrt(
        max(position2 - speed2 * time_s * time_s, 0.0)
    )


@leaf
def is_sound(mean: Array, cov: Array) -> bool:
    """Whether the state can be a device's: on earth, slower than light, its position and velocity
    covariances definite in whatever axes they are told."""
    if not (abs(mean[X.PX]) < _FARTHEST_M and abs(mean[X.PY]) < _FARTHEST_M):
        return False
    if not math.hypot(mean[X.VX], mean[X.VY]) < SPEED_OF_LIGHT_MPS:
        return False
    for p in (X.PX, X.VX):
        a, b, c = cov[p, p], cov[p, p + 1], cov[p + 1, p + 1]
        if not (a > 0.0 and a * c - b * b > _ROUNDING * (a + c) ** 2):
            return False
    return True


@leaf
def _copy(mean: Array, cov_or_sqrt: Array, to_mean: Array, to_cov_or_sqrt: Array) -> None:
    for a in range(mean.size):
        to_mean[a] = mean[a]
        for b in range(mean.size):
            to_cov_or_sqrt[a, b] = cov_or_sqrt[a, b]


@leaf
def _count(accepted: Array, groups: int) -> int:
    taken = 0
    for g in range(groups):
        taken += int(accepted[g])
    return taken


@leaf
def predict_epoch(
    mean: Array,
    cov_or_sqrt: Array,
    epoch: EpochInput,
    motion: Array,
    bias: Array,
    options: FilterOptions,
    scratch: Scratch,
) -> None:
    """Move one component to an epoch, in place, and see its rows from there.

    After ``inflate_after`` epochs rejected in a row the velocity opens to its initial sd.
    ``scratch`` keeps the prediction without that, and the rows as the component sees them
    (``update.fusion.predicted_in``).
    """
    predict_to(mean, cov_or_sqrt, epoch.dt_s, epoch.rows, motion, bias, options)
    _copy(mean, cov_or_sqrt, scratch.prior_mean, scratch.prior_cov_or_sqrt)
    choice.write_cov(options.filter, cov_or_sqrt, scratch.prior_cov)
    if epoch.rejected_in_row >= options.inflate_after:
        open_velocity(cov_or_sqrt, options.initial_speed_sd, epoch.unheard_s, options)
    choice.write_cov(options.filter, cov_or_sqrt, scratch.met_cov)
    predicted = fusion.predicted_in(scratch.work, mean.size, epoch.rows.shape[0])
    predict_rows(mean, scratch.met_cov, epoch.rows, options.height_m, predicted)


@leaf
def update_epoch(
    mean: Array,
    cov_or_sqrt: Array,
    epoch: EpochInput,
    motion: Array,
    options: FilterOptions,
    scratch: Scratch,
) -> StepResult:
    """Apply an epoch to one component after ``predict_epoch``, in place.

    Nothing accepted leaves the prediction. ``scratch`` keeps 0 or 1 of each group in ``accepted``.
    The robust options re-weight the rows in place. The velocity step allowed for is left in
    ``motion`` (``set_velocity_step_noise``), for a smoother to know.
    """
    rows = epoch.rows
    groups = group_count(rows)
    if options.robust.kind != Robust.NONE or options.robust.nlos_probability > 0.0:
        predicted = fusion.predicted_in(scratch.work, mean.size, rows.shape[0])
        conditioning.reweight(scratch.met_cov, rows, predicted, options.robust)
    nis, used = update(mean, cov_or_sqrt, rows, options, scratch.accepted, scratch.work)
    taken = _count(scratch.accepted, groups)
    if taken == 0:
        _copy(scratch.prior_mean, scratch.prior_cov_or_sqrt, mean, cov_or_sqrt)
    else:
        opened = epoch.rejected_in_row >= options.inflate_after
        opened_sd = options.initial_speed_sd if opened else 0.0
        set_velocity_step_noise(motion, opened_sd, epoch.unheard_s, 0.0, 0.0)
    return StepResult(nis, used, taken)
