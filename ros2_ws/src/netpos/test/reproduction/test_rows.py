"""Rows of a whole run are the rows of its single measurements."""

from __future__ import annotations

import numpy as np
import pytest
from netpos.estimation.measurement import AXES, BIAS, KIND, ORIGIN, Kind
from netpos.estimation.rows import rsu_axes, rsu_rows
from netpos.messages.values import Beacon
from netpos.reproduction.rows import RowTemplates, observation_rows
from netpos.scenario import Simulation, load_scenario

ALL = ["azimuth", "elevation", "toa", "range"]


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("metis_madrid", {"max_duration_s": 20.0}),
        (
            "metis_madrid",
            {
                "max_duration_s": 20.0,
                "measurement.nearest": 4,
                "measurement.quantities": ALL,
                "rsus.height_m": 6.0,
            },
        ),
        ("intersection_turn_30m", {}),  # some beacons are heard by no RSU
        ("intersection_turn", {"rsus.units.0.id": "z", "rsus.units.0.yaw_deg": 30.0}),
    ],
)
def test_rows_are_those_of_single_measurements(name: str, changes: dict[str, object]) -> None:
    simulation = Simulation(load_scenario(name, changes=changes))
    infos = {rsu.rsu_id: rsu for rsu in simulation.rsus}
    templates = RowTemplates.of(simulation.rsus, simulation.fields)
    heard, start, rows, bias = observation_rows(simulation.observations("vue_1"), templates, 6)
    epoch = 0
    for i, beacon in enumerate(e for e in simulation.events() if isinstance(e, Beacon)):
        measured = sorted(simulation.measure(beacon), key=lambda m: m.rsu_id)
        if not measured:
            continue
        assert heard[epoch] == i
        expected = [
            rsu_rows(m, infos[m.rsu_id], rsu_axes(infos[m.rsu_id]), group)
            for group, m in enumerate(measured)
        ]
        ours = rows[start[epoch] : start[epoch + 1]]
        np.testing.assert_array_equal(ours, np.vstack(expected))
        epoch += 1
    assert epoch == heard.size
    assert start[-1] == len(rows)
    assert bias.shape == (2, 0)


def test_a_run_that_nobody_hears_has_no_rows() -> None:
    simulation = Simulation(
        load_scenario("fast_pass", changes={"measurement.los.max_distance_m": 1.0})
    )
    templates = RowTemplates.of(simulation.rsus, simulation.fields)
    heard, start, rows, bias = observation_rows(simulation.observations("vue_1"), templates, 6)
    assert heard.size == len(rows) == bias.size == 0
    assert start.tolist() == [0]


def test_each_rsu_heard_has_a_state_for_its_clock() -> None:
    clock = {"sd_s": 3e-9, "correlation_time_s": 40.0, "reference": "rsu_01"}
    simulation = Simulation(
        load_scenario("metis_madrid", changes={"max_duration_s": 20.0, "rsus.clock": clock})
    )
    seen = simulation.observations("vue_1")
    _, _, rows, bias = observation_rows(
        seen, RowTemplates.of(simulation.rsus, simulation.fields), 7
    )
    ids = {tuple(rsu.position): rsu.rsu_id for rsu in simulation.rsus}
    states: dict[str, set[float]] = {}
    for row in rows:
        if row[KIND] == Kind.TOA:
            states.setdefault(ids[tuple(row[ORIGIN:AXES])], set()).add(row[BIAS])
        else:
            assert row[BIAS] == -1
    reference = states.pop("rsu_01", {-1})
    assert reference == {-1}
    assert all(len(of_one) == 1 for of_one in states.values())
    in_the_order_heard = [state for of_one in states.values() for state in of_one]
    assert in_the_order_heard == list(range(7, 7 + len(states)))
    np.testing.assert_allclose(bias, np.tile([[3e-9 * 299_792_458.0], [40.0]], len(states)))
