"""Re-estimation of a bag without ROS: the same core, the same order, the same bytes as the live
node."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import yaml

from netpos.bags import BagError, BagReader, BagWriter, codec
from netpos.messages import topics
from netpos.tracking.config import TrackerConfig
from netpos.tracking.sequencer import Item
from netpos.tracking.settings import TRACKER_METADATA, bag_settings
from netpos.tracking.track import TrackOutput
from netpos.tracking.tracker import Tracker


@dataclass(frozen=True, slots=True)
class ReplaySummary:
    """What a replay did: epochs written and measurements refused or rejected, by device and
    reason."""

    epochs: int
    rejected: Mapping[str, Mapping[str, int]]


def replay_bag(
    bag_in: Path,
    bag_out: Path,
    overrides: Mapping[str, Any] | None = None,
    progress: Callable[[int], None] | None = None,
) -> ReplaySummary:
    """Run a bag's measurements through the tracker and write a bag with all input and the new
    output.

    Parameters come from the bag's own metadata, then ``overrides``. ``progress`` is called with
    the
    number of messages done. Raises ``BagError`` for a bag without measurements, ``ValueError`` for
    a
    bad parameter, ``FileExistsError`` where ``bag_out`` exists.
    """
    with BagReader(bag_in) as source:
        parameters = {**bag_settings(source.metadata).parameters, **(overrides or {})}
        config = TrackerConfig.from_mapping(parameters)
        if topics.RSU_MEASUREMENTS not in source.topics:
            raise BagError(
                f"{bag_in} has no {topics.RSU_MEASUREMENTS}: record that topic to replay"
            )
        metadata = {**source.metadata, TRACKER_METADATA: yaml.safe_dump(asdict(config))}
        tracker = Tracker(config)
        epochs = 0
        with BagWriter(bag_out, metadata=metadata) as out:
            for name, info in source.topics.items():
                if not topics.is_tracker_output(name):
                    out.add_topic(name, info.type_name, info.qos)
            for done, batch in enumerate(_through(tracker, source, out)):
                epochs += len(batch)
                for output in batch:
                    write_output(out, output)
                if progress is not None:
                    progress(done)
        return ReplaySummary(epochs, {v: dict(c) for v, c in tracker.rejected().items()})


def _through(tracker: Tracker, source: BagReader, out: BagWriter) -> Iterator[list[TrackOutput]]:
    """Feed every message to the tracker and copy it, unless a tracker wrote it."""
    for entry in source.messages([topics.RSU_INFO]):
        tracker.add_rsu(codec().rsu_info_from_msg(entry.message))
    for entry in source.messages():
        if topics.is_tracker_output(entry.topic):
            continue
        out.write_raw(entry.topic, entry.type_name, entry.cdr, entry.log_time_ns)
        item = item_of(entry.topic, entry)
        if item is not None:
            tracker.add(item)
            yield tracker.process()
    yield tracker.flush()


def item_of(topic: str, entry: Any) -> Item | None:
    """Tracker input of a bag entry (``entry.message`` is decoded only for input), else None."""
    if topic == topics.RSU_MEASUREMENTS:
        return codec().measurement_from_msg(entry.message)
    vue_id, name = topics.split(topic)
    match name:
        case topics.STEP_VELOCITY:
            return codec().velocity_from_msg(entry.message, vue_id)
        case topics.GROUND_SPEED:
            return codec().ground_speed_from_msg(entry.message, vue_id)
        case topics.INITIAL_POSE:
            return codec().initial_pose_from_msg(entry.message, vue_id)
    return None


def write_output(out: BagWriter, output: TrackOutput) -> None:
    """Write what the live node would publish, logged at its stamp."""
    make = codec()
    status = output.status
    stamp, vue_id = status.stamp_ns, status.vue_id
    if output.odometry is not None:
        message = make.odometry_to_msg(output.odometry)
        out.write(topics.of_vue(vue_id, topics.ODOMETRY), message, stamp)
        out.write(topics.TF, make.transform_to_msg(output.odometry), stamp)
    if output.clock is not None:
        message = make.clock_state_to_msg(output.clock)
        out.write(topics.of_vue(vue_id, topics.CLOCK_STATE), message, stamp)
    message = make.track_status_to_msg(status)
    out.write(topics.of_vue(vue_id, topics.TRACK_STATUS), message, stamp)
