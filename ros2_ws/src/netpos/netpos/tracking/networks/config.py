"""Parameters of the fusion of tracks; the node and the command line take names, defaults and
limits from here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from netpos.common.parameters import check_fields, choice, described, from_mapping, real
from netpos.estimation.intersection import METHODS
from netpos.messages.fields import Frames
from netpos.tracking import shared_parameters as shared

ASSOCIATIONS = ("motion", "names")


@dataclass(frozen=True, slots=True, kw_only=True)
class FusionConfig:
    """Every parameter has its unit in its name, a range and a sentence.

    Raises ``ValueError`` naming the parameter, its value and the accepted range.
    """

    method: str = choice(
        "split_ci",
        METHODS,
        "split_ci (only what is not a network's own noise may be correlated) | ci (anything may"
        " be) | ici (an estimate both have fused) | independent (nothing)",
    )
    association: str = choice(
        "motion",
        ASSOCIATIONS,
        "motion (tracks that move alike are one device) | names (networks name devices alike)",
    )
    jerk_density: float = real(
        1.0, 0.0, 1e4, "noise of the way to the common instant [m/s^3/sqrt(Hz)]"
    )
    hold_s: float = real(
        0.25, 0.0, 10.0, "longest wait for tracks still missing at an epoch; 0: do not wait"
    )
    stale_s: float = real(2.0, 0.01, 1e4, "a track silent for longer than this is left out")
    forget_s: float = real(60.0, 0.1, 1e6, "a track silent for longer than this is forgotten")
    gate_probability: float = real(
        0.999, 0.5, 1.0, "share of true pairs whose mean squared distance passes; 1: no gate"
    )
    memory_s: float = real(60.0, 0.1, 1e6, "time over which a pair's misfit is averaged")
    decision_margin: float = real(
        12.0, 0.0, 1e3, "how much better [-2 ln likelihood] than any rival a pair has to fit"
    )
    confirm_s: float = real(1.0, 0.0, 1e3, "a pair has to be watched so long before it is fused")
    max_future_s: float = shared.max_future_s()
    integrity_risk: float = shared.integrity_risk()
    map_frame: str = described("map", "frame of tracks and estimates, that of the trackers")
    odom_frame: str = shared.odom_frame()
    base_frame: str = shared.base_frame()

    def __post_init__(self) -> None:
        check_fields(self)
        self.frames.check()
        if self.forget_s < self.stale_s:
            raise ValueError(
                f"forget_s must be at least stale_s ({self.stale_s:g}), got {self.forget_s:g}"
            )

    @property
    def frames(self) -> Frames:
        """Names of the frames."""
        return Frames(self.map_frame, self.odom_frame, self.base_frame)

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> FusionConfig:
        """Config of named values over the defaults; raises ``ValueError`` for a name that does not
        exist."""
        return from_mapping(cls, values, "fusion")
