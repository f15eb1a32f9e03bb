"""Exact plane motion: straight lines, arcs, speed ramps, pauses.

A motion is a list of pieces. Within one piece curvature and tangential acceleration are constant,
so that position, velocity, acceleration, heading and yaw rate have closed forms and no step of any
integrator enters the truth."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from netpos.world.body import BodyState, Kinematics, check_times, level, on_hills
from netpos.world.hills import FLAT, Hills

Array = npt.NDArray[np.float64]

_STRAIGHT_RAD = 1e-9  # a bend below this is no corner


@dataclass(frozen=True, slots=True)
class _Segment:
    """A stretch of constant curvature."""

    x: float
    y: float
    yaw: float
    curvature: float
    length: float


@dataclass(frozen=True, slots=True)
class _Piece:
    """A stretch of constant curvature and tangential acceleration; ``spin`` turns on the spot."""

    start_s: float
    x: float
    y: float
    yaw: float
    curvature: float
    speed: float
    acceleration: float
    spin: float


@dataclass(frozen=True, slots=True)
class Leg:
    """A straight line, or an arc that turns by ``turn_rad`` on its length, left if positive."""

    length_m: float
    turn_rad: float = 0.0


class Motion:
    """Motion along way-points or legs, built by ``follow`` and ``follow_legs``."""

    def __init__(
        self, pieces: Sequence[_Piece], duration_s: float, *, smooth: bool, hills: Hills = FLAT
    ) -> None:
        self.duration_s = duration_s
        self.hills = hills
        self.smooth = smooth
        """Whether velocity and heading are continuous, as an inertial sensor needs."""
        self._start = np.array([p.start_s for p in pieces])
        self._table = np.array(
            [(p.x, p.y, p.yaw, p.curvature, p.speed, p.acceleration, p.spin) for p in pieces]
        )

    @property
    def knots(self) -> tuple[Array, Array]:
        """Instants (k,) between which the heading changes evenly, and the heading there: the
        start of every piece and the end."""
        last = self.at(self.duration_s).yaw
        return np.append(self._start, self.duration_s), np.append(self._table[:, 2], last)

    def at(self, time_s: npt.ArrayLike) -> Kinematics:
        """State at times (n,) since the start [s]; at a jump, the state after it.

        Raises
        ------
        ValueError  a time is not finite or outside [0, duration_s]
        """
        t = check_times(time_s, self.duration_s)
        k = np.maximum(np.searchsorted(self._start, t, side="right") - 1, 0)
        x, y, yaw, curvature, speed, acceleration, spin = self._table[k].T
        tau = t - self._start[k]
        way = speed * tau + acceleration * tau**2 / 2
        now = speed + acceleration * tau
        chord = way * np.sinc(curvature * way / (2 * np.pi))
        chord_yaw = yaw + curvature * way / 2
        heading = yaw + curvature * way + spin * tau
        ahead = np.column_stack([np.cos(heading), np.sin(heading)])
        left = np.column_stack([-ahead[:, 1], ahead[:, 0]])
        return Kinematics(
            position=np.column_stack(
                [x + chord * np.cos(chord_yaw), y + chord * np.sin(chord_yaw)]
            ),
            velocity=now[:, None] * ahead,
            acceleration=acceleration[:, None] * ahead + (curvature * now**2)[:, None] * left,
            yaw=heading,
            yaw_rate=curvature * now + spin,
        )

    def body_at(self, time_s: npt.ArrayLike) -> BodyState:
        """The same as a body in three dimensions: level, or pitching with its hills."""
        state = self.at(time_s)
        if self.hills.amplitude_m == 0.0:
            return level(state)
        return on_hills(state, *self.hills.at(check_times(time_s, self.duration_s)))


def follow(
    points: npt.ArrayLike,
    speed_mps: float,
    *,
    corner_radius_m: float = 0.0,
    acceleration_mps2: float | None = None,
    pauses_s: Sequence[float] = (),
    hills: Hills = FLAT,
) -> Motion:
    """Motion along way-points at constant speed.

    Parameters
    ----------
    points : (n, 2)  way-points in map [m], n >= 2
    speed_mps : cruising speed
    corner_radius_m : corners become arcs of this radius; 0 turns on the spot, at once
    acceleration_mps2 : ramp to and from each pause; None starts and stops at once
    pauses_s : (n,) standing time at each way-point, or empty. A first or last pause makes the
        motion start or end at rest;
        without it the motion starts and ends at cruising speed. During a pause at a corner of
        radius 0 the body turns evenly.
    hills : the road's height; it does not count in the speed, and it allows no pauses

    Raises
    ------
    ValueError  a leg is too short for its corners or ramps, a way-point repeats, a pause lies on
        an arc, a value is out of range
    """
    if hills.amplitude_m > 0 and any(pauses_s):
        raise ValueError("a road with hills allows no pauses; set their amplitude to 0")
    xy = np.asarray(points, dtype=np.float64)
    _check(xy, speed_mps, corner_radius_m, acceleration_mps2, pauses_s)
    pauses = list(pauses_s) or [0.0] * len(xy)
    runs, bends = _geometry(xy, corner_radius_m, pauses)
    return _motion(runs, bends, pauses, speed_mps, acceleration_mps2, hills)


def follow_legs(
    start: npt.ArrayLike,
    heading_rad: float,
    legs: Sequence[Leg],
    speed_mps: float,
    *,
    acceleration_mps2: float | None = None,
    pauses_s: Sequence[float] = (),
    hills: Hills = FLAT,
) -> Motion:
    """Motion at constant speed along straight lines and arcs, each of which goes on where and in
    the direction in which the one before ends.

    Parameters
    ----------
    start : (2,)  where the first leg begins in map [m]
    heading_rad : direction there, from east counter-clockwise
    legs : n >= 1
    pauses_s : (n + 1,) standing time at the start and at the end of each leg, or empty

    The others, and pauses, are as in ``follow``.

    Raises
    ------
    ValueError  a way is too short for its ramps, a value is out of range
    """
    if hills.amplitude_m > 0 and any(pauses_s):
        raise ValueError("a road with hills allows no pauses; set their amplitude to 0")
    xy = np.asarray(start, dtype=np.float64)
    if xy.shape != (2,) or not np.isfinite([*xy, heading_rad]).all():
        raise ValueError(
            f"a way needs a finite start (x, y) and heading, got {xy.tolist()}, {heading_rad}"
        )
    if not legs:
        raise ValueError("a way needs at least one leg")
    for i, leg in enumerate(legs):
        if not (0 < leg.length_m < math.inf and math.isfinite(leg.turn_rad)):
            raise ValueError(f"leg {i} needs a finite length > 0 and a finite turn, got {leg}")
    _check_run(speed_mps, acceleration_mps2, pauses_s, len(legs) + 1)
    runs: list[list[_Segment]] = []
    pose = float(xy[0]), float(xy[1]), heading_rad
    for leg in legs:
        segment = _Segment(*pose, leg.turn_rad / leg.length_m, leg.length_m)
        runs.append([segment])
        pose = _end(segment)
    pauses = list(pauses_s) or [0.0] * (len(legs) + 1)
    return _motion(runs, [0.0] * len(pauses), pauses, speed_mps, acceleration_mps2, hills)


def _motion(
    runs: list[list[_Segment]],
    bends: list[float],
    pauses: list[float],
    speed: float,
    acceleration: float | None,
    hills: Hills,
) -> Motion:
    """Motion along the runs between points with a bend and a pause each."""
    stops = [i for i, pause in enumerate(pauses) if pause > 0]
    breaks = sorted({0, len(runs), *stops})
    pieces, clock = _walk(runs, bends, breaks, pauses, speed, acceleration)
    sharp = any(abs(bends[i]) > _STRAIGHT_RAD and pauses[i] == 0 for i in range(len(pauses)))
    abrupt = bool(stops) and acceleration is None
    return Motion(pieces, clock, smooth=not (sharp or abrupt), hills=hills)


def _walk(
    runs: list[list[_Segment]],
    bends: list[float],
    breaks: list[int],
    pauses: list[float],
    speed: float,
    acceleration: float | None,
) -> tuple[list[_Piece], float]:
    """Pieces from break to break, where the motion begins, pauses or ends, and their duration."""
    pieces: list[_Piece] = []
    clock = 0.0
    for a, b in itertools.pairwise(breaks):
        segments = [s for leg in runs[a:b] for s in leg]
        if a == 0 and pauses[0] > 0:
            first = segments[0]
            clock = _stand(pieces, clock, (first.x, first.y, first.yaw), 0.0, pauses[0])
        phases = _phases(
            sum(s.length for s in segments),
            speed,
            acceleration,
            ramp_up=pauses[a] > 0,
            ramp_down=pauses[b] > 0,
        )
        clock = _travel(pieces, clock, segments, phases)
        if pauses[b] > 0:
            clock = _stand(pieces, clock, _end(segments[-1]), bends[b], pauses[b])
    return pieces, clock


def _check(
    xy: Array, speed: float, radius: float, acceleration: float | None, pauses: Sequence[float]
) -> None:
    if xy.ndim != 2 or xy.shape[1] != 2 or len(xy) < 2 or not np.isfinite(xy).all():
        raise ValueError(
            f"a route needs at least two finite way-points (x, y), got shape {xy.shape}"
        )
    if not 0 <= radius < math.inf:
        raise ValueError(f"corner_radius_m must be finite and >= 0, got {radius}")
    _check_run(speed, acceleration, pauses, len(xy))
    repeated = np.flatnonzero((np.diff(xy, axis=0) == 0).all(axis=1))
    if repeated.size:
        raise ValueError(
            f"way-points {repeated[0]} and {repeated[0] + 1} are the same point; "
            "remove one, or set pauses_s to wait there"
        )


def _check_run(
    speed: float, acceleration: float | None, pauses: Sequence[float], points: int
) -> None:
    if not 0 < speed < math.inf:
        raise ValueError(f"speed_mps must be finite and > 0, got {speed}")
    if acceleration is not None and not 0 < acceleration < math.inf:
        raise ValueError(f"acceleration_mps2 must be finite and > 0, got {acceleration}")
    if pauses and len(pauses) != points:
        raise ValueError(f"pauses_s needs one value per way-point ({points}), got {len(pauses)}")
    if not all(0 <= p < math.inf for p in pauses):
        raise ValueError(f"pauses_s must be finite and >= 0, got {list(pauses)}")


def _geometry(
    xy: Array, radius: float, pauses: Sequence[float]
) -> tuple[list[list[_Segment]], list[float]]:
    """Segments of every leg (its straight, then the arc at its end), and the turn left at each
    way-point."""
    leg = np.diff(xy, axis=0)
    length = np.hypot(leg[:, 0], leg[:, 1])
    yaw = np.arctan2(leg[:, 1], leg[:, 0])
    turn = np.zeros(len(xy))
    turn[1:-1] = np.mod(np.diff(yaw) + np.pi, 2 * np.pi) - np.pi
    cut = np.zeros(len(xy))
    if radius > 0:
        bent = np.abs(turn) > _STRAIGHT_RAD
        for i in np.flatnonzero(bent).tolist():
            if pauses[i] > 0:
                raise ValueError(
                    f"way-point {i} is a rounded corner, where no pause is possible; "
                    "set corner_radius_m to 0"
                )
        cut[bent] = radius * np.tan(np.abs(turn[bent]) / 2)
    runs: list[list[_Segment]] = []
    for i in range(len(leg)):
        straight = length[i] - cut[i] - cut[i + 1]
        if straight < -1e-9:
            raise ValueError(
                f"the leg from way-point {i} to {i + 1} ({length[i]:.3f} m) is too short for "
                f"corner_radius_m {radius}; its corners need {cut[i] + cut[i + 1]:.3f} m"
            )
        ahead = leg[i] / length[i]
        x, y = xy[i] + ahead * cut[i]
        run = [_Segment(x, y, yaw[i], 0.0, straight)] if straight > 1e-9 else []
        if cut[i + 1] > 0:
            x, y = xy[i + 1] - ahead * cut[i + 1]
            run.append(
                _Segment(
                    x, y, yaw[i], math.copysign(1 / radius, turn[i + 1]), radius * abs(turn[i + 1])
                )
            )
        runs.append(run)
    return runs, [0.0 if c > 0 else float(t) for c, t in zip(cut, turn, strict=True)]


def _phases(
    length: float, speed: float, acceleration: float | None, *, ramp_up: bool, ramp_down: bool
) -> list[tuple[float, float, float]]:
    """(distance, speed at its start, acceleration) of ramp up, cruise and ramp down."""
    if acceleration is None or not (ramp_up or ramp_down):
        return [(length, speed, 0.0)]
    ramp = speed**2 / (2 * acceleration)
    ramps = ramp_up + ramp_down
    if ramps * ramp > length:
        if ramps == 1:
            raise ValueError(
                f"a leg of {length:.3f} m is too short to ramp between 0 and {speed} m/s at "
                f"{acceleration} m/s^2; raise acceleration_mps2"
            )
        ramp = length / 2
    peak = math.sqrt(2 * acceleration * ramp)
    phases = [(ramp, 0.0, acceleration)] if ramp_up else []
    if length > ramps * ramp:
        phases.append((length - ramps * ramp, peak, 0.0))
    return phases + ([(ramp, peak, -acceleration)] if ramp_down else [])


def _travel(
    pieces: list[_Piece],
    clock: float,
    segments: Sequence[_Segment],
    phases: Sequence[tuple[float, float, float]],
) -> float:
    """Append the pieces of a run: cut where the segment or the phase changes. Returns the time at
    its end."""
    segment_ends = np.cumsum([s.length for s in segments])
    phase_ends = np.cumsum([p[0] for p in phases])
    phase_ends[-1] = segment_ends[-1]
    cuts = np.unique(np.concatenate([[0.0], segment_ends, phase_ends]))
    for low, high in itertools.pairwise(cuts):
        middle = (low + high) / 2
        i = int(np.searchsorted(segment_ends, middle))
        j = int(np.searchsorted(phase_ends, middle))
        segment, (distance, speed, acceleration) = segments[i], phases[j]
        into_phase = low - (phase_ends[j] - distance)
        here = math.sqrt(max(speed**2 + 2 * acceleration * into_phase, 0.0))
        there = math.sqrt(max(here**2 + 2 * acceleration * (high - low), 0.0))
        x, y, yaw = _along(segment, low - (segment_ends[i] - segment.length))
        pieces.append(_Piece(clock, x, y, yaw, segment.curvature, here, acceleration, 0.0))
        clock += 2 * (high - low) / (here + there)
    return clock


def _stand(
    pieces: list[_Piece], clock: float, pose: tuple[float, float, float], turn: float, pause: float
) -> float:
    pieces.append(_Piece(clock, *pose, 0.0, 0.0, 0.0, turn / pause))
    return clock + pause


def _along(segment: _Segment, way: float) -> tuple[float, float, float]:
    """x, y, yaw after a distance along a segment."""
    half = segment.curvature * way / 2
    chord = way * float(np.sinc(half / np.pi))
    return (
        segment.x + chord * math.cos(segment.yaw + half),
        segment.y + chord * math.sin(segment.yaw + half),
        segment.yaw + 2 * half,
    )


def _end(segment: _Segment) -> tuple[float, float, float]:
    return _along(segment, segment.length)
