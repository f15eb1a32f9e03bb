"""The parts of the compiled epoch: what opens, what is noted, what is sound, what is carried."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from engine_cases import opened, start
from netpos.estimation import engine
from netpos.estimation.engine import EpochInput
from netpos.estimation.factor import factor
from netpos.estimation.forms import ekf
from netpos.estimation.level.manoeuvre import add_manoeuvre
from netpos.estimation.measurement import GATE_VARIANCE, VARIANCE
from netpos.estimation.motion import NO_BIAS, noise
from netpos.estimation.rows import linear_rows
from netpos.estimation.state import POSITION
from netpos.estimation.update.fusion import predicted_in
from netpos.estimation.update.predicted import predict_rows, predicted_rows
from netpos.tracking import TrackerConfig
from netpos.tracking.estimators.models import motions_of, options_of
from scipy.stats import chi2

H = np.eye(2, 6)


def test_opening_a_factor_is_opening_its_covariance() -> None:
    config = TrackerConfig(filter="srukf")
    options = options_of(config)
    _, cov = start()
    for sd, unheard_s in ((3.0, 0.0), (5.0, 0.1), (5.0, 30.0), (1e-3, 2.0)):
        L = factor(cov)
        engine.open_velocity(L, sd, unheard_s, options)
        plain = cov.copy()
        engine.open_velocity(plain, sd, unheard_s, options_of(TrackerConfig()))
        np.testing.assert_allclose(plain, opened(cov, sd, unheard_s), rtol=1e-14)
        np.testing.assert_allclose(L @ L.T, plain, rtol=1e-12, atol=1e-13)
        assert (np.triu(L, 1) == 0.0).all()


@pytest.mark.parametrize("within_s", [0.0, 0.1, 4.0])
def test_a_manoeuvre_at_any_time(within_s: float) -> None:
    """The second moments of a step at a uniform time."""
    _, cov = start()
    nodes, weights = np.polynomial.legendre.leggauss(3)
    steps = [opened(cov, 3.0, within_s * (x + 1.0) / 2.0) for x in nodes]
    expected = sum(w / 2.0 * step for w, step in zip(weights, steps, strict=True))
    add_manoeuvre(3.0, within_s, cov)
    np.testing.assert_allclose(cov, expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize(("opened_sd", "turn"), [(0.0, 0.0), (5.0, 0.0), (0.0, 3.0), (5.0, 3.0)])
def test_a_smoother_is_told_of_both_steps(opened_sd: float, turn: float) -> None:
    """What ``noise`` adds from the note is what the looks added."""
    motion = motions_of(TrackerConfig())[0]
    without, noted = np.zeros((6, 6)), np.zeros((6, 6))
    noise(np.zeros(6), 0.1, motion, NO_BIAS, without)
    engine.set_velocity_step_noise(motion, opened_sd, 1.3, turn, 0.7)
    noise(np.zeros(6), 0.1, motion, NO_BIAS, noted)
    expected = opened(without, opened_sd, 1.3)
    if turn > 0.0:
        add_manoeuvre(turn, 0.7, expected)
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
        *(({"block": (p, 4.0, 5.0, 9.0)}, True) for p in (0, 2)),
        *(({"block": (p, 4.0, 6.5, 9.0)}, False) for p in (0, 2)),
        *(({"block": (p, 1e6, 0.0, 1e-8)}, True) for p in (0, 2)),
        *(({"block": (p, 1e6, 0.0, 1e-10)}, False) for p in (0, 2)),
        *(({"block": (p, 1.0, 1.0 - 4e-15, 1.0)}, True) for p in (0, 2)),
        *(({"block": (p, 1.0, 1.0 - 1e-15, 1.0)}, False) for p in (0, 2)),
    ],
)
def test_what_can_be_a_device(change: dict[str, Any], sound: bool) -> None:
    """A clock may be known exactly; a position and a velocity may not, but for rounding: the
    smaller variance along any axis is no more than 1e-15 of both."""
    mean, cov = np.zeros(6), np.eye(6)
    if "mean" in change:
        at, value = change["mean"]
        mean[at] = value
    if "cov" in change:
        i, j, value = change["cov"]
        cov[i, j] = cov[j, i] = value
    if "block" in change:
        p, a, b, c = change["block"]
        cov[p : p + 2, p : p + 2] = [[a, b], [b, c]]
    assert engine.is_sound(mean, cov) is sound


def test_what_is_carried_and_the_covariance() -> None:
    _, cov = start()
    root, plain = options_of(TrackerConfig(filter="srukf")), options_of(TrackerConfig())
    L = engine.to_cov_or_sqrt(cov, root)
    np.testing.assert_allclose(L, np.linalg.cholesky(cov), rtol=1e-12)
    np.testing.assert_allclose(engine.to_cov(L, root), cov, rtol=1e-12)
    copied = engine.to_cov_or_sqrt(cov, plain)
    assert copied is not cov
    np.testing.assert_array_equal(copied, cov)


@pytest.mark.parametrize("name", ["ekf", "iekf", "ukf", "srukf", "kf"])
def test_predict_does_nothing_for_no_time(name: str) -> None:
    config = TrackerConfig(filter=name)
    options, motion = options_of(config), motions_of(config)[0]
    mean, cov = start()
    x, S = mean.copy(), engine.to_cov_or_sqrt(cov, options)
    for dt in (0.0, -1.0):
        engine.predict(x, S, dt, motion, NO_BIAS, options)
        np.testing.assert_array_equal(x, mean)
        np.testing.assert_array_equal(S, engine.to_cov_or_sqrt(cov, options))
    engine.predict(x, S, 0.5, motion, NO_BIAS, options)
    ekf.predict(mean, cov, 0.5, motion, NO_BIAS)  # linear: all the same
    np.testing.assert_allclose(x, mean, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(engine.to_cov(S, options), cov, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("name", ["ekf", "iekf", "ukf", "srukf", "kf"])
def test_every_filter_applies_what_is_linear_alike(name: str) -> None:
    """Two fixes, the second 100 m off: the information form of the first."""
    options, (prior, cov) = options_of(TrackerConfig(filter=name)), start()
    R, fix = np.diag([0.25, 0.16]), prior[POSITION] + np.array([0.8, -0.5])
    rows = np.vstack([linear_rows(fix, R, H, 0), linear_rows(fix + 100.0, R, H, 1)])
    x, S, accepted = prior.copy(), engine.to_cov_or_sqrt(cov, options), np.full(2, 9.0)
    work = ekf.workspace(6, 4)
    predict_rows(x, cov, rows, 0.0, predicted_in(work, 6, 4))
    nis, used = engine.update(x, S, rows, options, accepted, work)
    assert accepted.tolist() == [1.0, 0.0]
    residual, information = fix - prior[POSITION], np.linalg.inv(cov)
    expected = residual @ np.linalg.solve(cov[POSITION, POSITION] + R, residual)
    assert (nis, used) == (pytest.approx(expected, rel=1e-7), 2)
    posterior = np.linalg.inv(information + H.T @ np.linalg.inv(R) @ H)
    expected_mean = prior + posterior @ H.T @ np.linalg.solve(R, residual)
    np.testing.assert_allclose(x, expected_mean, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(engine.to_cov(S, options), posterior, rtol=1e-7, atol=1e-9)


def test_the_linear_filter_has_its_floors() -> None:
    """A fix next to nothing is known better than by: the gains are the floors."""
    floors = {"position_gain_min": 0.5, "velocity_gain_min": 0.25, "accel_gain_min": 0.125}
    options = options_of(TrackerConfig(filter="kf", **floors))
    x, P = np.zeros(8), 1e-6 * np.eye(8)
    rows, work = linear_rows(np.array([2.0, -1.0]), np.eye(2), H, 0), ekf.workspace(8, 2)
    predict_rows(x, P, rows, 0.0, predicted_in(work, 8, 2))
    engine.update(x, P, rows, options, np.zeros(1), work)
    np.testing.assert_allclose(x, [1.0, -0.5, 0.5, -0.25, 0.0, 0.0, 0.25, -0.125], rtol=1e-9)


@pytest.mark.parametrize("name", ["iekf", "srukf"])
@pytest.mark.parametrize(("share", "is_one"), [(0.999, True), (1.001, False)])
def test_a_manoeuvre_is_more_than_the_velocity_allows_for(
    name: str, share: float, is_one: bool
) -> None:
    """A fix of variance 5 in all, the same on either axis: a step of 3 m/s shows after the gate's
    distance over 3 m/s; no time is shorter than the silence. One that no row tells of shows
    never."""
    change = {"manoeuvre_speed_sd_mps": 3.0, "gate_probability": 0.999}
    options = options_of(TrackerConfig(filter=name, **change))
    cov = np.diag([2.0, 2.0, 12.0 * share, 6.0 * share, 1.0, 1.0])
    rows = linear_rows(np.zeros(2), 3.0 * np.eye(2), H, 0)
    shows_s = math.sqrt(chi2.ppf(0.999, 2) * 5.0) / 3.0
    for unheard_s in (0.1, 1.01 * shows_s):
        seen = predicted_rows(np.zeros(6), cov, rows, 0.0)
        within_s = engine.manoeuvre_s(cov, rows, seen, unheard_s, options)
        expected = max(unheard_s, shows_s) if is_one else unheard_s
        assert within_s == pytest.approx(expected, rel=1e-9)
        nothing = predicted_rows(np.zeros(6), cov, rows[:0], 0.0)
        assert engine.manoeuvre_s(cov, rows[:0], nothing, unheard_s, options) == unheard_s


@pytest.mark.parametrize("name", ["iekf", "srukf"])
def test_rows_are_weighed_by_what_is_carried(name: str) -> None:
    """Huber's factor of a fix 9 m and 7 m off, under the covariance of either filter."""
    options = options_of(TrackerConfig(filter=name, robust="huber", robust_parameter=1.5))
    (mean, cov), R, off = start(), np.diag([0.25, 0.16]), np.array([9.0, -7.0])
    rows = linear_rows(mean[POSITION] + off, R, H, 0)
    S, memory = engine.to_cov_or_sqrt(cov, options), engine.scratch(6, 2)
    epoch, motion = EpochInput(0.0, 0.0, 0.0, 0, rows), motions_of(TrackerConfig())[0]
    engine.predict_epoch(mean.copy(), S, epoch, motion, NO_BIAS, options, memory)
    engine.update_epoch(mean.copy(), S, epoch, motion, options, memory)
    factor = math.sqrt(off @ np.linalg.solve(cov[POSITION, POSITION] + R, off) / 2.0) / 1.5
    assert factor > 2.0
    np.testing.assert_allclose(rows[:, [VARIANCE, GATE_VARIANCE]], factor, rtol=1e-9)
