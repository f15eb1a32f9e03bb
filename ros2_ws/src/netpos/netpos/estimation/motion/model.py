"""What one motion model is: the record that every module of this folder fills in."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from netpos.estimation.dispatch import Kernel


def _none(_config: Any) -> tuple[float, ...]:
    return ()


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionModel:
    """One motion model of a planar state.

    The functions see the whole state (n,) and deal with position, velocity and the states of the
    model, which begin at ``N_CORE``. The clock, slow errors and the states that only other models
    of an interacting set have are dealt with for all models alike (``process``).

    propagate : ``(mean, dt, motion)`` moves mean (n,) by dt > 0 seconds in place: f
    transition : ``(mean, dt, motion, F)`` writes the Jacobian of f at mean to F (n, n), which is
        the unit matrix before
    add_noise : ``(mean, dt, motion, cov)`` adds Q over dt > 0 seconds to cov (n, n) in place; mean
        is the state after the step

    motion (size,) is the vector of ``motion.parameters``.
    """

    name: str
    """In upper case; in lower case the word for the parameter ``motion_model``."""
    propagate: Kernel
    transition: Kernel
    add_noise: Kernel
    summary: str | None = ""
    """What the parameter's description says beside the name; None: not offered by itself."""
    states: tuple[str, ...] = ()
    """Names of its own states."""
    initial_sd: Callable[[Any], tuple[float, ...]] = _none
    """From the tracker's parameters: sd of its own states at the first fix, where they are 0."""
    parameters: Mapping[str, Any] = field(default_factory=dict)
    """Tracker parameters that this module declares: name and ``common.parameters`` field. Two
    modules may declare the same one."""
    own: Mapping[str, str] = field(default_factory=dict)
    """Its entries of ``motion`` from ``Parameter.OWN`` on, in this order: the name for
    ``motion_parameters`` and the tracker parameter that gives the value."""
    accel_density: str | None = None
    """Tracker parameter of the density of its white acceleration; None: that of most models."""
    manoeuvre_speed: str = "manoeuvre_speed_sd_mps"
    """Tracker parameter of the velocity step that a refused measurement may reveal."""
    is_straight: bool = False
    """F is that of a constant velocity."""
    is_driven_by_white_acceleration: bool = True
    """Its white acceleration may be learned while a device moves steadily."""
    uses_imu: bool = False
    """The increments of the device's IMU move it."""
    heading: int = -1
    """Index of the device's heading in the state; -1: none of its own."""
