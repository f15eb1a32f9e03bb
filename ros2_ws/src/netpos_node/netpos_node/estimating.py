"""What the nodes that estimate have in common: order, silence, outputs, services."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, Protocol

from nav_msgs.msg import Odometry
from netpos.bags import cdr_codec
from netpos.common.kernel_memory import give_back_compiler
from netpos.messages import topics
from netpos.messages.fields import Frames
from netpos.messages.values import Odometry as Estimated
from netpos.messages.values import TrackStatus
from netpos.tracking import TrackOutput
from netpos_msgs.msg import ClockState
from netpos_msgs.msg import TrackStatus as TrackStatusMsg
from rclpy.clock import Clock, ClockType, JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from sensor_msgs.msg import NavSatFix
from std_srvs.srv import SetBool, Trigger
from tf2_msgs.msg import TFMessage

from netpos_node import (
    BACKLOG,
    CODEC,
    RELAXED,
    STREAM,
    declare,
    see_delivered,
    take_waiting,
    wait_until_heard,
)

if TYPE_CHECKING:
    from netpos.world.geodesy import Datum
    from netpos.world.map_to_odom import MapToOdom

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


_DONE, _FAILED = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


class EstimatingNode(LifecycleNode):
    """Feeds a ``Core``.

    Whoever spins the node hands messages over in the order of their arrival, so that no topic
    overtakes another.

    A lifecycle node: it has a core and offers its topics from ``configure`` on, listens and
    estimates from ``activate`` on, and keeps its tracks over ``deactivate``. Unless ``autostart``
    is false it does both by itself.
    """

    def __init__(self, name: str, **node_options: Any) -> None:
        super().__init__(name, **node_options)
        self._fault: Exception | None = None
        self._starts = False
        self._inputs: list[tuple[Subscription, Callable[[Any], None]]] = []
        self._timers_of_life: list[Timer] = []
        self._offers: list[Publisher | Service] = []
        self._jump_handle: Any = None
        self._forget_all()

    def _start_up(self) -> None:
        """Configure and activate unless told otherwise; last of all. Raises what a bad parameter
        raises."""
        text = "configure and activate at the start; false: wait for lifecycle transitions"
        if not declare(self, "autostart", True, text):
            self.get_logger().info("waits to be configured")
            return
        self._starts = True
        for step in (self.trigger_configure, self.trigger_activate):
            if step() is not _DONE and self._fault is not None:
                raise self._fault
        self._starts = False

    # life

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Make the core, offer topics and services."""
        done = self._done(self._configure)
        if done is _FAILED:
            self._clean_up()
        return done

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Listen and estimate."""
        done = self._done(self._activate)
        if done is _FAILED:
            self._stop_listening()
        return done

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Give out what follows from all that has arrived, and listen no more."""
        return self._done(self._deactivate)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Forget all tracks and take topics and services back."""
        return self._done(self._clean_up)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """The same, from any state."""
        if self.is_active:
            self._deactivate()
        return self._done(self._clean_up)

    def destroy_node(self) -> None:
        """Take the node out of the graph: rclpy keeps it there for as long as its state machine
        lives."""
        machine = self._state_machine
        super().destroy_node()
        machine.destroy_when_not_in_use()

    @property
    def is_active(self) -> bool:
        """Whether it listens."""
        return bool(self._inputs)

    def _done(self, step: Callable[[], None]) -> TransitionCallbackReturn:
        try:
            step()
        except Exception as error:  # rclpy would drop it
            self._fault = error
            if not self._starts:  # else it is raised
                self.get_logger().error(str(error) or repr(error))
            return _FAILED
        return _DONE

    def _configure(self) -> None:
        raise NotImplementedError

    def _activate(self) -> None:
        raise NotImplementedError

    def _deactivate(self) -> None:
        self._give_out()
        self._stop_listening()
        see_delivered(self)

    def _stop_listening(self) -> None:
        for subscription, _ in self._inputs:
            self.destroy_subscription(subscription)
        self._inputs = []
        for timer in self._timers_of_life:
            self.destroy_timer(timer)
        self._timers_of_life = []
        if self._tf_sub is not None:
            self.destroy_subscription(self._tf_sub)
            self._tf_sub = None
        if self._jump_handle is not None:
            self._jump_handle.unregister()
            self._jump_handle = None

    def _clean_up(self) -> None:
        for vue_id in list(self._outputs):
            self._remove_device(vue_id)
        for offer in self._offers:
            if isinstance(offer, Service):
                self.destroy_service(offer)
            else:
                self.destroy_publisher(offer)
        self._offers = []
        self._forget_all()

    def _offer(self, kind: Any, topic: str, qos: Any = STREAM) -> Publisher:
        """A publisher for as long as the node is configured."""
        publisher = self.create_publisher(kind, topics.to_resolve(topic), qos)
        self._offers.append(publisher)
        return publisher

    def _forget_all(self) -> None:
        self._outputs: dict[str, tuple[Publisher, ...]] = {}
        self._statuses: dict[str, TrackStatus] = {}
        self._told_s: dict[str, float] = {}
        self._seen_ns: dict[str, tuple[int, int]] = {}
        self._unheard_topics: set[str] = set()
        self._relaxed: set[str] = set()
        self._fix_pubs: dict[str, Publisher] = {}
        self._odoms: dict[str, MapToOdom] = {}
        self._tf_pub: Publisher | None = None
        self._tf_sub: Subscription | None = None

    def _begin(
        self,
        core: Core,
        *,
        publish_tf: bool,
        frames: Frames | None = None,
        datum: Datum | None = None,
    ) -> None:
        """Set up what all share; first of all when it is configured."""
        self._core = core
        self._frames, self._datum = frames or Frames(), datum
        self._cdr = cdr_codec(self._frames)
        self._heard_since_tick = False
        self._heard_s = time.monotonic()
        self._tick_ns = self._quiet_ns = 0
        if publish_tf:
            self._tf_pub = self.create_publisher(TFMessage, topics.TF, STREAM)
            self._offers.append(self._tf_pub)
        self._offers += [
            self.create_service(Trigger, "~/reset", self._on_reset),
            self.create_service(SetBool, "~/enable", self._on_enable),
        ]

    def _be_ready(self) -> None:
        """Transforms of others, timers and the watch over the clock; last of all when it is
        activated."""
        if self._frames.odom and self._tf_pub is not None:
            self._tf_sub = self.create_subscription(
                TFMessage, topics.TF, self._on_transforms, BACKLOG
            )
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # /clock may stand still
        self._heard_s = time.monotonic()
        self._timers_of_life = [
            self.create_timer(_SILENCE_S, self._on_silence_tick, clock=steady),
            self.create_timer(1.0, self._on_diagnostics_tick, clock=steady),
        ]
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
        topic = self.resolve_topic_name(topics.to_resolve(topic))

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
        found += [
            f"{vue_id}: no {self._frames.odom_of(vue_id)} -> {self._frames.base_of(vue_id)} on"
            f" {topics.TF} at the stamps of the estimates, so {self._frames.map} ->"
            f" {self._frames.odom_of(vue_id)} is not published"
            for vue_id, odom in self._odoms.items()
            if odom.is_lost
        ]
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
            self.create_publisher(kind, self._topic_of(vue_id, name, network), STREAM)
            for kind, name in outputs
        )
        if self._datum is not None:
            name = self._topic_of(vue_id, topics.FIX, network)
            self._fix_pubs[vue_id] = self.create_publisher(NavSatFix, name, STREAM)

    def _topic_of(self, vue_id: str, name: str, network: str = "") -> str:
        return topics.to_resolve(topics.of_vue(vue_id, name, network))

    def _remove_device(self, vue_id: str) -> None:
        """Give back the topics of a device that is no longer tracked, and tell nothing of it."""
        self._give_back(vue_id)
        for told in (self._statuses, self._told_s, self._seen_ns, self._odoms):
            told.pop(vue_id, None)

    def _give_back(self, vue_id: str) -> None:
        """Give back the topics of a device."""
        for publisher in (*self._outputs.pop(vue_id, ()), self._fix_pubs.pop(vue_id, None)):
            if publisher is not None:
                self.destroy_publisher(publisher)
        names = {
            self.resolve_topic_name(self._topic_of(vue_id, name)) for name in topics.DEVICE_INPUTS
        }
        mine = [s for s, _ in self._inputs if s.topic_name in names]
        self._inputs = [entry for entry in self._inputs if entry[0] not in mine]
        for subscription in mine:
            self.destroy_subscription(subscription)

    def _publish(self, outputs: list[TrackOutput]) -> None:
        for output in outputs:
            self._publish_one(output)

    def _publish_one(self, output: TrackOutput) -> None:
        vue_id = output.status.vue_id
        if vue_id not in self._outputs:
            self._add_outputs(vue_id, output.network)
        self._note(output.status)
        odometry_pub, clock_pub, status_pub, *smoothed_pub = self._outputs[vue_id]
        if output.odometry is not None:
            odometry_pub.publish(self._cdr.odometry(output.odometry))
            if self._datum is not None:
                self._fix_pubs[vue_id].publish(self._fix(output.odometry, self._datum))
            if not output.revised:
                self._publish_transform(output.odometry)
        if output.clock is not None:
            clock_pub.publish(self._cdr.clock_state(output.clock))
        status_pub.publish(self._cdr.track_status(output.status))
        for odometry in output.smoothed:
            smoothed_pub[0].publish(self._cdr.odometry(odometry))

    def _note(self, status: TrackStatus) -> None:
        """Keep the newest status of a device, for the diagnostics."""
        self._statuses[status.vue_id], self._told_s[status.vue_id] = status, time.monotonic()

    def _fix(self, odometry: Estimated, datum: Datum) -> Any:
        frame = self._frames.base_of(odometry.vue_id)
        place, cov = datum.fix(odometry.position, odometry.pose_cov[:3, :3])
        return CODEC.fix_to_msg(odometry.stamp_ns, frame, place, cov)

    def _publish_transform(self, odometry: Estimated) -> None:
        if self._tf_pub is None:
            return
        if not self._frames.odom:
            self._tf_pub.publish(self._cdr.transform(odometry))
            return
        joined = self._odom_of(odometry.vue_id)
        pose = odometry.stamp_ns, odometry.position, odometry.quaternion
        self._publish_map_to_odom(odometry.vue_id, joined.add_map(*pose))

    def _odom_of(self, vue_id: str) -> MapToOdom:
        if vue_id not in self._odoms:
            from netpos.world.map_to_odom import MapToOdom  # noqa: PLC0415 - brings SciPy

            self._odoms[vue_id] = MapToOdom()
        return self._odoms[vue_id]

    def _publish_map_to_odom(self, vue_id: str, poses: Iterable[Any]) -> None:
        for stamp_ns, position, quaternion in poses:
            assert self._tf_pub is not None
            cdr = self._cdr.map_to_odom(vue_id, stamp_ns, position, quaternion)
            self._tf_pub.publish(cdr)

    def _on_transforms(self, msg: Any) -> None:
        """Take odom -> base of the devices that are tracked; what else is on /tf is of others."""
        for transform in msg.transforms:
            named = transform.header.frame_id, transform.child_frame_id
            for vue_id in self._outputs:
                if named == (self._frames.odom_of(vue_id), self._frames.base_of(vue_id)):
                    pose = CODEC.pose_of_transform(transform)
                    self._publish_map_to_odom(vue_id, self._odom_of(vue_id).add_odom(*pose))

    def _publish_status(self, status: TrackStatus) -> None:
        """Give out a status without an estimate."""
        _, _, status_pub, *_ = self._outputs[status.vue_id]
        status_pub.publish(self._cdr.track_status(status))

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
        if self.is_active:
            self._give_out()
        see_delivered(self)

    def _give_out(self) -> None:
        for waiting in self._inputs:
            take_waiting(*waiting)
        self._publish(self._core.flush())

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
