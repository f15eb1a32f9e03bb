"""Yardstick: a plain extended Kalman filter of constant velocity.

    x = [p, v, (heading)];  p' = v, v' = white acceleration, heading' = white turn rate
    Q = q^2 [[dt^3/3, dt^2/2], [dt^2/2, dt]] per axis;  heading: q_h^2 dt
    one update per measurement: K = P H' / (H P H' + sd^2), left out beyond 4 sd; the measurements
    of one stamp are linearised at its prediction

It starts from a snapshot, and starts anew from one after 2 s of silence or when less than half of
the measurements of 2 s were accepted. All numbers are the same for every recording; none is tuned.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from netpos.evaluation.pairing import Trajectory
from netpos.evaluation.yardsticks.observations import NS, Observations, residuals
from netpos.evaluation.yardsticks.snapshot import WINDOW_S, Fix, Space, snapshot, trajectory_of
from netpos.messages.values import Array, TrackState, TrackStatus


@dataclass(frozen=True, slots=True, kw_only=True)
class PlainConfig:
    """accel_density: white acceleration [m/s^2/sqrt(Hz)]; turn_density: white turn rate
    [rad/s/sqrt(Hz)], where several antennas show the heading; initial_speed_sd_mps: per axis;
    gate_sd: innovations beyond so many sd are left out; restart_after_s: of silence, or with
    less than half of the measurements accepted."""

    accel_density: float = 0.5
    turn_density: float = 0.5
    initial_speed_sd_mps: float = 10.0
    gate_sd: float = 4.0
    restart_after_s: float = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class PlainRun:
    """Estimates after each stamp, and their NIS and counts as status messages."""

    estimate: Trajectory
    statuses: list[TrackStatus]


@dataclass(slots=True)
class _Filter:
    space: Space
    config: PlainConfig
    heading: bool
    x: Array = field(default_factory=lambda: np.zeros(0))
    P: Array = field(default_factory=lambda: np.zeros((0, 0)))

    def start(self, fix: Fix) -> None:
        d, n = self.space.dimensions, 2 * self.space.dimensions + self.heading
        known = [*range(d), *([n - 1] if self.heading else [])]
        self.x, self.P = np.zeros(n), np.eye(n) * self.config.initial_speed_sd_mps**2
        self.x[known], self.P[np.ix_(known, known)] = fix.state, fix.cov

    def predict(self, dt: float) -> None:
        d, n = self.space.dimensions, len(self.x)
        F, Q = np.eye(n), np.zeros((n, n))
        p, v, q = np.arange(d), np.arange(d, 2 * d), self.config.accel_density**2
        F[p, v] = dt
        Q[p, p], Q[p, v], Q[v, p], Q[v, v] = q * dt**3 / 3, q * dt**2 / 2, q * dt**2 / 2, q * dt
        if self.heading:
            Q[-1, -1] = self.config.turn_density**2 * dt
        self.x, self.P = F @ self.x, F @ self.P @ F.T + Q

    def update(self, seen: Observations) -> tuple[float, int]:
        """Apply the measurements of one stamp; sum of the squared normalised innovations of those
        that pass the gate, and their number."""
        d, prior, nis, used = self.space.dimensions, self.x, 0.0, 0
        heading = float(prior[-1]) if self.heading else 0.0
        errors, slope = residuals(seen, self.space.point(prior), heading)
        H = np.zeros((len(seen), len(prior)))
        H[:, :d] = slope[:, :d]
        if self.heading:
            H[:, -1] = slope[:, 3]
        for h, error, R in zip(H, errors, seen.sd**2, strict=True):
            innovation, Ph = error - h @ (self.x - prior), self.P @ h
            S = h @ Ph + R
            if innovation**2 > self.config.gate_sd**2 * S:
                continue
            K = Ph / S
            A = np.eye(len(prior)) - np.outer(K, h)
            self.x = self.x + K * innovation
            self.P = A @ self.P @ A.T + R * np.outer(K, K)
            nis, used = nis + float(innovation**2 / S), used + 1
        return nis, used

    def fix(self) -> Fix:
        d = self.space.dimensions
        known = [*range(d), *([2 * d] if self.heading else [])]
        return Fix(self.x[known], self.P[np.ix_(known, known)])


@dataclass(slots=True)
class _Watch:
    """Whether the filter runs: the last accepted measurements of ``restart_after_s``."""

    span_ns: int
    started_ns: int = -1  # -1: not started
    recent: deque[tuple[int, int, int]] = field(default_factory=deque)  # stamp, used, all

    def running(self, stamp_ns: int) -> bool:
        """Before the measurements of a stamp: not after a silence, and not while most are
        refused."""
        if self.started_ns < 0 or stamp_ns - self.recent[-1][0] > self.span_ns:
            return False
        while stamp_ns - self.recent[0][0] > self.span_ns:
            self.recent.popleft()
        settled = stamp_ns - self.started_ns > self.span_ns
        used, every = (sum(row[k] for row in self.recent) for k in (1, 2))
        return not (settled and 2 * used < every)

    def start(self, stamp_ns: int, count: int) -> None:
        self.started_ns = stamp_ns
        self.recent.clear()
        self.recent.append((stamp_ns, count, count))


def plain_ekf(seen: Observations, space: Space, config: PlainConfig | None = None) -> PlainRun:
    """Filter all measurements in their order; an estimate for each stamp from the first fix on.

    While it waits for a snapshot to start from it gives no estimate.
    """
    config = config or PlainConfig()
    ekf = _Filter(space, config, seen.turns)
    watch = _Watch(round(config.restart_after_s * NS))
    stamps: list[int] = []
    fixes: list[Fix] = []
    velocities: list[Array] = []
    statuses: list[TrackStatus] = []
    previous_ns, accepted, refused = 0, 0, 0
    edges = np.flatnonzero(np.append(True, np.diff(seen.stamp_ns) > 0)).tolist()
    for low, high in zip(edges, [*edges[1:], len(seen)], strict=True):
        stamp, nis, used = int(seen.stamp_ns[low]), 0.0, 0
        if watch.running(stamp):
            ekf.predict((stamp - previous_ns) / NS)
            nis, used = ekf.update(seen.take(slice(low, high)))
            accepted, refused = accepted + used, refused + high - low - used
            watch.recent.append((stamp, used, high - low))
        else:
            watch.started_ns = -1
            fix = snapshot(seen.window(stamp - round(WINDOW_S * NS), stamp), space)
            if fix is None or len(fix.state) != space.dimensions + ekf.heading:
                continue
            ekf.start(fix)
            watch.start(stamp, high - low)
            accepted += high - low
        previous_ns = stamp
        stamps.append(stamp)
        fixes.append(ekf.fix())
        velocities.append(ekf.x[space.dimensions : 2 * space.dimensions].copy())
        statuses.append(_status(stamp, nis, used, (accepted, refused)))
    path = trajectory_of(np.array(stamps, dtype=np.int64), fixes, space)
    path.velocity[:, : space.dimensions] = np.reshape(velocities, (-1, space.dimensions))
    return PlainRun(path, statuses)


def _status(stamp_ns: int, nis: float, used: int, counts: tuple[int, int]) -> TrackStatus:
    """Status after one stamp; ``counts``: measurements accepted and refused since the start."""
    accepted, refused = counts
    return TrackStatus(
        stamp_ns=stamp_ns,
        vue_id="vue_1",
        state=TrackState.TRACKING,
        nis=nis,
        nis_dof=used,
        used=used,
        accepted=accepted,
        rejected={"gate": refused},
    )
