"""The share by which all distances are too long, against errors that are known."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest
from netpos.messages.values import Array, Field, RsuErrors, RsuInfo, RsuMeasurement
from netpos.tracking import Tracker
from netpos.tracking.config import TrackerConfig
from netpos.tracking.report import TrackOutput
from netpos.tracking.rsus.stretch import NONE_SEEN, Stretch, together

SITES = np.array([[30.0, 0.0], [0.0, 40.0], [-35.0, 0.0], [5.0, -30.0]])
PRIOR_SD = 0.05


def windows(seed: int, true: float) -> Iterator[tuple[Array, Array]]:
    """What is left of residuals (4,) and of distances (4,), in sd of the residuals; no error is
    beyond one of them."""
    rng = np.random.default_rng(seed)
    for _ in range(60):
        distance = rng.normal(0.0, 20.0, 4)
        yield true * distance + rng.uniform(-0.9, 0.9, 4), distance


@pytest.mark.parametrize("true", [0.0, 0.03, -0.07])
def test_the_share_is_that_of_least_squares_with_a_prior(true: float) -> None:
    """Whatever share had been taken out of each window."""
    stretch, left, distances = NONE_SEEN, [], []
    for residual, distance in windows(1, true):
        share = true + 0.01 * math.sin(len(left))
        taken = residual - share * distance
        if np.abs(taken).max() > 1.0:
            continue
        stretch = stretch.seen(taken, distance, np.ones(4), share, 0.0)
        left.append(residual)
        distances.append(distance)
    fading = np.repeat(0.99 ** (0.5 * np.arange(len(left))[::-1]), 4)  # of the variance's inverse
    A = np.append(fading * np.concatenate(distances), 1.0 / PRIOR_SD)
    b = np.append(fading * np.concatenate(left), 0.0)
    assert len(left) > 20
    assert stretch.share == pytest.approx(float(A @ b / (A @ A)), rel=1e-9)
    assert stretch.sd == pytest.approx(1.0 / math.sqrt(float(A @ A)), rel=1e-9)


def test_outliers_count_less_and_slow_errors_make_it_less_sure() -> None:
    """As least squares with the weights of errors with a Student tail (Lange, Little and Taylor
    1989)."""
    left, distance = np.array([0.5, 4.0, -0.3]), np.array([10.0, -20.0, 15.0])
    independent = np.array([1.0, 1.0, 0.1])
    stretch = NONE_SEEN.seen(left, distance, independent, 0.0, 0.0)
    w = np.array([1.0, 6.0 / (5.0 + 16.0), 1.0])
    information = float(w @ distance**2) + PRIOR_SD**-2
    assert stretch.share == pytest.approx(float(w @ (distance * left)) / information)
    variance = 1.0 / (float(w @ (independent * distance**2)) + PRIOR_SD**-2)
    assert stretch.sd == pytest.approx(variance**0.5)


@pytest.mark.parametrize(("log_odds", "believed"), [(29.4, False), (29.5, True)])
def test_a_tenth_of_the_evidence_has_to_outweigh_nineteen_to_one(
    log_odds: float, believed: bool
) -> None:
    """10 log 19 = 29.44. The share is beyond what slow errors may pretend."""
    certain = Stretch(1e6, 0.07e6, 1e6, log_odds)
    assert certain.is_one(False) is believed
    assert certain.is_one(True) is believed


def test_what_slow_errors_may_pretend_is_not_believed_and_does_not_end_a_belief() -> None:
    """0.07 of a standard deviation of 0.024: less than three."""
    doubtful = Stretch(1e6, 0.07e6, 0.024**-2 - PRIOR_SD**-2, 100.0)
    assert doubtful.sd == pytest.approx(0.024)
    assert not doubtful.is_one(False)
    assert doubtful.is_one(True)


def test_what_devices_have_seen_is_added() -> None:
    one, other = Stretch(2.0, 0.5, 1.0, 7.0), Stretch(3.0, -0.25, 2.5, -1.0)
    assert together(one, [other, other]) == Stretch(8.0, 0.0, 6.0, 5.0)
    assert together(one, []) == one


def place(t: float) -> Array:
    return np.array([14.0 * math.cos(t / 12.0), 12.0 * math.sin(t / 12.0), 0.0])


def ranges(
    seed: int, seconds: float, stretch: float, vue_id: str = "vue_1", start_s: float = 1.0
) -> list[RsuMeasurement]:
    """Of a device that walks around, twice a second, in turn, 0.2 m of noise."""
    rng, found = np.random.default_rng(seed), []
    for k in range(int(8 * seconds)):
        t, i = k / 8.0, k % len(SITES)
        true = float(np.linalg.norm(place(t) - [*SITES[i], 2.0]))
        found.append(
            RsuMeasurement(
                stamp_ns=round((start_s + t) * 1e9),
                rsu_id=f"a{i}",
                vue_id=vue_id,
                sequence=k,
                expected=1,
                fields=Field.RANGE,
                range_m=(1.0 + stretch) * true + float(rng.normal(0.0, 0.2)),
                range_var=0.04,
            )
        )
    return found


def outputs(measured: list[RsuMeasurement], **parameters: object) -> list[TrackOutput]:
    tracker = Tracker(TrackerConfig(learn_errors=True, **parameters))  # type: ignore[arg-type]
    for i, site in enumerate(SITES):
        tracker.add_rsu(RsuInfo(rsu_id=f"a{i}", position=np.append(site, 2.0)))
    found = []
    for m in measured:
        tracker.add(m)
        found += tracker.process()
    return [*found, *tracker.flush()]


def learned(found: list[TrackOutput], vue_id: str = "vue_1") -> list[RsuErrors]:
    return [e for output in found for e in output.errors if e.vue_id == vue_id]


def rmse(found: list[TrackOutput], from_s: float) -> float:
    errors = [
        o.odometry.position[:2] - place(o.odometry.stamp_ns * 1e-9 - 1.0)[:2]
        for o in found
        if o.odometry is not None and o.odometry.stamp_ns > (1.0 + from_s) * 1e9
    ]
    return float(np.sqrt(np.mean(np.sum(np.square(errors), axis=1))))


@pytest.mark.parametrize("stretch", [0.07, -0.05])
def test_distances_that_are_all_too_long_are_learned(stretch: float) -> None:
    found = outputs(ranges(5, 240.0, stretch))
    newest = {errors.rsu_id: errors for errors in learned(found)}
    assert set(newest) == {"a0", "a1", "a2", "a3"}
    for errors in newest.values():
        assert errors.stretch[0] == pytest.approx(stretch, abs=0.005)
        assert abs(errors.stretch[0] - stretch) < errors.stretch_sd[0]
        assert abs(errors.bias[0]) < 0.4
    none = outputs(ranges(5, 240.0, 0.0))
    assert rmse(found, 200.0) < 1.6 * rmse(none, 200.0)


@pytest.mark.parametrize("seed", [3, 6, 8])
def test_an_rsu_that_was_excluded_before_they_were_known_comes_back(seed: int) -> None:
    """Ranges that are 7 % too long contradict each other until that is known, and one of the four
    RSUs is excluded. Then it is judged by what is known of all."""
    found = outputs(ranges(seed, 120.0, 0.07))
    excluded = [output.status.rejected.get("isolated_rsu", 0) for output in found]
    stamps = [output.status.stamp_ns for output in found]
    after = next(k for k, stamp in enumerate(stamps) if stamp > stamps[0] + 100_000_000_000)
    assert 0 < excluded[after] == excluded[-1]
    reported = {e.rsu_id for e in learned(found) if e.stamp_ns > stamps[after]}
    assert reported == {"a0", "a1", "a2", "a3"}


def test_nothing_is_made_of_distances_that_are_right() -> None:
    for seed in range(4):
        told = learned(outputs(ranges(seed, 120.0, 0.0)))
        assert all(errors.stretch == errors.stretch_sd == (0.0,) for errors in told)


def test_another_device_and_a_track_that_is_lost_begin_with_what_is_known() -> None:
    first = ranges(6, 240.0, 0.07)
    for vue_id in ("vue_1", "vue_2"):
        later = ranges(7, 10.0, 0.07, vue_id, start_s=400.0)  # beyond the longest gap
        found = outputs([*first, *later], max_gap_s=60.0)
        start = next(e for e in learned(found, vue_id) if e.stamp_ns > 400_000_000_000)
        alone = learned(outputs(later), vue_id)[0]
        assert abs(start.stretch[0] - 0.07) < 0.5 * abs(alone.stretch[0] - 0.07)


def test_a_late_range_ends_in_the_same_stretch_as_one_in_order() -> None:
    measured = ranges(8, 240.0, 0.07)
    late = list(measured)
    for k in range(50, len(late) - 20, 35):
        late.insert(k + 6, late.pop(k))
    parameters = {"hold_s": 0.0, "history_s": 5.0, "isolate_rsus": False}
    in_order, revised = (outputs(items, **parameters) for items in (measured, late))
    assert learned(in_order)[-1].stretch[0] > 0.05
    newest = {errors.rsu_id: errors for errors in learned(revised)}
    for errors in learned(in_order)[-len(SITES) :]:
        assert newest[errors.rsu_id] == errors
    in_order_last, revised_last = in_order[-1].odometry, revised[-1].odometry
    assert in_order_last is not None
    assert revised_last is not None
    np.testing.assert_array_equal(revised_last.position, in_order_last.position)
    np.testing.assert_array_equal(revised_last.pose_cov, in_order_last.pose_cov)
