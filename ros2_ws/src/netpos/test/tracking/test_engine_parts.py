"""The parts of the compiled epoch: what opens, what is noted, what is sound, what is carried."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from engine_cases import opened, start
from netpos.filters import ekf, srukf
from netpos.filters.motion import NO_BIAS, noise
from netpos.tracking import TrackerConfig, engine
from netpos.tracking.models import motions_of, options_of


def test_opening_a_factor_is_opening_its_covariance() -> None:
    config = TrackerConfig(filter="srukf")
    options = options_of(config)
    _, cov = start()
    for sd, unheard_s in ((3.0, 0.0), (5.0, 0.1), (5.0, 30.0), (1e-3, 2.0)):
        L = srukf.factor(cov)
        engine.open_velocity(L, sd, unheard_s, options)
        plain = cov.copy()
        engine.open_velocity(plain, sd, unheard_s, options_of(TrackerConfig()))
        np.testing.assert_allclose(plain, opened(cov, sd, unheard_s), rtol=1e-14)
        np.testing.assert_allclose(L @ L.T, plain, rtol=1e-12, atol=1e-13)
        assert (np.triu(L, 1) == 0.0).all()


@pytest.mark.parametrize("within_s", [0.0, 0.1, 4.0])
def test_a_manoeuvre_at_any_time(within_s: float) -> None:
    """The second moments of a step at a uniform time, for covariance and factor."""
    _, cov = start()
    root = options_of(TrackerConfig(filter="srukf", manoeuvre_speed_sd_mps=3.0))
    plain = options_of(TrackerConfig(manoeuvre_speed_sd_mps=3.0))
    nodes, weights = np.polynomial.legendre.leggauss(3)
    steps = [opened(cov, 3.0, within_s * (x + 1.0) / 2.0) for x in nodes]
    expected = sum(w / 2.0 * step for w, step in zip(weights, steps, strict=True))
    L, P = srukf.factor(cov), cov.copy()
    engine.allow_manoeuvre(P, within_s, plain)
    engine.allow_manoeuvre(L, within_s, root)
    np.testing.assert_allclose(P, expected, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(L @ L.T, expected, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize(("opened_sd", "turn"), [(0.0, 0.0), (5.0, 0.0), (0.0, 3.0), (5.0, 3.0)])
def test_a_smoother_is_told_of_both_steps(opened_sd: float, turn: float) -> None:
    """What ``noise`` adds from the note is what the looks added."""
    motion = motions_of(TrackerConfig())[0]
    without, noted = np.zeros((6, 6)), np.zeros((6, 6))
    noise(np.zeros(6), 0.1, motion, NO_BIAS, without)
    engine.note_jump(motion, opened_sd, 1.3, turn, 0.7)
    noise(np.zeros(6), 0.1, motion, NO_BIAS, noted)
    expected = opened(without, opened_sd, 1.3)
    if turn > 0.0:
        options = options_of(TrackerConfig(manoeuvre_speed_sd_mps=turn))
        engine.allow_manoeuvre(expected, 0.7, options)
    np.testing.assert_allclose(noted, expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize(
    ("change", "sound"),
    [
        ({}, True),
        ({"mean": (0, 0.999e9)}, True),
        ({"mean": (0, -1.001e9)}, False),
        ({"mean": (1, math.nan)}, False),
        ({"mean": (2, 2.99e8)}, True),
        ({"mean": (2, 3.0e8)}, False),
        ({"cov": (0, 1, 0.999999)}, True),
        ({"cov": (0, 1, 1.0)}, False),
        ({"cov": (2, 3, -1.0)}, False),
        ({"cov": (4, 5, 1.0)}, True),
    ],
)
def test_what_can_be_a_device(change: dict[str, Any], sound: bool) -> None:
    """A clock may be known exactly; a position and a velocity may not."""
    mean, cov = np.zeros(6), np.eye(6)
    if "mean" in change:
        at, value = change["mean"]
        mean[at] = value
    if "cov" in change:
        i, j, value = change["cov"]
        cov[i, j] = cov[j, i] = value
    assert engine.is_sound(mean, cov) is sound


def test_what_is_carried_and_the_covariance() -> None:
    _, cov = start()
    root, plain = options_of(TrackerConfig(filter="srukf")), options_of(TrackerConfig())
    L = engine.to_spread(cov, root)
    np.testing.assert_allclose(L, np.linalg.cholesky(cov), rtol=1e-12)
    np.testing.assert_allclose(engine.to_cov(L, root), cov, rtol=1e-12)
    copied = engine.to_spread(cov, plain)
    assert copied is not cov
    np.testing.assert_array_equal(copied, cov)


@pytest.mark.parametrize("name", ["ekf", "iekf", "ukf", "srukf", "kf"])
def test_predict_does_nothing_for_no_time(name: str) -> None:
    config = TrackerConfig(filter=name)
    options, motion = options_of(config), motions_of(config)[0]
    mean, cov = start()
    x, S = mean.copy(), engine.to_spread(cov, options)
    for dt in (0.0, -1.0):
        engine.predict(x, S, dt, motion, NO_BIAS, options)
        np.testing.assert_array_equal(x, mean)
        np.testing.assert_array_equal(S, engine.to_spread(cov, options))
    engine.predict(x, S, 0.5, motion, NO_BIAS, options)
    ekf.predict(mean, cov, 0.5, motion, NO_BIAS)  # linear: all the same
    np.testing.assert_allclose(x, mean, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(engine.to_cov(S, options), cov, rtol=1e-7, atol=1e-9)
