"""The networks that ``scripts/fewer_rsus.py`` makes of a recording."""

from __future__ import annotations

import importlib
from types import ModuleType

import numpy as np
import pytest
from netpos.evaluation.guarded_runs import Material
from netpos.evaluation.yardsticks import Kind, Observations
from netpos.messages.values import Array, Field, Odometry, RsuInfo, RsuMeasurement
from netpos.scenario.settings import TrackerSettings
from runs import ROOT

PLACES = {
    name: np.array([x, y, 0.0])
    for name, x, y in (("a", 0.0, 0.0), ("b", 9.0, 0.0), ("c", 0.0, 7.0), ("d", 9.0, 7.0))
}
START_NS, STEP_NS, COUNT = 5_000_000_000, 100_000_000, 40


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "scripts"))
    return importlib.import_module("fewer_rsus")


def way(k: int) -> Array:
    return np.array([1.0 + 0.1 * k, 2.0 + 0.05 * k, 0.0])


def recording() -> tuple[Material, Observations]:
    """Ranges without noise of four RSUs in turn, and what the plain filter takes of them."""
    stamps = [START_NS + k * STEP_NS for k in range(COUNT)]
    names = [list(PLACES)[k % len(PLACES)] for k in range(COUNT)]
    ranges = [float(np.linalg.norm(way(k) - PLACES[name])) for k, name in enumerate(names)]
    items = [
        RsuMeasurement(
            stamp_ns=stamp,
            rsu_id=name,
            vue_id="vue_1",
            fields=Field.RANGE,
            range_m=range_m,
            range_var=0.01,
        )
        for stamp, name, range_m in zip(stamps, names, ranges, strict=True)
    ]
    truth = [
        Odometry(
            stamp_ns=stamp,
            vue_id="vue_1",
            position=way(k),
            quaternion=np.array([0.0, 0.0, 0.0, 1.0]),
            linear_velocity=np.zeros(3),
        )
        for k, stamp in enumerate(stamps)
    ]
    rsus = tuple(RsuInfo(rsu_id=name, position=place) for name, place in PLACES.items())
    material = Material(settings=TrackerSettings(), rsus=rsus, items=items, truth={"vue_1": truth})
    seen = Observations(
        stamp_ns=np.array(stamps),
        kind=np.full(COUNT, int(Kind.RANGE)),
        value=np.array(ranges),
        sd=np.full(COUNT, 0.1),
        rsu=np.array([PLACES[name] for name in names]),
        other=np.zeros((COUNT, 3)),
        axes=np.broadcast_to(np.eye(3), (COUNT, 3, 3)),
        lever_arm=np.zeros((COUNT, 3)),
    )
    return material, seen


def test_what_runs_backwards_fits_its_truth_and_goes_the_other_way(script: ModuleType) -> None:
    material, seen = recording()
    turned, turned_seen = script.backwards(material, seen)
    positions = {odometry.stamp_ns: odometry.position for odometry in turned.truth["vue_1"]}
    for item in turned.items:
        distance = np.linalg.norm(positions[item.stamp_ns] - PLACES[item.rsu_id])
        assert item.range_m == pytest.approx(distance, rel=1e-12)
    stamps = [item.stamp_ns for item in turned.items]
    assert stamps == [item.stamp_ns for item in material.items]
    assert (positions[stamps[0]] == way(COUNT - 1)).all()
    assert turned_seen.stamp_ns.tolist() == stamps
    assert turned_seen.value.tolist() == [item.range_m for item in turned.items]
    again, again_seen = script.backwards(turned, turned_seen)
    assert again.items == material.items
    assert (again_seen.value == seen.value).all()


def test_both_sides_have_the_same_measurements_in_every_part(script: ModuleType) -> None:
    for part in script.parts(*recording()):
        seen = script.seen_of(part.everything, part.material)
        heard = [item.range_m for item in part.material.items]
        assert seen.value.tolist() == heard, part.name
        assert len(heard) > 0, part.name


def test_parts_of_a_network_of_four(script: ModuleType) -> None:
    parts = {part.name: part.material for part in script.parts(*recording())}
    assert all(name.startswith(script.KINDS) for name in parts)
    kinds = [name.split()[0].strip(",") for name in parts]
    assert [kinds.count(kind) for kind in script.KINDS] == [1, 4 + 2, 5, 6, 3]
    two = parts["two, without a and c"]
    assert {item.rsu_id for item in two.items} == {"b", "d"}
    assert {item.rsu_id for item in parts["without b"].items} == {"a", "c", "d"}
    late = parts["backwards from 35% on"].items
    assert late[0].stamp_ns > START_NS + 0.35 * (COUNT - 1) * STEP_NS
    assert len(late) == COUNT - 1 - int(0.35 * (COUNT - 1))
