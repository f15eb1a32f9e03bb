"""Recorded figures as one list of entries, for all commands.

An entry has the name of an experiment and of a figure: a paper's row ``Fig. 5, T = 0.1 s: RMSE``
is the figure ``RMSE`` of the experiment ``Fig. 5, T = 0.1 s``; a recording's ``ours: {rmse_m: 1}``
is the figure ``ours.rmse_m`` of the recording.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from netpos.common.quantity import quantity

Value = float | str | None

PROMISED_RISK = 1e-4
"""Largest share of errors above the protection level (``integrity_risk`` of a tracker)."""
EXPECTED_AVAILABILITY = 0.99
_EDGES = ("lower", "upper")
_SIGNS = {">=": "≥", "<=": "≤"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """One measured figure. ok: whether it keeps its target (None: it has none); target says which
    in words, "" where the row does not say."""

    experiment: str
    figure: str
    unit: str = ""
    paper: Value = None
    baseline: Value = None
    ours: Value = None
    defaults: Value = None
    ok: bool | None = None
    target: str = ""

    @property
    def name(self) -> str:
        """Experiment and figure, without the ``ours.`` of a recording's figures."""
        figure = self.figure.removeprefix("ours.")
        return f"{self.experiment}: {figure}" if figure else self.experiment


@dataclass(frozen=True, slots=True, kw_only=True)
class Recorded:
    """All entries of one file. method: a sentence, how they were measured."""

    name: str
    entries: tuple[Entry, ...]
    method: str

    @property
    def missed(self) -> tuple[Entry, ...]:
        """Entries that do not keep their target."""
        return tuple(entry for entry in self.entries if entry.ok is False)

    @property
    def judged(self) -> int:
        """Number of entries with a target."""
        return sum(entry.ok is not None for entry in self.entries)


def number(value: Value) -> str:
    """Three significant digits; whole numbers in full; an en dash for None."""
    if value is None:
        return "–"
    if isinstance(value, str):
        return value.replace("|", "\\|")
    if value == int(value) or abs(value) >= 1000.0:
        return f"{value:.0f}"
    return f"{value:.3g}"


def split_name(name: str) -> tuple[str, str]:
    """Experiment and figure of a paper's row: around the last colon outside brackets."""
    places = [m.start() for m in re.finditer(": ", name)]
    for position in reversed(places):
        figure = name[position + 2 :]
        if figure.count("(") == figure.count(")"):
            return name[:position], figure
    return name, ""


def read_recorded(path: Path, full_runs: Mapping[str, int]) -> Recorded:
    """Read one file of ``docs/results/recorded``.

    full_runs : runs of the full measurement by name; fewer are marked in ``method``. A file may
        have a ``note``, a sentence on what was not measured, which ``method`` then ends with.

    Raises
    ------
    ValueError  the file is not what one of the commands writes
    """
    data = json.loads(path.read_text(encoding="utf-8"))
    name = path.stem
    read = _READERS.get(name, _read_paper)
    try:
        entries, method = read(data)
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{path} lacks what the command writes ({error}); measure it again: "
            f"scripts/results.sh {name}"
        ) from error
    if data.get("note"):
        method += f" {data['note']}"
    runs, full = data.get("runs"), full_runs.get(name)
    if runs is not None and full is not None and runs < full:
        method += f" **Few runs:** {runs} instead of {full}; the figures are provisional."
    return Recorded(name=name, entries=tuple(entries), method=method)


def _read_paper(data: Mapping[str, Any]) -> tuple[list[Entry], str]:
    """``netpos reproduce PAPER --json``."""
    entries = []
    for row in data["rows"]:
        named = split_name(row["name"])
        values = {key: row.get(key) for key in ("unit", "paper", "baseline", "ours", "defaults")}
        entries.append(Entry(experiment=named[0], figure=named[1], ok=row["ok"], **values))
    known = {(entry.experiment, entry.figure): entry for entry in entries}
    method = (
        f"Measured by `netpos reproduce {data['paper']} --runs {data['runs']} --seed "
        f"{data['seed']}` in {data['wall_s']:.0f} s: {_seeds(data)}."
    )
    return [replace(entry, target=_target(entry, known)) for entry in entries], method


def _seeds(data: Mapping[str, Any]) -> str:
    runs, seed = data["runs"], data["seed"]
    return f"{runs} runs (seeds {seed} to {seed + runs - 1})"


def _target(entry: Entry, known: Mapping[tuple[str, str], Entry]) -> str:
    """The target of a paper's row, as far as the row, its bounds or its name say it."""
    if entry.ok is None:
        return ""
    for stem in (entry.figure, entry.figure.split(",")[0]):
        pair = [known.get((entry.experiment, f"{stem}, {edge} 95 % bound")) for edge in _EDGES]
        if pair[0] is not None and pair[1] is not None:
            return f"{number(pair[0].ours)} to {number(pair[1].ours)}"
    if entry.paper is not None:
        return f"{number(entry.paper)} {entry.unit if entry.unit != '1' else ''}".rstrip()
    promised = re.search(r"\(promised ([^)]*)\)", entry.figure)
    return f"at most {promised[1]}" if promised else ""


