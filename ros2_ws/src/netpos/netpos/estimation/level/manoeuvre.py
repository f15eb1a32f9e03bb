"""A manoeuvre nobody has noticed yet: how long it may have been going on, and what it does.

A device that turns leaves its prediction slowly at first. Until a measurement fails its gate the
filter follows in part, in the directions that are measured, and goes on straight in the others.
Where measurements see it, the device is no farther from the prediction than their gate allows. The
step of the velocity lies anywhere in the time in which it stays unnoticed, not in the last
interval.

Most devices that turn keep their speed and turn to a side, where a street or a corridor crosses
theirs. What is declared says how large steps are; those as large as such a turn are turns.
"""

from __future__ import annotations

import math

import numpy as np

from netpos.estimation.compile import kernel, leaf
from netpos.estimation.factor import eigenvalues, factor_in_place, solve_lower
from netpos.estimation.measurement import GATE_VARIANCE
from netpos.estimation.motion import add_velocity_step
from netpos.estimation.state import POSITION, VELOCITY, X
from netpos.estimation.update.predicted import PredictedRows, prior_cov_of
from netpos.messages.values import Array

# A turn to a side: steps of the velocity from 0.65 to 1.35 times its size are taken for such
# turns; its speed and its angle differ by so much.
TURN_SIZES = 0.7
TURN_ANGLE_SD = math.radians(25.0)
TURN_SPEED_SD = 0.25  # of the speed


@kernel
def _information(rows: Array, predicted: PredictedRows, n: int) -> Array:
    """What ``rows`` (m, ROW_WIDTH) together tell of a change of x, y, vx and vy (4, 4) that the
    prediction of ``n`` states does not foresee. Its own uncertainty is noise, and what rows share
    of it, a clock or the error of a common reference, is one noise: H' S^-1 H = W' W with the
    factor L of S and L W = H."""
    m = rows.shape[0]
    S = prior_cov_of(predicted, np.arange(m), n)
    for i in range(m):
        S[i, i] += rows[i, GATE_VARIANCE] + predicted.second_order_var[i]
    W, information = predicted.H[:m, X.PX : X.VY + 1].copy(), np.zeros((4, 4))
    factor_in_place(S)
    solve_lower(S, W)
    for i in range(m):
        for a in range(4):
            for b in range(4):
                information[a, b] += W[i, a] * W[i, b]
    return information


@kernel
def detection_delay_s(
    rows: Array, predicted: PredictedRows, n: int, gate: float, speed: float
) -> tuple[float, float]:
    """Time [s] until a velocity step of ``speed`` [m/s] takes ``rows`` (m, ROW_WIDTH) as far off
    where ``n`` states ``predicted`` them as ``gate``, a squared Mahalanobis distance, allows: for
    a step in any direction, and for one in the direction they know least (inf: not at all). A
    measured velocity shows the step at once, the longest time is then an upper bound."""
    information = _information(rows, predicted, n)
    xx, xy, yy = information[0, 0], information[0, 1], information[1, 1]
    velocity_xx, velocity_xy = information[2, 2], information[2, 3]
    velocity_yy = information[3, 3]
    least, _ = eigenvalues(xx, xy, yy)
    least_velocity, _ = eigenvalues(velocity_xx, velocity_xy, velocity_yy)
    step2 = speed * speed
    left = max(2.0 * gate - step2 * (velocity_xx + velocity_yy), 0.0)
    left_least = max(gate - step2 * max(least_velocity, 0.0), 0.0)
    typical = longest = math.inf
    if left == 0.0 or xx + yy > 0.0:
        typical = math.sqrt(left / (xx + yy)) / speed if left > 0.0 else 0.0
    if left_least == 0.0 or least > 1e-12 * (xx + yy):
        longest = math.sqrt(left_least / least) / speed if left_least > 0.0 else 0.0
    return typical, longest


