"""Output of the dead-reckoning core as the values that are published and recorded."""

from __future__ import annotations

from collections.abc import Iterator

from netpos.inertial.pdr_output import PdrOutput, StepEvent, StepVelocity
from netpos.messages.values import Step, Velocity


def frame_of(vue_id: str, heading_reference: str) -> str:
    """``map`` where a magnetometer gives north, else a frame of the device's own start."""
    return "map" if heading_reference == "map" else f"{vue_id}/pdr_start"


def step_value(vue_id: str, event: StepEvent) -> Step:
    """Step of a core event."""
    return Step(
        stamp_ns=event.stamp_ns,
        vue_id=vue_id,
        frame_id=frame_of(vue_id, event.heading_reference),
        start_ns=event.start_ns,
        end_ns=event.end_ns,
        count=event.count,
        length_m=event.length_m,
        length_var=event.length_sd_m**2,
        heading_rad=event.heading_rad,
        heading_var=event.heading_sd_rad**2,
        cadence_hz=event.cadence_hz,
    )


def velocity_value(vue_id: str, velocity: StepVelocity) -> Velocity:
    """Velocity of a core step velocity."""
    return Velocity(
        stamp_ns=velocity.stamp_ns,
        vue_id=vue_id,
        frame_id=frame_of(vue_id, velocity.heading_reference),
        velocity=velocity.velocity,
        cov=velocity.covariance,
    )


def values_of(vue_id: str, output: PdrOutput | None) -> Iterator[Step | Velocity]:
    """All values of one core output, steps first."""
    if output is None:
        return
    for event in output.steps:
        yield step_value(vue_id, event)
    if output.velocity is not None:
        yield velocity_value(vue_id, output.velocity)
