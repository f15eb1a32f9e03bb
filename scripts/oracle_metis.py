#!/usr/bin/env python3
"""Compare today's tracker with a particle filter where fokin2020 hears one RSU.

    python scripts/oracle_metis.py [--runs 30] [--first-seed 1] [--particles 1000]
        [--estimator scenario|defaults] [--experiment one_rsu|strong|turn] [--json FILE]

Both get the same measurements, start and parameters of the model: white acceleration, and turns
and other velocity steps as often as the tracker's manoeuvres. The vehicle itself drives along
streets and turns by 90 degrees: so the particle filter says what this model can reach, not what is
possible. ``turn`` is Fig. 6 without an IMU.
Exit 0 done, 1 a file could not be written, 2 bad usage.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from scipy.constants import speed_of_light

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "ros2_ws/src/netpos/test/support"))

from netpos.estimation.level.manoeuvre import (  # noqa: E402
    TURN_ANGLE_SD,
    TURN_SIZES,
    TURN_SPEED_SD,
)
from netpos.estimation.level.protection import protection_level  # noqa: E402
from netpos.estimation.measurement import (  # noqa: E402
    AXES,
    KIND,
    LEVER,
    ORIGIN,
    VALUE,
    VARIANCE,
    Kind,
)
from netpos.estimation.mixture.turns import TURNS_HZ  # noqa: E402
from netpos.estimation.motion import Parameter  # noqa: E402
from netpos.estimation.state import N_CORE, POSITION  # noqa: E402
from netpos.evaluation.metrics import SKIP_EPOCHS  # noqa: E402
from netpos.messages.values import Array, InitialPose  # noqa: E402
from netpos.reproduction.experiment import VUE, Experiment, Setup, setup_of  # noqa: E402
from netpos.reproduction.fokin2020.paper import FIG_6, METIS_ONE_RSU, METIS_STRONG  # noqa: E402
from netpos.reproduction.monte_carlo import DIVERGED_M  # noqa: E402
from netpos.reproduction.rows import RowTemplates, observation_rows  # noqa: E402
from netpos.tracking.config import TrackerConfig  # noqa: E402
from netpos.tracking.estimators.models import motions_of  # noqa: E402
from particle_filter import Start  # noqa: E402
from particle_gaussians import GaussianParticles, StepMotion  # noqa: E402
from particle_kernels import Kind as OracleKind  # noqa: E402
from script_parts import positive  # noqa: E402

AT_ONCE_S = 0.07  # of epochs that the particle filter takes together
SHARE = 0.95
EXPERIMENTS = {"one_rsu": METIS_ONE_RSU[0], "strong": METIS_STRONG[-1][0], "turn": FIG_6[0][1]}


@dataclass(frozen=True, slots=True, kw_only=True)
class Figures:
    """Of one filter on one route: RMSE and largest error [m], share of the epochs above 5 m, mean
    NEES, share of the truths in the 95 % circle."""

    rmse_m: float
    largest_m: float
    above: float
    nees: float
    inside: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Route:
    """One route by both filters. epochs: scored."""

    seed: int
    epochs: int
    oracle: Figures
    tracker: Figures


def start_of(config: TrackerConfig, pose: InitialPose) -> Start:
    """The tracker's start (``pose_state``) as the particle filter takes it."""
    c = speed_of_light
    return Start(
        mean=np.array([*pose.position[:2], 0.0, 0.0]),
        position_sd=math.sqrt(pose.cov[0, 0]),
        velocity_sd=config.initial_speed_sd_mps,
        clock_mean=(0.0, c * config.clock_drift_mean),
        clock_sd=(c * config.clock_offset_sd_s, c * config.clock_drift_sd),
    )


def motion_of(config: TrackerConfig) -> StepMotion:
    """The model of the tracker: continuous white acceleration, manoeuvres, clock."""
    if config.process_noise != "continuous":
        raise ValueError(f"the particle filter has no process noise {config.process_noise}")
    c = speed_of_light
    return StepMotion(
        accel=config.accel_density_mps2_sqrthz,
        steps_hz=TURNS_HZ,
        step_sd=config.manoeuvre_sd_mps,
        to_sides=TURN_SIZES,
        turn_speed_sd=TURN_SPEED_SD,
        turn_angle_sd=TURN_ANGLE_SD,
        clock=(c * config.clock_white_density, motions_of(config)[0][Parameter.DRIFT_DENSITY]),
    )


def rows_of(rows: Array, height_m: float) -> Array:
    """Azimuths and times of arrival (m, ROW_WIDTH) as rows of the particle filter."""
    told = []
    for row in rows:
        x, y, z = row[ORIGIN : ORIGIN + 3]
        sd = math.sqrt(row[VARIANCE])
        if row[KIND] == Kind.AZIMUTH:
            bearing = row[VALUE] + math.atan2(row[AXES + 1], row[AXES])
            told.append([OracleKind.BEARING, bearing, sd, x, y, 0.0, 0.0])
        elif row[KIND] == Kind.TOA:
            up = height_m + row[LEVER + 2] - z
            told.append([OracleKind.TOA, row[VALUE], sd, x, y, up, 0.0])
        else:
            raise ValueError(f"the particle filter has no {Kind(int(row[KIND])).name} here")
    return np.array(told)


