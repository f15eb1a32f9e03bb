"""The comparison with the particle filter as Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from oracle_scores import TARGETS, Check, Summary, off_one

BEGIN, END = "<!-- table: oracle -->", "<!-- end of table -->"
_HEAD = (
    "| problem | mean apart, sd (median) | trace off (median ratio) | radius off (median ratio) |"
    " modes off | RMSE m, oracle / tracker | NEES, oracle / tracker | median NEES | in 95 % circle"
    " | silent |"
)
_CHECK_HEAD = (
    "| problem | NEES (bounds) | truth in 95 % circle | p of ranks | modes, mean / most |"
    " Gaussian radius | twice the particles: mean, sd | trace off | radius off | modes off |"
)


def _rule(head: str) -> str:
    return "|---" * (head.count("|") - 1) + "|"


def _number(value: float | None, form: str = ".2f") -> str:
    return "–" if value is None else format(value, form)


def _judged(summary: Summary, key: str, form: str, ratio: float | None = None) -> str:
    """Difference, bold where it misses its target."""
    value = summary.differences[key]
    if value is None:
        return "–"
    text = format(value, form)
    text = f"**{text}**" if value > TARGETS[key] else text
    return text if ratio is None else f"{text} ({ratio:.2f})"


def comparison(summaries: Sequence[Summary]) -> list[str]:
    """A line a problem, the one furthest from its targets first."""
    lines = [_HEAD, _rule(_HEAD)]
    for s in sorted(summaries, key=lambda s: -s.excess()):
        nees = _number(s.tracker_nees)
        bounds = s.tracker_nees_bounds
        if s.tracker_nees is not None and bounds is not None:
            outside = not bounds[0] <= s.tracker_nees <= bounds[1]
            nees = f"**{nees}**" if outside else nees
        cells = (
            f"{s.problem} {s.name}",
            _judged(s, "mean", ".2f", s.mean_apart_median),
            _judged(s, "trace", ".0%", s.trace_ratio),
            _judged(s, "radius", ".0%", s.radius_ratio),
            _judged(s, "modes", ".3f"),
            f"{_number(s.rmse_beside)} / {_number(s.tracker_rmse)}",
            f"{s.nees:.2f} / {nees}",
            f"{s.nees_median:.2f} / {_number(s.tracker_nees_median)}",
            f"{s.covered:.1%} / {_number(s.tracker_covered, '.1%')}",
            f"{s.silent:.0%}",
        )
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def own_check(summaries: Sequence[Summary], checks: Sequence[Check]) -> list[str]:
    """A line a problem: is the oracle right on average, and does it have enough particles."""
    lines = [_CHECK_HEAD, _rule(_CHECK_HEAD)]
    for s in summaries:
        own = [c for c in checks if c.problem == s.problem]
        mean, modes = (
            float(np.mean([getattr(c, name) for c in own])) if own else None
            for name in ("mean_apart", "modes_apart")
        )
        trace, radius = (
            off_one(np.array([getattr(c, name) for c in own]))
            for name in ("trace_ratio", "radius_ratio")
        )
        cells = (
            f"{s.problem}",
            f"{s.nees:.2f} ({s.nees_bounds[0]:.2f}–{s.nees_bounds[1]:.2f})",
            f"{s.covered:.1%}",
            f"{s.rank_p:.2f}",
            f"{s.modes_mean:.2f} / {s.modes_max}",
            f"{s.own_radius:.2f}",
            _number(mean),
            _number(trace, ".0%"),
            _number(radius, ".0%"),
            _number(modes, ".3f"),
        )
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def tables(summaries: Sequence[Summary], checks: Sequence[Check]) -> str:
    """Both tables."""
    return "\n".join([*comparison(summaries), "", *own_check(summaries, checks)])


def write_between_marks(document: Path, text: str) -> None:
    """Replace what is between the marks of a document.

    Raises ``ValueError`` for a document without both marks in their order.
    """
    old = document.read_text(encoding="utf-8")
    begin, end = old.find(BEGIN), old.find(END)
    if not 0 <= begin < end:
        raise ValueError(f"{document} has no {BEGIN} … {END}; add both lines where tables belong")
    new = f"{old[: begin + len(BEGIN)]}\n{text}\n{old[end:]}"
    document.write_text(new, encoding="utf-8")
