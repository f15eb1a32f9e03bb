"""petukhov's pedestrian as a running graph: gait, dead reckoning, one anchor, tracker."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from netpos.messages.values import Field, TrackState
from runs import (
    INFOS,
    MEASUREMENTS,
    ODOMETRY,
    TRACK_STATUS,
    TRUTH,
    VUE,
    assert_same,
    finish,
    graphs,
    horizontal_errors,
    is_of_measurements,
    messages,
    netpos,
    script,
    stamps,
)

SCENARIO, SEED, RATE = "pedestrian_rectangle", "11", "1.5"
SIMULATED = tuple(
    f"/{VUE}/{name}" for name in ("beacon", "ground_truth", "ground_truth_clock", "imu", "mag")
)
SETTLED_NS = 16_000_000_000
RECKONED = (f"/{VUE}/step", f"/{VUE}/step_velocity")


@dataclass(frozen=True)
class Recorded:
    """The same run, live and offline."""

    live: Path
    offline: Path


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    folder = tmp_path_factory.mktemp("rectangle")
    bags = Recorded(folder / "live", folder / "offline")
    with graphs(folder) as (graph,):
        started = script(graph, "run_graph", SCENARIO, bags.live, RATE, SEED)
        netpos("run", SCENARIO, "--offline", "--seed", SEED, "--bag", bags.offline)
        finish(started)
    return bags


def test_live_and_offline_carry_the_same_measurements(recorded: Recorded) -> None:
    assert_same(recorded.live, recorded.offline, (INFOS, MEASUREMENTS, *SIMULATED))


def test_live_and_offline_reckon_alike(recorded: Recorded) -> None:
    assert len(messages(recorded.offline, RECKONED[0])) == 32
    assert_same(recorded.live, recorded.offline, RECKONED)


def last_places(bag: Path) -> tuple[list[int], np.ndarray]:
    """Stamps and positions of the last seconds, as last said.

    At the start nobody waits for a topic not heard before, so that a velocity may come too late
    there; what that changes has died away by the end.
    """
    said = {}
    for odometry in messages(bag, ODOMETRY):
        (ns,) = stamps([odometry])
        said[ns] = (odometry.pose.pose.position.x, odometry.pose.pose.position.y)
    late = sorted(ns for ns in said if ns > SETTLED_NS)
    return late, np.array([said[ns] for ns in late])


def test_live_and_offline_end_alike(recorded: Recorded) -> None:
    (when, live), (expected, offline) = last_places(recorded.live), last_places(recorded.offline)
    assert when == expected
    assert len(when) > 100
    np.testing.assert_allclose(live, offline, atol=1e-6)


def test_measurements_are_ranges_and_wrapped_phases(recorded: Recorded) -> None:
    (info,) = messages(recorded.live, INFOS)
    assert info.baseline == pytest.approx(4 * info.wavelength)
    measured = messages(recorded.live, MEASUREMENTS)
    assert len(measured) == 256
    assert {m.fields for m in measured} == {int(Field.RANGE | Field.PHASE)}
    phases = np.array([m.phase_difference for m in measured])
    assert np.abs(phases).max() <= np.pi
    assert np.ptp(phases) > 6.0  # it wraps


def test_the_sector_is_open_until_steps_decide_it(recorded: Recorded) -> None:
    statuses = list(filter(is_of_measurements, messages(recorded.live, TRACK_STATUS)))
    states = [s.state for s in statuses]
    first = states.index(TrackState.TRACKING)
    assert first > 5  # standing still decides nothing
    assert set(states[:first]) <= {TrackState.WAITING, TrackState.AMBIGUOUS}
    assert set(states[first:]) == {TrackState.TRACKING}
    decided_ns = stamps(statuses)[first]
    errors = horizontal_errors(messages(recorded.live, TRUTH), messages(recorded.live, ODOMETRY))
    tracking = np.array([error for ns, error in errors.items() if ns >= decided_ns])
    assert len(tracking) > 150
    assert np.sqrt((tracking**2).mean()) < 0.06
    assert tracking.max() < 0.25


def test_the_recording_replays_to_its_own_end(recorded: Recorded, tmp_path: Path) -> None:
    again = tmp_path / "again"
    netpos("replay", recorded.live, "--out", again)
    np.testing.assert_allclose(last_places(again)[1], last_places(recorded.live)[1], atol=1e-6)


def test_the_paper_s_rule_runs_by_a_parameter(recorded: Recorded, tmp_path: Path) -> None:
    """It fixes after the first step, right or wrong; nothing says which."""
    ruled = tmp_path / "ruled"
    netpos("replay", recorded.live, "--out", ruled, "--set", "ambiguity=step_heading")
    states = [s.state for s in messages(ruled, TRACK_STATUS)]
    assert not {TrackState.INITIALISING, TrackState.AMBIGUOUS} & set(states)
    assert states[0] == TrackState.WAITING
    assert TrackState.TRACKING in states