def _read_speed(data: Mapping[str, Any]) -> tuple[list[Entry], str]:
    """``netpos bench --json``."""
    entries = []
    for row in data["rows"]:
        reference = row["reference"] or "the limit itself"
        name = f"{row['name']}, against {reference}"
        target = f"{_SIGNS[row['relation']]} {row['target']:g}"
        shown = {
            "ours": quantity(row["ours"], row["unit"]),
            "reference": quantity(row["reference_value"], row["unit"]),
            "target": target,
        }
        entries += [Entry(experiment=name, figure=f, ours=v) for f, v in shown.items()]
        judged = {"ours": row["ratio"], "ok": row["ok"], "target": target}
        entries.append(Entry(experiment=name, figure="ratio", **judged))
    for row in data["left_out"]:
        entries.append(Entry(experiment=row["name"], figure="left out", ours=row["reason"]))
    around = data["surroundings"]
    method = (
        f"Measured by `netpos bench` on {around['cores']} cores ({around['machine']}, Python "
        f"{around['python']}); load average before it {around['load_average'][0]:.1f}."
    )
    if around["quick"]:
        method += " **Quick run:** few rounds; the figures are provisional."
    if data["left_out"]:
        names = ", ".join(row["name"] for row in data["left_out"])
        method += f" **Not measured here:** {names}."
    return entries, method


def _flat(value: object, key: str = "") -> Iterator[tuple[str, Value]]:
    """Leaves of nested mappings and lists by their dotted keys; truth values are left out."""
    if isinstance(value, Mapping):
        for name, part in value.items():
            yield from _flat(part, f"{key}.{name}" if key else str(name))
    elif isinstance(value, list):
        for index, part in enumerate(value):
            yield from _flat(part, f"{key}.{index}")
    elif not isinstance(value, bool):
        assert value is None or isinstance(value, float | int | str)
        yield key, value


def _read_table(command: str) -> Callable[[Mapping[str, Any]], tuple[list[Entry], str]]:
    """A reader of rows that are not judged here: ``{"rows": [{"name": ..., figures}]}``; a row
    may have ``targets``, by figure whether it is ``ok`` and the ``target`` in words."""

    def read(data: Mapping[str, Any]) -> tuple[list[Entry], str]:
        entries = []
        for row in data["rows"]:
            name, targets = row["name"], row.get("targets", {})
            for figure, value in _flat(row):
                if figure != "name":
                    judged = targets.get(figure, {})
                    entries.append(Entry(experiment=name, figure=figure, ours=value, **judged))
        seeds = f": {_seeds(data)}" if "seed" in data else ""
        return entries, f"Measured by `{command}`{seeds}."

    return read


def _read_recordings(data: Mapping[str, Any]) -> tuple[list[Entry], str]:
    """``scripts/real_data.py --json``: ours against the authors' figure and both baselines."""
    entries: list[Entry] = []
    for row in data["rows"]:
        figures = {figure: value for figure, value in _flat(row) if figure != "name"}
        verdicts = dict(_verdicts(figures))
        for figure, value in figures.items():
            ok, target = verdicts.get(figure, (None, ""))
            entries.append(
                Entry(experiment=row["name"], figure=figure, ours=value, ok=ok, target=target)
            )
    return entries, "Measured by `python scripts/real_data.py`."


def _verdicts(figures: Mapping[str, Value]) -> Iterator[tuple[str, tuple[bool, str]]]:
    """Which figures of our tracker miss what a user expects of them: to be better than every
    reference, consistent, always there, and below the level it promised."""

    def real(*names: str) -> tuple[str, float] | None:
        for name in names:
            value = figures.get(name)
            if isinstance(value, float | int):
                return name, float(value)
        return None

    rmse = real("ours.rmse_m", "ours.rmse")
    references = [
        (label, real(key, f"{key}.rmse_m", f"{key}.rmse")) for label, key in _REFERENCES.items()
    ]
    limits = [(reference[1], label) for label, reference in references if reference is not None]
    if rmse is not None and limits:
        limit, label = min(limits)
        yield rmse[0], (rmse[1] <= limit, f"≤ {number(limit)} ({label})")
    nees = real("ours.nees_mean")
    low = real("ours.nees_bounds.0", "ours.bounds.0")
    high = real("ours.nees_bounds.1", "ours.bounds.1")
    if nees is not None and low is not None and high is not None:
        inside = low[1] <= nees[1] <= high[1]
        yield nees[0], (inside, f"{number(low[1])} to {number(high[1])}")
    for name, limit, at_most in _LIMITS:
        figure = real(f"ours.{name}")
        if figure is not None:
            kept = figure[1] <= limit if at_most else figure[1] >= limit
            yield figure[0], (kept, f"{'≤' if at_most else '≥'} {limit:g}")


_REFERENCES = {
    "the authors": "reference",
    "snapshot least squares": "snapshot",
    "plain Kalman filter": "plain_ekf",
}
_LIMITS: Iterable[tuple[str, float, bool]] = (
    ("availability", EXPECTED_AVAILABILITY, False),
    ("lost_tracks", 0.0, True),
    ("protection_exceeded", PROMISED_RISK, True),
)
_READERS: Mapping[str, Callable[[Mapping[str, Any]], tuple[list[Entry], str]]] = {
    "speed": _read_speed,
    "real_data": _read_recordings,
    "scenarios": _read_table("netpos run SCENARIO --offline, netpos evaluate"),
    "learned": _read_table("python scripts/learned_papers.py"),
    "error_grid": _read_table("python scripts/error_grid.py"),
    "random_networks": _read_table("python scripts/random_networks.py"),
    "fewer_rsus": _read_table("python scripts/fewer_rsus.py --parts whole without from"),
    "halved": _read_table("python scripts/fewer_rsus.py --parts two backwards"),
    "walking": _read_table("python scripts/pdr_results.py"),
}
