"""The tracker of an experiment's set-up, fed with what its simulation gives a live one."""

from __future__ import annotations

from netpos.messages.values import Beacon, InitialPose
from netpos.reproduction.experiment import VUE, Setup
from netpos.tracking import Tracker, TrackOutput


def tracker_outputs(setup: Setup, seed: int) -> list[TrackOutput]:
    """All it says of one seed."""
    simulation, tracker = setup.simulation.with_seed(seed), Tracker(setup.config)
    for info in simulation.rsus:
        tracker.add_rsu(info)
    outputs = []
    for event in simulation.events():
        items = [event] if isinstance(event, InitialPose) else []
        if isinstance(event, Beacon) and event.vue_id == VUE:
            items = list(simulation.measure(event))
        for item in items:
            assert tracker.add(item) is None
        outputs += tracker.process()
    return outputs + tracker.flush()
