#!/usr/bin/env python3
"""What attackers do to a live tracker: real processes, each trial in a ROS domain of its own.

    python scripts/hostile_trials.py [--trial NAME ...] [--seconds 20] [--json FILE]

Five devices go in circles between four honest RSUs, 10 Hz. After 5 s another process attacks; all
it says is of vue_1, or of names that nobody carries. Prints a row of a table for each trial.
"""

from __future__ import annotations

import argparse
import json
import math
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from netpos.bench.domains import claim_domain
from netpos.bench.live import executable, surroundings
from netpos.messages import topics
from netpos.messages.values import Field, InitialPose, RsuInfo, RsuMeasurement, TrackState

NS = 1_000_000_000
PERIOD_S, SETTLED_S = 0.1, 5.0
RANGE_SD_M, AZIMUTH_SD_RAD = 0.5, math.radians(2.0)
SITES = {"a": (0.0, 0.0), "b": (120.0, 0.0), "c": (120.0, 100.0), "d": (0.0, 100.0)}
VUES = tuple(f"vue_{k}" for k in range(1, 6))
VICTIM = VUES[0]
Message = tuple[str, Any]
"""Topic, and the value that is published on it."""


def info(name: str, x: float, y: float) -> RsuInfo:
    return RsuInfo(rsu_id=name, position=np.array([x, y, 8.0]))


HONEST = {name: info(name, x, y) for name, (x, y) in SITES.items()}


def place(vue_id: str, t_s: float) -> np.ndarray:
    """Where a device is: on a circle of its own."""
    k = VUES.index(vue_id) if vue_id in VUES else 0
    angle = 0.2 * t_s + 1.3 * k
    return np.array([60.0 + (15.0 + 5.0 * k) * math.cos(angle), 50.0 + 30.0 * math.sin(angle), 0])


def measured(
    rsu: RsuInfo, vue_id: str, t_s: float, at: np.ndarray, rng: np.random.Generator
) -> RsuMeasurement:
    """Range and azimuth of what is at a place."""
    x, y, z = at - rsu.position
    return RsuMeasurement(
        stamp_ns=NS + round(t_s * NS),
        rsu_id=rsu.rsu_id,
        vue_id=vue_id,
        expected=len(HONEST),
        fields=Field.RANGE | Field.AZIMUTH,
        range_m=math.sqrt(x * x + y * y + z * z) + float(rng.normal(0.0, RANGE_SD_M)),
        range_var=RANGE_SD_M**2,
        azimuth_rad=math.atan2(y, x) + float(rng.normal(0.0, AZIMUTH_SD_RAD)),
        azimuth_var=AZIMUTH_SD_RAD**2,
    )


# attacks: what is sent at a time of the run


def of_invented_names(t_s: float, rng: np.random.Generator) -> list[Message]:
    """One RSU's range and direction of a name that nobody carries: enough for a fix."""
    name = f"made_up_{round(1000.0 * t_s) % 5000}"
    found = measured(HONEST["a"], name, t_s, place(VICTIM, t_s), rng)
    return [(topics.RSU_MEASUREMENTS, found)]


def of_an_unknown_rsu(t_s: float, rng: np.random.Generator) -> list[Message]:
    """One measurement of an RSU without a description."""
    found = measured(HONEST["a"], VICTIM, t_s, place(VICTIM, t_s), rng)
    return [(topics.RSU_MEASUREMENTS, replace(found, rsu_id="flooder"))]


def in_a_known_name(t_s: float, rng: np.random.Generator) -> list[Message]:
    """One measurement in the name of an honest RSU, of a device 30 m away."""
    away = place(VICTIM, t_s) + np.array([21.0, 21.0, 0.0])
    return [(topics.RSU_MEASUREMENTS, measured(HONEST["a"], VICTIM, t_s, away, rng))]


def of_moved_rsus(t_s: float, _: np.random.Generator) -> list[Message]:
    """Descriptions of all RSUs, 50 m aside."""
    aside = np.array([50.0, 0.0, 0.0])
    infos = [replace(rsu, position=rsu.position + aside) for rsu in HONEST.values()]
    return [(topics.RSU_INFO, rsu) for rsu in infos]


