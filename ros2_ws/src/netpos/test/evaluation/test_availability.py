"""Availability, lost tracks, time without a scored estimate: hand-made runs."""

from __future__ import annotations

import numpy as np
import pytest
from netpos.evaluation.availability import (
    availability,
    lost_tracks,
    ready_stamps,
    rejected_share,
    unscored_s,
)
from netpos.evaluation.metrics import Figures, Run, score
from netpos.evaluation.pairing import Trajectory
from netpos.messages.values import Odometry, TrackState, TrackStatus

S = 1_000_000_000
STATES = {
    "W": TrackState.WAITING,
    "I": TrackState.INITIALISING,
    "T": TrackState.TRACKING,
    "C": TrackState.COASTING,
    "A": TrackState.AMBIGUOUS,
}


def stamps(*seconds: float) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return np.array([round(s * S) for s in seconds], dtype=np.int64)


def status(t_s: float, letter: str, **values: object) -> TrackStatus:
    return TrackStatus(
        stamp_ns=round(t_s * S),
        vue_id="vue_1",
        state=STATES[letter],
        **values,  # type: ignore[arg-type]
    )


def at(t_s: float, off_m: float = 0.0) -> Odometry:
    return Odometry(
        stamp_ns=round(t_s * S),
        vue_id="vue_1",
        position=np.array([t_s, off_m, 0.0]),
        quaternion=np.array([0.0, 0.0, 0.0, 1.0]),
        linear_velocity=np.array([1.0, 0.0, 0.0]),
    )


def figures_of(letters: str, errors_m: dict[int, float] | None = None, skip: int = 0) -> Figures:
    """Figures of an epoch each 0.1 s, one letter each, over as much truth; WAITING has no
    estimate.
    """
    off = errors_m or {}
    truth = [at(0.1 * k) for k in range(len(letters) + 1)]
    estimate = [at(0.1 * k, off.get(k, 0.0)) for k, c in enumerate(letters) if c != "W"]
    statuses = [status(0.1 * k, c) for k, c in enumerate(letters)]
    run = Run(truth=Trajectory.of(truth), estimate=Trajectory.of(estimate), statuses=statuses)
    return score(run, skip=skip).figures


@pytest.mark.parametrize(
    ("ready", "expected"),
    [
        ((), 0.0),
        ((0.0, 0.2, 0.4, 0.6, 0.8), 1.0),
        ((0.5,), 0.2),
        ((0.5, 0.6), 0.3),
        ((0.9,), 0.1),
        ((-0.1,), 0.1),
        ((-0.3, 1.1), 0.0),
    ],
)
def test_availability_is_the_covered_share(ready: tuple[float, ...], expected: float) -> None:
    truth = stamps(0.0, 1.0)
    assert availability(truth, stamps(*ready)) == pytest.approx(expected)
    assert unscored_s(truth, stamps(*ready), stamps()) == pytest.approx(1.0 - expected)


def test_a_span_without_length() -> None:
    assert availability(stamps(0.0), stamps(0.0)) is None
    assert unscored_s(stamps(0.0), stamps(0.0), stamps(0.0)) == 0.0


