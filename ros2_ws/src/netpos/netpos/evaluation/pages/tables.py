"""Tables of recorded figures as Markdown."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from typing import Any, TypeVar

from netpos.evaluation.pages.recorded import Entry, Recorded, Value, number

SOURCES = {
    "paper": "paper",
    "baseline": "paper's filter",
    "ours": "ours",
    "defaults": "defaults",
}
"""Title of each value of an entry."""

Spec = TypeVar("Spec")


class TableError(ValueError):
    """A table that cannot be rendered; the text says which pattern is wrong."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """Figures in one column of a table, or in one per value that is shown.

    figure : regular expression that matches the whole name of the figure; several matches of one
        experiment are written with a slash between them
    show : values, keys of ``SOURCES``
    bounds : regular expression of the two figures written in brackets after the value
    percent : a share, written in percent
    """

    title: str
    figure: str
    show: tuple[str, ...] = ("ours",)
    bounds: str = ""
    percent: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """A line per experiment that matches ``rows`` as a whole, in the order they were recorded.
    Groups of the expression name the line. ``having``: regular expression of a figure that a line
    must have. Without columns: a line per figure."""

    rows: str
    having: str = ""
    heading: str = "experiment"
    columns: tuple[Column, ...] = ()


def checked(kind: type[Spec], data: dict[str, Any], where: str) -> Spec:
    """A value of a dataclass from a mapping; ``TableError`` for keys it does not know or lacks."""
    unknown = set(data) - {field.name for field in fields(kind)}  # type: ignore[arg-type]
    if unknown:
        raise TableError(f"{where}: unknown key {min(unknown)!r}")
    try:
        return kind(**data)
    except TypeError as error:
        raise TableError(f"{where}: {error}") from error


def markdown(header: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """A Markdown table; every line ends with a newline."""
    rows = [header, ["---"] * len(header), *lines]
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def render(table: Table, recorded: Recorded) -> str:
    """The table with every figure that misses its target in bold; columns without any value are
    left out.

    Raises
    ------
    TableError  a pattern of the table matches nothing
    """
    chosen = _experiments(table, recorded)
    if not table.columns:
        return _listed(chosen)
    header, cells = [table.heading], [[title] for title in chosen]
    for column in table.columns:
        groups = [_matching(column.figure, entries) for entries in chosen.values()]
        edges = [_matching(column.bounds, e) if column.bounds else [] for e in chosen.values()]
        for pattern, matches in ((column.figure, groups), (column.bounds, edges)):
            if pattern and not any(matches):
                raise TableError(f"no figure of {table.rows!r} matches {pattern!r}")
        for source in column.show:
            texts = [
                _cell(group, source, column) + _bounds(edge)
                for group, edge in zip(groups, edges, strict=True)
            ]
            if all(text == "–" for text in texts) and len(column.show) > 1:
                continue
            several = len(column.show) > 1
            header.append(f"{column.title}, {SOURCES[source]}" if several else column.title)
            for line, text in zip(cells, texts, strict=True):
                line.append(text)
    return markdown(header, cells)


def _experiments(table: Table, recorded: Recorded) -> dict[str, list[Entry]]:
    """Entries of each line by its title."""
    chosen: dict[str, list[Entry]] = {}
    for entry in recorded.entries:
        match = re.fullmatch(table.rows, entry.experiment)
        if match:
            groups = [text for text in match.groups() if text]
            chosen.setdefault(", ".join(groups) or entry.experiment, []).append(entry)
    if table.having:
        chosen = {
            title: entries
            for title, entries in chosen.items()
            if any(entry.ours is not None for entry in _matching(table.having, entries))
        }
    if not chosen:
        raise TableError(f"nothing recorded for {recorded.name} matches {table.rows!r}")
    return chosen


def _matching(pattern: str, entries: Iterable[Entry]) -> list[Entry]:
    return [entry for entry in entries if re.fullmatch(pattern, entry.figure)]


def _cell(entries: Sequence[Entry], source: str, column: Column) -> str:
    texts = []
    for entry in entries:
        text = _text(getattr(entry, source), column.percent)
        texts.append(f"**{text}**" if entry.ok is False and source == "ours" else text)
    return "–" if all(text == "–" for text in texts) else " / ".join(texts)


def _text(value: Value, percent: bool) -> str:
    if percent and isinstance(value, float | int):
        return f"{number(100.0 * value)} %"
    return number(value)


def _bounds(entries: Sequence[Entry]) -> str:
    return f" ({' to '.join(number(entry.ours) for entry in entries)})" if entries else ""


def _listed(chosen: dict[str, list[Entry]]) -> str:
    """Every figure of the experiments on a line of its own."""
    used = [
        s for s in SOURCES if any(getattr(e, s) is not None for v in chosen.values() for e in v)
    ]
    lines = [
        [
            f"{title}: {entry.figure}" if entry.figure else title,
            entry.unit if entry.unit != "1" else "",
            *(_cell([entry], source, Column(title="", figure="")) for source in used),
        ]
        for title, entries in chosen.items()
        for entry in entries
    ]
    return markdown(["figure", "unit", *(SOURCES[source] for source in used)], lines)


def missed(recorded: Recorded) -> str:
    """The list of figures that miss their target, or a sentence that there is none."""
    count = f"{len(recorded.missed)} of {recorded.judged} figures with a target miss it"
    if not recorded.missed:
        return f"{count}.\n"
    lines = [
        [entry.name, f"**{_with_unit(entry)}**", entry.target or "own requirement"]
        for entry in recorded.missed
    ]
    return f"{count}:\n\n" + markdown(["missed", "ours", "target"], lines)


def _with_unit(entry: Entry) -> str:
    unit = "" if entry.unit == "1" else entry.unit
    return f"{number(entry.ours)} {unit}".rstrip()


def summary(every: Iterable[Recorded]) -> str:
    """How many targets each page misses."""
    lines = [
        [f"[{r.name}]({r.name}.md)", str(len(r.missed)), str(r.judged)] for r in every if r.judged
    ]
    return markdown(["page", "missed", "figures with a target"], lines)