def of_invented_rsus(t_s: float, rng: np.random.Generator) -> list[Message]:
    """Five RSUs that nobody built, which agree on a place 30 m away."""
    away = place(VICTIM, t_s) + np.array([21.0, 21.0, 0.0])
    sites = [(30.0, -20.0), (90.0, -20.0), (140.0, 50.0), (60.0, 120.0), (-20.0, 50.0)]
    rsus = [info(f"new_{k}", x, y) for k, (x, y) in enumerate(sites)]
    lies = [(topics.RSU_MEASUREMENTS, measured(rsu, VICTIM, t_s, away, rng)) for rsu in rsus]
    return [*((topics.RSU_INFO, rsu) for rsu in rsus), *lies]


def of_a_far_pose(t_s: float, _: np.random.Generator) -> list[Message]:
    """An initial pose 100 km away, sure to a millimetre."""
    pose = InitialPose(
        stamp_ns=NS + round(t_s * NS),
        vue_id=VICTIM,
        position=np.array([1e5, 0.0, 0.0]),
        cov=np.eye(3) * 1e-6,
    )
    return [(topics.of_vue(VICTIM, topics.INITIAL_POSE), pose)]


@dataclass(frozen=True)
class Attack:
    """What is sent, and how often [Hz]."""

    words: str
    rate_hz: float
    messages: Callable[[float, np.random.Generator], list[Message]]


ATTACKS = {
    "none": Attack("nobody", 0.0, of_a_far_pose),
    "names": Attack("5000 invented names, 1000 messages/s", 1000.0, of_invented_names),
    "unknown": Attack("5000 messages/s of an unknown RSU", 5000.0, of_an_unknown_rsu),
    "known": Attack("5000 false values/s in a known name", 5000.0, in_a_known_name),
    "slow": Attack("20 false values/s in a known name", 20.0, in_a_known_name),
    "moved": Attack("RsuInfo of all RSUs 50 m aside", 1.0, of_moved_rsus),
    "rsus": Attack("five invented RSUs that agree", 10.0, of_invented_rsus),
    "pose": Attack("an initial pose 100 km away, sd 1 mm", 1.0, of_a_far_pose),
}


def attack(name: str, begin_s: float, seconds: float) -> None:
    """Send; ``begin_s``: when the run began, by the monotonic clock of this machine."""
    # ROS is loaded where it is needed: the table of attacks needs none.
    from netpos_bringup.bench_common import Probe  # noqa: PLC0415
    from netpos_node import init  # noqa: PLC0415

    init()
    probe, rng, sent, chosen = Probe(()), np.random.default_rng(9), 0, ATTACKS[name]
    publish = Publishers(probe.node)
    for topic, value in chosen.messages(0.0, np.random.default_rng(9)):
        publish.of(topic, value)
    start_s = begin_s + SETTLED_S
    while (now_s := time.monotonic()) < begin_s + seconds:
        due = math.floor((now_s - start_s) * chosen.rate_hz)
        for k in range(sent, min(due, sent + 200)):
            for topic, value in chosen.messages(SETTLED_S + k / chosen.rate_hz, rng):
                publish(topic, value)
            sent += 1
        time.sleep(0.001)
    print(json.dumps({"sent": sent}))


class Publishers:
    """Publishes values on their topics."""

    def __init__(self, node: Any) -> None:
        from geometry_msgs.msg import PoseWithCovarianceStamped  # noqa: PLC0415
        from netpos_msgs.msg import RsuInfo as Info  # noqa: PLC0415
        from netpos_msgs.msg import RsuMeasurement as Measurement  # noqa: PLC0415
        from netpos_node import BACKLOG, CODEC, LATCHED  # noqa: PLC0415

        self._node, self._made = node, {}
        self._kinds = {
            RsuInfo: (Info, CODEC.rsu_info_to_msg, LATCHED),
            RsuMeasurement: (Measurement, CODEC.measurement_to_msg, BACKLOG),
            InitialPose: (PoseWithCovarianceStamped, CODEC.initial_pose_to_msg, BACKLOG),
        }

    def of(self, topic: str, value: Any) -> Any:
        """The publisher of a topic."""
        if topic not in self._made:
            kind, _, qos = self._kinds[type(value)]
            self._made[topic] = self._node.create_publisher(kind, topic, qos)
        return self._made[topic]

    def __call__(self, topic: str, value: Any) -> None:
        self.of(topic, value).publish(self._kinds[type(value)][1](value))


# the honest side


@dataclass
class Heard:
    """What came of one device: lag by stamp, and by stamp odometry and status."""

    lag_s: dict[int, float] = field(default_factory=dict)
    error_m: dict[int, float] = field(default_factory=dict)
    level_m: dict[int, float] = field(default_factory=dict)
    tracking: set[int] = field(default_factory=set)


