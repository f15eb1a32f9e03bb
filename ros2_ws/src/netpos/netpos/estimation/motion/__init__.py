"""How a device moves: one module per motion model, and the table of all of them.

``model``       ``MotionModel``, the record that a motion model fills in
``table``       ``MODELS``, one line per model; ``SETS`` of them that interact
``parameters``  the vector ``motion`` that the kernels take
``process``     f, F and Q of a whole state; ``process_noise``: what several models share

The others are models. docs/adding_a_motion_model_or_filter.md adds one.
"""

from netpos.estimation.motion.parameters import (
    NO_BIAS,
    SPEED_OF_LIGHT_MPS,
    Parameter,
    ProcessNoise,
)
from netpos.estimation.motion.process import (
    add_noise,
    extra_states,
    is_straight,
    motion_parameters,
    noise,
    own_index,
    propagate,
    transition,
)
from netpos.estimation.motion.process_noise import add_velocity_step, add_walk
from netpos.estimation.motion.table import Model

__all__ = [
    "NO_BIAS",
    "SPEED_OF_LIGHT_MPS",
    "Model",
    "Parameter",
    "ProcessNoise",
    "add_noise",
    "add_velocity_step",
    "add_walk",
    "extra_states",
    "is_straight",
    "motion_parameters",
    "noise",
    "own_index",
    "propagate",
    "transition",
]
