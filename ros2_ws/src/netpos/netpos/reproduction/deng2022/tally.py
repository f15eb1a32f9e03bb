"""Sums over deng2022's drives: errors, consistency, lost tracks and what the outages end with."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from netpos.estimation.engine import Epochs
from netpos.estimation.fixes.position_fix import FixStatus
from netpos.estimation.motion import SPEED_OF_LIGHT_MPS
from netpos.estimation.state import NAV_POSITION, NAV_QUATERNION, NAV_VELOCITY, Err, Nav
from netpos.evaluation.consistency import MeanTest, nees, nees_over_runs
from netpos.evaluation.work import Work
from netpos.messages.values import Array
from netpos.reproduction.deng2022.blocked_drive import Case, Run, ned, run
from netpos.reproduction.deng2022.drives import Drive, Fixes
from netpos.tracking.config import TrackerConfig

LARGE_ERROR_M = 5.0
NEES_STATES = (3, 9, 1)
"""Position; position, velocity and attitude; offset of the clock."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Tally:
    """Sums over the epochs of R drives, of one variant.

    solved of n epochs have a finite position; square (3,) north, east, down error^2 [m^2] of
    these; worst_m (R,) largest 3-D error of each drive; lost drives whose track was lost;
    nees_sum, nees_n (R, 3) sums and counts for ``NEES_STATES``; outage_m (k, 2) horizontal and 3-D
    errors at the end of the outages; clock_m2 (2,) error^2 and variance of the clock's offset
    [m^2]. Without a clock its sums are 0.
    """

    n: int
    solved: int
    square: Array
    worst_m: Array
    lost: int
    nees_sum: Array
    nees_n: Array
    outage_m: Array
    clock_m2: Array

    def __add__(self, other: Tally) -> Tally:
        stacked = ("worst_m", "nees_sum", "nees_n", "outage_m")
        values: dict[str, Any] = {}
        for field in fields(self):
            one, two = getattr(self, field.name), getattr(other, field.name)
            both = np.concatenate([one, two]) if field.name in stacked else one + two
            values[field.name] = both
        return Tally(**values)

    @property
    def success_percent(self) -> float:
        """Share of epochs with a position."""
        return 100.0 * self.solved / self.n

    @property
    def rms_m(self) -> tuple[float, float, float]:
        """North, east, down, over the epochs with a position."""
        north, east, down = np.sqrt(self.square / self.solved).tolist()
        return north, east, down

    @property
    def plane_m(self) -> float:
        """Horizontal RMS."""
        return float(np.hypot(*self.rms_m[:2]))

    @property
    def lost_percent(self) -> float:
        """Share of drives whose track was lost."""
        return 100.0 * self.lost / self.worst_m.size

    @property
    def large_percent(self) -> float:
        """Share of drives with a 3-D error above ``LARGE_ERROR_M`` at some epoch."""
        return float(100.0 * np.mean(self.worst_m > LARGE_ERROR_M))

    @property
    def clock_ns(self) -> tuple[float, float]:
        """RMS error of the clock's offset, and that its covariance says."""
        error, stated = (1e9 / SPEED_OF_LIGHT_MPS * np.sqrt(self.clock_m2 / self.n)).tolist()
        return error, stated

    def nees_test(self, states: int) -> MeanTest:
        """Mean NEES of ``states`` of ``NEES_STATES``, tested by the spread between drives."""
        which = NEES_STATES.index(states)
        return nees_over_runs(self.nees_sum[:, which], self.nees_n[:, which], states)


def tally_errors(error: Array, *, lost: bool = False) -> Tally:
    """Of one drive's errors (N, 3) north, east, down; a row that is not finite has no position."""
    good = np.isfinite(error).all(axis=1)
    error = error[good]
    return Tally(
        n=good.size,
        solved=int(good.sum()),
        square=(error**2).sum(axis=0),
        worst_m=np.array([np.linalg.norm(error, axis=1).max(initial=0.0)]),
        lost=int(lost),
        nees_sum=np.zeros((1, 3)),
        nees_n=np.zeros((1, 3)),
        outage_m=np.zeros((0, 2)),
        clock_m2=np.zeros(2),
    )