class Run:
    """The honest traffic, and what the tracker says to it."""

    def __init__(self, probe: Any) -> None:
        from nav_msgs.msg import Odometry  # noqa: PLC0415
        from netpos_msgs.msg import TrackStatus  # noqa: PLC0415

        self.probe, self.publish = probe, Publishers(probe.node)
        self.heard = {vue: Heard() for vue in VUES}
        self._odometry = {v: probe.listen(Odometry, f"/{v}/odometry") for v in VUES}
        self._status = {v: probe.listen(TrackStatus, f"/{v}/track_status") for v in VUES}
        self._kinds, self._rng = (Odometry, TrackStatus), np.random.default_rng(5)
        self._sent_s: dict[tuple[str, int], float] = {}
        self.epochs = 0

    def go(self, begin_s: float, seconds: float, settled: Callable[[], None]) -> None:
        """Send until the end, and hear what is still under way; ``settled`` is called before the
        attack begins."""
        for k in range(round(seconds / PERIOD_S)):
            if k == round(SETTLED_S / PERIOD_S) - 1:
                settled()
            for n, vue in enumerate(VUES):
                due_s = begin_s + (k + n / len(VUES)) * PERIOD_S
                while time.monotonic() < due_s:
                    self._hear()
                    time.sleep(0.001)
                self._send(vue, k * PERIOD_S)
            self.epochs += k * PERIOD_S >= SETTLED_S
        end_s = time.monotonic() + 2.0
        while time.monotonic() < end_s:
            self._hear()
            time.sleep(0.002)

    def _send(self, vue: str, t_s: float) -> None:
        messages = [measured(r, vue, t_s, place(vue, t_s), self._rng) for r in HONEST.values()]
        for m in messages:
            self.publish(topics.RSU_MEASUREMENTS, m)
        self._sent_s[vue, messages[0].stamp_ns] = time.monotonic()

    def _hear(self) -> None:
        from netpos_bringup.bench_common import stamp_of, taken  # noqa: PLC0415
        from rclpy.serialization import deserialize_message  # noqa: PLC0415

        now_s = time.monotonic()
        for vue, heard in self.heard.items():
            for cdr in taken(self._odometry[vue]):
                stamp = stamp_of(cdr)
                sent_s = self._sent_s.pop((vue, stamp), None)
                if sent_s is not None:
                    heard.lag_s[stamp] = now_s - sent_s
                at = deserialize_message(cdr, self._kinds[0]).pose.pose.position
                x, y, _ = place(vue, (stamp - NS) / NS)
                heard.error_m[stamp] = math.hypot(at.x - x, at.y - y)
            for cdr in taken(self._status[vue]):
                status = deserialize_message(cdr, self._kinds[1])
                stamp = status.header.stamp.sec * NS + status.header.stamp.nanosec
                heard.level_m[stamp] = status.protection_level
                known = status.state == int(TrackState.TRACKING)
                (heard.tracking.add if known else heard.tracking.discard)(stamp)

    def figures(self, vues: tuple[str, ...]) -> dict[str, float]:
        """Of these devices, from the attack on."""
        first = NS + round(SETTLED_S * NS)
        kept = [self.heard[v] for v in vues]
        lags = [s for h in kept for t, s in h.lag_s.items() if t >= first]
        errors = [(h, t, e) for h in kept for t, e in h.error_m.items() if t >= first]
        tracked = [(h, t, e) for h, t, e in errors if t in h.tracking]
        median, p99 = np.percentile(lags, [50, 99]) if lags else (math.inf, math.inf)
        return {
            "median_ms": 1e3 * float(median),
            "p99_ms": 1e3 * float(p99),
            "missing": self.epochs * len(vues) - len(lags),
            "error_m": max((e for _, _, e in errors), default=math.inf),
            "tracking": len(tracked),
            "beyond": sum(e > h.level_m.get(t, math.inf) for h, t, e in tracked),
        }


