"""What the nodes that estimate have in common: order, silence, outputs, services."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterable
from typing import Any, Protocol

from nav_msgs.msg import Odometry
from netpos.kernel_memory import give_back_compiler
from netpos.messages import topics
from netpos.messages.values import TrackStatus
from netpos.tracking import TrackOutput
from netpos_msgs.msg import ClockState
from netpos_msgs.msg import TrackStatus as TrackStatusMsg
from rclpy.clock import Clock, ClockType, JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from std_srvs.srv import SetBool, Trigger
from tf2_msgs.msg import TFMessage

from netpos_node import (
    BACKLOG,
    CDR,
    RELAXED,
    STREAM,
    see_delivered,
    take_waiting,
    wait_until_heard,
)

_SILENCE_S = 2.0  # long: a stalled machine must not look like the end of the measurements
_PATIENCE_S = 30.0
_RELAXED = "best effort or volatile, as one of its publishers offers no more; what is lost is lost"
_STALE_S = 3.0  # a device, or all of them, unheard for so long shows in the diagnostics


class Core(Protocol):
    """What such a node feeds."""

    enabled: bool

    def process(self) -> list[TrackOutput]:
        """Estimates of all that is complete."""

    def flush(self) -> list[TrackOutput]:
        """Estimates of all that is pending."""

    def reset(self) -> None:
        """Forget all tracks."""


class EstimatingNode(Node):
    """Feeds a ``Core``.

    Whoever spins the node hands messages over in the order of their arrival, so that no topic
    overtakes another.
    """

    def _begin(self, core: Core, *, publish_tf: bool) -> None:
        """Set up what all share; first of all."""
        self._core = core
        self._inputs: list[tuple[Subscription, Callable[[Any], None]]] = []
        self._outputs: dict[str, tuple[Publisher, ...]] = {}
        self._statuses: dict[str, TrackStatus] = {}
        self._told_s: dict[str, float] = {}
        self._seen_ns: dict[str, tuple[int, int]] = {}
        self._unheard_topics: set[str] = set()
        self._relaxed: set[str] = set()
        self._heard_since_tick = False
        self._heard_s = time.monotonic()
        self._tick_ns = self._quiet_ns = 0
        self._tf_pub = self.create_publisher(TFMessage, topics.TF, STREAM) if publish_tf else None

    def _be_ready(self) -> None:
        """Services, timers and the watch over the clock; last of all."""
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_service(SetBool, "~/enable", self._on_enable)
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # /clock may stand still
        self.create_timer(_SILENCE_S, self._on_silence_tick, clock=steady)
        self.create_timer(1.0, self._on_diagnostics_tick, clock=steady)
        threshold = JumpThreshold(
            min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=False
        )
        self._jump_handle = self.get_clock().create_jump_callback(
            threshold, post_callback=self._on_clock_jump
        )
        gc.collect()
        gc.freeze()  # what is here stays: looking at it again stalls a tracker of many devices
        give_back_compiler()

    def _wait_for_subscribers(self, wanted: int, extra: Iterable[Publisher] = ()) -> None:
        """Hear no measurement before the estimates are heard: what is given out is then seen.
        Publishers ``extra`` need one subscriber more."""
        publishers = {pub.topic_name: pub for pubs in self._outputs.values() for pub in pubs}
        required = dict.fromkeys(publishers, wanted)
        for pub in extra if wanted else ():
            publishers[pub.topic_name], required[pub.topic_name] = pub, wanted + 1
        unheard = wait_until_heard(publishers, required, _PATIENCE_S, settle_s=0.0)
        if unheard:
            self.get_logger().warning(
                f"fewer than {wanted} subscribers to {', '.join(unheard)}; going on all the same"
            )

    # inputs

    def _listen(
        self,
        msg_type: Any,
        topic: str,
        handler: Callable[[Any], None],
        qos: Any = BACKLOG,
        *,
        raw: bool = False,
    ) -> None:
        def on_message(msg: Any) -> None:
            self._heard_since_tick = True
            self._heard_s = time.monotonic()
            handler(msg)
            self._publish(self._core.process())

        heard = any(sub.topic_name == topic for sub, _ in self._inputs)
        events = SubscriptionEventCallbacks(
            incompatible_qos=lambda _: None if heard else self._unheard_topics.add(topic)
        )
        subscription = self.create_subscription(
            msg_type, topic, on_message, qos, raw=raw, event_callbacks=events
        )
        self._inputs.append((subscription, on_message))

    def _hear_all(self) -> None:
        """Ask for less of the publishers of topics that offer less than was asked for."""
        topics_, self._unheard_topics = self._unheard_topics, set()
        for topic in topics_:
            for at, (old, on_message) in enumerate(self._inputs):
                if old.topic_name != topic or topic in self._relaxed:
                    continue
                take_waiting(old, on_message)
                new = self.create_subscription(
                    old.msg_type, topic, on_message, RELAXED, raw=old.raw
                )
                if old.qos_profile.durability is DurabilityPolicy.TRANSIENT_LOCAL:
                    self._inputs.append((new, on_message))  # what others keep comes by the old one
                else:
                    self._inputs[at] = new, on_message
                    self.destroy_subscription(old)
                self._relaxed.add(topic)
                self.get_logger().warning(f"{topic}: {_RELAXED}")
                break

    def _input_warnings(self) -> list[str]:
        """What is unusual about who is heard, and who else publishes what this node does."""
        found = [f"{topic}: {_RELAXED}" for topic in sorted(self._relaxed)]
        for publishers in self._outputs.values():
            topic = publishers[0].topic_name
            if self.count_publishers(topic) > 1:
                found.append(
                    f"another node publishes {topic} too: stop it, or set another ROS_DOMAIN_ID"
                )
        if self.count_publishers(topics.CLOCK) > 1:
            found.append(f"more than one node publishes {topics.CLOCK}")
        return found

    def _read(self, cdr: bytes, kind: Any) -> Any | None:
        """The message in these bytes; None, and a word, where it is none of this kind."""
        try:
            return deserialize_message(cdr, kind)
        except rclpy_implementation.RMWError:
            self.get_logger().error(
                f"refused {len(cdr)} bytes that are no {kind.__name__}; is its sender built with"
                " other message definitions?",
                throttle_duration_sec=2.0,
            )
            return None

    # outputs

    def _add_outputs(self, vue_id: str, network: str = "", *, smoothed: bool = False) -> None:
        outputs = [
            (Odometry, topics.ODOMETRY),
            (ClockState, topics.CLOCK_STATE),
            (TrackStatusMsg, topics.TRACK_STATUS),
        ]
        if smoothed:
            outputs.append((Odometry, topics.ODOMETRY_SMOOTHED))
        self._outputs[vue_id] = tuple(
            self.create_publisher(kind, topics.of_vue(vue_id, name, network), STREAM)
            for kind, name in outputs
        )

    def _remove_device(self, vue_id: str) -> None:
        """Give back the topics of a device that is no longer tracked."""
        for publisher in self._outputs.pop(vue_id, ()):
            self.destroy_publisher(publisher)
        mine = [s for s, _ in self._inputs if topics.split(s.topic_name)[0] == vue_id]
        self._inputs = [entry for entry in self._inputs if entry[0] not in mine]
        for subscription in mine:
            self.destroy_subscription(subscription)
        for told in (self._statuses, self._told_s, self._seen_ns):
            told.pop(vue_id, None)

    def _publish(self, outputs: list[TrackOutput]) -> None:
        for output in outputs:
            self._publish_one(output)

    def _publish_one(self, output: TrackOutput) -> None:
        vue_id = output.status.vue_id
        if vue_id not in self._outputs:
            self._add_outputs(vue_id, output.network)
        self._statuses[vue_id], self._told_s[vue_id] = output.status, time.monotonic()
        odometry_pub, clock_pub, status_pub, *smoothed_pub = self._outputs[vue_id]
        if output.odometry is not None:
            odometry_pub.publish(CDR.odometry(output.odometry))
            if self._tf_pub is not None and not output.revised:
                self._tf_pub.publish(CDR.transform(output.odometry))
        if output.clock is not None:
            clock_pub.publish(CDR.clock_state(output.clock))
        status_pub.publish(CDR.track_status(output.status))
        for odometry in output.smoothed:
            smoothed_pub[0].publish(CDR.odometry(odometry))

    def _publish_status(self, status: TrackStatus) -> None:
        """Give out a status without an estimate."""
        _, _, status_pub, *_ = self._outputs[status.vue_id]
        status_pub.publish(CDR.track_status(status))

    def _on_diagnostics_tick(self) -> None:
        self._hear_all()
        self._note_stamps()
        self._publish_diagnostics()

    def _publish_diagnostics(self) -> None:
        raise NotImplementedError

    def _now_ns(self, vue_ids: Iterable[str]) -> dict[str, int]:
        """The time of devices by their own stamps: the newest, and what this node's clock has gone
        since it was seen here."""
        now_ns = self.get_clock().now().nanoseconds
        found = {}
        for vue_id in vue_ids:
            stamp_ns, seen_ns = self._seen_ns[vue_id]
            found[vue_id] = stamp_ns + max(now_ns - seen_ns, 0)
        return found

    def _note_stamps(self) -> None:
        """Note when, by this node's clock, the newest stamps of devices were first seen."""
        now_ns = self.get_clock().now().nanoseconds
        for vue_id, status in self._statuses.items():
            if self._seen_ns.get(vue_id, (-1, 0))[0] != status.stamp_ns:
                self._seen_ns[vue_id] = status.stamp_ns, now_ns

    def _unheard_s(self) -> float:
        """Seconds since anything was heard, 0 while it is not long."""
        unheard_s = time.monotonic() - self._heard_s
        return unheard_s if unheard_s >= _STALE_S else 0.0

    def _silent_s(self) -> dict[str, float]:
        """Devices nothing was told of for long, and how long [s]."""
        now_s = time.monotonic()
        return {v: now_s - at_s for v, at_s in self._told_s.items() if now_s - at_s >= _STALE_S}

    def finish(self) -> None:
        """Give out what still follows from all that has arrived, and see it delivered."""
        for waiting in self._inputs:
            take_waiting(*waiting)
        self._publish(self._core.flush())
        see_delivered(self)

    # time and services

    def _on_silence_tick(self) -> None:
        now_ns = self.get_clock().now().nanoseconds
        if self._heard_since_tick:
            self._quiet_ns = now_ns
        elif not self._is_played_slowly(now_ns):
            self._publish(self._core.flush())
        self._tick_ns, self._heard_since_tick = now_ns, False

    def _is_played_slowly(self, now_ns: int) -> bool:
        """Whether what is silent by the wall clock is not by a simulated one, which goes on."""
        quiet = now_ns - self._quiet_ns >= 1e9 * _SILENCE_S
        goes_on = self.get_clock().ros_time_is_active and now_ns != self._tick_ns
        return bool(goes_on and not quiet)

    def _on_clock_jump(self, jump: TimeJump) -> None:
        self.get_logger().warning("the clock jumped back: all tracks start anew")
        self._core.reset()

    def _on_reset(self, _: Any, response: Any) -> Any:
        self._core.reset()
        response.success, response.message = True, "all tracks start anew"
        return response

    def _on_enable(self, request: Any, response: Any) -> Any:
        self._core.enabled = bool(request.data)
        response.success = True
        response.message = "enabled" if request.data else "disabled: measurements are refused"
        return response
