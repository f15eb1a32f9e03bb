"""petukhov: one anchor with a long baseline, steps, a square-root UKF.

The headline is the whole chain from a simulated gait (``chain_rows``): the tracker hears of a
step after the step. Beside it the rectangle is walked in steps of constant velocity, with dead
reckoning by the paper's error model. There the tracker knows a step's velocity during the step,
and the name of every such row says so. The column of the paper's own filter is its scheme: the
sector by the direction of the first step, white step velocities, no gate.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from netpos.estimation.state import POSITION
from netpos.evaluation.work import Work
from netpos.messages.values import Array
from netpos.reproduction.frame import Outcome, Row, at_least, at_most, required, shown
from netpos.reproduction.petukhov import chain_rows, person, pictures, rectangle
from netpos.reproduction.petukhov.chain_rows import PAPER, RATIO, RMSE_M
from netpos.reproduction.petukhov.rectangle import Case, Walked
from netpos.reproduction.petukhov.sector_choice import Conditions, SectorShares, sector_choice
from netpos.reproduction.petukhov.troubles import Trouble
from netpos.reproduction.petukhov.walk_bound import known_instants_rmse_m
from netpos.reproduction.petukhov.walk_figures import (
    FAR_M,
    LOST_M,
    Figures,
    Scores,
    ratio_at_same_instants,
)

DURING = "step velocities during the step they describe"
AIM_M = 0.02
RIGHT_AFTER = {2: 0.99, 5: 0.999}
HIDDEN_S = (10.0, 15.0)
DECIDED_S = 1.3  # when sectors are decided, for the bound

LONG = Case(name="L = 4 lambda", wavelengths=4.0)
SHORT = Case(name="L = lambda/2", wavelengths=0.5)
HIDDEN = Case(name="anchor hidden for 5 s", wavelengths=4.0, hidden_s=HIDDEN_S)

WRONG_S, WRONG_M = 10.0, 0.3
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Compared:
    """Figures of netpos, of the paper's scheme (None where it has none) and of the library's
    defaults, on the same runs."""

    ours: Figures
    paper: Figures | None
    defaults: Figures


def paper_s(case: Case) -> Case:
    """The paper's scheme in the same case."""
    return replace(case, name=f"{case.name}, paper's scheme", tracker=PAPER)


def by_default(case: Case) -> Case:
    """The library's default parameters in the same case."""
    return replace(case, name=f"{case.name}, defaults", defaults=True)


def warm_up() -> None:
    """Compile, or load, every kernel."""
    for case in (LONG, paper_s(LONG), by_default(LONG)):
        rectangle.setup_of(case).run(0)
    chain_rows.warm_up()
    person.walk(0, person.ESTIMATED)


def reproduce(work: Work) -> Outcome:
    """All rows, and pictures of the run with the first seed."""
    chain = tuple(chain_rows.rows(work))
    walked = {case: compared(work, case) for case in (LONG, SHORT, HIDDEN)}
    conditions = (TARGET, POOR_HEADING)
    known = {c: sector_choice(work, replace(c, defaults=True)) for c in conditions}
    choices = {c: sector_choice(work, c) for c in (*conditions, *BY_BASELINE, *BY_PHASE)}
    some = work.with_runs(min(work.runs, TROUBLED_RUNS))
    troubled = {case: compared(some, case) for case in TROUBLES}
    during = [
        *_baselines(walked[LONG], walked[SHORT]),
        *_beyond(walked),
        *_troubled(troubled),
        *_sectors(choices, known),
        *person.rows(work),
    ]
    rows = (*chain, *_walk(rectangle.setup_of(LONG)), *_during(during))
    return Outcome(rows=rows, draw=partial(_draw, work.seed, walked, choices))


def _during(rows: Iterable[Row]) -> Iterator[Row]:
    """The same rows, each labelled with what no causal system has."""
    return (replace(row, name=f"{row.name}; {DURING}") for row in rows)


def _job(case: Case, seeds: range) -> list[Scores]:
    setup = rectangle.setup_of(case)
    return [_scores(setup.run(seed)) for seed in seeds]


def _scores(run: Walked) -> Scores:
    error = np.where(run.decided[:, None], run.mean[:, POSITION] - run.truth, np.nan)
    return Scores.of(error, run.cov[:, POSITION, POSITION])


def figures_of(work: Work, case: Case) -> Figures:
    """All seeds of a case."""
    runs = [run for part in work.over_seeds(case.name, _job, case) for run in part]
    return Figures.of(rectangle.setup_of(case).times_s, runs)


