"""dvornikov2017: several networks, one track.

The paper simulates the secondary stage of two networks; the tertiary stage is its future work, and
everything about it here has a target of our own.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from netpos.evaluation.reproduce import network_pictures
from netpos.evaluation.reproduce.frame import (
    Outcome,
    Row,
    Work,
    at_least,
    at_most,
    required,
    shown,
)
from netpos.evaluation.reproduce.network_crossing import (
    OBJECTS,
    Crossing,
    CrossingRun,
    crossings_of_seeds,
    run_crossing,
)
from netpos.evaluation.reproduce.network_stages import CENTRAL, FixNetwork, Setting, stages_of
from netpos.evaluation.reproduce.network_summary import NetworkSummary, summarise
from netpos.evaluation.reproduce.network_truth import Jerky, Quadratic
from netpos.filters.intersection import METHODS
from netpos.filters.kf import DVORNIKOV_FLOOR
from netpos.tracking.config import TrackerConfig
from netpos.tracking.networks.config import FusionConfig

LIMIT_M, LIMIT_FROM_S = 5.0, 15.0  # "at the 15th second ... 5 metres"
STEADY_S = 60.0
NO_SWAP_SHARE = 0.99
FUSED = "split_ci"

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
    clock_white_density=0.0,
    clock_walk_density=0.0,
)
"""dvornikov2017:eq.6 with Q = 0: the gain goes to 0."""
FLOORED = replace(DEAF, **_FLOOR)  # type: ignore[arg-type]
JERK = 0.3  # m/s^3/sqrt(Hz)
JERKY = replace(DEAF, jerk_density=JERK)

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
    paper, deaf, common = (summarise(work, s) for s in (PAPER, PAPER_DEAF, COMMON_NOISE))
    steps = [summarise(work, setting) for setting in MANOEUVRE]
    crossings = [_crossing_runs(work, entry) for entry in CROSSINGS]
    rows = [
        *_paper(paper),
        *_tertiary(paper),
        *_tertiary(deaf),
        *_tertiary(common),
        *_other_methods(common),
        *_cost(paper, deaf),
        *_manoeuvre(steps),
        *(row for entry, runs in crossings for row in _crossing(entry, runs)),
    ]
    return Outcome(rows=tuple(rows), draw=partial(_draw, work.seed, paper, deaf, common, steps))


def _crossing_runs(work: Work, entry: Crossings) -> tuple[Crossings, list[CrossingRun]]:
    parts = work.over_seeds(entry.name, crossings_of_seeds, entry.case)
    return entry, [run for part in parts for run in part]


def _paper(summary: NetworkSummary) -> Iterator[Row]:
    """What the paper claims: coordinate x, at the 15th second and from then on."""
    for network in (WIFI.name, WIMAX.name, FUSED):
        label = f"{summary.setting.name}, {network}"
        at = summary.axis_rmse_m(network, LIMIT_FROM_S, LIMIT_FROM_S + 0.5)
        yield at_most(f"{label}: RMSE of x at the 15th second", "m", at, LIMIT_M)
        claimed = summary.axis_sd_m(network, LIMIT_FROM_S)
        yield shown(f"{label}: sd of x the covariance gives at the 15th second", "m", claimed)
        steady = summary.axis_rmse_m(network, STEADY_S)
        yield at_most(f"{label}: RMSE of x in steady state", "m", steady, LIMIT_M)
        share = summary.axis_share_within(network, LIMIT_M, STEADY_S)
        yield shown(f"{label}: share of errors of x within 5 m in steady state", "1", share)
        largest = summary.axis_largest_m(network, STEADY_S)
        name = f"{label}: largest error of x in steady state, all runs"
        demanded = network == FUSED
        yield at_most(name, "m", largest, LIMIT_M) if demanded else shown(name, "m", largest)


def _nees(
    summary: NetworkSummary, name: str, *, demanded: bool = True, bound: bool = False
) -> Iterator[Row]:
    """``bound``: the covariance is one, as the correlation is not known; it must not be too small,
    which is what consistent means of covariance intersection."""
    test = summary.nees_test(name, LIMIT_FROM_S)
    expected = "at most 2 expected" if bound else "2 expected"
    label = f"{summary.setting.name}, {name}: NEES, mean from the 15th second ({expected})"
    consistent = test.mean <= test.bounds[1] if bound else test.consistent
    ok = consistent if demanded else None
    yield Row(name=label, unit="1", paper=None, ours=test.mean, ok=ok)
    yield shown(f"{summary.setting.name}, {name}: NEES, lower 95 % bound", "1", test.bounds[0])
    yield shown(f"{summary.setting.name}, {name}: NEES, upper 95 % bound", "1", test.bounds[1])


def _tertiary(summary: NetworkSummary) -> Iterator[Row]:
    """Fused against the better network and against one filter that takes all raw fixes."""
    label = summary.setting.name
    alone = {n.name: summary.rmse_m(n.name, LIMIT_FROM_S) for n in summary.setting.networks}
    better = min(alone.values())
    fused, central = (summary.rmse_m(name, LIMIT_FROM_S) for name in (FUSED, CENTRAL))
    for name, rmse in alone.items():
        yield shown(f"{label}, {name}: RMSE", "m", rmse)
    yield required(f"{label}, fused: RMSE", "m", fused, fused < better)
    yield shown(f"{label}: RMSE fused over the better network", "1", fused / better)
    yield shown(f"{label}, centralised: RMSE", "m", central)
    yield shown(f"{label}: RMSE fused over centralised", "1", fused / central)
    for name in alone:
        yield from _nees(summary, name)
    yield from _nees(summary, FUSED, bound=summary.setting is COMMON_NOISE)


def _other_methods(summary: NetworkSummary) -> Iterator[Row]:
    """Where what the networks share counts, only some rules stay honest."""
    for method in (m for m in METHODS if m != FUSED):
        rmse = summary.rmse_m(method, LIMIT_FROM_S)
        yield shown(f"{summary.setting.name}, {method}: RMSE", "m", rmse)
        yield from _nees(summary, method, demanded=False)


def _manoeuvre(summaries: list[NetworkSummary]) -> Iterator[Row]:
    """The floor helps when the object manoeuvres and costs when it does not."""
    floor, deaf, jerk = summaries
    for name in (WIMAX.name, FUSED):
        quiet = {s.setting.name: s.rmse_m(name, *QUIET_S) for s in summaries}
        moving = {s.setting.name: max(s.rmse_m(name, *w) for w in MANOEUVRES_S) for s in summaries}
        for s in summaries:
            yield shown(f"{s.setting.name}, {name}: RMSE when quiet", "m", quiet[s.setting.name])
            label = f"{s.setting.name}, {name}: RMSE in the worse manoeuvre"
            yield shown(label, "m", moving[s.setting.name])
        gain = moving[floor.setting.name] / moving[deaf.setting.name]
        label = f"acceleration steps, {name}: RMSE floor over no floor"
        yield required(f"{label}, in the worse manoeuvre", "1", gain, gain < 1.0)
    for s in (floor, deaf, jerk):
        test = s.nees_test(FUSED, *MANOEUVRES_S[0])
        yield shown(f"{s.setting.name}, {FUSED}: NEES in the first manoeuvre", "1", test.mean)


def _cost(floored: NetworkSummary, deaf: NetworkSummary) -> Iterator[Row]:
    """An object that never manoeuvres: what the floor costs, after half a minute and at the
    end."""
    for name in (WIMAX.name, FUSED):
        for from_s, to_s in ((30.0, 60.0), (150.0, 180.0)):
            ratio = floored.rmse_m(name, from_s, to_s) / deaf.rmse_m(name, from_s, to_s)
            label = f"paper's motion, {name}: RMSE floor over no floor"
            yield shown(f"{label}, from {from_s:g} to {to_s:g} s", "1", ratio)


def _crossing(entry: Crossings, runs: list[CrossingRun]) -> Iterator[Row]:
    kept = sum(not (run.swapped or run.renamed) for run in runs) / len(runs)
    name = f"{entry.name}: runs without an identity swap"
    yield at_least(name, "1", kept, NO_SWAP_SHARE) if entry.required else shown(name, "1", kept)
    share = float(np.mean([run.fused_share for run in runs]))
    yield shown(
        f"{entry.name}: share of devices with both networks in them after 10 s", "1", share
    )


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
