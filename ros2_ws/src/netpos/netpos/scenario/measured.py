"""Measurements in a scenario file: which RSUs hear a beacon, what they measure, how well."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from netpos.estimation.sensors.table import readings
from netpos.radio.anchor import TwoWayRanging
from netpos.radio.arrays import AntennaArray
from netpos.radio.propagation import LosModel, PathLoss
from netpos.radio.waveform import Waveform
from netpos.scenario.section import Positive, Section

_SIMULATED = {r.quantity: r.simulated for _, r in readings() if r.simulated is not None}
_QUANTITIES = (*_SIMULATED, "position")
_ERRORS = {
    "azimuth": "azimuth_sd_deg",
    "elevation": "elevation_sd_deg",
    "toa": "toa_sd_s",
    "range": "range_sd_m",
    "phase": "phase_sd_deg",
}
"""Which of ``FixedErrors`` is the error of each of ``radio.measure.QUANTITIES``."""


class LineOfSight(Section):
    """Which RSUs may hear a beacon. Buildings of the world always block.

    ``max_distance_m`` is fokin2020's d_los (plane distance; absent: no limit). ``probability``
    draws the state by ITU-R M.2412 once per (seed, RSU, device) as a field over the plane with the
    given correlation distance."""

    max_distance_m: Positive | None = None
    probability: LosModel | None = None
    correlation_distance_m: Positive = 50.0


class FixedErrors(Section):
    """Constant standard deviations of the measurements; ``two_way_ranging`` gives that of a range
    instead of ``range_sd_m``."""

    model: Literal["fixed"] = "fixed"
    azimuth_sd_deg: Positive | None = None
    elevation_sd_deg: Positive | None = None
    toa_sd_s: Positive | None = None
    range_sd_m: Positive | None = None
    position_sd_m: Positive | None = None
    phase_sd_deg: Positive | None = None
    two_way_ranging: TwoWayRanging | None = None

    @model_validator(mode="after")
    def _one_range_error(self) -> Self:
        if self.two_way_ranging is not None and self.range_sd_m is not None:
            raise ValueError("two_way_ranging gives the error of a range; remove range_sd_m")
        return self


class CramerRaoErrors(Section):
    """Variances are the Cramér-Rao bounds at the RSU's distance."""

    model: Literal["cramer_rao"]
    array: AntennaArray = AntennaArray()
    waveform: Waveform = Waveform()
    path_loss: PathLoss = PathLoss()


class Measurement(Section):
    """Quantities that the RSUs measure of each beacon. The ``nearest`` RSUs in line of sight
    report it, or a number of these drawn uniformly for each beacon, at least ``fewest``."""

    quantities: tuple[str, ...] = ("azimuth", "toa")
    nearest: int = Field(default=2, ge=1)
    fewest: int | None = Field(default=None, ge=1)
    los: LineOfSight = LineOfSight()
    errors: Annotated[FixedErrors | CramerRaoErrors, Field(discriminator="model")]

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if self.fewest is not None and self.fewest > self.nearest:
            raise ValueError(f"fewest must be at most nearest ({self.nearest}), got {self.fewest}")
        unknown = set(self.quantities) - set(_QUANTITIES)
        if unknown or not self.quantities or len(set(self.quantities)) < len(self.quantities):
            raise ValueError(
                f"quantities must name each of {', '.join(_QUANTITIES)} at most once, "
                f"got {', '.join(self.quantities) or 'none'}"
            )
        if isinstance(self.errors, FixedErrors):
            keys = {quantity: _ERRORS[drawn] for quantity, drawn in _SIMULATED.items()}
            keys["position"] = "position_sd_m"
            if self.errors.two_way_ranging is not None:
                keys = {q: k.replace("range_sd_m", "two_way_ranging") for q, k in keys.items()}
            for quantity in self.quantities:
                if getattr(self.errors, keys[quantity]) is None:
                    raise ValueError(
                        f"errors.{keys[quantity]} is missing: {quantity} is among the quantities"
                    )
        elif "position" in self.quantities:
            raise ValueError("position needs errors of model fixed: it has no bound of its own")
        elif "phase" in self.quantities:
            raise ValueError("phase needs errors of model fixed, with phase_sd_deg")
        elif "elevation" in self.quantities and self.errors.array.rows < 2:
            raise ValueError("elevation needs an array with at least 2 rows")
        return self
