#!/usr/bin/env python3
"""Compare today's tracker with a particle filter on six canonical problems.

    python scripts/oracle.py [--problem N] [--seeds 50] [--particles 10000] [--json FILE]
        [--document docs/oracle.md]

Truth and measurements are drawn from the model, and both filters know its parameters. What is
furthest from its target comes first. Exit 0 done, 1 a file could not be written, 2 bad usage.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "ros2_ws/src/netpos/test/support"))

from oracle_problems import PROBLEMS  # noqa: E402
from oracle_scores import Check, Moment, compare, doubled, summarise  # noqa: E402
from oracle_table import tables, write_between_marks  # noqa: E402
from script_parts import positive  # noqa: E402

CHECKED = 4  # seeds that are run again with twice the particles


def _share(text: str) -> float:
    value = float(text)
    if not 0.1 <= value <= 1.0:
        raise argparse.ArgumentTypeError(f"must be in [0.1, 1], got {value}")
    return value


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--problem", type=int, choices=sorted(PROBLEMS), help="only this one")
    parser.add_argument("--seeds", type=positive, default=50, help="runs a problem")
    parser.add_argument("--first-seed", type=int, default=0, help="seed of the first run")
    parser.add_argument("--particles", type=positive, default=10_000)
    parser.add_argument("--share", type=_share, default=1.0, help="end every run earlier")
    parser.add_argument("--json", type=Path, help="write all figures to this file")
    parser.add_argument("--document", type=Path, help="write the tables between its marks")
    return parser


def _run(problem: int, seeds: range, options: argparse.Namespace) -> list[Moment]:
    moments = []
    for done, seed in enumerate(seeds, start=1):
        moments += compare(problem, seed, options.particles, options.share)
        sys.stderr.write(f"\rproblem {problem}: {done} of {len(seeds)} runs")
        sys.stderr.flush()
    sys.stderr.write("\n")
    return moments


def main(arguments: Sequence[str] | None = None) -> int:
    """Run, print both tables, write what was asked for."""
    options = _parser().parse_args(arguments)
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    moments: list[Moment] = []
    checks: list[Check] = []
    summaries = []
    for problem in [options.problem] if options.problem else sorted(PROBLEMS):
        own = _run(problem, seeds, options)
        moments += own
        summaries.append(summarise(own))
        for seed in seeds[:CHECKED]:
            checks += doubled(problem, seed, options.particles, options.share)
    text = tables(summaries, checks)
    sys.stdout.write(text + "\n")
    figures = {
        "seeds": [seeds.start, seeds.stop],
        "particles": options.particles,
        "problems": [summary.to_json() for summary in summaries],
        "moments": [asdict(moment) for moment in moments],
        "checks": [asdict(check) for check in checks],
    }
    try:
        if options.json:
            options.json.write_text(json.dumps(figures, indent=1), encoding="utf-8")
        if options.document:
            write_between_marks(options.document, text)
    except (OSError, ValueError) as error:
        sys.stderr.write(f"error: {error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
