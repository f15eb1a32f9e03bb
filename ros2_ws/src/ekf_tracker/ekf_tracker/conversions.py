"""Findings to diagnostics; everything else is the common codec."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from netpos.messages.network_tracks import network_track_to_msg
from netpos.tracking.health.diagnosis import Finding
from netpos_node import CODEC

__all__ = ["diagnostics_to_msg", "network_track_to_msg"]


def diagnostics_to_msg(
    findings: Iterable[Finding], stamp_ns: int, tracker: str = "ekf_tracker"
) -> Any:
    """diagnostic_msgs/DiagnosticArray with one entry per finding of ``tracker``."""
    array = DiagnosticArray()
    array.header.stamp = CODEC.time(stamp_ns)
    array.status.extend(
        DiagnosticStatus(
            level=bytes([finding.level]),
            name=f"{tracker}: {finding.subject}",
            message=finding.message,
            hardware_id=finding.hardware_id,
            values=[KeyValue(key=key, value=value) for key, value in finding.values.items()],
        )
        for finding in findings
    )
    return array
