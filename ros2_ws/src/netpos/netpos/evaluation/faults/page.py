"""The campaign as a table: what defeats the tracker first."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from netpos.evaluation.faults.outcome import Outcome

HEADS = (
    "fault",
    "scenario",
    "detected by",
    "error max [m]",
    "RMSE [m]",
    "beyond the level",
    "recovered after [s]",
    "estimates missing during, after",
    "finite",
)
_NONE = "–"


def worst_first(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Faults that ended the tracker, then those whose errors TRACKING covered, then those it did
    not recover from, then the others as they come; without those that do not apply."""
    return sorted((o for o in outcomes if o.applies), key=_rank)


def _rank(outcome: Outcome) -> tuple[bool, bool, int, bool]:
    excess = outcome.beyond - outcome.beyond_without
    return (
        not outcome.failed,
        not outcome.missed,
        -excess if outcome.missed else 0,
        outcome.recovered_s is not None,
    )


def row(outcome: Outcome) -> tuple[str, ...]:
    """The cells of one outcome, in the order of ``HEADS``."""
    beyond = f"{outcome.beyond} of {outcome.tracking}"
    if outcome.missed and outcome.worst_ratio is not None:
        beyond += f", up to {outcome.worst_ratio:.1f} times"
    if outcome.beyond_without:
        beyond += f" (without the fault {outcome.beyond_without})"
    finite = "yes" if outcome.finite else "NO"
    return (
        outcome.fault,
        outcome.scenario,
        "; ".join(outcome.detected) or "nothing",
        _number(outcome.max_m),
        _number(outcome.rmse_m),
        beyond,
        _NONE if outcome.recovered_s is None else f"{outcome.recovered_s:.1f}",
        f"{outcome.missing_during}, {outcome.missing_after}",
        finite if not outcome.crashed else f"ENDED: {outcome.crashed}",
    )


def _number(value: float | None) -> str:
    return _NONE if value is None else f"{value:.3g}"


def summary(outcomes: Sequence[Outcome]) -> str:
    """The campaign in a sentence."""
    ran = [o for o in outcomes if o.applies]
    counts: dict[str, Callable[[Outcome], bool]] = {
        "ended the tracker or made it publish what is no number": lambda o: o.failed,
        "were covered by TRACKING beyond the level": lambda o: o.missed,
        "were noticed by nothing": lambda o: not o.detected,
        "were not recovered from": lambda o: o.recovered_s is None,
    }
    parts = [f"{sum(map(test, ran))} {words}" for words, test in counts.items()]
    return f"{len(ran)} runs with a fault: {', '.join(parts)}."


def markdown(outcomes: Sequence[Outcome], command: str) -> str:
    """A Markdown page part: the command, the sentence, the table; misses in bold."""
    lines = [
        "<!-- Written by the command below; change the plan, not the table. -->",
        "",
        f"`{command}`",
        "",
        summary(outcomes),
        "",
        f"| {' | '.join(HEADS)} |",
        f"|{'---|' * len(HEADS)}",
    ]
    for outcome in worst_first(outcomes):
        cells = list(row(outcome))
        if outcome.missed:
            cells[5] = f"**{cells[5]}**"
        if outcome.failed:
            cells[8] = f"**{cells[8]}**"
        lines.append(f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |")
    return "\n".join(lines) + "\n"
