"""Pictures of an evaluation: the map with error ellipses (fokin2020: Figs. 5, 6) and errors
against time. No display is needed.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from PIL import Image
from scipy.stats import chi2

from netpos.common.files import whole_file
from netpos.evaluation.evaluate import Evaluation, VueEvaluation
from netpos.evaluation.metrics import NS, clock_error_series
from netpos.evaluation.pairing import Trajectory, wrap_angle
from netpos.evaluation.survey import Survey
from netpos.messages.values import Array, TrackState

FORMATS = (".png", ".svg", ".pdf")
PNG_DPI = 110
PNG_COLOURS = 64
ELLIPSE_PROBABILITY = 0.95
ELLIPSES_PER_TRACK = 45
LABELLED_RSUS = 14
# Okabe and Ito's colours: distinct for any colour vision
TRACK_COLOURS = ("#0072B2", "#D55E00", "#CC79A7", "#009E73", "#56B4E9", "#E69F00")
RSU_COLOUR = "#117733"
BUILDING_COLOUR = "#E4E0D8"


def check_format(path: Path) -> None:
    """``ValueError`` for a file that is no picture by its suffix."""
    if path.suffix.lower() not in FORMATS:
        raise ValueError(
            f"{path}: pictures are written as {', '.join(FORMATS)}; choose one of these"
        )


def save(figure: Figure, path: Path, description: str = "") -> None:
    """Write a figure as PNG, SVG or PDF, by the file's suffix; ValueError for another.

    Files are small (a PNG has a palette of 64 colours), and the same figure gives the same SVG. An
    SVG carries ``description`` as text.
    """
    check_format(path)
    with whole_file(path) as draft:
        _draw(figure, draft, description)


def _draw(figure: Figure, path: Path, description: str) -> None:
    suffix = path.suffix.lower()
    frame: dict[str, Any] = {"bbox_inches": "tight", "pad_inches": 0.15}
    if suffix == ".png":
        drawn = io.BytesIO()
        figure.savefig(drawn, format="png", dpi=PNG_DPI, **frame)
        image = Image.open(drawn).convert("RGB")
        image.quantize(PNG_COLOURS, dither=Image.Dither.NONE).save(path, optimize=True)
    elif suffix == ".svg":
        about = {"Date": None, "Description": description or None}
        with rc_context({"svg.hashsalt": "netpos"}):
            figure.savefig(path, metadata=about, **frame)
    else:
        figure.savefig(path, **frame)


def ellipse_axes(
    cov: Array, probability: float = ELLIPSE_PROBABILITY
) -> tuple[Array, Array, Array]:
    """Axes of the ellipses that hold a share of a 2-D Gaussian.

    cov : (n, 2, 2) m^2. Returns full lengths of the major and minor axis (n,) m and the major
    axis' angle (n,) deg from east.
    """
    values, vectors = np.linalg.eigh(cov)
    lengths = 2.0 * np.sqrt(chi2.ppf(probability, 2) * np.maximum(values, 0.0))
    major = vectors[:, :, 1]
    return lengths[:, 1], lengths[:, 0], np.rad2deg(np.arctan2(major[:, 1], major[:, 0]))


def magnification(lengths: Array, extent_m: float) -> int:
    """How much to enlarge ellipses whose median length (n,) m would be lost on a map of an extent.

    1 where they show: at a fiftieth of the extent; else the next of 2, 5, 10, 20, ... that makes
    them so.
    """
    median = float(np.median(lengths))
    needed = 0.02 * extent_m / median if median > 0.0 else 1.0
    steps: list[int] = [digit * 10**power for power in range(4) for digit in (1, 2, 5)]
    return next((step for step in steps if step >= needed), steps[-1])


def _heard(evaluation: Evaluation) -> set[str]:
    return {
        source
        for vue in evaluation.vues.values()
        for status in vue.run.statuses
        for source in status.sources
    }


def _view(evaluation: Evaluation, heard: set[str]) -> tuple[Array, Array]:
    """Lower left and upper right corner (2,) m of the picture: the true tracks, the RSUs that
    were used, and a margin.
    """
    points = [vue.run.truth.position[:, :2] for vue in evaluation.vues.values()]
    points += [
        rsu.position[None, :2] for rsu in evaluation.rsus if not heard or rsu.rsu_id in heard
    ]
    return _around(np.concatenate(points))


def _around(every: Array) -> tuple[Array, Array]:
    """Corners (2,) m of a picture of points (n, 2) m."""
    low, high = every.min(axis=0), every.max(axis=0)
    extent = high - low
    margin = max(0.08 * float(extent.max()), 2.0)
    thin = np.maximum(0.2 * float(extent.max()) - extent, 0.0) / 2.0  # no view thinner than 2 : 10
    return low - margin - thin, high + margin + thin


def _draw_buildings(axes: Axes, evaluation: Evaluation | Survey) -> list[Patch]:
    if not len(evaluation.buildings):
        return []
    low, high = evaluation.buildings[:, :2], evaluation.buildings[:, 2:]
    corners = np.stack(
        [
            low,
            np.column_stack([high[:, 0], low[:, 1]]),
            high,
            np.column_stack([low[:, 0], high[:, 1]]),
        ],
        axis=1,
    )
    axes.add_collection(
        PolyCollection(
            list(corners), facecolor=BUILDING_COLOUR, edgecolor="#B8B2A6", lw=0.6, zorder=0
        )
    )
    return [Patch(facecolor=BUILDING_COLOUR, edgecolor="#B8B2A6", label="building")]


def _draw_rsus(axes: Axes, evaluation: Evaluation | Survey, heard: set[str]) -> list[Line2D]:
    low, high = np.array([axes.get_xlim(), axes.get_ylim()]).T
    edge = 0.01 * (high - low)
    seen = [
        rsu
        for rsu in evaluation.rsus
        if ((low + edge < rsu.position[:2]) & (rsu.position[:2] < high - edge)).all()
    ]
    handles = []
    groups = (
        ("RSU", [r for r in seen if not heard or r.rsu_id in heard], RSU_COLOUR),
        ("RSU, not used", [r for r in seen if heard and r.rsu_id not in heard], "#AAAAAA"),
    )
    for label, rsus, colour in groups:
        if not rsus:
            continue
        xy = np.array([r.position[:2] for r in rsus])
        handles += axes.plot(
            *xy.T, "^", ms=8, color=colour, mec="white", mew=0.8, label=label, zorder=5
        )
    if len(seen) <= LABELLED_RSUS:
        for rsu in seen:
            axes.annotate(
                rsu.rsu_id,
                (rsu.position[0], rsu.position[1]),
                xytext=(6, 5),
                textcoords="offset points",
                fontsize=8,
                color="#333333",
                annotation_clip=True,
                zorder=6,
            )
    return handles


def _draw_track(
    axes: Axes, name: str, vue: VueEvaluation, colour: str, extent_m: float
) -> list[Line2D]:
    truth, estimate = vue.run.truth.position, vue.scored.pairs.estimate
    handles = axes.plot(*truth[:, :2].T, color="black", lw=1.2, ls=(0, (4, 2)), zorder=2)
    handles[0].set_label("ground truth")
    n = len(estimate)
    if not n:
        return handles
    handles += axes.plot(
        *estimate.position[:, :2].T,
        color=colour,
        lw=1.3,
        marker="." if n <= 150 else "",
        ms=3.5,
        label=f"{name} estimate",
        zorder=3,
    )
    axes.plot(*estimate.position[0, :2], "o", mfc="white", mec=colour, ms=6, zorder=4)
    first = int(np.searchsorted(estimate.stamp_ns, vue.scored.from_ns))
    if first < n:
        chosen = np.unique(np.linspace(first, n - 1, ELLIPSES_PER_TRACK).astype(np.int64))
        handles += _draw_ellipses(axes, estimate.take(chosen), colour, extent_m)
    return handles


def _draw_ellipses(axes: Axes, shown: Trajectory, colour: str, extent_m: float) -> list[Line2D]:
    """The 95 % ellipses of some poses and their legend; none where no covariance is known."""
    cov = shown.position_cov[:, :2, :2]
    if not cov.any():
        return []
    major, minor, angle = ellipse_axes(cov)
    enlarged = magnification(major, extent_m)
    axes.add_collection(
        EllipseCollection(
            enlarged * major,
            enlarged * minor,
            angle,
            units="xy",
            offsets=shown.position[:, :2],
            offset_transform=axes.transData,
            facecolor=colour + "1C",
            edgecolor=colour + "A0",
            lw=0.8,
            zorder=3.5,
        )
    )
    handle = Line2D(
        [],
        [],
        marker="o",
        ls="",
        ms=9,
        mfc=colour + "1C",
        mec=colour + "A0",
        label="95 % ellipse" if enlarged == 1 else f"95 % ellipse × {enlarged}",
    )
    return [handle]


def draw_map(evaluation: Evaluation) -> Figure:
    """Plan view in map axes: buildings, RSUs, true and estimated tracks, 95 % ellipses evenly
    along the scored part of each track, enlarged (the legend says by how much) where they would
    be lost.

    A hollow dot marks the first estimate. Estimates outside the view are counted below it.
    """
    heard = _heard(evaluation)
    low, high = _view(evaluation, heard)
    extent = float((high - low).max())
    figure, axes = _plan(low, high)
    handles: list[Line2D | Patch] = []
    outside = 0
    for index, (name, vue) in enumerate(evaluation.vues.items()):
        handles += _draw_track(axes, name, vue, TRACK_COLOURS[index % len(TRACK_COLOURS)], extent)
        xy = vue.scored.pairs.estimate.position[:, :2]
        outside += int(np.count_nonzero(~((low <= xy) & (xy <= high)).all(axis=1)))
    handles += _draw_rsus(axes, evaluation, heard)
    handles += _draw_buildings(axes, evaluation)
    if outside:
        handles.append(Line2D([], [], ls="", label=f"{outside} estimates\noutside the view"))
    _explain(axes, handles, _title(evaluation))
    return figure


def _plan(low: Array, high: Array) -> tuple[Figure, Axes]:
    """An empty plan view between two corners (2,) m."""
    width, height = high - low
    scale = min(8.5 / width, 7.5 / height)
    figure = Figure(figsize=(width * scale + 1.0, height * scale + 1.0))
    axes = figure.add_subplot()
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="east [m]", ylabel="north [m]")
    axes.set_aspect("equal")
    axes.grid(color="#DDDDDD", lw=0.5, zorder=0)
    axes.set_axisbelow(True)
    return figure, axes


def _explain(axes: Axes, handles: list[Line2D | Patch], title: str) -> None:
    """Legend, each label once, and title."""
    unique = {str(handle.get_label()): handle for handle in handles}
    axes.legend(
        handles=list(unique.values()),
        loc="upper left",
        bbox_to_anchor=(1.0, 1.0),
        frameon=False,
        fontsize=9,
    )
    axes.set_title(title, loc="left", fontsize=10)


def draw_survey(survey: Survey) -> Figure:
    """Plan view of a recording without ground truth: buildings, RSUs and estimated tracks, with
    dots where the track was not TRACKING."""
    points = [vue.record.track.position[:, :2] for vue in survey.vues.values()]
    points += [rsu.position[None, :2] for rsu in survey.rsus]
    if not sum(map(len, points)):
        raise ValueError(f"{survey.path} has neither RSUs nor estimates: there is nothing to draw")
    figure, axes = _plan(*_around(np.concatenate(points)))
    handles: list[Line2D | Patch] = []
    for index, (name, vue) in enumerate(survey.vues.items()):
        colour = TRACK_COLOURS[index % len(TRACK_COLOURS)]
        track = vue.record.track
        xy = track.position[:, :2]
        handles += axes.plot(*xy.T, color=colour, lw=1.4, label=name)
        states = {s.stamp_ns: s.state for s in vue.record.statuses}
        poor = [
            states.get(stamp, TrackState.TRACKING) is not TrackState.TRACKING
            for stamp in track.stamp_ns.tolist()
        ]
        if any(poor):
            label = f"{name}, not TRACKING"
            handles += axes.plot(*xy[poor].T, "o", ms=3, mfc="none", mec="k", label=label)
    heard = {s for v in survey.vues.values() for st in v.record.statuses for s in st.sources}
    handles += _draw_rsus(axes, survey, heard)
    handles += _draw_buildings(axes, survey)
    _explain(axes, handles, f"{survey.path.name} (no ground truth)")
    return figure


def _title(evaluation: Evaluation) -> str:
    scores = [
        f"{name}: RMSE {vue.scored.figures.rmse_m:.2f} m, p95 {vue.scored.figures.p95_m:.2f} m"
        for name, vue in evaluation.vues.items()
        if vue.scored.figures.rmse_m is not None
    ]
    return "\n".join([evaluation.path.name, *scores[:4]])


def _scale(axes: Axes, *series: Array) -> None:
    """Symmetric limits that show 98 % of each series; spikes may leave the picture."""
    sizes = [float(np.percentile(np.abs(s), 98)) for s in series if s.size]
    limit = 1.25 * max(sizes, default=0.0) or 1.0
    axes.set_ylim(-limit, limit)


def _draw_component(axes: Axes, vue: VueEvaluation, t: Array, component: int, colour: str) -> None:
    pairs = vue.scored.pairs
    error = pairs.error[:, component]
    sd = np.sqrt(np.maximum(pairs.estimate.position_cov[:, component, component], 0.0))
    if sd.any():
        axes.fill_between(t, -3 * sd, 3 * sd, color=colour, alpha=0.10, lw=0, label="±3σ")
        axes.fill_between(t, -2 * sd, 2 * sd, color=colour, alpha=0.16, lw=0, label="±2σ")
    axes.plot(t, error, color=colour, lw=1.0, label="error")
    counted = pairs.estimate.stamp_ns >= vue.scored.from_ns
    _scale(axes, error[counted], 3 * sd[counted])
    axes.set_ylabel(("east [m]", "north [m]")[component])


def _draw_clock(axes: Axes, vue: VueEvaluation, start_ns: int, colour: str) -> None:
    stamps, error = clock_error_series(vue.run)
    axes.set(ylabel="clock [ns]", xlabel="time since the start of the ground truth [s]")
    if not stamps.size:
        axes.text(0.5, 0.5, "no clock truth", ha="center", transform=axes.transAxes, fontsize=9)
        return
    axes.plot((stamps - start_ns) / NS, error, color=colour, lw=1.0)
    _scale(axes, error[stamps >= vue.scored.from_ns])


def _draw_column(column: Array, name: str, vue: VueEvaluation, colour: str) -> None:
    pairs = vue.scored.pairs
    start = int(vue.run.truth.stamp_ns[0])
    t = (pairs.estimate.stamp_ns - start) / NS
    counted = pairs.estimate.stamp_ns >= vue.scored.from_ns
    for component in (0, 1):
        _draw_component(column[component], vue, t, component, colour)
    horizontal, heading = column[2:4]
    horizontal.plot(t, pairs.horizontal_error, color=colour, lw=1.0)
    horizontal.axhline(1.0, color="black", lw=0.8, ls=":", label="1 m")
    _scale(horizontal, pairs.horizontal_error[counted], np.ones(1))
    horizontal.set_ylim(bottom=0)
    horizontal.set_ylabel("horizontal [m]")
    errors = np.rad2deg(wrap_angle(pairs.estimate.heading - pairs.truth.heading))
    heading.plot(t, errors, color=colour, lw=1.0)
    _scale(heading, errors[counted])
    heading.set_ylabel("heading [°]")
    _draw_clock(column[4], vue, start, colour)
    for axes in column:
        axes.grid(color="#DDDDDD", lw=0.5)
        axes.margins(x=0.01)
        if counted.any() and not counted.all():
            axes.axvspan(t[0], t[counted][0], color="#999999", alpha=0.18, lw=0)
    column[0].legend(loc="upper right", ncols=3, fontsize=8)
    horizontal.legend(loc="upper right", fontsize=8)
    column[0].set_title(f"{name}: estimate − truth (grey: not scored)", loc="left", fontsize=10)


def draw_errors(evaluation: Evaluation) -> Figure:
    """Errors against time, a column per device: east and north with the filter's ±2σ and ±3σ,
    horizontal, heading, clock offset.
    """
    n = len(evaluation.vues)
    figure = Figure(figsize=(max(9.0, 6.0 * n), 9.0), layout="constrained")
    grid = figure.subplots(5, n, sharex="col", squeeze=False)
    for index, (name, vue) in enumerate(evaluation.vues.items()):
        _draw_column(grid[:, index], name, vue, TRACK_COLOURS[index % len(TRACK_COLOURS)])
    return figure


def draw_bounds(evaluation: Evaluation) -> Figure:
    """Horizontal error over time beside the tracker's own bounds, a panel per device: the
    longer half axis of the 95 % ellipse, and the protection level where it was reported.

    The scale is logarithmic; estimates that are not scored are left out.
    """
    n = len(evaluation.vues)
    figure = Figure(figsize=(8.0, 0.6 + 2.8 * n), layout="constrained")
    panels = figure.subplots(n, 1, sharex=True, squeeze=False)[:, 0]
    for index, (axes, (name, vue)) in enumerate(zip(panels, evaluation.vues.items(), strict=True)):
        _draw_bound_panel(axes, vue, TRACK_COLOURS[index % len(TRACK_COLOURS)])
        axes.set_ylabel(f"{name}\nposition error [m]" if n > 1 else "position error [m]")
    panels[-1].set_xlabel("time since the start of the ground truth [s]")
    return figure


def _draw_bound_panel(axes: Axes, vue: VueEvaluation, colour: str) -> None:
    counted = vue.scored.counted
    t = (counted.estimate.stamp_ns - int(vue.run.truth.stamp_ns[0])) / NS
    level_by_stamp = {s.stamp_ns: s.protection_level_m for s in vue.run.statuses}
    level = np.array(
        [level_by_stamp.get(stamp, -1.0) for stamp in counted.estimate.stamp_ns.tolist()]
    )
    if (level > 0.0).any():
        level = np.where(level > 0.0, level, np.nan)
        axes.plot(t, level, color=TRACK_COLOURS[1], lw=1.2, label="protection level")
    major, _, _ = ellipse_axes(counted.estimate.position_cov[:, :2, :2])
    if major.any():
        axes.plot(t, major / 2.0, color="black", lw=1.2, ls="--", label="95 % ellipse, half axis")
    axes.plot(t, counted.horizontal_error, color=colour, lw=0.8, label="error")
    axes.set_yscale("log")
    if counted.horizontal_error.size:
        axes.set_ylim(bottom=max(0.1 * float(np.median(counted.horizontal_error)), 1e-4))
    axes.grid(color="#DDDDDD", lw=0.5)
    axes.margins(x=0.01)
    axes.legend(frameon=False, fontsize=9, ncols=3, loc="lower left", bbox_to_anchor=(0.0, 1.0))
