"""Score a recording: every device that has ground truth, in one pass over the bag."""

from __future__ import annotations

import pickle
import zlib
from array import array
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from netpos.bags import LOST_METADATA, BagEntry, BagReader, codec
from netpos.bags.recording import SKIPPED, TRUTH_ALIGNMENT
from netpos.bags.single_file import load_yaml
from netpos.evaluation.metrics import SKIP_EPOCHS, Figures, Run, Scored, score
from netpos.evaluation.pairing import Clock, Poses, at_stamps
from netpos.evaluation.recorded_bound import recorded_bound_m
from netpos.evaluation.requirements import Verdict, judge
from netpos.evaluation.residuals import Series, series_of
from netpos.evaluation.scene import buildings_of
from netpos.evaluation.survey import Survey, VueRecord, survey_vue
from netpos.messages import topics
from netpos.messages.values import (
    Array,
    InitialPose,
    Odometry,
    RsuErrors,
    RsuInfo,
    RsuMeasurement,
    TrackStatus,
)
from netpos.tracking.config import TrackerConfig
from netpos.tracking.settings import bag_settings

_ODOMETRY, _CLOCK = "nav_msgs/msg/Odometry", "netpos_msgs/msg/ClockState"
_Sink = tuple[str, Callable[[BagEntry], None]]
_BLOCK = 1000  # measurements compressed together
Progress = Callable[[int], None]


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
    """Takes measurements as they come, of each four numbers."""

    def __init__(self) -> None:
        self._rows = array("q")
        self._rsus: dict[str, int] = {}

    def add(self, measurement: RsuMeasurement) -> None:
        rsu = self._rsus.setdefault(measurement.rsu_id, len(self._rsus))
        at = (measurement.stamp_ns, measurement.sequence)
        self._rows.extend((*at, rsu, measurement.expected))

    def result(self, beacons: int | None) -> Delivery:
        rows = np.array(self._rows, dtype=np.int64).reshape(-1, 4)
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


