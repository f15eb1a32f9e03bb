"""Scenario files: what is accepted, and that every complaint names line and key."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from netpos.messages.values import Odometry
from netpos.scenario import ScenarioError, Simulation, load_scenario, scenario_names
from netpos.scenario.load import scenario_of_text, scenario_text
from netpos.scenario.size import route_duration_s
from scipy.spatial.transform import Rotation

GOOD = """\
seed: 3
rsus:
  units:
    - {id: rsu_1, position: [0.0, 0.0, 0.0]}
measurement:
  quantities: [azimuth, toa]
  errors: {model: fixed, azimuth_sd_deg: 2.0, toa_sd_s: 50e-9}
devices:
  - route: {kind: waypoints, points: [[0.0, 5.0], [10.0, 5.0]]}
    speed_mps: 1.0
    beacon_interval_s: 0.1
    clock:
      drift_sd: 1e-6
tracker:
  drift_step_sd: 1e-4
"""


def _write(folder: Path, text: str) -> str:
    path = folder / "trial.yaml"
    path.write_text(text, encoding="utf-8")
    return str(path)


def test_a_good_file(tmp_path: Path) -> None:
    scenario = load_scenario(_write(tmp_path, GOOD))
    assert (scenario.name, scenario.seed, scenario.vue_ids) == ("trial", 3, ("vue_1",))
    assert scenario.duration_s == pytest.approx(10.0)
    assert scenario.devices[0].clock.drift_sd == 1e-6
    assert scenario.tracker == {"drift_step_sd": 1e-4}  # a number, also without a dot
    assert load_scenario(_write(tmp_path, GOOD), seed=8).seed == 8


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("speed_mps: 1.0", "sped_mps: 1.0", "line 10: devices.0.sped_mps: unknown key"),
        ("    speed_mps: 1.0\n", "", "line 9: devices.0: a device needs either speed_mps"),
        ("speed_mps: 1.0", "speed_mps: -1.0", "line 10: devices.0.speed_mps: .*got -1.0"),
        ("speed_mps: 1.0", "speed_mps: .nan", "line 10: devices.0.speed_mps: .*got nan"),
        ("speed_mps: 1.0", "speed_mps: fast", "line 10: devices.0.speed_mps: .*got 'fast'"),
        ("drift_sd: 1e-6", "drift_sd: -1", "line 13: devices.0.clock.drift_sd: .*got -1"),
        ("drift_sd: 1e-6", "drift: 1", "line 13: devices.0.clock.drift: unknown key"),
        ("azimuth_sd_deg: 2.0, ", "", "line 5: measurement: errors.azimuth_sd_deg is missing"),
        (
            "azimuth_sd_deg: 2.0",
            "azimuth_sd_deg: 0",
            "line 7: measurement.errors.azimuth_sd_deg: ",
        ),
        ("model: fixed", "model: magic", "line 7: measurement.errors: .*magic"),
        ("kind: waypoints", "kind: metis_random", "line 9: devices.0.route.points: unknown key"),
        ("[10.0, 5.0]", "[0.0, 5.0]", "line 9: devices.0: .*same point"),
        ("seed: 3", "seed: 3\nseed: 4", "line 2: seed was given already in line 1"),
        ("seed: 3", "seed: [3", "line .*not valid YAML"),
        ("seed: 3", "seed: -3", "line 1: seed: .*got -3"),
        (
            "    - {id: rsu_1, position: [0.0, 0.0, 0.0]}\n",
            "    []\n",
            "line 2: rsus: layout 'list'",
        ),
        ("0.1\n", "0.1\n    imu: {rate_hz: 30}\n", "line 9: devices.0: .*whole nanoseconds"),
        ("seed: 3", "seed: 3\nstart_s: 3.0e9", "line 2: start_s: .*2000000000"),
        ("seed: 3", 'seed: 3\nname: "a/b"', "line 2: name: "),
        ("azimuth, toa", "azimuth, azimuth", "line 5: measurement: quantities must name"),
    ],
)
def test_complaints_name_line_and_key(tmp_path: Path, old: str, new: str, complaint: str) -> None:
    assert old in GOOD
    with pytest.raises(ScenarioError, match=complaint) as caught:
        load_scenario(_write(tmp_path, GOOD.replace(old, new, 1)))
    assert "trial.yaml" in str(caught.value)


def test_an_imu_on_a_sharp_corner_is_refused(tmp_path: Path) -> None:
    text = GOOD.replace("[10.0, 5.0]]", "[10.0, 5.0], [10.0, 9.0]]").replace(
        "    clock:", "    imu: {}\n    clock:"
    )
    with pytest.raises(ScenarioError, match="without jumps"):
        load_scenario(_write(tmp_path, text))
    rounded = text.replace("9.0]]}", "9.0]], corner_radius_m: 1.0}")
    assert load_scenario(_write(tmp_path, rounded)).devices[0].imu is not None


def test_empty_missing_and_unknown(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match="a mapping"):
        load_scenario(_write(tmp_path, ""))
    with pytest.raises(ScenarioError, match="no scenario file"):
        load_scenario(str(tmp_path / "absent.yaml"))
    with pytest.raises(ScenarioError, match=r"no scenario 'absent'; known: .*metis_madrid"):
        load_scenario("absent")


def test_changes_are_validated_too(tmp_path: Path) -> None:
    path = _write(tmp_path, GOOD)
    changed = load_scenario(path, changes={"devices.0.beacon_interval_s": 0.01})
    assert changed.devices[0].beacon_interval_ns == 10_000_000
    assert load_scenario(path, changes={"measurement.los.max_distance_m": 30}).measurement.los
    with pytest.raises(ScenarioError, match=r"devices\.0\.speed_mps"):
        load_scenario(path, changes={"devices.0.speed_mps": 0})
    with pytest.raises(ScenarioError, match="no such place"):
        load_scenario(path, changes={"devices.4.speed_mps": 1})


def test_a_scenario_cannot_be_altered(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="frozen"):
        load_scenario(_write(tmp_path, GOOD)).seed = 4  # type: ignore[misc]


@pytest.mark.parametrize("name", scenario_names())
def test_every_shipped_scenario_loads(name: str) -> None:
    assert load_scenario(name).name == name
    assert load_scenario(name).description


@pytest.mark.parametrize("name", scenario_names())
def test_the_text_of_a_scenario_gives_the_scenario(name: str) -> None:
    """Buildings, RSUs and tracker of a bag are those of its run, whatever is installed later."""
    scenario = load_scenario(name, seed=77)
    assert scenario_of_text(scenario_text(scenario), Path("a bag")) == scenario


def test_a_scenario_text_that_cannot_be_read_names_its_bag() -> None:
    with pytest.raises(ScenarioError, match="a bag"):
        scenario_of_text("rsus: [", Path("a bag"))


def test_metis_interval_is_a_whole_number_of_frames() -> None:
    assert load_scenario("metis_madrid").devices[0].beacon_interval_ns == 500 * 167_300


def test_variants_differ_in_one_value_only() -> None:
    def plain(name: str) -> dict[str, object]:
        return load_scenario(name).model_dump(exclude={"name", "description"})

    slow, fast = plain("fast_pass"), plain("fast_pass_100hz")
    fast["devices"][0]["beacon_interval_s"] = 0.1  # type: ignore[index]
    assert slow == fast
    wide, narrow = plain("intersection_turn"), plain("intersection_turn_30m")
    narrow["measurement"]["los"]["max_distance_m"] = 40.0  # type: ignore[index]
    assert wide == narrow


WALKER = """\
  - route: {kind: rectangle, width_m: 5.7, height_m: 4.5, pauses_s: [0.51, 0.51, 0.51, 0.51, 0.51]}
    gait: {step_length_m: 0.6375, cadence_hz: 1.568627450980392}
    antenna_height_m: 1.0
    beacon_interval_s: 0.1
    imu: {}
    magnetometer: {disturbances: [{center: [5, 2], radius_m: 0.7, field_t: [15.0e-6, 0, 0]}]}
