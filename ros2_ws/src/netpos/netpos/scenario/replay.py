"""Re-estimation of a bag without ROS: the same core, the same order, the same bytes as the live
node."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from netpos.bags import (
    BagEntry,
    BagError,
    BagReader,
    BagWriter,
    TopicInfo,
    cdr_codec,
    codec,
    has_common_definition,
    whole_bag,
)
from netpos.common.yaml_text import load_yaml
from netpos.messages import topics
from netpos.messages.fields import Frames
from netpos.messages.network_tracks import network_track_to_msg
from netpos.messages.values import ImuSample, Odometry
from netpos.scenario.settings import (
    CHANGE_FACT,
    TrackerSettings,
    bag_settings,
    fusion_fact,
    list_of,
    not_usual,
    tracker_fact,
)
from netpos.tracking.config import TrackerConfig
from netpos.tracking.networks.chain import Chain
from netpos.tracking.networks.config import FusionConfig
from netpos.tracking.ordering.sequencer import Item
from netpos.tracking.report import TrackOutput
from netpos.tracking.tracker import Tracker

_ODOMETRY = "nav_msgs/msg/Odometry"
_FUSION = "fusion."
_LIST = "rsus_file"


@dataclass(frozen=True, slots=True)
class ReplaySummary:
    """Summary of a replay: parameters of the tracker that are not the defaults, epochs written,
    estimates in them, and measurements refused or rejected, by device and reason."""

    parameters: Mapping[str, Any]
    epochs: int
    estimates: int
    rejected: Mapping[str, Mapping[str, int]]
    refused_rsus: Mapping[str, str] = field(default_factory=dict)
    """RSUs whose description was refused, and why."""


def replay_bag(
    bag_in: Path | str,
    bag_out: Path | str,
    overrides: Mapping[str, Any] | None = None,
    progress: Callable[[int], None] | None = None,
    *,
    smooth: bool = False,
    settings: TrackerSettings | None = None,
) -> ReplaySummary:
    """Run a bag's measurements through the tracker and write a bag with all input and the new
    output.

    Parameters are ``settings``, by default those the bag holds, then ``overrides``. ``progress``
    is called with the number of messages done. ``smooth`` adds the odometry of every epoch given
    all measurements. Raises ``BagError`` for a bag without measurements or parameters,
    ``ValueError`` for a bad parameter, ``FileExistsError`` where ``bag_out`` exists.
    """
    bag_in, bag_out = Path(bag_in), Path(bag_out)
    with BagReader(bag_in) as source:
        settings = changed(settings or bag_settings(source), overrides or {})
        _check_changes(source, overrides or {})
        config = TrackerConfig.from_mapping(settings.parameters)
        if topics.RSU_MEASUREMENTS not in source.topics:
            raise BagError(
                f"{bag_in} has no {topics.RSU_MEASUREMENTS}: record that topic to replay"
            )
        metadata = source.metadata | tracker_fact(config, settings.rsus)
        frames = config.frames
        if settings.networks:
            fusion = FusionConfig.from_mapping(settings.fusion)
            metadata |= fusion_fact(settings.networks, fusion)
            frames = fusion.frames
        tracker = tracker_of(config, settings, smooth=smooth)
        epochs = estimates = 0
        with whole_bag(bag_out, metadata=metadata) as out:
            for name, info in source.topics.items():
                if not topics.is_tracker_output(name):
                    text = info.definition or None  # that of the bag, which may be older than ours
                    out.add_topic(name, info.type_name, info.qos, text=text)
            for done, batch in enumerate(_through(tracker, source, out)):
                epochs += len(batch)
                estimates += sum(output.odometry is not None for output in batch)
                for output in batch:
                    write_output(out, output, config.frames if output.network else frames)
                if progress is not None:
                    progress(done)
            for vue_id, odometry in tracker.smoothed().items() if smooth else ():
                _write_smoothed(out, vue_id, odometry, config.frames)
        rejected = {vue: dict(counts) for vue, counts in tracker.rejected().items()}
        refused = tracker.refused_rsus()
        return ReplaySummary(not_usual(config), epochs, estimates, rejected, refused)


def _check_changes(source: BagReader, overrides: Mapping[str, Any]) -> None:
    """Nobody knows between which measurements a parameter changed while a bag was recorded: what
    holds for all of it is to be said."""
    names: set[str] = set()
    for text in source.facts.get(CHANGE_FACT, ()):
        names |= (load_yaml(text) or {}).keys() - {"stamp_ns"}
    unsaid = sorted(names - overrides.keys())
    if unsaid:
        raise BagError(
            f"{source.path}: {', '.join(unsaid)} changed while it was recorded; say what holds"
            f" for all of it, such as --set {unsaid[0]}=VALUE"
        )


def changed(settings: TrackerSettings, overrides: Mapping[str, Any]) -> TrackerSettings:
    """Settings with other values; names of parameters of the fusion begin with ``fusion.``, and
    ``rsus_file`` is a file with the network's list of RSUs."""
    fusion = {n.removeprefix(_FUSION): v for n, v in overrides.items() if n.startswith(_FUSION)}
    if fusion and not settings.networks:
        raise ValueError(f"the bag has one network, so there is no {_FUSION}{min(fusion)} to set")
    rest = {name: v for name, v in overrides.items() if not name.startswith(_FUSION)}
    file = rest.pop(_LIST, None)
    return replace(
        settings,
        rsus=settings.rsus
        if file is None
        else list_of(str(file), str(rest.get("datum", settings.parameters.get("datum", "")))),
        parameters={**settings.parameters, **rest},
        fusion={**settings.fusion, **fusion},
    )