@dataclass(frozen=True, slots=True, kw_only=True)
class VueEvaluation:
    """One device: its run, the scored pairs with their figures, the verdicts, what was
    delivered, and, where asked for, what each RSU measured minus what it should have.
    """

    run: Run
    scored: Scored
    verdicts: tuple[Verdict, ...]
    delivery: Delivery
    series: tuple[Series, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluation:
    """Result of ``evaluate_bag``. ``networks``: of several networks, how each alone did, by
    network and device, under the devices' true names only. ``topics``: type and number of
    messages; ``notes``: what the importer did to the data, to be read before the figures;
    ``buildings``: (k, 4) rectangles x_min, y_min, x_max, y_max [m], none where the bag
    does not hold its scenario; ``facts``: what the bag says of how it was made."""

    path: Path
    skip: int
    vues: Mapping[str, VueEvaluation]
    networks: Mapping[str, Mapping[str, Scored]]
    rsus: tuple[RsuInfo, ...]
    buildings: Array
    topics: Mapping[str, tuple[str, int]]
    notes: tuple[str, ...] = ()
    facts: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def columns(self) -> dict[str, Figures]:
        """Figures by the name of their column in a table: devices, then devices by network."""
        own = {name: vue.scored.figures for name, vue in self.vues.items()}
        return own | {
            f"{vue} by {network}": scored.figures
            for network, vues in self.networks.items()
            for vue, scored in vues.items()
        }

    def to_json(self) -> dict[str, Any]:
        """Plain types in the form of ``netpos evaluate --json``."""
        return {
            "bag": self.path.name,
            "skip": self.skip,
            "notes": list(self.notes),
            "vues": {name: vue.scored.figures.to_json() for name, vue in self.vues.items()},
            "networks": {
                network: {name: scored.figures.to_json() for name, scored in vues.items()}
                for network, vues in self.networks.items()
            },
            "requirements": {
                name: {verdict.name: verdict.to_json() for verdict in vue.verdicts}
                for name, vue in self.vues.items()
            },
            "delivery": {name: asdict(vue.delivery) for name, vue in self.vues.items()},
            "topics": {
                topic: {"type": type_name, "messages": count}
                for topic, (type_name, count) in sorted(self.topics.items())
            },
        }


def _key(vue: str, network: str) -> str:
    return f"{network}/{vue}" if network else vue


@dataclass(slots=True)
class _Statuses:
    """Those of a device; what a status has in common with the one before is held once."""

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
class _Recording:
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
        """Make room."""
        for kept in (self.measured, self.truth, self.estimate, self.delivery, self.clock_truth):
            kept.pop(vue, None)

    def run(self, vue: str, network: str = "") -> Run:
        by = _key(vue, network)
        return Run(
            truth=self.truth[vue].trajectory(),
            estimate=self.estimate[by].trajectory(),
            statuses=self.status[by].kept,
            clock=self.clock[by].offsets(),
            clock_truth=self.clock_truth[vue].offsets(),
        )


def _chosen(bag: BagReader, path: Path, vue: str | None) -> list[str]:
    """Devices to score; an error names what the bag lacks."""
    filled = {topics.split(topic) for topic, info in bag.topics.items() if info.count}
    found = {name for name, topic in filled if topic == topics.GROUND_TRUTH}
    if not found:
        raise ValueError(
            f"{path} is a bag without ground truth (no messages on /<vue>/ground_truth); "
            "record that topic to evaluate the run"
        )
    if vue is not None and vue not in found:
        raise ValueError(
            f"{path} has no ground truth of {vue!r}; choose one of {', '.join(sorted(found))}"
        )
    names = sorted(found) if vue is None else [vue]
    if not any((name, topics.ODOMETRY) in filled for name in names):
        raise ValueError(
            f"{path} has no estimates (no messages on /<vue>/odometry); "
            f"make some with: netpos replay {path} --out NEW_BAG"
        )
    return names


def _networks(bag: BagReader, vues: list[str]) -> list[tuple[str, str]]:
    """Networks with estimates of their own and the devices of ``vues`` they are of, sorted."""
    filled = sorted(topics.split_network(t) for t, info in bag.topics.items() if info.count)
    return [(net, vue) for net, vue, name in filled if name == topics.ODOMETRY and vue in vues]


def _into(convert: Callable[[Any], Any], add: Callable[[Any], None]) -> Callable[[BagEntry], None]:
    return lambda entry: add(convert(entry.message))


def _output_sinks(recording: _Recording, vue: str, network: str) -> dict[str, _Sink]:
    """What becomes of what a tracker says of a device."""
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


def _common_sinks(recording: _Recording) -> dict[str, _Sink]:
    """What becomes of the topics of the RSUs."""
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
    recording: _Recording, vues: list[str], networks: list[tuple[str, str]]
) -> dict[str, _Sink]:
    """What becomes of each topic: its type, and what takes its messages."""
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
) -> _Recording:
    def decode(cdr: bytes) -> RsuMeasurement:
        return codec().measurement_from_msg(bag.decode(topics.RSU_MEASUREMENTS, cdr))

    recording = _Recording(measured=defaultdict(partial(_Measured, decode)))
    sinks = _sinks(recording, vues, networks)
    wanted = sinks.keys() & bag.topics.keys()
    for topic in sorted(wanted):
        expected, found = sinks[topic][0], bag.topics[topic].type_name
        if found != expected:
            raise ValueError(f"{bag.path}: {topic} must hold {expected}, it holds {found}")
    for done, entry in enumerate(bag.messages(wanted)):
        sinks[entry.topic][1](entry)
        if progress is not None:
            progress(done)
    return recording


def config_of(bag: BagReader) -> TrackerConfig | None:
    """Parameters of the tracker, None where the bag does not say."""
    try:
        return TrackerConfig.from_mapping(bag_settings(bag).parameters)
    except ValueError:
        return None


def _with_bound(
    scored: Scored, recording: _Recording, vue: str, config: TrackerConfig | None
) -> Scored:
    """The figures with the error over its bound, of a run that starts from one pose or none."""
    poses, rmse = recording.poses[vue], scored.figures.rmse_m
    if config is None or len(poses) > 1 or rmse is None:
        return scored
    bound = recorded_bound_m(
        recording.measured[vue],
        recording.rsus,
        poses[0] if poses else None,
        recording.truth[vue].trajectory(),
        config,
        scored.counted.estimate.stamp_ns,
    )
    if not bound:
        return scored
    return replace(scored, figures=replace(scored.figures, bound_ratio=rmse / bound))


