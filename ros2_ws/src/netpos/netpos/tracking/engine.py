"""One epoch of one track, compiled: predict, gate, second look, recover. The same kernel serves
the live track, the replay and Monte Carlo runs of thousands of routes."""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np

from netpos.filters import conditioning, ekf, kf, srukf, ukf
from netpos.filters.compile import kernel, leaf
from netpos.filters.manoeuvre import add_manoeuvre, unnoticed_s
from netpos.filters.measurement import GROUP
from netpos.filters.motion import SPEED_OF_LIGHT_MPS, Parameter, add_jump
from netpos.filters.state import X
from netpos.messages.values import Array

GATE_SIZE = 65
_FARTHEST_M = 1e9  # no measurement may say more
_ROUNDING = 1e-15  # of turned axes


class Option(IntEnum):
    """Entries of the vector ``options``; ``GATE_SIZE`` thresholds of the gate follow them."""

    FILTER = 0  # Filter
    ITERATIONS = 1
    HEIGHT = 2  # of the device [m]
    INFLATE_AFTER = 3  # epochs rejected in a row
    LOST_AFTER = 4  # epochs rejected in a row
    INITIAL_SPEED = 5  # sd [m/s] to which the velocity opens then
    MANOEUVRE_SPEED = 6  # sd [m/s] of the second look; 0: none
    ROBUST = 7  # conditioning.Robust
    ROBUST_PARAMETER = 8
    NLOS_PROBABILITY = 9
    NLOS_EXCESS = 10  # mean [m]
    POSITION_GAIN = 11
    VELOCITY_GAIN = 12
    ACCEL_GAIN = 13


GATE = len(Option)


class Filter(IntEnum):
    """Entries of ``Option.FILTER``, in the order of ``config.FILTERS``."""

    EKF = 0
    IEKF = 1
    UKF = 2
    SRUKF = 3
    KF = 4


@kernel
def scratch(n: int, m: int) -> tuple[Array, Array]:
    """Scratch memory ``work`` and ``spare`` for ``step`` with up to ``n`` states and ``m`` rows;
    ``spare`` has to have exactly n columns."""
    return ekf.workspace(n, m), np.zeros((2 * (n + 1), n))


def to_spread(cov: Array, options: Array) -> Array:
    """What the filter carries instead of the covariance: its lower Cholesky factor where it is a
    square-root filter, a copy otherwise."""
    if int(options[Option.FILTER]) == Filter.SRUKF:
        factor: Array = srukf.factor(cov)
        return factor
    return cov.copy()


def to_cov(spread: Array, options: Array) -> Array:
    """Covariance (n, n) of what the filter carries."""
    if int(options[Option.FILTER]) == Filter.SRUKF:
        cov: Array = srukf.covariance(spread)
        return cov
    return spread


@leaf
def predict(
    mean: Array, spread: Array, dt: float, motion: Array, bias: Array, options: Array
) -> None:
    """Move mean (n,) and spread (n, n) by ``dt`` seconds in place; nothing happens for dt <= 0.
    A velocity step noted in ``motion`` is over."""
    motion[Parameter.JUMP_SPEED] = 0.0
    kind = int(options[Option.FILTER])
    if kind == Filter.UKF:
        ukf.predict(mean, spread, dt, motion, bias)
    elif kind == Filter.SRUKF:
        srukf.predict(mean, spread, dt, motion, bias)
    else:
        ekf.predict(mean, spread, dt, motion, bias)


@leaf
def update(
    mean: Array, spread: Array, rows: Array, options: Array, accepted: Array, work: Array
) -> tuple[float, int]:
    """Gate and apply one epoch, in place: NIS of the accepted rows and their number; ``accepted``
    (groups,) is filled."""
    kind = int(options[Option.FILTER])
    height_m, gate = options[Option.HEIGHT], options[GATE:]
    if kind == Filter.UKF:
        nis, used = ukf.update(mean, spread, rows, height_m, gate, accepted)
    elif kind == Filter.SRUKF:
        nis, used = srukf.update(mean, spread, rows, height_m, gate, accepted)
    elif kind == Filter.KF:
        floor = options[Option.POSITION_GAIN : GATE]
        nis, used = kf.update(mean, spread, rows, height_m, gate, accepted, floor)
    else:
        iterations = int(options[Option.ITERATIONS])
        nis, used = ekf.update(mean, spread, rows, height_m, gate, iterations, accepted, work)
    return nis, used


@leaf
def open_velocity(spread: Array, sd: float, unheard_s: float, options: Array) -> None:
    """Add, in place, a velocity step of ``sd`` [m/s] per axis at some time in the last
    ``unheard_s`` seconds, and the position it leads to."""
    if int(options[Option.FILTER]) == Filter.SRUKF:
        _open_factor(spread, sd, unheard_s)
        return
    add_jump(sd, unheard_s, 0.0, spread)


