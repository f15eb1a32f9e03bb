"""The same bag gives the same estimates to the last bit: live at any speed, and without ROS."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from netpos.bags import BagReader, BagWriter, codec
from netpos.messages.topics import ODOMETRY as ODOMETRY_NAME
from netpos.messages.topics import STEP_VELOCITY, TRACK_STATUS, is_tracker_output, of_vue
from netpos.messages.values import Odometry, Velocity
from runs import (
    ESTIMATES,
    MEASUREMENTS,
    ODOMETRY,
    TRUTH,
    assert_same,
    changed_scenario,
    finish,
    graphs,
    messages,
    netpos,
    script,
)
from scipy.spatial.transform import Rotation

VELOCITIES = of_vue("vue_1", STEP_VELOCITY)
EVERY_NS = 100_000_000
AFTER_NS, LATER_NS = 5_000_000, 80_000_000  # from a velocity to its arrival
CASES = [("fast_pass", "1"), ("fast_pass", "10"), ("mixed", "10")]


@dataclass(frozen=True)
class Replays:
    """One bag of measurements with the bags of its replays."""

    source: Path
    offline: Path
    vues: tuple[str, ...]
    live: dict[str, Path] = field(default_factory=dict)

    @property
    def estimates(self) -> list[str]:
        return [of_vue(v, t.rsplit("/", 1)[1]) for v in self.vues for t in ESTIMATES]


def mixed_bag(folder: Path) -> Path:
    """Two devices that begin with an initial pose; the first has a second sensor.

    Its velocities come between the beacons, and every third after the measurements of the next
    beacon.
    """
    make, rng = codec(), np.random.default_rng(3)
    scenario = changed_scenario(
        folder / "two_devices.yaml", "metis_madrid", {"count": 2}, max_duration_s=6.0
    )
    source = folder / "two_devices"
    netpos("run", scenario, "--offline", "--bag", source)
    with BagReader(source) as reader, BagWriter(folder / "mixed", metadata=reader.metadata) as bag:
        arrivals: list[tuple[int, str, str, Any]] = [
            (entry.log_time_ns, entry.topic, entry.type_name, entry.cdr)
            for entry in reader.messages()
            if not is_tracker_output(entry.topic)
        ]
        for topic, info in reader.topics.items():
            if not is_tracker_output(topic):
                bag.add_topic(topic, info.type_name, info.qos)
        for index, truth in enumerate(map(make.odometry_from_msg, messages(source, TRUTH))):
            velocity = noisy_velocity(truth, rng)
            wait_ns = LATER_NS if index % 3 == 2 else AFTER_NS
            message = make.velocity_to_msg(velocity)
            arrivals.append((velocity.stamp_ns + wait_ns, VELOCITIES, "", message))
        for log_ns, topic, type_name, content in sorted(arrivals, key=lambda item: item[0]):
            if type_name:
                bag.write_raw(topic, type_name, content, log_ns)
            else:
                bag.write(topic, content, log_ns)
    return folder / "mixed"


def noisy_velocity(truth: Odometry, rng: np.random.Generator) -> Velocity:
    velocity = Rotation.from_quat(truth.quaternion).apply(truth.linear_velocity)[:2]
    return Velocity(
        stamp_ns=truth.stamp_ns + 37_000_000,
        vue_id="vue_1",
        frame_id="map",
        velocity=velocity + rng.normal(scale=0.5, size=2),
        cov=np.diag([0.25, 0.25]),
    )


@pytest.fixture(scope="module")
def replays(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Replays]:
    """Both bags, offline and through the live graph; the live replays run side by side."""
    folder = tmp_path_factory.mktemp("replays")
    netpos("run", "fast_pass", "--offline", "--bag", folder / "fast_pass")
    made = {
        "fast_pass": Replays(folder / "fast_pass", folder / "fast_pass_offline", ("vue_1",)),
        "mixed": Replays(mixed_bag(folder), folder / "mixed_offline", ("vue_1", "vue_2")),
    }
    with graphs(folder, len(CASES)) as running:
        started = []
        for graph, (name, rate) in zip(running, CASES, strict=True):
            out = folder / f"identity_{name}_at_{rate}x"
            made[name].live[rate] = out
            started.append(script(graph, "play_bag", made[name].source, out, rate))
        for replay in made.values():
            netpos("replay", replay.source, "--out", replay.offline)
        finish(*started)
    return made


@pytest.mark.parametrize(("name", "rate"), CASES)
def test_live_replay_equals_offline_replay(
    replays: dict[str, Replays], name: str, rate: str
) -> None:
    replay = replays[name]
    topics = [*replay.estimates, MEASUREMENTS]
    assert_same(replay.live[rate], replay.offline, topics, at_least=40)


def test_offline_replay_equals_the_run_it_was_recorded_in(replays: dict[str, Replays]) -> None:
    replay = replays["fast_pass"]
    assert_same(replay.offline, replay.source, ESTIMATES)


def test_the_second_sensor_counts(replays: dict[str, Replays]) -> None:
    """Its velocities are fused, those that arrive late too: else equal bits would prove little."""
    replay = replays["mixed"]
    statuses = messages(replay.offline, of_vue("vue_1", TRACK_STATUS))
    used = Counter(source for status in statuses for source in status.sources)
    sent = len(messages(replay.source, VELOCITIES))
    assert used["step_velocity"] >= sent - 3
    assert "late" not in statuses[-1].rejection_reasons
    first, second = (
        messages(replay.offline, of_vue(v, ODOMETRY_NAME)) for v in ("vue_1", "vue_2")
    )
    assert len(first) > 1.8 * len(second) > 100


def test_a_live_replay_replays_to_its_own_estimates(
    replays: dict[str, Replays], tmp_path: Path
) -> None:
    replay, again = replays["fast_pass"], tmp_path / "again"
    with BagReader(replay.source) as bag:
        settings = [f"--set={line.replace(': ', '=')}" for line in _lines(bag.metadata["tracker"])]
    netpos("replay", replay.live["10"], "--out", again, *settings)
    assert_same(again, replay.live["10"], ESTIMATES)


def test_a_live_replay_keeps_the_time_of_the_bag(replays: dict[str, Replays]) -> None:
    """At ten times real time too, so that the recording plays at its own pace again."""
    replay = replays["fast_pass"]
    with BagReader(replay.source) as source:
        begin_ns, end_ns = source.start_ns, source.end_ns
    for bag in replay.live.values():
        with BagReader(bag) as live:
            assert begin_ns <= live.start_ns < begin_ns + 10**9
            assert abs(live.end_ns - end_ns) < 10**9
            assert live.topics[ODOMETRY].count == len(messages(replay.source, ODOMETRY))


def _lines(text: str) -> list[str]:
    return [line for line in text.splitlines() if line]
