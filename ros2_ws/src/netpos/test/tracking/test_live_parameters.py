"""Parameters that change while a tracker runs: as if it had been started with them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from netpos.messages.values import RsuMeasurement
from netpos.tracking import Tracker, TrackerConfig
from netpos.tracking.live_parameters import LIVE, LIVE_OF_ONE_MODEL, live_names
from street_run import epochs, fed

OTHER: dict[str, Any] = {
    "max_devices": 1,
    "allowed_devices": "vue_.",
    "max_rate_hz": 7,
    "max_rsu_rate_hz": 7,
    "accept_initialpose": False,
    "max_gap_s": 0.5,
    "isolate_rsus": False,
    "gate_probability": 0.6,
    "accel_density_mps2_sqrthz": 3.0,
    "coast_after_s": 0.2,
}


@pytest.fixture
def batches(world: Any) -> list[list[RsuMeasurement]]:
    """Noisy epochs with a gap of 0.8 s."""
    noisy = replace(world, rng=np.random.default_rng(5))
    return [batch for k, batch in enumerate(epochs(noisy, 60)) if not 30 <= k < 38]


def told(tracker: Tracker, batches: list[list[RsuMeasurement]]) -> list[Any]:
    found = []
    for batch in batches:
        for item in batch:
            tracker.add(item)
        for output in tracker.process():
            odometry = output.odometry
            found.append(
                (
                    output.status.stamp_ns,
                    output.status.state,
                    dict(output.status.rejected),
                    None if odometry is None else odometry.position.tolist(),
                    None if odometry is None else odometry.pose_cov.tolist(),
                )
            )
    return found


def test_every_live_parameter_is_tried() -> None:
    assert set(OTHER) == {*LIVE, *LIVE_OF_ONE_MODEL}


def estimates(outputs: list[Any]) -> list[Any]:
    """Without the counts, which go on over a reset."""
    return [(stamp, state, *rest) for stamp, state, _, *rest in outputs]


@pytest.mark.parametrize("name", sorted(OTHER))
def test_it_is_as_if_the_tracker_had_been_started_with_it(
    world: Any, batches: list[list[RsuMeasurement]], name: str
) -> None:
    """To the last bit, once the track that ran before is forgotten."""
    changed = world.tracker()
    told(changed, batches[:5])
    changed.set_config(replace(changed.config, **{name: OTHER[name]}))
    changed.reset()
    started = world.tracker(**{name: OTHER[name]})
    told(started, batches[:5])
    started.reset()
    assert estimates(told(changed, batches[8:])) == estimates(told(started, batches[8:]))


@pytest.mark.parametrize("name", ["gate_probability", "accel_density_mps2_sqrthz", "max_gap_s"])
def test_the_next_epoch_of_a_running_track_takes_it(
    world: Any, batches: list[list[RsuMeasurement]], name: str
) -> None:
    """The track goes on, and differently: before the change not a bit is another."""
    usual, changed = world.tracker(), world.tracker()
    assert told(usual, batches[:20]) == told(changed, batches[:20])
    changed.set_config(replace(changed.config, **{name: OTHER[name]}))
    here, there = told(usual, batches[20:]), told(changed, batches[20:])
    first = 10 if name == "max_gap_s" else 0  # from the gap on
    assert here[:first] == there[:first]
    assert here[first:] != there[first:]
    assert here[0][0] == there[0][0]
    if name != "max_gap_s":
        assert all(output[3] is not None for output in there), "no new first fix"


def test_a_wider_gate_takes_what_was_refused(world: Any) -> None:
    """A range 1.5 m off fails a gate of 90 %; after the change it passes."""
    tracker = world.tracker(gate_probability=0.9, manoeuvre_speed_sd_mps=0.0)
    runs = epochs(world, 40)
    off = [replace(m, toa_s=m.toa_s + (5e-9 if m.rsu_id == "a" else 0.0)) for m in runs[30]]
    later = [replace(m, toa_s=m.toa_s + (5e-9 if m.rsu_id == "a" else 0.0)) for m in runs[31]]
    for batch in runs[:30]:
        fed(tracker, batch)
    (before,) = fed(tracker, off)
    tracker.set_config(replace(tracker.config, gate_probability=1.0))
    (after,) = fed(tracker, later)
    assert "a" not in before.status.sources
    assert "a" in after.status.sources


def test_late_measurements_are_applied_again_with_it(
    world: Any, batches: list[list[RsuMeasurement]]
) -> None:
    """States of the history hold it too: in order or late, the estimate is the same."""
    in_order, late = world.tracker(), world.tracker()
    for tracker in (in_order, late):
        told(tracker, batches[:20])
        tracker.set_config(replace(tracker.config, gate_probability=0.6))
    told(in_order, batches[20:24])
    for item in [*batches[21], *batches[22], *batches[20], *batches[23]]:
        late.add(item)
        late.process()
    probe = batches[24]
    assert estimates(told(late, [probe]))[-1] == estimates(told(in_order, [probe]))[-1]


@pytest.mark.parametrize(
    ("config", "values", "words"),
    [
        ({}, {"hold_s": 0.5}, "hold_s cannot change"),
        ({}, {"filter": "ukf", "max_devices": 3}, "filter cannot change"),
        ({"motion_model": "interacting"}, {"gate_probability": 0.9}, "gate_probability cannot"),
    ],
)
def test_others_are_refused_and_nothing_changes(
    config: dict[str, Any], values: dict[str, Any], words: str
) -> None:
    tracker = Tracker(TrackerConfig(**config))
    before = tracker.config
    with pytest.raises(ValueError, match=words) as raised:
        tracker.set_config(replace(before, **values))
    assert "max_devices" in str(raised.value), "it says what can change"
    assert tracker.config is before


def test_limits_can_always_change() -> None:
    for config in (TrackerConfig(), TrackerConfig(motion_model="interacting")):
        assert set(LIVE) <= set(live_names(config))
