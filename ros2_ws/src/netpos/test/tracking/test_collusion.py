"""Invented RSUs that agree with one another: names are no evidence."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from health_stream import observe
from netpos.messages.values import Array, Field, RsuInfo, RsuMeasurement, TrackState
from netpos.tracking import Tracker, TrackerConfig
from netpos.tracking.health.health import RsuHealth, RsuReport, RsuState
from netpos.tracking.rsus.rsu import Rsu

S = 1_000_000_000
T0 = S
HONEST = {"a": (0.0, 0.0), "b": (60.0, 0.0), "c": (60.0, 60.0), "d": (0.0, 60.0)}
INVENTED = {
    "v": (10.0, -20.0),
    "w": (80.0, 20.0),
    "x": (45.0, 80.0),
    "y": (-20.0, 40.0),
    "z": (30.0, -30.0),
}
ASIDE = np.array([40.0, 0.0])


def truth(t_s: float) -> Array:
    return np.array([12.0 + 0.5 * t_s, 31.0])


def tracker_of(names: dict[str, tuple[float, float]], **config: Any) -> Tracker:
    tracker = Tracker(TrackerConfig(**config))
    for name, site in names.items():
        tracker.add_rsu(RsuInfo(rsu_id=name, position=np.array([*site, 0.0])))
    return tracker


def measured(
    sites: dict[str, tuple[float, float]], t_s: float, place: Array, sd: float, seed: int
) -> list[RsuMeasurement]:
    rng = np.random.default_rng([seed, round(10 * t_s), len(sites)])
    return [
        RsuMeasurement(
            stamp_ns=T0 + round(t_s * S),
            rsu_id=name,
            vue_id="vue_1",
            fields=Field.RANGE,
            range_m=float(np.linalg.norm(place - site) + sd * rng.standard_normal()),
            range_var=sd * sd,
        )
        for name, site in sites.items()
    ]


def run(tracker: Tracker, seconds: tuple[float, float], told: Any) -> list[tuple[float, Any]]:
    """Outputs with their errors; ``told(t_s)``: what is measured."""
    found = []
    for k in range(round(10 * seconds[0]), round(10 * seconds[1])):
        for m in told(k / 10.0):
            tracker.add(m)
        for output in tracker.process():
            t_s = (output.status.stamp_ns - T0) / S
            place = output.odometry.position[:2] if output.odometry is not None else np.inf
            found.append((float(np.linalg.norm(place - truth(t_s))), output))
    return found


@pytest.mark.parametrize("seed", range(3))
def test_five_that_agree_do_not_outvote_four_that_track(seed: int) -> None:
    """From 10 s on they measure a device 40 m aside, with an sd of 0.01 m."""
    tracker = tracker_of(HONEST | INVENTED)

    def told(t_s: float) -> list[RsuMeasurement]:
        honest = measured(HONEST, t_s, truth(t_s), 0.3, seed)
        false = measured(INVENTED, t_s, truth(t_s) + ASIDE, 0.01, seed)
        return honest + (false if t_s >= 10.0 else [])

    found = run(tracker, (0.0, 40.0), told)
    later = [(e, o.status) for e, o in found if o.status.stamp_ns > T0 + 5 * S]
    assert all(s.state is TrackState.TRACKING for _, s in later)
    assert max(e for e, _ in later) < 1.5
    assert all(e < s.protection_level_m for e, s in later)
    assert set(found[-1][1].status.sources) == set(HONEST)
    reports = {r.rsu_id: r for r in tracker.rsu_reports()}
    assert all(reports[name].state is RsuState.OK for name in HONEST)
    assert all(reports[name].state is RsuState.EXCLUDED for name in INVENTED)


@pytest.mark.parametrize("expected", [4, 50])
@pytest.mark.parametrize("first", [True, False])
def test_no_epoch_waits_for_them(expected: int, first: bool) -> None:
    """They measure at the stamps of the honest RSUs, before or after these, and announce more
    than there are."""
    tracker, delayed = tracker_of(HONEST | INVENTED, history_s=0.5), 0
    for k in range(200):
        t_s = k / 10.0
        honest = [
            replace(m, expected=len(HONEST)) for m in measured(HONEST, t_s, truth(t_s), 0.3, 1)
        ]
        false = [
            replace(m, expected=expected)
            for m in measured(INVENTED, t_s, truth(t_s) + ASIDE, 0.01, 1)
        ]
        false = false if t_s >= 10.0 else []
        for m in false if first else []:
            tracker.add(m)
        outputs = tracker.process()
        for m in honest:
            tracker.add(m)
        outputs += tracker.process()
        told = {o.status.stamp_ns for o in outputs if not o.revised}
        delayed += honest[0].stamp_ns not in told
        assert all(o.status.stamp_ns <= honest[0].stamp_ns for o in outputs)
        for m in [] if first else false:
            tracker.add(m)
        tracker.process()
    assert delayed == 0


def test_they_take_over_only_after_the_track_is_lost() -> None:
    tracker = tracker_of(HONEST | INVENTED)

    def told(t_s: float) -> list[RsuMeasurement]:
        if t_s < 20.0:
            honest = measured(HONEST, t_s, truth(t_s), 0.3, 1)
            return honest + (measured(INVENTED, t_s, truth(t_s) + ASIDE, 0.01, 1) * (t_s > 10))
        return measured(INVENTED, t_s, truth(t_s) + ASIDE, 0.01, 1)

    found = run(tracker, (0.0, 70.0), told)
    used = [o.status.stamp_ns for _, o in found if set(o.status.sources) & set(INVENTED)]
    assert used, "nobody else is left: they are heard in the end"
    coasted = [
        o.status.stamp_ns
        for _, o in found
        if T0 + 21.5 * S < o.status.stamp_ns < used[0] and o.status.state is TrackState.TRACKING
    ]
    assert coasted == []
    assert used[0] > T0 + 50 * S  # max_gap_s after the last honest one


def report_of(tracker: Tracker, name: str) -> RsuReport:
    return next(r for r in tracker.rsu_reports() if r.rsu_id == name)


@pytest.mark.parametrize("seed", range(3))
def test_an_honest_newcomer_is_used_at_once_and_votes_after_some_seconds(seed: int) -> None:
    tracker = tracker_of(HONEST | {"new": (30.0, -20.0)})

    def told(t_s: float) -> list[RsuMeasurement]:
        sites = HONEST | ({"new": (30.0, -20.0)} if t_s >= 10.0 else {})
        return measured(sites, t_s, truth(t_s), 0.3, seed)

    found = run(tracker, (0.0, 14.0), told)
    stamps = [o.status.stamp_ns for _, o in found if "new" in o.status.sources]
    assert stamps[0] == T0 + 10 * S
    assert "new: used where it agrees" in report_of(tracker, "new").text
    found += run(tracker, (14.0, 20.0), told)
    stamps = [o.status.stamp_ns for _, o in found if "new" in o.status.sources]
    assert len(stamps) >= 95
    assert report_of(tracker, "new").state is RsuState.OK


def test_no_probation_where_few_track() -> None:
    """Two RSUs may track a mirrored place: the third is used at once."""
    few = {name: HONEST[name] for name in "ab"}
    tracker = tracker_of(HONEST, require_initial_pose=False)

    def told(t_s: float) -> list[RsuMeasurement]:
        return measured(HONEST if t_s < 2.0 or t_s >= 12.0 else few, t_s, truth(t_s), 0.3, 4)

    found = run(tracker, (0.0, 14.0), told)
    first = next(o for _, o in found if o.status.stamp_ns >= T0 + 12 * S)
    assert set(first.status.sources) == set(HONEST)


@pytest.mark.parametrize(("apart_m", "excluded"), [(0.1, False), (0.24, False), (10.0, True)])
def test_names_at_one_place_are_one_witness(apart_m: float, excluded: bool) -> None:
    """Five RSUs that a track follows outvote two that it refuses only from several places."""
    sites = {f"m{k}": (30.0 + apart_m * k, -20.0) for k in range(5)} | {"a": (0, 0), "b": (60, 0)}
    known = {
        name: Rsu.of(RsuInfo(rsu_id=name, position=np.array([*site, 0.0])))
        for name, site in sites.items()
    }
    health = RsuHealth(rsus=known)
    for k in range(200):
        for name in sites:
            fits = name.startswith("m")
            pair = (0.1 if fits else 30.0, 0.3)
            observe(health, name, "vue_1", T0 + k * S // 10, fits, {"range": pair})
    end_ns = T0 + 20 * S
    assert [health.excluded(name, end_ns) for name in "ab"] == [excluded] * 2
    assert not any(health.excluded(f"m{k}", end_ns) for k in range(5))


def test_order_of_arrival_does_not_matter() -> None:
    """Probation follows from stamps: late measurements give the same bytes."""
    outputs = []
    for late in (False, True):
        tracker = tracker_of(HONEST | INVENTED, hold_s=0.0)
        last: dict[int, bytes] = {}
        held: list[RsuMeasurement] = []
        for k in range(200):
            t_s = k / 10.0
            items = measured(HONEST, t_s, truth(t_s), 0.3, 5)
            if t_s >= 10.0:
                items += measured(INVENTED, t_s, truth(t_s) + ASIDE, 0.01, 5)
            now = held + items[: 2 if late else None]
            held = items[2:] if late else []
            for m in now:
                tracker.add(replace(m))
                for o in tracker.process():
                    if o.odometry is not None:
                        last[o.status.stamp_ns] = o.odometry.position.tobytes()
        for m in held:
            tracker.add(m)
        for o in tracker.process():
            last[o.status.stamp_ns] = o.odometry.position.tobytes()
        outputs.append(last[max(last)])
    assert outputs[0] == outputs[1]
