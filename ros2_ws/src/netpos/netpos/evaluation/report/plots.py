"""Plots of a report: maps, errors, integrity, residuals, level over time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from netpos.evaluation.evaluate import Evaluation, VueEvaluation
from netpos.evaluation.metrics import NS, clock_error_series
from netpos.evaluation.pairing import wrap_angle
from netpos.evaluation.pictures import (
    BUILDING_COLOUR,
    RSU_COLOUR,
    TRACK_COLOURS,
    ellipse_axes,
)
from netpos.evaluation.residuals import Series
from netpos.evaluation.survey import Survey, SurveyedVue
from netpos.messages.values import Array, RsuInfo, TrackState

_STATE_COLOURS = {
    TrackState.WAITING: "#BBBBBB",
    TrackState.INITIALISING: "#E69F00",
    TrackState.TRACKING: "#009E73",
    TrackState.COASTING: "#D55E00",
    TrackState.AMBIGUOUS: "#CC79A7",
}
# Marks that the slider of the map moves.
_NOW: dict[str, dict[str, Any]] = {
    "estimate": {"mode": "markers", "marker": {"size": 11, "color": "#222222"}},
    "truth": {
        "mode": "markers",
        "marker": {"size": 11, "color": "#D55E00", "symbol": "x-thin-open"},
    },
    "level": {"mode": "lines", "line": {"color": "#222222", "width": 1}},
}
ELLIPSES_PER_TRACK = 60
_SHOWN_MAX = 10_000  # points of a plot


def html(figure: go.Figure) -> str:
    """A piece of the page, which has the plotting script."""
    return str(
        figure.to_html(full_html=False, include_plotlyjs=False, config={"responsive": True})
    )


def _ellipses(vue: VueEvaluation) -> tuple[Array, Array]:
    """Outlines of 95 % ellipses as one line broken by NaN: east and north [m]."""
    estimate = vue.scored.pairs.estimate
    if not len(estimate) or not estimate.position_cov.any():
        return np.zeros(0), np.zeros(0)
    picks = np.unique(np.linspace(0, len(estimate) - 1, ELLIPSES_PER_TRACK).astype(np.int64))
    shown = estimate.take(picks)
    major, minor, angle = ellipse_axes(shown.position_cov[:, :2, :2])
    turn = np.append(np.linspace(0.0, 2.0 * np.pi, 33), np.nan)
    a = np.outer(major / 2, np.cos(turn))
    b = np.outer(minor / 2, np.sin(turn))
    c, s = np.cos(np.deg2rad(angle))[:, None], np.sin(np.deg2rad(angle))[:, None]
    centre = shown.position
    east, north = centre[:, :1] + c * a - s * b, centre[:, 1:2] + s * a + c * b
    return east.ravel(), north.ravel()


def _line(name: str, x: Array, y: Array, colour: str, **options: Any) -> go.Scatter:
    line = {"color": colour, "width": 1.5} | options.pop("line", {})
    return go.Scatter(x=x, y=y, name=name, mode="lines", line=line, **options)


def map_of_evaluation(evaluation: Evaluation) -> go.Figure:
    """Plan view: true and estimated tracks, ellipses, RSUs."""
    figure = go.Figure()
    for index, (name, vue) in enumerate(evaluation.vues.items()):
        colour = TRACK_COLOURS[index % len(TRACK_COLOURS)]
        of_it: dict[str, Any] = {"meta": name, "legendgroup": name}
        truth, estimate = vue.run.truth.position, vue.scored.pairs.estimate.position
        dashed = {"dash": "dash"}
        for label, x, y, options in (
            ("ground truth", truth[:, 0], truth[:, 1], {"line": dashed | {"color": "black"}}),
            ("estimate", estimate[:, 0], estimate[:, 1], {}),
            ("95 % ellipse", *_ellipses(vue), {"line": {"width": 0.7}, "opacity": 0.7}),
        ):
            figure.add_trace(_line(f"{name} {label}", x, y, colour, **options, **of_it))
    figure.add_trace(rsu_markers(evaluation.rsus))
    return as_map(figure, evaluation.buildings)


def errors(evaluation: Evaluation) -> go.Figure:
    """Position, heading and clock against time."""
    labels = ("east [m]", "north [m]", "horizontal [m]", "heading [°]", "clock offset [ns]")
    figure = make_subplots(rows=5, cols=1, shared_xaxes=True, vertical_spacing=0.02)
    for index, (name, vue) in enumerate(evaluation.vues.items()):
        colour = TRACK_COLOURS[index % len(TRACK_COLOURS)]
        pairs, start = vue.scored.pairs, int(vue.run.truth.stamp_ns[0])
        t = (pairs.estimate.stamp_ns - start) / NS
        heading = np.rad2deg(wrap_angle(pairs.estimate.heading - pairs.truth.heading))
        clock_ns, clock = clock_error_series(vue.run)
        series = [
            (t, pairs.error[:, 0]),
            (t, pairs.error[:, 1]),
            (t, pairs.horizontal_error),
            (t, heading),
            ((clock_ns - start) / NS, clock),
        ]
        for row, (x, y) in enumerate(series, start=1):
            options = {"legendgroup": name, "meta": name, "showlegend": row == 1}
            figure.add_trace(_line(name, x, y, colour, **options), row=row, col=1)
        for row in (1, 2):
            sd = np.sqrt(np.maximum(pairs.estimate.position_cov[:, row - 1, row - 1], 0.0))
            for sign in (-3, 3):
                dots = {"dash": "dot", "width": 1.0}
                band = _line(
                    f"{name} ±3σ",
                    t,
                    sign * sd,
                    colour,
                    line=dots,
                    legendgroup=f"{name} sd",
                    meta=name,
                    showlegend=row == 1 and sign == 3,
                )
                figure.add_trace(band, row=row, col=1)
    for row, label in enumerate(labels, start=1):
        figure.update_yaxes(title=label, row=row, col=1)
    figure.update_xaxes(title="time since the start of the ground truth [s]", row=5, col=1)
    return below(figure, 1000)


def integrity(evaluation: Evaluation) -> tuple[go.Figure, list[str]]:
    """Protection level against error, every epoch a point (a Stanford diagram): above the diagonal
    the level held. With it a sentence for each device that has levels."""
    figure, sentences, ends = go.Figure(), [], [1e-2, 1e0]
    for index, (name, vue) in enumerate(evaluation.vues.items()):
        counted = vue.scored.counted
        level_by_stamp = {s.stamp_ns: s.protection_level_m for s in vue.run.statuses}
        level = np.array(
            [level_by_stamp.get(stamp, -1.0) for stamp in counted.estimate.stamp_ns.tolist()]
        )
        known = level >= 0.0
        if not known.any():
            continue
        error, level = np.maximum(counted.horizontal_error[known], 1e-3), level[known]
        above = error > level
        sentences.append(
            f"{name}: {above.sum()} of {len(error)} errors above their level "
            f"({above.mean():.1e}); the largest is {(error / level).max():.2g} times its level."
        )
        step = max(len(error) // _SHOWN_MAX, 1)
        keep = above | (np.arange(len(error)) % step == 0)
        figure.add_trace(
            go.Scatter(
                x=error[keep],
                y=level[keep],
                name=name,
                meta=name,
                mode="markers",
                marker={"size": 3, "color": TRACK_COLOURS[index % len(TRACK_COLOURS)]},
            )
        )
        ends += [float(error.min()), float(level.max()), float(error.max())]
    ends = [min(ends), max(ends)]
    figure.add_trace(_line("error = level", np.array(ends), np.array(ends), "black"))
    figure.update_xaxes(title="horizontal error [m]", type="log")
    figure.update_yaxes(title="protection level [m]", type="log")
    return below(figure, 460), sentences


def rsu_markers(rsus: tuple[RsuInfo, ...]) -> go.Scatter:
    """The RSUs of a map."""
    sites = np.array([rsu.position for rsu in rsus]).reshape(-1, 3)
    return go.Scatter(
        x=sites[:, 0],
        y=sites[:, 1],
        text=[rsu.rsu_id for rsu in rsus],
        name="RSU",
        mode="markers",
        marker={"symbol": "triangle-up", "size": 11, "color": RSU_COLOUR},
    )


def as_map(figure: go.Figure, buildings: Array) -> go.Figure:
    """With buildings, equal axes, the marks of the slider, and no legend: it would take a narrow
    screen for itself."""
    for x_min, y_min, x_max, y_max in buildings:
        figure.add_shape(
            type="rect", x0=x_min, y0=y_min, x1=x_max, y1=y_max,
            fillcolor=BUILDING_COLOUR, line_width=0, layer="below",
        )  # fmt: skip
    for mark, options in _NOW.items():
        figure.add_trace(go.Scatter(x=[], y=[], name=mark, meta=f"now {mark}", **options))
    figure.update_xaxes(title="east [m]", constrain="domain")
    figure.update_yaxes(title="north [m]", scaleanchor="x", scaleratio=1)
    return below(figure, 640).update_layout(showlegend=False)


def below(figure: go.Figure, height: int) -> go.Figure:
    """With the legend below the plot, whatever the width."""
    figure.update_layout(
        height=height,
        template="plotly_white",
        margin={"t": 30, "b": 40, "l": 50, "r": 10},
        legend={"orientation": "h", "yanchor": "bottom", "y": 1.0, "x": 0.0},
    )
    return figure


def map_of_survey(survey: Survey) -> go.Figure:
    """Plan view: tracks, coloured by state, and RSUs."""
    figure = go.Figure()
    for name, vue in survey.vues.items():
        states = {s.stamp_ns: s.state for s in vue.record.statuses}
        xy = vue.record.track.position[:, :2]
        colours = [
            _STATE_COLOURS[states.get(stamp, TrackState.TRACKING)]
            for stamp in vue.record.track.stamp_ns.tolist()
        ]
        figure.add_trace(
            go.Scatter(
                x=xy[:, 0],
                y=xy[:, 1],
                name=name,
                meta=name,
                mode="lines+markers",
                line={"color": "#888888", "width": 1},
                marker={"color": colours, "size": 4},
            )
        )
    figure.add_trace(rsu_markers(survey.rsus))
    return as_map(figure, survey.buildings)


def over_time(name: str, vue: SurveyedVue) -> go.Figure:
    """State, sd and protection level, NIS over what is expected, measurements used."""
    statuses = vue.record.statuses
    start = statuses[0].stamp_ns if statuses else 0
    t = np.array([(s.stamp_ns - start) / NS for s in statuses])
    figure = make_subplots(rows=3, cols=1, shared_xaxes=True, vertical_spacing=0.04)
    lines: list[tuple[int, str, list[float | None], str]] = [
        (1, "position sd [m]", [s.position_sd_m or None for s in statuses], "#0072B2"),
        (
            1,
            "protection level [m]",
            [s.protection_level_m if s.protection_level_m >= 0.0 else None for s in statuses],
            "#D55E00",
        ),
        (
            2,
            "NIS / expected",
            [s.nis / s.nis_dof if s.nis_dof else None for s in statuses],
            "#555",
        ),
        (3, "measurements used", [float(s.used) for s in statuses], "#009E73"),
    ]
    for row, label, values, colour in lines:
        figure.add_trace(
            go.Scatter(
                x=t,
                y=values,
                name=label,
                meta=name,
                mode="lines",
                line={"color": colour, "width": 1},
            ),
            row=row,
            col=1,
        )
    for row, label in enumerate(("sd, level [m]", "NIS / expected", "used"), start=1):
        figure.update_yaxes(title=label, row=row, col=1)
    figure.update_yaxes(type="log", row=1, col=1)
    figure.update_xaxes(title=f"{name}: time since the first status [s]", row=3, col=1)
    return below(figure, 620)


def residuals(name: str, measured: Sequence[Series]) -> go.Figure:
    """A row per quantity: what each RSU measured, minus what it should have."""
    quantities = sorted({series.quantity for series in measured})
    figure = make_subplots(rows=max(len(quantities), 1), cols=1, shared_xaxes=True)
    start = min((int(series.stamp_ns[0]) for series in measured), default=0)
    rsus = sorted({series.rsu_id for series in measured})
    step = max(sum(len(series.residual) for series in measured) // _SHOWN_MAX, 1)
    for series in measured:
        options: dict[str, Any] = {"legendgroup": series.rsu_id, "meta": name}
        figure.add_trace(
            go.Scatter(
                x=(series.stamp_ns[::step] - start) / NS,
                y=series.residual[::step],
                name=series.rsu_id,
                mode="markers",
                marker={
                    "size": 3,
                    "color": TRACK_COLOURS[rsus.index(series.rsu_id) % len(TRACK_COLOURS)],
                },
                showlegend=series.quantity == quantities[0],
                **options,
            ),
            row=quantities.index(series.quantity) + 1,
            col=1,
        )
    for row, quantity in enumerate(quantities, start=1):
        of_it = [series for series in measured if series.quantity == quantity]
        shown = np.quantile(np.concatenate([s.residual for s in of_it]), [0.002, 0.998])
        margin = 0.1 * float(shown[1] - shown[0]) + 1e-3
        figure.update_yaxes(
            title=f"{quantity} [{of_it[0].unit or '1'}]",
            range=[float(shown[0]) - margin, float(shown[1]) + margin],
            row=row,
            col=1,
        )
    figure.update_xaxes(title=f"{name}: time [s]", row=max(len(quantities), 1), col=1)
    return below(figure, 200 + 220 * max(len(quantities), 1))
