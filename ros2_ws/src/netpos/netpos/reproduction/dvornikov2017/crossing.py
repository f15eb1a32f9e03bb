"""Objects whose paths cross: does the fusion still pair the tracks of two networks correctly?"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from netpos.messages.values import NetworkTrack
from netpos.radio.noise import generator
from netpos.reproduction.dvornikov2017.stages import Pass, Setting
from netpos.reproduction.dvornikov2017.truth import START_NS, crossing
from netpos.scenario.schema import NS
from netpos.tracking.networks.config import FusionConfig
from netpos.tracking.networks.tertiary import TrackFusion

OBJECTS = 5
SETTLED_S = 10.0  # from here on all should be fused


@dataclass(frozen=True, slots=True, kw_only=True)
class Crossing:
    """``OBJECTS`` objects that meet, in directions within ``fan_deg`` (180: all) and at speeds
    between two; ``setting`` names the networks and their filters, each
    started by itself. Its truth is not used."""

    setting: Setting
    meeting_s: float
    fan_deg: float
    speed_mps: tuple[float, float]
    fusion: FusionConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class CrossingRun:
    """swapped: two objects were ever fused as one; renamed: a device's name ever went to another
    object; fused_share: of the devices reported after ``SETTLED_S``, those in which both networks
    are."""

    swapped: bool
    renamed: bool
    fused_share: float


@lru_cache(maxsize=2)
def _passes(setting: Setting) -> list[Pass]:
    return [Pass(setting, [network]) for network in setting.networks]


def _reports(case: Crossing, seed: int) -> dict[int, list[NetworkTrack]]:
    """Tracks of all objects by both networks, by stamp. Networks number the objects their own
    way; here both numbers are the true one, which the fusion does not look at."""
    setting = case.setting
    reports: dict[int, list[NetworkTrack]] = {}
    for number, truth in enumerate(
        crossing(seed, OBJECTS, case.meeting_s, case.fan_deg, case.speed_mps)
    ):
        for network, stage in zip(setting.networks, _passes(setting), strict=True):
            vue = f"object_{number}"
            states = truth(seed, stage.stamps_ns)
            error = generator(seed, f"{network.name}/{vue}/start").standard_normal(6)
            start = truth(seed, np.array([START_NS]))[0] + np.sqrt(setting.start_var) * error
            means, covs = stage.run(stage.fixes(seed, states, vue), start)
            for stamp, mean, cov in zip(stage.stamps_ns.tolist(), means, covs, strict=True):
                track = NetworkTrack(
                    stamp_ns=stamp, network=network.name, vue_id=vue, mean=mean, cov=cov
                )
                reports.setdefault(stamp, []).append(track)
    return reports


def run_crossing(case: Crossing, seed: int) -> CrossingRun:
    """One seed through association and fusion."""
    fusion = TrackFusion([network.name for network in case.setting.networks], case.fusion)
    reports = _reports(case, seed)
    swapped = renamed = False
    both = total = 0
    of_name: dict[str, str] = {}
    for stamp in sorted(reports):
        for device in fusion.put_together(stamp, reports[stamp])[1]:
            objects = {member.vue_id for member in device.members}
            swapped |= len(objects) > 1
            first = device.members[0].vue_id
            renamed |= of_name.setdefault(device.vue_id, first) != first
            if stamp >= START_NS + SETTLED_S * NS:
                total += 1
                both += len(device.members) == 2
    return CrossingRun(swapped=swapped, renamed=renamed, fused_share=both / max(total, 1))


def crossings_of_seeds(case: Crossing, seeds: range) -> list[CrossingRun]:
    """``run_crossing`` for several seeds."""
    return [run_crossing(case, seed) for seed in seeds]
