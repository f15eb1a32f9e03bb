"""A walking person with a module at the waist: smooth motion in space, in closed form.

The middle of the body follows the route; the waist moves about it with the phase of the steps.

    u    steps done, real-valued: 0 at rest, n at the end of a run of n steps
    s    = l u, way along the route, l the leg's length / n
    e    step rate over cadence: 0 at rest, 1 in steady walking (smootherstep over one step, so
         that position, velocity and acceleration are continuous)
    a    = 2 pi (u - 1/2 - d),  b = a / 2 (strides: every other step is a left one)
    forward   e^2 surge/2 sin a,        left      e^2 sway/2 sin b
    up       -e^2 bounce/2 (cos a + h cos 2a)
    yaw       mean direction of the next and last half step of the way + e^2 yaw_swing cos b
    pitch     lean + e^2 pitch_swing cos a,    roll   e^2 roll_swing sin b                (G1)

After each contact the jolt of the heel runs through the body, up and half as much back: with the
time t since the contact

    impact / w^2 (1 - exp(-t / 0.01 s))^3 exp(-t / 0.06 s) sin(w t),    w = 2 pi 12 Hz       (G2)

Foot contacts are at u = 1/2, 3/2, ... n - 1/2, when the body is midway between the feet; the
waist is lowest and fastest ``LATE`` of a step after them (inverted pendulum: Zijlstra and Hof,
Gait & Posture 6(3), 1997). The first and the last half step take one step time each (gait
initiation: Breniere and Do, J. Motor Behavior 23(4), 1991), so a run of n steps lasts n + 1
step times. Default amplitudes: Orendurff et al., J. Rehabil. Res. Dev. 41(6A), 2004, at 1 m/s.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass as plain_dataclass

import numpy as np
import numpy.typing as npt
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass
from scipy.spatial.transform import Rotation

from netpos.world.body import BodyState, check_times
from netpos.world.frames import wrap_angle
from netpos.world.motion import Leg, Motion, follow, follow_legs

Array = npt.NDArray[np.float64]

LATE = 0.08  # of a step: from foot contact to the lowest point of the waist
SECOND_HARMONIC = 0.1  # h: sharp contacts, flat mid-stance
_JOLT_RADPS = 2 * math.pi * 12
_JOLT_RISE_S, _JOLT_DECAY_S = 0.01, 0.06
_NO_TURN_RAD = 1e-9

_STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)


@dataclass(frozen=True, slots=True, kw_only=True, config=_STRICT)
class GaitModel:
    """Gait of a person. ``bounce_m``, ``sway_m`` and ``surge_m`` are peak to peak, the swings
    amplitudes; ``stance_pause_s`` is a pause after every step."""

    step_length_m: float = Field(default=0.6375, gt=0)
    cadence_hz: float = Field(default=1.57, gt=0, le=5)
    stance_pause_s: float = Field(default=0.0, ge=0)
    bounce_m: float = Field(default=0.04, ge=0)
    sway_m: float = Field(default=0.04, ge=0)
    surge_m: float = Field(default=0.02, ge=0)
    impact_mps2: float = Field(default=4.0, ge=0)
    yaw_swing_deg: float = Field(default=4.0, ge=0, le=45)
    roll_swing_deg: float = Field(default=3.0, ge=0, le=45)
    pitch_swing_deg: float = Field(default=1.5, ge=0, le=45)
    lean_deg: float = Field(default=5.0, ge=-60, le=60)


@plain_dataclass(frozen=True, slots=True)
class _Run:
    """n steps from rest to rest along a leg, from ``way_m`` on; ``before`` steps came earlier."""

    start_s: float
    end_s: float
    leg: int
    way_m: float
    n: int
    length_m: float
    before: int


@plain_dataclass(frozen=True, slots=True)
class _Stand:
    """A pause at a point, while the body turns smoothly from ``yaw`` by ``turn``."""

    start_s: float
    end_s: float
    x: float
    y: float
    yaw: float
    turn: float


class _Leg:
    """A way between two pauses by its length [m], and the body's heading on it: the mean direction
    over ``window_m``, for people turn smoothly and ahead of the corner (Grasso et al., Neurosci.
    Lett. 253(2), 1998)."""

    def __init__(self, way: Motion, window_m: float) -> None:
        self.way = way
        self.length_m = way.duration_s
        self._half = window_m / 2
        self._knots, self._yaws = way.knots
        pieces = np.diff(self._knots) * (self._yaws[:-1] + self._yaws[1:]) / 2
        self._areas = np.append(0.0, np.cumsum(pieces))

    def heading(self, way_m: Array) -> tuple[Array, Array]:
        """Heading [rad] and its change along the way [rad/m] at ways (n,)."""
        front, back = way_m + self._half, way_m - self._half
        span = 2 * self._half
        mean = (self._area(front) - self._area(back)) / span
        ends = [np.interp(w, self._knots, self._yaws) for w in (front, back)]
        return mean, (ends[0] - ends[1]) / span

    def pose(self, way_m: float) -> tuple[float, float, float]:
        """x, y and heading after a way."""
        x, y = self.way.at(way_m).position[0]
        return float(x), float(y), float(self.heading(np.array([way_m]))[0][0])

    def _area(self, way_m: Array) -> Array:
        """Integral of the direction from 0 on; beyond its ends the way goes straight on."""
        inside = np.clip(way_m, 0.0, self.length_m)
        i = np.clip(
            np.searchsorted(self._knots, inside, side="right") - 1, 0, len(self._knots) - 2
        )
        here = np.interp(inside, self._knots, self._yaws)
        area = self._areas[i] + (inside - self._knots[i]) * (self._yaws[i] + here) / 2
        before, after = np.minimum(way_m, 0.0), np.maximum(way_m - self.length_m, 0.0)
        return np.asarray(area + before * self._yaws[0] + after * self._yaws[-1])


class Gait:
    """The motion of the waist; ``walk`` makes it."""

    smooth = True

    def __init__(
        self,
        model: GaitModel,
        legs: Sequence[_Leg],
        runs: Sequence[_Run],
        stands: Sequence[_Stand],
    ) -> None:
        self.model = model
        self._legs, self._runs, self._stands = legs, runs, stands
        self.duration_s = max([r.end_s for r in runs] + [s.end_s for s in stands])
        t = 1.0 / model.cadence_hz
        self.contact_s: Array = np.array(
            [run.start_s + t * k for run in runs for k in range(1, run.n + 1)]
        )
        """(steps,) instants of the foot contacts [s]."""
        self.step_length_m: Array = np.repeat(
            [r.length_m for r in runs], [r.n for r in runs]
        ).astype(np.float64)
        """(steps,) length of each step along the route [m]."""

    def body_at(self, time_s: npt.ArrayLike) -> BodyState:
        """State at times (n,) since the start [s] (G1).

        Raises
        ------
        ValueError  a time is not finite or outside [0, duration_s]
        """
        t = np.minimum(check_times(time_s, self.duration_s), self.duration_s)
        out = np.empty((len(t), 12))
        for stand in self._stands:
            inside = (t >= stand.start_s) & (t <= stand.end_s)
            out[inside] = self._standing(stand, t[inside])
        for run in self._runs:
            inside = (t >= run.start_s) & (t <= run.end_s)
            out[inside] = self._walking(run, t[inside])
        return BodyState(
            position=out[:, :3],
            velocity=out[:, 3:6],
            rotation=Rotation.from_euler("ZYX", out[:, 6:9]),
            angular_velocity=out[:, 9:],
        )

    def _standing(self, stand: _Stand, t: Array) -> Array:
        span = stand.end_s - stand.start_s
        share = (t - stand.start_s) / span
        eased, rate, _ = _smootherstep(share)
        zero = np.zeros_like(t)
        lean = math.radians(self.model.lean_deg) + zero
        yaw, yaw_rate = stand.yaw + stand.turn * eased, stand.turn * rate / span
        body_rate = _body_rate(lean, zero, yaw_rate, zero, zero)
        still = np.zeros((len(t), 4))
        position = np.column_stack([zero + stand.x, zero + stand.y])
        return np.hstack([position, still, np.column_stack([yaw, lean, zero]), body_rate])

    def _walking(self, run: _Run, t: Array) -> Array:
        m = self.model
        u, du, e, de = _progress(t - run.start_s, run.n, 1.0 / m.cadence_hz)
        leg, way = self._legs[run.leg], run.way_m + run.length_m * u
        path = leg.way.at(np.clip(way, 0.0, leg.length_m))
        heading, curvature = leg.heading(way)
        ahead = np.column_stack([np.cos(heading), np.sin(heading)])
        left = np.column_stack([-ahead[:, 1], ahead[:, 0]])
        a = 2 * np.pi * (u - 0.5 - LATE)
        da = 2 * np.pi * du
        b, db = a / 2 + np.pi * run.before, da / 2

        def swing(amplitude: float, wave: Array, slope: Array) -> tuple[Array, Array]:
            return amplitude * e**2 * wave, amplitude * (2 * e * de * wave + e**2 * slope)

        h = SECOND_HARMONIC
        surge, d_surge = swing(m.surge_m / 2, np.sin(a), np.cos(a) * da)
        sway, d_sway = swing(m.sway_m / 2, np.sin(b), np.cos(b) * db)
        up, d_up = swing(
            -m.bounce_m / 2,
            np.cos(a) + h * np.cos(2 * a),
            -(np.sin(a) + 2 * h * np.sin(2 * a)) * da,
        )
        jolt, d_jolt = _jolt(t - run.start_s, run.n, 1.0 / m.cadence_hz)
        up, d_up = up + m.impact_mps2 * jolt, d_up + m.impact_mps2 * d_jolt
        surge = surge - m.impact_mps2 / 2 * jolt
        d_surge = d_surge - m.impact_mps2 / 2 * d_jolt
        yaw, d_yaw = swing(math.radians(m.yaw_swing_deg), np.cos(b), -np.sin(b) * db)
        pitch, d_pitch = swing(math.radians(m.pitch_swing_deg), np.cos(a), -np.sin(a) * da)
        roll, d_roll = swing(math.radians(m.roll_swing_deg), np.sin(b), np.cos(b) * db)
        way_rate = run.length_m * du
        turn_rate = curvature * way_rate
        forward = (d_surge - turn_rate * sway)[:, None] * ahead
        sideways = (d_sway + turn_rate * surge)[:, None] * left
        pitch = pitch + math.radians(m.lean_deg)
        return np.hstack(
            [
                path.position + surge[:, None] * ahead + sway[:, None] * left,
                up[:, None],
                way_rate[:, None] * path.velocity + forward + sideways,
                d_up[:, None],
                np.column_stack([heading + yaw, pitch, roll]),
                _body_rate(pitch, roll, turn_rate + d_yaw, d_pitch, d_roll),
            ]
        )


def walk(
    points: npt.ArrayLike,
    model: GaitModel,
    *,
    corner_radius_m: float = 0.0,
    pauses_s: Sequence[float] = (),
) -> Gait:
    """Walk along way-points, from rest to rest between pauses.

    Parameters
    ----------
    points : (n, 2)  way-points in map [m], n >= 2
    corner_radius_m : corners without a pause are walked as arcs of this radius
    pauses_s : (n,) standing time at each way-point, or empty; the body turns during a pause

    Each stretch between two pauses is walked in the whole number of equal steps nearest to its
    length over ``step_length_m``.

    Raises
    ------
    ValueError  as ``world.motion.follow``; a corner has neither a pause nor a radius
    """
    xy = np.asarray(points, dtype=np.float64)
    follow(xy, 1.0, pauses_s=pauses_s)  # refuses bad way-points and pauses
    pauses = list(pauses_s) or [0.0] * len(xy)
    stops = [0, *(i for i in range(1, len(xy) - 1) if pauses[i] > 0), len(xy) - 1]
    ways = [
        follow(xy[a : b + 1], 1.0, corner_radius_m=corner_radius_m)
        for a, b in itertools.pairwise(stops)
    ]
    if not all(way.smooth for way in ways):
        raise ValueError(
            "a walk turns at its corners: give each a pause in pauses_s to turn in, or the "
            "route a corner_radius_m > 0"
        )
    return _gait(model, ways, [pauses[i] for i in stops])


def walk_legs(
    start: npt.ArrayLike,
    heading_rad: float,
    legs: Sequence[Leg],
    model: GaitModel,
    *,
    pauses_s: Sequence[float] = (),
) -> Gait:
    """Walk along straight lines and arcs, from rest to rest between pauses.

    The way is that of ``world.motion.follow_legs``, which describes the arguments and errors.
    """
    whole = follow_legs(start, heading_rad, legs, 1.0, pauses_s=pauses_s)
    pauses = list(pauses_s) or [0.0] * (len(legs) + 1)
    stops = [0, *(i for i in range(1, len(legs)) if pauses[i] > 0), len(legs)]
    ways: list[Motion] = []
    pose = whole.at(0.0)
    for a, b in itertools.pairwise(stops):
        ways.append(follow_legs(pose.position[0], float(pose.yaw[0]), legs[a:b], 1.0))
        pose = ways[-1].at(ways[-1].duration_s)
    return _gait(model, ways, [pauses[i] for i in stops])


def _gait(model: GaitModel, ways: Sequence[Motion], pauses: Sequence[float]) -> Gait:
    """The gait along ways at 1 m/s, with the pauses before, between and after them."""
    return _timetable(model, [_Leg(way, model.step_length_m) for way in ways], pauses)


def _timetable(model: GaitModel, legs: Sequence[_Leg], pauses: Sequence[float]) -> Gait:
    """Runs and pauses one after the other."""
    runs: list[_Run] = []
    stands: list[_Stand] = []
    clock, steps = 0.0, 0
    x, y, yaw = legs[0].pose(0.0)
    for i, leg in enumerate(legs):
        turn = float(wrap_angle(leg.pose(0.0)[2] - yaw))
        clock = _stand(stands, clock, (x, y, yaw), turn, pauses[i])
        n = max(round(leg.length_m / model.step_length_m), 1)
        length = leg.length_m / n
        runs_of_leg = [1] * n if model.stance_pause_s > 0 else [n]
        for k, count in enumerate(runs_of_leg):
            way = k * count * length
            if k > 0:
                clock = _stand(stands, clock, leg.pose(way), 0.0, model.stance_pause_s)
            stop_s = clock + (count + 1) / model.cadence_hz
            runs.append(_Run(clock, stop_s, i, way, count, length, steps))
            steps += count
            clock = stop_s
        x, y, yaw = leg.pose(leg.length_m)
    _stand(stands, clock, (x, y, yaw), 0.0, pauses[-1])
    return Gait(model, legs, runs, stands)


def _stand(
    stands: list[_Stand],
    clock: float,
    pose: tuple[float, float, float],
    turn: float,
    pause_s: float,
) -> float:
    if pause_s > 0:
        turn = 0.0 if abs(turn) < _NO_TURN_RAD else turn
        stands.append(_Stand(clock, clock + pause_s, *pose, turn))
    return clock + pause_s


def _smootherstep(x: Array) -> tuple[Array, Array, Array]:
    """Value, slope and integral from 0 of 6 x^5 - 15 x^4 + 10 x^3 for x in [0, 1]."""
    value = x**3 * (10 + x * (6 * x - 15))
    slope = 30 * x**2 * (1 - x) ** 2
    return value, slope, x**4 * (2.5 + x * (x - 3))


def _progress(tau: Array, n: int, step_s: float) -> tuple[Array, Array, Array, Array]:
    """Steps done u, its rate [1/s], envelope e and its rate [1/s] at times into a run."""
    left = (n + 1) * step_s - tau
    near = np.clip(np.minimum(tau, left) / step_s, 0.0, 1.0)  # 1 in steady walking
    e, slope, done = _smootherstep(near)
    rising = tau <= left
    de = np.where(rising, slope, -slope) / step_s
    steady = np.clip(tau / step_s - 0.5, 0.5, None)
    u = np.where(near < 1, np.where(rising, done, n - done), steady)
    return u, e / step_s, e, de


def _jolt(tau: Array, n: int, step_s: float) -> tuple[Array, Array]:
    """Jolt of the last contact for an impact of 1 m/s^2 [m] and its rate, into a run (G2)."""
    last = np.clip(np.floor(tau / step_s), 0, n)
    t = np.where(last > 0, tau - last * step_s, 0.0)
    rest = np.exp(-t / _JOLT_RISE_S)
    rise, d_rise = (1 - rest) ** 3, 3 * (1 - rest) ** 2 * rest / _JOLT_RISE_S
    decay = np.exp(-t / _JOLT_DECAY_S) / _JOLT_RADPS**2
    wave, d_wave = np.sin(_JOLT_RADPS * t), _JOLT_RADPS * np.cos(_JOLT_RADPS * t)
    rate = d_rise * decay * wave + rise * decay * (d_wave - wave / _JOLT_DECAY_S)
    return rise * decay * wave, rate


def _body_rate(
    pitch: Array, roll: Array, yaw_rate: Array, pitch_rate: Array, roll_rate: Array
) -> Array:
    """(n, 3) angular velocity in body axes of Euler angles ZYX and their rates."""
    return np.column_stack(
        [
            roll_rate - yaw_rate * np.sin(pitch),
            pitch_rate * np.cos(roll) + yaw_rate * np.sin(roll) * np.cos(pitch),
            -pitch_rate * np.sin(roll) + yaw_rate * np.cos(roll) * np.cos(pitch),
        ]
    )
