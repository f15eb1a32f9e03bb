"""Malformed and extreme measurements through the tracker: nothing raises, no NaN leaves, every
reported covariance is positive definite.

``NETPOS_FUZZ=1000000`` sets how many measurements the test takes; ``python test_fuzz.py`` takes a
million unless that is set.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from netpos.estimation.measurement import GATE_VARIANCE, VARIANCE
from netpos.estimation.motion import SPEED_OF_LIGHT_MPS
from netpos.estimation.rows import RowErrors, rsu_axes, rsu_rows
from netpos.estimation.update import conditioning
from netpos.estimation.update.predicted import predicted_rows
from netpos.messages.values import (
    AngleConvention,
    Array,
    Field,
    GroundSpeed,
    ImuSample,
    InitialPose,
    RsuInfo,
    RsuMeasurement,
    Velocity,
)
from netpos.tracking import Tracker, TrackerConfig, TrackOutput

T0 = 1_000_000_000
RSU_IDS = ("a", "b", "c", "here", "twin", "nobody")
VUE = "vue_1"
BATCH = 400  # measurements per tracker

# What a sensor never says on purpose, in any unit.
ODD = (0.0, -0.0, 5e-324, 1e-300, 1e300, -1e300, math.nan, math.inf, -math.inf, 1e9, -999999999.0)
ODD_VARIANCES = (0.0, -1.0, 5e-324, 1e-300, 1e-12, 1.1e-12, 1e-9, 1e6, 9e11, 1e12, 1e300, math.nan)
REFERENCES = ("a", "a", "a", "b", "", "nobody")
STAMPS = (0, -1, 1, T0, T0 - 1, 2**62, 2**63 - 1, 10**18)

CONFIGS: dict[str, dict[str, Any]] = {
    "iekf": {},
    "ekf": {"filter": "ekf", "manoeuvre_speed_sd_mps": 5.0, "gate_probability": 0.99},
    "ukf": {"filter": "ukf", "robust": "huber"},
    "srukf": {"filter": "srukf", "manoeuvre_speed_sd_mps": 3.0},
    "kf": {"filter": "kf", "position_gain_min": 0.0926, "velocity_gain_min": 0.008},
    "no gate": {"gate_probability": 1.0, "initial_position_sd_max_m": 1e4},
    "srukf, no gate": {"filter": "srukf", "gate_probability": 1.0},
    "ukf, no gate": {"filter": "ukf", "gate_probability": 1.0},
    "turn": {"motion_model": "constant_turn", "filter": "ukf"},
    "acceleration": {"motion_model": "constant_acceleration", "process_noise": "werner"},
    "interacting": {"motion_model": "interacting", "filter": "ekf"},
    "inertial": {"motion_model": "inertial"},
    "robust": {"robust": "student_t", "nlos_probability": 0.2, "isolate_rsus": False},
    "paper's rule": {"filter": "srukf", "ambiguity": "step_heading", "isolate_rsus": False},
    "driven sectors": {"motion_model": "inertial", "filter": "srukf", "nlos_probability": 0.1},
    "nlos": {"filter": "srukf", "nlos_probability": 0.2, "motion_model": "constant_turn"},
    "no history": {"history_s": 0.0, "hold_s": 0.0, "filter": "ekf", "max_rejected_epochs": 2},
    "long history": {"history_s": 5.0, "hold_s": 1.0, "max_future_s": 1e9, "max_gap_s": 1e4},
    "exact clock": {
        "clock_offset_sd_s": 0.0,
        "clock_drift_sd": 0.0,
        "clock_white_density": 0.0,
        "clock_walk_density": 1e-30,
        "require_initial_pose": True,
    },
}


def stations(rng: np.random.Generator) -> list[RsuInfo]:
    """RSUs with every kind of error; two at the same place, one where the device is."""
    biases = {
        "azimuth_bias_sd_rad": 0.05,
        "range_bias_sd_m": 0.5,
        "bias_correlation_time_s": float(rng.choice([1e-6, 10.0, 1e9])),
        "common_range_bias_sd_m": 0.2,
        "common_bias_correlation_time_s": 5.0,
        "noise_correlation_time_s": 0.3,
    }
    return [
        RsuInfo(rsu_id="a", position=np.array([0.0, 5.0, 3.0]), baseline_m=0.2, wavelength_m=0.05),
        RsuInfo(rsu_id="b", position=np.array([60.0, -5.0, 0.0]), **biases),
        RsuInfo(
            rsu_id="c",
            position=np.array([120.0, 5.0, 3.0]),
            angle_convention=AngleConvention.CONE,
            quaternion=np.array([0.0, 0.0, 1.0, 0.0]),
        ),
        RsuInfo(rsu_id="here", position=np.array([30.0, 0.0, 0.0])),
        RsuInfo(rsu_id="twin", position=np.array([0.0, 5.0, 3.0]), network="n", **biases),
    ]


@dataclass
class Generator:
    """Draws measurements of a device that stands or drives by, most of them spoilt somewhere."""

    rng: np.random.Generator
    now_ns: int = T0
    infos: dict[str, RsuInfo] = field(default_factory=dict)

    def one_of(self, values: Any) -> Any:
        return values[int(self.rng.integers(len(values)))]

    def spoilt(self, value: float, share: float) -> float:
        """``value``, or something odd in its place."""
        u = self.rng.random()
        if u > share:
            return value
        if u < share / 2.0:
            return float(self.one_of(ODD))
        return float(value * 10.0 ** self.rng.uniform(-12, 12) * self.one_of((-1.0, 1.0)))

    def difference(self, offset: Array, origin: Array) -> float:
        """Time difference [s] from the first RSU of a device at ``offset`` from ``origin``."""
        first = next(iter(self.infos.values())).position if self.infos else np.zeros(3)
        other = np.linalg.norm(offset + origin - first)
        return float(np.linalg.norm(offset) - other) / SPEED_OF_LIGHT_MPS

    def variance(self, value: float, share: float) -> float:
        u = self.rng.random()
        if u > share:
            return value
        if u < share / 2.0:
            return float(self.one_of(ODD_VARIANCES))
        return float(value * 10.0 ** self.rng.uniform(-13, 13))

    def cov(self, share: float, n: int) -> Array:
        """(n, n): sound, nearly singular, asymmetric or not definite."""
        out = np.eye(n)
        a, b = 10.0 ** self.rng.uniform(-3, 3), 10.0 ** self.rng.uniform(-3, 3)
        r = self.rng.uniform(-1, 1)
        if self.rng.random() < share:
            a, b = self.variance(a, 0.5), self.variance(b, 0.5)
            r = float(self.one_of((1.0, -1.0, 1.0 - 1e-13, 1.0 - 1e-11, 1.0 - 1e-6, 1.1, 0.0)))
        with np.errstate(all="ignore"):
            out[:2, :2] = [[a, r * math.sqrt(abs(a)) * math.sqrt(abs(b))], [0.0, b]]
        out[1, 0] = out[0, 1] * (self.one_of((1.0, 1.0 + 1e-7, 2.0)) if share > 0.1 else 1.0)
        return out

    def stamp(self, share: float) -> int:
        u = self.rng.random()
        if u < share / 8.0:
            return int(self.one_of(STAMPS))
        if u < share:
            return self.now_ns - int(self.rng.integers(-(10**8), 3 * 10**9))
        if u < 0.6:
            self.now_ns += int(self.one_of((0, 1, 10**6, 10**8, 10**8, 10**9)))
            if u < share + 0.003:
                self.now_ns += int(self.one_of((20, 50, 100))) * 10**9
        return self.now_ns

    def item(self) -> Any:
        share = float(self.one_of((0.0, 0.05, 0.3)))
        stamp = self.stamp(share)
        kind = self.rng.random()
        if kind < 0.8:
            return self.measurement(stamp, share)
        x, y = self.spoilt(30.0, share), self.spoilt(0.0, share)
        if kind < 0.86:
            return GroundSpeed(
                stamp_ns=stamp,
                vue_id=VUE,
                speed_mps=self.spoilt(3.0, share),
                speed_var=self.variance(0.1, share),
            )
        if kind < 0.92:
            velocity = np.array([x / 10.0, y])
            return Velocity(stamp_ns=stamp, vue_id=VUE, velocity=velocity, cov=self.cov(share, 2))
        if kind < 0.93:
            position = np.array([x, y, 0.0])
            return InitialPose(
                stamp_ns=stamp, vue_id=VUE, position=position, cov=self.cov(share, 3)
            )
        return ImuSample(
            stamp_ns=stamp,
            vue_id=VUE,
            angular_velocity=np.array([0.0, 0.0, self.spoilt(0.3, share)]),
            specific_force=np.array([self.spoilt(0.1, share), 0.0, 9.8]),
        )

    def measurement(self, stamp: int, share: float) -> RsuMeasurement:
        rsu_id = str(self.one_of(RSU_IDS if self.rng.random() < 0.2 else RSU_IDS[:3]))
        x, y = 30.0 + 3.0 * (self.now_ns - T0) * 1e-9 % 60.0, 0.0
        origin = self.infos[rsu_id].position if rsu_id in self.infos else np.zeros(3)
        d = np.array([x, y, 0.0]) - origin
        r = float(np.linalg.norm(d))
        usual = (1, 4, 5, 5, 5, 8, 9, 12, 13, 15, 24, 24, 32, 32, 37, 47, 64, 65)
        fields = int(self.one_of(usual))
        if self.rng.random() < share:
            fields = int(self.rng.integers(0, 256)) * int(self.rng.random() > 0.1)
        noise = self.rng.normal(size=5)
        phase = -8.0 * math.pi * d[1] / max(r, 1e-3) + 0.1 * noise[3]
        return RsuMeasurement(
            stamp_ns=stamp,
            rsu_id=rsu_id,
            vue_id=VUE,
            expected=int(self.one_of((0, 0, 1, 2, 3, -1, 2**31))),
            fields=Field(fields),
            reference_rsu_id=str(self.one_of(REFERENCES)),
            tdoa_s=self.spoilt(self.difference(d, origin), share),
            tdoa_var=self.variance(1e-18, share),
            azimuth_rad=self.spoilt(math.atan2(d[1], d[0]) + 0.02 * noise[0], share),
            azimuth_var=self.variance(4e-4, share),
            elevation_rad=self.spoilt(math.asin(d[2] / max(r, 1e-3) % 1.0), share),
            elevation_var=self.variance(4e-4, share),
            toa_s=self.spoilt((r + 100.0 + 0.3 * noise[1]) / 3e8, share),
            toa_var=self.variance(1e-18, share),
            range_m=self.spoilt(abs(r + 0.3 * noise[2]), share),
            range_var=self.variance(0.09, share),
            phase_difference_rad=self.spoilt(math.remainder(phase, math.tau), share),
            phase_difference_var=self.variance(0.01, share),
            position=np.array([self.spoilt(x, share), self.spoilt(y, share), 0.0]),
            position_cov=self.cov(share, 3),
        )


def faults(output: TrackOutput, newest_ns: int, exact: bool = False) -> list[str]:
    """What is wrong with an output; the covariance of an ``exact`` clock may be 0 but for
    rounding (1 fs)."""
    status, found = output.status, []
    numbers = [status.nis, status.position_sd_m, status.protection_level_m]
    if not all(map(math.isfinite, numbers)) or status.nis < 0.0 or status.position_sd_m < 0.0:
        found.append(f"status {numbers}")
    told_of_refusals = output.odometry is None and "refused: " in status.reason
    if not (told_of_refusals or 0 < status.stamp_ns <= newest_ns):
        found.append(f"stamp {status.stamp_ns} beyond {newest_ns}")
    blocks: dict[str, Array] = {}
    if output.odometry is not None:
        o = output.odometry
        if o.stamp_ns != status.stamp_ns:
            found.append("stamps differ")
        values = (o.position, o.quaternion, o.linear_velocity, o.pose_cov, o.twist_cov)
        found += [f"odometry {value}" for value in values if not np.isfinite(value).all()]
        if abs(float(o.quaternion @ o.quaternion) - 1.0) > 1e-9:
            found.append("quaternion")
        blocks = {"position": o.pose_cov[:2, :2], "velocity": o.twist_cov[:2, :2]}
    if output.clock is not None:
        clock = output.clock
        if not (math.isfinite(clock.offset_s) and math.isfinite(clock.drift)):
            found.append("clock")
        blocks["clock"] = clock.cov
    for name, cov in blocks.items():
        try:
            np.linalg.cholesky(cov + (exact and name == "clock") * np.eye(2) * 1e-30)
        except np.linalg.LinAlgError:
            found.append(f"{name} covariance {cov.tolist()}")
    return found


def fuzz(seed: int, config: dict[str, Any], count: int = BATCH) -> tuple[Counter[str], list[str]]:
    """One tracker through ``count`` measurements: what was refused why, and what went wrong."""
    rng = np.random.default_rng(seed)
    tracker = Tracker(TrackerConfig(**config))
    for info in stations(rng):
        tracker.add_rsu(info)
    generator = Generator(rng, infos={info.rsu_id: info for info in stations(rng)})
    items = [generator.item() for _ in range(count)]
    if seed % 3 == 0:  # arrival out of order, near by or anywhere
        reach = (3.0, 1e9)[seed % 2]
        items = [items[i] for i in np.argsort(np.arange(count) + reach * rng.random(count))]
    seen: Counter[str] = Counter()
    wrong: list[str] = []
    newest_ns, exact = 0, config.get("clock_offset_sd_s") == 0.0

    def check(outputs: list[TrackOutput], k: int) -> None:
        for output in outputs:
            seen["epochs"] += 1
            seen["tracked"] += output.odometry is not None
            wrong.extend(f"seed {seed}, item {k}: {f}" for f in faults(output, newest_ns, exact))

    for k, item in enumerate(items):
        try:
            reason = tracker.add(item)
            seen[reason or "taken"] += 1
            if reason is None:
                newest_ns = max(newest_ns, item.stamp_ns)
            if rng.random() < 0.7:
                check(tracker.process(), k)
        except Exception as error:
            wrong.append(f"seed {seed}, item {k}, {config}: {type(error).__name__} {error}")
            return seen, wrong
    try:
        check(tracker.flush(), count)
        tracker.rsu_reports()
    except Exception as error:
        wrong.append(f"seed {seed}, flush, {config}: {type(error).__name__} {error}")
    return seen, wrong


def run(total: int, first_seed: int = 0, show: bool = False) -> tuple[Counter[str], list[str]]:
    """``total`` measurements over all configurations in turn."""
    seen: Counter[str] = Counter()
    wrong: list[str] = []
    names = list(CONFIGS)
    for batch in range(-(-total // BATCH)):
        name = names[batch % len(names)]
        with np.errstate(all="ignore"):
            some, faulty = fuzz(first_seed + batch, CONFIGS[name], min(BATCH, total))
        seen += some
        wrong += [f"{name}: {text}" for text in faulty]
        if show and faulty:
            print(f"{name}: {faulty[0]}", flush=True)
    return seen, wrong


def test_the_generator_reaches_all_parts() -> None:
    """Enough is taken and tracked, every reason to refuse occurs."""
    seen, _ = run(len(CONFIGS) * BATCH)
    assert seen["taken"] > 0.5 * len(CONFIGS) * BATCH
    assert seen["tracked"] > 0.5 * seen["epochs"]
    reasons = {"not_finite", "variance", "zero_stamp", "duplicate", "late", "future_stamp"}
    reasons |= {"no_fields", "unknown_fields", "no_baseline", "negative_range"}
    assert reasons | {"unknown_rsu"} <= set(seen)


def test_whatever_is_measured_nothing_raises_and_outputs_are_sound() -> None:
    _, wrong = run(int(os.environ.get("NETPOS_FUZZ", "20000")))
    assert not wrong, f"{len(wrong)} faults, first: {wrong[:3]}"


def test_kernels_stay_within_their_memory() -> None:
    """In Python an index beyond an array raises, a compiled kernel writes there: in this batch all
    explanations of what is refused were one more than there was room for."""
    code = (
        "from test_fuzz import BATCH, CONFIGS, fuzz; print(fuzz(12, CONFIGS['robust'], BATCH)[1])"
    )
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code],
        env={**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": os.pathsep.join(sys.path)},
        cwd=Path(__file__).parent,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert (done.stdout, done.returncode) == ("[]\n", 0), done.stderr


@pytest.mark.parametrize("name", CONFIGS)
def test_sound_measurements_of_a_device_on_top_of_an_rsu(name: str) -> None:
    """Range 0 and every direction from an RSU the device touches, beside two sound RSUs."""
    tracker = Tracker(TrackerConfig(**CONFIGS[name]))
    rng = np.random.default_rng(0)
    for info in stations(rng):
        tracker.add_rsu(info)
    pose = InitialPose(stamp_ns=T0, vue_id=VUE, position=np.array([30.0, 0.0, 0.0]), cov=np.eye(3))
    tracker.add(pose)
    outputs = []
    for k in range(60):
        touching = RsuMeasurement(
            stamp_ns=T0 + k * 10**8,
            rsu_id="here",
            vue_id=VUE,
            fields=Field.AZIMUTH | Field.ELEVATION | Field.RANGE | Field.TOA,
            azimuth_rad=rng.uniform(-4, 4),
            azimuth_var=1e-6,
            elevation_rad=rng.uniform(-4, 4),
            elevation_var=1e-6,
            range_m=0.0,
            range_var=1e-4,
            toa_s=0.0,
            toa_var=1e-20,
        )
        assert tracker.add(touching) is None
        outputs += tracker.process()
    outputs += tracker.flush()
    exact = name == "exact clock"
    assert [fault for o in outputs for fault in faults(o, T0 + 10**10, exact)] == []
    assert len(outputs) == 60


# what a million found


@pytest.mark.parametrize("seed", [123, 138, 139, 252, 330, 366, 518])
def test_a_state_no_device_can_have(seed: int) -> None:
    """Rounding at the edge of doubles; without a gate tracks 1e12 m away and faster than light."""
    with np.errstate(all="ignore"):
        seen, wrong = fuzz(seed, CONFIGS[list(CONFIGS)[seed % len(CONFIGS)]])
    assert not wrong
    assert seen["tracked"] > 0


@pytest.mark.parametrize("kind", ["position", "velocity"])
def test_a_nearly_singular_slightly_asymmetric_covariance(kind: str) -> None:
    """Refused, or fused: but never an exception."""
    cov = np.eye(3)
    cov[0, 1] = 1.0 - 1e-8
    cov[1, 0] = cov[0, 1] * (1.0 + 1e-7)
    tracker = Tracker(TrackerConfig(hold_s=0.0))
    tracker.add_rsu(RsuInfo(rsu_id="a", position=np.zeros(3)))
    if kind == "velocity":
        tracker.add(Velocity(stamp_ns=T0, vue_id=VUE, velocity=np.ones(2), cov=cov[:2, :2]))
    else:
        fix = {"fields": Field.POSITION, "position": np.ones(3), "position_cov": cov}
        tracker.add(RsuMeasurement(stamp_ns=T0, rsu_id="a", vue_id=VUE, expected=1, **fix))
    for output in tracker.process():
        assert not faults(output, T0)


def test_a_capped_variance_leaves_the_gate_variance_positive() -> None:
    """Noise correlated over 0.3 s, sampled 1 ns apart: an update variance beyond the cap."""
    info = RsuInfo(rsu_id="a", position=np.array([60.0, -5.0, 0.0]), noise_correlation_time_s=0.3)
    values = {"fields": Field.RANGE, "range_m": 40.0, "range_var": 1e6}
    m = RsuMeasurement(stamp_ns=T0, rsu_id="a", vue_id=VUE, **values)
    rows = rsu_rows(m, info, rsu_axes(info), 0, [RowErrors(inflation=3e8)])
    mean, cov = np.array([30.0, 0.0, 1.0, 1.0, 0.0, 0.0]), np.eye(6)
    options = conditioning.RobustOptions(0, 4.0, 0.2, 20.0)
    conditioning.reweight(cov, rows, predicted_rows(mean, cov, rows, 0.0), options)
    assert rows[0, GATE_VARIANCE] > 0.0
    assert rows[0, VARIANCE] > 0.0


if __name__ == "__main__":
    total = int(os.environ.get("NETPOS_FUZZ", "1000000"))
    seen, wrong = run(total, show=True)
    print(f"{total} measurements: {dict(seen)}; {len(wrong)} faults")
    print("\n".join(wrong[:50]))
    sys.exit(bool(wrong))
