"""Pictures of petukhov: Figs. 7, 8, 9, and how often the right sector is found."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from netpos.estimation.state import POSITION
from netpos.evaluation.pictures import RSU_COLOUR, TRACK_COLOURS, save
from netpos.messages.values import Array
from netpos.radio.anchor import uwb_wavelength_m
from netpos.reproduction.petukhov.rectangle import Walked
from netpos.reproduction.petukhov.sector_choice import Conditions, SectorShares
from netpos.tracking.first_fix.step_heading import choose_sector

__all__ = ["errors", "residuals", "save", "success", "tracks"]

_TRUTH_COLOUR = "#444444"
_START, _HEADING = (0.4, 4.0), math.radians(70.0)


def residuals(seed: int) -> Figure:
    """Fig. 7: residual of every sector's direction, without noise and as measured, and the
    parabola through the measured ones, for 4 and 8 wavelengths."""
    figure = Figure(figsize=(9.0, 3.8), layout="constrained")
    rng = np.random.default_rng(seed)
    for axes, wavelengths in zip(figure.subplots(1, 2), (4.0, 8.0), strict=True):
        _residuals_of_a_step(axes, wavelengths, rng)
    return figure


def _residuals_of_a_step(axes: Axes, wavelengths: float, rng: np.random.Generator) -> None:
    wavelength_m = uwb_wavelength_m(5)
    baseline_m = wavelengths * wavelength_m
    times = 0.1 * np.arange(7, dtype=np.float64)
    way = np.array([math.cos(_HEADING), math.sin(_HEADING)])
    x, y = (np.array(_START) + times[:, None] * way).T
    ranges = np.hypot(x - baseline_m / 2, y)
    phases = 2 * math.pi * wavelengths * np.sin(np.arctan2(x, y))
    noisy = ranges + 0.03 * rng.standard_normal(7)
    turned = phases + math.radians(6.0) * rng.standard_normal(7)
    heading = _HEADING + math.radians(3.0) * float(rng.standard_normal())
    ideal = choose_sector(times, ranges, phases, _HEADING, baseline_m, wavelength_m)
    real = choose_sector(times, noisy, turned, heading, baseline_m, wavelength_m)
    if ideal is not None:
        axes.plot(ideal.turns, np.degrees(ideal.residuals), "o", mfc="none", label="without noise")
    if real is not None:
        m = np.linspace(real.turns[0], real.turns[-1], 200)
        colour = TRACK_COLOURS[1]
        axes.plot(real.turns, np.degrees(real.residuals), "s", color=colour, label="measured")
        axes.plot(m, np.degrees(np.polyval(real.parabola, m)), color=colour, label="parabola")
        axes.axvline(real.chosen, color=colour, lw=0.8, ls=":", label="chosen by the rule")
    axes.axvline(0.0, color=_TRUTH_COLOUR, lw=0.8, label="true sector")
    axes.set(xlabel="sector", ylabel="residual of the direction [°]")
    axes.set_title(f"L = {wavelengths:g} λ")
    axes.legend(frameon=False, fontsize=8)


def tracks(runs: Mapping[str, Walked]) -> Figure:
    """Fig. 8: the rectangle as estimated with both baselines."""
    figure = Figure(figsize=(6.4, 5.4), layout="constrained")
    axes = figure.subplots()
    truth = next(iter(runs.values())).truth
    axes.plot(*truth.T, color=_TRUTH_COLOUR, lw=1.0, label="truth")
    for (name, run), colour in zip(runs.items(), TRACK_COLOURS, strict=False):
        places = np.where(run.decided[:, None], run.mean[:, POSITION], np.nan)
        axes.plot(*places.T, ".-", ms=3, lw=0.8, color=colour, label=name)
    axes.plot(0.0, 0.0, "^", color=RSU_COLOUR, label="anchor")
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes.legend(frameon=False, fontsize=8)
    return figure


def errors(times_s: Array, one: Mapping[str, Array], every: Mapping[str, Array]) -> Figure:
    """Fig. 9: errors over time, of one run (thin) and RMSE over all (thick).

    one : (n,) m; every : (runs, n) m^2
    """
    figure = Figure(figsize=(7.5, 3.8), layout="constrained")
    axes = figure.subplots()
    for (name, error), colour in zip(one.items(), TRACK_COLOURS, strict=False):
        decided = np.isfinite(every[name]).mean(axis=0) > 0.5
        rmse = np.full(len(times_s), np.nan)
        rmse[decided] = np.sqrt(np.nanmean(every[name][:, decided], axis=0))
        axes.plot(times_s, 100 * error, color=colour, lw=0.6, alpha=0.6)
        axes.plot(times_s, 100 * rmse, color=colour, lw=1.8, label=name)
    axes.axhline(3.0, color="#999999", lw=0.8, ls=":")
    axes.set(xlabel="time [s]", ylabel="position error [cm]", ylim=(0.0, None))
    axes.legend(frameon=False, fontsize=8)
    return figure


def success(
    by_baseline: Sequence[tuple[Conditions, SectorShares]],
    by_phase: Sequence[tuple[Conditions, SectorShares]],
) -> Figure:
    """Share of starts in the right sector against baseline and phase noise, the paper's rule
    beside ours."""
    figure = Figure(figsize=(9.5, 4.0), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    _shares(left, [c.wavelengths for c, _ in by_baseline], [f for _, f in by_baseline])
    left.set(xlabel="baseline [wavelengths]", ylabel="share in the right sector", ylim=(0, 1.02))
    left.set_title("phase sd 6°")
    _shares(right, [c.phase_sd_deg for c, _ in by_phase], [f for _, f in by_phase])
    right.set(xlabel="phase sd [°]")
    right.set_title("L = 4 λ")
    right.legend(frameon=False, fontsize=8, loc="lower left")
    return figure


def _shares(axes: Axes, x: Sequence[float], choices: Sequence[SectorShares]) -> None:
    for step, colour in zip((1, 2, 5), TRACK_COLOURS, strict=False):
        label = f"hypotheses, {step} step" + ("s" if step > 1 else "")
        axes.plot(x, [f.share_right(step) for f in choices], "o-", color=colour, label=label)
    axes.plot(x, [f.rule_share for f in choices], "s--", color=_TRUTH_COLOUR, label="paper's rule")
