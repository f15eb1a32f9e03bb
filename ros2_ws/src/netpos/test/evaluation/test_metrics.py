"""Figures against evo, hand-made numbers and boundaries."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from evo.core import sync
from evo.core.metrics import APE, PoseRelation, StatisticsType
from evo.core.trajectory import PoseTrajectory3D
from netpos.evaluation.metrics import (
    Figures,
    Run,
    Scored,
    score,
    time_to_converge,
)
from netpos.evaluation.pairing import ClockOffsets, Pairs, Trajectory
from netpos.messages.values import Array, ClockState, Odometry, TrackState, TrackStatus

S = 1_000_000_000


def pose(
    t_s: float, x: float, y: float = 0.0, *, speed: float = 1.0, yaw: float = 0.0
) -> Odometry:
    return Odometry(
        stamp_ns=round(t_s * S),
        vue_id="vue_1",
        position=np.array([x, y, 0.0]),
        quaternion=np.array([0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)]),
        linear_velocity=np.array([speed, 0.0, 0.0]),
    )


def status(t_s: float, state: TrackState, **values: object) -> TrackStatus:
    return TrackStatus(stamp_ns=round(t_s * S), vue_id="vue_1", state=state, **values)  # type: ignore[arg-type]


def run_of(truth: list[Odometry], estimate: list[Odometry], **values: object) -> Run:
    return Run(truth=Trajectory.of(truth), estimate=Trajectory.of(estimate), **values)  # type: ignore[arg-type]


def straight(n: int, dt_s: float = 0.1) -> list[Odometry]:
    return [pose(k * dt_s, k * dt_s) for k in range(n)]


def moved(original: Odometry, east: float, north: float) -> Odometry:
    return replace(original, position=original.position + np.array([east, north, 0.0]))


def evo_path(poses: list[Odometry]) -> PoseTrajectory3D:
    return PoseTrajectory3D(
        positions_xyz=np.array([p.position for p in poses]),
        orientations_quat_wxyz=np.array([np.roll(p.quaternion, 1) for p in poses]),
        timestamps=np.array([p.stamp_ns / S for p in poses]),
    )


def test_position_figures_agree_with_evo() -> None:
    """evo 1.38: association with interpolation, absolute pose error, translation part."""
    rng = np.random.default_rng(4)
    t = np.arange(0.0, 30.0, 0.05)
    truth = [pose(ti, 20 * np.cos(ti / 5), 20 * np.sin(ti / 5)) for ti in t]
    t_est = np.sort(rng.uniform(0.01, 29.9, 250))
    estimate = [
        pose(ti, 20 * np.cos(ti / 5) + dx, 20 * np.sin(ti / 5) + dy)
        for ti, (dx, dy) in zip(t_est, rng.normal(size=(250, 2)), strict=True)
    ]
    reference, estimated = sync.associate_trajectories(
        evo_path(truth),
        evo_path(estimate),
        sync_method=sync.SyncMethod.interpolation,
        max_diff=0.1,
    )
    ape = APE(PoseRelation.translation_part)
    ape.process_data((reference, estimated))
    figures = score(run_of(truth, estimate), skip=0).figures
    assert figures.n == ape.error.size == 250
    assert figures.rmse_m == pytest.approx(ape.get_statistic(StatisticsType.rmse), abs=1e-6)
    assert figures.mean_error_m == pytest.approx(ape.get_statistic(StatisticsType.mean), abs=1e-6)
    assert figures.p50_m == pytest.approx(ape.get_statistic(StatisticsType.median), abs=1e-6)
    assert figures.max_m == pytest.approx(ape.get_statistic(StatisticsType.max), abs=1e-6)
    assert figures.p95_m == pytest.approx(np.quantile(ape.error, 0.95), abs=1e-6)


def test_the_papers_rmse_is_the_mean_error() -> None:
    """fokin2020:eq.34 with errors of 3 m and 5 m: mean 4 m, root mean square sqrt(17) m."""
    truth = [pose(0, 0), pose(1, 0)]
    figures = score(run_of(truth, [pose(0, 3), pose(1, 3, 4)]), skip=0).figures
    assert figures.mean_error_m == pytest.approx(4.0)
    assert figures.rmse_m == pytest.approx(np.sqrt(17.0))


def test_height_counts_in_3d_only() -> None:
    high = replace(pose(0, 3), position=np.array([3.0, 0.0, 4.0]))
    figures = score(run_of([pose(0, 0), pose(1, 0)], [high]), skip=0).figures
    assert (figures.rmse_m, figures.rmse_3d_m) == (pytest.approx(3.0), pytest.approx(5.0))


def test_north_east_and_down_are_the_axes_of_map() -> None:
    """Errors of 3 m east, 1 m north, 4 m up, and none at the second epoch."""
    off = replace(pose(0, 3), position=np.array([3.0, 1.0, 4.0]))
    figures = score(run_of([pose(0, 0), pose(1, 0)], [off, pose(1, 0)]), skip=0).figures
    root = np.sqrt(0.5)
    axes = (figures.north_rmse_m, figures.east_rmse_m, figures.down_rmse_m)
    assert axes == pytest.approx((root, 3 * root, 4 * root))


def test_skipped_estimates_do_not_count() -> None:
    truth = straight(41)
    estimate = [moved(p, 0.0, 100.0 if k < 20 else 1.0) for k, p in enumerate(truth)]
    figures = score(run_of(truth, estimate), skip=20).figures
    assert (figures.n, figures.skipped, figures.estimates) == (21, 20, 41)
    assert figures.max_m == pytest.approx(1.0)
    assert score(run_of(truth, estimate), skip=19).figures.max_m == pytest.approx(100.0)


def test_a_track_is_scored_from_its_first_tracking_state() -> None:
    """What comes before says that it is metres off; what comes after, lost or not, counts."""
    truth = straight(60)
    estimate = [
        moved(p, 0.0, 100.0 if k < 30 else 7.0 if k == 40 else 1.0) for k, p in enumerate(truth)
    ]
    tracking = [k >= 30 and k != 40 for k in range(60)]
    statuses = [
        status(0.1 * k, TrackState.TRACKING if tracking[k] else TrackState.INITIALISING)
        for k in range(60)
    ]
    figures = score(run_of(truth, estimate, statuses=statuses), skip=20).figures
    assert (figures.n, figures.skipped, figures.initialising) == (30, 20, 30)
    assert figures.max_m == pytest.approx(7.0)
    later = score(run_of(truth, estimate, statuses=statuses), skip=45).figures
    assert (later.n, later.skipped, later.initialising) == (15, 45, 30)
    assert later.max_m == pytest.approx(1.0)


def test_a_track_that_is_never_ready_has_no_score() -> None:
    statuses = [status(0.1 * k, TrackState.INITIALISING) for k in range(40)]
    figures = score(run_of(straight(40), straight(40), statuses=statuses)).figures
    assert (figures.n, figures.initialising, figures.rmse_m) == (0, 40, None)
    unknown = score(run_of(straight(40), straight(40))).figures
    assert (unknown.n, unknown.initialising) == (20, 0)


def test_velocity_is_compared_in_map_axes() -> None:
    """A right speed of 3 m/s under a heading wrong by 90 degrees is an error of 3 sqrt 2."""
    truth = [pose(0, 0, speed=3.0), pose(1, 3, speed=3.0)]
    figures = score(run_of(truth, [pose(0, 0, speed=3.0, yaw=np.pi / 2)]), skip=0).figures
    assert figures.velocity_rmse_mps == pytest.approx(3.0 * np.sqrt(2.0))
    assert figures.heading_rmse_deg == pytest.approx(90.0)


@pytest.mark.parametrize(("speed", "known"), [(0.5, False), (0.51, True)])
def test_heading_and_way_count_only_in_motion(speed: float, known: bool) -> None:
    truth = [pose(0, 0, speed=speed), pose(1, 0, speed=speed)]
    figures = score(run_of(truth, [pose(0.5, 0, yaw=0.1)]), skip=0).figures
    assert (figures.heading_rmse_deg is not None) is known
    assert (figures.along_rmse_m is not None) is known


def test_errors_along_the_way_and_across_it() -> None:
    """The device goes north-east. Its estimate is 3 m ahead with an sd of 1 m, and 0.5 m to the
    left with an sd of 0.25 m."""
    truth = [pose(0.1 * k, 0.2 * k, 0.2 * k, yaw=np.pi / 4, speed=2.8) for k in range(5)]
    turn = np.array([[1.0, -1.0], [1.0, 1.0]]) / np.sqrt(2.0)
    cov: Array = np.eye(6)
    cov[:2, :2] = turn @ np.diag([1.0, 0.0625]) @ turn.T
    estimate = [replace(moved(p, *(turn @ [3.0, 0.5])), pose_cov=cov) for p in truth]
    figures = score(run_of(truth, estimate), skip=0).figures
    assert figures.along_rmse_m == pytest.approx(3.0)
    assert figures.across_rmse_m == pytest.approx(0.5)
    assert figures.along_nees == pytest.approx(9.0)
    assert figures.across_nees == pytest.approx(4.0)


def test_an_error_of_no_variance_has_no_nees() -> None:
    truth = [pose(0, 0, speed=1.0), pose(1, 1, speed=1.0)]
    figures = score(run_of(truth, [replace(pose(0.5, 0.7), pose_cov=np.zeros((6, 6)))]), skip=0)
    assert figures.figures.along_rmse_m == pytest.approx(0.2)
    assert figures.figures.along_nees is None


def test_heading_error_wraps() -> None:
    truth = [pose(0, 0, yaw=np.pi - 0.01), pose(1, 0, yaw=np.pi - 0.01)]
    figures = score(run_of(truth, [pose(0, 0, yaw=-np.pi + 0.01)]), skip=0).figures
    assert figures.heading_rmse_deg == pytest.approx(np.rad2deg(0.02))


def test_clock_sd_is_about_the_mean_and_rmse_about_zero() -> None:
    truth = straight(5)
    known = [
        ClockState(stamp_ns=p.stamp_ns, vue_id="vue_1", offset_s=1e-5 * k, drift=0.0)
        for k, p in enumerate(truth)
    ]
    errors_ns = [10.0, 14.0, 10.0, 14.0, 12.0]
    clock = [
        replace(c, offset_s=c.offset_s + error * 1e-9)
        for c, error in zip(known, errors_ns, strict=True)
    ]
    figures = score(
        run_of(truth, truth, clock=ClockOffsets.of(clock), clock_truth=ClockOffsets.of(known)),
        skip=1,
    ).figures
    kept = np.array(errors_ns[1:])
    assert figures.clock_offset_sd_ns == pytest.approx(kept.std(), rel=1e-6)
    assert figures.clock_offset_rmse_ns == pytest.approx(np.sqrt(np.mean(kept**2)), rel=1e-6)


def converging(errors: list[float], dt_s: float = 0.25) -> Pairs:
    truth = Trajectory.of([pose(k * dt_s, 0.0) for k in range(len(errors))])
    position = np.array([[error, 0.0, 0.0] for error in errors]).reshape(-1, 3)
    return Pairs(estimate=replace(truth, position=position), truth=truth)


@pytest.mark.parametrize(
    ("errors", "expected_s"),
    [
        ([5, 1, 1, 1, 1, 1], 0.25),
        ([5, 1, 1, 1, 1], None),
        ([0.5, 0.5, 1.01, 0.2, 0.2, 0.2, 0.2, 0.2], 0.75),
        ([], None),
    ],
)
def test_convergence_needs_a_whole_second(errors: list[float], expected_s: float | None) -> None:
    converged_ns = time_to_converge(converging(errors))
    assert converged_ns == (None if expected_s is None else round(expected_s * S))


def test_a_pause_is_no_convergence() -> None:
    assert time_to_converge(converging([0.1, 0.1, 0.1], dt_s=1.5)) is None


def test_initial_times_count_from_the_start_of_the_truth() -> None:
    truth = straight(60)
    statuses = [
        status(0.1 * k, TrackState.INITIALISING if k < 30 else TrackState.TRACKING)
        for k in range(20, 60)
    ]
    initial = score(run_of(truth, truth[20:], statuses=statuses)).figures.initial
    assert initial.time_to_first_fix_s == pytest.approx(2.0)
    assert initial.time_to_ready_s == pytest.approx(3.0)
    assert initial.time_to_1m_s == pytest.approx(2.0)


def test_rejections_are_the_last_count() -> None:
    statuses = [
        status(0.0, TrackState.TRACKING, rejected={"gate": 1}),
        status(0.1, TrackState.TRACKING, rejected={"gate": 2, "late": 5}),
    ]
    figures = score(run_of(straight(3), straight(3), statuses=statuses), skip=0).figures
    assert figures.rejected == 7
    assert figures.rejected_by_reason == {"gate": 2, "late": 5}


def test_nis_ignores_epochs_without_measurements() -> None:
    statuses = [
        status(0.0, TrackState.TRACKING, nis=3.0, nis_dof=2),
        status(0.1, TrackState.TRACKING, nis=0.0, nis_dof=0),
        status(0.2, TrackState.TRACKING, nis=6.0, nis_dof=4),
    ]
    figures = score(run_of(straight(3), straight(3), statuses=statuses), skip=0).figures
    assert (figures.nis_mean, figures.nis_dof_mean) == (4.5, 3.0)


UNKNOWN = (
    "rmse_m", "mean_error_m", "p50_m", "p95_m", "p99_m", "max_m", "velocity_rmse_mps",
    "heading_rmse_deg", "clock_offset_sd_ns", "clock_offset_rmse_ns", "nees_mean", "nees_bounds",
    "nees_consistent", "nis_mean", "rejected", "bound_ratio", "duration_s",
)  # fmt: skip


@pytest.mark.parametrize("estimate", [[], straight(3)])
def test_what_cannot_be_computed_is_none(estimate: list[Odometry]) -> None:
    """No estimates, or none left after the skipped ones."""
    figures = score(run_of(straight(30), estimate), skip=20).figures
    assert figures.n == 0
    assert {name: getattr(figures, name) for name in UNKNOWN} == dict.fromkeys(UNKNOWN)


def test_one_sample() -> None:
    figures = score(run_of(straight(30), [pose(1.0, 1.5)]), skip=0).figures
    assert (figures.n, figures.duration_s) == (1, 0.0)
    assert figures.rmse_m == figures.p99_m == pytest.approx(0.5)
    assert figures.output_rate_hz is None
    assert figures.clock_offset_sd_ns is None


def test_estimates_in_a_gap_of_the_truth_are_counted_not_scored() -> None:
    truth = straight(11) + [pose(5.0 + 0.1 * k, 5.0 + 0.1 * k) for k in range(11)]
    figures = score(
        run_of(truth, [pose(0.5, 0.5), pose(3.0, 9.0), pose(5.5, 5.5)]), skip=0
    ).figures
    assert (figures.n, figures.in_truth_gap) == (2, 1)
    assert figures.max_m == pytest.approx(0.0, abs=1e-12)


def nees_run(n: int, sd: float, claimed_sd: float) -> Scored:
    rng = np.random.default_rng(8)
    truth = straight(n)
    cov: Array = np.eye(6) * claimed_sd**2
    estimate = [replace(moved(p, *(rng.normal(size=2) * sd)), pose_cov=cov) for p in truth]
    return score(run_of(truth, estimate), skip=0)


@pytest.mark.parametrize(("claimed_sd", "consistent"), [(0.5, True), (0.3, False), (0.9, False)])
def test_nees_tells_an_honest_covariance(claimed_sd: float, consistent: bool) -> None:
    figures: Figures = nees_run(400, 0.5, claimed_sd).figures
    assert figures.nees_consistent is consistent
    assert figures.nees_n == 400


def test_no_truth_is_an_error() -> None:
    with pytest.raises(ValueError, match="no ground truth"):
        score(run_of([], straight(3)))


def test_skip_must_not_be_negative() -> None:
    with pytest.raises(ValueError, match="skip must be >= 0, got -1"):
        score(run_of(straight(3), straight(3)), skip=-1)


def test_errors_above_the_protection_level_are_counted() -> None:
    """Of ten estimates 0.3 m off one has a level below that, one none and one no status."""
    truth = straight(10)
    estimate = [moved(o, 0.3, 0.0) for o in truth]
    levels = [0.2, -1.0, *([0.5] * 7)]
    statuses = [
        status(0.1 * k, TrackState.TRACKING, protection_level_m=level)
        for k, level in enumerate(levels)
    ]
    figures = score(run_of(truth, estimate, statuses=statuses), skip=0).figures
    assert figures.protection_exceeded == pytest.approx(1 / 8)
    assert figures.protection_level_m == 0.5
    figures = score(run_of(truth, estimate), skip=0).figures
    assert figures.protection_exceeded is None
    assert figures.protection_level_m is None