def trial(name: str, seconds: float) -> dict[str, Any]:
    """One attack on a tracker of its own, in the domain of this process."""
    from netpos_bringup.bench_common import Probe, started, wait_for  # noqa: PLC0415
    from netpos_node import init  # noqa: PLC0415

    init()
    probe = Probe(HONEST.values())
    run = Run(probe)
    vues = ",".join(f"'{v}'" for v in VUES)
    tracker = [
        str(executable("ekf_tracker", "ekf_tracker")),
        "--ros-args",
        "-p",
        f"vues:=[{vues}]",
    ]
    with started(tracker) as (process,):
        said = Diagnosis(probe)
        wait_for(
            lambda: (
                probe.tracker.get_subscription_count()
                and all(probe.node.count_publishers(f"/{v}/odometry") for v in VUES)
            ),
            "the tracker",
            [process],
        )
        begin_s = time.monotonic() + 3.0
        memory: list[float] = []
        command = [sys.executable, __file__, "attack", name, str(begin_s), str(seconds)]
        with started(*([] if name == "none" else [command])):
            run.go(begin_s, seconds, lambda: memory.append(process.memory_mb()))
            named = said.named()
        process.check()
        publishers = sum(
            "odometry" in topic for topic, _ in probe.node.get_topic_names_and_types()
        )
        return {
            "attack": ATTACKS[name].words,
            "victim": run.figures((VICTIM,)),
            "others": run.figures(VUES[1:]),
            "memory_mb": process.memory_mb() - memory[0],
            "odometry_topics": publishers,
            "named": named,
        }


class Diagnosis:
    """What /diagnostics names."""

    def __init__(self, probe: Any) -> None:
        from diagnostic_msgs.msg import DiagnosticArray  # noqa: PLC0415

        self._kind, self._heard = (
            DiagnosticArray,
            probe.listen(DiagnosticArray, topics.DIAGNOSTICS),
        )

    def named(self) -> list[str]:
        """Subjects, not honest devices, that are not well, and what is said of them."""
        return list(self._newest())

    def _newest(self) -> Iterator[str]:
        from netpos_bringup.bench_common import taken  # noqa: PLC0415
        from rclpy.serialization import deserialize_message  # noqa: PLC0415

        arrays = [deserialize_message(cdr, self._kind) for cdr in taken(self._heard)]
        for status in arrays[-1].status if arrays else []:
            subject = status.name.removeprefix("ekf_tracker: ")
            if status.level != b"\x00":
                yield f"{subject}: {status.message}"
            elif poses := [v.value for v in status.values if "initialpose" in v.key]:
                yield f"{subject}: initialpose refused {poses[0]} times"


def row(found: dict[str, Any]) -> str:
    """A row of the table."""
    victim, others = found["victim"], found["others"]
    cells = [
        found["attack"],
        *(f"{v['median_ms']:.1f}, {v['p99_ms']:.0f}" for v in (victim, others)),
        f"{victim['missing']:.0f}, {others['missing']:.0f}",
        f"{victim['error_m']:.2f}, {others['error_m']:.2f}",
        f"{victim['beyond']} of {victim['tracking']}, {others['beyond']} of {others['tracking']}",
        f"{found['memory_mb']:+.1f}",
        str(found["odometry_topics"]),
        "; ".join(found["named"][:2]) or "nothing",
    ]
    return f"| {' | '.join(cells)} |"


HEAD = (
    "| attack | victim: lag median, 99 % [ms] | others | odometry missing: victim, others"
    " | largest error [m] | TRACKING beyond the level | memory [MB] | odometry topics"
    " | /diagnostics names |\n|---|---|---|---|---|---|---|---|---|"
)


def all_trials(names: list[str], seconds: float) -> Iterator[dict[str, Any]]:
    """Each in a process and a domain of its own."""
    for name in names:
        command = [sys.executable, __file__, "trial", name, str(seconds)]
        with (
            claim_domain() as domain,
            subprocess.Popen(
                command, stdout=subprocess.PIPE, text=True, env=surroundings(domain)
            ) as process,
        ):
            out, _ = process.communicate(timeout=120.0 + 2.0 * seconds)
        if process.returncode:
            raise SystemExit(f"{name}: the trial ended with exit code {process.returncode}")
        yield {"trial": name, **json.loads(out)}


def main() -> int:
    if sys.argv[1:2] == ["attack"]:
        attack(sys.argv[2], float(sys.argv[3]), float(sys.argv[4]))
        return 0
    if sys.argv[1:2] == ["trial"]:
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
        print(json.dumps(trial(sys.argv[2], float(sys.argv[3]))), flush=True)
        return 0
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--trial", nargs="+", choices=list(ATTACKS), default=list(ATTACKS))
    parser.add_argument("--seconds", type=float, default=20.0, help="of each, from the first on")
    parser.add_argument("--json", type=Path, help="write the figures here")
    given = parser.parse_args()
    print(HEAD, flush=True)
    found = []
    for one in all_trials(given.trial, given.seconds):
        found.append(one)
        print(row(one), flush=True)
    if given.json is not None:
        given.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
