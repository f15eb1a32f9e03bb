"""What every node shares: parameters from a dataclass, start and stop, QoS, message classes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, fields
from typing import Any

import pytest
import rclpy
from nav_msgs.msg import Odometry
from netpos.tracking import TrackerConfig
from netpos_msgs.msg import RsuMeasurement
from netpos_node import (
    CODEC,
    LATCHED,
    STREAM,
    choose_profiles,
    declare,
    declare_config,
    message_class,
    run,
    spin_until_stopped,
    wait_until_heard,
)
from rclpy.exceptions import (
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterAlreadyDeclaredException,
)
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, HistoryPolicy, ReliabilityPolicy
from std_msgs.msg import String

DOMAIN = 36


@dataclass(frozen=True, slots=True, kw_only=True)
class Config:
    """One field of each type."""

    gain: float = field(default=1.5, metadata={"low": 0.5, "high": 2.0, "text": "a gain [1]"})
    count: int = field(default=3, metadata={"low": 1, "high": 9, "text": "how many"})
    name: str = field(default="x", metadata={"text": "a name"})
    on: bool = field(default=False, metadata={"text": "a switch"})

    def __post_init__(self) -> None:
        if self.name == "bad":
            raise ValueError("name must not be bad, got 'bad'")


@pytest.fixture
def context() -> Iterator[rclpy.Context]:
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=DOMAIN)
    yield context
    rclpy.shutdown(context=context)


@pytest.fixture
def make(context: rclpy.Context) -> Iterator[Any]:
    nodes = []

    def node(**overrides: Any) -> Node:
        values = [Parameter(name, value=value) for name, value in overrides.items()]
        nodes.append(Node("probe", context=context, parameter_overrides=values))
        return nodes[-1]

    yield node
    for one in nodes:
        one.destroy_node()


def test_qos() -> None:
    for profile in (STREAM, LATCHED):
        assert profile.reliability == ReliabilityPolicy.RELIABLE
        assert profile.history == HistoryPolicy.KEEP_LAST
        assert profile.depth == 1000
    assert STREAM.durability != DurabilityPolicy.TRANSIENT_LOCAL
    assert LATCHED.durability == DurabilityPolicy.TRANSIENT_LOCAL


def test_message_classes_are_rclpys() -> None:
    assert message_class("nav_msgs/msg/Odometry") is Odometry
    assert message_class("netpos_msgs/msg/RsuMeasurement") is RsuMeasurement
    stamp = CODEC.time(1_700_000_000_123_456_789)
    assert (stamp.sec, stamp.nanosec) == (1_700_000_000, 123_456_789)


def test_defaults_overrides_and_explicit_values(make: Any) -> None:
    assert declare_config(make(), Config) == Config()
    assert declare_config(make(), Config, {"gain": 0.75, "count": 4}) == Config(gain=0.75, count=4)
    explicit = make(gain=1.0, name="y", on=True)
    assert declare_config(explicit, Config, {"gain": 0.75}) == Config(gain=1.0, name="y", on=True)


def test_parameters_are_read_only_described_and_ranged(make: Any) -> None:
    node = make()
    declare_config(node, Config)
    declare(node, "extra", 7, "one more")
    for name in ("gain", "count", "name", "on", "extra"):
        assert node.describe_parameter(name).read_only
    assert node.describe_parameter("gain").description == "a gain [1]"
    assert node.describe_parameter("extra").description == "one more"
    (gain,) = node.describe_parameter("gain").floating_point_range
    assert (gain.from_value, gain.to_value) == (0.5, 2.0)
    (count,) = node.describe_parameter("count").integer_range
    assert (count.from_value, count.to_value) == (1, 9)
    (result,) = node.set_parameters([Parameter("gain", value=1.0)])
    assert not result.successful
    assert node.get_parameter("gain").value == 1.5


@pytest.mark.parametrize(
    ("name", "value"), [("gain", 0.49), ("gain", 2.01), ("count", 0), ("count", 10)]
)
def test_out_of_range_is_refused(make: Any, name: str, value: Any) -> None:
    with pytest.raises(InvalidParameterValueException, match=name):
        declare_config(make(**{name: value}), Config)


@pytest.mark.parametrize(
    ("name", "value"), [("gain", 2.0), ("gain", 0.5), ("count", 1), ("count", 9)]
)
def test_limits_are_accepted(make: Any, name: str, value: Any) -> None:
    assert getattr(declare_config(make(**{name: value}), Config), name) == value


@pytest.mark.parametrize(
    ("name", "value"), [("gain", "high"), ("gain", 1), ("count", 1.0), ("on", 1)]
)
def test_wrong_type_is_refused(make: Any, name: str, value: Any) -> None:
    with pytest.raises(InvalidParameterTypeException, match=name):
        declare_config(make(**{name: value}), Config)


def test_the_configs_own_check_is_the_last_word(make: Any) -> None:
    with pytest.raises(ValueError, match="name must not be bad"):
        declare_config(make(name="bad"), Config)


def test_whole_tracker_config_is_declared(make: Any) -> None:
    node = make()
    assert declare_config(node, TrackerConfig) == TrackerConfig()
    for entry in fields(TrackerConfig):
        assert node.get_parameter(entry.name).value == getattr(TrackerConfig(), entry.name)
        assert node.describe_parameter(entry.name).description


def test_what_a_yaml_file_writes_is_a_valid_default(make: Any) -> None:
    """A scenario may say ``hold_s: 0``; from_mapping types it, declare_config takes it."""
    typed = asdict(TrackerConfig.from_mapping({"hold_s": 0, "drift_step_sd": "1e-4"}))
    config = declare_config(make(), TrackerConfig, typed)
    assert (config.hold_s, config.drift_step_sd) == (0.0, 1e-4)


def test_a_number_has_a_least_value(make: Any) -> None:
    assert declare(make(count=0), "count", 3, "how many", low=0) == 0
    with pytest.raises(InvalidParameterValueException, match="count"):
        declare(make(count=-1), "count", 3, "how many", low=0)


# run


def fail(error: Exception) -> Any:
    def factory() -> Node:
        raise error

    return factory


@pytest.mark.parametrize(
    "error",
    [
        ValueError("hold_s must be in [0, 10], got 11"),
        FileNotFoundError("no such map"),
        InvalidParameterTypeException(Parameter("a", value=1), "DOUBLE"),
        InvalidParameterValueException("a", 3, "too large"),
    ],
)
def test_a_bad_parameter_ends_with_one_sentence_and_code_2(error: Exception, capsys: Any) -> None:
    with pytest.raises(SystemExit) as stopped:
        run(fail(error))
    assert stopped.value.code == 2
    captured = capsys.readouterr()
    assert captured.err == f"error: {error}\n"
    assert captured.out == ""
    assert not rclpy.ok()


def test_a_programming_error_is_not_hidden() -> None:
    try:
        with pytest.raises(ParameterAlreadyDeclaredException):
            run(fail(ParameterAlreadyDeclaredException("a")))
    finally:
        rclpy.try_shutdown()


@pytest.mark.parametrize("stop", [KeyboardInterrupt, ExternalShutdownException, None])
def test_stop_is_clean(stop: type[BaseException] | None) -> None:
    spun = []

    def spin(node: Node) -> None:
        assert rclpy.ok()
        spun.append(node)
        if stop is not None:
            raise stop

    node: Any = object()
    run(lambda: node, spin)
    assert spun == [node]
    assert not rclpy.ok()


def test_an_error_while_spinning_shuts_down_and_shows() -> None:
    def spin(_: Node) -> None:
        raise RuntimeError("broken")

    node: Any = object()
    with pytest.raises(RuntimeError, match="broken"):
        run(lambda: node, spin)
    assert not rclpy.ok()


@pytest.fixture
def signal_handlers() -> Iterator[None]:
    """Those of before come back."""
    kept = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in kept.items():
        signal.signal(number, handler)


class Listener(Node):
    """Hears two topics; all is sent, by itself, in one callback."""

    def __init__(self, order: str, stop: int) -> None:
        super().__init__("listener")
        self.heard: list[str] = []
        self._expected, self._stop = len(order), stop
        publishers = {}
        for name in set(order):
            topic = f"/probe_{name}"
            self.create_subscription(String, topic, lambda msg: self.hear(msg.data), STREAM)
            publishers[name] = self.create_publisher(String, topic, STREAM)
        counts = dict.fromkeys(publishers, 1)
        assert wait_until_heard(publishers, counts, 20.0, settle_s=0.0) == []

        def send() -> None:
            timer.cancel()
            for index, name in enumerate(order):
                publishers[name].publish(String(data=f"{name}{index}"))

        timer = self.create_timer(0.01, send)

    def hear(self, text: str) -> None:
        self.heard.append(text)
        if len(self.heard) == self._expected:
            os.kill(os.getpid(), self._stop)


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.usefixtures("signal_handlers")
def test_what_has_arrived_is_handed_over_in_its_order_until_a_signal(
    monkeypatch: pytest.MonkeyPatch, stop: int
) -> None:
    """No topic overtakes another, however much of one arrived first."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(DOMAIN))
    order, finished = "aaaabaabbbbabbaaaaaabab", []

    def spin(node: Any) -> None:
        spin_until_stopped(node, lambda: finished.append((rclpy.ok(), node.heard)))

    run(lambda: Listener(order, stop), spin)
    assert finished == [(True, [f"{name}{index}" for index, name in enumerate(order)])]