def notes_of(bag: BagReader) -> tuple[str, ...]:
    """What a bag says is missing in it, and what was done to its data on import."""
    facts = bag.facts
    skipped = [f"skipped on import: {text}" for text in facts.get(SKIPPED, ())]
    return (*lost_of(bag), *facts.get(TRUTH_ALIGNMENT, ()), *skipped)


def lost_of(bag: BagReader) -> list[str]:
    """What recorders say they missed, as a sentence; none where nothing was lost."""
    lost = lost_in(bag.facts)
    told = ", ".join(f"{n} of {topic}" for topic, n in sorted(lost.items()))
    return [f"LOST while recording: {told}"] if told else []


def lost_in(facts: Mapping[str, tuple[str, ...]]) -> dict[str, int]:
    """Messages that recorders missed, by topic."""
    found: Counter[str] = Counter()
    for text in facts.get(LOST_METADATA, ()):
        found.update(load_yaml(text) or {})
    return dict(found)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Contents:
    """What a bag holds of the devices ``names``."""

    names: list[str]
    networks: list[tuple[str, str]]
    recording: _Recording
    rsus: tuple[RsuInfo, ...]
    topics: Mapping[str, tuple[str, int]]
    buildings: Array
    config: TrackerConfig | None
    notes: tuple[str, ...]
    facts: Mapping[str, tuple[str, ...]]


