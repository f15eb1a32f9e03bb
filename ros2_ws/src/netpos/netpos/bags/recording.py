"""Values from Python as the messages of a bag, and the messages of a bag as values."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import groupby
from pathlib import Path
from typing import Any

import netpos
from netpos.bags.errors import BagError
from netpos.bags.reader import BagReader
from netpos.bags.types import codec
from netpos.bags.writer import whole_bag
from netpos.common.yaml_text import dump_yaml
from netpos.messages.topics import (
    CLOCK_STATE,
    GROUND_TRUTH,
    IMU,
    ODOMETRY,
    RSU_INFO,
    RSU_MEASUREMENTS,
    TRACK_STATUS,
    of_vue,
    split,
)
from netpos.messages.values import (
    ClockState,
    ImuSample,
    Odometry,
    RsuInfo,
    RsuMeasurement,
    TrackStatus,
)

# Metadata of an import that a reader of the figures must know.
TRUTH_ALIGNMENT = "truth_alignment"
SKIPPED = "skipped"


def write_values(
    path: os.PathLike[str] | str,
    *,
    rsus: Sequence[RsuInfo],
    measurements: Sequence[RsuMeasurement],
    truth: Sequence[Odometry] = (),
    imu: Sequence[ImuSample] = (),
    tracker: Mapping[str, object] | None = None,
    metadata: Mapping[str, str] | None = None,
) -> dict[str, int]:
    """``netpos.write_bag``, which describes the arguments and errors. Returns the number of
    messages by topic."""
    messages = codec()
    _check(rsus, measurements)
    measurements = number_beacons(measurements)
    stamps = [m.stamp_ns for m in measurements] + [t.stamp_ns for t in truth]
    start_ns = min(stamps + [s.stamp_ns for s in imu])
    merged = [(m.stamp_ns, RSU_MEASUREMENTS, messages.measurement_to_msg(m)) for m in measurements]
    merged += [
        (t.stamp_ns, of_vue(t.vue_id, GROUND_TRUTH), messages.odometry_to_msg(t)) for t in truth
    ]
    merged += [(s.stamp_ns, of_vue(s.vue_id, IMU), messages.imu_to_msg(s)) for s in imu]
    merged.sort(key=lambda item: item[0])
    kept = {"netpos_version": netpos.__version__, **(metadata or {})}
    kept["tracker"] = dump_yaml(dict(tracker or {}))
    with whole_bag(Path(path), metadata=kept) as writer:
        for info in rsus:
            message = messages.rsu_info_to_msg(replace(info, stamp_ns=start_ns))
            writer.write(RSU_INFO, message, start_ns)
        for stamp_ns, topic, message in merged:
            writer.write(topic, message, stamp_ns)
        return writer.counts


class RecordedValues(os.PathLike[str]):
    """The values of a bag, in recorded order.

    They are read when one of them is first asked for, all at once: the bag must fit into memory
    (about 1 KB a message). It can be given wherever a path of a bag is taken.
    """

    def __init__(self, path: os.PathLike[str] | str) -> None:
        self.path = Path(path)
        """Folder or file of the bag."""
        with BagReader(self.path) as bag:
            self.facts: Mapping[str, tuple[str, ...]] = bag.facts
            """How the bag was made, by name (``scenario``, ``tracker``, ``lost``); several values
            where copies differ."""
            self._topics = bag.topics
            self._duration_s = (bag.end_ns - bag.start_ns) * 1e-9
        for topic, info in self._topics.items():
            wanted = _TYPES.get(_device_and_name(topic)[1], info.type_name)
            if info.type_name != wanted:
                raise BagError(
                    f"{self.path}: {topic} holds {info.type_name} instead of {wanted}; "
                    "record it under another name"
                )

    def __fspath__(self) -> str:
        return os.fspath(self.path)

    def __repr__(self) -> str:
        counts = {topic: info.count for topic, info in self._topics.items() if info.count}
        measured = counts.get(RSU_MEASUREMENTS, 0)
        by_name: dict[str, list[str]] = defaultdict(list)
        for topic in sorted(counts):
            vue, name = _device_and_name(topic)
            by_name[name].append(vue)
        tracks, truths = by_name[ODOMETRY], by_name[GROUND_TRUTH]
        return (
            f"{type(self).__name__}({os.fspath(self.path)!r}): {self._duration_s:.1f} s, "
            f"{measured} measurements, tracks of {', '.join(tracks) or 'no device'}, "
            f"ground truth of {', '.join(truths) or 'no device'}"
        )

    @property
    def rsus(self) -> tuple[RsuInfo, ...]:
        """Every description of an RSU; one that was sent again is there again."""
        return tuple(self._values[RSU_INFO].get("", ()))

    @property
    def measurements(self) -> tuple[RsuMeasurement, ...]:
        """What the RSUs measured of all devices."""
        return tuple(self._values[RSU_MEASUREMENTS].get("", ()))

    @property
    def imu(self) -> Mapping[str, tuple[ImuSample, ...]]:
        """IMU samples by device."""
        return self._values[IMU]

    @property
    def truth(self) -> Mapping[str, tuple[Odometry, ...]]:
        """Ground truth by device."""
        return self._values[GROUND_TRUTH]

    @property
    def odometry(self) -> Mapping[str, tuple[Odometry, ...]]:
        """The track by device."""
        return self._values[ODOMETRY]

    @property
    def clock(self) -> Mapping[str, tuple[ClockState, ...]]:
        """The estimated clock by device."""
        return self._values[CLOCK_STATE]

    @property
    def status(self) -> Mapping[str, tuple[TrackStatus, ...]]:
        """State, counts and protection level of the track by device."""
        return self._values[TRACK_STATUS]

    @cached_property
    def _values(self) -> dict[str, dict[str, tuple[Any, ...]]]:
        """By name of the topic, then by device ("" for what is not a device's)."""
        convert = codec()
        read = {
            RSU_INFO: convert.rsu_info_from_msg,
            RSU_MEASUREMENTS: convert.measurement_from_msg,
            IMU: convert.imu_from_msg,
            GROUND_TRUTH: convert.odometry_from_msg,
            ODOMETRY: convert.odometry_from_msg,
            CLOCK_STATE: convert.clock_state_from_msg,
            TRACK_STATUS: convert.track_status_from_msg,
        }
        found: dict[str, dict[str, list[Any]]] = {name: defaultdict(list) for name in read}
        with BagReader(self.path) as bag:
            names = {topic: _device_and_name(topic) for topic in bag.topics}
            wanted = [topic for topic, (_, name) in names.items() if name in read]
            for entry in bag.messages(wanted):
                vue, name = names[entry.topic]
                found[name][vue].append(read[name](entry.message))
        return {
            name: {vue: tuple(values) for vue, values in sorted(by_vue.items())}
            for name, by_vue in found.items()
        }


_TYPES = {
    RSU_INFO: "netpos_msgs/msg/RsuInfo",
    RSU_MEASUREMENTS: "netpos_msgs/msg/RsuMeasurement",
    IMU: "sensor_msgs/msg/Imu",
    GROUND_TRUTH: "nav_msgs/msg/Odometry",
    ODOMETRY: "nav_msgs/msg/Odometry",
    CLOCK_STATE: "netpos_msgs/msg/ClockState",
    TRACK_STATUS: "netpos_msgs/msg/TrackStatus",
}


def _device_and_name(topic: str) -> tuple[str, str]:
    vue, name = split(topic)
    return (vue, name) if vue else ("", topic)


def _check(rsus: Sequence[RsuInfo], measurements: Sequence[RsuMeasurement]) -> None:
    if not measurements:
        raise BagError("there is no measurement to write; give at least one")
    known = {info.rsu_id for info in rsus}
    heard = {name for m in measurements for name in (m.rsu_id, m.reference_rsu_id) if name}
    strangers = sorted(heard - known)
    if strangers:
        raise BagError(
            f"no position of RSU {', '.join(strangers)}; give an RsuInfo of each "
            f"(there are {', '.join(sorted(known)) or 'none'})"
        )
    first_ns = min(m.stamp_ns for m in measurements)
    if first_ns <= 0:
        raise BagError(f"stamp {first_ns} ns is not > 0; add a constant to all stamps")


def number_beacons(measurements: Sequence[RsuMeasurement]) -> list[RsuMeasurement]:
    """In stamp order, with one sequence number per stamp of a device and ``expected`` its RSUs.

    Raises ``BagError`` where an RSU measures a device twice at one stamp.
    """
    ordered = sorted(measurements, key=lambda m: (m.stamp_ns, m.vue_id, m.rsu_id))
    numbered: list[RsuMeasurement] = []
    groups = groupby(ordered, key=lambda m: (m.stamp_ns, m.vue_id))
    for sequence, ((stamp_ns, vue_id), group) in enumerate(groups):
        beacon = list(group)
        names = [(m.rsu_id, m.reference_rsu_id) for m in beacon]
        if len(set(names)) != len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise BagError(
                f"RSU {twice[0]} measures {vue_id} twice at stamp {stamp_ns} ns; "
                "keep one of the two"
            )
        numbered.extend(replace(m, sequence=sequence, expected=len(beacon)) for m in beacon)
    return numbered
