"""Which parameters may change while a tracker runs."""

from __future__ import annotations

from dataclasses import fields

from netpos.tracking.config import TrackerConfig

LIVE = (
    "max_devices",
    "allowed_devices",
    "max_rate_hz",
    "max_rsu_rate_hz",
    "accept_initialpose",
    "max_gap_s",
    "coast_after_s",
    "isolate_rsus",
)
"""Limits and rules that no estimate holds."""
LIVE_OF_ONE_MODEL = ("gate_probability", "accel_density_mps2_sqrthz")
"""Parameters of a compiled planar filter with one motion model: its next epoch takes them."""


def live_names(config: TrackerConfig) -> tuple[str, ...]:
    """The parameters that may change while a tracker runs with ``config``."""
    if config.interacts or config.is_strapdown:
        return LIVE
    return LIVE + LIVE_OF_ONE_MODEL


def changed_names(old: TrackerConfig, new: TrackerConfig) -> list[str]:
    """The parameters in which two configurations differ."""
    return [f.name for f in fields(old) if getattr(old, f.name) != getattr(new, f.name)]


def check_change(old: TrackerConfig, new: TrackerConfig) -> list[str]:
    """The names of what changes. Raises ``ValueError`` for a parameter that may not change while a
    tracker runs."""
    live, changed = live_names(old), changed_names(old, new)
    fixed = [name for name in changed if name not in live]
    if fixed:
        raise ValueError(
            f"{', '.join(fixed)} cannot change while the tracker is configured: the tracks are"
            " built with it. Clean the node up or start it anew. These can change:"
            f" {', '.join(live)}"
        )
    return changed
