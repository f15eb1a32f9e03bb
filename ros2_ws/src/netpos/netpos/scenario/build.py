"""Turn a scenario into the arrays of the simulation."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from netpos.messages.values import RsuInfo
from netpos.radio.anchor import HALF_VIEW_RAD, TwoWayRanging
from netpos.radio.clocks import clock_tones
from netpos.radio.measure import Errors, Sight, Sites, los_model_number
from netpos.radio.noise import generator, stream_key
from netpos.radio.propagation import SPEED_OF_LIGHT_MPS
from netpos.scenario.load import ScenarioError, scenario_of_text
from netpos.scenario.measured import FixedErrors
from netpos.scenario.places import Grid, RsuUnit
from netpos.scenario.schema import Device, Scenario
from netpos.world.frames import quaternion_from_yaw, yaw_from_quaternion
from netpos.world.maps import METIS_KERB_OFFSET_M, METIS_MADRID, METIS_RSU_SPACING_M

Array = npt.NDArray[np.float64]


def buildings_of(scenario: Scenario) -> Array:
    """(k, 4) rectangles."""
    if scenario.world.map == "metis_madrid":
        return METIS_MADRID.buildings
    rows = [(b.x_min, b.y_min, b.x_max, b.y_max) for b in scenario.world.buildings]
    return np.array(rows, dtype=np.float64).reshape(-1, 4)


def buildings_of_text(text: str, path: Path) -> Array:
    """(k, 4) rectangles of the scenario in a recording; ``path`` is for error messages.

    None (k = 0) where the text is no scenario that this version reads: a map without buildings is
    then the honest one.
    """
    try:
        return buildings_of(scenario_of_text(text, path))
    except ScenarioError:
        return np.zeros((0, 4))


def rsus_of(scenario: Scenario) -> tuple[RsuInfo, ...]:
    """The RSUs, stamped with the start of the run."""
    clock = scenario.rsus.clock
    if clock is None or not clock.declared:
        return _placed(scenario)
    return tuple(
        rsu
        if rsu.rsu_id == clock.reference
        else replace(
            rsu,
            range_bias_sd_m=SPEED_OF_LIGHT_MPS * clock.sd_s,
            bias_correlation_time_s=clock.correlation_time_s,
        )
        for rsu in _placed(scenario)
    )


def _placed(scenario: Scenario) -> tuple[RsuInfo, ...]:
    if scenario.rsus.layout == "metis_madrid":
        places = METIS_MADRID.lamp_posts(METIS_RSU_SPACING_M, METIS_KERB_OFFSET_M)
        return tuple(
            RsuInfo(
                rsu_id=f"rsu_{i + 1:02d}",
                position=np.array([x, y, scenario.rsus.height_m]),
                stamp_ns=scenario.start_ns,
            )
            for i, (x, y) in enumerate(places)
        )
    if scenario.rsus.grid is not None:
        return _grid_rsus(scenario.rsus.grid, scenario)
    return tuple(_rsu_of(unit, scenario.start_ns) for unit in scenario.rsus.units)


def _rsu_of(unit: RsuUnit, stamp_ns: int) -> RsuInfo:
    return RsuInfo(
        rsu_id=unit.id,
        position=np.array(unit.position, dtype=np.float64),
        quaternion=quaternion_from_yaw(math.radians(unit.yaw_deg)),
        network=unit.network,
        baseline_m=unit.antennas.baseline_m if unit.antennas else 0.0,
        wavelength_m=unit.antennas.wavelength_m if unit.antennas else 0.0,
        stamp_ns=stamp_ns,
    )


def _grid_rsus(grid: Grid, scenario: Scenario) -> tuple[RsuInfo, ...]:
    """Row by row from the south-west, heights from the stream ``rsus/height``."""
    count = grid.columns * grid.rows
    low, high = grid.height_min_m, grid.height_max_m
    heights = generator(scenario.seed, "rsus/height").uniform(low, high, count)
    return tuple(
        RsuInfo(
            rsu_id=f"rsu_{i + 1:03d}",
            position=np.array(
                [
                    grid.x_min + grid.spacing_m * (i % grid.columns),
                    grid.y_min + grid.spacing_m * (i // grid.columns),
                    height,
                ]
            ),
            stamp_ns=scenario.start_ns,
        )
        for i, height in enumerate(heights.tolist())
    )


def rotations_of(rsus: tuple[RsuInfo, ...]) -> Array:
    """(m, 3, 3) from map to the RSUs' axes."""
    rotations = np.empty((len(rsus), 3, 3))
    for i, rsu in enumerate(rsus):
        yaw = float(yaw_from_quaternion(rsu.quaternion))
        c, s = math.cos(yaw), math.sin(yaw)
        rotations[i] = [[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]
    return rotations


def clock_tones_of(scenario: Scenario, rsus: tuple[RsuInfo, ...]) -> Array:
    """(m, k, 3) of the RSUs' clocks; k = 0 where they are perfect.

    Raises
    ------
    ValueError  the reference is none of the RSUs
    """
    clock = scenario.rsus.clock
    if clock is None:
        return np.zeros((len(rsus), 0, 3))
    ids = [rsu.rsu_id for rsu in rsus]
    if clock.reference is not None and clock.reference not in ids:
        raise ValueError(
            f"rsus.clock.reference {clock.reference!r} is not one of the RSUs: {', '.join(ids)}"
        )
    return np.array([clock_tones(clock, scenario.seed, rsu_id) for rsu_id in ids])


def sites_of(
    rsus: tuple[RsuInfo, ...],
    rotations: Array,
    tones: Array,
    seed: int,
    vue_id: str,
    two_way: TwoWayRanging | None = None,
) -> Sites:
    """The RSUs for one device: positions, rotations of ``rotations_of``, clocks of
    ``clock_tones_of``, noise streams, range errors of ``two_way`` ranging by the clocks' drift."""
    residuals = np.array([_residual(two_way, seed, f"{r.rsu_id}/{vue_id}") for r in rsus])
    return Sites(
        position=np.array([rsu.position for rsu in rsus]),
        rotation=rotations,
        noise_key=np.array([stream_key(seed, f"{r.rsu_id}/{vue_id}/noise") for r in rsus]),
        sight_key=np.array([stream_key(seed, f"{r.rsu_id}/{vue_id}/sight") for r in rsus]),
        clock_tones=tones,
        baseline_m=np.array([rsu.baseline_m for rsu in rsus]),
        wavelength_m=np.array([rsu.wavelength_m for rsu in rsus]),
        range_scale=residuals[:, 0],
        range_offset_m=residuals[:, 1],
    )


def _residual(two_way: TwoWayRanging | None, seed: int, link: str) -> tuple[float, float]:
    """Scale and offset [m] of the ranges between one RSU and one device."""
    if two_way is None:
        return 0.0, 0.0
    device, anchor = two_way.drift_sd * generator(seed, f"{link}/two_way_ranging").standard_normal(
        2
    )
    return two_way.residual(float(device), float(anchor))


def two_way_of(scenario: Scenario) -> TwoWayRanging | None:
    """Two-way ranging of the scenario, None without it."""
    errors = scenario.measurement.errors
    return errors.two_way_ranging if isinstance(errors, FixedErrors) else None


def sight_of(scenario: Scenario, device: Device) -> Sight:
    """Which RSUs may hear the device."""
    los = scenario.measurement.los
    return Sight(
        nearest=scenario.measurement.nearest,
        max_distance_m=los.max_distance_m or math.inf,
        buildings=buildings_of(scenario),
        model=los_model_number(los.probability),
        correlation_m=los.correlation_distance_m,
        device_height_m=device.antenna_height_m,
        fewest=scenario.measurement.fewest or scenario.measurement.nearest,
    )


def errors_of(scenario: Scenario) -> Errors:
    """Variances of the measurements."""
    errors = scenario.measurement.errors
    if isinstance(errors, FixedErrors):
        sds = [
            math.radians(errors.azimuth_sd_deg or 0.0),
            math.radians(errors.elevation_sd_deg or 0.0),
            errors.toa_sd_s or 0.0,
            errors.two_way_ranging.range_sd_m
            if errors.two_way_ranging
            else errors.range_sd_m or 0.0,
            math.radians(errors.phase_sd_deg or 0.0),
        ]
        phase = "phase" in scenario.measurement.quantities
        return Errors(
            fixed=np.square(sds),
            with_elevation=False,
            snr_at_0_db_loss=0.0,
            path_loss=np.zeros(5),
            second_moment=np.zeros((3, 3)),
            rms_bandwidth_hz=0.0,
            half_view_rad=HALF_VIEW_RAD if phase else math.pi,
            tx_power_dbm=0.0,
        )
    waveform, array = errors.waveform, errors.array
    return Errors(
        fixed=np.zeros(5),
        with_elevation="elevation" in scenario.measurement.quantities,
        snr_at_0_db_loss=array.count * waveform.energy_snr_at_0_db_loss,
        path_loss=errors.path_loss.coefficients(waveform.carrier_hz),
        second_moment=array.second_moment(),
        rms_bandwidth_hz=waveform.rms_bandwidth_hz,
        half_view_rad=array.half_view_rad,
        tx_power_dbm=waveform.tx_power_dbm,
    )
