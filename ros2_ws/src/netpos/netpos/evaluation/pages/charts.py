"""Bar charts of recorded figures, side by side."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from netpos.evaluation.pages.recorded import Recorded, number
from netpos.evaluation.pages.tables import TableError
from netpos.evaluation.pictures import save

# Okabe and Ito's colours: distinct for any colour vision; ours is the strongest
COLOURS = ("#999999", "#E69F00", "#0072B2", "#56B4E9")


@dataclass(frozen=True, slots=True, kw_only=True)
class Series:
    """Bars of one colour: the value ``show`` of the first figure of each experiment that matches
    the regular expression ``figure``."""

    title: str
    figure: str
    show: str = "ours"


@dataclass(frozen=True, slots=True, kw_only=True)
class Chart:
    """A group of bars per experiment that matches ``rows``; groups of the expression name it.
    Groups without a bar of ``require`` (a title of a series) are left out."""

    recorded: str
    rows: str
    ylabel: str
    series: tuple[Series, ...]
    log: bool = False


Bars = dict[str, dict[str, float]]
"""Values by title of the series and name of the group."""


def bars(chart: Chart, recorded: Recorded) -> Bars:
    """The values to draw; series without a value are left out.

    Raises
    ------
    TableError  nothing was recorded for any bar
    """
    values: Bars = {}
    for series in chart.series:
        for entry in recorded.entries:
            match = re.fullmatch(chart.rows, entry.experiment)
            value = getattr(entry, series.show)
            if match and re.fullmatch(series.figure, entry.figure) and _is_real(value):
                group = ", ".join(match.groups()) or entry.experiment
                values.setdefault(series.title, {}).setdefault(group, float(value))
    if not values:
        raise TableError(f"nothing recorded for {recorded.name} matches {chart.rows!r}")
    return values


def _is_real(value: object) -> bool:
    return isinstance(value, float | int)


def description(values: Bars) -> str:
    """The values as text; a chart carries it, so that it can be compared with the figures."""
    return "; ".join(
        f"{title}: "
        + ", ".join(f"{group} {number(value)}" for group, value in group_values.items())
        for title, group_values in values.items()
    )


def draw(chart: Chart, values: Bars) -> Figure:
    """Bars with their values above them."""
    groups = list(dict.fromkeys(group for one in values.values() for group in one))
    figure = Figure(figsize=(8.0, 3.4), layout="constrained")
    axes = figure.subplots()
    width = 0.8 / len(values)
    for index, (title, one) in enumerate(values.items()):
        colour = COLOURS[[series.title for series in chart.series].index(title) % len(COLOURS)]
        places = np.array([groups.index(group) for group in one], dtype=float)
        places += (index - (len(values) - 1) / 2) * width
        drawn = axes.bar(places, list(one.values()), 0.92 * width, color=colour, label=title)
        axes.bar_label(drawn, [number(value) for value in one.values()], fontsize=8, padding=2)
    axes.set_xticks(range(len(groups)), groups)
    axes.set_ylabel(chart.ylabel)
    axes.set_yscale("log" if chart.log else "linear")
    axes.margins(y=0.12)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", color="#DDDDDD", lw=0.5)
    axes.set_axisbelow(True)
    axes.legend(frameon=False, ncols=len(values), loc="lower left", bbox_to_anchor=(0.0, 1.0))
    return figure


def write(chart: Chart, recorded: Recorded, path: Path) -> None:
    """Draw the chart into an SVG file that carries its values as text."""
    values = bars(chart, recorded)
    save(draw(chart, values), path, description=description(values))
