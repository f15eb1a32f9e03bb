"""Path loss of the direct path, and the chance that there is one."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import numpy.typing as npt
from numba import njit
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from netpos.radio.noise import Key, draw_normals

Array = npt.NDArray[np.float64]
LosModel = Literal["uma", "umi", "rma", "inh"]

SPEED_OF_LIGHT_MPS = 299_792_458.0
LOS_MODELS: tuple[LosModel, ...] = ("uma", "umi", "rma", "inh")
UMA_LOW_DEVICE_M = 13.0
UMA_HIGHEST_DEVICE_M = 23.0


@dataclass(
    frozen=True, slots=True, kw_only=True, config=ConfigDict(extra="forbid", allow_inf_nan=False)
)
class PathLoss:
    """Line-of-sight path loss ``A + B log10(d / 1 m)``, with a second branch beyond a break point.

    ``free_space``: Friis. ``umi``: Report ITU-R M.2412-0 annex 1, UMi_B, LOS: PL1 below the break
    point ``4 (h_rsu - 1)(h_device - 1) f / c``, PL2 beyond. Heights are those of the formula (the
    simulated world may be plane). Distances below 1 m count as 1 m."""

    model: Literal["umi", "free_space"] = "umi"
    rsu_height_m: float = Field(default=10.0, gt=1)
    device_height_m: float = Field(default=1.5, gt=1)

    def coefficients(self, carrier_hz: float) -> Array:
        """(5,) A1, B1, break point [m], A2, B2 (dB with d in m)."""
        carrier_db = 20 * math.log10(carrier_hz / 1e9)
        if self.model == "free_space":
            intercept = 20 * math.log10(4 * math.pi * carrier_hz / SPEED_OF_LIGHT_MPS)
            return np.array([intercept, 20.0, math.inf, intercept, 20.0])
        break_m = (
            4
            * (self.rsu_height_m - 1)
            * (self.device_height_m - 1)
            * carrier_hz
            / SPEED_OF_LIGHT_MPS
        )
        far = (
            32.4
            + carrier_db
            - 9.5 * math.log10(break_m**2 + (self.rsu_height_m - self.device_height_m) ** 2)
        )
        return np.array([32.4 + carrier_db, 21.0, break_m, far, 40.0])


@njit(cache=True)
def path_loss_db(distance_m: float, coefficients: Array) -> float:
    """Path loss [dB] at a distance [m] from ``PathLoss.coefficients``."""
    log_d = math.log10(max(distance_m, 1.0))
    if distance_m <= coefficients[2]:
        return float(coefficients[0] + coefficients[1] * log_d)
    return float(coefficients[3] + coefficients[4] * log_d)


@njit(cache=True)
def _uma(d: float, device_height: float) -> float:
    if d <= 18.0:
        return 1.0
    near = 18.0 / d + math.exp(-d / 63.0) * (1.0 - 18.0 / d)
    if device_height <= UMA_LOW_DEVICE_M:
        return float(near)
    gain = ((device_height - 13.0) / 10.0) ** 1.5
    high = near * (1.0 + gain * 1.25 * (d / 100.0) ** 3 * math.exp(-d / 150.0))
    return float(min(high, 1.0))


@njit(cache=True)
def los_chance(model: int, d: float, device_height: float) -> float:
    """Probability of line of sight of model number ``model`` (index into LOS_MODELS) at a plane
    distance d [m]."""
    if model == 0:
        return float(_uma(d, device_height))
    if model == 1:
        return 1.0 if d <= 18.0 else 18.0 / d + math.exp(-d / 36.0) * (1.0 - 18.0 / d)
    if model == 2:
        return 1.0 if d <= 10.0 else math.exp(-(d - 10.0) / 1000.0)
    if d <= 5.0:
        return 1.0
    if d <= 49.0:
        return math.exp(-(d - 5.0) / 70.8)
    return 0.54 * math.exp(-(d - 49.0) / 211.7)


def los_probability(
    model: LosModel, distance_m: npt.ArrayLike, device_height_m: float = 1.5
) -> Array:
    """Probability of line of sight at plane distances (n,) [m] (fokin2020:table.1, Report ITU-R
    M.2412-0 annex 1).

    uma, umi, rma, inh (indoor hotspot). RMa is ``exp(-(d - 10)/1000)``: the further factor printed
    in fokin2020 is a misprint (negative below 18 m); and UMa's height term has d/100, where the
    paper prints d/63, which matters above 13 m only.

    Raises
    ------
    ValueError  unknown model, negative or non-finite distance, device height outside (0, 23] m
    """
    if model not in LOS_MODELS:
        raise ValueError(f"LOS model must be one of {', '.join(LOS_MODELS)}, got {model!r}")
    d = np.atleast_1d(np.asarray(distance_m, dtype=np.float64))
    if not (np.isfinite(d) & (d >= 0)).all():
        raise ValueError(f"distances must be finite and >= 0, got {d}")
    if not 0 < device_height_m <= UMA_HIGHEST_DEVICE_M:
        raise ValueError(f"device height must be in (0, 23] m, got {device_height_m}")
    number = LOS_MODELS.index(model)
    return np.array([los_chance(number, float(x), device_height_m) for x in d])


@njit(cache=True)
def smooth_uniform(x: float, y: float, spacing_m: float, key: Key) -> float:
    """A uniform variate in (0, 1) that varies smoothly over the plane, and is a pure function of
    (key, place).

    Independent standard normals sit on a lattice of the correlation distance; bilinear weights mix
    the four around the place and are normalised to unit variance; the normal distribution function
    makes the mix uniform. So a device that stands still or comes back keeps its line-of-sight
    state, as in the soft LOS state of 3GPP TR 38.901 section 7.6.3.3."""
    column, row = math.floor(x / spacing_m), math.floor(y / spacing_m)
    u, v = x / spacing_m - column, y / spacing_m - row
    total = 0.0
    power = 0.0
    for i in range(2):
        for j in range(2):
            weight = (u if i else 1.0 - u) * (v if j else 1.0 - v)
            total += weight * draw_normals(column + i, row + j, 0, key)[0]
            power += weight * weight
    return 0.5 * math.erfc(-total / math.sqrt(2.0 * power))