@kernel
def _open_factor(spread: Array, sd: float, unheard_s: float) -> None:
    for p in range(2):
        x = np.zeros(spread.shape[0])
        x[X.PX + p], x[X.VX + p] = sd * unheard_s, sd
        srukf.cholesky_update(spread, x, 1.0)


@kernel
def manoeuvre_s(
    mean: Array, spread: Array, rows: Array, unheard_s: float, options: Array
) -> float:
    """Time [s] in which a manoeuvre may have begun, seen from the prediction: since the last
    accepted measurement, or for as long as it goes unnoticed. A step of the velocity that its own
    sd allows for is followed, and no manoeuvre."""
    cov = spread
    if int(options[Option.FILTER]) == Filter.SRUKF:
        cov = srukf.covariance(spread)
    h, height_m = np.empty(mean.size), options[Option.HEIGHT]
    speed, gate = options[Option.MANOEUVRE_SPEED], options[GATE + 2]
    if 2.0 * speed * speed <= cov[X.VX, X.VX] + cov[X.VY, X.VY]:
        return unheard_s
    typical_s, _ = unnoticed_s(mean, cov, rows, height_m, gate, speed, h)
    return max(unheard_s, typical_s if math.isfinite(typical_s) else 0.0)


@kernel
def allow_manoeuvre(spread: Array, within_s: float, options: Array) -> None:
    """Add, in place, a velocity step of the manoeuvre speed at any time of the last ``within_s``
    seconds."""
    speed = options[Option.MANOEUVRE_SPEED]
    if int(options[Option.FILTER]) != Filter.SRUKF:
        add_manoeuvre(speed, within_s, spread)
        return
    _open_factor(spread, speed, within_s / 2.0)
    for p in range(2):
        x = np.zeros(spread.shape[0])
        x[X.PX + p] = speed * within_s / math.sqrt(12.0)
        srukf.cholesky_update(spread, x, 1.0)


@leaf
def note_jump(
    motion: Array, opened_sd: float, unheard_s: float, manoeuvre_sd: float, within_s: float
) -> None:
    """Leave in ``motion`` the velocity steps allowed for, one ``unheard_s`` ago and one at any
    time of the last ``within_s`` seconds, as one."""
    opened2, manoeuvre2 = opened_sd * opened_sd, manoeuvre_sd * manoeuvre_sd
    speed2 = opened2 + manoeuvre2
    motion[Parameter.JUMP_SPEED] = math.sqrt(speed2)
    if speed2 == 0.0:
        return
    time_s = (opened2 * unheard_s + manoeuvre2 * within_s / 2.0) / speed2
    position2 = opened2 * unheard_s * unheard_s + manoeuvre2 * within_s * within_s / 3.0
    motion[Parameter.JUMP_TIME] = time_s
    motion[Parameter.JUMP_SPREAD] = math.sqrt(max(position2 - speed2 * time_s * time_s, 0.0))


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
def _copy(mean: Array, spread: Array, to_mean: Array, to_spread: Array) -> None:
    for a in range(mean.size):
        to_mean[a] = mean[a]
        for b in range(mean.size):
            to_spread[a, b] = spread[a, b]


@leaf
def _count(accepted: Array, groups: int) -> int:
    taken = 0
    for g in range(groups):
        taken += int(accepted[g])
    return taken


