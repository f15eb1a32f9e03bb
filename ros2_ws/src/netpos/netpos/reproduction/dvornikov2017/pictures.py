"""Pictures of dvornikov2017: gains, errors, stages, manoeuvres, crossing ways."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from netpos.evaluation.pictures import TRACK_COLOURS, save
from netpos.messages.values import Array
from netpos.reproduction.dvornikov2017.crossing import OBJECTS, Crossing
from netpos.reproduction.dvornikov2017.stages import CENTRAL, Pass, Stages
from netpos.reproduction.dvornikov2017.summary import NetworkSummary
from netpos.reproduction.dvornikov2017.truth import START_NS, crossing
from netpos.scenario.schema import NS
from netpos.tracking.networks.common_instant import step_matrices

__all__ = ["crossing_ways", "errors", "gains", "manoeuvres", "save", "stages"]

_GAIN_LABELS = ("$k_{11}$", "$k_{21}$ [1/s]", "$k_{31}$ [1/s²]")
_FIX_COLOUR = "#BBBBBB"


def gains_of(stage: Pass, jerk_density: float, fixes: Array, start: Array) -> Array:
    """(n, 3) gains from the x of a fix to x, its rate and its acceleration: what a fix changed
    over what it differed from the prediction."""
    means = np.vstack([start, stage.run(fixes, start)[0]])
    stamps = np.concatenate([[START_NS], stage.stamps_ns])
    gains = np.empty((len(fixes), 3))
    for k, dt_ns in enumerate(np.diff(stamps).tolist()):
        prediction = step_matrices(dt_ns, jerk_density)[0] @ means[k]
        change = means[k + 1] - prediction
        gains[k] = change[[0, 2, 4]] / (fixes[k, 0] - prediction[0])
    return gains


def gains(all_stages: Mapping[str, Stages], network: str, seed: int) -> Figure:
    """dvornikov2017 Fig. 6: elements of the gain matrix over time."""
    figure = Figure(figsize=(7.2, 6.4), layout="constrained")
    panels = figure.subplots(3, 1, sharex=True)
    for (label, built), colour in zip(all_stages.items(), TRACK_COLOURS, strict=False):
        setting = built.setting
        number = [n.name for n in setting.networks].index(network)
        stage = built.networks[number]
        truth = setting.truth(seed, stage.stamps_ns)
        start = setting.truth(seed, np.array([START_NS]))[0]
        gain_series = gains_of(
            stage, setting.tracker.jerk_density, stage.fixes(seed, truth), start
        )
        time = (stage.stamps_ns - START_NS) / NS
        for panel, values in zip(panels, gain_series.T, strict=True):
            panel.plot(time, values, color=colour, lw=1.0, label=label)
    for panel, label in zip(panels, _GAIN_LABELS, strict=True):
        panel.set(ylabel=label, yscale="log")
        panel.grid(alpha=0.3, which="both")
    panels[0].legend(frameon=False)
    panels[0].set_title(f"gains of the {network} filter (Fig. 6)", loc="left", fontsize=10)
    panels[-1].set(xlabel="time [s]")
    return figure


def errors(summary: NetworkSummary, seed: int, network: str, fused: str) -> Figure:
    """dvornikov2017 Fig. 7: errors of the fixes, of one network's track and of the fused one."""
    from netpos.reproduction.dvornikov2017.stages import stages_of  # noqa: PLC0415

    built = stages_of(summary.setting)
    number = [n.name for n in summary.setting.networks].index(network)
    stage = built.networks[number]
    truth = summary.setting.truth(seed, stage.stamps_ns)
    noise = stage.fixes(seed, truth)[:, 0] - truth[:, 0]
    figure = Figure(figsize=(9.0, 4.2), layout="constrained")
    axes = figure.subplots()
    time = (stage.stamps_ns - START_NS) / NS
    axes.plot(time, noise, ".", color=_FIX_COLOUR, ms=3, label=f"fixes of {network}, $f(n)$")
    for name, colour in ((network, TRACK_COLOURS[0]), (fused, TRACK_COLOURS[1])):
        axes.plot(summary.time_s, summary.errors[name][0, :, 0], color=colour, lw=1.0, label=name)
    for sign in (-5.0, 5.0):
        axes.axhline(sign, color="#444444", lw=0.8, ls=":")
    axes.set(xlabel="time [s]", ylabel="error of x [m]", title="one run (Fig. 7)")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False, ncols=3)
    return figure


