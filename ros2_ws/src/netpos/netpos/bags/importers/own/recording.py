"""A text file or a ROS bag becomes a bag of netpos, without code."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from netpos.bags.errors import BagError
from netpos.bags.importers.own.alignment import Way, align, plain_track
from netpos.bags.importers.own.columns import Columns
from netpos.bags.importers.own.records import Message, Record, Skipped, lines, messages
from netpos.bags.importers.own.truth import Pose, Poses, TruthColumns, local, poses_of
from netpos.bags.recording import SKIPPED, TRUTH_ALIGNMENT, write_values
from netpos.messages.values import Odometry, RsuInfo, RsuMeasurement

CUT = "cut first or last lines"
# Nothing but what a data sheet says is declared: the rest is learned.
TRACKER = {"learn_errors": True}


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """Where the truth is and how it is brought to the measurements.

    source : a text file, or the topic of the bag
    columns : where a pose stands; None: as in an Odometry, a pose or a NavSatFix, of a topic only
    offset_s : added to its times; None: found
    """

    source: Path | str
    columns: TruthColumns | None
    offset_s: float | None = 0.0
    align: Way = "none"
    height_m: float = 0.0
    """Of the device; the plain track that the truth is aligned with needs it."""
    origin: tuple[float, float, float] | None = None
    """Latitude, longitude [deg] and height [m] of the origin of ``map``, for a truth on earth."""

    def of_topic(self, records: Iterator[Message], skipped: Skipped) -> Poses:
        """The poses of messages."""
        if self.columns is not None:
            return self.placed(self.columns, map(self.columns.pose, records), skipped)
        first = next(records, None)
        if first is None:
            raise BagError(f"{self.source} has no messages")
        columns = TruthColumns.of_kind(first)
        return self.placed(columns, map(columns.pose, itertools.chain([first], records)), skipped)

    def placed(
        self, columns: TruthColumns, found: Iterable[Pose | None], skipped: Skipped
    ) -> Poses:
        """Poses as they were read, in ``map`` as far as that is known."""
        if columns.on_earth and self.origin is None and self.align == "none":
            raise BagError(
                f"{self.source} has latitudes: say with --truth-origin LATITUDE,LONGITUDE,HEIGHT "
                "where the origin of map is, or move it there with --truth-align shift or rigid"
            )
        poses = replace(poses_of(found, skipped), has_height=columns.has_height)
        return local(poses, self.origin) if columns.on_earth else poses


def import_csv(
    file: Path,
    bag: Path,
    columns: Columns,
    rsus: Sequence[RsuInfo],
    *,
    truth: Truth | None = None,
    delimiter: str | None = None,
    skip_bad_lines: bool = False,
    any_order: bool = False,
    tracker: Mapping[str, object] | None = None,
) -> dict[str, int]:
    """Write the measurements of a text file as a bag.

    Parameters
    ----------
    delimiter : found in the first line where it is None
    skip_bad_lines : skip and count lines that cannot be understood; a cut first or last line
        always is
    any_order : the lines of an RSU need not be in the order of time
    tracker : parameters of the tracker, kept in the bag beside ``learn_errors``

    Returns
    -------
    messages per topic, and what was skipped

    Raises
    ------
    BagError  a line that cannot be understood, an RSU without a position, no measurement
    FileExistsError  ``bag`` exists
    """
    skipped = Skipped()
    order = _Order(any_order)
    found: list[RsuMeasurement] = []

    def read(record: Record) -> None:
        for measurement in columns.measurements(record, skipped):
            order.check(record, measurement)
            found.append(measurement)

    reading = _Reading(delimiter, skip_bad_lines, skipped)
    reading.lines(Path(file), list(columns.sources.values()), read)
    poses = None if truth is None else reading.truth(truth)
    return _write(
        bag, f"csv {Path(file).name}", rsus, found, _aligned(truth, poses), skipped, tracker
    )


def import_ros(
    source: Path,
    bag: Path,
    columns: Columns,
    topic: str,
    rsus: Sequence[RsuInfo],
    *,
    truth: Truth | None = None,
    skip_bad_messages: bool = False,
    any_order: bool = False,
    tracker: Mapping[str, object] | None = None,
) -> dict[str, int]:
    """Write the measurements of a topic of a ROS 1 or ROS 2 bag as a bag.

    RSUs whose position is in the messages (``rsu_x``, ``rsu_y``, ``rsu_z``) need not be given.

    Returns
    -------
    messages per topic, and what was skipped

    Raises
    ------
    BagError  a message that cannot be understood, an RSU without a position, no measurement
    FileExistsError  ``bag`` exists
    """
    skipped = Skipped()
    order = _Order(any_order)
    found: list[RsuMeasurement] = []
    known = {info.rsu_id: info for info in rsus}
    for message in messages(Path(source), topic):
        try:
            place = columns.rsu_position(message)
            measured = columns.measurements(message, skipped)
            for measurement in measured:
                order.check(message, measurement)
        except BagError:
            if not skip_bad_messages:
                raise
            skipped["messages that cannot be understood"] += 1
            continue
        if place is not None:
            _keep_place(known, message, *place)
        found += measured
    poses = None
    if truth is not None:
        poses = truth.of_topic(messages(Path(source), str(truth.source)), skipped)
    name = f"ros {Path(source).name} {topic}"
    return _write(bag, name, list(known.values()), found, _aligned(truth, poses), skipped, tracker)


def _keep_place(
    known: dict[str, RsuInfo], message: Message, rsu_id: str, place: tuple[float, float, float]
) -> None:
    info = known.setdefault(rsu_id, RsuInfo(rsu_id=rsu_id, position=np.array(place)))
    if tuple(info.position) != place:
        raise BagError(
            f"{message.where}: RSU {rsu_id} is at {place}, before at {tuple(info.position)}; an "
            "RSU that moves cannot be imported"
        )


class _Order:
    """Refuses times that run backwards, unless asked for, and an RSU that measures twice at
    once."""

    def __init__(self, any_order: bool) -> None:
        self._any_order = any_order
        self._last: dict[tuple[str, ...], int] = {}
        self._seen: set[tuple[tuple[str, ...], int]] = set()

    def check(self, record: Record, measurement: RsuMeasurement) -> None:
        key = (measurement.vue_id, measurement.rsu_id, measurement.reference_rsu_id)
        stamp_ns = measurement.stamp_ns
        if (key, stamp_ns) in self._seen:
            raise BagError(
                f"{record.where}: RSU {measurement.rsu_id} measures {measurement.vue_id} a second "
                "time at this stamp"
            )
        back_ns = self._last.get(key, stamp_ns) - stamp_ns
        if back_ns > 0 and not self._any_order:
            raise BagError(
                f"{record.where}: RSU {measurement.rsu_id} is heard {back_ns / 1e9:g} s before "
                "its measurement above; a clock that restarts needs two recordings, a file that "
                "is not in order needs --any-order"
            )
        self._last[key] = stamp_ns
        self._seen.add((key, stamp_ns))


@dataclass(frozen=True, slots=True)
class _Reading:
    delimiter: str | None
    skip_bad_lines: bool
    skipped: Skipped

    def lines(self, file: Path, sources: Sequence[str], read: Callable[[Record], None]) -> None:
        for line, edge in lines(file, sources, self.delimiter):
            try:
                read(line)
            except BagError as error:
                if not (edge or self.skip_bad_lines):
                    raise BagError(f"{error}; repair it or give --skip-bad-lines") from None
                self.skipped[CUT if edge else "lines that cannot be understood"] += 1

    def truth(self, truth: Truth) -> Poses:
        columns = truth.columns
        assert columns is not None, "a text file has no kind"
        found: list[Pose | None] = []
        self.lines(
            Path(truth.source),
            list(columns.sources.values()),
            lambda line: found.append(columns.pose(line)),
        )
        return truth.placed(columns, found, self.skipped)


def truth_of(
    truth: Truth,
    infos: Sequence[RsuInfo],
    measurements: Sequence[RsuMeasurement],
    *,
    within: Path | None = None,
) -> tuple[Poses, str]:
    """The truth of a text file, or of a topic of the bag ``within``, brought to the measurements
    as asked for; and a sentence about that, empty where nothing was done.

    Raises
    ------
    BagError  a truth that cannot be read, or not be aligned
    """
    skipped = Skipped()
    if within is None:
        poses = _Reading(None, False, skipped).truth(truth)
    else:
        poses = truth.of_topic(messages(within, str(truth.source)), skipped)
    found, sentence = _aligned(truth, poses)(infos, measurements)
    return found or poses, sentence


Aligned = Callable[[Sequence[RsuInfo], Sequence[RsuMeasurement]], tuple[Poses | None, str]]


def _aligned(truth: Truth | None, poses: Poses | None) -> Aligned:
    """What brings the truth to the measurements and says so."""

    def apply(
        infos: Sequence[RsuInfo], measurements: Sequence[RsuMeasurement]
    ) -> tuple[Poses | None, str]:
        if truth is None or poses is None:
            return None, ""
        if truth.align == "none" and truth.offset_s is not None:
            return poses.shifted(round(truth.offset_s * 1e9)), ""
        times_s, track = plain_track(infos, measurements, truth.height_m)
        found = align(poses, times_s, track, truth.align, truth.offset_s)
        moved = poses.shifted(round(found.offset_s * 1e9)).turned(found.angle_rad, found.shift)
        return moved, found.sentence()

    return apply


def _write(
    bag: Path,
    source: str,
    rsus: Sequence[RsuInfo],
    measurements: Sequence[RsuMeasurement],
    aligned: Aligned,
    skipped: Skipped,
    tracker: Mapping[str, object] | None,
) -> dict[str, int]:
    heard = {m.rsu_id for m in measurements}
    used = [info for info in rsus if info.rsu_id in heard]
    poses, sentence = aligned(used, measurements) if measurements else (None, "")
    metadata = {"source": source}
    if sentence:
        metadata[TRUTH_ALIGNMENT] = sentence
    if skipped:
        metadata[SKIPPED] = ", ".join(f"{what} {n}" for what, n in sorted(skipped.items()))
    counts = write_values(
        bag,
        rsus=rsus,
        measurements=measurements,
        truth=_of_devices(poses, measurements),
        tracker={**TRACKER, **(tracker or {})},
        metadata=metadata,
    )
    return {**counts, **skipped}


def _of_devices(poses: Poses | None, measurements: Sequence[RsuMeasurement]) -> list[Odometry]:
    if poses is None:
        return []
    vues = sorted({m.vue_id for m in measurements})
    if len(vues) != 1:
        raise BagError(f"the truth is that of one device, but there are {', '.join(vues)}")
    return poses.odometry(vues[0])
