"""Speed as ratios measured side by side in one process, so that the machine cancels out."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from netpos.bags import BagReader
from netpos.filters import ekf
from netpos.filters.measurement import VALUE, VARIANCE, linearise, rsu_axes, rsu_rows
from netpos.filters.motion import process_noise, transition
from netpos.messages.values import Array, Field, RsuInfo, RsuMeasurement
from netpos.tracking.replay import replay_bag

_ROUNDS = 7
_DT_S = 0.1
_NO_BIAS = np.zeros(0)
_NO_GATE = np.array([np.inf])


@dataclass(frozen=True, slots=True)
class BenchRow:
    """One ratio; ``ours_s`` and ``reference_s`` are seconds per operation."""

    name: str
    ours_s: float
    reference: str
    reference_s: float
    ratio: float


def _seconds(operation: Callable[[], object], repeats: int) -> float:
    """Best of several rounds, per operation: what the code costs when nothing interferes."""
    operation()
    best = math.inf
    for _ in range(_ROUNDS):
        start = time.perf_counter()
        for _ in range(repeats):
            operation()
        best = min(best, (time.perf_counter() - start) / repeats)
    return best


def _problem() -> tuple[Array, Array, Array]:
    """State, covariance and rows of two RSUs that measure DOA and TOA (fokin2020 Fig. 5)."""
    x = np.array([20.0, 5.0, 42.0, 0.0, 100.0, 10.0])
    cov = np.diag([4.0, 4.0, 1.0, 1.0, 100.0, 25.0])
    blocks = []
    for group, east in enumerate((0.0, 60.0)):
        info = RsuInfo(rsu_id=str(group), position=np.array([east, 15.0, 0.0]))
        dx, dy = x[:2] - info.position[:2]
        measurement = RsuMeasurement(
            stamp_ns=1,
            rsu_id=info.rsu_id,
            vue_id="vue_1",
            fields=Field.AZIMUTH | Field.TOA,
            azimuth_rad=math.atan2(dy, dx),
            azimuth_var=math.radians(2.0) ** 2,
            toa_s=4e-7,
            toa_var=(50e-9) ** 2,
        )
        blocks.append(rsu_rows(measurement, info, rsu_axes(info), group))
    return x, cov, np.vstack(blocks)


def _model() -> tuple[Array, Array]:
    F = transition(6, _DT_S, _NO_BIAS)
    return F, process_noise(0, _DT_S, 1.0, 0.1, 0.1, 1.0, 1.0, _NO_BIAS, _NO_BIAS)


def ekf_against_filterpy() -> BenchRow:
    """Prediction and update of 6 states with two RSUs, both called from Python."""
    x, cov, rows = _problem()
    F, Q = _model()

    def ours() -> object:
        mean, prior = ekf.predict(x, cov, F, Q)
        return ekf.update(mean, prior, rows, 0.0, _NO_GATE, 1)

    reference = ExtendedKalmanFilter(6, 4)
    R, z = np.diag(rows[:, VARIANCE]), rows[:, VALUE][:, None]

    def h(state: Array) -> Array:
        return np.asarray(z[:, 0] - linearise(rows, state[:, 0], 0.0)[0])[:, None]

    def jacobian(state: Array) -> Array:
        return np.asarray(linearise(rows, state[:, 0], 0.0)[1])

    def filterpy() -> object:
        reference.x, reference.P, reference.F, reference.Q = x[:, None], cov, F, Q
        reference.predict()
        return reference.update(z, jacobian, h, R)

    ours_s, reference_s = _seconds(ours, 2000), _seconds(filterpy, 500)
    name = "EKF predict + update, 6 states, 2 RSUs, from Python"
    return BenchRow(name, ours_s, "FilterPy 2.0 EKF", reference_s, reference_s / ours_s)


def replay_against_real_time() -> BenchRow:
    """Offline re-estimation of a METIS run against the time it lasted."""
    from netpos.scenario import load_scenario  # noqa: PLC0415 - only this row simulates
    from netpos.scenario.offline import simulate_to_bag  # noqa: PLC0415

    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "in"
        simulate_to_bag(load_scenario("metis_madrid"), source)
        with BagReader(source) as bag:
            lasted_s = (bag.end_ns - bag.start_ns) * 1e-9
        start = time.perf_counter()
        replay_bag(source, Path(folder) / "out")
        took_s = time.perf_counter() - start
    name = "offline replay of a METIS bag, read, track, write"
    return BenchRow(name, took_s, "real time", lasted_s, lasted_s / took_s)


def bench() -> list[BenchRow]:
    """All rows."""
    return [ekf_against_filterpy(), replay_against_real_time()]


def as_json(rows: list[BenchRow]) -> dict[str, Any]:
    """Rows as plain values."""
    return {"rows": [asdict(row) for row in rows]}
