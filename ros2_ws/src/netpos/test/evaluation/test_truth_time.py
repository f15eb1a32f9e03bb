"""The time offset of a ground truth, against offsets that are known."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from netpos import write_bag
from netpos.cli.main import app
from netpos.evaluation.pairing import Trajectory
from netpos.evaluation.truth_time import time_offset
from netpos.messages.values import Array, Field, Odometry, RsuInfo, RsuMeasurement
from netpos.scenario.replay import replay_bag
from typer.testing import CliRunner

SITES = {"a": (20.0, 0.0, 2.0), "b": (-15.0, 12.0, 2.0), "c": (0.0, -25.0, 3.0)}
RSUS = {name: RsuInfo(rsu_id=name, position=np.array(site)) for name, site in SITES.items()}


def walk(t: Array) -> Array:
    """Positions (n, 3) m of somebody who walks to and fro, 1.5 m/s at most."""
    return np.column_stack([6.0 * np.sin(0.25 * t), 4.0 * np.sin(0.2 * t + 0.7), 0.0 * t])


def truth_of(late_s: float) -> Trajectory:
    """Of two minutes, 10 a second, with stamps that are late."""
    t = np.arange(0.0, 120.0, 0.1)
    position = walk(t)
    return Trajectory(
        stamp_ns=np.round(1e9 * (t + 10.0 + late_s)).astype(np.int64),
        position=position,
        velocity=np.gradient(position, 0.1, axis=0),
        heading=np.zeros(t.size),
        position_cov=np.zeros((t.size, 3, 3)),
    )


def measured(quantity: Field, seed: int, blocked: float = 0.0) -> list[RsuMeasurement]:
    """About 1000 values of three RSUs in turn, with a constant error of each."""
    rng, found = np.random.default_rng(seed), []
    bias = dict(zip(SITES, rng.normal(0.0, 0.2, 3), strict=True))
    for k in range(1000):
        t, name = 0.11 * k + 2.0, list(SITES)[k % 3]
        away = walk(np.array([t]))[0] - SITES[name]
        error = bias[name] + (rng.exponential(3.0) if rng.random() < blocked else 0.0)
        value = (
            {"range_m": float(np.linalg.norm(away)) + error + rng.normal(0.0, 0.1)}
            if quantity is Field.RANGE
            else {"azimuth_rad": float(np.arctan2(away[1], away[0])) + rng.normal(0.0, 0.01)}
        )
        found.append(
            RsuMeasurement(
                stamp_ns=round(1e9 * (t + 10.0)),
                rsu_id=name,
                vue_id="vue_1",
                fields=quantity,
                range_var=0.01,
                azimuth_var=1e-4,
                **value,
            )
        )
    return found


@pytest.mark.parametrize("quantity", [Field.RANGE, Field.AZIMUTH])
@pytest.mark.parametrize("late_s", [-1.2, -0.15, 0.3])
def test_an_offset_is_found(quantity: Field, late_s: float) -> None:
    """A truth stamped late would have to be earlier by as much."""
    found = time_offset(measured(quantity, 1), RSUS, truth_of(late_s))
    assert found is not None
    assert found.offset_s == pytest.approx(-late_s, abs=0.02)
    assert found.matters


def test_ranges_that_come_late_do_not_shift_it() -> None:
    found = time_offset(measured(Field.RANGE, 2, blocked=0.2), RSUS, truth_of(-0.2))
    assert found is not None
    assert found.offset_s == pytest.approx(0.2, abs=0.02)


@pytest.mark.parametrize("seed", range(4))
def test_clocks_that_agree_are_not_spoken_of(seed: int) -> None:
    found = time_offset(measured(Field.RANGE, seed), RSUS, truth_of(0.0))
    assert found is not None
    assert abs(found.offset_s) < 0.02
    assert not found.matters


def test_a_device_that_stands_tells_no_time() -> None:
    standing = truth_of(0.0)
    standing = replace(standing, position=0.0 * standing.position)
    at_rest = [replace(m, range_m=20.0) for m in measured(Field.RANGE, 3)]
    found = time_offset(at_rest, RSUS, standing)
    assert found is not None
    assert not found.matters


def test_values_that_are_no_numbers_have_no_say() -> None:
    spoilt = [
        replace(m, range_m=math.nan if k % 5 == 0 else m.range_m)
        for k, m in enumerate(measured(Field.RANGE, 1))
    ]
    nobody = [replace(m, range_m=math.nan) for m in spoilt]
    found = time_offset(spoilt, RSUS, truth_of(-0.3))
    assert found is not None
    assert found.offset_s == pytest.approx(0.3, abs=0.02)
    assert time_offset(nobody, RSUS, truth_of(-0.3)) is None


def test_few_measurements_say_nothing() -> None:
    assert time_offset(measured(Field.RANGE, 1)[:150], RSUS, truth_of(0.3)) is None


def test_it_is_said_with_what_to_do(tmp_path: Path) -> None:
    """What the sentence names scores the recording against a truth at its time, and against no
    other one."""
    truth = truth_of(-0.4)
    stamps = truth.stamp_ns.tolist()
    poses = [
        Odometry(
            stamp_ns=stamp_ns,
            vue_id="vue_1",
            position=place,
            quaternion=np.array([0.0, 0.0, 0.0, 1.0]),
            linear_velocity=velocity,
        )
        for stamp_ns, place, velocity in zip(stamps, truth.position, truth.velocity, strict=True)
    ]
    bag, track = tmp_path / "bag", tmp_path / "track"
    ranges = measured(Field.RANGE, 1)
    write_bag(bag, rsus=list(RSUS.values()), measurements=ranges, truth=poses)
    replay_bag(bag, track)

    late, (note,) = evaluated(track)
    said = re.search(r"(--truth \S+ --truth-topic \S+) --truth-time-offset (\S+)", note)
    assert said is not None
    source, offset_s = said[1].split(), float(said[2])
    assert offset_s == pytest.approx(0.4, abs=0.02)
    at_its_time, notes = evaluated(track, *source, "--truth-time-offset", offset_s)
    assert not [text for text in notes if "fit the ground truth" in text]
    assert at_its_time["rmse_m"] < 0.7 * late["rmse_m"]

    _, notes = evaluated(track, *source, "--truth-time-offset", 0.1)
    (more,) = re.findall(r"(\S+) more in --truth-time-offset", " ".join(notes))
    assert float(more) == pytest.approx(0.3, abs=0.02)


def evaluated(bag: Path, *options: object) -> tuple[dict[str, Any], list[str]]:
    """Figures and notes of ``netpos evaluate``, but for those of what is not scored."""
    file = bag.parent / "figures.json"
    arguments = ["evaluate", bag, "--json", file, *options]
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == 0, result.output
    content = json.loads(file.read_text())
    return content["vues"]["vue_1"], [n for n in content["notes"] if "not scored" not in n]
