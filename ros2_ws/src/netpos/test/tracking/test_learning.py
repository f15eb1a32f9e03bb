"""Learned error models against errors that are known, because they are simulated."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from netpos.estimation.measurement import VALUE
from netpos.estimation.rows import linear_rows
from netpos.messages.values import Array, Field, Odometry, RsuInfo, RsuMeasurement
from netpos.tracking.config import TrackerConfig
from netpos.tracking.report import TrackOutput
from netpos.tracking.rsus.error_model import RATE, SCALE, SPREAD, ErrorModel
from netpos.tracking.rsus.learning import LearnedErrors
from netpos.tracking.rsus.shared_errors import SharedErrors
from netpos.tracking.rsus.shift import DeviceState
from netpos.tracking.tracker import Tracker

RSUS = np.array(
    [[15.0, 0.0, 3.0], [4.0, 12.0, 3.0], [-12.0, 7.0, 3.0], [-12.0, -7.0, 3.0], [4.0, -12.0, 3.0]]
)
RATE_HZ = 5.0
NAMES = [("rsu/a", "RANGE"), ("rsu/b", "RANGE"), ("rsu/c", "RANGE"), ("rsu/d", "RANGE")]
SIDES = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])


OF_SIDES = {
    tuple(side): linear_rows(np.zeros(1), np.eye(1), np.array([[*side, 0, 0, 0, 0]]), 0)[0]
    for side in SIDES
}


def measured(side: Array, error: float, x: float = 0.0) -> Array:
    """Row (ROW_WIDTH,) of an RSU so far away that its value is linear in the position, of a device
    at (x, 0)."""
    row = OF_SIDES[tuple(side)].copy()
    row[VALUE] = error + side[0] * x
    return row


def known(stamp_ns: int, x: float = 0.0) -> DeviceState:
    """Of a device at (x, 0), as everybody knows."""
    mean = np.array([x, 0.0, 0.0, 0.0, 0.0, 0.0])
    return DeviceState(stamp_ns, mean, np.zeros((6, 6)), 0.0, 0.0)


def hear(
    learned: LearnedErrors, name: tuple[str, str], row: Array, stamp_ns: int, stated: float
) -> None:
    """Let a row (ROW_WIDTH,) of ``measured`` be heard of, with the variance stated."""
    learned.move(stamp_ns, np.zeros(3), True)
    learned.hear([name], row[None], left_of(row[VALUE], stated), np.array([stated]))


def left_of(error: float, variance: float) -> Array:
    """What is left (1, 8) of a value at the true place, of an update with its ``variance``."""
    return np.array([[error, error**2, variance, 0.0, 0.0, 0.0, 0.0, 0.0]])


def learned_of(
    errors: Array, stated_sd: float, rate_hz: int = 5, speeds: Array | None = None
) -> LearnedErrors:
    """What is learned of four RSUs to the four sides of a device whose place is known: errors
    (n, 4) m, ``rate_hz`` a second, of which those of a window count as one; ``speeds`` (n,) m/s,
    of none: 0."""
    learned = LearnedErrors()
    for name in NAMES:
        learned.model(name, stated_sd, 0.0, 0.0)
    x = before = 0.0
    for k, of_all in enumerate(errors):
        stamp_ns = k * 1_000_000_000 // rate_hz
        speed = 0.0 if speeds is None else float(speeds[k])
        x, before = x + 0.5 * (before + speed) / rate_hz, speed
        learned.move(stamp_ns, np.array([speed, 0.0, 0.0]), speed == 0.0)
        for name, error, side in zip(NAMES, of_all.tolist(), SIDES, strict=True):
            variance = learned.models[name].scale * stated_sd**2 * rate_hz
            row, left = measured(side, error, x)[None], left_of(error, variance)
            learned.hear([name], row, left, np.array([stated_sd**2]))
        learned.conclude(known(stamp_ns, x))
    return learned


def stop_and_go(seconds: int, rate_hz: int = 5) -> Array:
    """Speeds (n,) m/s: 1 for five seconds, 0 for fifteen, and again."""
    return np.where(np.arange(seconds * rate_hz) // rate_hz % 20 < 5, 1.0, 0.0)


def slow_and_white(
    seed: int, seconds: int, noise_sd: float, bias_sd: float, time_s: float, rate_hz: int = 5
) -> Array:
    """(n, 4) m: first-order Gauss-Markov biases and white noise."""
    decays = np.full(seconds * rate_hz, math.exp(-1.0 / rate_hz / time_s))
    return gauss_markov(seed, noise_sd, bias_sd, decays)


def gauss_markov(seed: int, noise_sd: float, bias_sd: float, decays: Array) -> Array:
    """(n, 4) m: biases of which ``decays`` (n,) is left since the value before, and white
    noise."""
    rng, n = np.random.default_rng(seed), len(decays)
    bias = np.empty((n, 4))
    bias[0] = rng.normal(0.0, bias_sd, 4)
    for k in range(1, n):
        new_sd = bias_sd * math.sqrt(1 - decays[k] ** 2)
        bias[k] = decays[k] * bias[k - 1] + rng.normal(0.0, new_sd, 4)
    return bias + rng.normal(0.0, noise_sd, (n, 4))


@pytest.mark.parametrize("factor", [0.25, 1.0, 4.0])
def test_white_noise_is_learned_as_scatter_without_a_bias(factor: float) -> None:
    sd = 0.1 * math.sqrt(factor)
    for seed in range(3):
        learned = learned_of(slow_and_white(seed, 120, sd, 0.0, 1.0), 0.1)
        for model in learned.models.values():
            expected = factor / 5.0  # of five values a window
            assert expected / 1.6 < model.scale < expected * 1.6
            assert factor / 1.3 < model.gate_scale < factor * 1.3
            assert model.bias_sd < 0.35 * sd


@pytest.mark.parametrize("bias_sd", [0.1, 0.3, 0.5])
def test_a_bias_is_learned_with_its_sd_and_its_time(bias_sd: float) -> None:
    """Within a factor of 2, of 3 where it is no larger than the noise: a bias twice as large that
    lasts four times as long changes by as much in a second, and ten correlation times of four RSUs
    do not tell them apart. How much it changes in a second: within a factor of 2."""
    spreads, times = [], []
    for seed in range(6):
        learned = learned_of(slow_and_white(seed, 300, 0.1, bias_sd, 30.0), 0.1)
        spreads += [m.bias_sd for m in learned.models.values()]
        times += [m.time_s(0.0) for m in learned.models.values()]
    found = np.sqrt(np.mean(np.square(spreads)))
    factor = 3.0 if bias_sd <= 0.1 else 2.0
    assert bias_sd / factor < found < factor * bias_sd
    assert 0.5 < found / bias_sd / math.sqrt(np.median(times) / 30.0) < 2.0
    assert 10.0 < np.median(times) < 150.0


@pytest.mark.parametrize("length_m", [1.0, 4.0])
@pytest.mark.parametrize("time_s", [60.0, math.inf])
def test_a_bias_of_a_place_is_learned_with_how_long_it_lasts_there(
    time_s: float, length_m: float
) -> None:
    """Errors that change with the place, and within a minute or never: within a factor of 2."""
    speeds, times, spreads = stop_and_go(600), [], []
    decays = np.exp(-0.2 / time_s - 0.2 * speeds / length_m)
    for seed in range(4):
        learned = learned_of(gauss_markov(seed, 0.1, 0.3, decays), 0.1, speeds=speeds)
        times += [model.time_s(0.0) for model in learned.models.values()]
        spreads += [model.bias_sd for model in learned.models.values()]
    time_s = min(time_s, 400.0)  # the longest that is told apart
    assert time_s / 2.0 < np.median(times) < time_s * 2.0
    assert 0.15 < np.median(spreads) < 0.6


@pytest.mark.parametrize(("time_s", "values"), [(0.0, 40.0), (0.1, 5.6)])
def test_values_of_a_window_count_as_many_as_are_independent(time_s: float, values: float) -> None:
    """First-order Gauss-Markov noise, 40 values a second; their mean has its variance over
    ``values``: (T / tau)^2 / 2 / (T / tau - 1 + exp(-T / tau)) of them (Papoulis 1991, 6-60)."""
    rho = math.exp(-1.0 / 40.0 / time_s) if time_s > 0.0 else 0.0
    for seed in range(3):
        rng = np.random.default_rng(seed)
        noise = rng.normal(0.0, 0.1, (120 * 40, 4))
        for k in range(1, len(noise)):
            noise[k] = rho * noise[k - 1] + math.sqrt(1.0 - rho**2) * noise[k]
        learned = learned_of(noise, 0.1, rate_hz=40)
        for model in learned.models.values():
            assert 1.0 / 2.5 < values * model.scale < 2.5


def test_values_that_follow_each_other_count_as_one_until_their_scatter_is_seen() -> None:
    model = ErrorModel.declared(0.1, 0.0, 0.0)
    assert model.window_scale == 1.0
    alike = model.scattered(0.4, 39.0, 0.004)  # a hundredth of what is stated
    assert alike.window_scale > 0.95
    for _ in range(50):
        model = model.scattered(39.0, 39.0, 39.0)  # as stated, from one to the next
    assert model.window_scale == pytest.approx(1.0 / 40.0, rel=0.25)


def test_who_scatters_beyond_all_candidates_has_the_largest_scale() -> None:
    """An RSU that errs by up to a hundred times what it states, in a wave of three seconds."""
    errors = np.random.default_rng(4).normal(0.0, 0.1, (300, 4))
    errors[:, 0] = 10.0 * np.sin(2.0 * math.pi * np.arange(300) / 15.0)
    model = learned_of(errors, 0.1).models[NAMES[0]]
    assert model.window_scale > 4.0 * 64.0
    assert model.scale == pytest.approx(64.0, rel=0.01)
    assert math.isfinite(model.bias_sd)
    assert math.isfinite(model.time_s(0.0))


def test_a_window_fits_as_well_as_it_was_foreseen() -> None:
    """The candidates' densities of a window, weighted as before it: Student's with 5 degrees of
    freedom, the variance of a Gaussian of which is 0.72 of what is stated, without factors that
    all have."""
    model = ErrorModel.declared(0.1, 0.0, 0.0)
    for k, y in enumerate([0.15, -0.3, 0.8]):
        biased = (model.unit * SPREAD) ** 2
        dt = 0.0 if k == 0 else 1.0
        left = np.exp(-dt * RATE)
        mean, var = left * model.mean, left**2 * model.var + (1.0 - left**2) * biased
        S = var + SCALE * 0.01
        density = S**-0.5 * (1.0 + (y - mean) ** 2 / (0.72 * S) / 5.0) ** -3.0
        expected = model.log_fit + 0.6 * math.log(float(model.weights @ density))
        model = model.weigh(k * 1_000_000_000, 0.0, y, 0.01, 0.6)
        assert model.log_fit == pytest.approx(expected, rel=1e-12)
        model = model.weighed(model.prior + model.evidence)


def test_what_a_shift_of_the_position_explains_is_not_an_error_of_the_rsus() -> None:
    """All residuals are those of a device 3 m to the side: nothing contradicts anything."""
    rng = np.random.default_rng(5)
    shift = np.outer(3.0 * np.sin(np.arange(600) / 50.0), SIDES @ [1.0, 0.5])
    learned = learned_of(shift + rng.normal(0.0, 0.1, (600, 4)), 0.1)
    for model in learned.models.values():
        assert model.bias_sd < 0.1
        assert model.scale < 2.0


def test_nothing_is_learned_of_rsus_that_nobody_checks() -> None:
    """Two directions, two unknowns: every residual is a shift of the position."""
    learned = LearnedErrors()
    for name in NAMES[:2]:
        learned.model(name, 0.1, 0.0, 0.0)
    before = {name: learned.models[name].bias_sd for name in NAMES[:2]}
    for k in range(500):
        for name, side in zip(NAMES[:2], SIDES, strict=False):
            hear(learned, name, measured(side, 0.7), k * 200_000_000, 0.01)
        learned.conclude(known(k * 200_000_000))
    for name in NAMES[:2]:
        assert not learned.models[name].evidence.any()
        assert learned.models[name].bias_sd == before[name]


def test_what_is_declared_is_the_prior() -> None:
    undeclared = ErrorModel.declared(0.1, 0.0, 0.0)
    declared = ErrorModel.declared(0.1, 0.5, 20.0)
    assert undeclared.scale == pytest.approx(1.0, rel=0.05)
    assert undeclared.bias_sd < 0.3
    assert 0.25 < declared.bias_sd < 1.5
    assert 10.0 < declared.time_s(0.0) < 60.0
    assert declared.time_s(2.0) < declared.time_s(0.0)


def test_a_copy_goes_its_own_way() -> None:
    errors = slow_and_white(3, 60, 0.2, 0.3, 20.0)
    learned = learned_of(errors[:150], 0.1)
    twin = learned.copy()
    kept = {name: (m.bias_sd, m.scale) for name, m in twin.models.items()}
    for k, row in enumerate(errors[150:], start=150):
        for name, error, side in zip(NAMES, row.tolist(), SIDES, strict=True):
            hear(learned, name, measured(side, error), k * 200_000_000, 0.01)
        learned.conclude(known(k * 200_000_000))
    assert {name: (m.bias_sd, m.scale) for name, m in twin.models.items()} == kept
    assert any(learned.models[n].bias_sd != kept[n][0] for n in NAMES)


def _measurements(seed: int, seconds: float, noise_sd: float, bias: Array) -> list[RsuMeasurement]:
    """Ranges of a device on an ellipse, with constant biases (5,) m."""
    rng, found = np.random.default_rng(seed), []
    for k in range(int(seconds * RATE_HZ)):
        t = k / RATE_HZ
        place = np.array([8.0 * math.cos(t / 8), 5.0 * math.sin(t / 8), 0.0])
        for i, rsu in enumerate(RSUS):
            value = float(np.linalg.norm(place - rsu) + bias[i] + rng.normal(0, noise_sd))
            found.append(_range(t, i, value, 0.1, sequence=k, expected=len(RSUS)))
    return found


def _range(t: float, i: int, value: float, stated_sd: float, **epoch: int) -> RsuMeasurement:
    """A range [m] of RSU i, t [s] after the start."""
    return RsuMeasurement(
        stamp_ns=round((1.0 + t) * 1e9),
        rsu_id=f"a{i}",
        vue_id="vue_1",
        fields=Field.RANGE,
        range_m=value,
        range_var=stated_sd**2,
        **epoch,  # type: ignore[arg-type]
    )


def _track(measurements: list[RsuMeasurement], **parameters: object) -> list[Odometry]:
    _, outputs = _outputs(measurements, **parameters)
    return [o.odometry for o in outputs if o.odometry is not None]


def _outputs(
    measurements: list[RsuMeasurement], **parameters: object
) -> tuple[Tracker, list[TrackOutput]]:
    tracker = Tracker(TrackerConfig(**{"accel_density_mps2_sqrthz": 0.3, **parameters}))  # type: ignore[arg-type]
    for i, rsu in enumerate(RSUS):
        tracker.add_rsu(RsuInfo(rsu_id=f"a{i}", position=rsu))
    outputs = []
    for m in measurements:
        tracker.add(m)
        outputs += tracker.process()
    outputs += tracker.flush()
    return tracker, outputs


def _scores(odometry: list[Odometry], from_s: float) -> tuple[float, float]:
    """RMSE [m] and mean NEES of the position."""
    errors, nees = [], []
    for o in odometry:
        t = o.stamp_ns * 1e-9 - 1.0
        if t < from_s:
            continue
        error = o.position[:2] - [8.0 * math.cos(t / 8), 5.0 * math.sin(t / 8)]
        errors.append(float(error @ error))
        nees.append(float(error @ np.linalg.solve(o.pose_cov[:2, :2], error)))
    return math.sqrt(np.mean(errors)), float(np.mean(nees))


@pytest.mark.parametrize("filter_name", ["iekf", "ekf", "ukf", "srukf"])
def test_biases_nobody_declared_are_learned_by_every_filter(filter_name: str) -> None:
    """Biases of 3 sd: believed, they are errors of the position; learned, they are not."""
    bias = np.array([0.3, -0.2, 0.25, -0.3, 0.1])
    measured = _measurements(7, 90.0, 0.1, bias)
    told = {"filter": filter_name}
    rmse, nees = _scores(_track(measured, **told), 30.0)
    learned_rmse, learned_nees = _scores(_track(measured, learn_errors=True, **told), 30.0)
    assert nees > 10.0
    assert learned_nees < 4.0
    assert learned_rmse < 0.8 * rmse


def test_a_late_measurement_ends_in_the_same_estimate_as_one_in_order() -> None:
    """What is learned is part of the state a track goes back to."""
    measured = _measurements(9, 40.0, 0.2, np.array([0.4, 0.0, -0.3, 0.2, 0.0]))
    late = list(measured)
    for k in range(50, len(late) - 20, 35):
        late.insert(k + 12, late.pop(k))
    parameters = {"learn_errors": True, "hold_s": 0.0, "history_s": 5.0, "isolate_rsus": False}
    in_order = _track(measured, **parameters)[-1]
    revised = _track(late, **parameters)[-1]
    assert revised.stamp_ns == in_order.stamp_ns
    np.testing.assert_array_equal(revised.position, in_order.position)
    np.testing.assert_array_equal(revised.pose_cov, in_order.pose_cov)


def in_turn(seed: int, noise_sd: float) -> list[RsuMeasurement]:
    """Ranges of a device on a circle, 1 m/s, to four RSUs 40 m away: four a second, two of each
    before the next one; 0.5 m is stated."""
    rng, found = np.random.default_rng(seed), []
    for k in range(4 * 240):
        t, i = k / 4.0, k // 2 % 4
        value = float(np.linalg.norm(on_circle(t) - FAR[i]) + rng.normal(0.0, noise_sd))
        found.append(_range(t, i, value, 0.5, sequence=k, expected=1))
    return found


FAR = np.array([[40.0, 0.0, 2.0], [0.0, 40.0, 2.0], [-40.0, 5.0, 2.0], [3.0, -40.0, 2.0]])


def on_circle(t: float) -> Array:
    return np.array([14.0 * math.cos(t / 14.0), 14.0 * math.sin(t / 14.0), 0.0])


@pytest.mark.parametrize("noise_sd", [0.25, 0.5, 1.0])
def test_rsus_that_are_heard_in_turn_check_each_other(noise_sd: float) -> None:
    """No second has the ranges of three, and every update is large: what it moved the estimate by
    must not count as an agreement."""
    nees, scatter = [], []
    for seed in range(2):
        tracker = Tracker(TrackerConfig(learn_errors=True))
        for i, site in enumerate(FAR):
            tracker.add_rsu(RsuInfo(rsu_id=f"a{i}", position=site))
        outputs = []
        for m in in_turn(seed, noise_sd):
            tracker.add(m)
            outputs += tracker.process()
        newest = {e.rsu_id: e for output in outputs for e in output.errors}
        scatter += [errors.scatter[0] for errors in newest.values()]
        for o in (output.odometry for output in outputs):
            if o is not None and o.stamp_ns > 61_000_000_000:
                error = (o.position - on_circle(o.stamp_ns * 1e-9 - 1.0))[:2]
                nees.append(float(error @ np.linalg.solve(o.pose_cov[:2, :2], error)))
    assert len(scatter) == 8
    assert 1.0 / 1.4 < np.mean(scatter) / (noise_sd / 0.5) < 1.4
    assert 1.0 < np.mean(nees) < 3.3


def test_what_is_learned_is_told_every_second() -> None:
    bias = np.array([0.8, 0.0, 0.0, 0.0, 0.0])
    tracker, outputs = _outputs(_measurements(4, 60.0, 0.3, bias), learn_errors=True)
    told = [errors for output in outputs for errors in output.errors]
    assert {errors.rsu_id for errors in told} == {"a0", "a1", "a2", "a3", "a4"}
    assert 55 * 5 <= len(told) <= 60 * 5
    newest = {errors.rsu_id: errors for errors in told}
    for name, expected in zip(sorted(newest), bias, strict=True):
        errors = newest[name]
        assert errors.quantities == ("RANGE",)
        assert abs(errors.bias[0] - expected) < 4.0 * errors.bias_sd[0]
        assert 0.7 < errors.scatter[0] / 3.0 < 1.15  # 0.3 m, stated as 0.1 m
    assert abs(newest["a0"].bias[0] - 0.8) < 0.3
    findings = {f.hardware_id: f for f in tracker.findings({}, {})}
    assert "m long, scatter " in findings["a0"].message
    assert "learned bias: RANGE" in findings["a1"].values


def test_nothing_is_told_where_nothing_is_learned() -> None:
    _, outputs = _outputs(_measurements(4, 10.0, 0.1, np.zeros(5)))
    assert not any(output.errors for output in outputs)


BIASED = np.array([0.3, -0.2, 0.25, -0.3, 0.1])


def _of_another(
    measured: list[RsuMeasurement], vue_id: str, after_s: float
) -> list[RsuMeasurement]:
    """The same measurements of another device, later."""
    return [
        replace(m, vue_id=vue_id, stamp_ns=m.stamp_ns + round(after_s * 1e9)) for m in measured
    ]


def _start_of_the_second(first: list[RsuMeasurement], seed: int, bias: Array) -> Array:
    """RMSE [m] and NEES in the first 15 s of a device that appears after 90 s."""
    second = _of_another(_measurements(seed, 15.0, 0.1, bias), "vue_2", 90.0)
    _, outputs = _outputs([*first, *second], learn_errors=True)
    found = [o.odometry for o in outputs if o.status.vue_id == "vue_2" and o.odometry is not None]
    return np.array(
        _scores([replace(o, stamp_ns=o.stamp_ns - 90_000_000_000) for o in found], 2.0)
    )


def test_a_device_takes_over_what_others_have_learned() -> None:
    """Of biases of 6 sd that nobody declared, it knows from the start how large they are."""
    alone, helped = [], []
    for seed in range(36):
        bias = np.random.default_rng(seed).normal(0.0, 0.6, 5)
        alone.append(_start_of_the_second([], seed, bias))
        first = _measurements(100 + seed, 90.0, 0.1, bias)
        helped.append(_start_of_the_second(first, seed, bias))
    assert np.mean(helped, axis=0)[1] < 0.9 * np.mean(alone, axis=0)[1]
    # RMSE: no worse than chance makes it, seed by seed.
    worse = np.subtract(helped, alone)[:, 0]
    assert worse.mean() < 2.0 * worse.std(ddof=1) / math.sqrt(worse.size)


@pytest.mark.parametrize(("noise_sd", "is_taken"), [(0.1, True), (0.2, False)])
def test_what_is_learned_in_another_unit_is_not_taken_over(
    noise_sd: float, is_taken: bool
) -> None:
    """Candidates of biases are in units of the noise stated, where no bias is declared."""
    shared, name = SharedErrors(settle_s=2.0), NAMES[0]
    first = learned_of(slow_and_white(3, 60, 0.1, 0.5, 30.0), 0.1).models[name]
    shared.note(("vue_1", 1), 60_000_000_000, name, first)
    alone = LearnedErrors().model(name, noise_sd, 0.0, 0.0)
    later = LearnedErrors(shared, ("vue_2", 1)).model(name, noise_sd, 0.0, 0.0, 90_000_000_000)
    assert (later.bias_sd > 1.5 * alone.bias_sd) is is_taken
    assert (later.gate_scale != alone.gate_scale) is is_taken


def test_what_is_shared_does_not_depend_on_the_order_of_arrival() -> None:
    """Two devices at once, one of them late by up to a second."""
    both = [_measurements(seed, 40.0, 0.1, BIASED) for seed in (7, 8)]
    other = _of_another(both[1], "vue_2", 0.05)
    in_order = sorted([*both[0], *other], key=lambda m: m.stamp_ns)
    late = sorted(
        [*both[0], *other], key=lambda m: m.stamp_ns + (m.vue_id == "vue_2") * 900_000_000
    )
    ends = []
    for measured in (in_order, late):
        _, outputs = _outputs(measured, learn_errors=True, history_s=2.0, isolate_rsus=False)
        newest = {o.status.vue_id: o.odometry for o in outputs if o.odometry is not None}
        ends.append(newest)
    for vue_id in ("vue_1", "vue_2"):
        np.testing.assert_array_equal(ends[0][vue_id].position, ends[1][vue_id].position)
        np.testing.assert_array_equal(ends[0][vue_id].pose_cov, ends[1][vue_id].pose_cov)


def test_a_track_that_is_lost_keeps_what_it_has_learned() -> None:
    measured = _measurements(7, 90.0, 0.1, BIASED)
    again = _of_another(_measurements(8, 15.0, 0.1, BIASED), "vue_1", 300.0)  # beyond max_gap_s
    _, outputs = _outputs([*measured, *again], learn_errors=True, max_gap_s=60.0)
    told = [errors for o in outputs if o.status.stamp_ns > 301_000_000_000 for errors in o.errors]
    fresh = [errors for o in _outputs(again, learn_errors=True)[1] for errors in o.errors]
    first, alone = (
        {e.rsu_id: e.bias_spread[0] for e in reversed(found)} for found in (told, fresh)
    )
    assert np.mean(list(first.values())) > 1.3 * np.mean(list(alone.values()))


@pytest.mark.parametrize(
    ("name", "value"),
    [("motion_model", "strapdown"), ("motion_model", "interacting")],
)
def test_learning_is_refused_where_there_is_none(name: str, value: str) -> None:
    with pytest.raises(ValueError, match=r"learn_errors.*set it to false"):
        TrackerConfig(**{"learn_errors": True, "filter": "ekf", name: value})  # type: ignore[arg-type]
