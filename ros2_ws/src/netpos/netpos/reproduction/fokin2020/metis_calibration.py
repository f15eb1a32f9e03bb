"""How the measurement errors of ``metis_madrid`` were chosen.

    python -m netpos.reproduction.fokin2020.metis_calibration --runs 200

prints, for waveforms and arrays that leave the energy of a beacon as it is, and for weaker
beacons, the RMSE and the clock offset sd of the paper's own filter, which section 2.4 of fokin2020
gives, and then of netpos. The first seed is one that no reproduction scores.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace

from netpos.evaluation.work import Work
from netpos.reproduction.experiment import Estimator, Experiment
from netpos.reproduction.fokin2020.paper import METIS
from netpos.reproduction.monte_carlo import Summary, monte_carlo

FIRST_SEED = 100_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """Errors to try: subcarriers between pilots, columns of a cylinder of 64 elements and their
    distance, power."""

    stride: int = 16
    columns: int = 16
    spacing_wavelengths: float = 0.5
    tx_power_dbm: float = -40.0

    @property
    def name(self) -> str:
        """Its parameters as a cell of a table."""
        return (
            f"stride {self.stride}, {self.columns} columns, "
            f"{self.spacing_wavelengths} wavelengths, {self.tx_power_dbm:g} dBm"
        )

    def of(self, experiment: Experiment, estimator: Estimator) -> Experiment:
        """An experiment on METIS with these errors."""
        errors = {
            "waveform.pilot_stride": self.stride,
            "waveform.tx_power_dbm": self.tx_power_dbm,
            "array.rows": 64 // self.columns,
            "array.columns": self.columns,
            "array.spacing_wavelengths": self.spacing_wavelengths,
        }
        changes = ((f"measurement.errors.{key}", value) for key, value in errors.items())
        return replace(
            experiment,
            name=f"{experiment.name}, {self.name}",
            changes=(*experiment.changes, *changes),
            estimator=estimator,
        )


CANDIDATES = (
    Candidate(),
    Candidate(tx_power_dbm=-54.0),
    Candidate(tx_power_dbm=-55.0),
    *(
        Candidate(stride=stride, columns=4, spacing_wavelengths=spacing)
        for stride in (4, 3)
        for spacing in (0.5, 0.4, 0.35, 0.3)
    ),
)


def _cell(summary: Summary) -> str:
    losses = summary.routes.losses
    lost = f", {losses} lost" if losses else ""
    return f"{summary.rmse_m:.2f} m, {summary.clock_sd_ns:.1f} ns{lost}"


def table(work: Work, candidates: tuple[Candidate, ...] = CANDIDATES) -> Iterator[str]:
    """Lines of a table: a candidate a line, the paper's filter and ours per interval."""
    experiments = [experiment for experiment, _, _ in METIS]
    heads = [f"{e.name}, {who}" for who in ("paper's filter", "netpos") for e in experiments]
    paper = [f"{rmse_m} m, {clock_ns:g} ns" for _, rmse_m, clock_ns in METIS]
    yield from map(_line, (["errors", *heads], ["---"] * 7, ["the paper", *paper, "", "", ""]))
    estimators: tuple[Estimator, ...] = ("paper", "scenario")
    for candidate in candidates:
        cells = [
            _cell(monte_carlo(work, candidate.of(experiment, estimator)))
            for estimator in estimators
            for experiment in experiments
        ]
        yield _line([candidate.name, *cells])


def _line(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--workers", type=int, default=None)
    options = parser.parse_args()
    with Work(options.runs, FIRST_SEED, options.workers) as work:
        for line in table(work):
            print(line, flush=True)


if __name__ == "__main__":
    main()
