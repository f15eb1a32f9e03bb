"""Faults put into a scenario: what they change, what noticed them, what the table says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from netpos.cli.main import app
from netpos.evaluation.faults import FAULTS, Entry, Outcome, Plan, campaign, load_plan
from netpos.evaluation.faults.campaign import strike, undisturbed
from netpos.evaluation.faults.geometry import measured_from
from netpos.evaluation.faults.page import HEADS, markdown, worst_first
from netpos.evaluation.faults.piecewise import Piecewise, possible_live
from netpos.evaluation.faults.stream import NS, Arrival, Hit, in_order
from netpos.evaluation.pairing import Trajectory
from netpos.evaluation.work import Work
from netpos.messages.values import (
    AngleConvention,
    Field,
    ImuSample,
    Odometry,
    RsuInfo,
    RsuMeasurement,
    Velocity,
)
from typer.testing import CliRunner

C = 299_792_458.0
SCENE = {
    "a": RsuInfo(rsu_id="a", position=np.array([0.0, 0.0, 5.0])),
    "b": RsuInfo(rsu_id="b", position=np.array([50.0, 0.0, 5.0])),
}


def stream() -> list[Arrival]:
    """Ten seconds of two RSUs at 10 Hz."""
    return [
        Arrival(
            k * NS // 10,
            RsuMeasurement(
                stamp_ns=k * NS // 10,
                rsu_id=name,
                vue_id="vue_1",
                fields=Field.RANGE | Field.AZIMUTH,
                range_m=20.0 + k,
                range_var=0.25,
                azimuth_rad=1.0,
                azimuth_var=1e-4,
            ),
        )
        for k in range(1, 101)
        for name in SCENE
    ]


def hit(size: float = 0.0, rsus: tuple[str, ...] = ("a",)) -> Hit:
    still = [
        Odometry(
            stamp_ns=k * NS,
            vue_id="vue_1",
            position=np.array([10.0, 20.0, 0.0]),
            quaternion=np.array([0.0, 0.0, 0.0, 1.0]),
            linear_velocity=np.zeros(3),
        )
        for k in range(12)
    ]
    return Hit(
        start_ns=4 * NS,
        end_ns=6 * NS,
        rsus=frozenset(rsus),
        size=size,
        rng=np.random.default_rng(3),
        scene=SCENE,
        truth={"vue_1": Trajectory.of(still)},
    )


@pytest.mark.parametrize("name", sorted(FAULTS))
def test_a_fault_touches_its_rsus_and_its_time_only(name: str) -> None:
    """What others send, and what is sent before and after, is the same object as before."""
    before = stream()
    struck = FAULTS[name].apply(before, hit(0.5))
    left = {id(a.what) for a in struck}
    others = [a for a in before if getattr(a.what, "rsu_id", "") == "b"]
    if name not in {"silence", "device_silent"}:
        assert all(id(a.what) in left for a in others)
    assert all(id(a.what) in left for a in before if not 4 * NS <= a.at_ns < 6 * NS)
    assert [a.at_ns for a in struck] == sorted(a.at_ns for a in struck)


def device_stream() -> list[Arrival]:
    """With IMU samples, step velocities and a description between the measurements."""
    found = stream()
    for k in range(1, 101):
        stamp, value = k * NS // 10 + 1, np.array([1.0, 0.1 * k, 0.0])
        imu = ImuSample(
            stamp_ns=stamp, vue_id="vue_1", angular_velocity=value, specific_force=value
        )
        step = Velocity(stamp_ns=stamp, vue_id="vue_1", velocity=value[:2], cov=np.eye(2))
        found += [Arrival(stamp, imu), Arrival(stamp, step)]
    return in_order([Arrival(5 * NS, SCENE["a"]), *found])


@pytest.mark.parametrize("name", sorted(possible_live()))
def test_piece_by_piece_a_fault_does_the_same(name: str) -> None:
    size = 40.0 if name in {"invented_devices", "flood"} else 0.5
    whole = FAULTS[name].apply(device_stream(), hit(size, ("a", "b")))
    live = Piecewise(FAULTS[name], hit(size, ("a", "b")))
    pieces = live.own() + [found for a in device_stream() for found in live.of(a)]
    assert sorted((a.at_ns, repr(a.what)) for a in pieces) == sorted(
        (a.at_ns, repr(a.what)) for a in whole
    )
    assert len(pieces) != 401 or name not in {"drop", "silence", "replayed", "invented_rsus"}


def test_the_same_seed_strikes_the_same_messages() -> None:
    def stamps() -> list[tuple[int, str]]:
        left = FAULTS["drop"].apply(stream(), hit(0.5))
        return [(a.at_ns, getattr(a.what, "rsu_id", "")) for a in left]

    assert stamps() == stamps()
    assert 3 <= 200 - len(stamps()) <= 17  # of 20, probability one half: else once in 2000


def test_sizes_are_in_the_unit_told() -> None:
    biased = FAULTS["bias"].apply(stream(), hit(4.0))
    told = {a.what.stamp_ns: a.what for a in biased if a.what.rsu_id == "a"}  # type: ignore[union-attr]
    before, during = told[3 * NS], told[5 * NS]
    assert (before.range_m, before.azimuth_rad) == (50.0, 1.0)  # type: ignore[union-attr]
    assert during.range_m == pytest.approx(70.0 + 4 * 0.5)  # type: ignore[union-attr]
    assert during.azimuth_rad == pytest.approx(1.0 + 4 * 0.01)  # type: ignore[union-attr]


def test_partition_delivers_all_at_its_end_in_order() -> None:
    struck = FAULTS["partition"].apply(stream(), hit(rsus=("a", "b")))
    assert not [a for a in struck if 4 * NS <= a.at_ns < 6 * NS]
    late = [a.what.stamp_ns for a in struck if a.at_ns == 6 * NS]  # type: ignore[union-attr]
    assert late == sorted(late)
    assert len(struck) == 200


@pytest.mark.parametrize("convention", list(AngleConvention))
def test_a_lie_has_the_geometry_of_the_place_told(convention: AngleConvention) -> None:
    """By hand: an RSU that looks north and is 5 m up sees a device 3 m east and 4 m north of it,
    on the ground."""
    north = np.array([0.0, 0.0, np.sin(np.pi / 4), np.cos(np.pi / 4)])
    rsu = replace(SCENE["a"], quaternion=north, angle_convention=convention)
    m = RsuMeasurement(stamp_ns=1, rsu_id="a", vue_id="v", reference_rsu_id="b")
    true, told = np.array([0.0, 5.0, 5.0]), np.array([3.0, 4.0, 0.0])
    lie = measured_from(m, true, told, {"a": rsu, "b": SCENE["b"]})
    distance = np.sqrt(50.0)
    azimuth = (
        np.arctan2(-3.0, 4.0)
        if convention is AngleConvention.SPHERICAL
        else np.arcsin(-3.0 / distance)
    )
    assert lie.azimuth_rad == pytest.approx(azimuth)
    assert lie.elevation_rad == pytest.approx(-np.pi / 4)
    assert lie.range_m == pytest.approx(distance - 5.0)
    assert lie.toa_s * C == pytest.approx(distance - 5.0)
    far = np.hypot(47.0, np.hypot(4.0, 5.0)) - np.hypot(50.0, 5.0)
    assert lie.tdoa_s * C == pytest.approx(distance - 5.0 - far)


@pytest.fixture(scope="module")
def small() -> dict[str, Outcome]:
    """The small campaign: a yard of six receivers."""
    faults = (
        Entry(fault="drop", size=0.3, rsus="all"),
        Entry(fault="silence", lasts_s=5.0),
        Entry(fault="bias", size=30.0),
        Entry(fault="not_finite", size=0.5, rsus="all"),
        Entry(fault="corrupt", size=0.5, rsus="all"),
        Entry(fault="clock_step", size=30.0),
        Entry(fault="tracker_crash", lasts_s=3.0),
        Entry(fault="flood", size=20.0),
        Entry(fault="freeze", rsus="all"),
        Entry(fault="creeping", size=30.0, rsus="all"),
        Entry(fault="device_silent"),
    )
    plan = Plan(faults=faults)
    with Work(1, 0, 1) as work:
        return {outcome.fault: outcome for outcome in campaign(plan, ["tdoa_yard"], work)}


def test_nothing_ends_the_tracker_and_all_is_finite(small: dict[str, Outcome]) -> None:
    assert len(small) == 11
    assert [o.fault for o in small.values() if o.failed] == []


def test_what_notices_a_fault_is_told(small: dict[str, Outcome]) -> None:
    assert small["drop 0.3 share, all RSUs"].detected == ()
    assert small["bias 30 sd"].detected[0].startswith("excluded rsu_")
    assert any("COASTING" in words for words in small["silence"].detected)
    assert any(
        "refused not_finite" in words for words in small["not_finite 0.5 share, all RSUs"].detected
    )
    assert any("refused clock_ahead" in words for words in small["clock_step 30 s"].detected)
    assert any(
        "refused no message" in words for words in small["corrupt 0.5 share, all RSUs"].detected
    )


def test_estimates_that_are_missing_are_counted(small: dict[str, Outcome]) -> None:
    """Epochs are 0.1 s apart: 3 s without a tracker are 30, of which none comes again."""
    crash = small["tracker_crash"]
    assert crash.missing_during == 30
    assert crash.missing_after <= 2
    assert crash.recovered_s is not None
    assert crash.recovered_s < 2.0


def test_a_lie_of_everybody_is_counted_as_a_miss(small: dict[str, Outcome]) -> None:
    """All RSUs tell of a device that goes another way: nothing contradicts them."""
    lie = small["creeping 30 m, all RSUs"]
    assert lie.missed
    assert lie.max_m is not None
    assert lie.max_m > 25.0
    assert worst_first(list(small.values()))[0] is lie


def test_rsus_that_are_stuck_are_noticed(small: dict[str, Outcome]) -> None:
    """Their values stand still while the device moves 40 m. Each pair's are refused after half a
    second."""
    frozen = small["freeze, all RSUs"]
    assert any("refused repeated" in words for words in frozen.detected)
    assert any("COASTING" in words for words in frozen.detected)
    assert frozen.max_m is not None
    assert frozen.max_m < 4.0
    assert frozen.beyond < 10


def test_a_fault_of_what_the_scenario_has_not_is_left_out(small: dict[str, Outcome]) -> None:
    assert not small["device_silent"].applies
    text = markdown(list(small.values()), "netpos faults x")
    assert "device_silent" not in text
    rows = [line for line in text.splitlines() if line.startswith("| ")]
    assert len(rows) == 1 + 10
    assert all(line.count("|") == len(HEADS) + 1 for line in rows)
    assert "**" in rows[1]


def test_an_undisturbed_run_is_the_replay() -> None:
    """A fault that strikes nothing leaves the estimates as they are."""
    run = undisturbed("tdoa_yard")
    assert not run.answer.crashed
    assert len(run.answer.odometry["vue_1"]) == 283
    plan = Plan(faults=(Entry(fault="drop", size=1e-12),))
    assert not strike("tdoa_yard", run, plan, 0).applies


def test_the_shipped_plan_has_enough() -> None:
    plan = load_plan()
    assert len(plan.faults) >= 24
    assert {entry.fault for entry in plan.faults} == set(FAULTS)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("faults: [{fault: biass, size: 1.0}]", "no fault 'biass'"),
        ("faults: [{fault: bias}]", "bias needs a size [sd]"),
        ("faults: [{fault: silence, size: 2.0}]", "silence has no size"),
        ("faults: [{fault: drop, size: 1.5}]", "size of drop is a share"),
        ("faults: [{fault: bias, size: 1.0, rsus: 0}]", "rsus of bias must be >= 1"),
        ("faults: [{fault: bias, size: .nan}]", "faults.0.size"),
        ("faults: []", "faults"),
        ("start: 2\nfaults: [{fault: silence}]", "start"),
        ("faults: [", "not valid YAML"),
    ],
)
def test_a_bad_plan_is_refused_in_words(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "plan.yaml"
    path.write_text(text)
    result = CliRunner().invoke(app, ["faults", "tdoa_yard", "--plan", str(path)])
    assert result.exit_code == 2
    assert said in result.output
    assert str(path) in result.output


def test_the_command_writes_the_table_and_the_figures(tmp_path: Path) -> None:
    path = tmp_path / "plan.yaml"
    path.write_text("faults: [{fault: bias, size: 30.0}]")
    out, figures = tmp_path / "table.md", tmp_path / "figures.json"
    arguments = ["faults", "tdoa_yard", "--plan", str(path), "--workers", "1"]
    result = CliRunner().invoke(app, [*arguments, "--out", str(out), "--json", str(figures)])
    assert result.exit_code == 0, result.output
    assert "| bias 30 sd | tdoa_yard | excluded rsu_" in out.read_text()
    assert '"detected"' in figures.read_text()
