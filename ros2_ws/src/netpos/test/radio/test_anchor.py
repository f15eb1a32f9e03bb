"""The two-antenna anchor: geometry written out, timestamps of an exchange kept as fractions."""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Literal

import numpy as np
import pytest
from netpos.messages.values import Field
from netpos.radio.anchor import TwoAntennas, TwoWayRanging, uwb_wavelength_m
from netpos.scenario import Simulation, load_scenario
from netpos.scenario.load import ScenarioError
from pydantic import ValidationError
from scipy import stats
from scipy.constants import speed_of_light

YAML = """
seed: 3
rsus:
  units:
    - {id: anchor, position: [1.0, 2.0, 0.0], yaw_deg: 120.0,
       antennas: {uwb_channel: 5, baseline_wavelengths: 4.0}}
measurement:
  quantities: [range, phase]
  nearest: 1
  errors: {model: fixed, phase_sd_deg: 6.0, two_way_ranging: {drift_sd: 0.0}}
devices:
  - route: {kind: rectangle, corner: [-4.0, -1.0], width_m: 3.0, height_m: 6.0}
    speed_mps: 1.0
    beacon_interval_s: 0.01
"""


@pytest.fixture
def scenario_file(tmp_path):  # type: ignore[no-untyped-def]
    path = tmp_path / "anchor.yaml"
    path.write_text(YAML)
    return str(path)


def exchange(
    flight: Fraction, replies: tuple[Fraction, Fraction], drifts: tuple[Fraction, Fraction]
) -> tuple[Fraction, Fraction]:
    """Flight times by the symmetric and the asymmetric formula of one noise-free exchange.

    replies, drifts : of the anchor and of the device
    """
    polled = flight
    responded = polled + replies[0]
    heard = responded + flight
    ended = heard + replies[1]
    last = ended + flight
    anchor, device = (1 + drift for drift in drifts)
    round_1, reply_1 = device * heard, anchor * (responded - polled)
    round_2, reply_2 = anchor * (last - responded), device * (ended - heard)
    symmetric = (round_1 - reply_1 + round_2 - reply_2) / 4
    product = round_1 * round_2 - reply_1 * reply_2
    return symmetric, product / (round_1 + round_2 + reply_1 + reply_2)


@pytest.mark.parametrize(("method", "method_index"), [("symmetric", 0), ("asymmetric", 1)])
def test_the_residual_of_the_drift_is_that_of_the_timestamps(
    method: Literal["symmetric", "asymmetric"], method_index: int
) -> None:
    ranging = TwoWayRanging(anchor_reply_s=1e-3, device_reply_s=1.5e-3, method=method)
    replies = Fraction(1, 1000), Fraction(3, 2000)
    anchor, device = Fraction(-4, 10**6), Fraction(7, 10**6)
    flight = Fraction(20, 10**9)
    measured = exchange(flight, replies, (anchor, device))[method_index]
    scale, offset_m = ranging.residual(float(device), float(anchor))
    distance_m = float(flight) * speed_of_light
    expected_m = float(measured - flight) * speed_of_light
    assert distance_m * scale + offset_m == pytest.approx(expected_m, rel=1e-4)
    assert abs(expected_m) > (1e-6 if method_index else 0.1)


@pytest.mark.parametrize("method", ["symmetric", "asymmetric"])
@pytest.mark.parametrize("replies", [(1e-3, 1e-3), (1e-3, 3e-3)])
def test_the_range_sd_is_that_of_noisy_timestamps(
    method: Literal["symmetric", "asymmetric"], replies: tuple[float, float]
) -> None:
    """Formulae on timestamps without the large common part, which doubles would round."""
    sd, rng = 160e-12, np.random.default_rng(4)
    polled, heard, last = sd * rng.standard_normal((3, 400_000))
    anchor, device = replies
    round_1, reply_1 = heard, -polled  # errors of each interval
    round_2, reply_2 = last, -heard
    if method == "symmetric":
        flight = (round_1 - reply_1 + round_2 - reply_2) / 4
    else:  # first order of the product formula about no flight time
        change = anchor * round_2 + device * round_1 - anchor * reply_2 - device * reply_1
        flight = change / (2 * (anchor + device))
    ranging = TwoWayRanging(
        timestamp_sd_s=sd, anchor_reply_s=anchor, device_reply_s=device, method=method
    )
    assert ranging.range_sd_m == pytest.approx(speed_of_light * flight.std(), rel=5e-3)


