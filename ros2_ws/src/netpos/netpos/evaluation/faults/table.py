"""Every fault by name. A new one is a function of the stream and a line here."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from netpos.evaluation.faults import (
    of_attackers,
    of_clocks,
    of_networks,
    of_processes,
    of_values,
)
from netpos.evaluation.faults.stream import Hit, Stream


@dataclass(frozen=True, slots=True)
class Fault:
    """``apply`` changes the stream; ``unit`` of its size, "" where it has none."""

    apply: Callable[[Stream, Hit], Stream]
    unit: str = ""

    @property
    def text(self) -> str:
        """What it does, in a sentence."""
        return " ".join((self.apply.__doc__ or "").split())


FAULTS: dict[str, Fault] = {
    "drop": Fault(of_networks.drop, "share"),
    "silence": Fault(of_networks.silence),
    "delay": Fault(of_networks.delay, "s"),
    "reorder": Fault(of_networks.reorder, "s"),
    "partition": Fault(of_networks.partition),
    "duplicate": Fault(of_networks.duplicate, "share"),
    "corrupt": Fault(of_networks.corrupt, "share"),
    "truncate": Fault(of_networks.truncate, "share"),
    "bias": Fault(of_values.bias, "sd"),
    "drift": Fault(of_values.drift, "sd"),
    "freeze": Fault(of_values.freeze),
    "noise": Fault(of_values.noise, "sd"),
    "outliers": Fault(of_values.outliers, "share"),
    "blocked": Fault(of_values.blocked, "m"),
    "overconfident": Fault(of_values.overconfident, "times"),
    "not_finite": Fault(of_values.not_finite, "share"),
    "no_variance": Fault(of_values.no_variance),
    "device_silent": Fault(of_values.device_silent),
    "device_turned": Fault(of_values.device_turned, "rad"),
    "device_frozen": Fault(of_values.device_frozen),
    "device_biased": Fault(of_values.device_biased, "rad/s"),
    "clock_step": Fault(of_clocks.clock_step, "s"),
    "clock_drift": Fault(of_clocks.clock_drift, "s/s"),
    "no_stamp": Fault(of_clocks.no_stamp),
    "clock_back": Fault(of_clocks.clock_back),
    "rsu_crash": Fault(of_processes.rsu_crash),
    "tracker_crash": Fault(of_processes.tracker_crash),
    "spoofed_info": Fault(of_attackers.spoofed_info, "m"),
    "colluding": Fault(of_attackers.colluding, "m"),
    "creeping": Fault(of_attackers.creeping, "m"),
    "injected": Fault(of_attackers.injected, "m"),
    "beside": Fault(of_attackers.beside, "m"),
    "replayed": Fault(of_attackers.replayed, "s"),
    "invented_rsus": Fault(of_attackers.invented_rsus, "m"),
    "invented_devices": Fault(of_attackers.invented_devices, "devices"),
    "flood": Fault(of_attackers.flood, "times"),
}
