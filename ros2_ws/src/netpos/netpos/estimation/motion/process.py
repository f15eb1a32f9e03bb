"""Process model of a planar state: f, F and Q of the motion model that a vector ``motion`` names,
with the two-state clock and slow errors, which are the same for all.

Entries of the state beyond the core (``state.X``) belong to the motion model first
(``extra_states``), then to the biases, first-order Gauss-Markov processes.
"""

from __future__ import annotations

import math

import numpy as np

from netpos.estimation.compile import inlined, leaf
from netpos.estimation.dispatch import choose, is_one_of
from netpos.estimation.motion.parameters import Parameter, ProcessNoise
from netpos.estimation.motion.process_noise import add_clock, add_velocity_step
from netpos.estimation.motion.table import MODELS, Model
from netpos.estimation.state import N_CORE, X
from netpos.messages.values import Array

_SIZE = int(Parameter.OWN) + max(len(model.own) for model in MODELS)
_SHARED = [entry.name.lower() for entry in Parameter if entry != Parameter.OWN]


@inlined
def _no_propagate(_mean: Array, _dt: float, _motion: Array) -> None:
    return


@inlined
def _no_matrix(_mean: Array, _dt: float, _motion: Array, _matrix: Array) -> None:
    return


_propagate = choose([(k, m.propagate) for k, m in enumerate(MODELS)], _no_propagate)
_transition = choose([(k, m.transition) for k, m in enumerate(MODELS)], _no_matrix)
_add_noise = choose([(k, m.add_noise) for k, m in enumerate(MODELS)], _no_matrix)
_is_straight = is_one_of(k for k, m in enumerate(MODELS) if m.is_straight)


def extra_states(model: Model) -> int:
    """Number of state entries a motion model adds to the core."""
    return len(MODELS[model].states)


def own_index(model: Model, name: str) -> int:
    """Index in ``motion`` of an entry that the model has of its own; -1: it has none of this
    name."""
    names = list(MODELS[model].own)
    return int(Parameter.OWN) + names.index(name) if name in names else -1


def motion_parameters(
    model: Model | int = 0,
    noise: ProcessNoise = ProcessNoise.CONTINUOUS,
    extras: int | None = None,
    **values: float,
) -> Array:
    """Vector ``motion`` of a model; ``values`` are named as the entries of ``Parameter`` in lower
    case, or as any model names its own; 0 where absent.

    ``extras`` larger than the model's own number makes models share one state (interacting
    models). What only other models have is left out. Raises ``KeyError`` for an unknown name.
    """
    own = MODELS[model]
    motion = np.zeros(_SIZE)
    motion[Parameter.MODEL] = model
    motion[Parameter.NOISE] = noise
    motion[Parameter.STATES] = len(own.states)
    motion[Parameter.EXTRAS] = len(own.states) if extras is None else extras
    for name, value in values.items():
        if name in _SHARED:
            motion[Parameter[name.upper()]] = value
        elif not any(name in m.own for m in MODELS):
            raise KeyError(name)
        elif name in own.own:
            motion[own_index(Model(model), name)] = value
    return motion


@inlined
def is_straight(motion: Array) -> bool:
    """Whether F is that of a constant velocity and of no other states than the biases."""
    straight = _is_straight(int(motion[Parameter.MODEL]))
    return bool(straight and motion[Parameter.EXTRAS] == 0.0)


@inlined
def propagate(mean: Array, dt: float, motion: Array, bias: Array) -> None:
    """f: move ``mean`` (n,) by ``dt`` seconds in place; bias (2, k): stationary sd and time
    constant of each bias."""
    states, extras = int(motion[Parameter.STATES]), int(motion[Parameter.EXTRAS])
    _propagate(int(motion[Parameter.MODEL]), mean, dt, motion)
    for i in range(N_CORE + states, N_CORE + extras):
        mean[i] = 0.0
    mean[X.CLOCK] += dt * mean[X.DRIFT]
    for i in range(bias.shape[1]):
        mean[N_CORE + extras + i] *= math.exp(-dt / bias[1, i])


@leaf
def transition(mean: Array, dt: float, motion: Array, bias: Array, F: Array) -> None:
    """Jacobian of ``propagate`` at ``mean`` (n,), written to F (n, n)."""
    states, extras = int(motion[Parameter.STATES]), int(motion[Parameter.EXTRAS])
    F[:] = 0.0
    for i in range(mean.size):
        F[i, i] = 1.0
    F[X.CLOCK, X.DRIFT] = dt
    _transition(int(motion[Parameter.MODEL]), mean, dt, motion, F)
    for i in range(N_CORE + states, N_CORE + extras):
        F[i, i] = 0.0
    for i in range(bias.shape[1]):
        k = N_CORE + extras + i
        F[k, k] = math.exp(-dt / bias[1, i])


@inlined
def add_noise(mean: Array, dt: float, motion: Array, bias: Array, cov: Array) -> None:
    """Add the process noise covariance over ``dt`` > 0 seconds to ``cov`` (n, n) in place.

    ``mean`` (n,) is the state after the step.
    """
    states, extras = int(motion[Parameter.STATES]), int(motion[Parameter.EXTRAS])
    _add_noise(int(motion[Parameter.MODEL]), mean, dt, motion, cov)
    add_clock(dt, motion, cov)
    age_s, position_sd = (
        motion[Parameter.VELOCITY_STEP_AGE],
        motion[Parameter.VELOCITY_STEP_POSITION_SD],
    )
    add_velocity_step(motion[Parameter.VELOCITY_STEP_SD], age_s, position_sd, cov)
    for i in range(N_CORE + states, N_CORE + extras):
        cov[i, i] += motion[Parameter.IDLE] ** 2 * dt
    for i in range(bias.shape[1]):
        k = N_CORE + extras + i
        cov[k, k] += bias[0, i] ** 2 * (1.0 - math.exp(-2.0 * dt / bias[1, i]))


@leaf
def noise(mean: Array, dt: float, motion: Array, bias: Array, Q: Array) -> None:
    """Process noise covariance over ``dt`` seconds, written to Q (n, n); 0 for dt <= 0."""
    Q[:] = 0.0
    if dt > 0.0:
        add_noise(mean, dt, motion, bias, Q)
