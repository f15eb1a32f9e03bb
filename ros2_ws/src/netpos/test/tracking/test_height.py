"""A device whose height is unknown: against linear algebra, by simulation, at its limits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from netpos.bags.recording import number_beacons
from netpos.messages.values import Array, Field, InitialPose, Odometry, RsuInfo, RsuMeasurement
from netpos.tracking import Tracker, TrackerConfig, TrackOutput
from netpos.tracking.estimators.models import slow_states, start_state, state_of_fit
from scipy.optimize import least_squares
from scipy.stats import chi2

C = 299_792_458.0
T0, STEP_S, SD_M = 1_000_000_000, 0.1, 0.1
HALL = {  # anchors of a room, low and high in turn
    "a": (0.0, 0.0, 0.2),
    "b": (8.0, 0.0, 2.7),
    "c": (8.0, 6.0, 0.3),
    "d": (0.0, 6.0, 2.6),
    "e": (4.0, -1.0, 2.8),
    "f": (4.0, 7.0, 0.1),
}
MEAN_M, HEIGHT_SD_M, HEIGHT_TIME_S, ACCEL = 1.3, 0.6, 5.0, 0.4
UNKNOWN: dict[str, Any] = {
    "device_height_m": MEAN_M,
    "device_height_sd_m": HEIGHT_SD_M,
    "device_height_time_s": HEIGHT_TIME_S,
    "accel_density_mps2_sqrthz": ACCEL,
    "initial_speed_sd_mps": 1.0,
    "coverage_radius_m": 20.0,
    "isolate_rsus": False,
    "hold_s": 0.0,
}


@dataclass(frozen=True)
class Flight:
    """Positions (n, 3) each 0.1 s, as the models of the tracker have them, and the velocities."""

    position: Array
    velocity: Array

    @classmethod
    def of(cls, seed: int, seconds: float = 10.0) -> Flight:
        rng, n = np.random.default_rng([seed, 9]), round(seconds / STEP_S)
        Q = ACCEL**2 * np.array([[STEP_S**3 / 3, STEP_S**2 / 2], [STEP_S**2 / 2, STEP_S]])
        L, keep = np.linalg.cholesky(Q), math.exp(-STEP_S / HEIGHT_TIME_S)
        place, speed = np.array([4.0, 3.0]), rng.normal(size=2) * 0.3
        up, positions, velocities = HEIGHT_SD_M * rng.normal(), [], []
        for _ in range(n):
            positions.append([*place, MEAN_M + up])
            velocities.append(speed)
            kick = L @ rng.normal(size=(2, 2))
            place, speed = place + STEP_S * speed + kick[0], speed + kick[1]
            up = keep * up + HEIGHT_SD_M * math.sqrt(1.0 - keep**2) * rng.normal()
        return cls(np.array(positions), np.array(velocities))


def stamp(k: int) -> int:
    return T0 + round(k * STEP_S * 1e9)


def ranges(
    k: int,
    place: Array,
    rng: np.random.Generator | None = None,
    names: Sequence[str] = tuple(HALL),
) -> list[RsuMeasurement]:
    noise = np.zeros(len(names)) if rng is None else SD_M * rng.normal(size=len(names))
    return [
        RsuMeasurement(
            stamp_ns=stamp(k),
            rsu_id=name,
            vue_id="v",
            fields=Field.RANGE,
            range_m=float(np.linalg.norm(place - HALL[name])) + off,
            range_var=SD_M**2,
            expected=len(names),
        )
        for name, off in zip(names, noise.tolist(), strict=True)
    ]


def difference(
    k: int, name: str, reference: str, place: Array, rng: np.random.Generator
) -> RsuMeasurement:
    to, other = (float(np.linalg.norm(place - HALL[n])) for n in (name, reference))
    return RsuMeasurement(
        stamp_ns=stamp(k),
        rsu_id=name,
        reference_rsu_id=reference,
        vue_id="v",
        fields=Field.TDOA,
        tdoa_s=(to - other + SD_M * rng.normal()) / C,
        tdoa_var=(SD_M / C) ** 2,
    )


def tracker(**config: Any) -> Tracker:
    made = Tracker(TrackerConfig(**{**UNKNOWN, **config}))
    for name, place in HALL.items():
        made.add_rsu(RsuInfo(rsu_id=name, position=np.array(place)))
    return made


def fed(made: Tracker, items: Sequence[Any]) -> list[TrackOutput]:
    for item in items:
        assert made.add(item) is None
    return made.process() + made.flush()


def flown(made: Tracker, flight: Flight, seed: int) -> list[Odometry]:
    """Odometry of the epochs that have one."""
    rng, outputs = np.random.default_rng([seed, 1]), []
    for k, place in enumerate(flight.position):
        outputs += fed(made, ranges(k, place, rng))
    return [o.odometry for o in outputs if o.odometry is not None]


def errors(flight: Flight, said: Sequence[Odometry]) -> Array:
    at = [round((o.stamp_ns - T0) * 1e-9 / STEP_S) for o in said]
    return np.array([o.position for o in said]) - flight.position[at]


def nees(flight: Flight, said: Sequence[Odometry]) -> Array:
    off = errors(flight, said)
    cov = np.array([o.pose_cov[:3, :3] for o in said])
    return np.einsum("ni,ni->n", off, np.linalg.solve(cov, off[..., None])[..., 0])


# --- against linear algebra


class NumpyEkf:
    """A second-order extended Kalman filter in three dimensions, derivatives by differences."""

    def __init__(self, place: Array, cov: Array) -> None:
        self.x = np.array([*place[:2], 0.0, 0.0, MEAN_M])
        self.P = np.diag([1.0, 1.0, 1.0, 1.0, HEIGHT_SD_M**2])
        self.P[:2, :2] = cov

    def predict(self) -> None:
        F, Q = np.eye(5), np.zeros((5, 5))
        F[0, 2] = F[1, 3] = STEP_S
        F[4, 4] = keep = math.exp(-STEP_S / HEIGHT_TIME_S)
        for p, v in ((0, 2), (1, 3)):
            Q[np.ix_([p, v], [p, v])] = ACCEL**2 * np.array(
                [[STEP_S**3 / 3, STEP_S**2 / 2], [STEP_S**2 / 2, STEP_S]]
            )
        Q[4, 4] = HEIGHT_SD_M**2 * (1.0 - keep**2)
        self.x = F @ self.x
        self.x[4] += (1.0 - keep) * MEAN_M
        self.P = F @ self.P @ F.T + Q

    def update(self, h: list[Any], z: Array, sd: float) -> None:
        at = [0, 1, 4]
        P3, e, eps = self.P[np.ix_(at, at)], np.eye(3), 1e-4
        place, H, R, longer = self.x[at], np.zeros((len(h), 5)), np.zeros(len(h)), np.zeros(len(h))
        for i, f in enumerate(h):
            H[i, at] = [(f(place + eps * u) - f(place - eps * u)) / (2 * eps) for u in e]
            bend = np.array(
                [
                    [
                        (
                            f(place + eps * (u + v))
                            - f(place + eps * (u - v))
                            - f(place - eps * (u - v))
                            + f(place - eps * (u + v))
                        )
                        / (4 * eps**2)
                        for v in e
                    ]
                    for u in e
                ]
            )
            R[i] = sd**2 + 0.5 * np.trace(bend @ P3 @ bend @ P3)
            longer[i] = 0.5 * np.trace(bend @ P3)
        left = z - np.array([f(place) for f in h]) - longer
        K = self.P @ H.T @ np.linalg.inv(H @ self.P @ H.T + np.diag(R))
        self.x = self.x + K @ left
        self.P = self.P - K @ H @ self.P


PLAIN: dict[str, Any] = {"filter": "ekf", "gate_probability": 1.0, "manoeuvre_speed_sd_mps": 0.0}


@pytest.mark.parametrize("differences", [False, True])
def test_the_track_is_that_of_a_filter_in_three_dimensions(differences: bool) -> None:
    flight, rng = Flight.of(3), np.random.default_rng(5)
    made, start = tracker(**PLAIN), flight.position[0] + [0.1, -0.2, 0.0]
    cov = np.array([[0.05, 0.01], [0.01, 0.08]])
    pose = np.zeros((3, 3))
    pose[:2, :2] = cov
    fed(made, [InitialPose(stamp_ns=T0 - 1, vue_id="v", position=start, cov=pose)])
    oracle, names = NumpyEkf(start, cov), list(HALL)
    for k, place in enumerate(flight.position[:60]):
        if k:
            oracle.predict()
        if differences:  # pairs one after the other, as an emitter that the anchors share
            name, other = names[k % 6], names[(k + 1) % 6]
            items = [difference(k, name, other, place, rng)]
            h = [
                lambda p, a=HALL[name], b=HALL[other]: (
                    np.linalg.norm(p - a) - np.linalg.norm(p - b)
                )
            ]
            z = np.array([C * items[0].tdoa_s])
        else:
            items = ranges(k, place, rng)
            h = [lambda p, a=HALL[m.rsu_id]: np.linalg.norm(p - a) for m in items]
            z = np.array([m.range_m for m in items])
        said = fed(made, items)[-1].odometry
        oracle.update(h, z, SD_M)
        assert said is not None
        np.testing.assert_allclose(said.position, oracle.x[[0, 1, 4]], atol=2e-6)
        np.testing.assert_allclose(
            said.pose_cov[:3, :3], oracle.P[np.ix_([0, 1, 4], [0, 1, 4])], rtol=1e-4, atol=1e-7
        )
    assert oracle.P[4, 4] < 0.3 * HEIGHT_SD_M**2


@pytest.mark.parametrize("seed", range(5))
def test_the_first_fix_is_that_of_least_squares(seed: int) -> None:
    rng = np.random.default_rng(seed)
    place = np.array([*rng.uniform([1.0, 1.0], [7.0, 5.0]), MEAN_M + HEIGHT_SD_M * rng.normal()])
    items = ranges(0, place, rng)
    said = fed(tracker(), items)[-1].odometry
    assert said is not None

    def residuals(p: Array, sd_m: float) -> Array:
        left = [(np.linalg.norm(p - HALL[m.rsu_id]) - m.range_m) / sd_m for m in items]
        return np.array([*left, (p[2] - MEAN_M) / HEIGHT_SD_M, *(p[:2] - [4.0, 3.0]) / 20.0])

    # Ranges that do not meet are less certain than stated, by as much as makes them meet.
    sd_m, worse = SD_M, 1.0
    for _ in range(5):
        sd_m *= math.sqrt(worse)
        found = least_squares(residuals, [4.0, 3.0, MEAN_M], args=(sd_m,))
        worse = float((found.fun[: len(items)] ** 2).mean())
        if worse < 1.1:
            break
    # The posterior about it, summed over samples: where it bends, its mean is not its top.
    width = 1.5 * np.linalg.cholesky(np.linalg.inv(found.jac.T @ found.jac))
    unit = rng.normal(size=(20000, 3))
    points = found.x + unit @ width.T
    cost = np.array([(residuals(p, sd_m) ** 2).sum() for p in points])
    weights = np.exp(-0.5 * (cost - cost.min()) + 0.5 * (unit**2).sum(axis=1))
    mean = np.average(points, axis=0, weights=weights)
    cov = np.cov(points.T, aweights=weights)
    sd = np.sqrt(np.diag(cov))
    np.testing.assert_allclose((said.position - mean) / sd, 0.0, atol=0.15)
    # As of the oracle: the trace within 15 %, here in units of the posterior.
    stated, expected = (P / np.outer(sd, sd) for P in (said.pose_cov[:3, :3], cov))
    assert np.trace(stated) == pytest.approx(np.trace(expected), rel=0.15)
    np.testing.assert_allclose(stated, expected, atol=0.25)


# --- by simulation


def test_errors_are_those_stated() -> None:
    """NEES of x, y and height over 40 flights; within the bounds of independent flights."""
    last, mean = [], []
    for seed in range(40):
        flight = Flight.of(seed)
        values = nees(flight, flown(tracker(), flight, seed))
        last.append(values[-1])
        mean.append(values[20:].mean())
    low, high = chi2.ppf([0.001, 0.999], 3 * len(last)) / len(last)
    assert low < float(np.mean(last)) < high
    assert float(np.mean(mean)) == pytest.approx(3.0, abs=0.5)


FORMS: dict[str, dict[str, Any]] = {
    "ekf": {"filter": "ekf"},
    "iekf": {},
    "ukf": {"filter": "ukf"},
    "srukf": {"filter": "srukf"},
    "turning": {"motion_model": "constant_turn"},
    "accelerating": {"motion_model": "constant_acceleration"},
    "interacting": {"motion_model": "interacting"},
    "robust": {"robust": "huber"},
    "blocked": {"nlos_probability": 0.05},
    "learned": {"learn_errors": True},
}


@pytest.mark.parametrize("form", FORMS)
def test_every_form_of_the_filter_finds_the_height(form: str) -> None:
    """Also where the motion model has states of its own before it."""
    found = []
    for seed in range(3):
        flight = Flight.of(seed, 8.0)
        said = flown(tracker(**FORMS[form]), flight, seed)
        assert len(said) > 60
        found.append(errors(flight, said)[20:, 2])
        assert nees(flight, said)[20:].mean() < 8.0
    assert float(np.sqrt(np.mean(np.square(found)))) < 0.12
    assert HEIGHT_SD_M > 0.5  # what is not measured would be off by this


def test_a_wrong_height_costs_what_an_unknown_one_does_not() -> None:
    """0.7 m, also horizontally: no anchor has another one opposite, at its height."""
    flight = Flight.of(8, 4.0)
    flight = replace(flight, position=flight.position + np.array([0.0, 0.0, 0.7]))
    known = errors(flight, flown(tracker(device_height_sd_m=0.0), flight, 8))[15:]
    open_ = errors(flight, flown(tracker(), flight, 8))[15:]
    assert np.abs(open_[:, 2]).mean() < 0.3 * np.abs(known[:, 2]).mean()
    assert np.hypot(*open_[:, :2].T).mean() < 0.6 * np.hypot(*known[:, :2].T).mean()


def test_a_fix_of_three_dimensions_says_the_height() -> None:
    made = tracker()
    cov = np.diag([0.04, 0.04, 0.01])
    for k in range(30):
        said = fed(
            made,
            [
                RsuMeasurement(
                    stamp_ns=stamp(k),
                    rsu_id="a",
                    vue_id="v",
                    fields=Field.POSITION,
                    position=np.array([3.0, 2.0, 1.9]),
                    position_cov=cov,
                )
            ],
        )[-1].odometry
    assert said is not None
    assert said.position[2] == pytest.approx(1.9, abs=0.02)
    assert said.pose_cov[2, 2] < 0.01


# --- at its limits


def test_the_odometry_of_a_known_height_is_what_it_was() -> None:
    flight = Flight.of(1, 3.0)
    plain = {k: v for k, v in UNKNOWN.items() if k != "device_height_sd_m"}
    made = Tracker(TrackerConfig(**plain))
    for name, place in HALL.items():
        made.add_rsu(RsuInfo(rsu_id=name, position=np.array(place)))
    for one, other in zip(
        flown(made, flight, 1), flown(tracker(device_height_sd_m=0.0), flight, 1), strict=True
    ):
        np.testing.assert_array_equal(one.position, other.position)
        assert one.position[2] == MEAN_M
        assert one.pose_cov[2, 2] == 1.0  # nothing is claimed of it


def test_a_height_that_is_nearly_known_gives_the_planar_track() -> None:
    flight = Flight.of(2, 4.0)
    known = flown(tracker(device_height_sd_m=0.0, **PLAIN), flight, 2)
    nearly = flown(tracker(device_height_sd_m=1e-5, **PLAIN), flight, 2)
    for one, other in zip(known, nearly, strict=True):
        np.testing.assert_allclose(one.position, other.position, atol=1e-6)
        np.testing.assert_allclose(one.pose_cov[:2, :2], other.pose_cov[:2, :2], rtol=1e-5)


@pytest.mark.parametrize("form", ["iekf", "srukf", "turning", "learned"])
def test_late_measurements_change_nothing(form: str) -> None:
    """One after the other, and each third of an epoch 0.3 s late."""
    flight, rng = Flight.of(6, 4.0), np.random.default_rng(6)
    epochs = [ranges(k, place, rng) for k, place in enumerate(flight.position)]
    epochs = [[replace(m, expected=0) for m in epoch] for epoch in epochs]
    in_order, late = (tracker(**FORMS[form], history_s=2.0) for _ in range(2))
    for epoch in epochs:
        expected = fed(in_order, epoch)[-1].odometry
    for k, epoch in enumerate(epochs):
        fed(late, epoch[2:] + (epochs[k - 3][:2] if k >= 3 else []))
    for k in (-3, -2, -1):
        outputs = fed(late, epochs[k][:2])
    found = outputs[-1].odometry
    assert expected is not None
    assert found is not None
    np.testing.assert_array_equal(found.position, expected.position)
    np.testing.assert_array_equal(found.pose_cov, expected.pose_cov)


def test_smoothing_gains_height() -> None:
    before, after, consistent = [], [], []
    for seed in range(6):
        flight, made = Flight.of(seed), tracker()
        track = made.track("v")
        track.record()
        said = flown(made, flight, seed)
        smoothed = track.smoothed()
        before.append(errors(flight, said)[20:-5, 2])
        after.append(errors(flight, smoothed)[20:-5, 2])
        consistent.append(nees(flight, smoothed)[20:-5].mean())
    assert float(np.mean(np.square(after))) < 0.8 * float(np.mean(np.square(before)))
    assert float(np.mean(consistent)) == pytest.approx(3.0, abs=1.2)


def test_anchors_heard_after_a_silence_split_and_join_again() -> None:
    """Ranges of single anchors under a wide prior, by a mixture whose components have heights."""
    worst = []
    for seed in range(4):
        flight, made, rng = Flight.of(seed, 12.0), tracker(), np.random.default_rng([seed, 2])
        names, said = list(HALL), []
        for k, place in enumerate(flight.position):
            if 40 <= k < 80:
                continue
            together = names if k < 40 else [names[k % 6]]
            items = [replace(m, expected=0) for m in ranges(k, place, rng, together)]
            said += [o.odometry for o in fed(made, items) if o.odometry is not None]
        assert nees(flight, said[-20:]).mean() < 6.0
        worst.append(np.abs(errors(flight, said[-20:])[:, :2]).max())
    assert max(worst) < 0.5  # the prior had an sd of 1.9 m


def test_where_the_states_of_a_start_go() -> None:
    """Fitted core and height, round two states of a motion model."""
    config = TrackerConfig(
        motion_model="constant_acceleration", accel_state_sd_mps2=2.0, device_height_sd_m=0.5
    )
    mean, A = np.arange(7.0), np.random.default_rng(1).normal(size=(7, 7))
    x, P = state_of_fit(config, mean, A @ A.T, slow_states(config).slow_errors)
    np.testing.assert_array_equal(x, [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 0.0, 0.0, 6.0])
    fitted = [0, 1, 2, 3, 4, 5, 8]
    np.testing.assert_array_equal(P[np.ix_(fitted, fitted)], A @ A.T)
    np.testing.assert_array_equal(P[6:8, 6:8], 4.0 * np.eye(2))
    assert not P[6:8][:, fitted].any()
    x, P = start_state(config, mean[:6], np.eye(6))
    assert (x[8], P[8, 8]) == (0.0, 0.25)
    assert start_state(config, x, P)[0] is x


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"device_height_sd_m": -0.1}, "device_height_sd_m must be in .* got -0.1"),
        ({"device_height_sd_m": math.nan}, "device_height_sd_m must be in .* got nan"),
        ({"device_height_time_s": 0.0}, "device_height_time_s must be in .* got 0"),
        (
            {"device_height_sd_m": 0.5, "motion_model": "strapdown"},
            "strapdown always estimates the height; set device_height_sd_m to 0, got 0.5",
        ),
        (
            {"device_height_sd_m": 0.5, "motion_model": "rigid_body"},
            "rigid_body needs a known height, got device_height_sd_m 0.5; set it to 0",
        ),
    ],
)
def test_parameters_that_are_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        TrackerConfig(**values)


def test_numbered_differences_start_a_track() -> None:
    """Time differences alone: first fix with the height, of a drone 0.5 m above the mean."""
    rng, place, names = np.random.default_rng(2), np.array([3.0, 2.0, 1.8]), list(HALL)
    made, said = tracker(), None
    for k in range(60):
        items = [difference(k, names[k % 6], names[(k + 1) % 6], place, rng)]
        for output in fed(made, number_beacons(items)):
            said = output.odometry or said
    assert said is not None
    off = said.position - place
    assert float(off @ np.linalg.solve(said.pose_cov[:3, :3], off)) < 12.0
    assert abs(off[2]) < 0.2
