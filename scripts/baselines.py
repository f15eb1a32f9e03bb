"""Rewrite the committed baselines: ``python scripts/baselines.py [CASE…]``, all cases by default.

``--worsen`` writes nothing: it makes the tracker worse on purpose, one way after the other, and
prints which figures leave their intervals.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from netpos.evaluation.guard import Baseline, losses, measured, pooled, read_baselines
from netpos.evaluation.guarded_runs import Case, Material, cases, thinned, track
from netpos.messages.values import RsuMeasurement

FOLDER = Path(__file__).resolve().parents[1] / "tests" / "baselines"
VARIANCES = (
    "azimuth_var",
    "elevation_var",
    "toa_var",
    "range_var",
    "phase_difference_var",
    "tdoa_var",
    "position_cov",
)
DENSITIES = (
    "accel_density_mps2_sqrthz",
    "accel_sd_mps2",
    "inertial_accel_density_mps2_sqrthz",
    "jerk_density",
)
Change = tuple[Callable[[Material], Material], Callable[[Mapping[str, Any]], Mapping[str, Any]]]


def declared(factor: float, material: Material) -> Material:
    """The same, with ``factor`` times the standard deviation declared by every measurement."""

    def item(value: Any) -> Any:
        if not isinstance(value, RsuMeasurement):
            return value
        return replace(value, **{name: factor**2 * getattr(value, name) for name in VARIANCES})

    return replace(material, items=[item(value) for value in material.items])


def fewer(material: Material) -> Material:
    """The same without a tenth of the measurements."""
    return thinned(material, 0.1, 1)


def noisier(parameters: Mapping[str, Any]) -> Mapping[str, Any]:
    """Twice the power of the process noise."""
    return {n: parameters[n] * 2.0**0.5 for n in DENSITIES if n in parameters}


def same(value: Any) -> Any:
    return value


def nothing(parameters: Mapping[str, Any]) -> Mapping[str, Any]:
    return {}


WORSE: dict[str, Change] = {
    "declared sd x 1.3": (partial(declared, 1.3), nothing),
    "declared sd / 1.3": (partial(declared, 1 / 1.3), nothing),
    "declared sd x 1.1": (partial(declared, 1.1), nothing),
    "process noise x 2": (same, noisier),
    "no gate": (same, lambda _: {"gate_probability": 1.0}),
    "gate at 0.99": (same, lambda _: {"gate_probability": 0.99}),
    "a tenth of the measurements lost": (fewer, nothing),
    "filter ekf": (same, lambda _: {"filter": "ekf"}),
    "filter srukf": (same, lambda _: {"filter": "srukf"}),
}


def measure(name: str) -> tuple[str, Baseline]:
    """The baseline of one case."""
    return name, measured(cases()[name])


def worsen(name: str) -> list[str]:
    """One line for each way of making a case worse."""
    case, baseline = cases()[name], read_baselines(FOLDER)[name]
    runs_by_way: dict[str, list[Any]] = {way: [] for way in WORSE}
    for material in case.materials():
        for way, (change, parameters) in WORSE.items():
            changed = parameters(material.settings.parameters)
            runs_by_way[way] += track(change(material), changed)
    return [_notice(name, way, baseline, pooled(runs)) for way, runs in runs_by_way.items()]


def _notice(name: str, way: str, baseline: Baseline, figures: Mapping[str, Any]) -> str:
    left = [sentence.split()[1] for sentence in losses(name, baseline, dict(figures))]
    cells = []
    for figure in left:
        interval, value = baseline.figures[figure], figures[figure]
        if interval is None or value is None:
            cells.append(f"{figure} appeared or went")
        else:
            cells.append(f"{figure} {interval.value:.3g} -> {value:.3g}")
    return f"{name:24s} {way:34s} {', '.join(cells) or 'not noticed'}"


def remove_stale(known: Mapping[str, Case]) -> None:
    """Remove the baselines of cases that are gone."""
    for path in FOLDER.glob("*.json"):
        if path.stem not in known:
            path.unlink()
            sys.stdout.write(f"removed {path.name}\n")


def chosen(names: Sequence[str], known: Mapping[str, Case]) -> list[str]:
    """The cases that can run; exits with 2 for an unknown name."""
    for name in names:
        if name not in known:
            sys.stderr.write(f"no case {name!r}; known: {', '.join(known)}\n")
            sys.exit(2)
    wanted = [known[name] for name in names or known]
    for case in wanted:
        if case.missing:
            sys.stderr.write(f"{case.name} keeps its baseline: {case.missing}\n")
    return [case.name for case in wanted if not case.missing]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", metavar="CASE")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--worsen", action="store_true")
    options = parser.parse_args()
    known = cases()
    names = chosen(options.cases, known)
    with ProcessPoolExecutor(options.workers) as pool:
        if options.worsen:
            for lines in pool.map(worsen, names):
                sys.stdout.write("\n".join(lines) + "\n")
                sys.stdout.flush()
            return
        FOLDER.mkdir(exist_ok=True)
        remove_stale(known)
        for name, baseline in pool.map(measure, names):
            (FOLDER / f"{name}.json").write_text(baseline.to_text(), encoding="utf-8")
            sys.stdout.write(f"wrote {name}.json: {baseline.runs} runs\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
