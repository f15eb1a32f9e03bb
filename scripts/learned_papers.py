#!/usr/bin/env python3
"""Measure what learning costs where a paper gives the errors and RSUs state them.

    python scripts/learned_papers.py [--runs 20] [--seed 1] [--workers N] [--json FILE]

Simulate the papers' experiments, track each seed with the errors as stated and with learned ones,
and score both alike. Figures are of all runs together. Exit 0 done, 2 bad usage.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
from netpos.evaluation.sweep import Plan, sweep
from netpos.evaluation.work import Work
from netpos.reproduction.experiment import Experiment
from netpos.reproduction.fokin2020.paper import FIG_5_FAST, FIG_5_SLOW, FIG_6, METIS, METIS_ONE_RSU

LEARNS = "tracker.learn_errors"
WALKS = tuple(
    Experiment(
        name=f"L = {name}",
        scenario="pedestrian_rectangle",
        changes=(("rsus.units.0.antennas.baseline_wavelengths", wavelengths),),
    )
    for name, wavelengths in (("4 lambda", 4.0), ("lambda/2", 0.5))
)
PAPERS: dict[str, tuple[Experiment, ...]] = {
    "fokin2020": (
        *(experiment for experiment, _, _ in (*METIS, METIS_ONE_RSU)),
        FIG_5_SLOW,
        FIG_5_FAST,
        *(experiment for variants in FIG_6 for experiment in variants[1:]),
    ),
    "petukhov": WALKS,
}


def figures(runs: pd.DataFrame) -> dict[str, float]:
    """Of all runs of one experiment and estimator together; a run without a scored estimate counts
    in availability, lost tracks and unscored time only."""
    scored = runs[runs["n"] > 0]
    weights = scored["n"].to_numpy(dtype=float)

    def mean(values: pd.Series) -> float:
        return float(np.average(values.to_numpy(dtype=float), weights=weights))

    return {
        "rmse_m": mean(scored["rmse_m"] ** 2) ** 0.5,
        "max_m": float(scored["max_m"].max()),
        "nees_mean": mean(scored["nees_mean"]),
        "availability": float(runs["availability"].mean()),
        "unscored_s": float(runs["unscored_s"].sum()),
        "lost_tracks": float(runs["lost_tracks"].sum()),
        "protection_exceeded": mean(scored["protection_exceeded"]),
    }


def row(paper: str, experiment: Experiment, work: Work) -> dict[str, object]:
    """The figures of an experiment with the errors as stated and with learned ones."""
    fixed = dict(experiment.changes)
    fixed |= {f"tracker.{name}": value for name, value in experiment.tracker}
    values = {key: (value,) for key, value in fixed.items()} | {LEARNS: (False, True)}
    table = sweep(Plan(experiment.scenario, values), work)
    learned = table[LEARNS].to_numpy(dtype=bool)
    return {
        "name": f"{paper}: {experiment.name}",
        "runs": work.runs,
        "stated": figures(table[~learned]),
        "learned": figures(table[learned]),
    }


def rows(work: Work) -> Iterator[dict[str, object]]:
    """One for each experiment of each paper."""
    for paper, experiments in PAPERS.items():
        for experiment in experiments:
            yield row(paper, experiment, work)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=20, help="seeds of each experiment (20)")
    parser.add_argument("--seed", type=int, default=1, help="the first of them (1)")
    parser.add_argument("--workers", type=int, default=None, help="processes; one per processor")
    parser.add_argument("--json", type=Path, help="write the figures there")
    chosen = parser.parse_args()
    measured = []
    try:
        with Work(chosen.runs, chosen.seed, chosen.workers) as work:
            for one in rows(work):
                measured.append(one)
                print(json.dumps(one), flush=True)
    except ValueError as error:
        print(f"learned_papers: {error}", file=sys.stderr)
        return 2
    if chosen.json is not None:
        document = {"runs": chosen.runs, "seed": chosen.seed, "rows": measured}
        chosen.json.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
