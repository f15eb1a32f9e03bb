"""The whole chain: what the tracker hears comes after it has happened, and the rows judge it."""

from __future__ import annotations

import numpy as np
import pytest
from netpos.evaluation.work import Work
from netpos.messages.values import Velocity
from netpos.radio.anchor import uwb_wavelength_m
from netpos.reproduction.frame import Row
from netpos.reproduction.petukhov import chain_rows
from netpos.reproduction.petukhov.chain_rows import FILTER, LOOSE, SCHEME, TIGHT, VARIANTS
from netpos.reproduction.petukhov.rectangle import STEPS
from netpos.reproduction.petukhov.waist_chain import Walk, follow, simulate
from netpos.scenario import Simulation
from netpos.tracking.config import TrackerConfig

SEED = 7200
WALKING_MPS = 0.3


@pytest.fixture(scope="module")
def walk() -> Walk:
    return simulate(SEED, chain_rows.LONG)


def test_a_step_is_heard_of_after_it(walk: Walk) -> None:
    """Who walks off is heard to walk a step time later at the earliest."""
    assert walk.detected_steps == STEPS
    speed = np.hypot(*np.diff(walk.truth, axis=0).T) / np.diff(walk.times_s)
    moved_s = walk.times_s[np.argmax(speed > WALKING_MPS)]
    stamps = [
        value.stamp_ns
        for value in walk.heard
        if isinstance(value, Velocity) and np.hypot(*value.velocity) > WALKING_MPS
    ]
    reported_s = (min(stamps) - walk.stamps_ns[0]) * 1e-9
    assert reported_s > moved_s + 0.6


def test_the_baseline_is_the_only_difference() -> None:
    (long,), (short,) = (
        Simulation(simulate(SEED, wavelengths).scenario).rsus
        for wavelengths in (chain_rows.LONG, chain_rows.SHORT)
    )
    assert long.baseline_m == pytest.approx(4.0 * uwb_wavelength_m(5))
    assert short.baseline_m == pytest.approx(0.5 * uwb_wavelength_m(5))


@pytest.mark.parametrize("variant", [LOOSE, TIGHT])
def test_a_walk_is_followed(walk: Walk, variant: chain_rows.Variant) -> None:
    scores = follow(walk, variant)
    scored = np.isfinite(scores.error2)
    assert 0.7 < scored.mean() < 1.0  # not before the sector is decided
    assert scored[np.argmax(scored) :].all()
    assert np.sqrt(scores.error2[scored].mean()) < 0.06
    assert scores.error2[scored].max() < 0.2**2


def test_defaults_keep_facts_only(walk: Walk) -> None:
    configs = {variant.name: variant.config(walk.scenario) for variant in VARIANTS}
    assert configs["loose, defaults"] == TrackerConfig(device_height_m=1.0)
    assert configs["tight, defaults"] == TrackerConfig(
        device_height_m=1.0, motion_model="inertial"
    )
    paper, known = configs[SCHEME.name], configs[FILTER.name]
    assert (paper.ambiguity, known.ambiguity) == ("step_heading", "hypotheses")
    assert paper.gate_probability == 1.0


@pytest.fixture(scope="module")
def rows() -> dict[str, Row]:
    with Work(3, SEED, 1) as work:
        listed = list(chain_rows.rows(work))
    named = {row.name: row for row in listed}
    assert len(named) == len(listed)
    return named


def test_the_headline_is_judged_as_the_paper_is(rows: dict[str, Row]) -> None:
    first = list(rows.values())[:3]
    assert [row.paper for row in first] == [0.03, 0.12, 2.0]
    for name in ("tight", "loose"):
        label = f"whole chain from the IMU, {name}"
        simulated = rows[f"{label}, L = 4 lambda: RMSE (paper: simulated)"]
        live = rows[f"{label}, L = 4 lambda: RMSE (paper: live)"]
        assert simulated.ours == live.ours
        assert simulated.ours is not None
        assert simulated.ok is (simulated.ours <= 0.03)
        assert live.ok is True
        gain = rows[f"{label}: RMSE of lambda/2 over that of 4 lambda, at the same instants"]
        assert gain.ok is True


def test_every_figure_has_its_columns(rows: dict[str, Row]) -> None:
    compared = [
        row for row in rows.values() if ", L = " in row.name and FILTER.name not in row.name
    ]
    assert all(None not in (row.baseline, row.defaults, row.ours) for row in compared)
    lost = [row for row in compared if "runs lost" in row.name]
    assert len(lost) == 4
    assert all(row.ok is (row.ours == 0) for row in lost)
