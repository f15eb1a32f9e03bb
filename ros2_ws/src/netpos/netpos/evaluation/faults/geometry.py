"""What an RSU would measure of a place: the values an attacker needs for a lie that fits."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from netpos.messages.values import AngleConvention, Array, Field, RsuInfo, RsuMeasurement

SPEED_OF_LIGHT_MPS = 299_792_458.0


def measured_from(
    m: RsuMeasurement, true: Array, told: Array, scene: Mapping[str, RsuInfo]
) -> RsuMeasurement:
    """A measurement of a device at ``true`` (3,) m changed to one of a device at ``told``; its
    noise stays. Phases stay as they are."""
    rsu, reference = scene[m.rsu_id], scene.get(m.reference_rsu_id)
    before, after = (_quantities(rsu, reference, place) for place in (true, told))
    values = {name: getattr(m, name) + after[name] - before[name] for name in before}
    values["azimuth_rad"] = math.remainder(values["azimuth_rad"], 2.0 * math.pi)
    return replace(m, **values)


def _quantities(rsu: RsuInfo, reference: RsuInfo | None, place: Array) -> dict[str, float]:
    offset = place - rsu.position
    x, y, z = Rotation.from_quat(rsu.quaternion).inv().apply(offset).tolist()
    distance = math.sqrt(x * x + y * y + z * z)
    cone = rsu.angle_convention is AngleConvention.CONE
    differs = 0.0 if reference is None else float(np.linalg.norm(place - reference.position))
    return {
        "azimuth_rad": math.asin(y / distance) if cone else math.atan2(y, x),
        "elevation_rad": math.atan2(z, math.hypot(x, y)),
        "range_m": distance,
        "toa_s": distance / SPEED_OF_LIGHT_MPS,
        "tdoa_s": (distance - differs) / SPEED_OF_LIGHT_MPS,
    }


def shifted(m: RsuMeasurement, sds: float) -> RsuMeasurement:
    """Every quantity of a measurement ``sds`` standard deviations larger."""
    values = {}
    for field, (value, variance) in SCALARS.items():
        if m.fields & field:
            values[value] = getattr(m, value) + sds * math.sqrt(getattr(m, variance))
    if "azimuth_rad" in values:
        values["azimuth_rad"] = math.remainder(values["azimuth_rad"], 2.0 * math.pi)
    return replace(m, **values)


SCALARS = {
    Field.AZIMUTH: ("azimuth_rad", "azimuth_var"),
    Field.ELEVATION: ("elevation_rad", "elevation_var"),
    Field.TOA: ("toa_s", "toa_var"),
    Field.RANGE: ("range_m", "range_var"),
    Field.TDOA: ("tdoa_s", "tdoa_var"),
}
"""Value and variance of the quantities that a fault of values changes."""
