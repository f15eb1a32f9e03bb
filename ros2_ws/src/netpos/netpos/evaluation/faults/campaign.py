"""Every fault of a plan in every scenario, each in a run of its own."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from netpos.evaluation.faults.outcome import Outcome, judged
from netpos.evaluation.faults.plan import Entry, Plan
from netpos.evaluation.faults.stream import NS, Arrival, Hit, Stream
from netpos.evaluation.faults.table import FAULTS
from netpos.evaluation.faults.tracking import Answer, answer_to
from netpos.evaluation.guarded_runs import Material, simulated
from netpos.evaluation.pairing import Trajectory
from netpos.evaluation.work import Work
from netpos.messages.values import RsuInfo, RsuMeasurement
from netpos.scenario import Simulation, load_scenario
from netpos.scenario.settings import settings_from
from netpos.tracking.config import TrackerConfig


@dataclass(frozen=True, slots=True)
class Undisturbed:
    """A run of a scenario before anything strikes it."""

    stream: Stream
    scene: Mapping[str, RsuInfo]
    truth: Mapping[str, Trajectory]
    config: TrackerConfig
    answer: Answer

    @classmethod
    def of(cls, material: Material) -> Undisturbed:
        """Everything arrives at its stamp, or right after what came before it."""
        config = TrackerConfig.from_mapping(material.settings.parameters)
        scene = {info.rsu_id: info for info in material.rsus}
        truth = {vue: Trajectory.of(poses) for vue, poses in material.truth.items()}
        stream, at_ns = [], 0
        for item in material.items:
            at_ns = max(at_ns, item.stamp_ns)
            stream.append(Arrival(at_ns, item))
        return cls(stream, scene, truth, config, answer_to(stream, config, scene, truth))


def campaign(plan: Plan, scenarios: Sequence[str], work: Work) -> Iterator[Outcome]:
    """The outcome of every fault in every scenario, scenario by scenario; each run has the seed of
    its scenario.

    Raises ``ValueError`` for a scenario that cannot be used, before anything is run.
    """
    for name in scenarios:
        scenario = load_scenario(name)
        TrackerConfig.from_mapping(scenario.tracker)
        if scenario.networks:
            raise ValueError(f"{name} has several networks; faults are put into one network")
    parts = [((name, index),) for name in scenarios for index in range(len(plan.faults))]
    return work.over("faults", _one, plan, parts)


def _one(plan: Plan, part: tuple[tuple[str, int]]) -> Outcome:
    ((name, index),) = part
    return strike(name, undisturbed(name), plan, index)


@lru_cache(maxsize=1)
def undisturbed(name: str) -> Undisturbed:
    """The run of a scenario without faults; the newest is kept."""
    simulation = Simulation(load_scenario(name))
    return Undisturbed.of(simulated(simulation, settings_from(name)))


def strike(name: str, run: Undisturbed, plan: Plan, index: int) -> Outcome:
    """One fault of a plan in a run."""
    entry = plan.faults[index]
    hit = _hit(run, plan, entry, index)
    stream = FAULTS[entry.fault].apply(run.stream, hit)
    names = load_scenario(name).name, entry.name
    if _same(stream, run.stream):
        return Outcome(scenario=names[0], fault=names[1], applies=False)
    answer = answer_to(stream, run.config, run.scene, run.truth)
    return judged(names, (hit.start_ns, hit.end_ns), run.truth, (answer, run.answer))


def _same(one: Stream, other: Stream) -> bool:
    return len(one) == len(other) and all(
        a.what is b.what and a.at_ns == b.at_ns for a, b in zip(one, other, strict=True)
    )


def _hit(run: Undisturbed, plan: Plan, entry: Entry, index: int) -> Hit:
    first, last = run.stream[0].at_ns, run.stream[-1].at_ns
    share = plan.start if entry.start is None else entry.start
    start_ns = first + round(share * (last - first))
    end_ns = start_ns + round((entry.lasts_s or plan.lasts_s) * NS)
    heard = Counter(
        a.what.rsu_id
        for a in run.stream
        if isinstance(a.what, RsuMeasurement) and start_ns <= a.at_ns < end_ns
    )
    number = None if entry.rsus == "all" else entry.rsus
    return Hit(
        start_ns=start_ns,
        end_ns=end_ns,
        rsus=frozenset(name for name, _ in heard.most_common(number)),
        size=entry.size,
        rng=np.random.default_rng([plan.seed, index]),
        scene=run.scene,
        truth=run.truth,
    )