def _contents(
    path: Path, choose: Callable[[BagReader], list[str]], progress: Progress | None
) -> _Contents:
    """Read a bag once, of the devices that ``choose`` names."""
    with BagReader(path) as bag:
        names = choose(bag)
        networks = _networks(bag, names)
        recording = _read(bag, names, networks, progress)
        return _Contents(
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


def _surveyed(bag: BagReader, path: Path, vue: str | None) -> list[str]:
    """Devices that a tracker reported of; an error names what the bag lacks."""
    filled = {topics.split(topic) for topic, info in bag.topics.items() if info.count}
    found = {name for name, topic in filled if name and topic in topics.TRACKER_OUTPUTS}
    if not found:
        raise ValueError(
            f"{path} has no estimates (no messages on /<vue>/odometry or track_status); "
            f"make some with: netpos replay {path} --out NEW_BAG"
        )
    if vue is not None and vue not in found:
        raise ValueError(f"{path} has no device {vue!r}; choose one of {', '.join(sorted(found))}")
    return sorted(found) if vue is None else [vue]


def assess_bag(
    path: Path,
    *,
    skip: int = SKIP_EPOCHS,
    vue: str | None = None,
    truth: TruthOf | None = None,
    residuals: bool = False,
    progress: Progress | None = None,
) -> Evaluation | Survey:
    """``evaluate_bag`` where there is ground truth, else ``survey_bag``; raises what they do.
    ``progress`` is called with the number of messages read."""
    if truth is not None:
        return evaluate_bag(
            path, skip=skip, vue=vue, truth=truth, residuals=residuals, progress=progress
        )
    with BagReader(path) as bag:
        has_truth = any(
            info.count and topics.split(topic)[1] == topics.GROUND_TRUTH
            for topic, info in bag.topics.items()
        )
    if has_truth:
        return evaluate_bag(path, skip=skip, vue=vue, residuals=residuals, progress=progress)
    return survey_bag(path, vue=vue, progress=progress)


def survey_bag(path: Path, *, vue: str | None = None, progress: Progress | None = None) -> Survey:
    """What a bag says of every device that a tracker reported of, or only of ``vue``, without
    ground truth.

    Raises
    ------
    ValueError  not a readable bag, no tracker's output, or no such device
    """
    held = _contents(path, lambda bag: _surveyed(bag, path, vue), progress)
    recording, vues = held.recording, {}
    for name in held.names:
        record = VueRecord(
            track=recording.estimate[name].trajectory(),
            statuses=recording.status[name].kept,
            clock=recording.clock[name].offsets(),
            measurements=list(recording.measured[name]),
            errors=recording.errors[name],
        )
        learns = held.config is not None and held.config.learn_errors
        vues[name] = survey_vue(record, recording.rsus, learns)
    return Survey(
        path=path,
        vues=vues,
        rsus=held.rsus,
        buildings=held.buildings,
        topics=held.topics,
        notes=held.notes,
        facts=held.facts,
    )


TruthOf = Callable[[list[RsuInfo], list[RsuMeasurement], str], tuple[list[Odometry], str]]
"""Ground truth from elsewhere: of RSUs, measurements and a device's name, poses and a sentence."""


def _alone(bag: BagReader, path: Path, vue: str | None) -> list[str]:
    """The one device with estimates, for a truth from elsewhere."""
    filled = {topics.split(topic) for topic, info in bag.topics.items() if info.count}
    found = sorted(name for name, topic in filled if name and topic == topics.ODOMETRY)
    if vue is not None and vue in found:
        return [vue]
    if vue is not None or len(found) != 1:
        raise ValueError(
            f"{path} has estimates of {', '.join(found) or 'no device'}; say with --vue of which "
            "one the truth is"
        )
    return found


def evaluate_bag(
    path: Path,
    *,
    skip: int = SKIP_EPOCHS,
    vue: str | None = None,
    truth: TruthOf | None = None,
    residuals: bool = False,
    progress: Progress | None = None,
) -> Evaluation:
    """Score every device of a bag that has ground truth, or only ``vue``; with ``truth`` one
    device against that.

    The first ``skip`` estimates of each device do not count (fokin2020 leaves out 20).
    ``residuals``: with what each RSU measured against the truth. ``progress`` is called with the
    number of messages read.

    Raises
    ------
    ValueError  not a readable bag, no ground truth, no estimates, no such device, or no device has
                more estimates than are skipped
    """
    choose = _chosen if truth is None else _alone
    held = _contents(path, lambda bag: choose(bag, path, vue), progress)
    recording, notes = held.recording, held.notes
    if truth is not None:
        (name,) = held.names
        poses, sentence = truth(list(held.rsus), list(recording.measured[name]), name)
        for pose in poses:
            recording.truth[name].append(pose)
        notes = (sentence, *notes)
    _check_skip(held, path, skip)
    networks: dict[str, dict[str, Scored]] = {}
    for network, name in held.networks:
        scored = score(recording.run(name, network), skip=skip)
        networks.setdefault(network, {})[name] = scored
    vues = {name: _evaluated(held, path, name, skip, residuals=residuals) for name in held.names}
    covered = [text for name, vue in vues.items() for text in _covered(name, vue.scored.figures)]
    return Evaluation(
        path=path,
        skip=skip,
        vues=vues,
        networks=networks,
        rsus=held.rsus,
        buildings=held.buildings,
        topics=held.topics,
        notes=(*notes, *covered),
        facts=held.facts,
    )


def _evaluated(
    held: _Contents, path: Path, name: str, skip: int, *, residuals: bool
) -> VueEvaluation:
    """One device against its truth; what the recording holds of it is not needed after."""
    recording = held.recording
    run = recording.run(name)
    if not len(run.truth):
        raise ValueError(f"{path}: no message on /{name}/ground_truth has finite values")
    scored = _with_bound(score(run, skip=skip), recording, name, held.config)
    series: list[Series] = []
    if residuals:
        clock = run.clock_truth if run.clock_truth.stamp_ns.size else run.clock
        stamps = run.estimate.stamp_ns
        there = at_stamps(run.truth, stamps)
        series = series_of(recording.measured[name], recording.rsus, there, clock.at(stamps))
    _, beacons = held.topics.get(topics.of_vue(name, topics.BEACON), ("", None))
    delivery = recording.delivery[name].result(beacons)
    recording.forget(name)
    return VueEvaluation(
        run=run,
        scored=scored,
        verdicts=judge(scored.figures, scored.counted.horizontal_error),
        delivery=delivery,
        series=tuple(series),
    )


def _check_skip(held: _Contents, path: Path, skip: int) -> None:
    """A prefix that leaves nothing to score is a mistake, not a result."""
    longest = max(len(held.recording.estimate[name]) for name in held.names)
    if 0 < longest <= skip:
        raise ValueError(
            f"{path} has {longest} estimates and the first {skip} are skipped; "
            f"give --skip {min(longest // 2, SKIP_EPOCHS)} to score the others"
        )


def _covered(name: str, figures: Figures) -> list[str]:
    """A sentence where some of the estimates have no ground truth to be scored by."""
    without = figures.outside_truth + figures.in_truth_gap
    if not without:
        return []
    share = 100.0 * without / figures.estimates
    return [
        f"{name}: {without} of {figures.estimates} estimates ({share:.1f} %) are not scored: "
        f"{figures.outside_truth} before or after the ground truth, {figures.in_truth_gap} in gaps"
    ]
