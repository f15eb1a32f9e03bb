"""The whole chain of petukhov, simulated: gait, waist IMU and magnetometer, dead reckoning, anchor
and tracker, fed with what an offline run of ``pedestrian_rectangle`` carries.

A step's velocity comes when dead reckoning knows the step, as in a live run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from netpos.evaluation.work import Work
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
from netpos.reproduction.petukhov.walk_figures import Figures, Scores
from netpos.scenario import Scenario, Simulation, load_scenario
from netpos.scenario.offline import timeline
from netpos.tracking import Tracker, TrackerConfig, TrackOutput

SCENARIO = "pedestrian_rectangle"
Settings = tuple[tuple[str, object], ...]
Heard = RsuInfo | RsuMeasurement | Velocity | ImuSample
_BASELINE = "rsus.units.0.antennas.baseline_wavelengths"


@dataclass(frozen=True, slots=True, kw_only=True)
class Variant:
    """A tracker of the walk: settings over those of the scenario or, with ``defaults``, over those
    of the library; the device's height is a fact of the scenario either way."""

    name: str
    settings: Settings = ()
    defaults: bool = False

    def config(self, scenario: Scenario) -> TrackerConfig:
        """Its parameters."""
        return config_of(scenario, self.settings, self.defaults)


def config_of(scenario: Scenario, settings: Settings, defaults: bool) -> TrackerConfig:
    """Settings over those of the scenario or, with ``defaults``, over those of the library and the
    device's height."""
    given = dict(scenario.tracker)
    if defaults:
        given = {"device_height_m": given["device_height_m"]}
    return TrackerConfig.from_mapping({**given, **dict(settings)})


@dataclass(frozen=True, slots=True, kw_only=True)
class Walk:
    """What one run carries: ``heard`` by the tracker in its order; times_s (n,) and truth (n, 2) m
    at the beacons; steps found by dead reckoning."""

    scenario: Scenario
    heard: tuple[Heard, ...]
    stamps_ns: tuple[int, ...]
    truth: Array
    detected_steps: int

    @property
    def times_s(self) -> Array:
        """(n,) since the first beacon."""
        return (np.array(self.stamps_ns) - self.stamps_ns[0]) * 1e-9


@dataclass(frozen=True, slots=True)
class Chains:
    """Figures of each variant over the same runs, and the steps found in each run (runs,)."""

    figures: dict[str, Figures]
    detected_steps: Array


def simulate(seed: int, wavelengths: float) -> Walk:
    """One walk before an anchor with a baseline of so many wavelengths."""
    scenario = load_scenario(SCENARIO, seed=seed, changes={_BASELINE: wavelengths})
    heard: list[Heard] = []
    truth: dict[int, Array] = {}
    steps = 0
    for value in timeline(Simulation(scenario), measured=True):
        match value:
            case RsuInfo() | RsuMeasurement() | Velocity() | ImuSample():
                heard.append(value)
            case Odometry():
                truth[value.stamp_ns] = value.position[:2]
            case Step():
                steps += 1
    stamps = tuple(sorted(truth))
    return Walk(
        scenario=scenario,
        heard=tuple(heard),
        stamps_ns=stamps,
        truth=np.array([truth[stamp] for stamp in stamps]),
        detected_steps=steps,
    )


def follow(walk: Walk, variant: Variant) -> Scores:
    """A walk through a tracker; scored from its first TRACKING state on."""
    tracker = Tracker(variant.config(walk.scenario))
    outputs: list[TrackOutput] = []
    for value in walk.heard:
        if isinstance(value, RsuInfo):
            tracker.add_rsu(value)
        else:
            tracker.add(value)
            outputs += tracker.process()
    outputs += tracker.flush()
    last = {output.status.stamp_ns: output for output in outputs}
    error, cov = np.full((len(walk.truth), 2), np.nan), np.full((len(walk.truth), 2, 2), np.nan)
    decided = False
    for k, stamp in enumerate(walk.stamps_ns):
        output = last.get(stamp)
        if output is None or output.odometry is None:
            continue
        decided |= output.status.state == TrackState.TRACKING
        if decided:
            error[k] = output.odometry.position[:2] - walk.truth[k]
            cov[k] = output.odometry.pose_cov[:2, :2]
    return Scores.of(error, cov)


@dataclass(frozen=True, slots=True)
class _Task:
    wavelengths: float
    variants: tuple[Variant, ...]


def _job(task: _Task, seeds: range) -> list[tuple[Array, int, list[Scores]]]:
    """Instants (n,), steps found and the scores of each variant, run by run."""
    runs = []
    for seed in seeds:
        walk = simulate(seed, task.wavelengths)
        scores = [follow(walk, variant) for variant in task.variants]
        runs.append((walk.times_s, walk.detected_steps, scores))
    return runs


def run_chains(work: Work, wavelengths: float, variants: Sequence[Variant]) -> Chains:
    """All variants on the same walks, one per seed of ``work``."""
    task = _Task(wavelengths, tuple(variants))
    label = f"whole chain, L = {wavelengths:g} lambda"
    runs = [run for part in work.over_seeds(label, _job, task) for run in part]
    figures = {
        variant.name: Figures.of(runs[0][0], [scores[i] for _, _, scores in runs])
        for i, variant in enumerate(task.variants)
    }
    return Chains(figures, np.array([steps for _, steps, _ in runs]))
