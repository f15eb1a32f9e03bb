"""Write a scenario's run to a bag without ROS: all topics of the live graph except the tracker's
output."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import netpos
from netpos.bags import BagWriter, codec
from netpos.common.yaml_text import dump_yaml
from netpos.inertial.pdr import PedestrianDeadReckoning
from netpos.inertial.pdr_config import PdrConfig
from netpos.inertial.pdr_values import values_of
from netpos.messages.topics import CLOCK
from netpos.messages.values import Beacon, ImuSample, MagneticSample, Step, Velocity
from netpos.scenario.load import scenario_text
from netpos.scenario.schema import NS, Scenario
from netpos.scenario.simulation import Simulation
from netpos.scenario.topics import Value, to_message, topic_of

DEFAULT_CLOCK_HZ = 100.0


def simulate_to_bag(
    scenario: Scenario,
    bag_path: Path | str,
    *,
    clock_hz: float = DEFAULT_CLOCK_HZ,
    progress: Callable[[int], None] | None = None,
) -> int:
    """Simulate a scenario into a new bag; log time is network time. Returns the number of
    messages; ``progress`` is called with it after each.

    Raises
    ------
    FileExistsError  the bag exists
    ValueError  clock_hz is not > 0
    """
    convert = codec()
    count = 0
    metadata = {
        "netpos_version": netpos.__version__,
        "scenario": scenario_text(scenario),
        "tracker": dump_yaml(dict(scenario.tracker)),
    }
    if scenario.networks:
        names = [network.name for network in scenario.networks]
        metadata["fusion"] = dump_yaml({"networks": names, **scenario.fusion})
    with BagWriter(Path(bag_path), metadata=metadata) as bag:
        for item in timeline(Simulation(scenario), clock_hz, measured=True):
            if isinstance(item, int):
                bag.write(CLOCK, convert.clock_to_msg(item), item)
            else:
                bag.write(topic_of(item), to_message(convert, item), item.stamp_ns)
            count += 1
            if progress is not None:
                progress(count)
    return count


def timeline(
    simulation: Simulation, clock_hz: float = DEFAULT_CLOCK_HZ, *, measured: bool = False
) -> Iterator[Value | int]:
    """Events with ticks of /clock (plain integer ns) between them, each tick before the events of
    its stamp.

    The last tick is the stamp of the last event. ``measured`` adds the RSUs and what they measure,
    right after each beacon.

    Raises
    ------
    ValueError  clock_hz is not > 0
    """
    if not 0 < clock_hz <= NS:
        raise ValueError(f"clock_hz must be > 0 and at most 1e9, got {clock_hz}")
    step = round(NS / clock_hz)
    tick = simulation.scenario.start_ns
    last = tick
    if measured:
        yield from simulation.rsus
    walkers = _Walkers(simulation.scenario)
    for event in simulation.events():
        while tick <= event.stamp_ns:
            yield tick
            tick += step
        last = event.stamp_ns
        yield event
        if measured and isinstance(event, Beacon):
            yield from simulation.measure(event)
        if measured and isinstance(event, ImuSample | MagneticSample):
            yield from walkers.reckon(event)
    if tick - step != last:
        yield last


class _Walkers:
    """Dead reckoning of every walking device, as in the nodes."""

    def __init__(self, scenario: Scenario) -> None:
        self._cores = {
            vue: PedestrianDeadReckoning(PdrConfig.from_mapping(device.dead_reckoning))
            for vue, device in scenario.each_device
            if device.walks
        }

    def reckon(self, sample: ImuSample | MagneticSample) -> Iterator[Step | Velocity]:
        core = self._cores.get(sample.vue_id)
        if core is None:
            return
        if isinstance(sample, MagneticSample):
            core.add_magnetic_field(sample.stamp_ns, sample.magnetic_field)
            return
        out = core.add_imu(sample.stamp_ns, sample.angular_velocity, sample.specific_force)
        yield from values_of(sample.vue_id, out)
