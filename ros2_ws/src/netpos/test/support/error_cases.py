"""Simulated errors of ranges, times and time differences around a yard or from the corners of a
car, and of arrays on the walls of a room: white noise, a first-order Gauss-Markov bias each, and
late paths, against what is declared."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from netpos.estimation.motion import SPEED_OF_LIGHT_MPS
from netpos.messages.values import (
    AngleConvention,
    Array,
    Field,
    RsuInfo,
    RsuMeasurement,
    TrackState,
)
from netpos.tracking.config import TrackerConfig
from netpos.tracking.tracker import Tracker

DURATION_S = 90.0
GO_S, STOP_AND_GO_S = 5.0, 20.0
WALK_MPS = 1.3
CLOCK_M, DRIFT_MPS = 30.0, 3.0  # sd of the device's: 100 ns, 10 ns/s
DEVICE_M = {False: 0.0, True: 1.13}  # height, for ranges and for arrays
FACING_RAD = np.radians([0.0, 90.0, 180.0, 270.0])  # of the arrays
ON_A_CAR_M = np.array([[0.7, 0.9, -0.6], [2.6, -0.9, -0.6], [2.6, -0.9, 0.9], [2.6, 0.9, 0.9]])
INWARDS_M = np.array([[0.0, 3.0, 2.3], [6.0, 0.0, 2.3], [12.0, 3.0, 2.3], [6.0, 6.0, 2.3]])


class Measures(StrEnum):
    """What RSUs measure: times of arrival while the clock of the device is unknown, time
    differences to the first of them, or, arrays, two direction cosines."""

    RANGES = "ranges"
    TIMES = "times"
    DIFFERENCES = "time differences"
    COSINES = "arrays"


@dataclass(frozen=True, slots=True)
class Case:
    """True errors: variance over the one declared, bias [sd of the noise declared], correlation
    time [s] and length [m], share of blocked paths; RSUs; whether the device moves, and whether it
    stops in between; what the RSUs measure, or whether they are close together on a car; how far
    the drift of the device's clock walks [(s/s)/sqrt(s)]."""

    variance: float = 1.0
    bias: float = 1.0
    time_s: float = 60.0
    length_m: float = math.inf
    blocked: float = 0.0
    rsus: int = 5
    moving: bool = True
    stops: bool = False
    measures: Measures = Measures.RANGES
    on_a_car: bool = False
    clock_walk: float = 0.0

    @property
    def arrays(self) -> bool:
        """Whether the RSUs are arrays."""
        return self.measures is Measures.COSINES

    @property
    def noise_sd(self) -> float:
        """Declared [m], or of a direction cosine."""
        return math.radians(5.0) if self.arrays else 0.1

    @property
    def rate_hz(self) -> float:
        """Of measurements of each RSU."""
        return 10.0 if self.arrays else 5.0


def walk(case: Case, times: Array) -> Array:
    """(n, 2) m: a loop in the yard or in the room, all the time or by turns, or a place; or away
    from a car and back."""
    if case.on_a_car:
        away = 6.0 + np.minimum(times, DURATION_S - times)
        return np.column_stack([away, 4.0 * np.sin(times / 7.0) + 2.0 * np.sin(times / 13.0)])
    if not case.moving:
        return np.tile([8.0, 2.0] if case.arrays else [2.0, -1.5], (times.size, 1))
    if case.stops:
        rounds, begun_s = np.divmod(times, STOP_AND_GO_S)
        times = GO_S * rounds + np.minimum(begun_s, GO_S)
    if case.arrays:
        return _in_room(WALK_MPS * times)
    angle = times / 8.0
    return np.column_stack([8.0 * np.cos(angle), 5.0 * np.sin(angle)])


def _in_room(way_m: Array) -> Array:
    """(n, 2) m on an ellipse about the middle of the room, ``way_m`` (n,) from its start."""
    angle = np.linspace(0.0, 2.0 * np.pi, 721)
    loop = np.column_stack([6.0 + 4.0 * np.cos(angle), 3.0 + 1.8 * np.sin(angle)])
    along = np.concatenate([[0.0], np.linalg.norm(np.diff(loop, axis=0), axis=1).cumsum()])
    return np.column_stack([np.interp(way_m % along[-1], along, axis) for axis in loop.T])


