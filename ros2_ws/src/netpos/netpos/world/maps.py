"""Maps: buildings, streets and positions of roadside units (RSUs)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class StreetGrid:
    """A square grid of equal blocks with a street on every side of each block.

    The map is the square [0, side_m]^2. Street k of either direction has its centre line at
    ``centres_m[k]``; where two centre lines meet is a crossing, that is, the corners of a block
    are crossings."""

    blocks: int
    block_m: float
    street_m: float

    def __post_init__(self) -> None:
        for name in ("blocks", "block_m", "street_m"):
            if not getattr(self, name) > 0:
                raise ValueError(f"grid.{name} must be > 0, got {getattr(self, name)}")

    @property
    def side_m(self) -> float:
        """Length of the map's side [m]."""
        return self.blocks * self.block_m + (self.blocks + 1) * self.street_m

    @property
    def centres_m(self) -> Array:
        """(blocks + 1,) coordinates of the street centre lines [m]."""
        period = self.block_m + self.street_m
        return np.asarray(self.street_m / 2 + period * np.arange(self.blocks + 1))

    @property
    def buildings(self) -> Array:
        """(blocks^2, 4) rectangles x_min, y_min, x_max, y_max [m]; a block is one building."""
        low = self.street_m + (self.block_m + self.street_m) * np.arange(self.blocks)
        x, y = np.meshgrid(low, low, indexing="ij")
        corner = np.column_stack([x.ravel(), y.ravel()])
        return np.hstack([corner, corner + self.block_m])

    def lamp_posts(self, spacing_m: float, kerb_offset_m: float) -> Array:
        """(n, 2) positions along every street, ``spacing_m`` apart, on alternating sides [m].

        The first place is on the map's edge, and so is the last where the spacing divides the
        side. ``kerb_offset_m`` is the distance from the centre line; > 0, so that no vehicle on
        the centre line ever drives through an antenna."""
        if not 0 < kerb_offset_m <= self.street_m / 2:
            raise ValueError(
                f"kerb_offset_m must be in (0, {self.street_m / 2}] so that RSUs are beside the "
                f"centre line and inside the street, got {kerb_offset_m}"
            )
        if not 0 < spacing_m < self.side_m:
            raise ValueError(f"spacing_m must be in (0, {self.side_m}), got {spacing_m}")
        along = np.arange(0.0, self.side_m + spacing_m / 2, spacing_m)
        side = kerb_offset_m * np.where(np.arange(along.size) % 2 == 0, 1.0, -1.0)
        places = []
        for centre in self.centres_m:
            places.append(np.column_stack([along, centre + side]))  # west to east
            places.append(np.column_stack([centre + side, along]))  # south to north
        return np.vstack(places)


METIS_MADRID = StreetGrid(blocks=4, block_m=120.0, street_m=12.0)
"""METIS Madrid grid of fokin2020 section 2.4: 4 x 4 blocks of 120 m, 12 m streets; 540 m square,
25 crossings."""

METIS_RSU_SPACING_M = 60.0
"""fokin2020 section 2.4."""

METIS_KERB_OFFSET_M = 5.0
"""Distance of an RSU from the centre line: on the pavement, 1 m before the facade (our choice, the
paper gives none)."""
