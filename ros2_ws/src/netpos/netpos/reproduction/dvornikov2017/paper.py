"""dvornikov2017: several networks, one track.

The paper simulates the secondary stage of two networks; the tertiary stage is its future work, and
everything about it here has a target of our own. The column of the paper's filter is the better
network by that filter: floor under the gain, Q = 0.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from netpos.estimation.forms.kf import DVORNIKOV_FLOOR
from netpos.estimation.intersection import METHODS
from netpos.evaluation.work import Work
from netpos.reproduction.dvornikov2017 import pictures as network_pictures
from netpos.reproduction.dvornikov2017.claims import (
    FUSED,
    LIMIT_FROM_S,
    Sides,
    claims,
    gain_rows,
    lost_rows,
)
from netpos.reproduction.dvornikov2017.crossing import (
    OBJECTS,
    Crossing,
    CrossingRun,
    crossings_of_seeds,
    run_crossing,
)
from netpos.reproduction.dvornikov2017.defaults import FUSION, TRACKER, summarise_defaults
from netpos.reproduction.dvornikov2017.stages import CENTRAL, FixNetwork, Setting, stages_of
from netpos.reproduction.dvornikov2017.summary import NetworkSummary, summarise
from netpos.reproduction.dvornikov2017.truth import Jerky, Quadratic
from netpos.reproduction.frame import Outcome, Row, at_least, required, shown
from netpos.tracking.config import TrackerConfig
from netpos.tracking.networks.config import FusionConfig

NO_SWAP_SHARE = 0.99

WIMAX = FixNetwork(name="wimax", sd_m=3.0, phase_s=0.2)
WIFI = FixNetwork(name="wifi", sd_m=10.0)
_FLOOR = {
    "position_gain_min": float(DVORNIKOV_FLOOR[0]),
    "velocity_gain_min": float(DVORNIKOV_FLOOR[1]),
    "accel_gain_min": float(DVORNIKOV_FLOOR[2]),
}
DEAF = TrackerConfig(
    filter="kf",
    motion_model="constant_acceleration",
    jerk_density=0.0,
    gate_probability=1.0,
)
"""dvornikov2017:eq.6 with Q = 0: the gain goes to 0."""
FLOORED = replace(DEAF, **_FLOOR)  # type: ignore[arg-type]
JERK = 0.3  # m/s^3/sqrt(Hz)
JERKY = replace(DEAF, jerk_density=JERK)  # type: ignore[call-arg]

PAPER = Setting(
    name="paper's motion, gain floor",
    networks=(WIMAX, WIFI),
    tracker=FLOORED,
    truth=Quadratic((10680.0, 3700.0), (-8.2, 23.6), ((181.0, (-0.125, 1.82)),)),
    duration_s=180.0,
)
PAPER_DEAF = replace(PAPER, name="paper's motion, no floor", tracker=DEAF)
COMMON_NOISE = Setting(
    name="motion noise that both networks share",
    networks=(WIMAX, WIFI),
    tracker=JERKY,
    truth=Jerky((10.0, 5.0), JERK, 180.0),
    duration_s=180.0,
)
COMMON_FLOORED = replace(
    COMMON_NOISE, name="motion noise that both networks share, floor", tracker=FLOORED
)

# Steady, 5 s of acceleration, steady, 10 s of braking, steady.
QUIET_S, MANOEUVRES_S = (40.0, 60.0), ((60.0, 80.0), (120.0, 145.0))
_STEPS = Quadratic(
    (0.0, 0.0),
    (10.0, 5.0),
    (
        (60.0, (0.0, 0.0)),
        (5.0, (2.0, 0.0)),
        (55.0, (0.0, 0.0)),
        (10.0, (-1.5, 1.0)),
        (51.0, (0.0, 0.0)),
    ),
)
MANOEUVRE = tuple(
    Setting(
        name=f"acceleration steps, {name}",
        networks=(WIMAX, WIFI),
        tracker=tracker,
        truth=_STEPS,
        duration_s=180.0,
    )
    for name, tracker in (("floor", FLOORED), ("no floor", DEAF), ("jerk noise", JERKY))
)

_CROSSING = Crossing(
    setting=replace(COMMON_NOISE, name="crossing", duration_s=30.0),
    meeting_s=15.0,
    fan_deg=180.0,
    speed_mps=(8.0, 20.0),
    fusion=FusionConfig(jerk_density=JERK),
)
_NARROW = replace(_CROSSING, fan_deg=30.0, speed_mps=(8.0, 12.0))
_FORGETFUL = FusionConfig(jerk_density=JERK, memory_s=0.1, decision_margin=0.0, confirm_s=0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Crossings:
    """A crossing under a name; ``required``: it has to be without swaps."""

    name: str
    case: Crossing
    required: bool


CROSSINGS = (
    Crossings(name=f"{OBJECTS} objects crossing in all directions", case=_CROSSING, required=True),
    Crossings(name=f"{OBJECTS} objects crossing within 30 deg", case=_NARROW, required=True),
    Crossings(
        name=f"{OBJECTS} objects crossing within 30 deg, without memory",
        case=replace(_NARROW, fusion=_FORGETFUL),
        required=False,
    ),
)


def warm_up() -> None:
    """Compile, or load, every kernel."""
    stages_of(PAPER).errors(0)
    run_crossing(replace(_CROSSING, setting=replace(_CROSSING.setting, duration_s=2.0)), 0)


def reproduce(work: Work) -> Outcome:
    """All rows, and pictures of the run with the first seed."""
    paper, deaf, common, common_floored = (
        summarise(work, s) for s in (PAPER, PAPER_DEAF, COMMON_NOISE, COMMON_FLOORED)
    )
    steps = [summarise(work, setting) for setting in MANOEUVRE]
    defaults, common_defaults, step_defaults = (
        summarise_defaults(work, s) for s in (PAPER, COMMON_NOISE, MANOEUVRE[0])
    )
    crossings = [_crossing_runs(work, entry) for entry in CROSSINGS]
    sides = Sides(ours=paper, paper=paper, defaults=defaults)
    shared = Sides(ours=common, paper=common_floored, defaults=common_defaults)
    rows = [
        *claims(sides),
        *gain_rows(paper, work.seed),
        *_tertiary(sides),
        *_tertiary(Sides(ours=deaf, paper=paper, defaults=defaults)),
        *_tertiary(shared),
        *lost_rows(shared, FUSED, f"{COMMON_NOISE.name}, fused"),
        *_other_methods(shared),
        *_cost(paper, deaf),
        *_manoeuvre([Sides(ours=s, paper=steps[0], defaults=step_defaults) for s in steps]),
        *(row for entry, *runs in crossings for row in _crossing(entry, *runs)),
    ]
    return Outcome(rows=tuple(rows), draw=partial(_draw, work.seed, paper, deaf, common, steps))


def _crossing_runs(
    work: Work, entry: Crossings
) -> tuple[Crossings, list[CrossingRun], list[CrossingRun]]:
    """Runs of a crossing by its settings and, where they are netpos's own, by default ones, which
    begin at the same start."""
    case = entry.case
    cases = [(entry.name, case)]
    if entry.required:
        setting = replace(case.setting, tracker=TRACKER)
        cases.append((f"{entry.name}, defaults", replace(case, setting=setting, fusion=FUSION)))
    runs = [
        [run for part in work.over_seeds(name, crossings_of_seeds, one) for run in part]
        for name, one in cases
    ]
    return entry, runs[0], runs[1] if entry.required else []


def _tertiary(sides: Sides) -> Iterator[Row]:
    """Fused against the better network and against one filter that takes all raw fixes."""
    summary = sides.ours
    label = summary.setting.name
    names = [network.name for network in summary.setting.networks]
    better = min(summary.rmse_m(name, LIMIT_FROM_S) for name in names)
    fused, central = (summary.rmse_m(name, LIMIT_FROM_S) for name in (FUSED, CENTRAL))
    for name in names:
        yield _rmse_row(sides, name, f"{label}, {name}: RMSE from the 15th second")
    row = _rmse_row(sides, FUSED, f"{label}, fused: RMSE from the 15th second")
    yield replace(row, ok=fused < better)
    yield shown(f"{label}: RMSE fused over the better network", "1", fused / better)
    yield shown(f"{label}, centralised: RMSE from the 15th second", "m", central)
    yield shown(f"{label}: RMSE fused over centralised", "1", fused / central)
    for name in names:
        yield from _nees(sides, name)
    yield from _nees(sides, FUSED, bound=summary.setting is COMMON_NOISE)


def _rmse_row(sides: Sides, name: str, label: str) -> Row:
    return sides.row(
        name,
        lambda summary, who: summary.rmse_m(who, LIMIT_FROM_S),
        lambda value: shown(label, "m", value),
    )


def _nees(sides: Sides, name: str, *, demanded: bool = True, bound: bool = False) -> Iterator[Row]:
    """``bound``: the covariance is one, as the correlation is not known; it must not be too small,
    which is what consistent means of covariance intersection."""
    summary = sides.ours
    expected = (
        "at most 2 expected: covariance intersection gives a bound" if bound else "2 expected"
    )
    label = f"{summary.setting.name}, {name}: NEES, mean from the 15th second ({expected})"
    yield sides.nees(name, LIMIT_FROM_S, label, demanded=demanded, bound=bound)
    test = summary.nees_test(name, LIMIT_FROM_S)
    for end, what in enumerate(("lower", "upper")):
        edge = None if test is None else test.bounds[end]
        yield shown(f"{summary.setting.name}, {name}: NEES, {what} 95 % bound", "1", edge)


def _other_methods(sides: Sides) -> Iterator[Row]:
    """Where what the networks share counts, only some rules stay honest."""
    label = sides.ours.setting.name
    for method in (m for m in METHODS if m != FUSED):
        rmse = sides.ours.rmse_m(method, LIMIT_FROM_S)
        yield shown(f"{label}, {method}: RMSE from the 15th second", "m", rmse)
        test = sides.ours.nees_test(method, LIMIT_FROM_S)
        mean = None if test is None else test.mean
        yield shown(f"{label}, {method}: NEES, mean from the 15th second (2 expected)", "1", mean)


def _manoeuvre(all_sides: list[Sides]) -> Iterator[Row]:
    """The floor helps when the object manoeuvres and costs when it does not."""
    floor, deaf, _ = all_sides
    for name in (WIMAX.name, FUSED):
        for sides in all_sides:
            label = f"{sides.ours.setting.name}, {name}"
            yield _quiet_row(sides, name, f"{label}: RMSE when quiet")
            yield _moving_row(sides, name, f"{label}: RMSE in the worse manoeuvre")
        gain = _moving_m(floor.ours, name) / _moving_m(deaf.ours, name)
        label = f"acceleration steps, {name}: RMSE floor over no floor"
        yield required(f"{label}, in the worse manoeuvre", "1", gain, gain < 1.0)
    for sides in all_sides:
        summary = sides.ours
        test = summary.nees_test(FUSED, *MANOEUVRES_S[0])
        mean = None if test is None else test.mean
        yield shown(f"{summary.setting.name}, {FUSED}: NEES in the first manoeuvre", "1", mean)
        noisy = summary.setting.tracker is JERKY
        yield from lost_rows(sides, FUSED, f"{summary.setting.name}, fused", demanded=noisy)


def _moving_m(summary: NetworkSummary, name: str) -> float:
    """RMSE in the worse of both manoeuvres."""
    return max(summary.rmse_m(name, *window) for window in MANOEUVRES_S)


def _quiet_row(sides: Sides, name: str, label: str) -> Row:
    return sides.row(
        name,
        lambda summary, who: summary.rmse_m(who, *QUIET_S),
        lambda value: shown(label, "m", value),
    )


def _moving_row(sides: Sides, name: str, label: str) -> Row:
    return sides.row(name, _moving_m, lambda value: shown(label, "m", value))


def _cost(floored: NetworkSummary, deaf: NetworkSummary) -> Iterator[Row]:
    """An object that never manoeuvres: what the floor costs, after half a minute and at the
    end."""
    for name in (WIMAX.name, FUSED):
        for from_s, to_s in ((30.0, 60.0), (150.0, 180.0)):
            ratio = floored.rmse_m(name, from_s, to_s) / deaf.rmse_m(name, from_s, to_s)
            label = f"paper's motion, {name}: RMSE floor over no floor"
            yield shown(f"{label}, from {from_s:g} to {to_s:g} s", "1", ratio)


def _crossing(
    entry: Crossings, runs: list[CrossingRun], defaults: list[CrossingRun]
) -> Iterator[Row]:
    """Identities kept, and how often both networks are in a device."""
    name = f"{entry.name}: runs without an identity swap"
    kept = _share_kept(runs)
    row = at_least(name, "1", kept, NO_SWAP_SHARE) if entry.required else shown(name, "1", kept)
    yield row.beside(None, _share_kept(defaults) if defaults else None)
    name = f"{entry.name}: share of devices with both networks in them after 10 s"
    row = shown(name, "1", _share_fused(runs))
    yield row.beside(None, _share_fused(defaults) if defaults else None)


def _share_kept(runs: list[CrossingRun]) -> float:
    return float(np.mean([not (run.swapped or run.renamed) for run in runs]))


def _share_fused(runs: list[CrossingRun]) -> float:
    return float(np.mean([run.fused_share for run in runs]))


def _draw(
    seed: int,
    paper: NetworkSummary,
    deaf: NetworkSummary,
    common: NetworkSummary,
    steps: list[NetworkSummary],
    folder: Path,
) -> list[Path]:
    figures = {
        "fig6_gains": network_pictures.gains(
            {"floor": stages_of(PAPER), "no floor": stages_of(PAPER_DEAF)}, WIFI.name, seed
        ),
        "fig7_errors": network_pictures.errors(paper, seed, WIFI.name, FUSED),
        "tertiary": network_pictures.stages([paper, deaf, common], FUSED),
        "gain_floor": network_pictures.manoeuvres(steps, WIMAX.name, FUSED),
        "crossing": network_pictures.crossing_ways(CROSSINGS[0].case, CROSSINGS[1].case, seed),
    }
    paths = []
    for name, figure in figures.items():
        path = folder / f"{name}.png"
        network_pictures.save(figure, path)
        paths.append(path)
    return paths
