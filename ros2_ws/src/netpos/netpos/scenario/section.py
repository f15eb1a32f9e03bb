"""The base of a scenario's sections, and the kinds of values in them."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

_MAX = 1e100  # its cube is a number
Finite = Annotated[float, Field(ge=-_MAX, le=_MAX, allow_inf_nan=False)]
Interval = Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)]  # s
Positive = Annotated[float, Field(gt=0, le=_MAX, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, le=_MAX, allow_inf_nan=False)]
Point = tuple[Finite, Finite]
Start = Annotated[float, Field(gt=0, le=2e9, allow_inf_nan=False)]  # ROS has 2^31 seconds
FileName = Annotated[str, Field(pattern=r"^[^/]+$")]
Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]


class Section(BaseModel):
    """A part of a scenario: frozen, no unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True)