_ENDPOINTS = """
import os, sys
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from netpos_node import BACKLOG, STREAM, choose_profiles

if sys.argv[1] == "ours":
    choose_profiles(os.environ)

def resident_kb():
    for line in open("/proc/self/status"):
        if line.startswith("VmRSS:"):
            return int(line.split()[1])

rclpy.init(domain_id=36)
node = rclpy.create_node("many")

def add(i):
    node.create_publisher(Odometry, f"/v{i}/odometry", STREAM)
    node.create_subscription(PoseWithCovarianceStamped, f"/v{i}/pose", lambda _: None, BACKLOG)

add(100)
before = resident_kb()
for i in range(50):
    add(i)
print((resident_kb() - before) / 100)
rclpy.shutdown()
"""


def _kb_per_endpoint(profiles: str) -> float:
    program = [sys.executable, "-c", _ENDPOINTS, profiles]
    environment = {k: v for k, v in os.environ.items() if "FASTRTPS" not in k}
    result = subprocess.run(program, capture_output=True, text=True, check=True, env=environment)
    assert "XML" not in result.stderr, "Fast DDS has not understood fastdds.xml"
    return float(result.stdout)


def test_silent_endpoints_take_little_memory() -> None:
    """Of a history of thousands of messages nothing is allocated ahead."""
    ours, usual = _kb_per_endpoint("ours"), _kb_per_endpoint("usual")
    assert ours < 60.0
    assert ours < 0.5 * usual


@pytest.mark.parametrize(
    "chosen",
    [
        {"FASTRTPS_DEFAULT_PROFILES_FILE": "/mine.xml"},
        {"FASTDDS_DEFAULT_PROFILES_FILE": "/mine.xml"},
        {"RMW_FASTRTPS_USE_QOS_FROM_XML": "0"},
    ],
)
def test_profiles_of_the_user_stand(chosen: dict[str, str]) -> None:
    environment = {"HOME": "/", **chosen}
    choose_profiles(environment)
    assert environment == {"HOME": "/", **chosen}


def test_profiles_are_ours_where_nothing_is_chosen() -> None:
    environment: dict[str, str] = {}
    choose_profiles(environment)
    assert environment.pop("RMW_FASTRTPS_USE_QOS_FROM_XML") == "1"
    (file,) = environment.values()
    assert os.path.isfile(file)
