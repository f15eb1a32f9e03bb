"""A particle filter of a device beside an RSU whose particles are short Gaussians.

Strong bearings and rare turns leave a plain bootstrap filter without particles. Here a particle is
a Gaussian of [x, y, vx, vy, clock offset, drift] in m and m/s, so short beside its distance from
the RSU that bearing and time of arrival are linear over it: one Kalman filter each (mixture Kalman
filter: Chen and Liu 2000). A particle that has grown longer is replaced by shorter ones, whose
centres are drawn along its longest axis: one, or several where it weighs much. Nothing is merged.
Where there are too many, those of little weight are drawn without bias (Fearnhead and Clifford
2003).

Velocity steps are Gaussian, so that a particle that has just stepped is one wide Gaussian. Those
that stepped lately are drawn apart from the others: they weigh little until measurements tell.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from netpos.messages.values import Array
from particle_filter import Motion, Start
from particle_gaussian_kernels import NEAREST_M, chosen, follow, shortened
from posterior import Cloud

_YOUNG_S = 3.0
_STEPS = 0.03  # particles drawn to step at a time, share of the others
_LONGEST = 0.05  # sd of a particle over its distance from the RSU
_REACH_SD, _SPACING = 6.0, 1.2  # of the row of particles at the start
_PARTS = 4.0  # draws that replace a long particle of average weight
_START_S, _AT_START = 1.0, 8  # so many times the particles in the first seconds
_DRAWS = 4  # positions of a particle in the cloud


@dataclass(frozen=True, slots=True, kw_only=True)
class StepMotion(Motion):
    """steps_hz: rate of velocity steps, of sd step_sd [m/s] per axis. to_sides: those
    about as large as a turn, within this share of its size, turn the device by 90 degrees to
    either side, but for a share turn_speed_sd of its speed and turn_angle_sd [rad], if its
    velocity is known better."""

    steps_hz: float = 0.0
    step_sd: float = 0.0
    to_sides: float = 0.0
    turn_speed_sd: float = 0.0
    turn_angle_sd: float = 0.0


class GaussianParticles:
    """Posterior of one device; ``advance`` from epoch to epoch."""

    def __init__(self, start: Start, motion: StepMotion, particles: int, seed: int) -> None:
        self._motion, self._count = motion, particles
        self._rng = np.random.default_rng([seed, 0x6A55])
        sd = [start.position_sd] * 2 + [start.velocity_sd] * 2 + [*start.clock_sd]
        self.mean: Array = np.array([[*start.mean, *start.clock_mean]])
        self.cov: Array = np.diag(np.square(sd))[None]
        self.log_weights = np.zeros(1)
        self._stepped_s = np.full(1, math.inf)  # since the last step
        self._left_s = _START_S

    @property
    def probability(self) -> Array:
        """Weight of each particle (K,); they sum to one."""
        p: Array = np.exp(self.log_weights - self.log_weights.max())
        return p / p.sum()

    def begin(self, row: Array) -> None:
        """Fuse the first bearing (WIDTH,): the prior becomes a row of particles along its ray, as
        long as others may be, for hardly any would be drawn there."""
        ray = np.array([math.cos(row[1]), math.sin(row[1])])
        mean, cov, origin = self.mean[0], self.cov[0], row[3:5]
        reach = math.hypot(*(mean[:2] - origin)) + _REACH_SD * math.sqrt(cov[0, 0])
        count = math.ceil(math.log(reach / NEAREST_M) / math.log1p(_LONGEST * _SPACING))
        r = np.geomspace(NEAREST_M, reach, count)
        ratio = math.log(r[1] / r[0])
        H = np.zeros((count, 2, 6))
        H[:, 0, :2] = ray
        H[:, 1, 0], H[:, 1, 1] = -ray[1] / r, ray[0] / r
        value = np.column_stack([r + ray @ origin, H[:, 1, :2] @ origin])
        R = np.zeros((count, 2, 2))
        R[:, 0, 0], R[:, 1, 1] = (r * ratio / _SPACING) ** 2, row[2] ** 2
        S = H @ cov @ H.transpose(0, 2, 1) + R
        gain = np.linalg.solve(S, H @ cov).transpose(0, 2, 1)
        e = value - H @ mean
        self.mean = mean + np.einsum("kij,kj->ki", gain, e)
        self.cov = cov - gain @ H @ cov
        nis = np.einsum("ki,ki->k", e, np.linalg.solve(S, e[..., None])[..., 0])
        self.log_weights = np.log(r * ratio) - 0.5 * (nis + np.linalg.slogdet(S)[1])
        self._stepped_s = np.full(count, math.inf)

    def advance(self, times: Array, rows: Array) -> None:
        """Rows (m, WIDTH) of some epochs, measured ``times`` (m,) seconds from now; the last is
        the new now. Steps begin at any time of the way."""
        duration = float(times[-1])
        if duration > 0.0:
            self._step(duration)
        origin = rows[0, 3:5]
        self._shorten(origin)
        motion = self._motion
        noise = np.array([motion.accel**2, motion.clock[0] ** 2, motion.clock[1] ** 2])
        follow(self.mean, self.cov, self.log_weights, times, rows, noise)
        self._stepped_s += duration
        self._left_s = max(self._left_s - duration, 0.0)
        self._shorten(origin)
        self._reduce()

    def cloud(self) -> Cloud:
        """Positions drawn from the particles, with the weights of these."""
        L = np.linalg.cholesky(self.cov[:, :2, :2])
        noise = self._rng.standard_normal((len(self.mean), _DRAWS, 2))
        xy = self.mean[:, None, :2] + np.einsum("kij,kdj->kdi", L, noise)
        return Cloud(xy.reshape(-1, 2), np.repeat(self.probability / _DRAWS, _DRAWS))

    def moments(self) -> tuple[Array, Array]:
        """Mean (2,) and covariance (2, 2) of the position."""
        p = self.probability
        mean = p @ self.mean[:, :2]
        d = self.mean[:, :2] - mean
        cov = np.einsum("k,kij->ij", p, self.cov[:, :2, :2]) + (p[:, None] * d).T @ d
        return mean, cov

    @property
    def _most(self) -> int:
        """Particles of a stratum."""
        return self._count * (_AT_START if self._left_s > 0.0 else 1)

    def _step(self, duration: float) -> None:
        """Add particles whose velocity steps in the next ``duration`` seconds."""
        share = -math.expm1(-self._motion.steps_hz * duration)
        if share == 0.0:
            return
        count = max(int(_STEPS * self._most), 1)
        p = self.probability
        parent = np.minimum(
            np.searchsorted(np.cumsum(p), (np.arange(count) + self._rng.random()) / count),
            p.size - 1,
        )
        after = duration * self._rng.random(count)
        mean, cov = self.mean[parent], self.cov[parent]
        ratio2 = 2.0 * np.square(mean[:, 2:4]).sum(axis=1) / self._motion.step_sd**2
        sides = self._motion.to_sides * ratio2 * np.exp(-0.5 * ratio2)
        known = self._motion.turn_angle_sd**2 * np.square(mean[:, 2:4]).sum(axis=1)
        sides[np.trace(cov[:, 2:4, 2:4], axis1=1, axis2=2) > known] = 0.0
        side = np.where(self._rng.random(count) < 0.5, 1.0, -1.0)
        side[self._rng.random(count) >= sides] = 0.0
        mean, cov = self._stepped(mean, cov, after, side)
        self.mean = np.concatenate([self.mean, mean])
        self.cov = np.concatenate([self.cov, cov])
        kept = np.log(p) + math.log1p(-share)
        self.log_weights = np.append(kept, np.full(count, math.log(share / count)))
        self._stepped_s = np.append(self._stepped_s, np.zeros(count))

    def _stepped(self, mean: Array, cov: Array, after: Array, side: Array) -> tuple[Array, Array]:
        """Means (K, 6) and covariances (K, 6, 6) that step ``after`` (K,) seconds, seen from
        before: by any step, or to a ``side`` (K,)."""
        motion, turned = self._motion, np.tile(np.eye(2), (side.size, 1, 1))
        turned[side != 0.0] = 0.0
        turned[:, 0, 1], turned[:, 1, 0] = -side, side
        change = turned - np.eye(2)
        F = np.tile(np.eye(6), (side.size, 1, 1))
        F[:, 2:4, 2:4] = turned
        F[:, :2, 2:4] = -after[:, None, None] * change
        moved = np.einsum("kij,kj->ki", F, mean)
        along = moved[:, 2:4]
        across = np.stack([-along[:, 1], along[:, 0]], axis=1)
        spread = motion.turn_speed_sd**2 * np.einsum("ki,kj->kij", along, along)
        spread += motion.turn_angle_sd**2 * np.einsum("ki,kj->kij", across, across)
        spread[side == 0.0] = motion.step_sd**2 * np.eye(2)
        wide = F @ cov @ F.transpose(0, 2, 1)
        wide[:, :2, :2] += after[:, None, None] ** 2 * spread
        wide[:, :2, 2:4] -= after[:, None, None] * spread
        wide[:, 2:4, :2] -= after[:, None, None] * spread
        wide[:, 2:4, 2:4] += spread
        return moved, wide

    def _shorten(self, origin: Array) -> None:
        """Draw particles that are too long beside their distance from the RSU."""
        for _ in range(6):
            p = self.probability
            cut = self._rng, self.mean, self.cov, p, _PARTS * self._most, origin, _LONGEST
            self.mean, self.cov, parent, share, drawn = shortened(*cut)
            self.log_weights = np.log(np.maximum(p[parent] * share, 1e-300))
            self._stepped_s = self._stepped_s[parent]
            if not drawn:
                return

    def _reduce(self) -> None:
        """Leave at most so many particles in each stratum, and none without weight."""
        p, young = self.probability, self._stepped_s < _YOUNG_S
        index, weight = [], []
        for stratum in (np.flatnonzero(~young & (p > 1e-12)), np.flatnonzero(young & (p > 1e-12))):
            kept, weights = stratum, p[stratum]
            if stratum.size > self._most:
                found, weights = chosen(self._rng, weights, self._most)
                kept = stratum[found]
            index.append(kept)
            weight.append(weights)
        kept = np.concatenate(index)
        self.mean, self.cov = self.mean[kept], self.cov[kept]
        self._stepped_s = self._stepped_s[kept]
        self.log_weights = np.log(np.concatenate(weight))
