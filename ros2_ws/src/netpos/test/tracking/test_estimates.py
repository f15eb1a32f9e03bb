"""Every filter and motion model behind one interface."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from filterpy_estimate import FilterpyEstimate
from netpos.estimation.engine import Epochs, empty_run
from netpos.estimation.mixture.epoch import run_epochs
from netpos.estimation.mixture.gaussians import Mixture, moments
from netpos.estimation.motion import NO_BIAS
from netpos.estimation.rows import linear_rows
from netpos.estimation.state import POSITION, X
from netpos.messages.values import Array, Field, GroundSpeed, ImuSample
from netpos.tracking import TrackerConfig, TrackOutput
from netpos.tracking.estimators import estimates
from netpos.tracking.estimators.models import augmented, dynamics_of, initial_extra_sd, options_of
from scipy import stats

T0 = 1_000_000_000
RUNNABLE = [
    (name, model)
    for name in ("ekf", "iekf", "ukf", "srukf", "kf")
    for model in (
        "constant_velocity",
        "constant_turn",
        "constant_acceleration",
        "interacting",
        "inertial",
    )
]


def truth(t_s: float) -> Array:
    """North-east along the street at 5 m/s; clock 8 m off, gaining 7495 m/s."""
    return np.array([20 + 4 * t_s, -3 + 3 * t_s, 4.0, 3.0, 8 + 7495 * t_s, 7495.0])


def still_imu(t_s: float) -> ImuSample:
    """Straight on at constant speed."""
    return ImuSample(
        stamp_ns=T0 + round(t_s * 1e9),
        vue_id="vue_1",
        angular_velocity=np.zeros(3),
        specific_force=np.array([0.0, 0.0, 9.80665]),
    )


def track(world: Any, seed: int, fields: Field, **config: Any) -> tuple[Any, list[TrackOutput]]:
    """Ten seconds, IMU and RSUs in stamp order."""
    world.rng = np.random.default_rng(seed)
    tracker, outputs = world.tracker(**config), []
    for k in range(100):
        for i in range(10):
            assert tracker.add(still_imu(0.1 * k + 0.01 * i)) is None
        for m in world.measure(0.1 * k, truth(0.1 * k), fields):
            assert tracker.add(m) is None
        outputs += tracker.process()
    return tracker, outputs + tracker.flush()


@pytest.mark.parametrize(("name", "model"), RUNNABLE)
def test_every_filter_tracks_with_every_model(world: Any, name: str, model: str) -> None:
    """At the end position, velocity and clock are within 4 sd, and the sd is what it may be."""
    fields = Field.POSITION if name == "kf" else Field.AZIMUTH | Field.TOA
    tracker, outputs = track(world, 3, fields, filter=name, motion_model=model)
    estimate = tracker._tracks["vue_1"]._state.estimator.estimate
    size = {"constant_velocity": 6, "constant_turn": 7, "interacting": 7}.get(model, 8)
    assert estimate.mean.size == size
    true = truth((estimate.stamp_ns - T0) * 1e-9)
    count = 4 if name == "kf" else 6
    error, sd = (estimate.mean[:6] - true)[:count], np.sqrt(np.diag(estimate.cov))[:count]
    assert (np.abs(error) < 4.0 * sd).all(), (error, sd)
    assert (sd[:2] < 0.5).all()
    assert (sd[2:4] < 1.5).all()
    np.linalg.cholesky(estimate.cov)
    np.testing.assert_allclose(estimate.cov, estimate.cov.T, rtol=1e-9, atol=1e-12)
    status = outputs[-1].status
    assert status.accepted > 285
    assert status.nis_dof == 6


@pytest.mark.parametrize("name", ["ekf", "ukf"])
@pytest.mark.parametrize(
    "model", ["constant_velocity", "constant_turn", "constant_acceleration", "inertial"]
)
def test_filterpy_says_the_same(
    world: Any, name: str, model: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every epoch of a track with biases, outliers and a ground speed, and one component."""
    slow = {"range_bias_sd_m": 0.3, "bias_correlation_time_s": 30.0}
    world.rsus = {n: replace(info, **slow) for n, info in world.rsus.items()}
    found = {}
    for algebra, start in (("ours", estimates.Estimate), ("filterpy", FilterpyEstimate)):
        monkeypatch.setattr(estimates, "Estimate", start)
        world.rng = np.random.default_rng(8)
        tracker = world.tracker(
            filter=name,
            motion_model=model,
            manoeuvre_speed_sd_mps=0.0,
            accel_density_mps2_sqrthz=0.5,
            clock_walk_density=5e-7,
            isolate_rsus=False,  # the first fix is one component
            clock_offset_sd_s=3e-8,
            clock_drift_sd=1e-8,
        )
        outputs = []
        for k in range(60):
            t = 0.1 * k
            items: list[Any] = [still_imu(t)]
            items += world.measure(t, truth(t), Field.AZIMUTH | Field.TOA)
            if k % 9 == 4:
                items[1] = replace(items[1], azimuth_rad=items[1].azimuth_rad + 1.0)
            if k % 4 == 0 and k:
                items.append(
                    GroundSpeed(
                        stamp_ns=items[0].stamp_ns, vue_id="vue_1", speed_mps=5.0, speed_var=0.04
                    )
                )
            for item in items:
                assert tracker.add(item) is None
            outputs += tracker.process()
        outputs += tracker.flush()
        rows = []
        for o in outputs:
            if o.odometry is not None:
                parts = [o.odometry.position[:2], o.odometry.linear_velocity[:2]]
                covs = (o.odometry.pose_cov, o.odometry.twist_cov)
                parts += [cov[POSITION, POSITION].ravel() for cov in covs]
                parts += [[o.clock.offset_s * 3e8], o.clock.cov.ravel() * 9e16]
                rows.append(np.concatenate([*parts, [o.status.nis, o.status.nis_dof]]))
        found[algebra] = np.array(rows), outputs[-1].status
    ours, reference = found["ours"], found["filterpy"]
    assert len(ours[0]) > 55
    assert ours[1].rejected == reference[1].rejected
    assert ours[1].rejected["gate"] >= 5
    scale = np.maximum(np.abs(reference[0]).max(axis=0), 1e-3)
    np.testing.assert_allclose(ours[0] / scale, reference[0] / scale, rtol=0.0, atol=1e-9)