def stages(summaries: Sequence[NetworkSummary], fused: str) -> Figure:
    """RMSE over all runs of both networks, the fused track and the centralised filter; NEES."""
    figure = Figure(figsize=(12.0, 3.2 * len(summaries)), layout="constrained")
    panels = figure.subplots(len(summaries), 2, squeeze=False)
    for (left, right), summary in zip(panels, summaries, strict=True):
        names = [n.name for n in summary.setting.networks] + [CENTRAL, "independent", fused]
        for name, colour in zip(names, TRACK_COLOURS, strict=False):
            rmse = np.sqrt((summary.errors[name] ** 2).sum(axis=2).mean(axis=0))
            left.plot(summary.time_s, rmse, color=colour, lw=1.0, label=name)
            nees = summary.nees(name).mean(axis=0)
            right.plot(summary.time_s, nees, color=colour, lw=0.7, label=name)
        right.axhline(2.0, color="#444444", lw=0.8, ls=":")
        left.set(xlabel="time [s]", ylabel="RMSE [m]", yscale="log")
        right.set(xlabel="time [s]", ylabel="mean NEES (2 expected)", ylim=(1.0, 3.5))
        left.set_title(summary.setting.name, loc="left", fontsize=10)
        for panel in (left, right):
            panel.grid(alpha=0.3, which="both")
        left.legend(frameon=False, fontsize=8, ncols=2)
    return figure


def manoeuvres(summaries: Sequence[NetworkSummary], network: str, fused: str) -> Figure:
    """What the floor of the gain gives and costs when the acceleration steps."""
    figure = Figure(figsize=(9.0, 6.4), layout="constrained")
    panels = figure.subplots(2, 1, sharex=True)
    for panel, name in zip(panels, (network, fused), strict=True):
        for summary, colour in zip(summaries, TRACK_COLOURS, strict=False):
            rmse = np.sqrt((summary.errors[name] ** 2).sum(axis=2).mean(axis=0))
            panel.plot(summary.time_s, rmse, color=colour, lw=1.0, label=summary.setting.name)
        for from_s, to_s in ((60.0, 65.0), (120.0, 130.0)):
            panel.axvspan(from_s, to_s, color="#EEEEEE", zorder=0)
        panel.set(ylabel=f"RMSE [m], {name}", yscale="log")
        panel.grid(alpha=0.3, which="both")
    panels[0].legend(frameon=False, fontsize=8)
    panels[1].set(xlabel="time [s] (grey: accelerating)")
    return figure


def crossing_ways(wide: Crossing, narrow: Crossing, seed: int) -> Figure:
    """The ways of one run around their meeting."""
    figure = Figure(figsize=(12.0, 5.6), layout="constrained")
    for panel, case in zip(figure.subplots(1, 2), (wide, narrow), strict=True):
        end_ns = START_NS + round(case.setting.duration_s * NS)
        stamps = np.arange(START_NS, end_ns + 1, NS // 2)
        ways = crossing(seed, OBJECTS, case.meeting_s, case.fan_deg, case.speed_mps)
        for number, (way, colour) in enumerate(zip(ways, TRACK_COLOURS, strict=False)):
            panel.plot(*way(seed, stamps)[:, :2].T, color=colour, label=f"object {number + 1}")
        panel.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
        panel.set_title(f"directions within {case.fan_deg:g}°", loc="left", fontsize=10)
        panel.grid(alpha=0.3)
        panel.legend(frameon=False, fontsize=8)
    return figure
