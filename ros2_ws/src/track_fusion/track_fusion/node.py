"""Fusion node: tracks of several networks in, one odometry per device out."""

from __future__ import annotations

import sys
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from netpos.messages import topics
from netpos.scenario.settings import fusion_fact
from netpos.tracking.networks.tertiary import TrackFusion
from netpos_msgs.msg import NetworkTrack
from netpos_node import run, say_of_run
from netpos_node.estimating import EstimatingNode

from track_fusion.conversions import diagnostics_to_msg, network_track_from_msg
from track_fusion.parameters import declare_parameters


class TrackFusionNode(EstimatingNode):
    """Feeds a ``TrackFusion``."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__("track_fusion", **node_options)
        self._chosen = declare_parameters(self)
        self._start_up()

    def _configure(self) -> None:
        parameters = self._chosen
        self._fusion = TrackFusion(parameters.networks, parameters.config)
        frames = parameters.config.frames
        self._begin(self._fusion, publish_tf=parameters.publish_tf, frames=frames)
        self._diagnostics_pub = self._offer(DiagnosticArray, topics.DIAGNOSTICS, 10)
        for vue_id in parameters.vue_ids:
            self._add_outputs(vue_id)
        fact = fusion_fact(parameters.networks, parameters.config)
        self._offers.append(say_of_run(self, topics.RUN_ESTIMATOR, fact))

    def _activate(self) -> None:
        parameters = self._chosen
        self._wait_for_subscribers(parameters.subscribers)
        for network in parameters.networks:
            self._listen(NetworkTrack, topics.tracks_of(network), self._on_track)
        self._be_ready()
        self.get_logger().info(f"fusing the tracks of {', '.join(parameters.networks)}")

    def _on_track(self, msg: Any) -> None:
        track = network_track_from_msg(msg)
        reason = self._fusion.add(track)
        if reason is not None:
            self.get_logger().warning(
                f"refused a track of {track.network!r}: {reason}", throttle_duration_sec=2.0
            )

    def _publish_diagnostics(self) -> None:
        self._diagnostics_pub.publish(
            diagnostics_to_msg(self._statuses.values(), self._fusion.network_reports())
        )


def main() -> None:
    """Entry point of ``ros2 run track_fusion track_fusion``."""
    run(TrackFusionNode, arguments=sys.argv[1:])
