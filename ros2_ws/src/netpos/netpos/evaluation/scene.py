"""Surroundings of a track: the buildings of the scenario from which a bag was made."""

from __future__ import annotations

import numpy as np

from netpos.bags import BagReader
from netpos.messages.values import Array


def buildings_of(bag: BagReader) -> Array:
    """(k, 4) rectangles x_min, y_min, x_max, y_max [m] of the scenario in the bag.

    None (k = 0) where the bag holds no scenario, or none that this version reads: a map without
    buildings is then the honest one.
    """
    from netpos.scenario.build import buildings_of_text  # noqa: PLC0415 - slow

    texts = bag.facts.get("scenario", ())
    return buildings_of_text(texts[-1], bag.path) if texts else np.zeros((0, 4))
