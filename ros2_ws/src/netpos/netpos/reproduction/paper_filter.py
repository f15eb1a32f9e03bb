"""The filter of fokin2020 as the paper prints it: the baseline beside ours.

An extended Kalman filter with the state [x, y, vx, vy, clock, drift] in metres and seconds. It
has no gate, does not iterate, and never starts again: a track that is lost stays lost. Nothing of
it comes from ``netpos.estimation`` but the layout of a row.

    x- = F x,  P- = F P F' + Q                         fokin2020:eq.21, 22, 35
    K = P- H' (H P- H' + R)^-1                         fokin2020:eq.23, 44
    x = x- + K (y - h(x-)),  P = (I - K H) P-          fokin2020:eq.24, 25, 37
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from netpos.estimation.compile import kernel
from netpos.estimation.measurement import AXES, BIAS, KIND, ORIGIN, VALUE, VARIANCE, Kind
from netpos.estimation.state import X
from netpos.evaluation.metrics import SKIP_EPOCHS
from netpos.messages.values import Array
from netpos.reproduction.segments import Epochs, Followed
from netpos.tracking.config import TrackerConfig
from netpos.tracking.estimators.models import motions_of

Ints = npt.NDArray[np.int64]

SPEED_OF_LIGHT_MPS = 299_792_458.0
LOST_M = 30.0  # half the distance between two RSUs
_AZIMUTH, _TOA = int(Kind.AZIMUTH), int(Kind.TOA)
_STATES = 6


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperNoise:
    """Process noise of one step: Q = diag(0, 0, sv^2, sv^2, 0, se^2) (fokin2020:eq.4) plus
    G G' ss^2 of position and velocity (eq.36). The defaults are those of section 2.4.

    velocity_sd_mps: sv. accel_sd_mps2: ss. drift_sd: se, relative [s/s].
    """

    velocity_sd_mps: float = 0.1
    accel_sd_mps2: float = 0.0
    drift_sd: float = 1e-4


@kernel
def _predict(x: Array, P: Array, dt: float, variances: Array) -> None:
    """Equations 21 and 22 in place: F adds ``dt`` times the entries 2, 3 and 5 to the entries 0, 1
    and 4. ``variances`` (3,) of a step: velocity, acceleration, drift."""
    for to, source in ((0, 2), (1, 3), (4, 5)):
        x[to] += dt * x[source]
        for b in range(_STATES):
            P[to, b] += dt * P[source, b]
        for a in range(_STATES):
            P[a, to] += dt * P[a, source]
    for p in range(2):
        v = X.VX + p
        P[p, p] += variances[1] * dt**4 / 4.0
        P[p, v] += variances[1] * dt**3 / 2.0
        P[v, p] += variances[1] * dt**3 / 2.0
        P[v, v] += variances[1] * dt**2 + variances[0]
    P[X.DRIFT, X.DRIFT] += variances[2]


@kernel
def _linearised(rows: Array, x: Array, H: Array, innovation: Array) -> None:
    """Fill H (m, 6) of eq. 44 and y - h(x) (m,) of eq. 37; angles are wrapped."""
    H[:] = 0.0
    for i in range(rows.shape[0]):
        dx, dy = x[X.PX] - rows[i, ORIGIN], x[X.PY] - rows[i, ORIGIN + 1]
        r2 = dx * dx + dy * dy
        if int(rows[i, KIND]) == _AZIMUTH:
            H[i, X.PX], H[i, X.PY] = -dy / r2, dx / r2
            angle = rows[i, VALUE] - math.atan2(dy, dx)
            innovation[i] = math.atan2(math.sin(angle), math.cos(angle))
        else:
            r = math.sqrt(r2)
            H[i, X.PX], H[i, X.PY], H[i, X.CLOCK] = dx / r, dy / r, 1.0
            innovation[i] = rows[i, VALUE] - r - x[X.CLOCK]


@kernel
def _product(A: Array, B: Array) -> Array:
    """A B of small matrices, for which a call of a library takes longer than its arithmetic."""
    out = np.zeros((A.shape[0], B.shape[1]))
    for i in range(A.shape[0]):
        for j in range(B.shape[1]):
            for k in range(B.shape[0]):
                out[i, j] += A[i, k] * B[k, j]
    return out


@kernel
def _update(rows: Array, x: Array, P: Array) -> None:
    """Equations 23 to 25 in place."""
    m = rows.shape[0]
    H, innovation = np.empty((m, _STATES)), np.empty((m, 1))
    _linearised(rows, x, H, innovation[:, 0])
    HP, PH = _product(H, P), _product(P, H.T)
    S = _product(HP, H.T)
    for i in range(m):
        S[i, i] += rows[i, VARIANCE]
    K = _product(PH, np.linalg.inv(S))
    x += _product(K, innovation)[:, 0]
    P -= _product(K, HP)


@kernel
def _run(
    stamps_ns: Ints,
    row_start: Ints,
    rows: Array,
    x: Array,
    P: Array,
    variances: Array,
    means: Array,
    covs: Array,
) -> int:
    """Fill ``means`` (N, 6) and ``covs`` (N, 6, 6); returns the number of epochs done, less than N
    where the state stops being finite."""
    for k in range(stamps_ns.size):
        if k > 0:
            dt = (stamps_ns[k] - stamps_ns[k - 1]) * 1e-9
            _predict(x, P, dt, variances)
        _update(rows[row_start[k] : row_start[k + 1]], x, P)
        if not (np.isfinite(x).all() and np.isfinite(P).all()):
            return k
        means[k], covs[k] = x, P
    return stamps_ns.size


def run_paper_filter(
    stamps_ns: Ints, row_start: Ints, rows: Array, mean: Array, cov: Array, noise: PaperNoise
) -> tuple[int, Array, Array]:
    """Epochs done, means (N, 6) and covariances (N, 6, 6).

    stamps_ns : (N,) increasing; row_start : (N + 1,); rows : (M, ROW_WIDTH) azimuths and TOA in
    axes of the map, TOA in metres; mean (6,) and cov (6, 6) at the first stamp, before its rows

    Fewer epochs are done than there are where the state stops being finite.

    Raises
    ------
    ValueError  a row is no azimuth or TOA, has a bias, a height or axes of its own
    """
    kinds = rows[:, KIND]
    if not ((kinds == _AZIMUTH) | (kinds == _TOA)).all():
        raise ValueError("the paper's filter takes azimuths and TOA only")
    if not (rows[:, AXES : AXES + 9] == np.eye(3).ravel()).all() or rows[:, ORIGIN + 2].any():
        raise ValueError("the paper's filter needs RSUs in the plane with the axes of the map")
    if (rows[:, BIAS] >= 0.0).any():
        raise ValueError("the paper's filter knows no biases of RSUs; undeclare them")
    means, covs = np.empty((stamps_ns.size, _STATES)), np.empty((stamps_ns.size, _STATES, _STATES))
    drift_sd_mps = SPEED_OF_LIGHT_MPS * noise.drift_sd
    variances = np.array([noise.velocity_sd_mps, noise.accel_sd_mps2, drift_sd_mps]) ** 2
    start = mean.copy(), cov.copy()
    done = _run(stamps_ns, row_start, rows, *start, variances, means, covs)
    return done, means, covs


def follow_paper(
    config: TrackerConfig, epochs: Epochs, mean: Array, cov: Array, truth: Array
) -> Followed:
    """The paper's filter on the epochs of a run with the true states ``truth`` (N, 6).

    Of ``config`` it takes the process noise of its step where that is white_acceleration (section
    3), otherwise that of section 2.4. A run is lost as a whole, and none of its estimates counts,
    where one of those that are scored is more than ``LOST_M`` off: the estimate then is nearer to
    another RSU than to the one that hears the device (the paper's own check, section 2.3).
    """
    noise = PaperNoise()
    if config.process_noise == "white_acceleration":
        noise = PaperNoise(
            velocity_sd_mps=0.0, accel_sd_mps2=config.accel_sd_mps2, drift_sd=config.drift_step_sd
        )
    count = epochs.stamps_ns.size
    done, means, covs = run_paper_filter(*epochs[:3], mean, cov, noise)
    error = np.hypot(*(means - truth[:, :_STATES])[SKIP_EPOCHS:done, :2].T)
    lost = done < count or bool((error > LOST_M).any())
    if lost:
        means[:], covs[:] = np.nan, np.nan
    unknown, zeros = np.full(count, np.nan), np.zeros(count)
    tracked = np.full(count, not lost)
    motions = motions_of(config)
    return Followed(means, covs, unknown, zeros, zeros, zeros, motions, tracked, int(lost))
