"""The runs that the committed baselines watch: every shipped scenario, every importer's recording.

Each run goes through the real tracker in memory, as ``netpos replay`` does it.
"""

from __future__ import annotations

import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from netpos.bags import BagReader, codec
from netpos.bags.importers import import_ble_aoa, import_uwb_anchors, import_uwb_trolley
from netpos.bags.importers.common import recordings
from netpos.evaluation.availability import refusals
from netpos.evaluation.metrics import Figures, Run, score
from netpos.evaluation.pairing import ClockOffsets, Trajectory
from netpos.messages import topics
from netpos.messages.values import (
    Beacon,
    ClockState,
    ImuSample,
    MagneticSample,
    Odometry,
    RsuInfo,
    RsuMeasurement,
    Step,
)
from netpos.scenario import Simulation, load_scenario
from netpos.scenario.load import scenario_names
from netpos.scenario.offline import timeline
from netpos.scenario.recorded_drive import import_car_drive
from netpos.scenario.replay import reading_of, tracker_of
from netpos.scenario.settings import TrackerSettings, bag_settings, settings_from
from netpos.tracking.config import TrackerConfig
from netpos.tracking.ordering.sequencer import Item
from netpos.tracking.report import TrackOutput

SEEDS = range(9001, 9061)
FEWEST_RUNS = 8
ENOUGH_S = 1500.0  # of all runs of a scenario
_CLOCK_HZ = 1.0  # these runs do not use /clock


