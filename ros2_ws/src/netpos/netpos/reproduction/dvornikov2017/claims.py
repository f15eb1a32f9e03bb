"""Claims of dvornikov2017, judged for both networks and for the fused track; and the columns of
its rows."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from netpos.estimation.forms.kf import DVORNIKOV_FLOOR
from netpos.messages.values import Array
from netpos.reproduction.dvornikov2017.pictures import gains_of
from netpos.reproduction.dvornikov2017.stages import FixNetwork, Ints, stages_of
from netpos.reproduction.dvornikov2017.summary import LOST_M, NetworkSummary
from netpos.reproduction.dvornikov2017.truth import START_NS
from netpos.reproduction.frame import Row, at_least, at_most, required, shown
from netpos.scenario.schema import NS

FUSED = "split_ci"
LIMIT_M, LIMIT_FROM_S = 5.0, 15.0  # "at the 15th second ... 5 metres"
WITHIN_M = 10.0  # "accuracy within 10 metres", of the abstract
REDUCTION = 20.0  # "almost 20 times, from 100 m to 5 metres"; 100 m^2 is the variance of a fix
FIRST_GAIN, NEAR = 1.0, 0.1  # "so that the first gains tend to one"
STEADY_S = 60.0

Figure = Callable[[NetworkSummary, str], float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Sides:
    """One object, three ways: our settings, the paper's filter (its gain floor, Q = 0) and the
    library's defaults. The paper has no fused track: beside ours is its better network."""

    ours: NetworkSummary
    paper: NetworkSummary
    defaults: NetworkSummary

    @property
    def better(self) -> str:
        """The network that is better by the paper's filter."""
        names = [network.name for network in self.paper.setting.networks]
        return min(names, key=lambda name: self.paper.rmse_m(name, LIMIT_FROM_S))

    def row(self, name: str, figure: Figure, make: Callable[[float | None], Row]) -> Row:
        """``make`` of our figure of an estimator, with the two others beside it."""
        baseline = figure(self.paper, self.better if name == FUSED else name)
        row = make(_known(figure(self.ours, name)))
        return row.beside(_known(baseline), _known(figure(self.defaults, name)))

    def nees(
        self, name: str, from_s: float, label: str, *, demanded: bool = True, bound: bool = False
    ) -> Row:
        """Mean NEES, two-sided, or as a ``bound``: not too large."""
        test = self.ours.nees_test(name, from_s)

        def make(value: float | None) -> Row:
            if test is None or not demanded:
                return shown(label, "1", value)
            ok = test.mean <= test.bounds[1] if bound else test.consistent
            return required(label, "1", value, ok)

        return self.row(name, lambda summary, who: _mean_nees(summary, who, from_s), make)


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value


def _mean_nees(summary: NetworkSummary, name: str, from_s: float) -> float:
    test = summary.nees_test(name, from_s)
    return math.nan if test is None else test.mean


def lost_rows(sides: Sides, name: str, label: str, *, demanded: bool = True) -> Iterator[Row]:
    """Errors above 5 m, time without an estimate, runs lost; ``demanded``: none may be lost."""
    limit = f"{label}: share of runs with an error above 5 m from the 15th second"
    yield sides.row(
        name,
        lambda summary, who: summary.share_of_runs_above(who, LIMIT_M, LIMIT_FROM_S),
        lambda value: shown(limit, "1", value),
    )
    yield sides.row(
        name,
        lambda summary, who: summary.share_without(who),
        lambda value: shown(f"{label}: share of instants without an estimate", "1", value),
    )
    lost = f"{label}: runs lost (no estimate at the end, or {LOST_M:g} m off)"
    yield sides.row(
        name,
        lambda summary, who: summary.lost(who),
        lambda value: (
            required(lost, "1", value, value == 0) if demanded else shown(lost, "1", value)
        ),
    )


def claims(sides: Sides) -> Iterator[Row]:
    """5 m by the 15th second and in steady state, both coordinates, fused and by each network."""
    networks = sides.ours.setting.networks
    for name in (FUSED, *(network.name for network in networks)):
        label = f"paper's motion, {'fused' if name == FUSED else name}"
        for axis, letter in enumerate("xy"):
            yield from _axis(sides, name, axis, f"{label}, {letter}")
        yield from lost_rows(sides, name, label)
    for network in networks:
        yield from _reduction(sides, network)


