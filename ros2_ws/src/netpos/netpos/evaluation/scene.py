"""What stands around the track: the buildings of the scenario a bag was made from."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from netpos.messages.values import Array


def buildings_of(metadata: Mapping[str, str]) -> Array:
    """(k, 4) rectangles x_min, y_min, x_max, y_max [m] of the scenario the bag names.

    None (k = 0) where the bag names no scenario, or one that is not installed: a map without
    buildings is then the honest one.
    """
    from netpos.scenario import load_scenario, scenario_names  # noqa: PLC0415 - slow to load
    from netpos.scenario.build import buildings_of as buildings_of_scenario  # noqa: PLC0415

    name = metadata.get("scenario")
    if name is None or name not in scenario_names():
        return np.zeros((0, 4))
    return buildings_of_scenario(load_scenario(name))
