"""fokin2020: DOA and TOA at roadside units, joint positioning and clock synchronisation.

The scenarios and the tracker's settings are those that come with netpos; only what the paper
varies is varied (N_T, the number of RSUs), and the fast passage is handed an initial position as
fokin2020:eq.32, 33 ask for.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from netpos.evaluation.work import Work
from netpos.reproduction.columns import Columns, beside, in_columns
from netpos.reproduction.experiment import VUE, Experiment, setup_of
from netpos.reproduction.fokin2020 import pictures
from netpos.reproduction.fokin2020 import rows as rows_of
from netpos.reproduction.frame import Outcome, Row
from netpos.reproduction.monte_carlo import Summary, monte_carlo
from netpos.scenario.build import buildings_of

FRAME_S = 167.3e-6


def _metis(frames: int, rsus: int, scenario: str = "metis_madrid") -> Experiment:
    number = {1: "one RSU", 2: "two RSUs"}[rsus]
    signal = "" if scenario == "metis_madrid" else ", strong signal"
    return Experiment(
        name=f"METIS{signal}, N_T = {frames}, {number}",
        scenario=scenario,
        changes=(("devices.0.beacon_interval_s", frames * FRAME_S), ("measurement.nearest", rsus)),
    )


# (experiment, RMSE [m], clock offset sd [ns]) of section 2.4
METIS = (
    (_metis(100, 2), 0.4, 4.0),
    (_metis(500, 2), 0.6, 4.0),
    (_metis(1000, 2), 1.0, 4.0),
)
METIS_ONE_RSU = (_metis(100, 1), 3.0, 10.3)
METIS_STRONG = tuple(
    (_metis(frames, rsus, "metis_madrid_strong_signal"), rmse_m, clock_sd_ns)
    for frames, rsus, rmse_m, clock_sd_ns in (
        (100, 2, 0.4, 4.0),
        (500, 2, 0.6, 4.0),
        (1000, 2, 1.0, 4.0),
        (100, 1, 3.0, 10.3),
    )
)

WANDER = Experiment(
    name="METIS street, N_T = 100, motion drawn from the model",
    scenario="metis_madrid",
    changes=(
        *_metis(100, 2).changes,
        ("devices.0.route.max_crossings", 1),
        ("devices.0.wander_density_mps2_sqrthz", 0.1),  # the tracker's own
        ("max_duration_s", 12.0),  # then it would leave the street
    ),
)

CLOCK_SD_S = 3e-9  # of the RSUs' clocks against network time
RSU_CLOCKS = tuple(
    replace(
        _metis(500, 2),
        name=f"METIS, N_T = 500, RSU clocks {1e9 * CLOCK_SD_S:.0f} ns, {label}",
        changes=(
            *_metis(500, 2).changes,
            ("rsus.clock.sd_s", CLOCK_SD_S),
            ("rsus.clock.declared", declared),
        ),
    )
    for label, declared in (("not declared", False), ("estimated", True))
)

_POSE = (("devices.0.initial_pose_sd_m", 5.0),)
FIG_5_SLOW = Experiment(name="Fig. 5, T = 0.1 s", scenario="fast_pass", changes=_POSE)
FIG_5_FAST = Experiment(name="Fig. 5, T = 0.01 s", scenario="fast_pass_100hz", changes=_POSE)
FIG_5_DRAWN = tuple(
    replace(
        experiment, name=f"{experiment.name}, start drawn from its covariance", start_drawn=True
    )
    for experiment in (FIG_5_SLOW, FIG_5_FAST)
)

_WITH_IMU = (("motion_model", "inertial"),)
_WITHOUT_IMU = (("motion_model", "constant_velocity"), ("manoeuvre_speed_sd_mps", 0.0))
_TURNING = (  # metis_madrid at 3 m/s: the device keeps its speed, its turns are manoeuvres
    ("motion_model", "constant_velocity"),
    ("process_noise", "continuous"),
    ("accel_density_mps2_sqrthz", 0.1),
    ("manoeuvre_speed_sd_mps", 3.0 * math.sqrt(2.0)),
)
# Per d_los: the paper's filter, which allows no turn; one that allows turns; and
# bridging with the inertial sensor.
FIG_6 = tuple(
    tuple(
        Experiment(name=f"Fig. 6, d_los = {d_los_m} m{label}", scenario=scenario, tracker=tracker)
        for label, tracker in (
            ("", _WITHOUT_IMU),
            (", turns told", _TURNING),
            (", IMU", _WITH_IMU),
        )
    )
    for d_los_m, scenario in ((40, "intersection_turn"), (30, "intersection_turn_30m"))
)


def warm_up() -> None:
    """Compile, or load, every kernel."""
    setup_of(FIG_5_SLOW).run(0)


def reproduce(work: Work) -> Outcome:
    """All rows, and pictures of the run with the first seed."""
    metis = [in_columns(work, experiment) for experiment, _, _ in METIS]
    one_rsu = in_columns(work, METIS_ONE_RSU[0])
    strong = [in_columns(work, experiment, defaults=False) for experiment, _, _ in METIS_STRONG]
    wander = monte_carlo(work, WANDER)
    clocks = [monte_carlo(work, e) for e in RSU_CLOCKS]
    fast = [in_columns(work, e, series=True) for e in (FIG_5_SLOW, FIG_5_FAST)]
    drawn = [monte_carlo(work, e) for e in FIG_5_DRAWN]
    turns = [_turns(work, *variants) for variants in FIG_6]
    rows = [
        *_judged(rows_of.on_metis, [*metis, one_rsu], [*METIS, METIS_ONE_RSU]),
        *beside(rows_of.growth, metis[0], metis[-1]),
        *_judged(rows_of.on_strong_signal, strong, METIS_STRONG),
        *rows_of.near_its_bound(wander),
        *rows_of.rsu_clocks(clocks[0], clocks[1]),
        *(row for columns in fast for row in beside(rows_of.fast_pass, columns)),
        *beside(rows_of.several_times, *fast),
        *(row for summary in drawn for row in rows_of.near_its_bound(summary)),
        *(row for turn in turns for row in turn.rows),
        *rows_of.line_of_sight(),
        *(row for columns in (metis[0], fast[1]) for row in beside(rows_of.tsp, columns)),
    ]
    summaries = [columns.ours for columns in metis], [columns.ours for columns in fast]
    shown = [summary for turn in turns for summary in turn.summaries]
    return Outcome(rows=tuple(rows), draw=partial(_draw, work.seed, *summaries, shown))


def _judged(
    make: Callable[[Summary, float, float], Iterable[Row]],
    columns: Sequence[Columns],
    targets: Sequence[tuple[Experiment, float, float]],
) -> Iterator[Row]:
    """Rows of experiments with an RMSE [m] and a clock offset sd [ns] of the paper."""
    for column, (_, rmse_m, clock_sd_ns) in zip(columns, targets, strict=True):
        yield from beside(make, column, paper=(rmse_m, clock_sd_ns))


class _Turns(NamedTuple):
    """Fig. 6 at one d_los."""

    rows: list[Row]
    summaries: list[Summary]


def _turns(work: Work, alone: Experiment, turning_model: Experiment, imu: Experiment) -> _Turns:
    """Rows of the model without turns, of the model with turns, and of the inertial model; the
    last two are compared with the first."""
    straight = in_columns(work, alone, defaults=False, series=True)
    turning = monte_carlo(work, turning_model, series=True)
    bridged = in_columns(work, imu, series=True)
    rows = [
        *beside(rows_of.turn, straight),
        *rows_of.turn_with(straight.ours, turning),
        *beside(partial(rows_of.turn_with, straight.ours), bridged),
    ]
    return _Turns(rows, [straight.ours, turning, bridged.ours])


def _draw(
    seed: int,
    metis: list[Summary],
    fast: list[Summary],
    turns: list[Summary],
    folder: Path,
) -> list[Path]:
    figures = {
        "fig4_line_of_sight": pictures.line_of_sight(),
        "fig5_fast_pass": pictures.passages([_sample(s, seed) for s in fast]),
        "fig6_turn": pictures.passages([_sample(s, seed) for s in turns]),
        "metis_madrid": pictures.grid(metis, _sample(metis[1])),
    }
    paths = []
    for name, figure in figures.items():
        path = folder / f"{name}.png"
        pictures.save(figure, path)
        paths.append(path)
    return paths


def _sample(summary: Summary, seed: int | None = None) -> pictures.Sample:
    """A run of an experiment; without a seed, that of the scenario."""
    setup = setup_of(summary.experiment)
    simulation = setup.simulation
    seed = simulation.scenario.seed if seed is None else seed
    return pictures.Sample(
        summary=summary,
        track=setup.run(seed),
        rsus=np.array([rsu.position[:2] for rsu in simulation.rsus]),
        way=simulation.with_seed(seed).beacons(VUE).position[:, :2],
        buildings=buildings_of(simulation.scenario),
    )
