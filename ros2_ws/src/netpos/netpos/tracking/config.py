"""Parameters of the tracker; the node and the command line take names, defaults and limits from
here."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from netpos.filters.motion import ProcessNoise

FILTER_ITERATIONS = {"ekf": 1, "iekf": 8}


def _real(default: float, low: float, high: float, text: str) -> Any:
    return field(default=default, metadata={"low": low, "high": high, "text": text})


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackerConfig:
    """Every parameter has its unit in its name, a range and a sentence
    (``dataclasses.fields(...).metadata``).

    Raises ``ValueError`` naming the parameter, its value and the accepted range.
    """

    filter: str = field(
        default="iekf", metadata={"text": "ekf | iekf (linearised again at its own result)"}
    )
    process_noise: str = field(
        default="continuous",
        metadata={"text": "continuous | werner (fokin2020:eq.4) | white_acceleration (eq.36)"},
    )
    accel_density_mps2_sqrthz: float = _real(
        1.0, 1e-6, 1e3, "continuous: density of the white acceleration [m/s^2/sqrt(Hz)]"
    )
    accel_sd_mps2: float = _real(1.0, 1e-6, 1e3, "white_acceleration: acceleration sd per step")
    velocity_step_sd_mps: float = _real(0.1, 1e-9, 1e3, "werner: velocity sd per step")
    drift_step_sd: float = _real(
        1e-4, 0.0, 1.0, "werner, white_acceleration: clock drift sd per step [s/s]"
    )
    clock_white_density: float = _real(
        1e-10, 0.0, 1.0, "continuous: clock white frequency noise [s/sqrt(s)]"
    )
    clock_walk_density: float = _real(
        2.5e-7, 0.0, 1.0, "continuous: clock random-walk frequency noise [(s/s)/sqrt(s)]"
    )
    clock_offset_sd_s: float = _real(1e-4, 0.0, 1e3, "initial clock offset sd, mean 0")
    clock_drift_mean: float = _real(25e-6, -1.0, 1.0, "initial clock drift [s/s]")
    clock_drift_sd: float = _real(30e-6, 0.0, 1.0, "initial clock drift sd [s/s]")
    initial_speed_sd_mps: float = _real(5.0, 1e-3, 1e3, "initial velocity sd per axis, mean 0")
    require_initial_pose: bool = field(
        default=False, metadata={"text": "wait for initialpose instead of the first measurements"}
    )
    initial_position_sd_max_m: float = _real(
        5.0, 1e-3, 1e4, "a first fix is taken once its position sd is below this"
    )
    initial_window_s: float = _real(3.0, 0.01, 60.0, "measurements used for the first fix")
    coverage_radius_m: float = _real(
        150.0, 1.0, 1e5, "a device is about this far from an RSU that hears it"
    )
    device_height_m: float = _real(0.0, -1e4, 1e4, "height of the device's antenna in map")
    gate_probability: float = _real(
        0.9999, 0.5, 1.0, "share of true measurements the chi-square gate accepts; 1: no gate"
    )
    manoeuvre_speed_sd_mps: float = _real(
        0.0, 0.0, 1e3, "velocity step a measurement that fails the gate may reveal; 0: none"
    )
    inflate_after_epochs: int = field(
        default=2,
        metadata={
            "low": 1,
            "high": 10000,
            "text": "epochs rejected in a row before the velocity opens to its initial sd",
        },
    )
    max_rejected_epochs: int = field(
        default=10,
        metadata={
            "low": 1,
            "high": 10000,
            "text": "epochs rejected in a row before a new first fix",
        },
    )
    max_gap_s: float = _real(30.0, 0.1, 1e5, "a silence longer than this starts a new first fix")
    coast_after_s: float = _real(1.0, 0.01, 1e4, "COASTING after this long without a measurement")
    hold_s: float = _real(
        0.25, 0.0, 10.0, "longest wait for measurements still missing at an epoch; 0: do not wait"
    )

    def __post_init__(self) -> None:
        names = [n.name.lower() for n in ProcessNoise]
        if self.process_noise not in names:
            raise ValueError(
                f"process_noise must be one of {', '.join(names)}, got {self.process_noise!r}"
            )
        if self.filter not in FILTER_ITERATIONS:
            names = list(FILTER_ITERATIONS)
            raise ValueError(f"filter must be one of {', '.join(names)}, got {self.filter!r}")
        for entry in fields(self):
            if "low" in entry.metadata:
                low, high = entry.metadata["low"], entry.metadata["high"]
                value = getattr(self, entry.name)
                if not (math.isfinite(value) and low <= value <= high):
                    raise ValueError(f"{entry.name} must be in [{low:g}, {high:g}], got {value!r}")

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> TrackerConfig:
        """Config of named values over the defaults; raises ``ValueError`` for a name that does not
        exist."""
        known = {entry.name: entry for entry in fields(cls)}
        unknown = sorted(set(values) - set(known))
        if unknown:
            raise ValueError(
                f"unknown tracker parameter {unknown[0]!r}; the parameters are {', '.join(known)}"
            )
        return cls(**{name: _typed(name, getattr(cls(), name), v) for name, v in values.items()})


def _typed(name: str, default: Any, value: Any) -> Any:
    """``value`` in the type of the default; YAML writes 1 for 1.0 and 1e-4 for a string."""
    if isinstance(default, bool):
        if isinstance(value, bool):
            return value
        if str(value).lower() in {"true", "false"}:
            return str(value).lower() == "true"
        raise ValueError(f"{name} must be true or false, got {value!r}")
    try:
        typed = type(default)(value)
        if isinstance(default, int) and typed != float(value):
            raise ValueError(value)
        return typed
    except (TypeError, ValueError):
        raise ValueError(
            f"{name} must be of type {type(default).__name__}, got {value!r}"
        ) from None
