"""Several networks: own times, own noise, own names; what a scenario may not say of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from netpos.messages.values import Beacon, Field, RsuMeasurement
from netpos.scenario import Simulation, load_scenario
from netpos.scenario.load import ScenarioError
from netpos.scenario.networks import fix_errors
from netpos.scenario.topics import device_topics
from scipy import stats

NS = 1_000_000_000


def measured(seed: int = 1, **changes: Any) -> list[tuple[Beacon, RsuMeasurement]]:
    simulation = Simulation(load_scenario("two_networks", seed=seed, changes=changes))
    return [
        (event, m)
        for event in simulation.events()
        if isinstance(event, Beacon)
        for m in simulation.measure(event)
    ]


def test_each_network_has_times_names_and_variances_of_its_own() -> None:
    arrivals = measured()
    stamps = {
        name: np.array([(m.stamp_ns - NS) // 10**6 for _, m in arrivals if m.rsu_id == name])
        for name in ("wifi_server", "wimax_server")
    }
    np.testing.assert_array_equal(stamps["wifi_server"], np.arange(0, 60_001, 500))
    np.testing.assert_array_equal(stamps["wimax_server"], np.arange(200, 60_001, 500))
    for _, m in arrivals:
        wifi = m.rsu_id == "wifi_server"
        assert m.vue_id == ("wifi_1" if wifi else "vue_1")
        assert m.fields == Field.POSITION
        assert m.expected == 1
        np.testing.assert_array_equal(m.position_cov, (100.0 if wifi else 9.0) * np.eye(3))


def test_noise_of_fixes_is_white_with_its_variance() -> None:
    errors = fix_errors(np.arange(1, 20_001), 3.0, 7, "a", "vue_1")
    np.testing.assert_allclose(errors.std(axis=0), 3.0, rtol=0.03)
    np.testing.assert_allclose(errors.mean(axis=0), 0.0, atol=0.1)
    assert stats.kstest(errors[:, 0] / 3.0, "norm").pvalue > 1e-3
    assert abs(np.corrcoef(errors.T)[0, 1]) < 0.03
    assert abs(np.corrcoef(errors[:-1, 0], errors[1:, 0])[0, 1]) < 0.03
    other = fix_errors(np.arange(1, 20_001), 3.0, 7, "b", "vue_1")
    assert abs(np.corrcoef(errors[:, 0], other[:, 0])[0, 1]) < 0.03


def test_fixes_lie_around_the_truth() -> None:
    misses = [m.position - b.position for b, m in measured() if m.rsu_id == "wimax_server"]
    assert 2.0 < np.std(misses) < 4.0
    errors = fix_errors([NS + NS // 5], 3.0, 1, "wimax_server", "vue_1")
    np.testing.assert_allclose(misses[0], errors[0], atol=1e-9)


def test_own_names_are_a_permutation_of_the_seed() -> None:
    changes = {"devices.0.count": 5}
    names = {}
    for beacon, m in measured(3, **changes):
        if m.rsu_id == "wifi_server":
            names[beacon.vue_id] = m.vue_id
    assert sorted(names) == [f"vue_{k}" for k in range(1, 6)]
    assert sorted(names.values()) == [f"wifi_{k}" for k in range(1, 6)]
    others = {b.vue_id: m.vue_id for b, m in measured(4, **changes) if "wifi" in m.rsu_id}
    assert others != names


def test_a_fix_without_networks() -> None:
    """Quantity position works for any RSU."""
    changes = {
        "measurement.quantities": ["azimuth", "position"],
        "measurement.errors": {"model": "fixed", "azimuth_sd_deg": 2.0, "position_sd_m": 4.0},
    }
    simulation = Simulation(load_scenario("fast_pass", changes=changes))
    beacon = next(e for e in simulation.events() if isinstance(e, Beacon))
    m = simulation.measure(beacon)[0]
    assert m.fields == Field.AZIMUTH | Field.POSITION
    assert m.position_cov[1, 1] == 16.0
    assert 0.0 < np.abs(m.position - beacon.position).max() < 20.0


def test_topics_carry_the_truth_of_the_scenario() -> None:
    assert "/vue_1/ground_truth" in device_topics(load_scenario("two_networks"))


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"networks": []}, "fusion needs networks"),
        ({"networks.1.name": "wimax"}, "networks must have different names, got wimax, wimax"),
        ({"rsus.units.1.network": "lte"}, "need RSUs of their own in rsus.units and no others"),
        ({"networks.0.interval_s": 0.25}, "must be multiples of beacon_interval_s"),
        ({"networks.0.phase_s": 0.05}, "must be multiples of beacon_interval_s"),
        ({"measurement.errors.position_sd_m": None}, "errors.position_sd_m is missing"),
        ({"measurement.errors": {"model": "cramer_rao"}}, "position needs errors of model fixed"),
        ({"devices.0.speed_mps": 3.0}, "a quadratic route has its own velocity"),
        ({"devices.0.route.stretches": []}, "at least 1 item"),
    ],
)
def test_complaints(changes: dict[str, Any], complaint: str) -> None:
    with pytest.raises(ScenarioError, match=complaint):
        load_scenario("two_networks", changes=changes)