@dataclass(frozen=True, slots=True)
class Material:
    """Input of the tracker in one run, in order, and the ground truth, by device."""

    settings: TrackerSettings
    rsus: tuple[RsuInfo, ...]
    items: Sequence[Item | ImuSample]
    truth: Mapping[str, list[Odometry]]
    clock_truth: Mapping[str, list[ClockState]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Tracked:
    """One device of one run: its figures, tracks lost, measurements rejected and judged in all."""

    figures: Figures
    lost: int
    rejected: int
    judged: int


@dataclass(frozen=True, slots=True)
class Case:
    """A scenario under the first seeds of ``SEEDS``, at least ``FEWEST_RUNS`` and so many that the
    runs last ``ENOUGH_S`` in all, or one recording.

    ``materials`` makes the runs one after the other; ``missing`` says why it cannot, "" where it
    can.
    """

    name: str
    materials: Callable[[], Iterator[Material]]
    missing: str = ""


def cases() -> dict[str, Case]:
    """All cases by name: shipped scenarios, then recordings, each sorted."""
    simulated = {name: Case(name, partial(_simulated, name)) for name in scenario_names()}
    recorded = {name: _recording(name) for name in sorted(RECORDINGS)}
    return {**simulated, **recorded}


def outputs_of(material: Material, changes: Mapping[str, Any] | None = None) -> list[TrackOutput]:
    """Outputs of the tracker for a material, in order; ``changes`` replaces parameters of the
    tracker."""
    parameters = {**material.settings.parameters, **(changes or {})}
    tracker = tracker_of(TrackerConfig.from_mapping(parameters), material.settings)
    for info in material.rsus:
        tracker.add_rsu(info)
    outputs: list[TrackOutput] = []
    for item in material.items:
        tracker.add(item)
        outputs += tracker.process()
    return outputs + tracker.flush()


def track(material: Material, changes: Mapping[str, Any] | None = None) -> list[Tracked]:
    """Run the tracker over a material and score each device that has truth; ``changes`` as for
    ``outputs_of``."""
    outputs = outputs_of(material, changes)
    return [_scored(material, vue, outputs) for vue in sorted(material.truth)]


def thinned(material: Material, share: float, seed: int) -> Material:
    """The same without a random ``share`` of the RSUs' measurements."""
    drawn = np.random.default_rng(seed).random(len(material.items)) >= share
    kept = [
        item
        for item, keep in zip(material.items, drawn.tolist(), strict=True)
        if keep or not isinstance(item, RsuMeasurement)
    ]
    return replace(material, items=kept)


def _scored(material: Material, vue: str, outputs: Sequence[TrackOutput]) -> Tracked:
    mine = [o for o in outputs if not o.network and o.status.vue_id == vue]
    statuses = [o.status for o in mine]
    measured = [
        item.stamp_ns
        for item in material.items
        if isinstance(item, RsuMeasurement) and item.vue_id == vue
    ]
    run = Run(
        truth=Trajectory.of(material.truth[vue]),
        estimate=Trajectory.of(o.odometry for o in mine if o.odometry is not None),
        statuses=statuses,
        measured_ns=np.unique(np.array(measured, dtype=np.int64)),
        clock=ClockOffsets.of(o.clock for o in mine if o.clock is not None),
        clock_truth=ClockOffsets.of(material.clock_truth.get(vue, ())),
    )
    figures = score(run).figures
    last = max(statuses, key=lambda status: status.stamp_ns, default=None)
    return Tracked(figures, figures.lost_tracks or 0, *(refusals(last) if last else (0, 0)))


def _simulated(name: str) -> Iterator[Material]:
    simulation = Simulation(load_scenario(name))
    settings = settings_from(name)
    lasted_s = 0.0
    for runs, seed in enumerate(SEEDS):
        if runs >= FEWEST_RUNS and lasted_s >= ENOUGH_S:
            return
        material = simulated(simulation.with_seed(seed), settings)
        truth = next(iter(material.truth.values()))
        lasted_s += (truth[-1].stamp_ns - truth[0].stamp_ns) * 1e-9
        yield material


def simulated(simulation: Simulation, settings: TrackerSettings) -> Material:
    """One run of a scenario."""
    items: list[Item | ImuSample] = []
    truth: dict[str, list[Odometry]] = defaultdict(list)
    clock: dict[str, list[ClockState]] = defaultdict(list)
    for value in timeline(simulation, _CLOCK_HZ, measured=True):
        match value:
            case Odometry():
                truth[value.vue_id].append(value)
            case ClockState():
                clock[value.vue_id].append(value)
            case RsuInfo() | Beacon() | MagneticSample() | Step() | int():
                pass
            case _:
                items.append(value)
    return Material(settings, simulation.rsus, items, truth, clock)


Importer = Callable[[Path, Path], object]
# Case: folder below NETPOS_DATA, and what makes a bag of it.
RECORDINGS: dict[str, tuple[str, Importer]] = {
    "ble_uc1_run1": ("ble_aoa", partial(import_ble_aoa, run="uc1_run1")),
    "ble_uc1_run2": ("ble_aoa", partial(import_ble_aoa, run="uc1_run2")),
    "ble_uc2_run1": ("ble_aoa", partial(import_ble_aoa, run="uc2_run1")),
    "ble_uc3_run1": ("ble_aoa", partial(import_ble_aoa, run="uc3_run1")),
    "car_imu_rtk": ("car_imu_rtk", import_car_drive),
    "uwb_los": ("uwb_car_anchors/LOS", import_uwb_anchors),
    "uwb_los_gap": ("uwb_car_anchors/LOS_gap", import_uwb_anchors),
    "uwb_nlos": ("uwb_car_anchors/NLOS", import_uwb_anchors),
    "uwb_trolley": ("uwb_trolley", import_uwb_trolley),
}


def _recording(name: str) -> Case:
    below, importer = RECORDINGS[name]
    folder = recordings(below)
    if folder is None:
        missing = f"real recording is absent: no folder {below} below NETPOS_DATA"
        return Case(name, lambda: iter(()), missing)
    return Case(name, partial(_recorded, folder, importer))


def _recorded(folder: Path, importer: Importer) -> Iterator[Material]:
    with tempfile.TemporaryDirectory() as temporary:
        bag = Path(temporary) / "bag"
        importer(folder, bag)
        yield material_of(bag)


def material_of(bag: Path) -> Material:
    """The material of an imported bag."""
    make, truth = codec(), defaultdict(list)
    items: list[Item | ImuSample] = []
    with BagReader(bag) as source:
        settings = bag_settings(source)
        config = TrackerConfig.from_mapping(settings.parameters)
        read = {name: reading_of(name, info, config) for name, info in source.topics.items()}
        infos = source.messages([topics.RSU_INFO])
        rsus = tuple(make.rsu_info_from_msg(entry.message) for entry in infos)
        for entry in source.messages():
            item_of = read[entry.topic]
            if item_of is not None:
                items.append(item_of(entry))
            elif topics.split(entry.topic)[1] == topics.GROUND_TRUTH:
                value = make.odometry_from_msg(entry.message)
                truth[topics.split(entry.topic)[0]].append(value)
    return Material(settings, rsus, items, truth)
