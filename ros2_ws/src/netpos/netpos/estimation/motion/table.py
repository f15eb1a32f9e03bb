"""The motion models: one line each. Everything that depends on the model is derived from this
table."""

from __future__ import annotations

from collections.abc import Mapping
from enum import EnumMeta, IntEnum
from typing import TYPE_CHECKING, Any

from netpos.estimation.motion import (
    constant_acceleration,
    constant_turn,
    constant_velocity,
    inertial,
    rigid_body,
    stationary,
)
from netpos.estimation.motion.model import MotionModel

# The place in the table is the number of the model.
MODELS: tuple[MotionModel, ...] = (
    constant_velocity.MODEL,
    constant_turn.MODEL,
    constant_acceleration.MODEL,
    stationary.MODEL,
    inertial.MODEL,
    rigid_body.MODEL,
)
DEFAULT = constant_velocity.MODEL.name.lower()
"""The motion of a tracker that is told nothing."""

SETS: Mapping[str, tuple[MotionModel, ...]] = {
    "interacting": (stationary.MODEL, constant_velocity.MODEL, constant_turn.MODEL),
}
"""Models that a device changes between."""
_SUMMARY_OF_SETS = {"interacting": "stop, straight, turn"}

if TYPE_CHECKING:

    class _AnyName(EnumMeta):
        def __getattr__(cls, name: str) -> Model: ...

    class Model(IntEnum, metaclass=_AnyName):
        """How a device moves: name and number of every model of the table."""

else:
    Model = IntEnum("Model", {m.name: k for k, m in enumerate(MODELS)}, module=__name__)
    Model.__doc__ = "How a device moves: name and number of every model of the table."


_BY_NAME = {m.name.lower(): (m,) for m in MODELS if m.summary is not None}


def words() -> dict[str, str]:
    """What a planar track may be told to move like, and what each word means beside its name."""
    models = {m.name.lower(): m.summary for m in MODELS if m.summary is not None}
    return {**models, **{name: _SUMMARY_OF_SETS.get(name, "") for name in SETS}}


def models_of(word: str) -> tuple[MotionModel, ...]:
    """The models of one of ``words``: one, or those of a set; none for another word."""
    return SETS.get(word, _BY_NAME.get(word, ()))


def parameters() -> dict[str, Any]:
    """Tracker parameters that the models declare: name and field."""
    return {name: entry for model in MODELS for name, entry in model.parameters.items()}


def number_of(model: MotionModel) -> int:
    """Its place in the table."""
    return MODELS.index(model)


def _check() -> None:
    names = [m.name for m in MODELS]
    if len(set(names)) < len(names) or any(m.name.lower() in SETS for m in MODELS):
        raise ValueError(f"two motion models share a name; give each its own, got {names}")


_check()
