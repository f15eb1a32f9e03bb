"""petukhov: one anchor with a long baseline, steps, a square-root UKF.

The rectangle is walked as the paper has it, in steps of constant velocity, with dead reckoning by
the paper's error model. ``paper`` is its scheme: the sector by the direction of the first step,
step velocities taken as white, no gate. ``netpos`` is ours: a filter per sector, one error per
step. The whole chain from a simulated gait is beside it, loose and tight.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from netpos.evaluation.consistency import MeanTest, chi2_mean_bounds, effective_size, nees
from netpos.evaluation.reproduce import person, rectangle
from netpos.evaluation.reproduce import petukhov_pictures as pictures
from netpos.evaluation.reproduce.frame import (
    Outcome,
    Row,
    Work,
    at_least,
    at_most,
    required,
    shown,
)
from netpos.evaluation.reproduce.rectangle import Case, Walked
from netpos.evaluation.reproduce.sector_choice import Conditions, Found, sector_choice
from netpos.evaluation.reproduce.troubles import Trouble
from netpos.evaluation.reproduce.waist_chain import Chain, run_chain, run_chains
from netpos.evaluation.reproduce.walk_bound import known_instants_rmse_m
from netpos.messages.values import Array

RMSE_M, RATIO, LIVE_RMSE_M = 0.03, 2.0, 0.12
AIM_M, HIDDEN_M = 0.02, 0.5
RIGHT_AFTER = {2: 0.99, 5: 0.999}
HIDDEN_S = (10.0, 15.0)
DECIDED_S = 1.3  # when sectors are decided, for the bound
CHAIN_RUNS = 40  # of the whole chain at most: it simulates an IMU

PAPER = (
    ("ambiguity", "step_heading"),
    ("process_noise", "werner"),
    ("steady_accel_density_mps2_sqrthz", 0.0),
    ("velocity_step_sd_mps", 0.1),  # sigma_xi = 1 m/s^2 over T = 0.1 s (petukhov:eq.2, 4, 23)
    ("velocity_correlation_s", 0.0),
    ("gate_probability", 1.0),
)
LONG = Case(name="netpos, L = 4 lambda", wavelengths=4.0)
SHORT = Case(name="netpos, L = lambda/2", wavelengths=0.5)
PAPER_LONG = Case(name="paper's scheme, L = 4 lambda", wavelengths=4.0, tracker=PAPER)
PAPER_SHORT = Case(name="paper's scheme, L = lambda/2", wavelengths=0.5, tracker=PAPER)
HIDDEN = Case(name="anchor hidden for 5 s", wavelengths=4.0, hidden_s=HIDDEN_S)

WRONG_S, FAR_M = 10.0, 0.3
TROUBLES = tuple(
    Case(name=name, wavelengths=4.0, trouble=trouble)
    for name, trouble in (
        ("one phase in ten a reflection", Trouble(phase_outliers=0.1)),
        ("someone in the line of sight for 1 s", Trouble(blocked_s=(10.0, 11.0))),
        ("anchor heard once a second", Trouble(heard_every=10)),
        ("heading of the steps 6 deg", Trouble(heading_sd_rad=math.radians(6.0))),
        ("put into a wrong sector", Trouble(wrong_s=WRONG_S)),
    )
)
TROUBLED_RUNS = 200  # of each of them at most

TARGET = Conditions()
BY_BASELINE = tuple(Conditions(wavelengths=w) for w in (1.0, 2.0, 6.0, 8.0, 10.0))
BY_PHASE = tuple(Conditions(phase_sd_deg=sd) for sd in (3.0, 12.0, 18.0, 30.0))
POOR_HEADING = Conditions(heading_sd_deg=6.0)
# The IMU's forward acceleration is not all there is: a turn on the spot may have to be revealed.
TIGHT = (("motion_model", "inertial"), ("manoeuvre_speed_sd_mps", 0.3))


@dataclass(frozen=True, slots=True, kw_only=True)
class Figures:
    """Over all runs of a case: RMSE and largest error of the decided estimates, their NEES;
    error2 (runs, n) m^2, NaN where not decided."""

    runs: int
    rmse_m: float
    error_max_m: float
    nees: MeanTest
    decided_s: float
    lost: int
    error2: Array


def warm_up() -> None:
    """Compile, or load, every kernel."""
    for case in (LONG, PAPER_LONG):
        rectangle.setup_of(case).run(0)
    run_chain(0)
    run_chain(0, TIGHT)
    person.walk(0, person.ESTIMATED)


def reproduce(work: Work) -> Outcome:
    """All rows, and pictures of the run with the first seed."""
    cases = (LONG, SHORT, PAPER_LONG, PAPER_SHORT, HIDDEN)
    walked = {case: _figures(work, case) for case in cases}
    conditions = (TARGET, *BY_BASELINE, *BY_PHASE, POOR_HEADING)
    found = {c: sector_choice(work, c) for c in conditions}
    some = work.with_runs(min(work.runs, TROUBLED_RUNS))
    troubled = {case: _figures(some, case) for case in TROUBLES}
    few = work.with_runs(min(work.runs, CHAIN_RUNS))
    chains = {
        "loose": run_chains(few, "whole chain, loose"),
        "tight": run_chains(few, "whole chain, tight", TIGHT),
    }
    rows = [
        *_walk(rectangle.setup_of(LONG)),
        *_pair(walked[PAPER_LONG], walked[PAPER_SHORT], PAPER_LONG, PAPER_SHORT),
        *_pair(walked[LONG], walked[SHORT], LONG, SHORT),
        *_beyond(walked),
        *_troubled(troubled),
        *_sectors(found),
        *_chains(chains),
        *person.rows(work),
    ]
    return Outcome(rows=tuple(rows), draw=partial(_draw, work.seed, walked, found))


def _job(case: Case, seeds: range) -> list[tuple[Array, Array, float]]:
    """Squared errors (n,), NEES (n,), NaN where not decided, and the time of decision."""
    setup = rectangle.setup_of(case)
    return [_scores(setup.run(seed)) for seed in seeds]


def _scores(run: Walked) -> tuple[Array, Array, float]:
    values = np.full(len(run.times_s), np.nan)
    error = (run.mean[:, :2] - run.truth)[run.decided]
    normalised, usable = nees(error, run.cov[run.decided][:, :2, :2])
    values[np.flatnonzero(run.decided)[usable]] = normalised
    first = float(run.times_s[np.argmax(run.decided)]) if run.decided.any() else np.inf
    return run.error_m**2, values, first


def _figures(work: Work, case: Case) -> Figures:
    runs = [run for part in work.over_seeds(case.name, _job, case) for run in part]
    error2 = np.array([run[0] for run in runs])
    series = [run[1][np.isfinite(run[1])] for run in runs]
    n_eff = sum(effective_size(s) for s in series if s.size)
    values = np.concatenate(series)
    return Figures(
        runs=len(runs),
        rmse_m=float(np.sqrt(np.nanmean(error2))),
        error_max_m=float(np.sqrt(np.nanmax(error2))),
        nees=MeanTest(mean=float(values.mean()), bounds=chi2_mean_bounds(2, n_eff), n_eff=n_eff),
        decided_s=float(np.mean([run[2] for run in runs])),
        lost=int(np.sum(np.nanmax(error2[:, -20:], axis=1) > HIDDEN_M**2)),
        error2=error2,
    )


def _walk(setup: rectangle.Setup) -> Iterator[Row]:
    """What the paper says of the walk itself."""
    way = float(np.hypot(*np.diff(setup.truth, axis=0).T).sum())
    steps = setup.steps
    for name, unit, paper, ours in (
        ("steps", "1", rectangle.STEPS, float(len(steps.start_s))),
        ("way", "m", rectangle.WALKED_M, way),
        ("duration", "s", rectangle.DURATION_S, float(setup.times_s[-1])),
        ("walking time", "s", rectangle.WALKED_M, float((steps.end_s - steps.start_s).sum())),
    ):
        ok = abs(ours - paper) < 0.006 * paper
        yield Row(name=f"rectangle: {name}", unit=unit, paper=float(paper), ours=ours, ok=ok)


def _pair(long: Figures, short: Figures, long_case: Case, short_case: Case) -> Iterator[Row]:
    """A long and a standard baseline beside each other."""
    yield at_most(f"{long_case.name}: RMSE", "m", long.rmse_m, RMSE_M)
    for figures, case in ((long, long_case), (short, short_case)):
        if figures is short:
            yield shown(f"{case.name}: RMSE", "m", figures.rmse_m)
        yield shown(f"{case.name}: largest error", "m", figures.error_max_m)
        yield shown(f"{case.name}: runs that end in a wrong place", "1", figures.lost)
        own = case in (LONG, SHORT)
        ok = figures.nees.mean <= figures.nees.bounds[1]
        name = f"{case.name}: NEES, mean (expected 2)"
        yield (
            required(name, "1", figures.nees.mean, ok)
            if own
            else shown(name, "1", figures.nees.mean)
        )
    scheme = long_case.name.split(",")[0]
    ratio = short.rmse_m / long.rmse_m
    yield at_least(f"{scheme}: RMSE of lambda/2 over that of 4 lambda", "1", ratio, RATIO)


def _beyond(walked: dict[Case, Figures]) -> Iterator[Row]:
    """What the paper does not show."""
    ours, hidden = walked[LONG], walked[HIDDEN]
    yield required(f"{LONG.name}: RMSE, aim 0.02 m", "m", ours.rmse_m, ours.rmse_m <= AIM_M)
    yield shown(f"{LONG.name}: sector decided after (1 s of standing first)", "s", ours.decided_s)
    for case in (LONG, SHORT):
        name = f"{case.name}: bound of who knows when the walk changes"
        setup = rectangle.setup_of(case)
        yield shown(name, "m", known_instants_rmse_m(setup, DECIDED_S))
        bound = known_instants_rmse_m(setup, DECIDED_S, every_step=True)
        yield shown(f"{name}, maybe at every step", "m", bound)
    times = rectangle.setup_of(HIDDEN).times_s
    gone = (times >= HIDDEN_S[0]) & (times < HIDDEN_S[1])
    largest = np.sqrt(np.nanmax(hidden.error2[:, gone], axis=1))
    worst = float(largest.max())
    yield required(f"{HIDDEN.name}: largest error of all runs", "m", worst, worst < HIDDEN_M)
    yield shown(
        f"{HIDDEN.name}: largest error, 95 % of runs", "m", float(np.quantile(largest, 0.95))
    )
    yield required(
        f"{HIDDEN.name}: runs that end in a wrong place", "1", hidden.lost, hidden.lost == 0
    )


def _troubled(troubled: dict[Case, Figures]) -> Iterator[Row]:
    """What no one promises: the tracker is not told of these. Errors of decided estimates."""
    for case, figures in troubled.items():
        error = np.sqrt(figures.error2)
        yield shown(f"{case.name}: RMSE", "m", figures.rmse_m)
        worst = np.nanmax(error, axis=1)
        yield shown(f"{case.name}: largest error, median run", "m", float(np.median(worst)))
        yield shown(f"{case.name}: NEES, mean (expected 2)", "1", figures.nees.mean)
        decided = np.isfinite(error)
        far = float((error[decided] > FAR_M).mean())
        yield shown(f"{case.name}: decided and more than {FAR_M} m off", "1", far)
        lost = figures.lost
        yield required(f"{case.name}: runs that end in a wrong place", "1", lost, lost == 0)
        if case.trouble.wrong_s is not None:
            repaired = _repair_s(error, rectangle.setup_of(case).times_s)
            yield shown(f"{case.name}: repaired after, mean", "s", float(repaired.mean()))
            late = float(np.quantile(repaired, 0.95))
            yield shown(f"{case.name}: repaired after, 95 % of runs", "s", late)


def _repair_s(error: Array, times_s: Array) -> Array:
    """How long after ``WRONG_S`` the errors (runs, n) are small for good, and decided: (runs,)."""
    bad = ~(error <= FAR_M)  # NaN, too
    bad[:, times_s < WRONG_S] = False
    last = error.shape[1] - 1 - np.argmax(bad[:, ::-1], axis=1)
    after: Array = times_s[np.minimum(last + 1, len(times_s) - 1)] - WRONG_S
    return np.where(bad.any(axis=1), after, 0.0)


def _sectors(found: dict[Conditions, Found]) -> Iterator[Row]:
    target = found[TARGET]
    name = "sector, L = 4 lambda"
    for step, least in RIGHT_AFTER.items():
        share = target.share_right(step)
        yield required(f"{name}: right after {step} steps", "1", share, share >= least)
        claimed = float(target.claimed[:, step - 1].mean())
        yield shown(f"{name}: its own probability after {step} steps", "1", claimed)
        yield shown(f"{name}: decided after {step} steps", "1", target.share_decided(step))
        wrong = target.share_wrong(step)
        yield required(f"{name}: decided wrongly after {step} steps", "1", wrong, wrong <= 0.001)
    yield shown(f"{name}: right by the paper's rule on one step", "1", target.rule_share)
    poor = found[POOR_HEADING]
    for step in RIGHT_AFTER:
        label = f"{name}, heading sd 6 deg: right after {step} steps"
        yield shown(label, "1", poor.share_right(step))
    yield shown(
        f"{name}, heading sd 6 deg: decided wrongly after 5 steps", "1", poor.share_wrong(5)
    )
    for conditions in BY_BASELINE + BY_PHASE:
        result = found[conditions]
        yield shown(f"{conditions.name}: right after 2 steps", "1", result.share_right(2))
        yield shown(f"{conditions.name}: right after 5 steps", "1", result.share_right(5))
        yield shown(f"{conditions.name}: right by the paper's rule", "1", result.rule_share)


def _chains(chains: dict[str, list[Chain]]) -> Iterator[Row]:
    """Gait, IMU, dead reckoning and tracker together; the paper's live experiment is the only
    figure to compare with."""
    for scheme, runs in chains.items():
        error2 = np.concatenate([(run.error[run.tracking] ** 2).sum(axis=1) for run in runs])
        name = f"whole chain from the IMU, {scheme}"
        yield at_most(
            f"{name}: RMSE (paper: live)", "m", float(np.sqrt(error2.mean())), LIVE_RMSE_M
        )
        yield shown(f"{name}: largest error", "m", float(np.sqrt(error2.max())))
        values = [nees(run.error[run.tracking], run.cov[run.tracking])[0] for run in runs]
        yield shown(f"{name}: NEES, mean (expected 2)", "1", float(np.concatenate(values).mean()))
    steps = np.array([run.steps_found for run in chains["loose"]])
    yield required(
        "whole chain: runs with all 32 steps found",
        "1",
        float((steps == rectangle.STEPS).mean()),
        bool((steps == rectangle.STEPS).all()),
    )


def _draw(
    seed: int, walked: dict[Case, Figures], found: dict[Conditions, Found], folder: Path
) -> list[Path]:
    runs = {case: rectangle.setup_of(case).run(seed) for case in (LONG, SHORT)}
    by_baseline = (*BY_BASELINE[:2], TARGET, *BY_BASELINE[2:])
    by_phase = (BY_PHASE[0], TARGET, *BY_PHASE[1:])
    figures = {
        "fig7_residuals": pictures.residuals(seed),
        "fig8_tracks": pictures.tracks({case.name: run for case, run in runs.items()}),
        "fig9_errors": pictures.errors(
            rectangle.setup_of(LONG).times_s,
            {case.name: np.sqrt(run.error_m**2) for case, run in runs.items()},
            {case.name: walked[case].error2 for case in runs},
        ),
        "sectors": pictures.success(
            [(c, found[c]) for c in by_baseline], [(c, found[c]) for c in by_phase]
        ),
    }
    paths = []
    for name, figure in figures.items():
        path = folder / f"{name}.png"
        pictures.save(figure, path)
        paths.append(path)
    return paths
