"""How large a scenario is, from its numbers, before anything is built."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from netpos.world.maps import METIS_MADRID

if TYPE_CHECKING:
    from netpos.scenario.schema import Device, Scenario

MESSAGES_MAX = 20_000_000
"""Limit for a whole run, a few GB of arrays and of bag; chosen, not measured."""
STEPS_MAX = 1_000_000
"""Of a walk: a week of walking. Each step is an object."""


def route_duration_s(device: Device) -> float:
    """Duration [s] of a device's route, without the turns at its corners."""
    route = device.route
    if route.kind == "quadratic":
        return math.fsum(stretch.duration_s for stretch in route.stretches)
    speed_mps = device.speed_mps
    if speed_mps is None:
        assert device.gait is not None
        speed_mps = device.gait.step_length_m * device.gait.cadence_hz
    if route.kind == "metis_random":
        length_m = (route.max_crossings + 1) * METIS_MADRID.block_m
    elif route.kind == "path":
        length_m = route.length_m
    elif route.kind == "rectangle":
        length_m = route.laps * 2.0 * (route.width_m + route.height_m)
    else:
        points = np.array(route.points)
        length_m = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
    return length_m / speed_mps + math.fsum(route.pauses_s)


def messages_of(device: Device, heard: int, limit_s: float) -> float:
    """About how many messages one such device makes; ``heard``: RSUs that report a beacon."""
    seconds = min(route_duration_s(device), limit_s)
    beacon_hz = 1.0 / device.beacon_interval_s
    sensors = (device.imu, device.magnetometer)
    rate_hz = beacon_hz * (1 + heard) + sum(s.rate_hz for s in sensors if s is not None)
    return seconds * (rate_hz + 2.0 * (device.ground_truth_rate_hz or beacon_hz))


def check_motion(device: Device) -> None:
    """Raise ValueError if the motion alone (of the whole route) does not fit into memory."""
    if device.gait is not None:
        walked = route_duration_s(device) * device.gait.cadence_hz
        if walked > STEPS_MAX:
            raise ValueError(
                f"the route takes about {walked:.3g} steps, at most {STEPS_MAX:.0e} are walked: "
                "shorten it or raise gait.step_length_m"
            )
    steps = route_duration_s(device) / device.beacon_interval_s
    if device.wander_density_mps2_sqrthz is not None and steps > MESSAGES_MAX:
        raise ValueError(
            f"the route takes {route_duration_s(device):.3g} s, {steps:.3g} beacon_interval_s of "
            f"{device.beacon_interval_s:g} s; a device that wanders may take {MESSAGES_MAX}: "
            "shorten its route or raise beacon_interval_s"
        )


def check_size(scenario: Scenario) -> None:
    """Raise ValueError, with limit and keys to change, if a run does not fit into memory."""
    nearest = scenario.measurement.nearest
    heard = min(nearest, len(scenario.rsus.units) or nearest)
    limit_s = scenario.max_duration_s or math.inf
    numbers = [d.count * messages_of(d, heard, limit_s) for d in scenario.devices]
    total = math.fsum(numbers)
    if total <= MESSAGES_MAX:
        return
    worst = numbers.index(max(numbers))
    device = scenario.devices[worst]
    seconds = min(route_duration_s(device), limit_s)
    raise ValueError(
        f"the run has about {total:.2g} messages, at most {MESSAGES_MAX:.2g} are simulated; most "
        f"are of devices.{worst}: count {device.count}, beacon_interval_s "
        f"{device.beacon_interval_s:g}, {seconds:.3g} s; lower count, raise beacon_interval_s, "
        "shorten its route or set max_duration_s"
    )
