"""A recording without ground truth for the report: tables, map, residuals, level over time."""

from __future__ import annotations

from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from netpos.evaluation.metrics import NS
from netpos.evaluation.pictures import BUILDING_COLOUR, RSU_COLOUR, TRACK_COLOURS
from netpos.evaluation.summary import RESIDUAL_HEAD, residual_rows, survey_rows
from netpos.evaluation.survey import Survey, SurveyedVue
from netpos.messages.values import Array, RsuInfo, TrackState

_STATE_COLOURS = {
    TrackState.WAITING: "#BBBBBB",
    TrackState.INITIALISING: "#E69F00",
    TrackState.TRACKING: "#009E73",
    TrackState.COASTING: "#D55E00",
    TrackState.AMBIGUOUS: "#CC79A7",
}
_SHOWN_MAX = 20_000  # points of a series


def section(survey: Survey) -> dict[str, object]:
    """What the template of the report takes."""
    tables: list[dict[str, object]] = [
        {
            "caption": "Figures",
            "head": ["figure", "unit", *survey.vues],
            "rows": survey_rows(survey),
        }
    ]
    plots = [_html(map_of(survey))]
    notes = list(survey.notes)
    for name, vue in survey.vues.items():
        notes += [f"{name}: {text}" for text in vue.figures.suggestions]
        tables.append(
            {
                "caption": f"{name}: measured minus where the track is",
                "head": list(RESIDUAL_HEAD),
                "rows": residual_rows(vue),
            }
        )
        plots += [_html(_over_time(name, vue)), _html(_residuals(name, vue))]
    return {
        "name": f"{survey.path.name} (no ground truth)",
        "notes": notes,
        "tables": tables,
        "plots": plots,
    }


def _html(figure: go.Figure) -> str:
    return str(
        figure.to_html(full_html=False, include_plotlyjs=False, config={"responsive": True})
    )


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
    """With buildings, equal axes and a legend that leaves a narrow screen to the map."""
    for x_min, y_min, x_max, y_max in buildings:
        figure.add_shape(
            type="rect", x0=x_min, y0=y_min, x1=x_max, y1=y_max,
            fillcolor=BUILDING_COLOUR, line_width=0, layer="below",
        )  # fmt: skip
    figure.update_xaxes(title="east [m]", constrain="domain")
    figure.update_yaxes(title="north [m]", scaleanchor="x", scaleratio=1)
    return below(figure, 640)


def below(figure: go.Figure, height: int) -> go.Figure:
    """With the legend below the plot, whatever the width."""
    figure.update_layout(
        height=height,
        template="plotly_white",
        margin={"t": 30, "b": 40, "l": 50, "r": 10},
        legend={"orientation": "h", "yanchor": "bottom", "y": 1.0, "x": 0.0},
    )
    return figure


def map_of(survey: Survey) -> go.Figure:
    """Plan view: tracks, coloured by state, and RSUs."""
    figure = go.Figure()
    for name, vue in survey.vues.items():
        states = {s.stamp_ns: s.state for s in vue.record.statuses}
        poses = vue.record.odometry
        xy = np.array([pose.position[:2] for pose in poses]).reshape(-1, 2)
        colours = [
            _STATE_COLOURS[states.get(pose.stamp_ns, TrackState.TRACKING)] for pose in poses
        ]
        figure.add_trace(
            go.Scatter(
                x=xy[:, 0],
                y=xy[:, 1],
                name=name,
                mode="lines+markers",
                line={"color": "#888888", "width": 1},
                marker={"color": colours, "size": 4},
            )
        )
    figure.add_trace(rsu_markers(survey.rsus))
    return as_map(figure, survey.buildings)


def _over_time(name: str, vue: SurveyedVue) -> go.Figure:
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
                x=t, y=values, name=label, mode="lines", line={"color": colour, "width": 1}
            ),
            row=row,
            col=1,
        )
    for row, label in enumerate(("sd, level [m]", "NIS / expected", "used"), start=1):
        figure.update_yaxes(title=label, row=row, col=1)
    figure.update_yaxes(type="log", row=1, col=1)
    figure.update_xaxes(title=f"{name}: time since the first status [s]", row=3, col=1)
    return below(figure, 620)


def _residuals(name: str, vue: SurveyedVue) -> go.Figure:
    """A row per quantity: what each RSU measured, minus where the track is."""
    quantities = sorted({series.quantity for series in vue.series})
    figure = make_subplots(rows=max(len(quantities), 1), cols=1, shared_xaxes=True)
    start = min((int(series.stamp_ns[0]) for series in vue.series), default=0)
    rsus = sorted({series.rsu_id for series in vue.series})
    for series in vue.series:
        step = max(len(series.residual) // _SHOWN_MAX, 1)
        options: dict[str, Any] = {"legendgroup": series.rsu_id}
        figure.add_trace(
            go.Scattergl(
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
        of_it = [series for series in vue.series if series.quantity == quantity]
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