KINDS: dict[str, dict[str, Any]] = {
    "ekf": {"filter": "ekf"},
    "srukf": {"filter": "srukf"},
    "inertial": {"motion_model": "inertial"},
    "interacting": {"motion_model": "interacting"},
}


def started(name: str) -> estimates.Estimate:
    cov = np.diag([1.0, 1.0, 4.0, 4.0, 9.0, 1.0])
    mean = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    return estimates.Estimate(TrackerConfig(**KINDS[name]), T0, mean, cov)


def fix(x: float, y: float) -> Array:
    return linear_rows(np.array([x, y]), 0.25 * np.eye(2), np.eye(2, 6), 0)


@pytest.mark.parametrize("name", KINDS)
def test_it_starts_where_it_is_told(name: str) -> None:
    estimate = started(name)
    assert estimate.stamp_ns == T0
    np.testing.assert_allclose(estimate.mean[:6], [1, 2, 3, 4, 5, 6], rtol=1e-14)
    np.testing.assert_allclose(np.diag(estimate.cov)[:6], [1, 1, 4, 4, 9, 1], rtol=1e-12)
    assert not estimate.mean[6:].any()


@pytest.mark.parametrize("name", KINDS)
def test_a_copy_is_independent(name: str) -> None:
    """What happens to either leaves the other where it was, and both go the same way."""
    estimate = started(name)
    estimate.step(T0 + 10**8, 0.1, 0, fix(1.4, 2.4), NO_BIAS)
    twin = estimate.copy()
    kept = (estimate.stamp_ns, estimate.mean.copy(), estimate.cov.copy())

    def onward(e: estimates.Estimate) -> tuple[Array, Array]:
        if name == "inertial":
            e.set_imu_increment(0.3, 1.0, 0.01)
        e.step(T0 + 3 * 10**8, 0.2, 0, fix(2.0, 3.0), NO_BIAS)
        e.predict(T0 + 4 * 10**8, NO_BIAS)
        e.augment(np.append(np.zeros(e.mean.size - 6), 0.7))
        return e.mean.copy(), e.cov.copy()

    moved = onward(twin)
    assert (estimate.stamp_ns, twin.stamp_ns) == (T0 + 10**8, T0 + 4 * 10**8)
    np.testing.assert_array_equal(estimate.mean, kept[1])
    np.testing.assert_array_equal(estimate.cov, kept[2])
    for got, want in zip(onward(estimate), moved, strict=True):
        np.testing.assert_array_equal(got, want)


