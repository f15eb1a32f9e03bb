"""Shares of blocked paths and of outliers are learned per RSU; late measurements change nothing
about them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from netpos.estimation.measurement import BLOCKED, KIND, OUTLIER_SHARE, Kind
from netpos.estimation.mixture.outliers import OUTLIERS
from netpos.estimation.rows import rsu_axes, rsu_rows
from netpos.messages.values import Field, RsuInfo, RsuMeasurement
from netpos.tracking import TrackerConfig
from netpos.tracking.estimators.epoch_rows import EpochRows
from netpos.tracking.rsus.shares import Shares
from scipy.constants import speed_of_light

STANDING = np.array([40.0, 2.0, 0.0, 0.0, 0.0, 0.0])
EXCESS_M = 15.0
BLOCKED_PATHS = TrackerConfig(nlos_probability=0.2, nlos_memory=50.0)
LEARNED = TrackerConfig(learn_errors=True)
NLOS = {
    "nlos_probability": 0.2,
    "nlos_mean_excess_m": EXCESS_M,
    "isolate_rsus": False,
    "accel_density_mps2_sqrthz": 0.1,
    "clock_walk_density": 5e-7,
}


def _epoch_rows() -> EpochRows:
    info = RsuInfo(rsu_id="a", position=np.zeros(3))
    m = RsuMeasurement(
        stamp_ns=1,
        rsu_id="a",
        vue_id="v",
        fields=Field.AZIMUTH | Field.RANGE,
        azimuth_var=1e-4,
        range_m=5.0,
        range_var=0.01,
    )
    return EpochRows(rsu_rows(m, info, rsu_axes(info), 0), (m,))


def test_share_is_the_mean_of_the_beta_distribution() -> None:
    """Three measurements written out: alpha' = f alpha + (1 - f) alpha0 + p, and the same of
    beta."""
    shares, epoch_rows = Shares.unknown(BLOCKED_PATHS), _epoch_rows()
    alpha, beta, f = 2.0, 8.0, 0.98
    for p in (0.9, 1.0, 0.1):
        shares.expect(epoch_rows)
        late = epoch_rows.rows[:, KIND] == Kind.RANGE
        assert epoch_rows.rows[late, BLOCKED] == pytest.approx(alpha / (alpha + beta))
        assert epoch_rows.rows[~late, BLOCKED] == 0.0
        assert (epoch_rows.rows[:, OUTLIER_SHARE] == 0.0).all()
        epoch_rows.rows[late, BLOCKED] = p
        shares.learn(epoch_rows, [0.0])
        alpha = f * alpha + (1 - f) * 2.0 + p
        beta = f * beta + (1 - f) * 8.0 + 1 - p
        assert shares.blocked.mean("a") == pytest.approx(alpha / (alpha + beta))
    assert shares.blocked.mean("b") == 0.2


def test_what_may_be_an_outlier_counts_with_its_probability() -> None:
    """A measurement of two values counts once: a share of 1 in 100, worth 100 measurements, of
    which two were outliers, one was none and one may be; all its rows then say so."""
    shares, epoch_rows = Shares.unknown(LEARNED), _epoch_rows()
    shares.expect(epoch_rows)
    assert epoch_rows.rows[:, OUTLIER_SHARE] == pytest.approx(OUTLIERS)
    alpha, beta, f = 1.0, 99.0, 1.0 - 1.0 / 300.0
    for outlier in (1.0, 1.0, 0.0, 0.3):
        shares.learn(epoch_rows, [outlier])
        alpha = f * alpha + (1 - f) * 1.0 + outlier
        beta = f * beta + (1 - f) * 99.0 + 1.0 - outlier
    shares.expect(epoch_rows)
    assert epoch_rows.rows[:, OUTLIER_SHARE] == pytest.approx(alpha / (alpha + beta))
    assert (epoch_rows.rows[:, BLOCKED] == 0.0).all()
    assert shares.outliers.mean("b") == pytest.approx(OUTLIERS)


@pytest.mark.parametrize("config", [BLOCKED_PATHS, LEARNED])
def test_a_copy_learns_for_itself(config: TrackerConfig) -> None:
    shares, epoch_rows = Shares.unknown(config), _epoch_rows()
    before, twin = (shares.blocked.mean("a"), shares.outliers.mean("a")), shares.copy()
    epoch_rows.rows[:, BLOCKED] = 1.0
    twin.learn(epoch_rows, [1.0])
    assert (twin.blocked.mean("a"), twin.outliers.mean("a")) > before
    assert (shares.blocked.mean("a"), shares.outliers.mean("a")) == before


def test_nothing_is_learned_where_the_options_are_off() -> None:
    shares, epoch_rows = Shares.unknown(TrackerConfig()), _epoch_rows()
    shares.expect(epoch_rows)
    assert (epoch_rows.rows[:, [BLOCKED, OUTLIER_SHARE]] == 0.0).all()
    shares.learn(epoch_rows, [1.0])
    assert shares.blocked.mean("a") == shares.outliers.mean("a") == 0.0


RSUS = {
    name: RsuInfo(rsu_id=name, position=np.array([x, y, 0.0]))
    for name, x, y in (("a", 0, 10), ("b", 40, -30), ("c", 80, 10), ("d", 40, 40))
}


def _measurements(world: Any, seed: int, epochs: int) -> list[list[RsuMeasurement]]:
    """RSU b is blocked nine times out of ten, the others never."""
    world.rsus, world.rng = RSUS, np.random.default_rng(seed)
    out = []
    for k in range(epochs):
        items = world.measure(0.1 * k, STANDING)
        if world.rng.random() < 0.9:
            delay_s = EXCESS_M * world.rng.exponential() / speed_of_light
            items[1] = replace(items[1], toa_s=items[1].toa_s + delay_s)
        out.append(items)
    return out


def test_learning_beats_the_configured_share(world: Any, feed: Any) -> None:
    """A memory of one measurement is all but the configured share. The clock may be anything: one
    that is known shows late times by itself."""
    square = {1.0: 0.0, 100.0: 0.0}
    for seed in range(8):
        epochs = _measurements(world, seed, 300)
        for memory in square:
            tracker = world.tracker(**NLOS, nlos_memory=memory)
            outputs = [o for items in epochs for o in feed(tracker, items)][50:]
            places = np.array([o.odometry.position[:2] for o in outputs])
            square[memory] += float(np.sum((places - STANDING[:2]) ** 2))
        shares = {name: tracker._tracks["vue_1"]._state.shares.blocked.mean(name) for name in RSUS}
        assert shares.pop("b") > 0.6
        assert max(shares.values()) < 0.1
    assert square[100.0] < 0.85 * square[1.0]


def test_late_measurements_end_in_the_same_estimate(world: Any, feed: Any) -> None:
    """To the last bit, ten epochs after one that came late: what was blocked or refused in between
    counts once. The last time of c is early, too, and weighed by the share of its outliers."""
    epochs, config = _measurements(world, 31, 56), {**NLOS, "learn_errors": True}
    in_order, late = world.tracker(**config), world.tracker(**config)
    for k, items in enumerate(epochs):
        if k in (35, 38, 42, 44, 55):
            items[2] = replace(items[2], toa_s=items[2].toa_s - 40.0 / speed_of_light)
        first = feed(in_order, items)
        second = feed(late, items[1:] if k == 40 else items)
        if k == 45:
            second = feed(late, epochs[40][:1])
    for one, other in zip(first, second, strict=True):
        assert one.status == other.status
        np.testing.assert_array_equal(one.odometry.position, other.odometry.position)
        np.testing.assert_array_equal(one.odometry.pose_cov, other.odometry.pose_cov)