def tracker_of(
    config: TrackerConfig, settings: TrackerSettings, *, smooth: bool = False
) -> Tracker | Chain:
    """One tracker, or one for each of several networks with the fusion of their tracks."""
    if not settings.networks:
        return Tracker(config, settings.rsu_list, keep_posteriors=smooth)
    if smooth:
        raise ValueError("the tracks of several networks are not smoothed; leave --smooth out")
    fusion = FusionConfig.from_mapping(settings.fusion)
    return Chain(settings.networks, config, fusion, settings.rsu_list)


def _through(
    tracker: Tracker | Chain, source: BagReader, out: BagWriter
) -> Iterator[list[TrackOutput]]:
    """Feed every message to the tracker and copy it, unless a tracker wrote it."""
    for entry in source.messages([topics.RSU_INFO]):
        with suppress(ValueError):  # refused: the tracker names it
            tracker.add_rsu(codec().rsu_info_from_msg(entry.message))
    read = {name: reading_of(name, info, tracker.config) for name, info in source.topics.items()}
    for entry in source.messages([t for t in source.topics if not topics.is_tracker_output(t)]):
        out.write_raw(entry.topic, entry.type_name, entry.cdr, entry.log_time_ns)
        item_of = read[entry.topic]
        if item_of is not None:
            tracker.add(item_of(entry))
            yield tracker.process()
    yield tracker.flush()


def reading_of(
    topic: str, info: TopicInfo, config: TrackerConfig
) -> Callable[[BagEntry], Item | ImuSample] | None:
    """Function that turns entries of a topic into tracker input; None for other topics."""
    make, fast = codec(), cdr_codec()
    if topic == topics.RSU_MEASUREMENTS:
        return _short_cut(info, fast.measurement, make.measurement_from_msg)
    vue_id, name = topics.split(topic)
    match name:
        case topics.STEP_VELOCITY:
            return lambda entry: make.velocity_from_msg(entry.message, vue_id)
        case topics.GROUND_SPEED:
            return lambda entry: make.ground_speed_from_msg(entry.message, vue_id)
        case topics.INITIAL_POSE:
            return lambda entry: make.initial_pose_from_msg(entry.message, vue_id)
        case topics.IMU if config.use_imu:
            return _short_cut(
                info,
                lambda cdr: fast.imu(cdr, vue_id),
                lambda msg: make.imu_from_msg(msg, vue_id),
            )
    return None


def _short_cut(
    info: TopicInfo, fast: Callable[[bytes], Any], from_msg: Callable[[Any], Any]
) -> Callable[[BagEntry], Any]:
    """Read the bytes directly if their encoding is the usual one and the definition is ours."""
    if not has_common_definition(info.type_name, info.definition):
        return lambda entry: from_msg(entry.message)

    def read(entry: BagEntry) -> Any:
        value = fast(entry.cdr)
        return from_msg(entry.message) if value is None else value

    return read


def _write_smoothed(
    out: BagWriter, vue_id: str, odometry: Iterable[Odometry], frames: Frames
) -> None:
    topic = topics.of_vue(vue_id, topics.ODOMETRY_SMOOTHED)
    for value in odometry:
        out.write_raw(topic, _ODOMETRY, cdr_codec(frames).odometry(value), value.stamp_ns)


def write_output(out: BagWriter, output: TrackOutput, frames: Frames | None = None) -> None:
    """Write what the live node would publish, logged at its stamp; nothing of a device that has
    sent no stamp yet."""
    make = cdr_codec(frames)
    status = output.status
    if not status.stamp_ns:
        return
    stamp, vue_id, network = status.stamp_ns, status.vue_id, output.network

    def write(topic: str, type_name: str, cdr: bytes) -> None:
        out.write_raw(topic, type_name, cdr, stamp)

    if output.odometry is not None:
        topic = topics.of_vue(vue_id, topics.ODOMETRY, network)
        write(topic, _ODOMETRY, make.odometry(output.odometry))
        if not output.revised and not network and not (frames and frames.odom):
            write(topics.TF, "tf2_msgs/msg/TFMessage", make.transform(output.odometry))
    if output.clock is not None:
        topic = topics.of_vue(vue_id, topics.CLOCK_STATE, network)
        write(topic, "netpos_msgs/msg/ClockState", make.clock_state(output.clock))
    topic = topics.of_vue(vue_id, topics.TRACK_STATUS, network)
    write(topic, "netpos_msgs/msg/TrackStatus", make.track_status(status))
    for errors in output.errors:
        out.write(topics.RSU_LEARNED, codec().rsu_errors_to_msg(errors), stamp)
    for odometry in output.smoothed:
        topic = topics.of_vue(vue_id, topics.ODOMETRY_SMOOTHED, network)
        write(topic, _ODOMETRY, make.odometry(odometry))
    if output.track is not None:
        message = network_track_to_msg(codec(), output.track)
        out.write(topics.tracks_of(network), message, stamp)