@pytest.mark.parametrize("name", KINDS)
def test_bias_states_grow_and_stay_stationary(name: str) -> None:
    estimate = started(name)
    extras = estimate.mean.size - 6
    before = estimate.cov.copy()
    for sd in ([0.5], [0.5, 2.0], [0.5, 2.0]):
        estimate.augment(np.append(np.zeros(extras), sd))
    n = 6 + extras
    assert estimate.mean.size == n + 2
    np.testing.assert_allclose(np.diag(estimate.cov)[n:], [0.25, 4.0], rtol=1e-12)
    np.testing.assert_allclose(estimate.cov[:n, :n], before, rtol=1e-12)
    bias = np.array([[0.5, 2.0], [3.0, 50.0]])
    for k in range(1, 6):
        estimate.predict(T0 + k * 10**9, bias)
    np.testing.assert_allclose(np.diag(estimate.cov)[n:], [0.25, 4.0], rtol=1e-9)
    assert np.abs(estimate.cov[:n, n:]).max() < 1e-9
    np.testing.assert_allclose(estimate.mean[n:], 0.0, atol=1e-14)  # rounding of fused products


@pytest.mark.parametrize("name", KINDS)
def test_step_keeps_the_prediction_and_what_it_accepted(name: str) -> None:
    estimate, ahead = started(name), started(name)
    ahead.predict(T0 + 10**9, NO_BIAS)
    far = np.vstack([fix(4.0, 6.0), fix(900.0, 6.0)])
    far[2:, 6] = 1
    step = estimate.step(T0 + 10**9, 1.0, 0, far, NO_BIAS)
    assert step.accepted == [1.0, 0.0]
    assert step.dof == 2
    assert 0.0 <= step.nis < 1.0
    np.testing.assert_allclose(estimate.prior[0], ahead.mean, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(estimate.prior[1], ahead.cov, rtol=1e-12, atol=1e-15)
    # models that interact: to the stop, 20 times its variance away, the fix may be an outlier
    mixture = estimate._components if name == "interacting" else None  # type: ignore[attr-defined]
    cov = estimate.cov if mixture is None else mixture.covs[np.argmax(mixture.log_weights)]
    assert cov[X.PX, X.PX] < 0.3 < ahead.cov[X.PX, X.PX]
    # nothing accepted: the prediction it is
    refused = started(name)
    step = refused.step(T0 + 10**9, 1.0, 0, fix(900.0, 6.0), NO_BIAS)
    assert (step.dof, step.accepted) == (0, [0.0])
    mean, cov = ahead.mean, ahead.cov
    if name == "interacting":  # an outlier is likelier the nearer it is to what a model predicts
        parts = ahead._components  # type: ignore[attr-defined]
        off = np.abs([900.0, 6.0] - parts.means[:, :2])
        sd = np.sqrt(0.25 + np.diagonal(parts.covs, axis1=1, axis2=2)[:, :2])
        log_weights = parts.log_weights - np.log(np.maximum(off, sd)).sum(axis=1)
        mean, cov = moments(Mixture(parts.means, parts.covs, log_weights))
    np.testing.assert_allclose(refused.mean, mean, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(refused.cov, cov, rtol=1e-12, atol=1e-15)


def test_many_rows_need_no_warning() -> None:
    """More rows than there was room for, and then fewer again."""
    estimate = started("ekf")
    rows = np.vstack([fix(1.0, 2.0) for _ in range(30)])
    rows[:, 6] = np.repeat(np.arange(30), 2)
    step = estimate.step(T0, 0.0, 0, rows, NO_BIAS)
    assert (step.dof, sum(step.accepted)) == (60, 30)
    assert estimate.cov[X.PX, X.PX] == pytest.approx(1.0 / (1.0 + 30 / 0.25))
    step = estimate.step(T0, 0.0, 0, fix(1.0, 2.0), NO_BIAS)
    assert (step.dof, step.accepted) == (2, [1.0])


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"filter": "best"}, "filter must be one of ekf, iekf, ukf, srukf, kf, got 'best'"),
        ({"motion_model": "flying"}, "motion_model must be one of constant_velocity, .*'flying'"),
        ({"robust": "l1"}, "robust must be one of none, huber, student_t, got 'l1'"),
    ],
)
def test_bad_combinations(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        TrackerConfig(**values)


@pytest.mark.parametrize("name", ["ekf", "srukf", "ukf"])
def test_interacting_models_in_one_kernel_are_the_same(name: str) -> None:
    """``run_epochs`` and the estimate, epoch by epoch, with an outlier and a silence."""
    config = TrackerConfig(filter=name, motion_model="interacting", robust="huber")
    cov = np.diag([1.0, 1.0, 4.0, 4.0, 9.0, 1.0])
    mean = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    estimate = estimates.Estimate(config, T0, mean, cov)
    times = np.array([0.0, 0.1, 0.2, 0.3, 1.9, 2.0])
    stamps = T0 + np.round(times * 1e9).astype(np.int64)
    rows = [fix(1.0 + 3.0 * t + 500.0 * (t == 0.2), 2.0 + 4.0 * t) for t in times]
    run = empty_run(6, 7)
    epochs = Epochs(stamps, np.arange(0, 14, 2), np.vstack(rows))
    done = run_epochs(
        epochs,
        *augmented(mean, cov, initial_extra_sd(config)),
        dynamics_of(config, NO_BIAS),
        options_of(config),
        run,
    )
    assert done == 6
    heard, rejected = T0, 0
    for k, stamp in enumerate(stamps.tolist()):
        part = rows[k].copy()
        step = estimate.step(stamp, (stamp - heard) * 1e-9, rejected, part, NO_BIAS)
        heard, rejected = (stamp, 0) if any(step.accepted) else (heard, rejected + 1)
        assert (run.nis[k], run.dof[k], run.undetected_m[k]) == (
            step.nis,
            step.dof,
            step.undetected_m,
        )
        np.testing.assert_array_equal(run.means[k], estimate.mean)
        np.testing.assert_array_equal(run.covs[k], estimate.cov)
        assert run.radius[k] == estimate.radius(0.0)
    assert run.dof.tolist() == [2, 2, 0, 2, 2, 2]


def of_two(apart_m: float, weights: tuple[float, float] = (0.5, 0.5), sd_m: float = 1.0) -> Any:
    """An estimate of two round components."""
    means, covs = np.zeros((2, 6)), np.tile(np.diag([sd_m**2, sd_m**2, 1, 1, 1, 1]), (2, 1, 1))
    means[1, X.PX] = apart_m
    return estimates.start_from(TrackerConfig(), 0, Mixture(means, covs, np.log(weights)))


@pytest.mark.parametrize("apart_m", [2.0, 5.0, 6.3, 6.6, 20.0])
def test_the_mean_of_two_is_a_place_while_they_are_near(apart_m: float) -> None:
    """Against the densities of SciPy: half the way from two components, and at one of them."""
    places = np.array([[apart_m / 2.0, 0.0], [0.0, 0.0]])
    density = sum(stats.multivariate_normal.pdf(places, mean=[x, 0.0]) for x in (0.0, apart_m))
    expected = density[0] / density[1] > np.exp(-4.5)
    assert of_two(apart_m).is_at_a_place == expected
    assert expected == (apart_m < np.sqrt(8.0 * (4.5 + np.log(2.0))))


def test_a_component_of_little_weight_moves_no_estimate_away() -> None:
    estimate = of_two(20.0, (0.999, 0.001))
    assert estimate.is_at_a_place
    np.testing.assert_array_equal(estimate.likeliest[0], np.zeros(6))


def test_components_that_are_certain_have_places() -> None:
    assert not of_two(20.0, sd_m=0.0).is_at_a_place
