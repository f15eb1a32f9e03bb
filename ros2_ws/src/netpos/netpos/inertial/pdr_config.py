"""Parameters of pedestrian dead reckoning."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Literal

from netpos.inertial.attitude import AttitudeConfig
from netpos.inertial.length import LengthModel
from netpos.inertial.steps import StepConfig

Placement = Literal["carried", "waist"]

_POSITIVE = (
    "output_rate_hz",
    "height_m",
    "weinberg_k",
    "length_scale",
    "length_scale_sd",
    "step_sd_fraction",
    "heading_sd_rad",
    "still_speed_sd_mps",
    "turning_speed_sd_mps",
    "undecided_speed_sd_mps",
    "still_rate_radps",
    "max_gap_s",
    "min_rate_hz",
    "max_rate_hz",
    "accelerometer_range_mps2",
    "gyro_range_radps",
    "max_mount_tilt_rad",
    "field_patience_s",
    "clock_reset_s",
)
_NOT_NEGATIVE = ("heading_drift_radps", "gap_rate_sd_radps", "speed_drift_mps2", "field_hold_s")


@dataclass(frozen=True, slots=True, kw_only=True)
class PdrConfig:
    """All parameters of the core; a bad value raises ``ValueError`` here.

    The defaults are for a device carried anyhow, ``of("waist")`` for one worn at the waist.

    length_model, height_m, weinberg_k : see ``inertial.length``; k in m (m/s^2)^(-1/4)
    length_scale, length_scale_sd : true over modelled step length of this person before any
        calibration; people of a height differ by about a tenth
    step_sd_fraction : sd of single steps about their scaled model, over the length
    heading_sd_rad : heading sd at alignment, or with a magnetometer in use
    heading_drift_radps : growth of the heading sd without an accepted magnetic sample
    mount_heading_rad : walking direction minus the body x axis, counter-clockwise
    max_mount_tilt_rad : a mean specific force further from the body z axis than this means
        swapped axes: the heading is then unknown; pi for a device carried anyhow
    hard_iron_t, field_matrix : the field is matrix (reading - hard iron), of
        ``magnetic_calibration.fit_iron``; the matrix by rows
    field_hold_s : a field sample is used this long after its stamp, so that it does not matter
        whether it or the IMU sample of the same time arrives first
    field_patience_s : how long the heading may do without magnetic samples before it is said
    turning_speed_sd_mps : of the zero velocity of a body that only turns
    speed_drift_mps2 : growth of the velocity sd with the age of the last step: people stop within
        a step, and the next step is known only ``steps.delay_s`` after it
    gap_rate_sd_radps : how fast the device may turn unseen, for the heading sd after a gap
    clock_reset_s : a stamp this far in the past restarts the core instead of being refused
    """

    output_rate_hz: float = 10.0
    length_model: LengthModel = "weinberg"
    height_m: float = 1.75
    weinberg_k: float = 0.41
    length_scale: float = 1.0
    length_scale_sd: float = 0.1
    step_sd_fraction: float = 0.06
    heading_sd_rad: float = 0.1
    heading_drift_radps: float = 0.001
    mount_heading_rad: float = 0.0
    max_mount_tilt_rad: float = math.pi
    hard_iron_t: tuple[float, ...] = (0.0, 0.0, 0.0)
    field_matrix: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    field_hold_s: float = 0.1
    field_patience_s: float = 3.0
    still_speed_sd_mps: float = 0.05
    turning_speed_sd_mps: float = 0.3
    undecided_speed_sd_mps: float = 1.0
    still_rate_radps: float = 0.2
    speed_drift_mps2: float = 0.5
    max_gap_s: float = 0.25
    gap_rate_sd_radps: float = 0.5
    min_rate_hz: float = 25.0
    max_rate_hz: float = 2000.0
    accelerometer_range_mps2: float = 156.0
    gyro_range_radps: float = 34.8
    clock_reset_s: float = 1.0
    attitude: AttitudeConfig = field(default_factory=AttitudeConfig)
    steps: StepConfig = field(default_factory=StepConfig)

    def __post_init__(self) -> None:
        if self.length_model not in ("frequency", "weinberg"):
            raise ValueError(
                f"pdr.length_model must be frequency or weinberg, got {self.length_model!r}"
            )
        for name in _POSITIVE:
            value = getattr(self, name)
            if not 0 < value < math.inf:
                raise ValueError(f"pdr.{name} must be finite and > 0, got {value}")
        for name in _NOT_NEGATIVE:
            value = getattr(self, name)
            if not 0 <= value < math.inf:
                raise ValueError(f"pdr.{name} must be finite and >= 0, got {value}; use 0 for off")
        for name, size in (("hard_iron_t", 3), ("field_matrix", 9)):
            numbers = getattr(self, name)
            if len(numbers) != size or not all(map(math.isfinite, numbers)):
                raise ValueError(f"pdr.{name} must be {size} finite numbers, got {numbers}")
        if not abs(self.mount_heading_rad) <= math.pi:
            raise ValueError(
                f"pdr.mount_heading_rad must be in [-pi, pi] rad, got {self.mount_heading_rad}; "
                "is it in degrees?"
            )
        if self.max_rate_hz <= self.min_rate_hz:
            raise ValueError(
                f"pdr.max_rate_hz ({self.max_rate_hz}) must exceed min_rate_hz "
                f"({self.min_rate_hz}); raise it"
            )
        if self.max_gap_s * self.min_rate_hz <= 1:
            raise ValueError(
                f"pdr.max_gap_s ({self.max_gap_s}) must exceed 1 / min_rate_hz "
                f"({1 / self.min_rate_hz:.3g} s), or every sample is a gap; raise it"
            )

    @classmethod
    def of(cls, placement: Placement) -> PdrConfig:
        """Defaults for where the device is worn.

        Raises
        ------
        ValueError  no such placement
        """
        if placement == "carried":
            return cls()
        if placement == "waist":
            return cls(steps=StepConfig.waist(), max_mount_tilt_rad=math.radians(60))
        raise ValueError(f"placement must be carried or waist, got {placement!r}")

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> PdrConfig:
        """From names such as ``height_m`` and ``attitude.declination_rad``, and ``placement``.

        Raises
        ------
        ValueError  an unknown name, a value of the wrong type or out of range
        """
        given = dict(values)
        base = cls.of(given.pop("placement", "carried"))
        known = base.flat()
        for name, value in given.items():
            if name not in known:
                raise ValueError(f"no parameter {name} of pdr; known: {', '.join(sorted(known))}")
            known[name] = _like(known[name], value, name)
        inner = {
            part: type(getattr(base, part))(
                **{n.split(".")[1]: v for n, v in known.items() if n.startswith(f"{part}.")}
            )
            for part in ("attitude", "steps")
        }
        return cls(**{n: v for n, v in known.items() if "." not in n}, **inner)

    def flat(self) -> dict[str, Any]:
        """Every number and word by name; those of ``attitude`` and ``steps`` with a dot."""
        out: dict[str, Any] = {}
        for entry in fields(self):
            value = getattr(self, entry.name)
            if isinstance(value, AttitudeConfig | StepConfig):
                out.update(
                    {f"{entry.name}.{e.name}": getattr(value, e.name) for e in fields(value)}
                )
            else:
                out[entry.name] = value
        return out


def _like(default: Any, value: Any, name: str) -> Any:
    """The value in the type of the default; whole numbers may stand for floats."""
    if isinstance(default, tuple) and isinstance(value, Sequence) and not isinstance(value, str):
        return tuple(_like(0.0, number, name) for number in value)
    if isinstance(default, float) and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if type(value) is not type(default):
        raise ValueError(f"pdr.{name} must be a {type(default).__name__}, got {value!r}")
    return value
