"""Findings to diagnostics."""

from __future__ import annotations

from diagnostic_msgs.msg import DiagnosticStatus
from ekf_tracker.conversions import diagnostics_to_msg
from netpos.tracking.health.diagnosis import Finding, Level


def test_a_finding_is_a_status() -> None:
    findings = [Finding(level, f"rsu {level}", "why", "id", {"key": "1"}) for level in Level]
    array = diagnostics_to_msg(findings, 1_000_000_005, "ekf_tracker wifi")
    assert (array.header.stamp.sec, array.header.stamp.nanosec) == (1, 5)
    assert [s.level for s in array.status] == [
        DiagnosticStatus.OK,
        DiagnosticStatus.WARN,
        DiagnosticStatus.ERROR,
        DiagnosticStatus.STALE,
    ]
    first = array.status[0]
    assert (first.name, first.message, first.hardware_id) == (
        "ekf_tracker wifi: rsu 0",
        "why",
        "id",
    )
    assert [(v.key, v.value) for v in first.values] == [("key", "1")]
    assert diagnostics_to_msg(findings, 0).status[0].name == "ekf_tracker: rsu 0"
