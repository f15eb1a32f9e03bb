"""Buildings and RSUs of a scenario."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from netpos.radio.anchor import TwoAntennas
from netpos.radio.clocks import NetworkClockModel
from netpos.scenario.section import Finite, Name, Positive, Section


class Building(Section):
    """A rectangle that blocks the line of sight."""

    x_min: Finite
    y_min: Finite
    x_max: Finite
    y_max: Finite

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not (self.x_min < self.x_max and self.y_min < self.y_max):
            raise ValueError("a building needs x_min < x_max and y_min < y_max")
        return self


class World(Section):
    """``metis_madrid``: the 4 x 4 grid of fokin2020. ``open``: only the buildings listed."""

    map: Literal["metis_madrid", "open"] = "open"
    buildings: tuple[Building, ...] = ()


class RsuUnit(Section):
    """One RSU; ``yaw_deg`` turns its boresight (x axis) counter-clockwise from east.
    ``antennas``: of an anchor that measures phase differences."""

    id: Name
    position: tuple[Finite, Finite, Finite]
    yaw_deg: Finite = 0.0
    network: str = ""
    antennas: TwoAntennas | None = None


class Grid(Section):
    """RSUs on a square grid from its south-west corner, their heights drawn uniformly per seed."""

    spacing_m: Positive
    columns: int = Field(ge=1)
    rows: int = Field(ge=1)
    x_min: Finite = 0.0
    y_min: Finite = 0.0
    height_min_m: Finite = 0.0
    height_max_m: Finite = 0.0

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.height_min_m > self.height_max_m:
            raise ValueError("a grid needs height_min_m <= height_max_m")
        return self


class Rsus(Section):
    """``metis_madrid``: every 60 m along the streets (maps.StreetGrid.lamp_posts). ``list``: the
    units listed. ``grid``: on a square grid."""

    layout: Literal["metis_madrid", "list", "grid"] = "list"
    units: tuple[RsuUnit, ...] = ()
    height_m: Finite = 0.0
    clock: NetworkClockModel | None = None
    grid: Grid | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.layout == "list" and not self.units:
            raise ValueError("layout 'list' needs at least one entry in units")
        if self.layout != "list" and self.units:
            raise ValueError(f"layout {self.layout!r} places the RSUs itself; remove units")
        if (self.layout == "grid") != (self.grid is not None):
            raise ValueError("layout 'grid' and the section grid need each other")
        ids = [unit.id for unit in self.units]
        twice = sorted({i for i in ids if ids.count(i) > 1})
        if twice:
            raise ValueError(f"RSU ids must be unique, used more than once: {', '.join(twice)}")
        return self
