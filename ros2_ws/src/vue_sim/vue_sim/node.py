"""Device node: plays a scenario's devices in real time or a multiple of it."""

from __future__ import annotations

import sys
import time
from contextlib import suppress
from threading import Thread
from typing import Any

from netpos.messages.topics import (
    BEACON,
    CLOCK,
    IMU,
    INITIAL_POSE,
    MAG,
    RUN_SCENARIO,
    split,
    to_resolve,
)
from netpos.messages.values import InitialPose
from netpos.scenario import Simulation
from netpos.scenario.load import scenario_text
from netpos.scenario.offline import timeline
from netpos_node import LATCHED, STREAM, run, say_of_run, wait_until_heard
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node

from vue_sim.conversions import publication, publications
from vue_sim.parameters import declare_parameters

_CLOCK_DEPTH = 10
_INPUTS = (BEACON, INITIAL_POSE)  # what others need from the first message on
_STEPS_INPUTS = (IMU, MAG)  # what dead reckoning needs of who walks
_POLL_S = 0.02
_TOLD_EVERY_S = 5.0
_DELIVERY_S = 5
_STALL_S = 0.05  # further behind than this, what is lost is not caught up with


class Pace:
    """Simulated time against the wall clock.

    After a stall it goes on at its rate: a burst of all that was due meanwhile would reach the
    other nodes as if each of them had been stalled.
    """

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._started_s: float | None = None
        self.lost_s = 0.0
        """Wall time [s] by which the simulation is behind its rate."""

    def wait(self, simulated_s: float) -> None:
        """Return when so much of simulated time is due; the first call is never early."""
        now_s = time.monotonic()
        if self._started_s is None:
            self._started_s = now_s - simulated_s / self._rate
        late_s = now_s - self._started_s - simulated_s / self._rate
        if late_s < 0.0:
            time.sleep(-late_s)
        elif late_s > _STALL_S:
            self._started_s += late_s
            self.lost_s += late_s


class VueSimNode(Node):
    """Publishes the timeline of a ``Simulation``, paced by the wall clock."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__("vue_sim", **node_options)
        self._settings = declare_parameters(self)
        self._simulation = Simulation(self._settings.scenario)
        self._pubs = {
            topic: self.create_publisher(message_class, to_resolve(topic), _qos(topic))
            for topic, message_class in publications(self._settings.scenario).items()
        }
        facts = {
            "scenario": scenario_text(self._settings.scenario),
            "rate": f"{self._settings.rate:g}",
        }
        say_of_run(self, RUN_SCENARIO, facts)

    def play(self) -> None:
        """Wait to be heard, publish everything at its time, wait for delivery."""
        scenario, rate = self._settings.scenario, self._settings.rate
        self._wait_for_subscribers()
        self.get_logger().info(
            f"{scenario.name}, seed {scenario.seed}: {', '.join(scenario.vue_ids)} for "
            f"{scenario.duration_s:.1f} s at rate {rate:g}"
        )
        self._hand_over_initial_poses()
        pace = Pace(rate)
        told_s = time.monotonic()
        for item in timeline(self._simulation, self._settings.clock_hz):
            if isinstance(item, InitialPose):
                continue
            topic, stamp_ns, message = publication(item)
            pace.wait((stamp_ns - scenario.start_ns) * 1e-9)
            if not self.context.ok():
                return
            self._pubs[topic].publish(message)
            if time.monotonic() - told_s > _TOLD_EVERY_S:
                told_s = time.monotonic()
                past_s = (stamp_ns - scenario.start_ns) * 1e-9
                self.get_logger().info(f"simulated {past_s:.0f} of {scenario.duration_s:.0f} s")
        for publisher in self._pubs.values():
            publisher.wait_for_all_acked(Duration(seconds=_DELIVERY_S))
        self.get_logger().info(f"{scenario.name} is over{_told(pace.lost_s)}")
        while not self._settings.shutdown_at_end and self.context.ok():
            time.sleep(_POLL_S)

    def _hand_over_initial_poses(self) -> None:
        """Before anything moves, and only once: a lone message that is lost is repaired late."""
        for vue_id in self._settings.scenario.vue_ids:
            pose = self._simulation.initial_pose(vue_id)
            if pose is not None:
                topic, _, message = publication(pose)
                self._pubs[topic].publish(message)
                self._pubs[topic].wait_for_all_acked(Duration(seconds=_DELIVERY_S))

    def _wait_for_subscribers(self) -> None:
        """Until all beacons are heard and for a while nobody new has subscribed to anything."""
        settings = self._settings
        inputs = {
            topic: settings.subscribers
            for topic in self._pubs
            if split(topic)[1] in _INPUTS
            or (split(topic)[0] in settings.scenario.walkers and split(topic)[1] in _STEPS_INPUTS)
        }
        unheard = wait_until_heard(
            self._pubs, inputs, settings.wait_for_subscribers_s, settings.settle_s
        )
        if unheard:
            self.get_logger().warning(
                f"{', '.join(unheard)}: fewer than {settings.subscribers} subscribers; are "
                "rsu_sensor, ekf_tracker and, for who walks, pdr_node running? Starting anyway"
            )


def _qos(topic: str) -> Any:
    """A pose is latched: whoever tracks may start late, or again."""
    if split(topic)[1] == INITIAL_POSE:
        return LATCHED
    return _CLOCK_DEPTH if topic == CLOCK else STREAM


def _told(lost_s: float) -> str:
    """What to say of stalls."""
    return f"; {lost_s:.1f} s behind its rate: this machine had no time" if lost_s else ""


def _play(node: Node) -> None:
    """Play, with the node's services answered by a second thread."""
    assert isinstance(node, VueSimNode)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    services = Thread(target=_serve, args=[executor])
    services.start()
    try:
        node.play()
    finally:
        executor.shutdown()
        services.join()


def _serve(executor: SingleThreadedExecutor) -> None:
    with suppress(ExternalShutdownException):
        executor.spin()


def main() -> None:
    """Entry point of ``ros2 run vue_sim vue_sim``."""
    run(VueSimNode, _play, sys.argv[1:])
