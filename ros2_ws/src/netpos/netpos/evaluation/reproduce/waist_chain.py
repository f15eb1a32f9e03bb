"""The whole chain of petukhov, simulated: gait, waist IMU and magnetometer, dead reckoning, anchor
and tracker, fed with what an offline run of ``pedestrian_rectangle`` carries."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from netpos.evaluation.reproduce.frame import Work
from netpos.messages.values import (
    Array,
    ImuSample,
    Odometry,
    RsuInfo,
    RsuMeasurement,
    Step,
    TrackState,
    Velocity,
)
from netpos.scenario import Simulation, load_scenario
from netpos.scenario.offline import timeline
from netpos.tracking import Tracker, TrackerConfig, TrackOutput

Bools = npt.NDArray[np.bool_]

Settings = tuple[tuple[str, object], ...]


@dataclass(frozen=True, slots=True)
class Chain:
    """Estimates of one run: error (n, 2) m, covariance (n, 2, 2), whether the track said TRACKING
    (n,); steps found."""

    error: Array
    cov: Array
    tracking: Bools
    steps_found: int


def run_chain(seed: int, tracker_settings: Settings = ()) -> Chain:
    """The scenario under a seed, with settings of the tracker over its own."""
    scenario = load_scenario("pedestrian_rectangle", seed=seed)
    config = TrackerConfig.from_mapping({**scenario.tracker, **dict(tracker_settings)})
    tracker, steps = Tracker(config), 0
    truth: dict[int, Array] = {}
    outputs: list[TrackOutput] = []
    for value in timeline(Simulation(scenario), measured=True):
        match value:
            case RsuInfo():
                tracker.add_rsu(value)
            case RsuMeasurement() | Velocity() | ImuSample():
                tracker.add(value)
                outputs += tracker.process()
            case Odometry():
                truth[value.stamp_ns] = value.position[:2]
            case Step():
                steps += 1
    outputs += tracker.flush()
    return Chain(*_scored(outputs, truth), steps)


def _scored(outputs: list[TrackOutput], truth: dict[int, Array]) -> tuple[Array, Array, Bools]:
    last = {o.status.stamp_ns: o for o in outputs if o.status.stamp_ns in truth}
    rows = [
        (o.odometry.position[:2] - truth[ns], o.odometry.pose_cov[:2, :2], o.status.state)
        for ns, o in sorted(last.items())
        if o.odometry is not None
    ]
    error, cov, state = zip(*rows, strict=True)
    return np.array(error), np.array(cov), np.array([s == TrackState.TRACKING for s in state])


def _job(settings: Settings, seeds: range) -> list[Chain]:
    return [run_chain(seed, settings) for seed in seeds]


def run_chains(work: Work, label: str, settings: Settings = ()) -> list[Chain]:
    """The chain under all seeds of ``work``."""
    return [run for part in work.over_seeds(label, _job, settings) for run in part]