def test_wavelengths_of_uwb_channels() -> None:
    assert uwb_wavelength_m(5) == pytest.approx(0.046196, abs=1e-6)
    assert uwb_wavelength_m(9) == pytest.approx(0.037534, abs=1e-6)
    with pytest.raises(ValueError, match="uwb_channel must be one of 0 to 15, got 16"):
        uwb_wavelength_m(16)
    assert TwoAntennas(baseline_wavelengths=4.0).baseline_m == pytest.approx(0.18478, abs=1e-5)


@pytest.mark.parametrize("baseline", [0.49, 10.01, math.nan])
def test_baselines_out_of_range_are_refused(baseline: float) -> None:
    with pytest.raises(ValidationError, match="baseline_wavelengths"):
        TwoAntennas(baseline_wavelengths=baseline)


def test_measured_range_and_phase_are_those_of_the_geometry(scenario_file: str) -> None:
    """Boresight at 120 degrees, so that the paper's x axis looks along 30 degrees."""
    simulation = Simulation(load_scenario(scenario_file))
    assert simulation.fields == Field.RANGE | Field.PHASE
    (info,) = simulation.rsus
    x_axis = np.array([math.cos(math.radians(30.0)), math.sin(math.radians(30.0))])
    y_axis = np.array([-x_axis[1], x_axis[0]])
    beacons, seen = simulation.beacons("vue_1"), simulation.observations("vue_1")
    d = beacons.position[:, :2] - info.position[:2]
    x, y = d @ x_axis, d @ y_axis
    np.testing.assert_array_equal(seen.heard_by, (y >= 0).astype(int))
    assert 0.1 < (y < 0).mean() < 0.9
    heard = seen.heard_by > 0
    to_master = np.hypot(x - info.baseline_m / 2, y)[heard]
    range_error = (seen.values[heard, 0, 3] - to_master) / np.sqrt(seen.variances[heard, 0, 3])
    true_phase = 2 * np.pi * 4.0 * np.sin(np.arctan2(x, y))[heard]
    measured = seen.values[heard, 0, 4]
    assert (measured >= -np.pi).all()
    assert (measured < np.pi).all()
    phase_error = (measured - true_phase + np.pi) % (2 * np.pi) - np.pi
    for error in (range_error, phase_error / math.radians(6.0)):
        assert stats.kstest(error, "norm").pvalue > 1e-4
    assert abs(np.corrcoef(range_error, phase_error)[0, 1]) < 0.15
    np.testing.assert_allclose(seen.variances[heard, 0, 4], math.radians(6.0) ** 2)
    sd_m = TwoWayRanging().range_sd_m
    np.testing.assert_allclose(seen.variances[heard, 0, 3], sd_m**2)


def test_a_drift_of_the_clocks_shifts_every_range_alike(scenario_file: str) -> None:
    changes = {"measurement.errors.two_way_ranging": {"drift_sd": 1e-5, "method": "symmetric"}}
    unequal = {**changes["measurement.errors.two_way_ranging"], "device_reply_s": 2e-3}
    ideal = Simulation(load_scenario(scenario_file)).observations("vue_1")
    equal = Simulation(load_scenario(scenario_file, changes=changes)).observations("vue_1")
    late = Simulation(
        load_scenario(scenario_file, changes={"measurement.errors.two_way_ranging": unequal})
    ).observations("vue_1")
    heard = ideal.heard_by > 0
    shift = late.values[heard, 0, 3] - equal.values[heard, 0, 3]
    assert np.ptp(shift) < 1e-9
    assert 0.01 < abs(shift[0]) < 3.0
    assert np.abs(equal.values[heard, 0, 3] - ideal.values[heard, 0, 3]).max() < 1e-3


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"measurement.errors.phase_sd_deg": None}, "errors.phase_sd_deg is missing"),
        ({"rsus.units.0.antennas": None}, "give every RSU in rsus.units its antennas"),
        ({"rsus.units.0.antennas.baseline_wavelengths": 0.4}, "baseline_wavelengths"),
        ({"rsus.units.0.antennas.uwb_channel": 16}, "uwb_channel"),
        ({"measurement.errors.range_sd_m": 0.03}, "remove range_sd_m"),
        ({"measurement.errors.two_way_ranging": None}, "errors.range_sd_m is missing"),
        ({"measurement.errors": {"model": "cramer_rao"}}, "phase needs errors of model fixed"),
    ],
)
def test_scenarios_without_sense_are_refused(
    scenario_file: str, changes: dict[str, object], message: str
) -> None:
    with pytest.raises(ScenarioError, match=message):
        load_scenario(scenario_file, changes=changes)
