"""One self-contained HTML file on one or several recordings: tables, maps, errors. The plotting
script is inside, no network is needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import plotly.graph_objects as go
from plotly.offline import get_plotlyjs
from plotly.subplots import make_subplots

from netpos import __version__
from netpos.evaluation import survey_plots
from netpos.evaluation.evaluate import Evaluation, VueEvaluation, assess_bag
from netpos.evaluation.metrics import NS, SKIP_EPOCHS, clock_error_series
from netpos.evaluation.pairing import wrap_angle
from netpos.evaluation.pictures import TRACK_COLOURS, ellipse_axes
from netpos.evaluation.summary import figure_rows, verdict_rows
from netpos.messages.values import Array

ELLIPSES_PER_TRACK = 60

_PAGE = jinja2.Template(
    """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>netpos report</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>
body{font:15px/1.45 system-ui,sans-serif;margin:2rem auto;max-width:76rem;
padding:0 1rem;color:#222}
table{border-collapse:collapse;margin:.6rem 2rem 1.2rem 0;font-size:14px}
caption{text-align:left;font-weight:600;padding:.3rem 0}
td,th{white-space:nowrap;border-bottom:1px solid #ddd;padding:.15rem .7rem;text-align:right}
td:first-child,th:first-child{text-align:left;white-space:normal}
.tables{display:flex;flex-wrap:wrap;align-items:flex-start}
.tables>div{overflow-x:auto;max-width:100%}
.ok{color:#117733}.bad{color:#aa2222}
</style><script>{{ script }}</script></head><body>
<h1>netpos report</h1>
<p>netpos {{ version }}. The first {{ skip }} estimates of each device are not scored,
nor those before it is first TRACKING. Position errors are horizontal unless named otherwise.</p>
{% for reason in left_out %}<p class="bad">Left out: {{ reason|e }}</p>{% endfor %}
{% for s in sections %}<h2>{{ s.name|e }}</h2>
{% for note in s.notes %}<p class="bad">{{ note|e }}</p>{% endfor %}
<div class="tables">{% for t in s.tables %}
<div tabindex="0"><table><caption>{{ t.caption }}</caption>
<tr>{% for c in t.head %}<th>{{ c|e }}</th>{% endfor %}</tr>
{% for r in t.rows %}<tr>{% for c in r %}
<td class="{{ 'ok' if '✓' in c else 'bad' if '✗' in c }}">{{ c|e }}</td>{% endfor %}</tr>
{% endfor %}</table></div>{% endfor %}</div>
{% for p in s.plots %}{{ p }}{% endfor %}{% endfor %}
</body></html>
"""
)


def bags_in(source: Path) -> list[Path]:
    """The bag itself, or the bags in a folder of bags, sorted.

    Raises
    ------
    ValueError  nothing there, or a folder without bags
    """
    if not source.exists():
        raise ValueError(f"{source} does not exist; check the path")
    if source.is_file() or (source / "metadata.yaml").exists() or any(source.glob("*.mcap")):
        return [source]
    found = (*source.glob("*/metadata.yaml"), *source.glob("*/*.mcap"))
    bags = sorted({path.parent for path in found})
    if not bags:
        raise ValueError(f"{source} is neither a bag nor a folder of bags")
    return bags


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


def _map(evaluation: Evaluation) -> go.Figure:
    figure = go.Figure()
    for index, (name, vue) in enumerate(evaluation.vues.items()):
        colour = TRACK_COLOURS[index % len(TRACK_COLOURS)]
        truth, estimate = vue.run.truth.position, vue.scored.pairs.estimate.position
        figure.add_trace(
            _line(f"{name} ground truth", truth[:, 0], truth[:, 1], "black", line={"dash": "dash"})
        )
        figure.add_trace(_line(f"{name} estimate", estimate[:, 0], estimate[:, 1], colour))
        east, north = _ellipses(vue)
        figure.add_trace(
            _line(f"{name} 95 % ellipse", east, north, colour, line={"width": 0.7}, opacity=0.7)
        )
    figure.add_trace(survey_plots.rsu_markers(evaluation.rsus))
    return survey_plots.as_map(figure, evaluation.buildings)


def _errors(evaluation: Evaluation) -> go.Figure:
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
            options = {"legendgroup": name, "showlegend": row == 1}
            figure.add_trace(_line(name, x, y, colour, **options), row=row, col=1)
        for row in (1, 2):
            sd = np.sqrt(np.maximum(pairs.estimate.position_cov[:, row - 1, row - 1], 0.0))
            for sign in (-3, 3):
                dots = {"dash": "dot", "width": 1.0}
                band = _line(
                    f"{name} ±3σ", t, sign * sd, colour, line=dots, legendgroup=f"{name} sd",
                    showlegend=row == 1 and sign == 3,
                )  # fmt: skip
                figure.add_trace(band, row=row, col=1)
    for row, label in enumerate(labels, start=1):
        figure.update_yaxes(title=label, row=row, col=1)
    figure.update_xaxes(title="time since the start of the ground truth [s]", row=5, col=1)
    return survey_plots.below(figure, 1000)


def _section(evaluation: Evaluation) -> dict[str, object]:
    names = list(evaluation.vues)
    accuracy = {"caption": "Figures", "head": ["figure", "unit", *evaluation.columns()]}
    verdicts = {"caption": "Requirements", "head": ["set", "requirement", "required", *names]}
    plots = [
        figure.to_html(full_html=False, include_plotlyjs=False, config={"responsive": True})
        for figure in (_map(evaluation), _errors(evaluation))
    ]
    return {
        "name": evaluation.path.name,
        "notes": evaluation.notes,
        "tables": [
            accuracy | {"rows": figure_rows(evaluation)},
            verdicts | {"rows": verdict_rows(evaluation)},
        ],
        "plots": plots,
    }


def write_report(bags: Sequence[Path], out: Path, *, skip: int = SKIP_EPOCHS) -> list[str]:
    """Evaluate the bags and write the report. Of several bags those that cannot be evaluated are
    left out; the reasons are in the report and returned.

    Raises
    ------
    ValueError  no bag can be evaluated, or ``out`` is not an .html file
    """
    if out.suffix.lower() not in {".html", ".htm"}:
        raise ValueError(f"{out}: the report is an HTML file; choose a name that ends in .html")
    sections: list[dict[str, object]] = []
    left_out: list[str] = []
    for bag in bags:
        try:
            found = assess_bag(bag, skip=skip)
            if isinstance(found, Evaluation):
                sections.append(_section(found))
            else:
                sections.append(survey_plots.section(found))
        except ValueError as error:
            left_out.append(str(error))
    if not sections:
        raise ValueError("; ".join(left_out))
    page = _PAGE.render(
        script=get_plotlyjs(),
        version=__version__,
        skip=skip,
        sections=sections,
        left_out=left_out,
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(page, encoding="utf-8")
    return left_out