def test_only_tracking_is_ready() -> None:
    estimate = Trajectory.of([at(0.1 * k) for k in range(4)])
    statuses = [status(0.1 * k, letter) for k, letter in enumerate("ITC")]
    assert ready_stamps(estimate, statuses).tolist() == [S // 10]
    assert ready_stamps(estimate, []).size == 4


@pytest.mark.parametrize(
    ("letters", "lost"),
    [
        ("", 0),
        ("WITTT", 0),
        ("WICIT", 0),  # never TRACKING before
        ("IAIT", 0),
        ("TTCCTT", 0),
        ("TCAAT", 0),
        ("TCAIT", 0),
        ("TTIT", 0),  # the sd has augmented
        ("TTWWIT", 1),
        ("TCCIT", 0),
        ("TWITCW", 2),
    ],
)
def test_a_loss_is_a_step_back_to_waiting(letters: str, lost: int) -> None:
    assert lost_tracks([status(0.1 * k, c) for k, c in enumerate(letters)]) == lost


@pytest.mark.parametrize(
    ("statuses", "lost"),
    [
        (("T", {}, "W", {"track_lost": 1}), 1),  # one loss, seen twice
        (("T", {}, "T", {"diverged": 1}), 1),  # found again within the epoch
        (("I", {}, "W", {"diverged": 1}), 1),  # before it was ever TRACKING
        (("T", {"track_lost": 1}, "T", {"track_lost": 2, "diverged": 1}), 3),
        (("T", {"gate": 1}, "T", {"gate": 9}), 0),
    ],
)
def test_a_loss_that_was_counted_is_one(statuses: tuple[str, dict[str, int]], lost: int) -> None:
    first, before, second, after = statuses
    states = [status(0.1, second, rejected=after), status(0.0, first, rejected=before)]
    assert lost_tracks(states) == lost


def test_refused_measurements_are_a_share_of_all() -> None:
    """Samples of the IMU and losses are no measurements."""
    counts = {"gate": 6, "late": 4, "imu_late": 50, "track_lost": 2}
    assert rejected_share(status(0.0, "T", accepted=30, rejected=counts)) == pytest.approx(0.25)
    assert rejected_share(status(0.0, "T", rejected={"track_lost": 2})) is None


def test_without_track_status_nothing_is_known_of_losses() -> None:
    truth = Trajectory.of([at(0.1 * k) for k in range(5)])
    figures = score(Run(truth=truth, estimate=truth), skip=0).figures
    assert (figures.lost_tracks, figures.rejected_share) == (None, None)
    assert figures.unscored_s == 0.0


def test_what_is_not_scored_is_counted_in_seconds() -> None:
    """One second before the first TRACKING; then a silence of 1 s, whose first 0.2 s the estimate
    before it covers.
    """
    figures = figures_of("I" * 10 + "T" * 10 + "W" * 9 + "T" * 10)
    assert figures.unscored_s == pytest.approx(1.0 + 0.8)
    assert figures.availability == pytest.approx(1.0 - 1.8 / 3.9)
    assert (figures.n, figures.lost_tracks) == (20, 1)
    skipped = figures_of("I" * 10 + "T" * 10 + "W" * 9 + "T" * 10, skip=15)
    assert skipped.unscored_s == pytest.approx(1.5 + 0.8)
    assert skipped.availability == figures.availability


def test_the_share_in_which_an_rsu_measured_is_told_beside() -> None:
    """One measurement a tenth of a second for 1 s, then none."""
    truth = Trajectory.of([at(0.1 * k) for k in range(31)])
    heard = truth.stamp_ns[:11]
    figures = score(Run(truth=truth, estimate=truth, measured_ns=heard), skip=0).figures
    assert figures.measured == pytest.approx(1.2 / 3.0)
    unknown = score(Run(truth=truth, estimate=truth), skip=0).figures
    assert unknown.measured is None


def test_epochs_after_a_loss_count_against_availability_and_are_scored() -> None:
    """Ready for 1 s, lost for 0.5 s, 12 m off while INITIALISING for 0.4 s, ready for 1 s."""
    errors = dict.fromkeys(range(15, 19), 12.0)
    figures = figures_of("T" * 10 + "W" * 5 + "I" * 4 + "T" * 10, errors)
    assert (figures.n, figures.lost_tracks) == (24, 1)
    assert figures.max_m == pytest.approx(12.0)
    assert figures.share_above_5m == pytest.approx(4 / 24)
    assert figures.availability == pytest.approx(1.0 - 0.8 / 2.9)
    assert figures.unscored_s == pytest.approx(0.4)


@pytest.mark.parametrize(
    ("interval_s", "missed_s"),
    [(0.1, 0.8), (0.2, 0.7), (0.5, 0.25), (1.0, 0.0)],
)
def test_a_slow_tracker_misses_only_what_is_missing(interval_s: float, missed_s: float) -> None:
    """Estimates at one interval over 20 s with one gap of 1 s."""
    before = np.arange(0.0, 10.0 + 1e-9, interval_s)
    after = np.arange(11.0, 20.0 + 1e-9, interval_s)
    estimates = stamps(*before, *after)
    assert unscored_s(stamps(0.0, 20.0), estimates, estimates) == pytest.approx(missed_s)


def test_a_track_that_never_comes_back_misses_the_rest() -> None:
    figures = figures_of("T" * 10 + "W" * 20)
    assert figures.unscored_s == pytest.approx(3.0 - 0.9 - 0.2)
    assert figures.availability == pytest.approx(1.1 / 3.0)
    assert (figures.n, figures.lost_tracks, figures.max_m) == (10, 1, pytest.approx(0.0))


def test_a_track_that_is_never_ready_misses_everything() -> None:
    figures = figures_of("I" * 20)
    assert (figures.n, figures.lost_tracks, figures.share_above_5m) == (0, 0, None)
    assert figures.unscored_s == pytest.approx(2.0)


@pytest.mark.parametrize(("error_m", "share"), [(5.0, 0.0), (5.001, 0.1)])
def test_five_metres_are_not_above_five_metres(error_m: float, share: float) -> None:
    assert figures_of("T" * 10, {3: error_m}).share_above_5m == pytest.approx(share)