def _axis(sides: Sides, name: str, axis: int, label: str) -> Iterator[Row]:
    """One coordinate of one estimator."""
    limited: tuple[tuple[str, str, Figure, float], ...] = (
        (
            "RMSE at the 15th second",
            "m",
            lambda s, who: s.axis_rmse_m(who, axis, LIMIT_FROM_S, LIMIT_FROM_S + 0.5),
            LIMIT_M,
        ),
        (
            "time from which the RMSE stays within 5 m",
            "s",
            lambda s, who: s.axis_settled_s(who, axis, LIMIT_M),
            LIMIT_FROM_S,
        ),
        (
            "RMSE in steady state",
            "m",
            lambda s, who: s.axis_rmse_m(who, axis, STEADY_S),
            LIMIT_M,
        ),
        (
            "largest error in steady state, all runs",
            "m",
            lambda s, who: s.axis_largest_m(who, axis, STEADY_S),
            LIMIT_M,
        ),
        (
            "largest error from the 15th second, all runs (abstract: within 10 m)",
            "m",
            lambda s, who: s.axis_largest_m(who, axis, LIMIT_FROM_S),
            WITHIN_M,
        ),
    )
    for what, unit, figure, limit in limited:
        yield sides.row(name, figure, _at_most(f"{label}: {what}", unit, limit))
    yield sides.row(
        name,
        lambda s, who: s.axis_share_within(who, axis, LIMIT_M, STEADY_S),
        lambda value: shown(f"{label}: share of errors within 5 m in steady state", "1", value),
    )
    yield sides.row(
        name,
        lambda s, who: s.axis_sd_m(who, axis, LIMIT_FROM_S),
        lambda value: shown(f"{label}: sd that the covariance gives, 15th second", "m", value),
    )


def _at_most(label: str, unit: str, limit: float) -> Callable[[float | None], Row]:
    return lambda value: at_most(label, unit, value, limit)


def _reduction(sides: Sides, network: FixNetwork) -> Iterator[Row]:
    """The paper's "100 m" is the variance of a fix of the Wi-Fi, in m^2."""

    def gain(summary: NetworkSummary, who: str) -> float:
        return network.sd_m / summary.axis_rmse_m(who, 0, LIMIT_FROM_S, LIMIT_FROM_S + 0.5)

    label = f"paper's motion, {network.name}, x, 15th second"
    squared = f"{label}: variance of a fix over mean squared error of the track"
    yield sides.row(
        network.name,
        lambda summary, who: gain(summary, who) ** 2,
        lambda value: at_least(squared, "1", value, REDUCTION),
    )
    yield sides.row(
        network.name,
        gain,
        lambda value: shown(f"{label}: sd of a fix over RMSE of the track", "1", value),
    )


def gain_rows(summary: NetworkSummary, seed: int) -> Iterator[Row]:
    """Fig. 6: the gains of each network begin near one and end on the floor."""
    stages = stages_of(summary.setting)
    for network, stage in zip(summary.setting.networks, stages.networks, strict=True):
        truth = summary.setting.truth(seed, stage.stamps_ns)
        start = summary.setting.truth(seed, np.array([START_NS]))[0]
        jerk = summary.setting.tracker.jerk_density
        gains = gains_of(stage, jerk, stage.fixes(seed, truth), start)
        label = f"paper's motion, {network.name}"
        first = float(gains[0, 0])
        yield Row(
            name=f"{label}: gain k11 of the first fix (paper: tends to 1; within {NEAR:g})",
            unit="1",
            paper=FIRST_GAIN,
            ours=first,
            ok=abs(first - FIRST_GAIN) <= NEAR,
        )
        for i, (element, unit) in enumerate((("k11", "1"), ("k21", "1/s"), ("k31", "1/s^2"))):
            last, floor = float(gains[-1, i]), float(DVORNIKOV_FLOOR[i])
            name = f"{label}: gain {element} at the end"
            ok = math.isclose(last, floor, rel_tol=1e-3)
            yield Row(name=name, unit=unit, paper=floor, ours=last, ok=ok)
        rests = (_at_rest(gains, stage.stamps_ns) - START_NS) / NS
        name = f"{label}: all gains rest on the floor from (steady state: {STEADY_S:g} s)"
        yield required(name, "s", rests, rests <= STEADY_S)


def _at_rest(gains: Array, stamps_ns: Ints) -> float:
    """Stamp [ns] from which all gains (n, 3) are the floor; the last one if that alone is."""
    moving = ~np.isclose(gains, DVORNIKOV_FLOOR, rtol=1e-3).all(axis=1)
    first = int(np.flatnonzero(moving)[-1]) + 1 if moving.any() else 0
    return float(stamps_ns[min(first, len(stamps_ns) - 1)])
