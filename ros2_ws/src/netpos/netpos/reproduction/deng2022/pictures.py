"""Pictures of deng2022: errors along a drive, and through an outage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from netpos.estimation.fixes.position_fix import FixStatus
from netpos.estimation.state import NAV_POSITION
from netpos.evaluation.metrics import NS
from netpos.evaluation.pictures import TRACK_COLOURS
from netpos.reproduction.deng2022.blocked_drive import FIX, LOOSE, VEHICLE, Run, ned
from netpos.reproduction.deng2022.car_drive import Outages

_AXES = ("north", "east", "down")


def drive_errors(runs: Sequence[tuple[str, Run]]) -> Figure:
    """deng2022 Figs. 3, 4: north, east and down errors of a drive, a column per case."""
    figure = Figure(figsize=(6.4 * len(runs), 7.0), layout="constrained")
    grid = figure.subplots(3, len(runs), squeeze=False, sharex=True)
    for column, (name, done) in enumerate(runs):
        time = (done.stamps_ns - done.stamps_ns[0]) / NS
        fixes = done.fixes[FIX]
        good = fixes.status == FixStatus.CONVERGED
        fixed = ned(fixes.position - done.antenna)
        for row, axis in enumerate(_AXES):
            axes = grid[row, column]
            axes.plot(
                time[good], fixed[good, row], ".", ms=2, color="#BBBBBB", label="least squares"
            )
            for variant, colour in zip((LOOSE, VEHICLE), TRACK_COLOURS, strict=False):
                error = ned(done.drives[variant].nav[:, NAV_POSITION] - done.position)[:, row]
                axes.plot(time, error, lw=0.9, color=colour, label=f"SINS, {variant}")
            axes.set(ylabel=f"{axis} error [m]")
            axes.grid(alpha=0.3)
        grid[0, column].set_title(name, loc="left", fontsize=10)
        grid[0, column].legend(frameon=False, fontsize=8, ncols=3)
        grid[-1, column].set(xlabel="time [s]")
    return figure


def outage_curves(curves: Mapping[str, Outages]) -> Figure:
    """Median and 95 % of the horizontal error over the time without RTK."""
    figure = Figure(figsize=(7.0, 4.4), layout="constrained")
    axes = figure.subplots()
    for (name, outages), colour in zip(curves.items(), TRACK_COLOURS, strict=False):
        low, high = np.percentile(outages.error, [50, 95], axis=0)
        n = len(outages.error)
        axes.plot(outages.time_s, low, color=colour, label=f"{name}: median of {n} outages")
        axes.plot(outages.time_s, high, "--", color=colour, lw=0.9, label=f"{name}: 95 %")
    axes.plot([5.0, 10.0], [0.70, 2.56], "o", color="#444444", label="crude coast: median")
    axes.set(
        xlabel="time without RTK [s]",
        ylabel="horizontal error [m]",
        yscale="log",
        xlim=(0.0, float(next(iter(curves.values())).time_s[-1])),
        ylim=(0.05, 200.0),
    )
    axes.grid(alpha=0.3, which="both")
    axes.legend(frameon=False, fontsize=8)
    return figure
