"""Score a recording: every device that has ground truth, in one pass over the bag."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from netpos.bags import LOST_METADATA, BagReader, codec
from netpos.bags.recording import SKIPPED, TRUTH_ALIGNMENT
from netpos.bags.single_file import load_yaml
from netpos.evaluation.metrics import SKIP_EPOCHS, Figures, Run, Scored, score
from netpos.evaluation.pairing import Trajectory
from netpos.evaluation.recorded_bound import recorded_bound_m
from netpos.evaluation.requirements import Verdict, judge
from netpos.evaluation.scene import buildings_of
from netpos.evaluation.survey import Survey, VueRecord, survey_vue
from netpos.messages import topics
from netpos.messages.values import (
    Array,
    ClockState,
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
_Sink = tuple[str, Callable[[Any], Any], Callable[[Any], None]]


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


@dataclass(slots=True)
class _DeliveryCounter:
    received: int = 0
    out_of_order: int = 0
    newest_ns: int = -1
    expected: dict[tuple[int, int], int] = field(default_factory=dict)
    seen: set[tuple[int, int, str]] = field(default_factory=set)

    def add(self, measurement: RsuMeasurement) -> None:
        epoch = (measurement.stamp_ns, measurement.sequence)
        self.received += 1
        self.out_of_order += measurement.stamp_ns < self.newest_ns
        self.newest_ns = max(self.newest_ns, measurement.stamp_ns)
        self.expected[epoch] = max(self.expected.get(epoch, 0), measurement.expected)
        self.seen.add((*epoch, measurement.rsu_id))

    def result(self, beacons: int | None) -> Delivery:
        announced = self.received > 0 and all(self.expected.values())
        expected = sum(self.expected.values()) if announced else None
        return Delivery(
            beacons=beacons,
            epochs=len(self.expected),
            received=self.received,
            duplicates=self.received - len(self.seen),
            out_of_order=self.out_of_order,
            expected=expected,
            missing=None if expected is None else expected - len(self.seen),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class VueEvaluation:
    """One device: its run, the scored pairs with their figures, the verdicts and what was
    delivered.
    """

    run: Run
    scored: Scored
    verdicts: tuple[Verdict, ...]
    delivery: Delivery


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluation:
    """Result of ``evaluate_bag``. ``networks``: of several networks, how each alone did, by
    network and device, under the devices' true names only. ``topics``: type and number of
    messages; ``notes``: what the importer did to the data, to be read before the figures;
    ``buildings``: (k, 4) rectangles x_min, y_min, x_max, y_max [m], none where the bag
    does not hold its scenario."""

    path: Path
    skip: int
    vues: Mapping[str, VueEvaluation]
    networks: Mapping[str, Mapping[str, Scored]]
    rsus: tuple[RsuInfo, ...]
    buildings: Array
    topics: Mapping[str, tuple[str, int]]
    notes: tuple[str, ...] = ()

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
class _Recording:
    """The messages of a bag that matter here, as values, in recorded order, by device; what a
    network says by "network/device"."""

    truth: dict[str, list[Odometry]] = field(default_factory=lambda: defaultdict(list))
    estimate: dict[str, list[Odometry]] = field(default_factory=lambda: defaultdict(list))
    status: dict[str, list[TrackStatus]] = field(default_factory=lambda: defaultdict(list))
    clock: dict[str, list[ClockState]] = field(default_factory=lambda: defaultdict(list))
    clock_truth: dict[str, list[ClockState]] = field(default_factory=lambda: defaultdict(list))
    rsus: dict[str, RsuInfo] = field(default_factory=dict)
    measured: dict[str, list[RsuMeasurement]] = field(default_factory=lambda: defaultdict(list))
    poses: dict[str, list[InitialPose]] = field(default_factory=lambda: defaultdict(list))
    errors: dict[str, list[RsuErrors]] = field(default_factory=lambda: defaultdict(list))
    delivery: dict[str, _DeliveryCounter] = field(
        default_factory=lambda: defaultdict(_DeliveryCounter)
    )

    def run(self, vue: str, network: str = "") -> Run:
        by = _key(vue, network)
        return Run(
            truth=Trajectory.of(self.truth[vue]),
            estimate=Trajectory.of(self.estimate[by]),
            statuses=self.status[by],
            clock=self.clock[by],
            clock_truth=self.clock_truth[vue],
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


def _output_sinks(recording: _Recording, vue: str, network: str) -> dict[str, _Sink]:
    """What becomes of what a tracker says of a device."""
    convert, by = codec(), _key(vue, network)
    of_vue: dict[str, _Sink] = {
        topics.ODOMETRY: (_ODOMETRY, convert.odometry_from_msg, recording.estimate[by].append),
        topics.CLOCK_STATE: (_CLOCK, convert.clock_state_from_msg, recording.clock[by].append),
        topics.TRACK_STATUS: (
            "netpos_msgs/msg/TrackStatus",
            convert.track_status_from_msg,
            recording.status[by].append,
        ),
    }
    return {topics.of_vue(vue, name, network): sink for name, sink in of_vue.items()}


def _sinks(
    recording: _Recording, vues: list[str], networks: list[tuple[str, str]]
) -> dict[str, _Sink]:
    """What becomes of each topic: its type, the conversion to a value and where the value goes."""
    convert = codec()

    def add_rsu(info: RsuInfo) -> None:
        recording.rsus[info.rsu_id] = info

    def add_measurement(measurement: RsuMeasurement) -> None:
        recording.delivery[measurement.vue_id].add(measurement)
        recording.measured[measurement.vue_id].append(measurement)

    sinks: dict[str, _Sink] = {
        topics.RSU_INFO: ("netpos_msgs/msg/RsuInfo", convert.rsu_info_from_msg, add_rsu),
        topics.RSU_MEASUREMENTS: (
            "netpos_msgs/msg/RsuMeasurement",
            convert.measurement_from_msg,
            add_measurement,
        ),
        topics.RSU_LEARNED: (
            "netpos_msgs/msg/RsuErrors",
            convert.rsu_errors_from_msg,
            lambda errors: recording.errors[errors.vue_id].append(errors),
        ),
    }
    for vue in vues:
        truth, clock = recording.truth[vue], recording.clock_truth[vue]
        of_vue: dict[str, _Sink] = {
            topics.GROUND_TRUTH: (_ODOMETRY, convert.odometry_from_msg, truth.append),
            topics.GROUND_TRUTH_CLOCK: (_CLOCK, convert.clock_state_from_msg, clock.append),
            topics.INITIAL_POSE: (
                "geometry_msgs/msg/PoseWithCovarianceStamped",
                partial(convert.initial_pose_from_msg, vue_id=vue),
                recording.poses[vue].append,
            ),
        }
        sinks |= {topics.of_vue(vue, name): sink for name, sink in of_vue.items()}
    for network, vue in [*(("", vue) for vue in vues), *networks]:
        sinks |= _output_sinks(recording, vue, network)
    return sinks


def _read(bag: BagReader, vues: list[str], networks: list[tuple[str, str]]) -> _Recording:
    recording = _Recording()
    sinks = _sinks(recording, vues, networks)
    wanted = sinks.keys() & bag.topics.keys()
    for topic in sorted(wanted):
        expected, found = sinks[topic][0], bag.topics[topic].type_name
        if found != expected:
            raise ValueError(f"{bag.path}: {topic} must hold {expected}, it holds {found}")
    for entry in bag.messages(wanted):
        _, convert, add = sinks[entry.topic]
        add(convert(entry.message))
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
        Trajectory.of(recording.truth[vue]),
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
    """What recorders say they missed, a sentence each; none where nothing was lost."""
    found = [load_yaml(text) or {} for text in bag.facts.get(LOST_METADATA, ())]
    told = [", ".join(f"{n} of {topic}" for topic, n in sorted(lost.items())) for lost in found]
    return [f"LOST while recording: {text}" for text in told if text]


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


def _contents(path: Path, choose: Callable[[BagReader], list[str]]) -> _Contents:
    """Read a bag once, of the devices that ``choose`` names."""
    with BagReader(path) as bag:
        names = choose(bag)
        networks = _networks(bag, names)
        recording = _read(bag, names, networks)
        return _Contents(
            names=names,
            networks=networks,
            recording=recording,
            rsus=tuple(recording.rsus[name] for name in sorted(recording.rsus)),
            topics={topic: (info.type_name, info.count) for topic, info in bag.topics.items()},
            buildings=buildings_of(bag),
            config=config_of(bag),
            notes=notes_of(bag),
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
) -> Evaluation | Survey:
    """``evaluate_bag`` where there is ground truth, else ``survey_bag``; raises what they do."""
    if truth is not None:
        return evaluate_bag(path, skip=skip, vue=vue, truth=truth)
    with BagReader(path) as bag:
        has_truth = any(
            info.count and topics.split(topic)[1] == topics.GROUND_TRUTH
            for topic, info in bag.topics.items()
        )
    return evaluate_bag(path, skip=skip, vue=vue) if has_truth else survey_bag(path, vue=vue)


def survey_bag(path: Path, *, vue: str | None = None) -> Survey:
    """What a bag says of every device that a tracker reported of, or only of ``vue``, without
    ground truth.

    Raises
    ------
    ValueError  not a readable bag, no tracker's output, or no such device
    """
    held = _contents(path, lambda bag: _surveyed(bag, path, vue))
    recording, vues = held.recording, {}
    for name in held.names:
        record = VueRecord(
            odometry=recording.estimate[name],
            statuses=recording.status[name],
            clock=recording.clock[name],
            measurements=recording.measured[name],
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
) -> Evaluation:
    """Score every device of a bag that has ground truth, or only ``vue``; with ``truth`` one
    device against that.

    The first ``skip`` estimates of each device do not count (fokin2020 leaves out 20).

    Raises
    ------
    ValueError  not a readable bag, no ground truth, no estimates, or no such device
    """
    held = _contents(path, lambda bag: (_chosen if truth is None else _alone)(bag, path, vue))
    recording, notes = held.recording, held.notes
    if truth is not None:
        (name,) = held.names
        recording.truth[name], sentence = truth(list(held.rsus), recording.measured[name], name)
        notes = (sentence, *notes)
    networks: dict[str, dict[str, Scored]] = {}
    for network, name in held.networks:
        scored = score(recording.run(name, network), skip=skip)
        networks.setdefault(network, {})[name] = scored
    return Evaluation(
        path=path,
        skip=skip,
        vues={name: _evaluated(held, path, name, skip) for name in held.names},
        networks=networks,
        rsus=held.rsus,
        buildings=held.buildings,
        topics=held.topics,
        notes=notes,
    )


def _evaluated(held: _Contents, path: Path, name: str, skip: int) -> VueEvaluation:
    """One device against its truth."""
    run = held.recording.run(name)
    if not len(run.truth):
        raise ValueError(f"{path}: no message on /{name}/ground_truth has finite values")
    scored = _with_bound(score(run, skip=skip), held.recording, name, held.config)
    _, beacons = held.topics.get(topics.of_vue(name, topics.BEACON), ("", None))
    return VueEvaluation(
        run=run,
        scored=scored,
        verdicts=judge(scored.figures, scored.counted.horizontal_error),
        delivery=held.recording.delivery[name].result(beacons),
    )
