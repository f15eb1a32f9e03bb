"""Parameters of pedestrian dead reckoning."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal

from netpos.common.parameters import (
    check_fields,
    choice,
    described,
    nearest,
    not_negative,
    positive,
    real,
    typed,
)
from netpos.inertial.attitude import AttitudeConfig
from netpos.inertial.steps import StepConfig

Placement = Literal["carried", "waist"]
_WAIST_SCALE_SD = 0.4


@dataclass(frozen=True, slots=True, kw_only=True)
class PdrConfig:
    """All parameters of the core; a bad value raises ``ValueError`` here.

    The defaults are for a device carried anyhow, ``of("waist")`` for one worn at the waist.
    """

    output_rate_hz: float = positive(10.0, "rate of the velocities")
    length_model: Literal["frequency", "weinberg"] = choice(
        "weinberg",
        ("frequency", "weinberg"),
        "weinberg (by the bounce) | frequency (by cadence and height), see inertial.length",
    )
    height_m: float = positive(1.75, "frequency: height of the person")
    weinberg_k: float = positive(0.41, "weinberg: k [m (m/s^2)^(-1/4)]")
    length_scale: float = positive(
        1.0, "true over modelled step length of this person before any calibration"
    )
    length_scale_sd: float = positive(0.1, "its sd; people of a height differ by about a tenth")
    step_sd_fraction: float = positive(
        0.06, "sd of single steps about their scaled model, over the length"
    )
    heading_sd_rad: float = positive(0.1, "heading sd at alignment, or with a magnetometer in use")
    heading_drift_radps: float = not_negative(
        0.001, "growth of the heading sd without an accepted magnetic sample"
    )
    mount_heading_rad: float = real(
        0.0, -math.pi, math.pi, "walking direction minus the body x axis, counter-clockwise"
    )
    max_mount_tilt_rad: float = positive(
        math.pi,
        "a mean specific force further from the body z axis than this means swapped axes: the"
        " heading is then unknown; pi for a device carried anyhow",
    )
    hard_iron_t: tuple[float, ...] = described(
        (0.0, 0.0, 0.0),
        "the field is matrix (reading - hard iron), of magnetic_calibration.fit_iron",
    )
    field_matrix: tuple[float, ...] = described(
        (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0), "the matrix of hard_iron_t, by rows"
    )
    field_hold_s: float = not_negative(
        0.1,
        "a field sample is used this long after its stamp, so that it does not matter whether it"
        " or the IMU sample of the same time arrives first; 0: at once",
    )
    field_patience_s: float = positive(
        3.0, "time without magnetic samples after which this is reported"
    )
    still_speed_sd_mps: float = positive(0.05, "of the zero velocity of a body at rest")
    turning_speed_sd_mps: float = positive(0.3, "of the zero velocity of a body that only turns")
    undecided_speed_sd_mps: float = positive(
        1.0, "of the velocity of a body that is neither at rest nor walking"
    )
    still_rate_radps: float = positive(0.2, "a body at rest turns slower")
    speed_drift_mps2: float = not_negative(
        0.5,
        "growth of the velocity sd with the age of the last step: people stop within a step, and"
        " the next step is known only steps.delay_s after it",
    )
    max_gap_s: float = positive(0.25, "a longer gap of the IMU starts anew")
    gap_rate_sd_radps: float = not_negative(
        0.5, "how fast the device may turn unseen, for the heading sd after a gap"
    )
    min_rate_hz: float = positive(25.0, "slowest IMU that is good enough")
    max_rate_hz: float = positive(2000.0, "fastest IMU that is believed")
    accelerometer_range_mps2: float = positive(156.0, "the accelerometer is cut off there")
    gyro_range_radps: float = positive(34.8, "the gyro is cut off there")
    clock_reset_s: float = positive(
        1.0, "a stamp this far in the past restarts the core instead of being refused"
    )
    attitude: AttitudeConfig = field(default_factory=AttitudeConfig)
    steps: StepConfig = field(default_factory=StepConfig)

    def __post_init__(self) -> None:
        check_fields(self, "pdr.")
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
        """Defaults for a placement of the device.

        Raises
        ------
        ValueError  no such placement
        """
        if placement == "carried":
            return cls()
        if placement == "waist":
            return cls(
                steps=StepConfig.waist(),
                max_mount_tilt_rad=math.radians(60),
                # a patient's steps are much shorter than the model's, and nothing tells before
                length_scale_sd=_WAIST_SCALE_SD,
            )
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
                raise ValueError(f"no parameter {name} of pdr{nearest(name, known)}")
            known[name] = typed(f"pdr.{name}", known[name], value)
        inner = {
            part: type(getattr(base, part))(
                **{n.split(".")[1]: v for n, v in known.items() if n.startswith(f"{part}.")}
            )
            for part in ("attitude", "steps")
        }
        return cls(**{n: v for n, v in known.items() if "." not in n}, **inner)

    def flat(self) -> dict[str, Any]:
        """Every number and word by name; those of ``attitude`` and ``steps`` with a dot."""
        return {name: value for name, value, _ in self.entries()}

    def entries(self) -> Iterator[tuple[str, Any, str]]:
        """Name as in ``flat``, value and sentence of every number and word."""
        for entry in fields(self):
            value = getattr(self, entry.name)
            if isinstance(value, AttitudeConfig | StepConfig):
                for e in fields(value):
                    yield f"{entry.name}.{e.name}", getattr(value, e.name), e.metadata["text"]
            else:
                yield entry.name, value, entry.metadata["text"]
