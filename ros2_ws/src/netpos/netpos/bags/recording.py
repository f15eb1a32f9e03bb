"""A recording made in Python becomes a bag: RSUs, measurements, truth, IMU."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path

import yaml

import netpos
from netpos.bags.errors import BagError
from netpos.bags.types import codec
from netpos.bags.writer import whole_bag
from netpos.messages.topics import GROUND_TRUTH, IMU, RSU_INFO, RSU_MEASUREMENTS, of_vue
from netpos.messages.values import ImuSample, Odometry, RsuInfo, RsuMeasurement

# Metadata of an import that whoever reads the figures must know.
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

    Measurements of one stamp and device are taken as one beacon: they get its number, and
    ``expected`` is how many there are.

    Parameters
    ----------
    rsus : every RSU of the measurements
    tracker : parameters of the tracker that a replay takes, such as ``device_height_m``
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
    if tracker:
        kept["tracker"] = yaml.safe_dump(dict(tracker))
    with whole_bag(Path(path), metadata=kept) as writer:
        for info in rsus:
            message = messages.rsu_info_to_msg(replace(info, stamp_ns=start_ns))
            writer.write(RSU_INFO, message, start_ns)
        for stamp_ns, topic, message in merged:
            writer.write(topic, message, stamp_ns)
        return writer.counts


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
        raise BagError(f"stamp {first_ns} ns is no stamp; add a constant so that all are > 0")


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
