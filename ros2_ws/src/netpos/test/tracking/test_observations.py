"""What the health of the RSUs is told of an epoch, row by row and in any portions."""

from __future__ import annotations

import numpy as np
import pytest
from netpos.estimation.measurement import GROUP, KIND, ROW_WIDTH, Kind
from netpos.messages.values import GroundSpeed, RsuMeasurement
from netpos.tracking.health import RsuHealth
from netpos.tracking.observations import FittedEpoch

S = 1_000_000_000


def measured(rsu_id: str, stamp_ns: int) -> RsuMeasurement:
    return RsuMeasurement(stamp_ns=stamp_ns, rsu_id=rsu_id, vue_id="v")


def epoch_of(stamp_ns: int, rng: np.random.Generator) -> FittedEpoch:
    """RSU a: azimuth and time, and a position fix; a speed; RSU b: a range."""
    kinds = [Kind.AZIMUTH, Kind.TOA, Kind.LINEAR, Kind.LINEAR, Kind.SPEED, Kind.RANGE]
    rows = np.zeros((6, ROW_WIDTH))
    rows[:, KIND], rows[:, GROUP] = kinds, [0, 0, 0, 0, 1, 2]
    fits = np.column_stack([rng.normal(size=6), rng.uniform(0.5, 2.0, size=6)])
    speed = GroundSpeed(stamp_ns=stamp_ns, vue_id="v", speed_mps=1.0, speed_var=1.0)
    items = (measured("a", stamp_ns), speed, measured("b", stamp_ns))
    return FittedEpoch(stamp_ns, "v", items, rows, fits, [1.0, 1.0, float(rng.random() < 0.5)])


def test_rows_find_their_measurement() -> None:
    epoch = epoch_of(7 * S, np.random.default_rng(1))
    (a, first), (b, second) = epoch.observations()
    assert (a, b) == ("a", "b")
    assert first == (7 * S, "v", True, ("AZIMUTH", "TOA"), tuple(epoch.innovations[:2].ravel()))
    taken = bool(epoch.accepted[2])
    assert second == (7 * S, "v", taken, ("RANGE",), tuple(epoch.innovations[5]))


@pytest.mark.parametrize("asked_every", [1, 7, 1000])
def test_health_does_not_depend_on_when_it_is_asked(asked_every: int) -> None:
    """Epochs are taken in portions; one by one through ``observe`` is the same, also where a track
    goes back."""
    rng = np.random.default_rng(2)
    epochs = [epoch_of(S + k * S // 10, rng) for k in range(150)]
    epochs[100:100] = epochs[95:100]  # gone back to, and heard again
    heard, observed = RsuHealth(), RsuHealth()
    for k, epoch in enumerate(epochs):
        if k == 100:
            heard.rewind("v", epoch.stamp_ns)
            observed.rewind("v", epoch.stamp_ns)
        heard.hear(epoch)
        for rsu_id, seen in epoch.observations():
            pairs = zip(seen.values[::2], seen.values[1::2], strict=True)
            told = dict(zip(seen.kinds, pairs, strict=True))
            observed.observe(rsu_id, "v", epoch.stamp_ns, seen.accepted, told)
        if k % asked_every == 0:
            assert heard.reports(epoch.stamp_ns) == observed.reports(epoch.stamp_ns)
    now_ns = epochs[-1].stamp_ns
    assert heard.reports(now_ns) == observed.reports(now_ns)
    assert heard.report("b", now_ns) == observed.report("b", now_ns)
    assert heard.report("b", now_ns).measurements > 100


def test_all_are_trusted_until_one_is_isolated() -> None:
    health = RsuHealth()
    for k in range(80):
        stamp_ns = S + k * S // 10
        assert health.trusts_all(stamp_ns) is not health.excluded("b", stamp_ns)
        for rsu_id in "abc":
            error = 30.0 if rsu_id == "b" else 0.5
            health.observe(rsu_id, "v", stamp_ns, rsu_id != "b", {"range": (error, 1.0)})
    assert health.excluded("b", 10 * S)
    assert not health.trusts_all(10 * S)
