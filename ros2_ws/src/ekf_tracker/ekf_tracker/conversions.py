"""Tracker output to diagnostics; everything else is the common codec."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from netpos.messages.network_tracks import network_track_to_msg
from netpos.messages.values import StepCalibration, TrackState, TrackStatus
from netpos.tracking.health import RsuReport, RsuState
from netpos_node import CODEC

__all__ = ["diagnostics_to_msg", "network_track_to_msg"]

_LEVELS = {
    TrackState.WAITING: DiagnosticStatus.WARN,
    TrackState.INITIALISING: DiagnosticStatus.WARN,
    TrackState.TRACKING: DiagnosticStatus.OK,
    TrackState.COASTING: DiagnosticStatus.WARN,
    TrackState.AMBIGUOUS: DiagnosticStatus.WARN,
}


_RSU_LEVELS = {
    RsuState.OK: DiagnosticStatus.OK,
    RsuState.SUSPECT: DiagnosticStatus.WARN,
    RsuState.EXCLUDED: DiagnosticStatus.ERROR,
}


def diagnostics_to_msg(
    statuses: Iterable[TrackStatus],
    rsu_count: int,
    reports: Iterable[RsuReport] = (),
    network: str = "",
    *,
    silent_s: Mapping[str, float] | None = None,
    warning: str = "",
) -> Any:
    """diagnostic_msgs/DiagnosticArray with one entry per device and per RSU heard, stamped with
    the newest epoch.

    network : the one this tracker is of; silent_s : seconds since what was last told of devices
    that have fallen silent; warning : what is wrong with the tracker's input as a whole
    """
    tracker = f"ekf_tracker {network}".rstrip()
    array = DiagnosticArray()
    newest = 0
    for status in statuses:
        newest = max(newest, status.stamp_ns)
        array.status.append(_device(tracker, status, (silent_s or {}).get(status.vue_id, 0.0)))
    array.status.append(
        DiagnosticStatus(
            level=DiagnosticStatus.OK if rsu_count and not warning else DiagnosticStatus.WARN,
            name=f"{tracker}: rsus",
            message=f"{rsu_count} RSUs known{warning and '; '}{warning}"
            if rsu_count
            else "no /rsu/info received yet",
        )
    )
    array.status.extend(_rsu(tracker, report) for report in reports)
    array.header.stamp = CODEC.time(newest)
    return array


def _rsu(tracker: str, report: RsuReport) -> Any:
    values = {
        "age_s": f"{report.age_s:.1f}",
        "rate_hz": f"{report.rate_hz:.1f}",
        "accept_ratio": f"{report.accept_ratio:.2f}",
        "measurements": str(report.measurements),
        **{f"innovation: {k}": f"{v:.4g}" for k, v in sorted(report.mean_innovation.items())},
        **{f"innovation / sd: {k}": f"{v:.2f}" for k, v in sorted(report.mean_normalised.items())},
    }
    return DiagnosticStatus(
        level=_RSU_LEVELS[report.state],
        name=f"{tracker}: rsu {report.rsu_id}",
        message=report.text,
        hardware_id=report.rsu_id,
        values=[KeyValue(key=key, value=value) for key, value in values.items()],
    )


def _steps(steps: StepCalibration) -> dict[str, str]:
    """What of a person's steps is estimated."""
    said = {}
    if steps.length_factor_sd:
        said["step_length_factor"] = f"{steps.length_factor:.3f} +- {steps.length_factor_sd:.3f}"
    if steps.heading_offset_sd_rad:
        offset, sd = steps.heading_offset_rad, steps.heading_offset_sd_rad
        said["step_heading_offset_rad"] = f"{offset:.3f} +- {sd:.3f}"
    return said


def _device(tracker: str, status: TrackStatus, silent_s: float) -> Any:
    values = {
        "position_sd_m": f"{status.position_sd_m:.3f}",
        "protection_level_m": f"{status.protection_level_m:.3f}",
        "nis": f"{status.nis:.3f}",
        "nis_dof": str(status.nis_dof),
        "accepted": str(status.accepted),
        **_steps(status.steps),
        **{f"rejected: {reason}": str(n) for reason, n in sorted(status.rejected.items())},
    }
    places = [f"{100 * m.weight:.0f} % at ({m.x_m:.1f}, {m.y_m:.1f}) m" for m in status.modes]
    state = status.state.name.lower() + (f": {', '.join(places)}" if places else "")
    return DiagnosticStatus(
        level=DiagnosticStatus.STALE if silent_s else _LEVELS[status.state],
        name=f"{tracker}: {status.vue_id}",
        message=f"silent for {silent_s:.0f} s; was {state}" if silent_s else state,
        hardware_id=status.vue_id,
        values=[KeyValue(key=key, value=value) for key, value in values.items()],
    )
