"""The headline of petukhov: rows of the whole chain, in which a step's velocity comes after the
step."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from netpos.evaluation.work import Work
from netpos.reproduction.frame import Row, at_least, at_most, required, shown
from netpos.reproduction.petukhov import rectangle
from netpos.reproduction.petukhov.waist_chain import Chains, Variant, follow, run_chains, simulate
from netpos.reproduction.petukhov.walk_figures import (
    FAR_M,
    LOST_M,
    Figures,
    ratio_at_same_instants,
)

RUNS = 300  # at most: every run simulates an IMU and is followed by six trackers
RMSE_M, RATIO, LIVE_RMSE_M = 0.03, 2.0, 0.12
LONG, SHORT = 4.0, 0.5

PAPER_FILTER = (
    ("process_noise", "werner"),
    ("manoeuvre_speed_sd_mps", 0.0),
    ("steady_accel_density_mps2_sqrthz", 0.0),
    ("velocity_step_sd_mps", 0.1),  # sigma_xi = 1 m/s^2 over T = 0.1 s (petukhov:eq.2, 4, 23)
    ("velocity_correlation_s", 0.0),
    ("gate_probability", 1.0),
)
PAPER = (("ambiguity", "step_heading"), *PAPER_FILTER)
"""The scheme of the paper over the scenario's parameters."""

SCHEME = Variant(name="paper's scheme", settings=PAPER)
FILTER = Variant(name="paper's filter, sector by hypotheses", settings=PAPER_FILTER)
LOOSE = Variant(name="loose")
# The IMU's forward acceleration is not all there is: a turn on the spot may have to be revealed.
TIGHT = Variant(
    name="tight",
    settings=(("motion_model", "inertial"), ("inertial_manoeuvre_speed_sd_mps", 0.3)),
)
_DEFAULTS = {
    LOOSE.name: Variant(name="loose, defaults", defaults=True),
    TIGHT.name: Variant(
        name="tight, defaults", settings=(("motion_model", "inertial"),), defaults=True
    ),
}
VARIANTS = (LOOSE, TIGHT, SCHEME, FILTER, *_DEFAULTS.values())


def warm_up() -> None:
    """Compile, or load, every kernel."""
    for wavelengths in (LONG, SHORT):
        walk = simulate(0, wavelengths)
        for variant in VARIANTS:
            follow(walk, variant)


def rows(work: Work) -> Iterator[Row]:
    """Loose and tight, each beside the paper's scheme and the library's defaults on the same
    walks."""
    few = work.with_runs(min(work.runs, RUNS))
    long, short = (run_chains(few, wavelengths, VARIANTS) for wavelengths in (LONG, SHORT))
    for variant in (TIGHT, LOOSE):
        yield from _headline(variant.name, long, short)
    for variant in (TIGHT, LOOSE):
        for chains, label in ((long, "L = 4 lambda"), (short, "L = lambda/2")):
            yield from _details(f"{_label(variant.name)}, {label}", *_beside(variant.name, chains))
    sectors = long.figures[FILTER.name]
    yield shown(f"{_label(FILTER.name)}, L = 4 lambda: RMSE", "m", sectors.rmse_m)
    name = f"{_label(FILTER.name)}, L = 4 lambda: NEES, mean (expected 2)"
    yield shown(name, "1", sectors.nees.mean)
    complete = np.concatenate([long.detected_steps, short.detected_steps]) == rectangle.STEPS
    name = "whole chain: runs with all 32 steps found"
    yield required(name, "1", float(complete.mean()), bool(complete.all()))


def _label(name: str) -> str:
    return f"whole chain from the IMU, {name}"


def _beside(name: str, chains: Chains) -> tuple[Figures, Figures, Figures]:
    """Figures of a variant, of the paper's scheme and of the defaults."""
    figures = chains.figures
    return figures[name], figures[SCHEME.name], figures[_DEFAULTS[name].name]


def _headline(name: str, long: Chains, short: Chains) -> Iterator[Row]:
    """What the paper claims: its simulation, the gain of the long baseline and its live walk."""
    ours, paper, defaults = (figures.rmse_m for figures in _beside(name, long))
    label = f"{_label(name)}, L = 4 lambda"
    row = at_most(f"{label}: RMSE (paper: simulated)", "m", ours, RMSE_M)
    yield row.beside(paper, defaults)
    row = at_most(f"{label}: RMSE (paper: live)", "m", ours, LIVE_RMSE_M)
    yield row.beside(paper, defaults)
    ratios = (
        ratio_at_same_instants(above, below)
        for above, below in zip(_beside(name, short), _beside(name, long), strict=True)
    )
    gain, paper_gain, default_gain = ratios
    title = f"{_label(name)}: RMSE of lambda/2 over that of 4 lambda, at the same instants"
    yield at_least(title, "1", gain, RATIO).beside(paper_gain, default_gain)
    ours, paper, defaults = (figures.rmse_m for figures in _beside(name, short))
    row = shown(f"{_label(name)}, L = lambda/2: RMSE", "m", ours)
    yield row.beside(paper, defaults)


def _details(label: str, ours: Figures, paper: Figures, defaults: Figures) -> Iterator[Row]:
    """Errors, consistency, time not scored and lost runs."""
    row = shown(f"{label}: RMSE of the median run", "m", ours.median_rmse_m)
    yield row.beside(paper.median_rmse_m, defaults.median_rmse_m)
    row = shown(f"{label}: largest error", "m", ours.error_max_m)
    yield row.beside(paper.error_max_m, defaults.error_max_m)
    name = f"{label}: NEES, mean (expected 2)"
    row = required(name, "1", ours.nees.mean, ours.nees.consistent)
    yield row.beside(paper.nees.mean, defaults.nees.mean)
    for i, what in enumerate(("mean", "95 % of runs")):
        row = shown(f"{label}: time before the sector is decided, {what}", "s", ours.decided_s[i])
        yield row.beside(paper.decided_s[i], defaults.decided_s[i])
    row = shown(f"{label}: share of instants not scored", "1", ours.unscored)
    yield row.beside(paper.unscored, defaults.unscored)
    for limit in (LOST_M, FAR_M):
        name = f"{label}: share of runs with an error above {limit:g} m"
        row = shown(name, "1", ours.share_above(limit))
        yield row.beside(paper.share_above(limit), defaults.share_above(limit))
    row = required(f"{label}: runs lost at their end", "1", ours.lost, ours.lost == 0)
    yield row.beside(paper.lost, defaults.lost)
