"""Start the real processes with `ros2 run` on a ROS domain of their own, watch and stop them.

Nothing here sleeps a guessed time: every wait polls a condition and fails with what it saw.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import rclpy
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

POLL_S = 0.02
START_S = 60.0  # a first start may have to compile kernels

RELIABLE = QoSProfile(depth=1000)
LATCHED = QoSProfile(
    depth=1000,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)


def wait_until(condition: Callable[[], Any], what: str, timeout_s: float = 20.0) -> Any:
    """Poll until the condition is true and return its value; TimeoutError names ``what``."""
    end = time.monotonic() + timeout_s
    while not (value := condition()):
        if time.monotonic() > end:
            raise TimeoutError(f"waited {timeout_s:g} s in vain for {what}")
        time.sleep(POLL_S)
    return value


@dataclass(frozen=True, eq=False)
class Process:
    """One started process and the file its output goes to."""

    name: str
    popen: subprocess.Popen[bytes]
    log: Path

    @property
    def running(self) -> bool:
        return self.popen.poll() is None

    @property
    def output(self) -> str:
        """What it has written so far, both streams."""
        return self.log.read_text(encoding="utf-8", errors="replace")

    def wait_for_output(self, text: str, timeout_s: float = START_S) -> None:
        """Wait until the output holds the text; fails at once when the process ends before."""
        wait_until(
            lambda: text in self.output or not self.running,
            f"'{text}' from {self.name}",
            timeout_s,
        )
        if text not in self.output:
            raise AssertionError(f"{self.describe()} without writing '{text}'")

    def wait(self, timeout_s: float = 60.0) -> int:
        """Wait for its end and return the exit code; a signal's is negative."""
        try:
            return self.popen.wait(timeout_s)
        except subprocess.TimeoutExpired as error:
            raise TimeoutError(f"{self.describe()} after {timeout_s:g} s") from error

    def interrupt(self, timeout_s: float = 20.0) -> int:
        """Send SIGINT, as Ctrl-C does, and return the exit code."""
        self.signal(signal.SIGINT)
        return self.wait(timeout_s)

    def kill(self) -> int:
        """Send SIGKILL and return the exit code."""
        self.signal(signal.SIGKILL)
        return self.wait()

    def signal(self, number: signal.Signals) -> None:
        """Signal the process and its children: the real `ros2 run` starts the node as a child."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.popen.pid, number)

    def describe(self) -> str:
        """Say what became of it, with the end of its output."""
        state = "still runs" if self.running else f"ended with {self.popen.returncode}"
        return f"{self.name} {state}; its output ends:\n{self.output[-2000:]}\n--"


class Collector:
    """The messages received on one topic so far."""

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.messages: list[Any] = []

    def wait_for(self, count: int, timeout_s: float = 20.0) -> list[Any]:
        """Wait until at least ``count`` messages have come and return all of them."""
        try:
            wait_until(lambda: len(self.messages) >= count, "", timeout_s)
        except TimeoutError as error:
            seen = len(self.messages)
            raise TimeoutError(
                f"{self.topic}: {seen} of {count} messages in {timeout_s:g} s"
            ) from error
        return list(self.messages)


def wait_for_rsus(told: Collector, count: int, tracker: str = "ekf_tracker") -> None:
    """Wait until a tracker says in /diagnostics that it knows so many RSUs; a subscription that is
    matched may get a measurement before the description of its RSU."""
    line = (f"{tracker}: rsus", f"{count} RSUs known")
    wait_until(
        lambda: line in [(s.name, s.message) for m in list(told.messages) for s in m.status],
        ", ".join(line),
        60.0,
    )


class Graph:
    """The processes of one ROS domain, and a node of the test in it."""

    def __init__(self, domain_id: int, log_folder: Path) -> None:
        log_folder.mkdir(parents=True, exist_ok=True)
        self.domain_id = domain_id
        self.log_folder = log_folder
        self.processes: list[Process] = []
        self.environment = {
            **os.environ,
            "ROS_DOMAIN_ID": str(domain_id),
            "ROS_LOG_DIR": str(log_folder),
            "PYTHONUNBUFFERED": "1",
        }
        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain_id)
        self.node = Node("test_observer", context=self._context, start_parameter_services=False)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for process in self.processes:
            if process.running:
                process.kill()
        self._executor.shutdown(10.0)
        self._thread.join(10.0)
        self.node.destroy_node()  # or the next graph of this domain would see it
        self._context.try_shutdown()

    def run(
        self,
        package: str,
        executable: str,
        *arguments: str,
        parameters: dict[str, Any] | None = None,
    ) -> Process:
        """Start `ros2 run package executable arguments --ros-args -p name:=value ...`."""
        command = ["ros2", "run", package, executable, *arguments]
        if parameters:
            command.append("--ros-args")
            for name, value in parameters.items():
                command += ["-p", f"{name}:={_yaml_text(value)}"]
        return self.start(executable, command)

    def start(self, name: str, command: list[str], **options: Any) -> Process:
        """Start any command in this domain, its output going to a log of its own."""
        log = self.log_folder / f"{len(self.processes)}_{name}.log"
        with log.open("wb") as file:
            popen = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                env=self.environment,
                start_new_session=True,
                **options,
            )
        process = Process(name, popen, log)
        self.processes.append(process)
        return process

    def wait_for_nodes(self, *names: str, timeout_s: float = START_S) -> None:
        """Wait until nodes of these names are in the graph; fails when a process ends before."""

        def all_there() -> bool:
            for process in self.processes:
                if process.popen.poll() not in (None, 0):
                    raise AssertionError(process.describe())
            return set(names) <= set(self.node.get_node_names())

        wait_until(all_there, f"the nodes {', '.join(names)}", timeout_s)

    def wait_for_subscribers(self, topic: str, count: int = 1, timeout_s: float = START_S) -> None:
        """Wait until somebody listens to the topic."""
        wait_until(
            lambda: self.node.count_subscribers(topic) >= count, f"listeners of {topic}", timeout_s
        )

    def wait_for_publishers(self, topic: str, count: int = 1, timeout_s: float = START_S) -> None:
        """Wait until somebody offers the topic."""
        wait_until(
            lambda: self.node.count_publishers(topic) >= count, f"publishers of {topic}", timeout_s
        )

    def collect(
        self, topic: str, message_type: type[Any], qos: QoSProfile = RELIABLE
    ) -> Collector:
        """Subscribe in the test process; messages gather in the returned object."""
        collector = Collector(topic)
        self.node.create_subscription(message_type, topic, collector.messages.append, qos)
        self._executor.wake()
        return collector

    def publisher(self, topic: str, message_type: type[Any], qos: QoSProfile = RELIABLE) -> Any:
        """Return a publisher of the test process."""
        return self.node.create_publisher(message_type, topic, qos)

    def call(
        self, service_type: type[Any], name: str, request: Any, timeout_s: float = 20.0
    ) -> Any:
        """Call a service and return its response."""
        client = self.node.create_client(service_type, name)
        if not client.wait_for_service(timeout_s):
            raise TimeoutError(f"no service {name} within {timeout_s:g} s")
        future = client.call_async(request)
        self._executor.wake()
        wait_until(future.done, f"the answer of {name}", timeout_s)
        return future.result()

    def _spin(self) -> None:
        with contextlib.suppress(ExternalShutdownException):
            self._executor.spin()


def _yaml_text(value: Any) -> str:
    """Write a parameter value as `ros2 run -p` reads it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_yaml_text(item) for item in value) + "]"
    return str(value)
