"""Sums over runs against NumPy on the runs themselves; many seeds on any number of processes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from netpos.estimation.state import POSITION, VELOCITY, X
from netpos.evaluation.consistency import nees
from netpos.evaluation.work import Work
from netpos.messages.values import Beacon, ImuSample, InitialPose
from netpos.reproduction.experiment import Experiment, Setup, Track
from netpos.reproduction.monte_carlo import (
    BINS,
    Batch,
    NothingScoredError,
    Summary,
    monte_carlo,
    tally,
)
from netpos.tracking import Tracker
from scipy.stats import norm

C = 299_792_458.0
SKIP = 20
METIS = Experiment(
    name="METIS", scenario="metis_madrid", changes=(("devices.0.beacon_interval_s", 0.08365),)
)


def _track(seed: int, epochs: int) -> Track:
    """Random errors of known size about a random truth."""
    rng = np.random.default_rng(seed)
    truth = rng.normal(size=(epochs, 6)) * [100.0, 100.0, 3.0, 3.0, 1e4, 100.0]
    truth[5, VELOCITY] = 0.1, 0.2  # too slow to have a heading
    sd = np.array([0.5, 0.2, 0.3, 0.3, 0.4, 1.0])
    mix = np.eye(6)
    mix[1, 0] = 0.6
    cov = mix @ np.diag(sd**2) @ mix.T
    mean = truth + rng.normal(size=(epochs, 6)) * sd @ mix.T
    return Track(
        stamps_ns=1_000_000_000 + 250_000_000 * np.arange(epochs),
        truth=truth,
        mean=mean,
        cov=np.tile(cov, (epochs, 1, 1)) * np.linspace(9.0, 1.0, epochs)[:, None, None],
        bound=np.tile(np.diag([0.3, 0.1, 1, 1, 1, 1]) ** 2, (epochs, 1, 1)),
        nis=rng.chisquare(4, epochs),
        dof=np.full(epochs, 4.0),
        level=np.full(epochs, 0.8),
        tracked=np.ones(epochs, dtype=np.bool_),
        losses=0,
    )


def _summary(tracks: list[Track], position_sd_max_m: float = 1.0) -> Summary:
    histogram = np.zeros(BINS + 1, dtype=np.int64)
    tallies = [tally(track, position_sd_max_m, histogram, SKIP) for track in tracks]
    return Summary.of(METIS, [Batch(tallies=tallies, histogram=histogram)])


def test_routes_above_5_m_that_the_bound_leaves() -> None:
    """Of the largest bound of each route; a bound of one axis is the tail of a normal error."""
    first, second = _track(1, 60), _track(2, 60)
    bound = np.zeros((60, 6, 6))
    bound[30, 0, 0], bound[40, 1, 1] = 3.0**2, 2.0**2
    bound[5, 0, 0] = 10.0**2  # left out with the first epochs
    routes = _summary([replace(first, bound=bound), second]).routes
    assert routes.astray_at_bound == pytest.approx(2.0 * norm.sf(5.0 / 3.0), rel=1e-3)
    assert _summary([second]).routes.astray_at_bound < 1e-30


def test_figures_of_two_runs() -> None:
    tracks = [_track(1, 120), _track(2, 60)]
    error = np.vstack([(t.mean - t.truth)[SKIP:] for t in tracks])
    cov = np.vstack([t.cov[SKIP:] for t in tracks])
    distance = np.hypot(error[:, 0], error[:, 1])
    clock_ns = 1e9 * error[:, 4] / C
    ours = _summary(tracks)
    assert (ours.runs, ours.n) == (2, 140)
    assert ours.rmse_m == pytest.approx(np.sqrt(np.mean(distance**2)))
    assert ours.mean_error_m == pytest.approx(distance.mean())
    assert ours.error_max_m == pytest.approx(distance.max())
    assert ours.clock_sd_ns == pytest.approx(clock_ns.std())
    assert ours.clock_rmse_ns == pytest.approx(np.sqrt(np.mean(clock_ns**2)))
    assert ours.nees.mean == pytest.approx(
        nees(error[:, :2], cov[:, POSITION, POSITION])[0].mean()
    )
    assert ours.bound_rmse_m == pytest.approx(np.sqrt(0.1))
    assert ours.bound_ratio == pytest.approx(ours.rmse_m / np.sqrt(0.1))
    assert ours.percentile_m(50) == pytest.approx(np.percentile(distance, 50), abs=0.02)
    assert ours.share_within(0.5) == pytest.approx(np.mean(distance < 0.5))
    assert ours.nis_over_dof == pytest.approx(
        np.concatenate([t.nis[SKIP:] for t in tracks]).mean() / 4
    )
    assert 0.0 < ours.exceeded < 1.0
    assert ours.exceeded == pytest.approx(np.mean(distance > 0.8))
    assert ours.exceeded_runs == 2
    assert ours.level_m == pytest.approx(0.8)
    assert ours.rate_hz == pytest.approx(4.0)
    assert ours.routes._replace(astray_at_bound=0.0) == (2, 0, 0, 0.0, 1.0)


def test_heading_counts_where_the_vehicle_moves() -> None:
    track = _track(3, 40)
    track.truth[25, VELOCITY] = 0.3, 0.39  # 0.492 m/s
    velocity, truth = track.mean[SKIP:, 2:4], track.truth[SKIP:, 2:4]
    turn = np.arctan2(velocity[:, 1], velocity[:, 0]) - np.arctan2(truth[:, 1], truth[:, 0])
    turn = (turn + np.pi) % (2 * np.pi) - np.pi
    moving = np.hypot(*truth.T) > 0.5
    assert not moving[5]
    expected = np.degrees(np.sqrt(np.mean(turn[moving] ** 2)))
    assert _summary([track]).heading_rmse_deg == pytest.approx(expected)


def test_ready_when_the_worst_run_is() -> None:
    tracks = [_track(1, 120), _track(2, 60)]
    largest = [np.sqrt(np.linalg.eigvalsh(t.cov[:, POSITION, POSITION])[:, -1]) for t in tracks]
    limit = float(np.median(largest[1]))
    expected = max(0.25 * np.flatnonzero(sd <= limit)[0] for sd in largest)
    assert expected > 0
    assert _summary(tracks, limit).ready_s == pytest.approx(expected)
    assert _summary(tracks, 0.9 * float(min(s.min() for s in largest))).ready_s is None


@pytest.mark.parametrize(
    ("error_m", "losses", "astray"), [(4.99, 0, 0), (5.01, 0, 1), (0, 1, 1), (5.01, 2, 2)]
)
def test_a_run_goes_astray_above_5_m_or_when_lost(
    error_m: float, losses: int, astray: int
) -> None:
    tracks = [_track(1, 60), _track(2, 60)]
    tracks[0].mean[SKIP, POSITION] = tracks[0].truth[SKIP, POSITION] + [error_m, 0.0]
    tracks[0].mean[SKIP - 1, :2] += 100.0  # still converging
    tracks[1] = replace(tracks[1], losses=losses)
    ours = _summary(tracks)
    assert (ours.routes.astray, ours.routes.losses) == (astray, losses)


def test_epochs_without_a_track_count_against_availability_only() -> None:
    """30 of 40 scored epochs have a track; the figures are theirs, after the loss included."""
    track = _track(1, 60)
    whole = _summary([track])
    track.tracked[[5, *range(30, 40)]] = False
    for array in (track.mean, track.cov, track.level):
        array[~track.tracked] = np.nan
    ours = _summary([track])
    error = np.hypot(*(track.mean - track.truth)[SKIP:, :2].T)
    assert (ours.n, ours.routes.availability) == (30, 0.75)
    assert ours.rmse_m == pytest.approx(np.sqrt(np.nanmean(error**2)))
    assert ours.rmse_m != pytest.approx(whole.rmse_m)
    assert ours.histogram.sum() == 30
    assert ours.level_m == pytest.approx(0.8)
    assert ours.rate_hz == pytest.approx(4.0 * 48 / 59)


def test_consistency_is_judged_by_the_spread_between_runs() -> None:
    """A run more that is sure of a wrong place moves the mean beyond what its runs allow."""
    tracks = [_track(seed, 60) for seed in range(1, 13)]
    for track in tracks:
        track.cov[:] = track.cov[-1]
    ours = _summary(tracks)
    per_run = [nees((t.mean - t.truth)[SKIP:, :2], t.cov[SKIP:, :2, :2])[0].mean() for t in tracks]
    reach = 2.201 * np.std(per_run, ddof=1) / np.sqrt(12)  # Student's t, 11 degrees of freedom
    assert ours.nees.mean == pytest.approx(np.mean(per_run))
    assert ours.nees.bounds == pytest.approx((2.0 - reach, 2.0 + reach), rel=1e-3)
    assert ours.nees.consistent
    for track in tracks:
        track.cov[:] /= 2.0
    assert not _summary(tracks).nees.consistent


def test_the_papers_filter_has_no_protection_level() -> None:
    track = _track(1, 60)
    histogram = np.zeros(BINS + 1, dtype=np.int64)
    batch = Batch(tallies=[tally(track, 1.0, histogram, SKIP)], histogram=histogram)
    ours = Summary.of(replace(METIS, estimator="paper"), [batch])
    assert (ours.level_m, ours.exceeded, ours.exceeded_runs) == (None, None, None)


@pytest.mark.parametrize(("error_m", "runs"), [(0.79, 0), (0.81, 1)])
def test_runs_with_an_error_above_their_level(error_m: float, runs: int) -> None:
    tracks = [_track(1, 60), _track(2, 60)]
    for track in tracks:
        track.mean[SKIP:, :2] = track.truth[SKIP:, :2]
    tracks[1].mean[-3:, 1] += error_m
    assert _summary(tracks).exceeded_runs == runs


def test_errors_beyond_the_histogram_have_no_percentile() -> None:
    track = _track(1, 60)
    track.mean[:, X.PX] += 50.0
    ours = _summary([track])
    assert ours.percentile_m(50) is None
    assert ours.share_within(1.0) == 0.0


def test_a_run_that_ends_before_it_counts() -> None:
    with pytest.raises(NothingScoredError, match="METIS: no run has estimates that count"):
        _summary([_track(1, SKIP)])


def test_a_scenario_without_initial_pose_is_refused() -> None:
    setup = Setup(Experiment(name="no pose", scenario="fast_pass"))
    with pytest.raises(ValueError, match="fast_pass gives no initial pose; set initial_pose_sd_m"):
        setup.run(1)


@pytest.mark.parametrize(
    ("scenario", "seed", "model", "clock"),
    [
        ("metis_madrid", 4, "constant_velocity", None),
        ("metis_madrid", 6, "constant_velocity", None),
        ("metis_madrid", 6, "constant_velocity", {"sd_s": 3e-9}),
        ("intersection_turn_30m", 2, "constant_velocity", None),
        ("intersection_turn", 3, "inertial", None),
        ("intersection_turn", 3, "interacting", None),
        ("metis_madrid", 6, "interacting", {"sd_s": 3e-9}),
    ],
)
def test_a_run_is_what_the_tracker_makes_of_its_measurements(
    scenario: str, seed: int, model: str, clock: dict[str, float] | None
) -> None:
    changes = (("max_duration_s", 25.0), ("rsus.clock", clock))
    several = {"manoeuvre_speed_sd_mps": 0.0} if model == "interacting" else {}
    tracker_settings = (("motion_model", model), *several.items())
    setup = Setup(
        Experiment(name="x", scenario=scenario, changes=changes, tracker=tracker_settings)
    )
    track = setup.run(seed)
    simulation = setup.simulation.with_seed(seed)
    tracker = Tracker(setup.config)
    for rsu in simulation.rsus:
        tracker.add_rsu(rsu)
    for event in simulation.events():
        if isinstance(event, InitialPose | ImuSample):
            tracker.add(event)
        if isinstance(event, Beacon):
            for measurement in simulation.measure(event):
                tracker.add(measurement)
    poses = [o.odometry for o in (*tracker.process(), *tracker.flush()) if o.odometry is not None]
    assert [pose.stamp_ns for pose in poses] == track.stamps_ns.tolist()
    positions = np.array([pose.position[:2] for pose in poses])
    np.testing.assert_allclose(positions, track.mean[:, POSITION], rtol=0, atol=1e-9)


def test_metis_routes_keep_the_papers_figures_on_any_number_of_processes() -> None:
    """fokin2020 section 2.4, N_T = 500: 0.6 m and 4 ns."""
    results = []
    for workers in (1, 2):
        with Work(12, 3, workers) as work:
            results.append(monte_carlo(work, METIS))
    one, two = results
    np.testing.assert_array_equal(one.histogram, two.histogram)
    assert replace(one, histogram=two.histogram) == two
    assert one.runs == 12
    assert one.rmse_m < 0.6
    assert one.clock_sd_ns < 6.0  # twelve routes; the paper has 4
    assert one.routes.losses == 0
    assert 0.5 < one.bound_ratio < 1.5


def test_a_drawn_start_is_off_the_truth_by_the_filters_own_covariance() -> None:
    """The first epoch hears azimuth and TOA of two RSUs: position and clock offset are measured,
    the velocity is not, and is what was drawn."""
    experiment = Experiment(
        name="x",
        scenario="fast_pass_100hz",
        changes=(("devices.0.initial_pose_sd_m", 5.0), ("max_duration_s", 0.02)),
        start_drawn=True,
    )
    setup, given = Setup(experiment), Setup(replace(experiment, start_drawn=False))
    drawn = np.array([(t.mean - t.truth)[0, 2:4] for t in map(setup.run, range(1, 201))])
    sd = setup.config.initial_speed_sd_mps
    np.testing.assert_allclose(drawn.mean(axis=0), 0.0, atol=4.0 * sd / np.sqrt(200.0))
    np.testing.assert_allclose(drawn.std(axis=0), sd, rtol=0.2)
    np.testing.assert_array_equal(setup.run(1).mean, Setup(experiment).run(1).mean)
    np.testing.assert_allclose(given.run(1).mean[0, 2:4], 0.0, atol=1e-9)
