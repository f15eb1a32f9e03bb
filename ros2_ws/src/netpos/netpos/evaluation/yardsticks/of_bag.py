"""Measurements of a bag as neutral arrays: the same input as the tracker's."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from netpos.bags import BagReader, codec
from netpos.estimation.motion import SPEED_OF_LIGHT_MPS
from netpos.evaluation.yardsticks.observations import Kind, Observations
from netpos.messages import topics
from netpos.messages.values import AngleConvention, Array, Field, RsuInfo, RsuMeasurement

_Row = tuple[Kind, float, float]


def observations_of_bag(
    path: Path,
    vue_id: str = "vue_1",
    *,
    range_sd_m: float | None = None,
    kinds: Collection[Kind] = tuple(Kind),
) -> Observations:
    """Azimuths, elevations, ranges and time differences of one device in stamp order; see
    ``observations_of_devices``."""
    return observations_of_devices(path, [vue_id], range_sd_m=range_sd_m, kinds=kinds)[vue_id]


def observations_of_devices(
    path: Path,
    vue_ids: Iterable[str],
    *,
    range_sd_m: float | None = None,
    kinds: Collection[Kind] = tuple(Kind),
) -> dict[str, Observations]:
    """Azimuths, elevations, ranges and time differences of each device in stamp order.

    The sd holds all that the RSU states, noise and biases, as if it were white noise;
    ``range_sd_m`` is used in its place for ranges. TOA, phases and position fixes are left out:
    they need a clock, a sector, or nothing at all.

    Raises
    ------
    BagError  not a bag, or one without RSUs or measurements
    ValueError  no measurement of a device that these kinds take
    """
    with BagReader(path) as bag:
        infos = [codec().rsu_info_from_msg(e.message) for e in bag.messages([topics.RSU_INFO])]
        heard = [
            codec().measurement_from_msg(e.message)
            for e in bag.messages([topics.RSU_MEASUREMENTS])
        ]
    known = {info.rsu_id: info for info in infos}
    axes = {i.rsu_id: Rotation.from_quat(i.quaternion).as_matrix().T for i in infos}
    rows: dict[str, list[tuple[RsuMeasurement, _Row]]] = {vue_id: [] for vue_id in vue_ids}
    for m in sorted(heard, key=lambda m: (m.stamp_ns, m.rsu_id)):
        if m.vue_id in rows and m.rsu_id in known:
            found = _rows(m, known[m.rsu_id], range_sd_m)
            rows[m.vue_id] += [(m, row) for row in found if row[0] in kinds]
    for vue_id, of_it in rows.items():
        if not of_it:
            raise ValueError(
                f"{path} has no azimuth, elevation, range or time difference of {vue_id!r}"
            )
    return {vue_id: _observations(of_it, known, axes) for vue_id, of_it in rows.items()}


def _observations(
    rows: list[tuple[RsuMeasurement, _Row]],
    known: Mapping[str, RsuInfo],
    axes: Mapping[str, Array],
) -> Observations:
    return Observations(
        stamp_ns=np.array([m.stamp_ns for m, _ in rows], dtype=np.int64),
        kind=np.array([row[0] for _, row in rows], dtype=np.int64),
        value=np.array([row[1] for _, row in rows]),
        sd=np.array([row[2] for _, row in rows]),
        rsu=np.array([known[m.rsu_id].position for m, _ in rows]),
        other=np.array([_reference(m, known).position for m, _ in rows]),
        axes=np.array([axes[m.rsu_id] for m, _ in rows]),
        lever_arm=_lever_arms([m for m, _ in rows]),
    )


def _lever_arms(measured: list[RsuMeasurement]) -> Array:
    """(n, 3) m; zero where all are of one antenna, whose place is then the device's."""
    arms = np.array([m.lever_arm for m in measured])
    return arms if np.ptp(arms, axis=0).any() else np.zeros_like(arms)


def _reference(m: RsuMeasurement, known: Mapping[str, RsuInfo]) -> RsuInfo:
    """The RSU that a time difference counts from; that of the measurement itself where there is
    none."""
    return known[m.reference_rsu_id if m.fields & Field.TDOA else m.rsu_id]


def _rows(m: RsuMeasurement, info: RsuInfo, range_sd_m: float | None) -> Iterator[_Row]:
    cone = info.angle_convention is AngleConvention.CONE
    if m.fields & Field.AZIMUTH and m.azimuth_var > 0:
        scale = math.cos(m.azimuth_rad) if cone else 1.0
        sd = math.hypot(math.sqrt(m.azimuth_var), info.azimuth_bias_sd_rad / scale)
        yield (Kind.AZIMUTH_CONE if cone else Kind.AZIMUTH), m.azimuth_rad, sd
    if m.fields & Field.ELEVATION and m.elevation_var > 0:
        scale = math.cos(m.elevation_rad) if cone else 1.0
        sd = math.hypot(math.sqrt(m.elevation_var), info.elevation_bias_sd_rad / scale)
        yield Kind.ELEVATION, m.elevation_rad, sd
    if m.fields & Field.RANGE and m.range_var > 0:
        biases = math.hypot(info.range_bias_sd_m, info.common_range_bias_sd_m)
        sd = range_sd_m or math.hypot(math.sqrt(m.range_var), biases)
        yield Kind.RANGE, m.range_m, sd
    if m.fields & Field.TDOA and m.tdoa_var > 0:
        clock_sd_m = math.sqrt(2.0) * info.range_bias_sd_m
        sd = range_sd_m or math.hypot(SPEED_OF_LIGHT_MPS * math.sqrt(m.tdoa_var), clock_sd_m)
        yield Kind.TDOA, -SPEED_OF_LIGHT_MPS * m.tdoa_s, sd
