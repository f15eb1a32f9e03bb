"""Write values from Python as a bag, and read a bag as values."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import yaml

import netpos
from netpos.bags.errors import BagError
from netpos.bags.reader import BagReader
from netpos.bags.types import codec
from netpos.bags.writer import whole_bag
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


def write_bag(
    path: Path | str,
    *,
    rsus: Sequence[RsuInfo],
    measurements: Sequence[RsuMeasurement],
    truth: Sequence[Odometry] = (),
    imu: Sequence[ImuSample] = (),
    tracker: Mapping[str, object] | None = None,
    metadata: Mapping[str, str] | None = None,
) -> dict[str, int]:
    """Write a recording as a bag that ``netpos replay`` tracks; every input may be in any order.

    Measurements of one stamp and device count as one beacon: they get its number, and
    ``expected`` is how many there are.

    Parameters
    ----------
    rsus : every RSU of the measurements
    tracker : parameters that a replay takes, such as ``device_height_m``; the others are defaults
    metadata : what made the recording; kept in the bag

    Returns
    -------
    messages per topic

    Raises
    ------
    BagError  no measurement, a stamp that is not positive, an RSU without RsuInfo, or one that
        measures a device twice at a stamp
    FileExistsError  ``path`` exists
    """
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
    kept["tracker"] = yaml.safe_dump(dict(tracker or {}))
    with whole_bag(Path(path), metadata=kept) as writer:
        for info in rsus:
            message = messages.rsu_info_to_msg(replace(info, stamp_ns=start_ns))
            writer.write(RSU_INFO, message, start_ns)
        for stamp_ns, topic, message in merged:
            writer.write(topic, message, stamp_ns)
        return writer.counts


@dataclass(frozen=True, slots=True, kw_only=True)
class Recording:
    """What a bag holds, in recorded order; truth, odometry, status and clock by device.

    facts : how the bag was made, by name (``scenario``, ``tracker``, ``lost``);
    several values where they do not agree
    """

    rsus: tuple[RsuInfo, ...]
    measurements: tuple[RsuMeasurement, ...]
    imu: tuple[ImuSample, ...]
    truth: Mapping[str, tuple[Odometry, ...]]
    odometry: Mapping[str, tuple[Odometry, ...]]
    clock: Mapping[str, tuple[ClockState, ...]]
    status: Mapping[str, tuple[TrackStatus, ...]]
    facts: Mapping[str, tuple[str, ...]]


def read_bag(path: Path | str) -> Recording:
    """Everything of a bag as values; for a bag that fits into memory (about 1 KB a message).

    Raises ``BagError`` for what is no bag, or holds other types under these names.
    """
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
    values_by_topic: dict[tuple[str, str], list[Any]] = defaultdict(list)
    with BagReader(Path(path)) as bag:
        names = {topic: split(topic) if split(topic)[0] else ("", topic) for topic in bag.topics}
        wanted = [topic for topic, (_, name) in names.items() if name in read]
        for entry in bag.messages(wanted):
            vue, name = names[entry.topic]
            try:
                value = read[name](entry.message)
            except (AttributeError, TypeError) as error:
                raise BagError(f"{path}: {entry.topic} holds {entry.type_name}") from error
            values_by_topic[name, vue].append(value)
        facts = bag.facts

    def of(name: str) -> dict[str, tuple[Any, ...]]:
        return {
            vue: tuple(v) for (kind, vue), v in sorted(values_by_topic.items()) if kind == name
        }

    return Recording(
        rsus=tuple(values_by_topic[RSU_INFO, ""]),
        measurements=tuple(values_by_topic[RSU_MEASUREMENTS, ""]),
        imu=tuple(sample for samples in of(IMU).values() for sample in samples),
        truth=of(GROUND_TRUTH),
        odometry=of(ODOMETRY),
        clock=of(CLOCK_STATE),
        status=of(TRACK_STATUS),
        facts=facts,
    )


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