def posteriors(setup: Setup, seed: int, particles: int) -> Iterator[tuple[int, GaussianParticles]]:
    """Epochs after which it is scored, and the particle filter there."""
    simulation, config = setup.simulation.with_seed(seed), setup.config
    templates = RowTemplates.of(simulation.rsus, simulation.fields)
    seen = simulation.observations(VUE)
    heard, row_start, rows, _ = observation_rows(seen, templates, N_CORE)
    seconds = 1e-9 * (simulation.beacons(VUE).stamp_ns[heard] - simulation.scenario.start_ns)
    pose = simulation.initial_pose(VUE)
    if pose is None:
        raise ValueError(f"scenario {simulation.scenario.name} gives no initial pose")
    told = rows_of(rows, config.device_height_m)
    oracle = GaussianParticles(start_of(config, pose), motion_of(config), particles, seed)
    oracle.begin(told[0])
    oracle.advance(np.zeros(row_start[1] - 1), told[1 : row_start[1]])
    now, at_once = seconds[0], max(round(AT_ONCE_S / (seconds[1] - seconds[0])), 1)
    for first in range(1, len(seconds), at_once):
        end = min(first + at_once, len(seconds))
        times = np.repeat(seconds[first:end] - now, np.diff(row_start[first : end + 1]))
        oracle.advance(times, told[row_start[first] : row_start[end]])
        now = seconds[end - 1]
        yield end - 1, oracle


def figures_of(error: Array, cov: Array, inside: Array) -> Figures:
    """Figures of errors (N, 2), covariances (N, 2, 2) and whether the circle held the truth."""
    size = np.hypot(*error.T)
    nees = np.einsum("ki,kij,kj->k", error, np.linalg.inv(cov), error)
    return Figures(
        rmse_m=math.sqrt(float((size**2).mean())),
        largest_m=float(size.max()),
        above=float((size > DIVERGED_M).mean()),
        nees=float(nees.mean()),
        inside=float(inside.mean()),
    )


def compare(experiment: Experiment, seed: int, particles: int) -> Route:
    """One route by both filters, scored at the same epochs."""
    setup = setup_of(experiment)
    track = setup.run(seed)
    epochs, means, covs, inside = [], [], [], []
    for epoch, oracle in posteriors(setup, seed, particles):
        if epoch < SKIP_EPOCHS or not track.tracked[epoch]:
            continue
        mean, cov = oracle.moments()
        epochs.append(epoch)
        means.append(mean)
        covs.append(cov)
        away = math.hypot(*(mean - track.truth[epoch, POSITION]))
        inside.append(oracle.cloud().share_within(away) < SHARE)
    truth, own = track.truth[epochs][:, POSITION], track.cov[epochs][:, POSITION, POSITION]
    error = track.mean[epochs][:, POSITION] - truth
    radius = np.array([protection_level(cov, 1.0 - SHARE) for cov in own])
    return Route(
        seed=seed,
        epochs=len(epochs),
        oracle=figures_of(np.array(means) - truth, np.array(covs), np.array(inside)),
        tracker=figures_of(error, own, np.hypot(*error.T) < radius),
    )


def _pair(routes: Sequence[Route], name: str, weights: Array) -> list[float]:
    """A figure of both filters, mean over all epochs; the RMSE over all epochs."""
    power = 2.0 if name == "rmse_m" else 1.0
    values = [[getattr(f, name) for f in (r.oracle, r.tracker)] for r in routes]
    mean = np.array([weights @ np.array(values) ** power]) ** (1.0 / power)
    both: list[float] = mean.ravel().tolist()
    return both


def summary(routes: Sequence[Route]) -> dict[str, list[float]]:
    """Figures of the particle filter and of the tracker over all routes."""
    weights = np.array([r.epochs for r in routes], dtype=float)
    names = "rmse_m", "above", "nees", "inside"
    found = {name: _pair(routes, name, weights / weights.sum()) for name in names}
    largest = np.array([[r.oracle.largest_m, r.tracker.largest_m] for r in routes])
    rmse = np.array([[r.oracle.rmse_m, r.tracker.rmse_m] for r in routes])
    found["median_rmse_m"] = np.median(rmse, axis=0).tolist()
    found["routes_above"] = (largest > DIVERGED_M).mean(axis=0).tolist()
    return found


def _cells(route: Route) -> str:
    both = (route.oracle, route.tracker)
    rmse, largest, above, nees, inside = (
        " / ".join(format(getattr(f, name), form) for f in both)
        for name, form in (
            ("rmse_m", ".2f"),
            ("largest_m", ".1f"),
            ("above", ".1%"),
            ("nees", ".2f"),
            ("inside", ".0%"),
        )
    )
    cells = str(route.seed), rmse, largest, above, nees, inside
    return f"| {' | '.join(cells)} |"


HEAD = (
    "| seed | RMSE m, oracle / tracker | largest m | above 5 m | NEES | in 95 % circle |\n"
    "|---|---|---|---|---|---|"
)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--runs", type=positive, default=30, help="routes")
    parser.add_argument("--first-seed", type=int, default=1, help="seed of the first route")
    parser.add_argument("--particles", type=positive, default=1000)
    parser.add_argument("--estimator", choices=["scenario", "defaults"], default="scenario")
    parser.add_argument("--experiment", choices=sorted(EXPERIMENTS), default="one_rsu")
    parser.add_argument("--json", type=Path, help="write all figures to this file")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run, print a line a route and the summary, write what was asked for."""
    options = _parser().parse_args(arguments)
    experiment = replace(EXPERIMENTS[options.experiment], estimator=options.estimator)
    print(HEAD)
    routes = []
    for seed in range(options.first_seed, options.first_seed + options.runs):
        routes.append(compare(experiment, seed, options.particles))
        print(_cells(routes[-1]), flush=True)
    total = summary(routes)
    for name, (oracle, tracker) in total.items():
        print(f"{name}: oracle {oracle:.3g}, tracker {tracker:.3g}")
    if options.json:
        content = {"particles": options.particles, "summary": total}
        content["routes"] = [asdict(route) for route in routes]
        try:
            options.json.write_text(json.dumps(content, indent=1), encoding="utf-8")
        except OSError as error:
            sys.stderr.write(f"error: {error}\n")
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
