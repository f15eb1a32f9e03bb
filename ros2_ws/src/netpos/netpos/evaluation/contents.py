"""Contents of a bag by device, read in one pass and kept in little memory."""

from __future__ import annotations

import pickle
import zlib
from array import array
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from netpos.bags import LOST_METADATA, BagEntry, BagError, BagReader, codec
from netpos.bags.recording import SKIPPED, TRUTH_ALIGNMENT
from netpos.common.yaml_text import load_yaml
from netpos.evaluation.metrics import Run
from netpos.evaluation.pairing import Clock, Poses, Stamps
from netpos.evaluation.scene import buildings_of
from netpos.messages import topics
from netpos.messages.values import (
    Array,
    InitialPose,
    RsuErrors,
    RsuInfo,
    RsuMeasurement,
    TrackStatus,
)
from netpos.scenario.settings import bag_settings
from netpos.tracking.config import TrackerConfig

_ODOMETRY, _CLOCK = "nav_msgs/msg/Odometry", "netpos_msgs/msg/ClockState"
_Sink = tuple[str, Callable[[BagEntry], None]]
_BLOCK = 1000  # measurements compressed together
Progress = Callable[[int], None]
"""Called with the number of messages read."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Delivery:
    """Beacons and measurements of one device as recorded.

    beacons: those emitted, None where the bag has none (real RSUs need no such message);
    epochs: beacons at least one RSU reported. received: measurements; duplicates: repeats of one
    RSU and sequence; out_of_order: older than one recorded before. ``expected`` and ``missing``
    are None where the RSUs do not announce how many report.
    """

    beacons: int | None
    epochs: int
    received: int
    duplicates: int
    out_of_order: int
    expected: int | None
    missing: int | None


class _DeliveryCounter:
    """Collects four numbers of each measurement."""

    def __init__(self) -> None:
        self._rows = array("q")
        self._rsus: dict[str, int] = {}

    def add(self, measurement: RsuMeasurement) -> None:
        rsu = self._rsus.setdefault(measurement.rsu_id, len(self._rsus))
        beacon = (measurement.stamp_ns, measurement.sequence)
        self._rows.extend((*beacon, rsu, measurement.expected))

    @property
    def stamps_ns(self) -> Stamps:
        """When something was measured, each instant once."""
        return np.unique(self._table()[:, 0])

    def _table(self) -> Stamps:
        return np.array(self._rows, dtype=np.int64).reshape(-1, 4)

    def result(self, beacons: int | None) -> Delivery:
        rows = self._table()
        stamps = rows[:, 0]
        epochs, of = np.unique(rows[:, :2], axis=0, return_inverse=True)
        expected = np.zeros(len(epochs), dtype=np.int64)
        np.maximum.at(expected, of, rows[:, 3])
        seen = len(np.unique(rows[:, :3], axis=0))
        announced = int(expected.sum()) if len(rows) and expected.all() else None
        return Delivery(
            beacons=beacons,
            epochs=len(epochs),
            received=len(rows),
            duplicates=len(rows) - seen,
            out_of_order=int((stamps < np.maximum.accumulate(stamps)).sum()),
            expected=announced,
            missing=None if announced is None else announced - seen,
        )


def _key(vue: str, network: str) -> str:
    return f"{network}/{vue}" if network else vue


@dataclass(slots=True)
class _Statuses:
    """Statuses of a device; values equal to those of the status before are stored once."""

    kept: list[TrackStatus] = field(default_factory=list)

    def append(self, status: TrackStatus) -> None:
        if self.kept:
            last = self.kept[-1]
            same = {
                name: getattr(last, name)
                for name in ("vue_id", "rejected", "sources", "steps", "reason")
                if getattr(last, name) == getattr(status, name)
            }
            status = replace(status, **same)
        self.kept.append(status)


@dataclass(slots=True)
class _Measured:
    """Measurements of a device, in recorded order, kept as they were recorded and compressed:
    their values take twenty times the place."""

    decode: Callable[[bytes], RsuMeasurement]
    _blocks: list[bytes] = field(default_factory=list)
    _open: list[bytes] = field(default_factory=list)

    def append(self, cdr: bytes) -> None:
        self._open.append(cdr)
        if len(self._open) == _BLOCK:
            self._blocks.append(zlib.compress(pickle.dumps(self._open), level=1))
            self._open.clear()

    def __iter__(self) -> Iterator[RsuMeasurement]:
        for block in self._blocks:
            yield from map(self.decode, pickle.loads(zlib.decompress(block)))
        yield from map(self.decode, self._open)


@dataclass(slots=True)
class Recording:
    """What matters here of the messages of a bag, by device; what a network says by
    "network/device". Of a million messages the values would not fit into memory."""

    measured: dict[str, _Measured]
    truth: dict[str, Poses] = field(default_factory=lambda: defaultdict(Poses))
    estimate: dict[str, Poses] = field(default_factory=lambda: defaultdict(Poses))
    status: dict[str, _Statuses] = field(default_factory=lambda: defaultdict(_Statuses))
    clock: dict[str, Clock] = field(default_factory=lambda: defaultdict(Clock))
    clock_truth: dict[str, Clock] = field(default_factory=lambda: defaultdict(Clock))
    rsus: dict[str, RsuInfo] = field(default_factory=dict)
    poses: dict[str, list[InitialPose]] = field(default_factory=lambda: defaultdict(list))
    errors: dict[str, list[RsuErrors]] = field(default_factory=lambda: defaultdict(list))
    delivery: dict[str, _DeliveryCounter] = field(
        default_factory=lambda: defaultdict(_DeliveryCounter)
    )

    def forget(self, vue: str) -> None:
        """Free the memory."""
        for kept in (self.measured, self.truth, self.estimate, self.delivery, self.clock_truth):
            kept.pop(vue, None)

    def run(self, vue: str, network: str = "") -> Run:
        by = _key(vue, network)
        return Run(
            truth=self.truth[vue].trajectory(),
            estimate=self.estimate[by].trajectory(),
            statuses=self.status[by].kept,
            measured_ns=self.delivery[vue].stamps_ns,
            clock=self.clock[by].offsets(),
            clock_truth=self.clock_truth[vue].offsets(),
        )


def _networks(bag: BagReader, vues: list[str]) -> list[tuple[str, str]]:
    """Networks with estimates of their own and the devices of ``vues`` they are of, sorted."""
    filled = sorted(topics.split_network(t) for t, info in bag.topics.items() if info.count)
    return [(net, vue) for net, vue, name in filled if name == topics.ODOMETRY and vue in vues]


def _into(convert: Callable[[Any], Any], add: Callable[[Any], None]) -> Callable[[BagEntry], None]:
    return lambda entry: add(convert(entry.message))


def _output_sinks(recording: Recording, vue: str, network: str) -> dict[str, _Sink]:
    """Collects the outputs of a tracker for one device."""
    convert, by = codec(), _key(vue, network)
    of_vue: dict[str, _Sink] = {
        topics.ODOMETRY: (
            _ODOMETRY,
            _into(convert.odometry_from_msg, recording.estimate[by].append),
        ),
        topics.CLOCK_STATE: (
            _CLOCK,
            _into(convert.clock_state_from_msg, recording.clock[by].append),
        ),
        topics.TRACK_STATUS: (
            "netpos_msgs/msg/TrackStatus",
            _into(convert.track_status_from_msg, recording.status[by].append),
        ),
    }
    return {topics.of_vue(vue, name, network): sink for name, sink in of_vue.items()}


def _common_sinks(recording: Recording) -> dict[str, _Sink]:
    """Collects the topics of the RSUs."""
    convert = codec()

    def add_rsu(info: RsuInfo) -> None:
        recording.rsus[info.rsu_id] = info

    def add_measurement(entry: BagEntry) -> None:
        measurement = convert.measurement_from_msg(entry.message)
        recording.delivery[measurement.vue_id].add(measurement)
        recording.measured[measurement.vue_id].append(entry.cdr)

    def add_errors(errors: RsuErrors) -> None:
        recording.errors[errors.vue_id].append(errors)

    return {
        topics.RSU_INFO: (
            "netpos_msgs/msg/RsuInfo",
            _into(convert.rsu_info_from_msg, add_rsu),
        ),
        topics.RSU_MEASUREMENTS: ("netpos_msgs/msg/RsuMeasurement", add_measurement),
        topics.RSU_LEARNED: (
            "netpos_msgs/msg/RsuErrors",
            _into(convert.rsu_errors_from_msg, add_errors),
        ),
    }


def _sinks(
    recording: Recording, vues: list[str], networks: list[tuple[str, str]]
) -> dict[str, _Sink]:
    """Type of each topic, and the function that collects its messages."""
    convert, sinks = codec(), _common_sinks(recording)
    for vue in vues:
        of_vue: dict[str, _Sink] = {
            topics.GROUND_TRUTH: (
                _ODOMETRY,
                _into(convert.odometry_from_msg, recording.truth[vue].append),
            ),
            topics.GROUND_TRUTH_CLOCK: (
                _CLOCK,
                _into(convert.clock_state_from_msg, recording.clock_truth[vue].append),
            ),
            topics.INITIAL_POSE: (
                "geometry_msgs/msg/PoseWithCovarianceStamped",
                _into(
                    partial(convert.initial_pose_from_msg, vue_id=vue),
                    recording.poses[vue].append,
                ),
            ),
        }
        sinks |= {topics.of_vue(vue, name): sink for name, sink in of_vue.items()}
    for network, vue in [*(("", vue) for vue in vues), *networks]:
        sinks |= _output_sinks(recording, vue, network)
    return sinks


def _read(
    bag: BagReader, vues: list[str], networks: list[tuple[str, str]], progress: Progress | None
) -> Recording:
    def decode(cdr: bytes) -> RsuMeasurement:
        return codec().measurement_from_msg(bag.decode(topics.RSU_MEASUREMENTS, cdr))

    recording = Recording(measured=defaultdict(partial(_Measured, decode)))
    sinks = _sinks(recording, vues, networks)
    wanted = sinks.keys() & bag.topics.keys()
    for topic in sorted(wanted):
        expected, actual = sinks[topic][0], bag.topics[topic].type_name
        if actual != expected:
            raise ValueError(f"{bag.path}: {topic} must hold {expected}, it holds {actual}")
    for done, entry in enumerate(bag.messages(wanted)):
        try:
            sinks[entry.topic][1](entry)
        except BagError:
            raise
        except ValueError as error:
            raise BagError(
                f"{bag.path}: {entry.topic}, message of {entry.log_time_ns} ns: {error}"
            ) from error
        if progress is not None:
            progress(done)
    return recording


def config_of(bag: BagReader) -> TrackerConfig | None:
    """Parameters of the tracker, None where the bag does not say."""
    try:
        return TrackerConfig.from_mapping(bag_settings(bag).parameters)
    except ValueError:
        return None


def notes_of(bag: BagReader) -> tuple[str, ...]:
    """Notes of a bag: messages that are missing, and changes of its data on import."""
    facts = bag.facts
    skipped = [f"skipped on import: {text}" for text in facts.get(SKIPPED, ())]
    return (*lost_of(bag), *facts.get(TRUTH_ALIGNMENT, ()), *skipped)


def lost_of(bag: BagReader) -> list[str]:
    """Messages that recorders missed, as a sentence; empty where nothing was lost."""
    lost = lost_in(bag.facts)
    losses = ", ".join(f"{n} of {topic}" for topic, n in sorted(lost.items()))
    return [f"LOST while recording: {losses}"] if losses else []


def lost_in(facts: Mapping[str, tuple[str, ...]]) -> dict[str, int]:
    """Messages that recorders missed, by topic."""
    losses: Counter[str] = Counter()
    for text in facts.get(LOST_METADATA, ()):
        losses.update(load_yaml(text) or {})
    return dict(losses)


@dataclass(frozen=True, slots=True, kw_only=True)
class Contents:
    """What a bag holds of the devices ``names``."""

    names: list[str]
    networks: list[tuple[str, str]]
    recording: Recording
    rsus: tuple[RsuInfo, ...]
    topics: Mapping[str, tuple[str, int]]
    buildings: Array
    config: TrackerConfig | None
    notes: tuple[str, ...]
    facts: Mapping[str, tuple[str, ...]]


def contents_of(
    path: Path, choose: Callable[[BagReader], list[str]], progress: Progress | None
) -> Contents:
    """Read a bag once, of the devices that ``choose`` names."""
    with BagReader(path) as bag:
        names = choose(bag)
        networks = _networks(bag, names)
        recording = _read(bag, names, networks, progress)
        return Contents(
            names=names,
            networks=networks,
            recording=recording,
            rsus=tuple(recording.rsus[name] for name in sorted(recording.rsus)),
            topics={topic: (info.type_name, info.count) for topic, info in bag.topics.items()},
            buildings=buildings_of(bag),
            config=config_of(bag),
            notes=notes_of(bag),
            facts=bag.facts,
        )
