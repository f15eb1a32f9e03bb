"""Who may publish and hear what: an SROS2 policy, made of the table of topics.

``python -m netpos.messages.policy > policy.xml``; the file goes to ``ros2 security
generate_artifacts``. Names may hold ``*``, as DDS permissions do: any device, any network.
"""

from __future__ import annotations

import sys
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from fnmatch import fnmatchcase

from netpos.messages import topics

VERSION = "0.2.0"
ANY = "*"
_PARAMETER_SERVICES = (
    "describe_parameters",
    "get_parameter_types",
    "get_parameters",
    "list_parameters",
    "set_parameters",
    "set_parameters_atomically",
    "get_type_description",
)
_LIFECYCLE_SERVICES = (
    "change_state",
    "get_state",
    "get_available_states",
    "get_available_transitions",
    "get_transition_graph",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Rights:
    """What the nodes of one enclave may do; absolute names.

    node : name of its node, which a network or a device may follow; publish, subscribe : topics;
    reply, request : services beside those of parameters
    """

    node: str
    publish: tuple[str, ...] = ()
    subscribe: tuple[str, ...] = ()
    reply: tuple[str, ...] = ()
    request: tuple[str, ...] = ()

    @property
    def published(self) -> tuple[str, ...]:
        """With what every node publishes."""
        return tuple(sorted({*self.publish, "/rosout", "/parameter_events"}))

    @property
    def subscribed(self) -> tuple[str, ...]:
        """With what every node hears."""
        return tuple(sorted({*self.subscribe, topics.CLOCK, "/parameter_events"}))

    @property
    def replied(self) -> tuple[str, ...]:
        """With the services of parameters."""
        own = (f"/{self.node}/{name}" for name in _PARAMETER_SERVICES)
        return tuple(sorted({*self.reply, *own}))


def _device(*names: str) -> tuple[str, ...]:
    return tuple(topics.of_vue(ANY, name) for name in names)


_OUTPUTS = _device(*topics.TRACKER_OUTPUTS)
_OF_NETWORKS = (
    topics.tracks_of(ANY),
    *(topics.of_vue(ANY, name, ANY) for name in topics.TRACKER_OUTPUTS),
)
_TRACKER, _FUSION = "ekf_tracker*", "track_fusion"
_OF_TRACKER = tuple(
    f"/{_TRACKER}/{name}" for name in ("reset", "enable", "accept_rsus", *_LIFECYCLE_SERVICES)
)
_OF_FUSION = tuple(f"/{_FUSION}/{name}" for name in ("reset", "enable", *_LIFECYCLE_SERVICES))

ENCLAVES: dict[str, Rights] = {
    "/netpos/simulator": Rights(
        node="vue_sim",
        publish=(
            topics.CLOCK,
            topics.RUN_SCENARIO,
            *_device(
                topics.BEACON,
                topics.GROUND_TRUTH,
                topics.GROUND_TRUTH_CLOCK,
                topics.IMU,
                topics.MAG,
                topics.INITIAL_POSE,
            ),
        ),
    ),
    "/netpos/rsu": Rights(
        node="rsu_sensor",
        publish=(topics.RSU_INFO, topics.RSU_MEASUREMENTS),
        subscribe=_device(topics.BEACON),
    ),
    "/netpos/device": Rights(
        node="device", publish=_device(topics.IMU, topics.MAG, topics.GROUND_SPEED)
    ),
    "/netpos/dead_reckoning": Rights(
        node="pdr_*",
        publish=_device(topics.STEP, topics.STEP_VELOCITY),
        subscribe=_device(topics.IMU, topics.MAG),
    ),
    "/netpos/tracker": Rights(
        node=_TRACKER,
        publish=(
            *_OUTPUTS,
            *_OF_NETWORKS,
            topics.DIAGNOSTICS,
            topics.RSU_LEARNED,
            topics.RUN_ESTIMATOR,
            topics.TF,
            f"/{_TRACKER}/transition_event",
        ),
        subscribe=(
            topics.RSU_INFO,
            topics.RSU_MEASUREMENTS,
            *_device(topics.IMU, topics.STEP_VELOCITY, topics.GROUND_SPEED, topics.INITIAL_POSE),
        ),
        reply=_OF_TRACKER,
    ),
    "/netpos/fusion": Rights(
        node=_FUSION,
        publish=(
            *_OUTPUTS,
            topics.DIAGNOSTICS,
            topics.RUN_ESTIMATOR,
            topics.TF,
            f"/{_FUSION}/transition_event",
        ),
        subscribe=(topics.tracks_of(ANY),),
        reply=_OF_FUSION,
    ),
    "/netpos/recorder": Rights(
        node="netpos_record", publish=(topics.DIAGNOSTICS,), subscribe=("/*",)
    ),
    "/netpos/player": Rights(node="netpos_play", publish=("/*",)),
    "/netpos/viewer": Rights(
        node="viz",
        publish=(topics.VIZ_MAP, topics.VIZ_MARKERS, f"/{topics.VIZ}/*"),
        subscribe=("/*",),
    ),
    "/netpos/operator": Rights(
        node="operator",
        publish=_device(topics.INITIAL_POSE),
        subscribe=("/*",),
        request=(*_OF_TRACKER, *_OF_FUSION),
    ),
}
"""Rights by enclave."""


def allows(patterns: tuple[str, ...], name: str) -> bool:
    """Whether one of the patterns matches a name."""
    return any(fnmatchcase(name, pattern) for pattern in patterns)


def policy_xml() -> str:
    """The policy as a file."""
    policy = ET.Element("policy", version=VERSION)
    enclaves = ET.SubElement(policy, "enclaves")
    for path, rights in ENCLAVES.items():
        profiles = ET.SubElement(ET.SubElement(enclaves, "enclave", path=path), "profiles")
        profile = ET.SubElement(profiles, "profile", ns="/", node=rights.node)
        for kind, verb, names in (
            ("topic", "publish", rights.published),
            ("topic", "subscribe", rights.subscribed),
            ("service", "reply", rights.replied),
            ("service", "request", rights.request),
        ):
            if names:
                group = ET.SubElement(profile, f"{kind}s", {verb: "ALLOW"})
                for name in names:
                    ET.SubElement(group, kind).text = name
    ET.indent(policy)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(policy, "unicode") + "\n"


if __name__ == "__main__":
    sys.stdout.write(policy_xml())