def anchors(case: Case) -> Array:
    """(n, 3) m, evenly around the yard, on the four walls, or on the car."""
    if case.on_a_car:
        return ON_A_CAR_M
    if case.arrays:
        return INWARDS_M
    angle = 2.0 * np.pi * (np.arange(case.rsus) + 0.3) / case.rsus
    return np.column_stack([15.0 * np.cos(angle), 12.0 * np.sin(angle), np.full(case.rsus, 3.0)])


def decays(case: Case, places: Array) -> Array:
    """(n - 1,): what is left of a bias from one of ``places`` (n, 2) to the next."""
    way_m = np.linalg.norm(np.diff(places, axis=0), axis=1)
    per_s = math.inf if case.time_s == 0.0 else 1.0 / case.time_s
    left: Array = np.exp(-per_s / case.rate_hz - way_m / case.length_m)
    return left


def true_values(case: Case, places: Array) -> Array:
    """(n, rsus, k): ranges, k = 1, or direction cosines along the y and z axes of arrays."""
    device = np.column_stack([places, np.full(len(places), DEVICE_M[case.arrays])])
    offset = device[:, None] - anchors(case)
    distance = np.linalg.norm(offset, axis=2)
    if not case.arrays:
        return distance[:, :, None]
    across = offset[:, :, 1] * np.cos(FACING_RAD) - offset[:, :, 0] * np.sin(FACING_RAD)
    return np.stack([across, offset[:, :, 2]], axis=2) / distance[:, :, None]


def measured(case: Case, seed: int) -> tuple[Array, Array]:
    """True places (n, 2) and what is measured there (n, rsus, k), of time
    differences the times [m], in one run."""
    rng = np.random.default_rng(seed)
    times = np.arange(0.0, DURATION_S, 1.0 / case.rate_hz)
    places = walk(case, times)
    values = true_values(case, places)
    noise_sd, bias_sd = math.sqrt(case.variance) * case.noise_sd, case.bias * case.noise_sd
    bias = np.empty_like(values)
    bias[0] = rng.normal(0.0, bias_sd, values.shape[1:])
    for k, decay in enumerate(decays(case, places).tolist(), start=1):
        step_sd = bias_sd * math.sqrt(1.0 - decay**2)
        bias[k] = decay * bias[k - 1] + rng.normal(0.0, step_sd, values.shape[1:])
    late = rng.exponential(3.0, values.shape) * (rng.random(values.shape) < case.blocked)
    seen = values + bias + rng.normal(0.0, noise_sd, values.shape) + late
    if case.measures is Measures.TIMES:
        seen += (rng.normal(0.0, CLOCK_M) + rng.normal(0.0, DRIFT_MPS) * times)[:, None, None]
        if case.clock_walk > 0.0:
            density = SPEED_OF_LIGHT_MPS * case.clock_walk / math.sqrt(case.rate_hz)
            drift = density * rng.normal(size=len(times)).cumsum()
            seen += (drift.cumsum() / case.rate_hz)[:, None, None]
    return places, np.clip(seen, -0.99, 0.99) if case.arrays else seen


def tracker_of(case: Case, places: Array, *, told: bool, learn: bool) -> tuple[Tracker, float]:
    """A tracker that knows the RSUs, and the variance that they state. ``told``: noise, bias and
    its correlation time on the way along ``places`` (n, 2) are the true ones."""
    variance = (case.variance if told else 1.0) * case.noise_sd**2
    bias_sd, time_s = case.bias * case.noise_sd, 0.0
    if told and case.time_s > 0.0:
        rate = -case.rate_hz * float(np.log(decays(case, places)).mean())
        time_s = 1.0 / max(rate, 1e-6)
    elif told:
        variance += bias_sd**2
    of_ranges = case.measures is Measures.RANGES
    config = TrackerConfig(
        accel_density_mps2_sqrthz=0.3,
        initial_speed_sd_mps=1.0,
        learn_errors=learn,
        nlos_probability=0.2 if of_ranges and case.blocked > 0.0 else 0.0,
        nlos_mean_excess_m=3.0,
    )
    if case.arrays:
        config = replace(
            config,
            accel_density_mps2_sqrthz=0.6,  # v^2 / T of a person at 1.3 m/s, turns of some seconds
            device_height_m=DEVICE_M[True],
            coverage_radius_m=6.0,
            gate_probability=1.0,
            manoeuvre_speed_sd_mps=0.0,
        )
    tracker = Tracker(config)
    tells = time_s > 0.0 and case.bias > 0.0
    slow = {
        "bias_correlation_time_s": time_s if tells else 0.0,
        **{
            f"{quantity}_sd_{unit}": bias_sd if tells and case.arrays == (unit == "rad") else 0.0
            for quantity, unit in (
                ("range_bias", "m"),
                ("azimuth_bias", "rad"),
                ("elevation_bias", "rad"),
            )
        },
    }
    for info in rsus_of(case):
        tracker.add_rsu(replace(info, **slow))
    return tracker, variance