@leaf
def _measures_both(H: Array, x: int, y: int) -> bool:
    """Whether rows with the Jacobian H (m, n) measure the states ``x`` and ``y`` in more than one
    direction, however steep each row is."""
    xx = xy = yy = 0.0
    for i in range(H.shape[0]):
        slope2 = H[i, x] * H[i, x] + H[i, y] * H[i, y]
        if slope2 > 0.0:
            xx += H[i, x] * H[i, x] / slope2
            xy += H[i, x] * H[i, y] / slope2
            yy += H[i, y] * H[i, y] / slope2
    least, largest = eigenvalues(xx, xy, yy)
    return bool(least > 1e-6 * largest)


@leaf
def measures_velocity(H: Array) -> bool:
    """Whether rows with the Jacobian H (m, n) measure both axes of the velocity."""
    return bool(_measures_both(H, X.VX, X.VY))


@leaf
def measures_position(H: Array) -> bool:
    """Whether rows with the Jacobian H (m, n) measure both axes of the position."""
    return bool(_measures_both(H, X.PX, X.PY))


@leaf
def manoeuvre_moments(speed: float, within_s: float) -> tuple[float, float]:
    """Mean age [s] of a velocity step of sd ``speed`` [m/s] at any time of the last ``within_s``
    seconds, and the sd [m] of the position it led to at a known age."""
    return within_s / 2.0, speed * within_s / math.sqrt(12.0)


@leaf
def add_manoeuvre(speed: float, within_s: float, cov: Array) -> None:
    """Add, in place, a velocity step of sd ``speed`` [m/s] per axis at any time of the last
    ``within_s`` seconds, and the position it led to."""
    time_s, position_sd = manoeuvre_moments(speed, within_s)
    add_velocity_step(speed, time_s, position_sd, cov)


@leaf
def side_turns(mean: Array, cov: Array, speed_sd: float) -> float:
    """Probability that a manoeuvre of a device with the state mean (n,), cov (n, n) is such a
    turn: as many steps of sd ``speed_sd`` [m/s] per axis are about as large (Rayleigh's density).
    None where the velocity is less certain than the angle of such a turn: it has no side then."""
    speed2 = mean[X.VX] * mean[X.VX] + mean[X.VY] * mean[X.VY]
    if cov[X.VX, X.VX] + cov[X.VY, X.VY] > TURN_ANGLE_SD * TURN_ANGLE_SD * speed2:
        return 0.0
    ratio2 = 2.0 * speed2 / (speed_sd * speed_sd)
    return float(TURN_SIZES * ratio2 * math.exp(-0.5 * ratio2))


@kernel
def turn_to_side(side: float, within_s: float, mean: Array, cov: Array) -> None:
    """Turn the state mean (n,), cov (n, n), in place, by about 90 degrees to the left (``side`` 1)
    or right (-1) at any time of the last ``within_s`` seconds: by its moments."""
    age_s, n = within_s / 2.0, mean.size
    turned = np.array([[0.0, -side], [side, 0.0]])
    change = turned - np.eye(2)
    F = np.eye(n)
    F[VELOCITY, VELOCITY] = turned
    F[POSITION, VELOCITY] = age_s * change
    step = change @ mean[VELOCITY]
    step2 = np.outer(step, step) + change @ cov[VELOCITY, VELOCITY].copy() @ change.T
    mean[:] = F @ mean
    along, across = mean[VELOCITY], turned @ mean[VELOCITY]
    spread = TURN_SPEED_SD**2 * np.outer(along, along)
    spread += TURN_ANGLE_SD**2 * np.outer(across, across)
    cov[:] = F @ cov @ F.T
    cov[VELOCITY, VELOCITY] += spread
    cov[POSITION, VELOCITY] += age_s * spread
    cov[VELOCITY, POSITION] += age_s * spread
    cov[POSITION, POSITION] += within_s**2 * (spread / 3.0 + step2 / 12.0)
