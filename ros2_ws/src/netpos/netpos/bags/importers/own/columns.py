"""Which column or field holds what: ``--map``, ``--units`` and ``--sd``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from decimal import Decimal, InvalidOperation
from typing import Any

import numpy as np

from netpos.bags.importers.own.records import Record, Skipped, label, number, problem
from netpos.common.parameters import nearest
from netpos.messages.values import Field, RsuMeasurement

SPEED_OF_LIGHT_MPS = 299_792_458.0
LENGTH = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "km": 1e3, "ft": 0.3048}
ANGLE = {"rad": 1.0, "deg": math.pi / 180}
FLIGHT = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "m": 1 / SPEED_OF_LIGHT_MPS}
CLOCK_NS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


@dataclass(frozen=True, slots=True)
class Quantity:
    """One quantity of a measurement: its flag, its attributes and the units it may have."""

    flag: Field
    value: str
    variance: str
    units: Mapping[str, float]
    positive: bool = False


QUANTITIES = {
    "range": Quantity(Field.RANGE, "range_m", "range_var", LENGTH, positive=True),
    "azimuth": Quantity(Field.AZIMUTH, "azimuth_rad", "azimuth_var", ANGLE),
    "elevation": Quantity(Field.ELEVATION, "elevation_rad", "elevation_var", ANGLE),
    "toa": Quantity(Field.TOA, "toa_s", "toa_var", FLIGHT),
    "tdoa": Quantity(Field.TDOA, "tdoa_s", "tdoa_var", FLIGHT),
    "phase": Quantity(Field.PHASE, "phase_difference_rad", "phase_difference_var", ANGLE),
}
POSITION = ("x", "y", "z")
RSU_POSITION = ("rsu_x", "rsu_y", "rsu_z")
_WORDS = ("time", "rsu", "reference", "vue", "rssi", "line_of_sight", *POSITION, *RSU_POSITION)
_UNITS: dict[str, Sequence[str]] = {
    "time": [*CLOCK_NS, "iso"],
    "position": list(LENGTH),
    "rsu": list(LENGTH),
    **{name: list(quantity.units) for name, quantity in QUANTITIES.items()},
}


def pairs(text: str, option: str) -> dict[str, str]:
    """``a=1,b=2`` as a mapping.

    Raises ``ValueError`` for a part without ``=`` and for a name given twice.
    """
    found: dict[str, str] = {}
    for part in filter(None, (part.strip() for part in text.split(","))):
        name, equals, value = (piece.strip() for piece in part.partition("="))
        if not (equals and name and value):
            raise ValueError(f"{option} takes NAME=VALUE pairs between commas, got {part!r}")
        if name in found:
            raise ValueError(f"{option} names {name} twice")
        found[name] = value
    return found


@dataclass(frozen=True, slots=True, kw_only=True)
class Columns:
    """What is read from a line or a message.

    sources : where each quantity stands, such as ``range`` in column ``dist``; one column for each
        RSU is ``range:a1``
    units : unit of a quantity (default: SI)
    sd : standard deviation of a quantity, in its unit, where no column ``range_sd`` or
        ``range_var`` gives it
    vue_id, lever_arm_m : of every measurement
    """

    sources: Mapping[str, str]
    units: Mapping[str, str] = field(default_factory=dict)
    sd: Mapping[str, float] = field(default_factory=dict)
    vue_id: str = "vue_1"
    lever_arm_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        for name in self.sources:
            _check_name(name)
        for name, unit in self.units.items():
            known = _UNITS.get(name)
            if known is None:
                raise ValueError(f"--units knows no {name!r}{nearest(name, list(_UNITS))}")
            if unit not in known:
                raise ValueError(f"--units {name}={unit}: give one of {', '.join(known)}")
        if "time" not in self.sources:
            raise ValueError("--map must name the time, as in time=stamp")
        if not self.measured:
            raise ValueError(
                f"--map names nothing measured; give one of {', '.join(QUANTITIES)} or x and y"
            )
        wide = {":" in name for name in self.sources if name.partition(":")[0] in QUANTITIES}
        if (False in wide or self.has_position) and "rsu" not in self.sources:
            raise ValueError(
                "--map must name the RSU, as in rsu=anchor_id, or one column for each RSU, as in "
                "range:a1=3"
            )
        if "tdoa" in self.measured and "reference" not in self.sources:
            raise ValueError("--map must name the RSU that tdoa counts from, as in reference=idA")
        self._check_sd()

    @classmethod
    def parse(cls, mapping: str, units: str = "", sd: str = "", **rest: Any) -> Columns:
        """From the text of the options.

        Raises ``ValueError`` for an unknown name or unit, and for a quantity without a standard
        deviation.
        """
        numbers: dict[str, float] = {}
        for name, value in pairs(sd, "--sd").items():
            try:
                numbers[name] = float(value)
            except ValueError:
                raise ValueError(f"--sd {name}={value}: {value!r} is not a number") from None
        return cls(
            sources=pairs(mapping, "--map"), units=pairs(units, "--units"), sd=numbers, **rest
        )

    @property
    def has_position(self) -> bool:
        """Whether fixes are read."""
        return "x" in self.sources

    @property
    def measured(self) -> set[str]:
        """The quantities that are read."""
        found = {name.partition(":")[0] for name in self.sources} & set(QUANTITIES)
        return found | ({"position"} if self.has_position else set())

    def _check_sd(self) -> None:
        known = [*QUANTITIES, "position"]
        for name, value in self.sd.items():
            if name not in known:
                raise ValueError(f"--sd knows no {name!r}{nearest(name, known)}")
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"--sd {name}={value:g}: give a number > 0")
        for name in sorted(self.measured):
            if not {f"{name}_sd", f"{name}_var"} & set(self.sources) and name not in self.sd:
                raise ValueError(
                    f"the standard deviation of {name} is not known: give --sd {name}=..., as the "
                    f"data sheet says it, or a column {name}_sd"
                )

    def stamp_ns(self, record: Record) -> int:
        """Time of a record [ns].

        Raises ``BagError`` for a time that cannot be read.
        """
        return time_ns(record, self.sources["time"], self.units.get("time", "s"))

    def measurements(self, record: Record, skipped: Skipped) -> list[RsuMeasurement]:
        """What a record says was measured; empty values are left out and counted.

        Raises ``BagError`` for a value that cannot be read.
        """
        stamp_ns = self.stamp_ns(record)
        vue_id = label(record, self.sources["vue"]) if "vue" in self.sources else self.vue_id
        by_rsu: dict[str, dict[str, Any]] = {}
        for name, source in self.sources.items():
            kind, colon, rsu = name.partition(":")
            if kind not in QUANTITIES:
                continue
            value = self._quantity(record, kind, source)
            if value is None:
                skipped["empty values"] += 1
                continue
            names = by_rsu.setdefault(rsu if colon else label(record, self.sources["rsu"]), {})
            quantity = QUANTITIES[kind]
            names[quantity.value] = value
            names[quantity.variance] = self._variance(record, kind)
            names["fields"] = names.get("fields", Field(0)) | quantity.flag
        if self.has_position:
            self._add_fix(record, by_rsu, skipped)
        shared = self._shared(record, skipped) if by_rsu else {}
        return [
            RsuMeasurement(stamp_ns=stamp_ns, rsu_id=rsu, vue_id=vue_id, **shared, **values)
            for rsu, values in by_rsu.items()
        ]

    def rsu_position(self, record: Record) -> tuple[str, tuple[float, float, float]] | None:
        """The RSU of a record and where it says it is; None where that is not mapped."""
        if RSU_POSITION[0] not in self.sources:
            return None
        factor = LENGTH[self.units.get("rsu", "m")]
        x, y, z = (
            factor * (_needed(record, self.sources[name], name) if name in self.sources else 0.0)
            for name in RSU_POSITION
        )
        return label(record, self.sources["rsu"]), (x, y, z)

    def _quantity(self, record: Record, kind: str, source: str) -> float | None:
        value = number(record, source, kind)
        if value is None:
            return None
        if QUANTITIES[kind].positive and value <= 0:
            raise problem(record, f"{kind} {value:g} in {source} is not positive")
        return value * self._factor(kind)

    def _factor(self, kind: str) -> float:
        units = LENGTH if kind == "position" else QUANTITIES[kind].units
        return units[self.units[kind]] if kind in self.units else 1.0

    def _variance(self, record: Record, kind: str) -> float:
        factor = self._factor(kind)
        for suffix, power in (("sd", 2), ("var", 1)):
            source = self.sources.get(f"{kind}_{suffix}")
            if source is not None:
                value = number(record, source, f"{kind}_{suffix}")
                if value is None or value <= 0:
                    raise problem(record, f"{kind}_{suffix} in {source} must be > 0, is {value}")
                return factor**2 * value**power
        return (factor * self.sd[kind]) ** 2

    def _add_fix(
        self, record: Record, by_rsu: dict[str, dict[str, Any]], skipped: Skipped
    ) -> None:
        values = [
            number(record, self.sources[axis], axis) if axis in self.sources else 0.0
            for axis in POSITION
        ]
        if None in values:
            skipped["empty values"] += 1
            return
        names = by_rsu.setdefault(label(record, self.sources["rsu"]), {})
        names["position"] = self._factor("position") * np.array(values, dtype=float)
        names["position_cov"] = np.eye(3) * self._variance(record, "position")
        names["fields"] = names.get("fields", Field(0)) | Field.POSITION

    def _shared(self, record: Record, skipped: Skipped) -> dict[str, Any]:
        shared: dict[str, Any] = {"lever_arm": self.lever_arm_m}
        if "reference" in self.sources:
            shared["reference_rsu_id"] = label(record, self.sources["reference"])
        if "rssi" in self.sources:
            shared["rssi_dbm"] = _rssi(record, self.sources["rssi"], skipped)
        if "line_of_sight" in self.sources:
            value = number(record, self.sources["line_of_sight"], "line_of_sight")
            shared["line_of_sight"] = value is None or value != 0
        return shared


def _check_name(name: str) -> None:
    kind, colon, rsu = name.partition(":")
    spread = kind.removesuffix("_sd").removesuffix("_var")
    if colon:
        if kind not in QUANTITIES or not rsu:
            raise ValueError(f"--map {name}: a column of one RSU is written range:a1=3")
    elif kind not in _WORDS and spread not in QUANTITIES and spread != "position":
        known = [*_WORDS, *QUANTITIES]
        raise ValueError(f"--map knows no {name!r}{nearest(name, known)}; it knows {known}")


def _needed(record: Record, source: str, name: str) -> float:
    value = number(record, source, name)
    if value is None:
        raise problem(record, f"{name} in {source} is empty")
    return value


def _rssi(record: Record, source: str, skipped: Skipped) -> float:
    try:
        value = float(record.value(source))
    except (TypeError, ValueError):
        value = math.nan
    if math.isfinite(value):
        return value
    skipped["RSSI not finite, taken as not measured"] += 1
    return 0.0


def time_ns(record: Record, source: str, unit: str) -> int:
    """A time [ns]: a number in ``unit``, ISO text, or a stamp of a message.

    Raises ``BagError`` for a time that cannot be read.
    """
    value = record.value(source)
    if source == "recorded":
        return int(value)
    if hasattr(value, "sec") and hasattr(value, "nanosec"):
        return int(value.sec) * 10**9 + int(value.nanosec)
    text = str(value).strip()
    if unit == "iso":
        return _iso_ns(record, text)
    try:
        exact = Decimal(text)
    except InvalidOperation:
        exact = Decimal("NaN")
    if not exact.is_finite():
        raise problem(record, f"time {text!r} in {source} is not a number")
    return int((exact * CLOCK_NS[unit]).to_integral_value())


def _iso_ns(record: Record, text: str) -> int:
    try:
        when = datetime.fromisoformat(text)
    except ValueError:
        raise problem(record, f"time {text!r} is not ISO 8601") from None
    when = when if when.tzinfo else when.replace(tzinfo=UTC)
    return (when - _EPOCH) // timedelta(microseconds=1) * 1000