def compared(work: Work, case: Case) -> Compared:
    """A case by all three. The paper's scheme has no answer to a wrong sector."""
    wrong = case.trouble.wrong_s is not None
    return Compared(
        ours=figures_of(work, case),
        paper=None if wrong else figures_of(work, paper_s(case)),
        defaults=figures_of(work, by_default(case)),
    )


def _walk(setup: rectangle.Setup) -> Iterator[Row]:
    """Claims of the paper about the walk itself."""
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


def _beside(row: Row, case: Compared, figure: Callable[[Figures], float]) -> Row:
    """A row with the same figure of the paper's scheme and of the defaults."""
    paper = None if case.paper is None else figure(case.paper)
    return row.beside(paper, figure(case.defaults))


def _common(name: str, case: Compared) -> Iterator[Row]:
    """Largest error, consistency, time not scored and lost runs."""
    ours = case.ours
    row = shown(f"{name}: largest error", "m", ours.error_max_m)
    yield _beside(row, case, lambda f: f.error_max_m)
    row = shown(f"{name}: sector decided after (1 s of standing first)", "s", ours.decided_s[0])
    yield _beside(row, case, lambda f: f.decided_s[0])
    row = shown(f"{name}: share of instants not scored", "1", ours.unscored)
    yield _beside(row, case, lambda f: f.unscored)
    row = shown(f"{name}: share of runs with an error above 5 m", "1", ours.share_above(FAR_M))
    yield _beside(row, case, lambda f: f.share_above(FAR_M))
    row = required(f"{name}: runs lost at their end", "1", ours.lost, ours.lost == 0)
    yield _beside(row, case, lambda f: f.lost)


def _baselines(long: Compared, short: Compared) -> Iterator[Row]:
    """A long and a standard baseline beside each other."""
    row = at_most(f"{LONG.name}: RMSE", "m", long.ours.rmse_m, RMSE_M)
    yield _beside(row, long, lambda f: f.rmse_m)
    row = required(
        f"{LONG.name}: RMSE, aim 0.02 m", "m", long.ours.rmse_m, long.ours.rmse_m <= AIM_M
    )
    yield _beside(row, long, lambda f: f.rmse_m)
    row = shown(f"{SHORT.name}: RMSE", "m", short.ours.rmse_m)
    yield _beside(row, short, lambda f: f.rmse_m)
    gains = [
        None if above is None or below is None else ratio_at_same_instants(above, below)
        for above, below in (
            (short.ours, long.ours),
            (short.paper, long.paper),
            (short.defaults, long.defaults),
        )
    ]
    name = "RMSE of lambda/2 over that of 4 lambda, at the same instants"
    yield at_least(name, "1", gains[0], RATIO).beside(gains[1], gains[2])
    for case, figures in ((LONG, long), (SHORT, short)):
        test = figures.ours.nees
        name = f"{case.name}: NEES, mean (expected 2)"
        row = required(name, "1", test.mean, test.consistent)
        yield _beside(row, figures, lambda f: f.nees.mean)
        yield from _common(case.name, figures)


def _beyond(walked: dict[Case, Compared]) -> Iterator[Row]:
    """What the paper does not show."""
    for case in (LONG, SHORT):
        name = f"{case.name}: bound of who knows when the walk changes"
        setup = rectangle.setup_of(case)
        yield shown(name, "m", known_instants_rmse_m(setup, DECIDED_S))
        bound = known_instants_rmse_m(setup, DECIDED_S, every_step=True)
        yield shown(f"{name}, maybe at every step", "m", bound)
    hidden = walked[HIDDEN]
    worst, late = (_largest_hidden(hidden.ours, quantile) for quantile in (1.0, 0.95))
    row = required(f"{HIDDEN.name}: largest error of all runs then", "m", worst, worst < LOST_M)
    yield _beside(row, hidden, lambda f: _largest_hidden(f, 1.0))
    row = shown(f"{HIDDEN.name}: largest error then, 95 % of runs", "m", late)
    yield _beside(row, hidden, lambda f: _largest_hidden(f, 0.95))
    yield from _common(HIDDEN.name, hidden)


def _largest_hidden(figures: Figures, quantile: float) -> float:
    """Quantile over the runs of the largest error [m] while the anchor is hidden."""
    times = rectangle.setup_of(HIDDEN).times_s
    gone = (times >= HIDDEN_S[0]) & (times < HIDDEN_S[1])
    largest = np.nanmax(figures.error2[:, gone], axis=1)
    return float(np.sqrt(np.nanquantile(largest, quantile)))


