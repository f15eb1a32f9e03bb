"""Pictures with the papers' axes: line of sight, passages with error ellipses, the street grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, PolyCollection
from matplotlib.figure import Figure

from netpos.estimation.state import POSITION
from netpos.evaluation.metrics import NS
from netpos.evaluation.pictures import (
    BUILDING_COLOUR,
    ELLIPSE_PROBABILITY,
    RSU_COLOUR,
    TRACK_COLOURS,
    ellipse_axes,
    save,
)
from netpos.messages.values import Array
from netpos.radio.propagation import LosModel, los_probability
from netpos.reproduction.experiment import Track
from netpos.reproduction.monte_carlo import BIN_M, Summary

__all__ = ["LOS_NAMES", "Sample", "grid", "line_of_sight", "passages", "save"]

LOS_NAMES: dict[LosModel, str] = {"uma": "UMa", "umi": "UMi", "rma": "RMa", "inh": "InH"}
_ELLIPSES = 40
_TRUTH_COLOUR = "#444444"


@dataclass(frozen=True, slots=True, kw_only=True)
class Sample:
    """One run of an experiment and the figures over all of them.

    rsus (m, 2) m; way (n, 2) m, the whole true way; buildings (k, 4) m
    """

    summary: Summary
    track: Track
    rsus: Array
    way: Array
    buildings: Array


def line_of_sight(distance_m: float = 200.0) -> Figure:
    """fokin2020 Fig. 4: probability of line of sight against plane distance."""
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = figure.subplots()
    d = np.linspace(0.0, distance_m, 401)
    for (model, name), colour in zip(LOS_NAMES.items(), TRACK_COLOURS, strict=False):
        axes.plot(d, los_probability(model, d), color=colour, label=name)
    axes.axvline(30.0, color="#999999", lw=0.8, ls=":")
    axes.set(
        xlabel="distance between RSU and VUE [m]",
        ylabel="probability of line of sight",
        xlim=(0.0, distance_m),
        ylim=(0.0, 1.02),
    )
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    return figure


def passages(samples: Sequence[Sample]) -> Figure:
    """fokin2020 Figs. 5, 6: per sample the track with error ellipses, and the error over time."""
    figure = Figure(figsize=(12.0, 3.4 * len(samples)), layout="constrained")
    for (left, right), sample in zip(
        figure.subplots(len(samples), 2, squeeze=False), samples, strict=True
    ):
        _draw_track(left, sample)
        _draw_errors(right, sample)
        right.set_title(sample.summary.experiment.name, loc="left", fontsize=10)
    return figure


def _draw_track(axes: Axes, sample: Sample) -> None:
    track = sample.track
    axes.plot(*sample.way.T, color="#BBBBBB", lw=4.0, label="true way")
    axes.plot(
        *track.mean[:, POSITION].T, ".-", ms=2, lw=0.7, color=TRACK_COLOURS[0], label="estimate"
    )
    _draw_ellipses(axes, track)
    axes.plot(*sample.rsus.T, "^", ms=8, color=RSU_COLOUR, mec="white", label="RSU", zorder=5)
    points = np.vstack([sample.way, sample.rsus])
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.1 * float((high - low).max())
    axes.set(
        xlabel="x [m]",
        ylabel="y [m]",
        xlim=(low[0] - margin, high[0] + margin),
        ylim=(low[1] - margin, high[1] + margin),
        aspect="equal",
    )
    axes.legend(frameon=False, fontsize=8, ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0))


def _draw_ellipses(axes: Axes, track: Track) -> None:
    tracked = np.flatnonzero(track.tracked)
    chosen = np.unique(tracked[np.linspace(0, tracked.size - 1, _ELLIPSES).astype(int)])
    major, minor, angle = ellipse_axes(track.cov[chosen, :2, :2])
    axes.add_collection(
        EllipseCollection(
            major,
            minor,
            angle,
            units="xy",
            offsets=track.mean[chosen, POSITION],
            offset_transform=axes.transData,
            facecolor="none",
            edgecolor=TRACK_COLOURS[1],
            lw=0.6,
        )
    )
    label = f"error ellipse, {100 * ELLIPSE_PROBABILITY:.0f} %"
    axes.plot([], [], "o", mfc="none", mec=TRACK_COLOURS[1], label=label)


def _draw_errors(axes: Axes, sample: Sample) -> None:
    track, summary = sample.track, sample.summary
    time = (track.stamps_ns - track.stamps_ns[0]) / NS
    axes.plot(time, track.error_m, lw=0.7, color=TRACK_COLOURS[0], label="error of this run")
    if summary.error2 is not None:
        axes.plot(
            time,
            np.sqrt(np.nanmean(summary.error2, axis=0)),
            color=TRACK_COLOURS[1],
            label=f"RMSE of {summary.runs} runs",
        )
    bound = np.sqrt(track.bound[:, 0, 0] + track.bound[:, 1, 1])
    axes.plot(time, bound, "--", color=_TRUTH_COLOUR, lw=1.0, label="Cramér-Rao bound")
    axes.set(xlabel="time [s]", ylabel="position error [m]", yscale="log", xlim=(0, time[-1]))
    axes.grid(alpha=0.3, which="both")
    axes.legend(frameon=False, fontsize=8)


def grid(summaries: Sequence[Summary], sample: Sample) -> Figure:
    """The street grid with one route, and the distribution of errors per experiment."""
    figure = Figure(figsize=(12.0, 5.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    _draw_track(left, sample)
    low, high = sample.buildings[:, :2], sample.buildings[:, 2:]
    corners = np.stack(
        [low, np.c_[high[:, 0], low[:, 1]], high, np.c_[low[:, 0], high[:, 1]]], axis=1
    )
    left.add_collection(
        PolyCollection(list(corners), facecolor=BUILDING_COLOUR, edgecolor="#B8B2A6", zorder=0)
    )
    edges = BIN_M * np.arange(1, len(sample.summary.histogram))
    for summary, colour in zip(summaries, TRACK_COLOURS, strict=False):
        share = np.cumsum(summary.histogram[:-1]) / summary.histogram.sum()
        label = f"{summary.experiment.name}: RMSE {summary.rmse_m:.2f} m"
        right.plot(edges, share, color=colour, label=label)
    right.set(
        xlabel="position error [m]",
        ylabel="share of estimates",
        xscale="log",
        xlim=(0.01, 20.0),
        ylim=(0.0, 1.0),
    )
    right.grid(alpha=0.3, which="both")
    right.legend(frameon=False, fontsize=8, loc="lower right")
    return figure
