"""Six canonical problems for the particle-filter oracle, drawn from the model they are solved by.

A case is one draw: what the tracker is given (parameters, RSUs, items), what the particle filter
is given (prior, motion, rows), and the truth. All is level: heights are 0.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from netpos.messages.values import Array, Field, InitialPose, RsuInfo, RsuMeasurement, Velocity
from particle_filter import Motion, Start
from particle_kernels import Kind
from scipy.constants import speed_of_light

T0_NS = 1_000_000_000
VUE = "vue_1"
# Plan of the four UWB anchors of a recorded car; two are above each other.
ANCHORS = {"a3": (2.58, 0.87), "a5": (2.58, -0.87), "a9": (2.58, -0.87), "a12": (0.69, 0.87)}
RANGE_SD_M, ANCHOR_HZ = 0.2, 9.0
LATE_SHARE, LATE_MEAN_M = 0.3, 2.0
ACCEL = 0.5
TURNS_HZ = 1.0 / 30.0  # what the tracker assumes
DRIFT = (25e-6, 30e-6)  # mean and sd of a clock nobody knows
CLOCK_DENSITIES = (1e-10, 2.5e-7)
KNOWN_CLOCK, KNOWN_CLOCK_DENSITIES = (3e-9, 1e-9), (1e-10, 1e-10)
WAVELENGTH_M, TURNS = 0.05, 4.0
NEVER = 1e-12  # the least probability that the tracker takes
PHASE_SCALE, PHASE_SD = 2.0 * math.pi * TURNS, math.radians(6.0)


@dataclass(slots=True)
class Step:
    """One epoch: seconds after the start, rows (m, WIDTH) of the particle filter, the tracker's
    items, the true state (4,), whether the posterior is compared."""

    time_s: float
    rows: Array
    items: list[Any]
    truth: Array
    scored: bool
    guided: bool = False


@dataclass(slots=True, kw_only=True)
class Case:
    """One draw of a problem."""

    config: dict[str, Any]
    rsus: tuple[RsuInfo, ...]
    start: Start
    motion: Motion
    steps: list[Step] = field(default_factory=list)


def _noise(rng: np.random.Generator, dt: float, density: float) -> Array:
    """(2,) value and rate after ``dt`` of a rate doing a random walk from 0."""
    drawn = rng.standard_normal(2)
    rate = density * math.sqrt(dt) * drawn[0]
    return np.array([dt / 2.0 * rate + density * math.sqrt(dt**3 / 12.0) * drawn[1], rate])


def _path(
    rng: np.random.Generator, start: Start, motion: Motion, times: Sequence[float]
) -> tuple[Array, Array]:
    """True states (n, 4) and clock offsets [m] (n,) at the times, the first of them 0."""
    spread = np.repeat([start.position_sd, start.velocity_sd], 2)
    state = start.mean + spread * rng.standard_normal(4)
    clock = np.array(start.clock_mean) + np.array(start.clock_sd) * rng.standard_normal(2)
    states, offsets = [state], [clock[0]]
    for dt in np.diff(times):
        x, y, vx, vy = states[-1]
        if rng.random() < -math.expm1(-motion.turns_hz * dt):
            vx, vy = (-vy, vx) if rng.random() < 0.5 else (vy, -vx)
        moved = np.array([x + dt * vx, y + dt * vy, vx, vy])
        for axis in range(2):
            moved[axis::2] += _noise(rng, dt, motion.accel)
        states.append(moved)
        clock = clock + _noise(rng, dt, motion.clock[1]) + np.array([dt * clock[1], 0.0])
        clock[0] += motion.clock[0] * math.sqrt(dt) * rng.standard_normal()
        offsets.append(clock[0])
    return np.array(states), np.array(offsets)


def _row(kind: Kind, value: float, sd: float, at: Array, a: float = 0.0, b: float = 0.0) -> Array:
    return np.array([kind, value, sd, at[0], at[1], a, b])


def _measurement(stamp_ns: int, rsu_id: str, fields: Field, **values: float) -> RsuMeasurement:
    return RsuMeasurement(
        stamp_ns=stamp_ns, rsu_id=rsu_id, vue_id=VUE, expected=1, fields=fields, **values
    )


def _stamp(time_s: float) -> int:
    return T0_NS + round(1e9 * time_s)


def _pose(start: Start) -> InitialPose:
    place = np.array([*start.mean[:2], 0.0])
    cov = np.eye(3) * start.position_sd**2
    return InitialPose(stamp_ns=T0_NS, vue_id=VUE, position=place, cov=cov)


def _velocity(stamp_ns: int, velocity: Array, sd: float) -> Velocity:
    return Velocity(stamp_ns=stamp_ns, vue_id=VUE, velocity=velocity, cov=np.eye(2) * sd**2)


def _at_moments(times: Sequence[float], moments: Sequence[float]) -> set[int]:
    """Indices of the last times not after the moments."""
    return {int(np.searchsorted(times, moment + 1e-9)) - 1 for moment in moments}


def _config(start: Start, motion: Motion, **values: Any) -> dict[str, Any]:
    shared = {
        "hold_s": 0.0,
        "accel_density_mps2_sqrthz": motion.accel,
        "initial_speed_sd_mps": start.velocity_sd,
        "manoeuvre_speed_sd_mps": 0.0,
        "isolate_rsus": False,  # no RSU errs grossly
    }
    return {**shared, **values}


def _anchor_ranges(
    rng: np.random.Generator,
    case: Case,
    times: Sequence[float],
    moments: Sequence[float],
    late: float = 0.0,
) -> None:
    """Fill a case with a range of one anchor after the other."""
    truth, _ = _path(rng, case.start, case.motion, times)
    names, scored = list(ANCHORS), _at_moments(times, moments)
    for k, (time_s, state) in enumerate(zip(times, truth, strict=True)):
        name = names[k % len(names)]
        origin = np.array(ANCHORS[name])
        value = math.hypot(*(state[:2] - origin)) + RANGE_SD_M * rng.standard_normal()
        kind = Kind.LATE_RANGE if late > 0.0 else Kind.RANGE
        if rng.random() < late:
            value += LATE_MEAN_M * rng.standard_exponential()
        stamp = _stamp(time_s)
        item = _measurement(stamp, name, Field.RANGE, range_m=value, range_var=RANGE_SD_M**2)
        row = _row(kind, value, RANGE_SD_M, origin, late, LATE_MEAN_M)
        case.steps.append(Step(time_s, row[None], [item], state, k in scored))


def _anchor_infos() -> tuple[RsuInfo, ...]:
    return tuple(RsuInfo(rsu_id=n, position=np.array([*p, 0.0])) for n, p in ANCHORS.items())


def _every(start_s: float, end_s: float, rate_hz: float) -> list[float]:
    """Times from ``start_s`` to ``end_s`` on whole nanoseconds."""
    count = round((end_s - start_s) * rate_hz) + 1
    return [round(start_s + k / rate_hz, 9) for k in range(count)]


def first_fix(rng: np.random.Generator, share: float = 1.0) -> Case:
    """Four anchors on a car, a device anywhere within about 50 m."""
    start = Start(mean=np.zeros(4), position_sd=25.0, velocity_sd=1.5)
    motion = Motion(accel=ACCEL)
    config = _config(start, motion, coverage_radius_m=start.position_sd)
    case = Case(config=config, rsus=_anchor_infos(), start=start, motion=motion)
    moments = [t for t in (0.25, 0.5, 1.0, 2.0, 3.0) if t <= 3.0 * share]
    _anchor_ranges(rng, case, _every(0.0, 3.0 * share, 4 * ANCHOR_HZ), moments)
    case.steps[0].guided = True
    return case


def silence(rng: np.random.Generator, share: float = 1.0) -> Case:
    """The same anchors after 20 s without a range."""
    mean = np.zeros(4)
    mean[:2] = 20.0 * rng.standard_normal(2)
    start = Start(mean=mean, position_sd=2.0, velocity_sd=1.5)
    motion = Motion(accel=ACCEL)
    case = Case(config=_config(start, motion), rsus=_anchor_infos(), start=start, motion=motion)
    rate, heard_s = 4 * ANCHOR_HZ, 2.0 * share
    times = _every(0.0, heard_s, rate)
    again = _every(heard_s + 20.0, 2.0 * heard_s + 20.0, rate)
    moments = [again[0] + t for t in (0.1, 0.25, 0.5, 1.0, 2.0) if t <= heard_s]
    _anchor_ranges(rng, case, times + again, moments)
    case.steps[0].items.insert(0, _pose(start))
    case.steps[len(times)].guided = True
    return case


def blocked_paths(rng: np.random.Generator, share: float = 1.0) -> Case:
    """The same anchors, every third path blocked."""
    mean = np.zeros(4)
    mean[:2] = 20.0 * rng.standard_normal(2)
    start = Start(mean=mean, position_sd=2.0, velocity_sd=1.5)
    motion = Motion(accel=ACCEL)
    blocked = {"nlos_probability": LATE_SHARE, "nlos_mean_excess_m": LATE_MEAN_M}
    config = _config(start, motion, **blocked)
    case = Case(config=config, rsus=_anchor_infos(), start=start, motion=motion)
    moments = [t for t in (0.5, 1.0, 2.0, 3.0, 4.0) if t <= 4.0 * share]
    times = _every(0.0, 4.0 * share, 4 * ANCHOR_HZ)
    _anchor_ranges(rng, case, times, moments, LATE_SHARE)
    case.steps[0].items.insert(0, _pose(start))
    return case


def _reported(
    report: Array, sd: float, speed_sd: float, place: Array, place_sd: float, **clock: Any
) -> Start:
    """Prior after a velocity report of ``sd`` has met a speed of mean 0 and sd ``speed_sd``."""
    gain = speed_sd**2 / (speed_sd**2 + sd**2)
    velocity_sd = math.sqrt(gain) * sd
    mean = np.array([*place, *(gain * report)])
    return Start(mean=mean, position_sd=place_sd, velocity_sd=velocity_sd, **clock)


def _one_rsu(
    rng: np.random.Generator,
    case: Case,
    report: tuple[Array, float],
    sds: tuple[float, float],
    times: Sequence[float],
    moments: Sequence[float],
) -> None:
    """Fill a case with angle and TOA of an RSU at the origin; ``sds`` in rad and m."""
    truth, offsets = _path(rng, case.start, case.motion, times)
    scored, c = _at_moments(times, moments), speed_of_light
    for k, (time_s, state, offset) in enumerate(zip(times, truth, offsets, strict=True)):
        angle = math.atan2(state[1], state[0]) + sds[0] * rng.standard_normal()
        angle = math.remainder(angle, math.tau)
        late = math.hypot(*state[:2]) + offset + sds[1] * rng.standard_normal()
        item = _measurement(
            _stamp(time_s),
            "rsu",
            Field.AZIMUTH | Field.TOA,
            azimuth_rad=angle,
            azimuth_var=sds[0] ** 2,
            toa_s=late / c,
            toa_var=(sds[1] / c) ** 2,
        )
        rows = np.array(
            [
                _row(Kind.BEARING, angle, sds[0], np.zeros(2)),
                _row(Kind.TOA, late, sds[1], np.zeros(2)),
            ]
        )
        case.steps.append(Step(time_s, rows, [item], state, k in scored))
    first = [_pose(case.start), _velocity(T0_NS, *report)]
    case.steps[0].items[:0] = first


def _clock_config(
    offset_sd: float, drift: tuple[float, float], densities: tuple[float, float]
) -> dict[str, float]:
    return {
        "clock_offset_sd_s": offset_sd,
        "clock_drift_mean": drift[0],
        "clock_drift_sd": drift[1],
        "clock_white_density": densities[0],
        "clock_walk_density": densities[1],
    }


def _clock_start(offset_sd: float, drift: tuple[float, float]) -> dict[str, tuple[float, float]]:
    c = speed_of_light
    return {"clock_mean": (0.0, c * drift[0]), "clock_sd": (c * offset_sd, c * drift[1])}


def _densities_m(densities: tuple[float, float]) -> tuple[float, float]:
    return speed_of_light * densities[0], speed_of_light * densities[1]


def pass_by(rng: np.random.Generator, share: float = 1.0) -> Case:
    """One RSU with angle and TOA of an unknown clock; a device passes 8 m away."""
    speed, lead_m, end_s = ((1.4, 10.0, 12.0), (5.0, 30.0, 12.0), (14.0, 50.0, 8.0))[
        int(rng.integers(3))
    ]
    sds = math.radians(rng.uniform(1.0, 2.0)), float(rng.uniform(3.0, 15.0))
    report, report_sd, speed_sd = np.array([speed, 0.0]), 0.25 * speed, max(1.5, speed)
    clock = _clock_start(1e-4, DRIFT)
    place = np.array([-lead_m, 8.0])
    start = _reported(report, report_sd, speed_sd, place, 5.0, **clock)
    motion = Motion(accel=ACCEL, clock=_densities_m(CLOCK_DENSITIES))
    config = _config(start, motion, initial_speed_sd_mps=speed_sd)
    config |= _clock_config(1e-4, DRIFT, CLOCK_DENSITIES)
    rsu = RsuInfo(rsu_id="rsu", position=np.zeros(3))
    case = Case(config=config, rsus=(rsu,), start=start, motion=motion)
    moments = [end_s * k / 6.0 for k in range(1, 7) if k / 6.0 <= share + 1e-9]
    times = _every(0.0, end_s * share, 10.0)
    _one_rsu(rng, case, (report, report_sd), sds, times, moments)
    return case


def turn(rng: np.random.Generator, share: float = 1.0) -> Case:
    """One RSU with angle and TOA of a known clock; a device turns now and then."""
    report, report_sd, speed_sd = np.array([6.0, 0.0]), 0.5, 6.0
    clock = _clock_start(KNOWN_CLOCK[0], (0.0, KNOWN_CLOCK[1]))
    start = _reported(report, report_sd, speed_sd, np.array([-50.0, 25.0]), 1.0, **clock)
    densities = _densities_m(KNOWN_CLOCK_DENSITIES)
    motion = Motion(accel=ACCEL, turns_hz=TURNS_HZ, clock=densities)
    drift = 0.0, KNOWN_CLOCK[1]
    config = _config(start, motion, initial_speed_sd_mps=speed_sd, manoeuvre_speed_sd_mps=speed_sd)
    config |= _clock_config(KNOWN_CLOCK[0], drift, KNOWN_CLOCK_DENSITIES)
    rsu = RsuInfo(rsu_id="rsu", position=np.zeros(3))
    case = Case(config=config, rsus=(rsu,), start=start, motion=motion)
    moments = [2.0 * k for k in range(1, 10) if 2.0 * k <= 18.0 * share]
    times = _every(0.0, 18.0 * share, 10.0)
    sds = math.radians(1.5), 3.0
    _one_rsu(rng, case, (report, report_sd), sds, times, moments)
    return case


def phase_sectors(rng: np.random.Generator, share: float = 1.0) -> Case:
    """A phase difference over four wavelengths, a range and step velocities; heard in front."""
    start = Start(mean=np.zeros(4), position_sd=6.0, velocity_sd=1.0)
    motion = Motion(accel=ACCEL)
    length = TURNS * WAVELENGTH_M
    rsu = RsuInfo(rsu_id="rsu", position=np.zeros(3), baseline_m=length, wavelength_m=WAVELENGTH_M)
    config = _config(start, motion, coverage_radius_m=start.position_sd)
    config["sector_slip_probability"] = NEVER
    case = Case(config=config, rsus=(rsu,), start=start, motion=motion)
    times = _every(0.0, 5.0 * share, 10.0)
    moments = [t for t in (0.0, 0.5, 1.0, 2.0, 3.0, 5.0) if t <= 5.0 * share]
    truth, _ = _path(rng, start, motion, times)
    if truth[0, 0] < 0.0:  # the prior is symmetric: mirror the way into the front
        truth[:, ::2] *= -1.0
    scored = _at_moments(times, moments)
    for k, (time_s, state) in enumerate(zip(times, truth, strict=True)):
        if state[0] < 0.0:
            break  # not heard any more
        case.steps.append(_phase_step(rng, time_s, state, k in scored))
    case.steps[0].guided = True
    return case


def _phase_step(rng: np.random.Generator, time_s: float, state: Array, scored: bool) -> Step:
    """Range to the right antenna, phase along the array (to the right, -y), velocity."""
    range_sd, velocity_sd, along = 0.03, 0.1, -math.pi / 2.0
    master = np.array([0.0, -TURNS * WAVELENGTH_M / 2.0])
    ranged = math.hypot(*(state[:2] - master)) + range_sd * rng.standard_normal()
    phase = -PHASE_SCALE * state[1] / math.hypot(*state[:2])
    phase = math.remainder(phase + PHASE_SD * rng.standard_normal(), math.tau)
    velocity = state[2:] + velocity_sd * rng.standard_normal(2)
    stamp = _stamp(time_s)
    item = _measurement(
        stamp,
        "rsu",
        Field.RANGE | Field.PHASE,
        range_m=ranged,
        range_var=range_sd**2,
        phase_difference_rad=phase,
        phase_difference_var=PHASE_SD**2,
    )
    origin = np.zeros(2)
    rows = [
        _row(Kind.RANGE, ranged, range_sd, master),
        _row(Kind.PHASE, phase, PHASE_SD, origin, PHASE_SCALE, along),
        _row(Kind.FRONT, 0.0, 1.0, origin),
        *(_row(Kind.STATE, velocity[a], velocity_sd, origin, 2.0 + a) for a in range(2)),
    ]
    items = [_velocity(stamp, velocity, velocity_sd), item]
    return Step(time_s, np.array(rows), items, state, scored)


@dataclass(frozen=True, slots=True)
class Problem:
    """Name and draw; ``factor``: it takes so many times the particles of the others."""

    name: str
    draw: Callable[..., Case]
    factor: int = 1


PROBLEMS = {
    1: Problem("first fix from four anchors on a car", first_fix),
    2: Problem("the same anchors after 20 s of silence", silence),
    3: Problem("passing one RSU, clock unknown", pass_by),
    4: Problem("phase sectors", phase_sectors, 2),
    5: Problem("undeclared turns, one RSU", turn, 5),
    6: Problem("blocked paths, 30 %", blocked_paths),
}


def draw(problem: int, seed: int, share: float = 1.0) -> Case:
    """Case of a problem and a seed; ``share`` < 1 ends it earlier. Raises ``KeyError``."""
    return PROBLEMS[problem].draw(np.random.default_rng([problem, seed]), share)