def rsus_of(case: Case) -> list[RsuInfo]:
    """The RSUs, without slow errors."""
    if not case.arrays:
        return [RsuInfo(rsu_id=f"a{i}", position=p) for i, p in enumerate(anchors(case))]
    return [
        RsuInfo(
            rsu_id=f"a{i}",
            position=position,
            quaternion=np.array([0.0, 0.0, math.sin(facing / 2.0), math.cos(facing / 2.0)]),
            angle_convention=AngleConvention.CONE,
        )
        for i, (position, facing) in enumerate(zip(anchors(case), FACING_RAD, strict=True))
    ]


def messages(case: Case, stamp_ns: int, k: int, values: Array, var: float) -> list[RsuMeasurement]:
    """What the RSUs measure, ``values`` (rsus, k), each of variance ``var``."""
    return [
        replace(
            _message(case, values, i, var),
            stamp_ns=stamp_ns,
            sequence=k,
            expected=case.rsus - (case.measures is Measures.DIFFERENCES),
        )
        for i in range(case.measures is Measures.DIFFERENCES, case.rsus)
    ]


def _message(case: Case, values: Array, i: int, var: float) -> RsuMeasurement:
    """What the RSU ``i`` measures."""
    bare = RsuMeasurement(stamp_ns=0, rsu_id=f"a{i}", vue_id="vue_1")
    if case.arrays:
        angles, angle_vars = np.arcsin(values[i]), var / (1.0 - values[i] ** 2)
        return replace(
            bare,
            fields=Field.AZIMUTH | Field.ELEVATION,
            azimuth_rad=float(angles[0]),
            azimuth_var=float(angle_vars[0]),
            elevation_rad=float(angles[1]),
            elevation_var=float(angle_vars[1]),
        )
    metres, c = float(values[i, 0]), SPEED_OF_LIGHT_MPS
    if case.measures is Measures.TIMES:
        return replace(bare, fields=Field.TOA, toa_s=metres / c, toa_var=var / c**2)
    if case.measures is Measures.DIFFERENCES:
        later_s = (metres - float(values[0, 0])) / c
        of_pair = {"tdoa_s": later_s, "tdoa_var": 2.0 * var / c**2, "reference_rsu_id": "a0"}
        return replace(bare, fields=Field.TDOA, **of_pair)
    return replace(bare, fields=Field.RANGE, range_m=metres, range_var=var)


class Tracked(NamedTuple):
    """A run: true places (n, 2), estimated ones (n, 2), their covariances (n, 2, 2), not a number
    without an estimate, and the protection level (n,), not a number but in the state TRACKING."""

    places: Array
    means: Array
    covs: Array
    levels: Array


def run(case: Case, seed: int, *, told: bool, learn: bool) -> Tracked:
    """Simulate and track one run."""
    places, seen = measured(case, seed)
    tracker, variance = tracker_of(case, places, told=told, learn=learn)
    means, covs = np.full_like(places, math.nan), np.full((len(places), 2, 2), math.nan)
    levels = np.full(len(places), math.nan)
    for k, values in enumerate(seen):
        stamp_ns = round(1e9 * (1.0 + k / case.rate_hz))
        for item in messages(case, stamp_ns, k, values, variance):
            tracker.add(item)
        for output in tracker.process():
            if output.odometry is not None:
                means[k] = output.odometry.position[:2]
                covs[k] = output.odometry.pose_cov[:2, :2]
                if output.status is not None and output.status.state is TrackState.TRACKING:
                    levels[k] = output.status.protection_level_m
    return Tracked(places, means, covs, levels)
