"""Names and types of the topics."""

from __future__ import annotations

CLOCK = "/clock"
RSU_INFO = "/rsu/info"
RSU_MEASUREMENTS = "/rsu/measurements"
RSU_LEARNED = "/rsu/learned"
DIAGNOSTICS = "/diagnostics"
TF = "/tf"

# What nodes say of the run, latched: diagnostic_msgs/KeyValue with YAML.
RUN_SCENARIO = "/run/scenario"  # of the simulator: scenario, rate
RUN_ESTIMATOR = "/run/estimator"  # of trackers and fusion: their parameters
RUN_TOPICS = (RUN_SCENARIO, RUN_ESTIMATOR)

# Of the node viz, for viewers.
VIZ = "viz"
VIZ_MAP = f"/{VIZ}/map"  # latched: buildings and RSUs
VIZ_MARKERS = f"/{VIZ}/markers"
PATH = "path"

# Per device: /<vue>/<name>.
BEACON = "beacon"
GROUND_TRUTH = "ground_truth"
GROUND_TRUTH_CLOCK = "ground_truth_clock"
IMU = "imu"
MAG = "mag"
STEP = "step"
STEP_VELOCITY = "step_velocity"
GROUND_SPEED = "ground_speed"
INITIAL_POSE = "initialpose"
ODOMETRY = "odometry"
ODOMETRY_SMOOTHED = "odometry_smoothed"
FIX = "fix"
CLOCK_STATE = "clock_state"
TRACK_STATUS = "track_status"

# Of a network among several: /networks/<network>/tracks and /networks/<network>/<vue>/<name>.
NETWORKS = "networks"
TRACKS = "tracks"

DEVICE_INPUTS = (INITIAL_POSE, STEP_VELOCITY, GROUND_SPEED, IMU)
TRACKER_OUTPUTS = (ODOMETRY, ODOMETRY_SMOOTHED, FIX, CLOCK_STATE, TRACK_STATUS)


_NO_DEVICES = ("rsu", "run", VIZ)
_OF_ALL = (CLOCK, DIAGNOSTICS, TF)  # of a whole graph, whatever the namespace of a node
_TRANSITION_EVENT = "transition_event"  # of a lifecycle node: /<node>/transition_event
_NAME_MAX = 100  # that of a device and of its network fit into a topic, of 247 characters in ROS


def is_vue_id(text: str) -> bool:
    """Whether a text can name a device: at most a hundred letters, digits and underscores, no
    digit first."""
    return len(text) <= _NAME_MAX and text.isascii() and text.isidentifier()


def of_vue(vue_id: str, name: str, network: str = "") -> str:
    """Topic of a device: ``/vue_1/beacon``, or as one network among several sees it:
    ``/networks/wifi/vue_1/odometry``."""
    return f"/{NETWORKS}/{network}/{vue_id}/{name}" if network else f"/{vue_id}/{name}"


def to_resolve(topic: str) -> str:
    """The name a node gives its topic: relative, so that its namespace comes in front and
    remapping works. Clock, diagnostics and transforms are of the whole graph."""
    return topic if topic in _OF_ALL else topic.removeprefix("/")


def below(topic: str, namespace: str) -> str:
    """The topic as its nodes call it, whose namespace is ``namespace``; empty for one of other
    nodes, or of the life of a node."""
    if topic.endswith(f"/{_TRANSITION_EVENT}"):
        return ""
    above = namespace.strip("/")
    if topic in _OF_ALL or not above:
        return topic
    return topic.removeprefix(f"/{above}") if topic.startswith(f"/{above}/") else ""


def tracks_of(network: str) -> str:
    """Topic of the tracks of a network: ``/networks/wifi/tracks``."""
    return f"/{NETWORKS}/{network}/{TRACKS}"


def path_of(vue_id: str, network: str = "") -> str:
    """Topic of the path that a viewer draws of a device: ``/viz/vue_1/path``."""
    return f"/{VIZ}{of_vue(vue_id, PATH, network)}"


def split(topic: str) -> tuple[str, str]:
    """Device and name of a device's topic; ("", topic) for any other."""
    parts = topic.strip("/").split("/")
    is_of_device = (
        len(parts) == 2 and parts[0] not in _NO_DEVICES and parts[1] != _TRANSITION_EVENT
    )
    return (parts[0], parts[1]) if is_of_device else ("", topic)


def split_network(topic: str) -> tuple[str, str, str]:
    """Network, device and name of a device's topic below a network's; ("", "", topic) for any
    other."""
    parts = topic.strip("/").split("/")
    is_of_network = len(parts) == 4 and parts[0] == NETWORKS
    return (parts[1], parts[2], parts[3]) if is_of_network else ("", "", topic)


def is_tracker_output(topic: str) -> bool:
    """Whether a topic is published by a tracker, by the fusion of tracks or from what they publish
    (and left out when a bag is re-estimated)."""
    if topic in (DIAGNOSTICS, RSU_LEARNED, RUN_ESTIMATOR, TF):
        return True
    if topic.startswith((f"/{NETWORKS}/", f"/{VIZ}/")):
        return True
    return split(topic)[1] in TRACKER_OUTPUTS
