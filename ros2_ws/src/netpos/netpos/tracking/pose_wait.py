"""Waiting for an initial pose, which may have been given before the tracker came."""

from __future__ import annotations

from dataclasses import dataclass

from netpos.tracking.config import TrackerConfig


@dataclass(slots=True)
class PoseWait:
    """Of one track: the stamp of the first epoch without a fix, whether that epoch, or a later
    one, still waits, and whether a pose has come."""

    since_ns: int | None = None
    waits: bool = False
    posed: bool = False

    def at(self, config: TrackerConfig, stamp_ns: int, *, tracked: bool) -> bool:
        """Whether a pose is waited for at an epoch; ``tracked``: there was a fix before."""
        if self.since_ns is None:
            self.since_ns = stamp_ns
        waited_s = (stamp_ns - self.since_ns) * 1e-9
        wanted = config.require_initial_pose and not (self.posed or tracked)
        self.waits = wanted and waited_s < config.initial_pose_wait_s
        return self.waits

    def missing(self, config: TrackerConfig, vue_id: str, else_missing: str) -> str:
        """What a first fix lacks: a pose, or ``else_missing``."""
        if not self.waits:
            return else_missing
        return (
            f"waits for a pose on /{vue_id}/initialpose, up to {config.initial_pose_wait_s:g} s "
            "from the first measurement on"
        )