@leaf
def step(
    mean: Array,
    spread: Array,
    dt: float,
    unheard_s: float,
    rejected_in_row: int,
    rows: Array,
    motion: Array,
    bias: Array,
    options: Array,
    accepted: Array,
    work: Array,
    spare: Array,
) -> tuple[float, int, int]:
    """Predict by ``dt`` and apply one epoch, in place.

    A first look gates with the prediction. Where it rejects something, a second look that allows
    for a manoeuvre in the time it may have gone unnoticed is taken if it accepts more. After
    ``INFLATE_AFTER`` epochs rejected in a row the velocity opens to its initial sd. Nothing
    accepted leaves the prediction.

    rows : (m, ROW_WIDTH), groups numbered 0, 1, ...; the robust options re-weight them in place
    unheard_s : since the last accepted measurement
    accepted : (2, groups), the first row filled with 0 or 1

    Returns the NIS of the accepted rows, their number, the number of accepted groups. The velocity
    step allowed for is left in ``motion`` (``note_jump``), for a smoother to know.
    """
    n, groups = mean.size, int(rows[rows.shape[0] - 1, GROUP]) + 1
    predict(mean, spread, dt, motion, bias, options)
    prior_mean, prior_spread = spare[0], spare[1 : n + 1]
    second_mean, second_spread = spare[n + 1], spare[n + 2 :]
    _copy(mean, spread, prior_mean, prior_spread)
    opened = rejected_in_row >= options[Option.INFLATE_AFTER]
    jump = options[Option.INITIAL_SPEED] if opened else 0.0
    turn, within_s = 0.0, 0.0
    if opened:
        open_velocity(spread, jump, unheard_s, options)
    if options[Option.ROBUST] > 0.0 or options[Option.NLOS_PROBABILITY] > 0.0:
        condition(mean, spread, rows, options, work)
    nis, used = update(mean, spread, rows, options, accepted[0], work)
    taken = _count(accepted[0], groups)
    manoeuvre = options[Option.MANOEUVRE_SPEED]
    if taken < groups and manoeuvre > 0.0:
        _copy(prior_mean, prior_spread, second_mean, second_spread)
        if opened:
            open_velocity(second_spread, jump, unheard_s, options)
        within_s = manoeuvre_s(prior_mean, prior_spread, rows, unheard_s, options)
        allow_manoeuvre(second_spread, within_s, options)
        second_nis, second_used = update(
            second_mean, second_spread, rows, options, accepted[1], work
        )
        if _count(accepted[1], groups) > taken:
            nis, used, taken = second_nis, second_used, _count(accepted[1], groups)
            _copy(second_mean, second_spread, mean, spread)
            for g in range(groups):
                accepted[0, g] = accepted[1, g]
            turn = manoeuvre
    if taken == 0:
        _copy(prior_mean, prior_spread, mean, spread)
    else:
        note_jump(motion, jump, unheard_s, turn, within_s)
    return nis, used, taken


@kernel
def condition(mean: Array, spread: Array, rows: Array, options: Array, work: Array) -> None:
    """Re-weight the rows in place as the robust options say."""
    cov = spread
    if int(options[Option.FILTER]) == Filter.SRUKF:
        cov = srukf.covariance(spread)
    conditioning.condition(
        mean,
        cov,
        rows,
        options[Option.HEIGHT],
        int(options[Option.ROBUST]),
        options[Option.ROBUST_PARAMETER],
        options[Option.NLOS_PROBABILITY],
        options[Option.NLOS_EXCESS],
        work,
    )


@kernel
def run_epochs(
    stamps_ns: Array,
    row_start: Array,
    rows: Array,
    mean: Array,
    cov: Array,
    motion: Array,
    bias: Array,
    options: Array,
    means: Array,
    covs: Array,
    nis: Array,
    dof: Array,
    taken: Array,
) -> int:
    """A whole run: ``step`` for every epoch, from ``mean`` (n,), ``cov`` (n, n) valid at the
    first stamp (a square-root filter takes and gives covariances, too).

    stamps_ns : (N,) integers, increasing; row_start : (N + 1,) integers, epoch k has the rows
    row_start[k] to row_start[k + 1], none or more; rows : (M, ROW_WIDTH), not changed
    means (N, n), covs (N, n, n), nis (N,), dof (N,), taken (N,) : filled per epoch

    Returns the number of epochs done: less than N where the track was lost, that is after
    ``LOST_AFTER`` epochs rejected in a row.
    """
    n, epochs = mean.size, stamps_ns.size
    most = 1
    for k in range(epochs):
        most = max(most, row_start[k + 1] - row_start[k])
    work, spare = scratch(n, most)
    accepted, own = np.zeros((2, most)), np.empty((most, rows.shape[1]))
    square_root = int(options[Option.FILTER]) == Filter.SRUKF
    x = mean.copy()
    S = srukf.factor(cov) if square_root else cov.copy()
    rejected_in_row = 0
    last_ns = heard_ns = stamps_ns[0]
    for k in range(epochs):
        dt = (stamps_ns[k] - last_ns) * 1e-9
        last_ns = stamps_ns[k]
        m = row_start[k + 1] - row_start[k]
        if m == 0:
            predict(x, S, dt, motion, bias, options)
            nis[k], dof[k], taken[k] = 0.0, 0, 0
        else:
            own[:m] = rows[row_start[k] : row_start[k + 1]]
            unheard_s = (last_ns - heard_ns) * 1e-9
            nis[k], dof[k], taken[k] = step(
                x,
                S,
                dt,
                unheard_s,
                rejected_in_row,
                own[:m],
                motion,
                bias,
                options,
                accepted,
                work,
                spare,
            )
            groups = int(own[m - 1, GROUP]) + 1
            rejected_in_row = 0 if 2 * taken[k] >= groups else rejected_in_row + 1
            if taken[k] > 0:
                heard_ns = last_ns
        means[k] = x
        covs[k] = srukf.covariance(S) if square_root else S
        if rejected_in_row >= options[Option.LOST_AFTER]:
            return k + 1
    return epochs