NO_DRIVE = tally_errors(np.zeros((1, 3)))
"""For the names of figures that cannot be computed."""


def is_lost(epochs: Epochs, result: Drive) -> bool:
    """Whether the state ceased to be finite, or the track's own rule gave it up: too many epochs
    in a row of which the gate refused more than half of the rows."""
    if not np.isfinite(result.nav).all():
        return True
    rows = np.diff(epochs.row_start)
    heard = rows > 0
    refused = 2 * result.dof[heard] < rows[heard]
    limit = TrackerConfig().max_rejected_epochs
    runs = np.convolve(refused, np.ones(limit), mode="valid") if refused.size >= limit else [0.0]
    return bool(np.max(runs) >= limit)


def error_of(done: Run, result: Drive) -> Array:
    """(N, 9) position, velocity and attitude, estimate minus truth in the filter's terms."""
    turned = Rotation.from_quat(result.nav[:, NAV_QUATERNION]) * done.attitude.inv()
    return np.hstack(
        [
            result.nav[:, NAV_POSITION] - done.position,
            result.nav[:, NAV_VELOCITY] - done.velocity,
            turned.as_rotvec(),
        ]
    )


def tally_fixes(done: Run, fixes: Fixes) -> Tally:
    """Of the fixes of the antenna."""
    error = ned(fixes.position - done.antenna)
    error[fixes.status != FixStatus.CONVERGED] = np.nan
    return tally_errors(error[~done.silence_end])


def tally_drive(done: Run, name: str) -> Tally:
    """Of the drive ``name``. Predictions at the end of an outage count for the outages and the
    largest error alone."""
    result, scored = done.drives[name], ~done.silence_end
    error, cov = error_of(done, result), result.cov
    finite = np.isfinite(error).all(axis=1) & scored
    offset, offset_var = _clock(done, result)
    values = [nees(error[finite, :k], cov[finite, :k, :k])[0] for k in NEES_STATES[:2]]
    values.append(nees(offset[finite, None], offset_var[finite, None, None])[0])
    at_end = [np.linalg.norm(error[done.silence_end, :k], axis=1) for k in (2, 3)]
    base = tally_errors(ned(error[scored, :3]), lost=is_lost(done.epochs[name], result))
    with_ends = tally_errors(ned(error[:, :3]))
    return Tally(
        n=base.n,
        solved=base.solved,
        square=base.square,
        worst_m=with_ends.worst_m,
        lost=base.lost,
        nees_sum=np.array([[v.sum() for v in values]]),
        nees_n=np.array([[v.size for v in values]]),
        outage_m=np.column_stack(at_end),
        clock_m2=np.array([(offset[scored] ** 2).sum(), offset_var[scored].sum()]),
    )


def _clock(done: Run, result: Drive) -> tuple[Array, Array]:
    """(N,) error [m] and variance [m^2] of the clock's offset; 0 without one."""
    if result.cov.shape[1] <= Err.CLOCK:
        return np.zeros(len(result.nav)), np.zeros(len(result.nav))
    return result.nav[:, Nav.CLOCK] - done.clock_m, result.cov[:, Err.CLOCK, Err.CLOCK]


def tally_seeds(case: Case, seeds: range) -> dict[str, Tally]:
    """Sums over some seeds, by variant."""
    parts = []
    for seed in seeds:
        done = run(case, seed)
        part = {name: tally_fixes(done, fixes) for name, fixes in done.fixes.items()}
        parts.append(part | {name: tally_drive(done, name) for name in done.drives})
    return added(parts)


def added(parts: list[dict[str, Tally]]) -> dict[str, Tally]:
    """The sum of each variant."""
    total = parts[0]
    for part in parts[1:]:
        total = {name: total[name] + part[name] for name in total}
    return total


def over_seeds(work: Work, case: Case) -> dict[str, Tally]:
    """Sums over all seeds of the work, by variant."""
    return added(work.over_seeds(case.name, tally_seeds, case))
