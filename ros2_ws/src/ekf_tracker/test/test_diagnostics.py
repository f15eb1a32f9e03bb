"""What the tracker node tells /diagnostics of devices and RSUs."""

from __future__ import annotations

from dataclasses import replace

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from ekf_tracker.conversions import diagnostics_to_msg
from netpos.messages.values import StepCalibration, TrackMode, TrackState, TrackStatus
from netpos.tracking.health import RsuReport, RsuState

T0 = 1_000_000_000


def status(state: TrackState, stamp_ns: int, vue_id: str = "vue_1") -> TrackStatus:
    return TrackStatus(
        stamp_ns=stamp_ns,
        vue_id=vue_id,
        state=state,
        nis=1.25,
        nis_dof=4,
        accepted=9,
        rejected={"late": 2, "gate": 1},
        position_sd_m=0.5,
        protection_level_m=2.25,
    )


@pytest.mark.parametrize(
    ("state", "level"),
    [
        (TrackState.WAITING, DiagnosticStatus.WARN),
        (TrackState.INITIALISING, DiagnosticStatus.WARN),
        (TrackState.TRACKING, DiagnosticStatus.OK),
        (TrackState.COASTING, DiagnosticStatus.WARN),
    ],
)
def test_diagnostics_of_a_device(state: TrackState, level: bytes) -> None:
    array = diagnostics_to_msg([status(state, T0)], 2)
    device, rsus = array.status
    assert (device.level, device.message) == (level, state.name.lower())
    assert (device.name, device.hardware_id) == ("ekf_tracker: vue_1", "vue_1")
    assert {v.key: v.value for v in device.values} == {
        "position_sd_m": "0.500",
        "protection_level_m": "2.250",
        "nis": "1.250",
        "nis_dof": "4",
        "accepted": "9",
        "rejected: gate": "1",
        "rejected: late": "2",
    }
    assert (rsus.level, rsus.message) == (DiagnosticStatus.OK, "2 RSUs known")


def test_diagnostics_name_the_places_of_an_ambiguous_device() -> None:
    modes = (TrackMode(weight=0.62, x_m=3.14, y_m=-4.0), TrackMode(weight=0.38, x_m=9.0, y_m=7.0))
    array = diagnostics_to_msg([replace(status(TrackState.AMBIGUOUS, T0), modes=modes)], 2)
    assert array.status[0].level == DiagnosticStatus.WARN
    expected = "ambiguous: 62 % at (3.1, -4.0) m, 38 % at (9.0, 7.0) m"
    assert array.status[0].message == expected


def test_diagnostics_of_what_is_known_of_the_steps() -> None:
    both = StepCalibration(
        length_factor=1.08,
        length_factor_sd=0.02,
        heading_offset_rad=-0.1,
        heading_offset_sd_rad=0.03,
    )
    for steps, said in (
        (both, {"length_factor": "1.080 +- 0.020", "heading_offset_rad": "-0.100 +- 0.030"}),
        (replace(both, heading_offset_sd_rad=0.0), {"length_factor": "1.080 +- 0.020"}),
        (StepCalibration(), {}),
    ):
        of_device = replace(status(TrackState.TRACKING, T0), steps=steps)
        values = diagnostics_to_msg([of_device], 1).status[0].values
        found = {v.key.removeprefix("step_"): v.value for v in values if "step_" in v.key}
        assert found == said


def test_diagnostics_stamp_and_missing_rsus() -> None:
    array = diagnostics_to_msg(
        [status(TrackState.TRACKING, T0 + 5), status(TrackState.TRACKING, T0, "vue_2")], 0
    )
    assert (array.header.stamp.sec, array.header.stamp.nanosec) == (1, 5)
    assert [s.name for s in array.status] == [
        "ekf_tracker: vue_1",
        "ekf_tracker: vue_2",
        "ekf_tracker: rsus",
    ]
    assert array.status[-1].level == DiagnosticStatus.WARN
    assert array.status[-1].message == "no /rsu/info received yet"


def test_diagnostics_of_an_rsu_that_lies() -> None:
    report = RsuReport(
        rsu_id="b",
        state=RsuState.EXCLUDED,
        text="isolated: azimuth off by 20.1 deg",
        age_s=0.25,
        rate_hz=10.0,
        accept_ratio=0.125,
        measurements=80,
        mean_innovation={"azimuth": 0.351},
        mean_normalised={"azimuth": 12.0},
    )
    array = diagnostics_to_msg([], 3, [report, replace(report, state=RsuState.SUSPECT)])
    liar, suspect = array.status[1:]
    assert (liar.level, liar.message) == (DiagnosticStatus.ERROR, report.text)
    assert suspect.level == DiagnosticStatus.WARN
    assert (liar.name, liar.hardware_id) == ("ekf_tracker: rsu b", "b")
    assert {v.key: v.value for v in liar.values} == {
        "age_s": "0.2",
        "rate_hz": "10.0",
        "accept_ratio": "0.12",
        "measurements": "80",
        "innovation: azimuth": "0.351",
        "innovation / sd: azimuth": "12.00",
    }
