"""ITU curves against values worked out by hand; the consistent field; path loss."""

from __future__ import annotations

import math

import numpy as np
import pytest
from netpos.radio.noise import stream_key
from netpos.radio.propagation import PathLoss, los_probability, path_loss_db, smooth_uniform
from scipy import stats


@pytest.mark.parametrize(
    ("model", "distance", "expected"),
    [
        ("uma", 18.0, 1.0),
        ("uma", 30.0, 0.6 + 0.4 * 0.62114),  # exp(-30/63) = 0.62114
        ("uma", 100.0, 0.18 + 0.82 * 0.20446),
        ("umi", 18.0, 1.0),
        ("umi", 30.0, 0.6 + 0.4 * 0.43460),
        ("umi", 100.0, 0.18 + 0.82 * 0.062177),
        ("rma", 10.0, 1.0),
        ("rma", 30.0, 0.98020),
        ("rma", 1010.0, 0.36788),
        ("inh", 5.0, 1.0),
        ("inh", 30.0, 0.70251),
        ("inh", 49.0, 0.53715),
        ("inh", 100.0, 0.54 * 0.78591),
    ],
)
def test_curves_by_hand(model: str, distance: float, expected: float) -> None:
    assert los_probability(model, distance)[0] == pytest.approx(expected, abs=2e-5)  # type: ignore[arg-type]


def test_only_umi_is_below_80_percent_at_30_m_outdoors() -> None:
    """The text of fokin2020 section 3.2 says none is."""
    at_30 = {m: los_probability(m, 30.0)[0] for m in ("uma", "umi", "rma")}  # type: ignore[arg-type]
    assert at_30["umi"] < 0.8 < min(at_30["uma"], at_30["rma"])


def test_curves_are_probabilities_and_never_rise() -> None:
    d = np.linspace(0, 3000, 6001)
    for model in ("uma", "umi", "rma", "inh"):
        p = los_probability(model, d)  # type: ignore[arg-type]
        assert ((p > 0) & (p <= 1)).all()
        steps = np.diff(p)
        assert (steps <= 3e-3).all()  # InH jumps up by 0.003 at 49 m in the recommendation itself


def test_uma_height_term() -> None:
    assert los_probability("uma", 100.0, 13.0)[0] == los_probability("uma", 100.0, 1.5)[0]
    near = 0.18 + 0.82 * math.exp(-100 / 63)
    raised = near * (1 + 1.25 * math.exp(-100 / 150))  # C' = 1 at 23 m
    assert los_probability("uma", 100.0, 23.0)[0] == pytest.approx(raised)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(("xyz", 1.0), "one of uma"), (("umi", -1.0), ">= 0"), (("umi", 1.0, 24.0), "height")],
)
def test_bad_arguments(arguments: tuple[object, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        los_probability(*arguments)  # type: ignore[arg-type]


def test_field_is_uniform_smooth_and_keyed() -> None:
    """Uniform over keys at any place in a cell; close places have close values; far ones are
    independent."""
    keys = [stream_key(4, f"rsu_{i}") for i in range(3000)]
    for point in ((0.0, 0.0), (-13.0, 20.0), (124.9, -75.1)):
        drawn = [smooth_uniform(*point, 50.0, k) for k in keys]
        assert stats.kstest(drawn, "uniform").pvalue > 1e-3
    here = np.array([smooth_uniform(10.0, 10.0, 50.0, k) for k in keys])
    near = np.array([smooth_uniform(10.5, 10.0, 50.0, k) for k in keys])
    far = np.array([smooth_uniform(160.0, 10.0, 50.0, k) for k in keys])
    assert np.abs(near - here).max() < 0.05
    assert abs(np.corrcoef(here, far)[0, 1]) < 5 / math.sqrt(len(keys))


def test_path_loss_by_hand() -> None:
    free = PathLoss(model="free_space").coefficients(3.5e9)
    assert path_loss_db(100.0, free) == pytest.approx(
        20 * math.log10(4 * math.pi * 100 * 3.5e9 / 299792458)
    )
    umi = PathLoss().coefficients(3.5e9)
    assert umi[2] == pytest.approx(4 * 9 * 0.5 * 3.5e9 / 299792458)  # break point, 210 m
    assert path_loss_db(50.0, umi) == pytest.approx(
        32.4 + 21 * math.log10(50) + 20 * math.log10(3.5)
    )
    below, above = path_loss_db(umi[2] * (1 - 1e-9), umi), path_loss_db(umi[2] * (1 + 1e-9), umi)
    assert below == pytest.approx(above, abs=0.05)  # the formula's own step at the break point
    assert path_loss_db(0.1, umi) == path_loss_db(1.0, umi)