"""


def _walker(tmp_path: Path, text: str = WALKER) -> str:
    return _write(tmp_path, GOOD[: GOOD.index("  - route")] + text)


def test_a_person_walks_a_route(tmp_path: Path) -> None:
    scenario = load_scenario(_walker(tmp_path))
    assert scenario.duration_s == pytest.approx(25.5)
    simulation = Simulation(scenario)
    beacons = simulation.beacons("vue_1")
    assert np.ptp(beacons.position[:, 2]) == pytest.approx(0.04, rel=0.1)
    assert beacons.position[0, 2] == 1.0
    truth = [e for e in simulation.events() if isinstance(e, Odometry)]
    for state, position, velocity in zip(truth, beacons.position, beacons.velocity, strict=True):
        np.testing.assert_array_equal(state.position, position)
        turned = Rotation.from_quat(state.quaternion).apply(state.linear_velocity)
        np.testing.assert_allclose(turned[:2], velocity, atol=1e-12)
    assert len(simulation.imu("vue_1")) == 2550


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("    gait:", "    speed_mps: 1.0\n    gait:", "devices.0: a device needs either"),
        ("    gait:", "    acceleration_mps2: 1.0\n    gait:", "remove acceleration_mps2"),
        ("pauses_s: [0.51, 0.51, 0.51, 0.51, 0.51]", "laps: 1", "give each a pause in pauses_s"),
        ("step_length_m: 0.6375", "step_length_m: 0.0", "step_length_m: input should be greater"),
        ("cadence_hz", "cadence", "gait.cadence: unknown key"),
        ("radius_m: 0.7", "radius_m: -1", "radius_m: input should be greater"),
        ("    imu: {}", "    imu: {}\n    pdr: {height: 1.8}", "no parameter height of pdr"),
        (
            "    imu: {}",
            "    imu: {}\n    pdr: {height_m: -1.0}",
            r"pdr.height_m must be in \[1e-09, 1e\+09\], got -1.0",
        ),
    ],
)
def test_complaints_about_a_walker(tmp_path: Path, old: str, new: str, complaint: str) -> None:
    assert old in WALKER
    with pytest.raises(ScenarioError, match=complaint):
        load_scenario(_walker(tmp_path, WALKER.replace(old, new)))


PATH = {
    "kind": "path",
    "start": [1.0, 2.0],
    "heading_deg": 90.0,
    "legs": [{"straight_m": 5.0}, {"arc_deg": -90.0, "radius_m": 4.0}],
}


def test_a_path_of_lines_and_arcs(tmp_path: Path) -> None:
    """Northwards 5 m, a quarter of 4 m to the right; an IMU may be on it."""
    path = _write(tmp_path, GOOD)
    changes: dict[str, object] = {"devices.0.route": PATH, "devices.0.speed_mps": 2.0}
    device = load_scenario(path, changes=changes | {"devices.0.imu": {}}).devices[0]
    motion = device.motion(1, "vue_1")
    assert motion.duration_s == pytest.approx((5.0 + 2.0 * math.pi) / 2.0)
    end = motion.body_at(motion.duration_s)
    np.testing.assert_allclose(end.position[0], [5.0, 11.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(end.velocity[0], [2.0, 0.0, 0.0], atol=1e-9)
    assert route_duration_s(device) == pytest.approx(motion.duration_s)
    walker = {"devices.0.speed_mps": None, "devices.0.gait": {"step_length_m": 0.6}}
    person = load_scenario(path, changes=changes | walker).devices[0]
    gait = person.motion(1, "vue_1")
    np.testing.assert_allclose(gait.body_at(gait.duration_s).position[0, :2], [5, 11], atol=1e-9)
    assert route_duration_s(person) == pytest.approx(gait.duration_s, rel=0.1)


@pytest.mark.parametrize(
    ("leg", "words"),
    [  # as in YAML
        ("straight_m: 1.0, radius_m: 2.0", "either straight_m, or arc_deg"),
        ("arc_deg: 10.0", "either straight_m, or arc_deg"),
        ("arc_deg: 0.0, radius_m: 2.0", "either straight_m, or arc_deg"),
        (
            "straight_m: -1.0",
            r"line 12: devices\.0\.route\.legs\.2\.straight_m.*greater than 0, got -1",
        ),
        ("length_m: 1.0", r"line 12: devices\.0\.route\.legs\.2\.length_m: unknown key"),
    ],
)
def test_a_leg_is_a_line_or_an_arc(leg: str, words: str, tmp_path: Path) -> None:
    route = (
        "{kind: path, start: [0.0, 5.0], heading_deg: 0.0, legs: [\n"
        f"        {{straight_m: 1.0}},\n        {{arc_deg: 9, radius_m: 1}},\n        {{{leg}}}]}}"
    )
    text = GOOD.replace("{kind: waypoints, points: [[0.0, 5.0], [10.0, 5.0]]}", route)
    with pytest.raises(ScenarioError, match=words):
        load_scenario(_write(tmp_path, text))