def _troubled(troubled: dict[Case, Compared]) -> Iterator[Row]:
    """Errors of decided estimates in troubles that the tracker does not know of; no target."""
    for case, figures in troubled.items():
        name, ours = case.name, figures.ours
        row = shown(f"{name}: RMSE", "m", ours.rmse_m)
        yield _beside(row, figures, lambda f: f.rmse_m)
        row = shown(f"{name}: largest error, median run", "m", _median_largest(ours))
        yield _beside(row, figures, _median_largest)
        row = shown(f"{name}: NEES, mean (expected 2)", "1", ours.nees.mean)
        yield _beside(row, figures, lambda f: f.nees.mean)
        label = f"{name}: decided and more than {WRONG_M} m off"
        yield _beside(shown(label, "1", _share_wrong(ours)), figures, _share_wrong)
        yield from _common(name, figures)
        if case.trouble.wrong_s is not None:
            times = rectangle.setup_of(case).times_s
            repaired = _repair_s(np.sqrt(ours.error2), times)
            yield shown(f"{name}: repaired after, mean", "s", float(repaired.mean()))
            late = float(np.quantile(repaired, 0.95))
            yield shown(f"{name}: repaired after, 95 % of runs", "s", late)


def _median_largest(figures: Figures) -> float:
    """Median over the runs of the largest error [m]."""
    largest = np.nanmax(np.nan_to_num(figures.error2), axis=1)
    return float(np.sqrt(np.median(largest)))


def _share_wrong(figures: Figures) -> float:
    """Share of the scored estimates that are more than ``WRONG_M`` off."""
    error2 = figures.error2[np.isfinite(figures.error2)]
    return float((error2 > WRONG_M**2).mean())


def _repair_s(error: Array, times_s: Array) -> Array:
    """How long after ``WRONG_S`` the errors (runs, n) are small for good, and decided: (runs,)."""
    bad = ~(error <= WRONG_M)  # NaN, too
    bad[:, times_s < WRONG_S] = False
    last = error.shape[1] - 1 - np.argmax(bad[:, ::-1], axis=1)
    after: Array = times_s[np.minimum(last + 1, len(times_s) - 1)] - WRONG_S
    return np.where(bad.any(axis=1), after, 0.0)


def _sectors(
    choices: dict[Conditions, SectorShares], known: dict[Conditions, SectorShares]
) -> Iterator[Row]:
    """The paper's scheme decides by one step and keeps to it: its column is its rule on one step.

    known : the same by the library's defaults
    """
    target, defaults = choices[TARGET], known[TARGET]
    name, rule = "sector, L = 4 lambda", target.rule_share
    for step, least in RIGHT_AFTER.items():
        share = target.share_right(step)
        row = required(f"{name}: right after {step} steps", "1", share, share >= least)
        yield row.beside(rule, defaults.share_right(step))
        claimed = (float(f.claimed[:, step - 1].mean()) for f in (target, defaults))
        row = shown(f"{name}: its own probability after {step} steps", "1", next(claimed))
        yield row.beside(None, next(claimed))
        row = shown(f"{name}: decided after {step} steps", "1", target.share_decided(step))
        yield row.beside(1.0, defaults.share_decided(step))
        wrong = target.share_wrong(step)
        row = required(f"{name}: decided wrongly after {step} steps", "1", wrong, wrong <= 0.001)
        yield row.beside(1.0 - rule, defaults.share_wrong(step))
    poor, defaults = choices[POOR_HEADING], known[POOR_HEADING]
    for step in RIGHT_AFTER:
        label = f"{name}, heading sd 6 deg: right after {step} steps"
        row = shown(label, "1", poor.share_right(step))
        yield row.beside(poor.rule_share, defaults.share_right(step))
    label = f"{name}, heading sd 6 deg: decided wrongly after 5 steps"
    row = shown(label, "1", poor.share_wrong(5))
    yield row.beside(1.0 - poor.rule_share, defaults.share_wrong(5))
    for conditions in BY_BASELINE + BY_PHASE:
        result = choices[conditions]
        for step in RIGHT_AFTER:
            label = f"{conditions.name}: right after {step} steps"
            yield shown(label, "1", result.share_right(step)).beside(result.rule_share)


def _draw(
    seed: int, walked: dict[Case, Compared], choices: dict[Conditions, SectorShares], folder: Path
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
            {case.name: walked[case].ours.error2 for case in runs},
        ),
        "sectors": pictures.success(
            [(c, choices[c]) for c in by_baseline], [(c, choices[c]) for c in by_phase]
        ),
    }
    paths = []
    for name, figure in figures.items():
        path = folder / f"{name}.png"
        pictures.save(figure, path)
        paths.append(path)
    return paths
