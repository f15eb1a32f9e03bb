"""Tracks from messages, health of networks and devices to diagnostics."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from netpos.messages.network_tracks import network_track_from_msg
from netpos.messages.values import TrackStatus
from netpos.tracking.networks.tertiary import NetworkReport, NetworkState
from netpos_node import CODEC

__all__ = ["diagnostics_to_msg", "network_track_from_msg"]

_LEVELS = {
    NetworkState.SILENT: DiagnosticStatus.WARN,
    NetworkState.LIVE: DiagnosticStatus.OK,
    NetworkState.STALE: DiagnosticStatus.ERROR,
}
_WORDS = {
    NetworkState.SILENT: "not heard yet",
    NetworkState.LIVE: "live",
    NetworkState.STALE: "silent: left out",
}


def diagnostics_to_msg(statuses: Iterable[TrackStatus], reports: Iterable[NetworkReport]) -> Any:
    """diagnostic_msgs/DiagnosticArray with one entry per network and per device, stamped with the
    newest epoch."""
    array = DiagnosticArray()
    array.status.extend(_network(report) for report in reports)
    newest = 0
    for status in statuses:
        newest = max(newest, status.stamp_ns)
        array.status.append(_device(status))
    array.header.stamp = CODEC.time(newest)
    return array


def _network(report: NetworkReport) -> Any:
    values = {
        "age_s": f"{report.age_s:.1f}",
        "tracks": str(report.tracks),
        "accepted": str(report.accepted),
        **{f"refused: {reason}": str(n) for reason, n in sorted(report.refused.items())},
    }
    return DiagnosticStatus(
        level=_LEVELS[report.state],
        name=f"track_fusion: network {report.network}",
        message=_WORDS[report.state],
        hardware_id=report.network,
        values=[KeyValue(key=key, value=value) for key, value in values.items()],
    )


def _device(status: TrackStatus) -> Any:
    values = {
        "position_sd_m": f"{status.position_sd_m:.3f}",
        "protection_level_m": f"{status.protection_level_m:.3f}",
    }
    return DiagnosticStatus(
        level=DiagnosticStatus.OK,
        name=f"track_fusion: {status.vue_id}",
        message=f"from {', '.join(status.sources)}",
        hardware_id=status.vue_id,
        values=[KeyValue(key=key, value=value) for key, value in values.items()],
    )
