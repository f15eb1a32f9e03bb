"""The share of blocked paths is learned per RSU, and late measurements change nothing about it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from netpos.estimation.measurement import BLOCKED, KIND, Kind
from netpos.estimation.rows import rsu_axes, rsu_rows
from netpos.messages.values import Field, RsuInfo, RsuMeasurement
from netpos.tracking import TrackerConfig
from netpos.tracking.estimators.epoch_rows import EpochRows
from netpos.tracking.rsus.nlos_rate import NlosRate
from scipy.constants import speed_of_light

STANDING = np.array([40.0, 2.0, 0.0, 0.0, 0.0, 0.0])
EXCESS_M = 15.0
NLOS = {
    "nlos_probability": 0.2,
    "nlos_mean_excess_m": EXCESS_M,
    "isolate_rsus": False,
    "accel_density_mps2_sqrthz": 0.1,
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
    nlos_rate, epoch_rows = NlosRate(0.2, 50.0), _epoch_rows()
    alpha, beta, f = 2.0, 8.0, 0.98
    for p in (0.9, 1.0, 0.1):
        nlos_rate.expect(epoch_rows)
        late = epoch_rows.rows[:, KIND] == Kind.RANGE
        assert epoch_rows.rows[late, BLOCKED] == pytest.approx(alpha / (alpha + beta))
        assert epoch_rows.rows[~late, BLOCKED] == 0.0
        epoch_rows.rows[late, BLOCKED] = p
        nlos_rate.learn(epoch_rows)
        alpha = f * alpha + (1 - f) * 2.0 + p
        beta = f * beta + (1 - f) * 8.0 + 1 - p
        assert nlos_rate.share("a") == pytest.approx(alpha / (alpha + beta))
    assert nlos_rate.share("b") == 0.2


def test_a_copy_learns_for_itself() -> None:
    nlos_rate, epoch_rows = NlosRate(0.2, 50.0), _epoch_rows()
    twin = nlos_rate.copy()
    epoch_rows.rows[:, BLOCKED] = 1.0
    twin.learn(epoch_rows)
    assert twin.share("a") > 0.2
    assert nlos_rate.share("a") == 0.2


def test_nothing_is_learned_where_the_option_is_off() -> None:
    nlos_rate, epoch_rows = NlosRate.of(TrackerConfig()), _epoch_rows()
    nlos_rate.expect(epoch_rows)
    assert (epoch_rows.rows[:, BLOCKED] == 0.0).all()
    nlos_rate.learn(epoch_rows)
    assert nlos_rate.share("a") == 0.0


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
    """A memory of one measurement is all but the configured share."""
    square = {1.0: 0.0, 100.0: 0.0}
    for seed in range(8):
        epochs = _measurements(world, seed, 300)
        for memory in square:
            tracker = world.tracker(**NLOS, nlos_memory=memory)
            outputs = [o for items in epochs for o in feed(tracker, items)][50:]
            places = np.array([o.odometry.position[:2] for o in outputs])
            square[memory] += float(np.sum((places - STANDING[:2]) ** 2))
        shares = {name: tracker._tracks["vue_1"]._state.nlos_rate.share(name) for name in RSUS}
        assert shares.pop("b") > 0.6
        assert max(shares.values()) < 0.1
    assert square[100.0] < 0.85 * square[1.0]


def test_late_measurements_end_in_the_same_estimate(world: Any, feed: Any) -> None:
    epochs = _measurements(world, 31, 60)
    in_order, late = world.tracker(**NLOS), world.tracker(**NLOS)
    for k, items in enumerate(epochs):
        feed(in_order, items)
        held = items[1:] if k == 40 else items
        feed(late, held)
        if k == 45:
            feed(late, epochs[40][:1])
    first, second = (t._tracks["vue_1"]._state for t in (in_order, late))
    np.testing.assert_array_equal(first.estimator.estimate.mean, second.estimator.estimate.mean)
    assert [first.nlos_rate.share(n) for n in RSUS] == [second.nlos_rate.share(n) for n in RSUS]
