"""The sector of a phase difference by the direction of one step: the rule of petukhov:eq.9-18.

Every sector turns the ranges and phases of a step into a track; the one whose direction agrees
with the heading of dead reckoning is taken, smoothed over the sectors by a parabola. Kept for
comparison: it uses one step's direction only and is sure of every answer.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from netpos.messages.values import Array

Ints = npt.NDArray[np.int64]


class Choice(NamedTuple):
    """What the rule saw: sectors (k,) that have a track, direction residuals (k,) [rad], the
    parabola's coefficients (a, b, c) and the sector chosen, in turns of the first phase."""

    turns: Ints
    residuals: Array
    parabola: Array
    chosen: int


def sector_numbers(wavelengths: float) -> Ints:
    """Numbers of all sectors, symmetric about 0 (petukhov:eq.10, 11)."""
    half = math.floor(wavelengths + 1e-9)
    return np.arange(-half, half + 1)


def sector_tracks(
    ranges_m: Array, phases_rad: Array, turns: Ints, baseline_m: float, wavelength_m: float
) -> Array:
    """Positions (k, n, 2), x along the array and y ahead of it, of ranges (n,) to the master and
    continuous phases (n,) with ``turns`` (k,) added; NaN where there is none (petukhov:eq.9, 14,
    15, 16)."""
    path = (phases_rad + 2.0 * math.pi * turns[:, None]) * wavelength_m / (2.0 * math.pi)
    x = path / baseline_m * (ranges_m + path / 2.0)
    square = (ranges_m + path) ** 2 - (x + baseline_m / 2.0) ** 2
    y = np.sqrt(np.where(square > 0.0, square, np.nan))
    return np.stack([x, y], axis=-1)


def choose_sector(
    times_s: Array,
    ranges_m: Array,
    phases_rad: Array,
    heading_rad: float,
    baseline_m: float,
    wavelength_m: float,
) -> Choice | None:
    """The sector of a step's measurements; None where fewer than two, or no sector has a track.

    times_s, ranges_m, phases_rad : (n,); the phases are made continuous first, which the paper
        does not say and a step across a wrap needs
    heading_rad : of the step, counter-clockwise from the array's x axis
    """
    if len(times_s) < 2:
        return None
    turns = sector_numbers(baseline_m / wavelength_m)
    tracks = sector_tracks(ranges_m, np.unwrap(phases_rad), turns, baseline_m, wavelength_m)
    real = np.isfinite(tracks).all(axis=(1, 2))
    if not real.any():
        return None
    turns, tracks = turns[real], tracks[real]
    centred = times_s - times_s.mean()
    slope = np.einsum("n,knd->kd", centred, tracks) / (centred @ centred)  # least-squares lines
    direction = np.arctan2(slope[:, 1], slope[:, 0])  # petukhov:eq.17
    off = direction - heading_rad
    residuals = np.abs(np.arctan2(np.sin(off), np.cos(off)))
    if len(turns) < 3:
        return Choice(turns, residuals, np.full(3, np.nan), int(turns[np.argmin(residuals)]))
    parabola = np.polyfit(turns, residuals, 2)
    return Choice(turns, residuals, parabola, _lowest(parabola, turns))


def _lowest(parabola: Array, turns: Ints) -> int:
    """Whole number next to the parabola's lowest point among ``turns`` (petukhov:eq.18)."""
    a, b, _ = parabola
    if a > 0.0:
        return int(np.clip(round(-b / (2.0 * a)), turns[0], turns[-1]))
    ends = np.polyval(parabola, turns[[0, -1]])
    return int(turns[0] if ends[0] < ends[1] else turns[-1])
