"""RSUs and their errors as a small file: written from a bag, loaded into another bag."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from netpos.bags.errors import BagError
from netpos.bags.importers.own.rsus import read_rsus
from netpos.bags.reader import BagReader
from netpos.bags.types import codec
from netpos.bags.writer import whole_bag
from netpos.common.files import write_text
from netpos.common.pair_errors import of_each_receiver
from netpos.common.yaml_text import dump_yaml
from netpos.messages.fields import bad_stamp, malformed_nanosec
from netpos.messages.topics import RSU_INFO, RSU_LEARNED, is_tracker_output
from netpos.messages.values import RsuErrors, RsuInfo

_DIFFERENCE = "TDOA"
_BIAS_OF = {
    "RANGE": "range_bias_sd_m",
    "TOA": "range_bias_sd_m",
    _DIFFERENCE: "range_bias_sd_m",
    "AZIMUTH": "azimuth_bias_sd_rad",
    "COSINE_Y": "azimuth_bias_sd_rad",
    "ELEVATION": "elevation_bias_sd_rad",
    "COSINE_Z": "elevation_bias_sd_rad",
}
_DIGITS = 6


def save_rsus(bag: Path, file: Path) -> list[RsuInfo]:
    """Write the RSUs of a bag, in the form that ``read_rsus`` reads; where their errors were
    learned, with the newest sd and correlation time of the biases as declared values.

    Raises
    ------
    BagError  not a readable bag, or one without RSUs
    FileExistsError  ``file`` exists
    """
    if file.exists():
        raise FileExistsError(f"{file} exists and is never overwritten; name another")
    make = codec()
    infos: dict[str, RsuInfo] = {}
    learned: dict[str, RsuErrors] = {}
    with BagReader(bag) as source:
        for entry in source.messages([t for t in (RSU_INFO, RSU_LEARNED) if t in source.topics]):
            if entry.topic == RSU_INFO:
                info = make.rsu_info_from_msg(entry.message)
                infos[info.rsu_id] = info
            else:
                errors = make.rsu_errors_from_msg(entry.message)
                learned[errors.rsu_id] = errors
    if not infos:
        raise BagError(f"{bag} has no {RSU_INFO}: there is nothing to save")
    of_differences = _of_differences(infos, learned)
    declared = [
        _declaring(info, _biases(learned.get(name), of_differences.get(name)))
        for name, info in sorted(infos.items())
    ]
    lines = [f"# RSUs of {bag.name}; m, rad, s, axes of map", "rsus:"]
    for info in declared:
        lines += [f"  # learned; {text}" for text in _comments(learned.get(info.rsu_id))]
        content = dump_yaml(_entry(info), default_flow_style=True, width=10_000).strip()
        name = dump_yaml(info.rsu_id).splitlines()[0]  # in quotes where it must be
        lines.append(f"  {name}: {content}")
    write_text(file, "\n".join(lines) + "\n")
    return declared


def _comments(errors: RsuErrors | None) -> list[str]:
    """What is learned of an RSU and no declaration holds."""
    if errors is None:
        return []
    scatter = zip(errors.quantities, errors.scatter, strict=True)
    stretch = zip(errors.quantities, errors.stretch, errors.stretch_sd, strict=True)
    return [
        "scatter over the sd stated: " + ", ".join(f"{of} {value:.2f}" for of, value in scatter),
        *(
            f"share by which distances are too long: {of} {share:.4f} +- {sd:.2g}"
            for of, share, sd in stretch
            if sd > 0.0
        ),
    ]


def rsus_text(infos: Iterable[RsuInfo]) -> str:
    """RSUs as the YAML of such a file, every digit kept."""
    entries = {info.rsu_id: _entry(info, None) for info in infos}
    return dump_yaml({"rsus": entries}, width=10_000)


def load_rsus(file: Path, bag: Path, out: Path) -> list[str]:
    """Copy a bag, with the RSUs that ``file`` names as it describes them; a tracker's output is
    left out. Returns their names.

    Raises
    ------
    BagError  not a readable bag or file, or an RSU that the bag does not know
    FileExistsError  ``out`` exists
    """
    wanted = {info.rsu_id: info for info in read_rsus(file)}
    make = codec()
    with BagReader(bag) as source:
        if RSU_INFO not in source.topics:
            raise BagError(f"{bag} has no {RSU_INFO}: there are no RSUs to describe anew")
        known = {e.message.rsu_id for e in source.messages([RSU_INFO])}
        strange = sorted(wanted.keys() - known)
        if strange:
            raise BagError(
                f"{file} names {', '.join(strange)}, which {bag} does not know; it knows "
                f"{', '.join(sorted(known))}"
            )
        with whole_bag(out, metadata=source.metadata) as copy:
            for name, info in source.topics.items():
                if not is_tracker_output(name):
                    copy.add_topic(name, info.type_name, info.qos, text=info.definition or None)
            for entry in source.messages([t for t in source.topics if not is_tracker_output(t)]):
                if entry.topic == RSU_INFO and entry.message.rsu_id in wanted:
                    old = make.rsu_info_from_msg(entry.message)
                    nanosec = malformed_nanosec(old.stamp_ns)
                    if nanosec is not None:
                        raise BagError(
                            f"{bag}: RsuInfo of {old.rsu_id}: {bad_stamp(nanosec)}; its time "
                            "cannot be kept"
                        )
                    new = replace(wanted[old.rsu_id], stamp_ns=old.stamp_ns, network=old.network)
                    copy.write(RSU_INFO, make.rsu_info_to_msg(new), entry.log_time_ns)
                else:
                    copy.write_raw(entry.topic, entry.type_name, entry.cdr, entry.log_time_ns)
    return sorted(wanted)


def _of_differences(
    names: Iterable[str], learned: Mapping[str, RsuErrors]
) -> dict[str, tuple[float, float]]:
    """Variance and correlation time of the bias of each RSU, by its learned differences."""
    known = list(names)
    pairs = {f"{one}-{other}": (one, other) for one in known for other in known}
    return of_each_receiver(
        (pairs[name], errors.bias_spread[0] ** 2, errors.correlation_time_s[0])
        for name, errors in learned.items()
        if name in pairs
    )


def _biases(
    own: RsuErrors | None, of_differences: tuple[float, float] | None
) -> list[tuple[str, float, float]]:
    """Quantity, sd and correlation time of the biases learned of an RSU."""
    found: list[tuple[str, float, float]] = []
    if own is not None:
        found += zip(own.quantities, own.bias_spread, own.correlation_time_s, strict=True)
    if of_differences is not None:
        variance, time_s = of_differences
        found.append((_DIFFERENCE, math.sqrt(variance), time_s))
    return found


def _declaring(info: RsuInfo, learned: Iterable[tuple[str, float, float]]) -> RsuInfo:
    """With the learned errors instead of the declared ones; of several quantities that share a
    bias the larger sd and its time."""
    changes: dict[str, float] = {}
    largest = 0.0
    for quantity, sd, time_s in learned:
        name = _BIAS_OF.get(quantity)
        if name is None:
            continue
        changes[name] = max(changes.get(name, 0.0), sd)
        if sd >= largest:
            largest, changes["bias_correlation_time_s"] = sd, time_s
    return replace(info, **changes)  # type: ignore[arg-type]


def _entry(info: RsuInfo, digits: int | None = _DIGITS) -> dict[str, Any]:
    """The fields that are not as by default, as plain values; ``digits`` None: unrounded."""
    plain = RsuInfo(rsu_id=info.rsu_id, position=info.position)
    content: dict[str, Any] = {"position": _rounded(info.position, digits)}
    for entry in fields(RsuInfo):
        value, default = getattr(info, entry.name), getattr(plain, entry.name)
        if entry.name in ("rsu_id", "position", "stamp_ns", "frame_id"):
            continue
        if isinstance(value, np.ndarray):
            if not np.array_equal(value, default):
                content[entry.name] = _rounded(value, digits and 9)
        elif value != default:
            content[entry.name] = _rounded(value, digits) if isinstance(value, float) else value
    if "angle_convention" in content:
        content["angle_convention"] = info.angle_convention.name
    return content


def _rounded(value: Any, digits: int | None) -> Any:
    if isinstance(value, np.ndarray):
        return [_rounded(v, digits) for v in value]
    return float(value) if digits is None else round(float(value), digits)
