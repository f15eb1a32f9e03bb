"""A fault in a running graph, between sensors and tracker: noticed, named, and over."""

from __future__ import annotations

import sys

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from graph import Graph
from nav_msgs.msg import Odometry
from netpos.messages.topics import RSU_INFO, RSU_MEASUREMENTS
from runs import ODOMETRY, TRUTH, horizontal_errors

SCENARIO = "tdoa_yard"
NODE = "from netpos_bringup.faults import main; main()"
FAULT = {"fault": "bias", "size": 30.0, "rsus": "rsu_2", "start_s": 4.0, "lasts_s": 4.0}


def accused(messages: list[DiagnosticArray]) -> set[str]:
    """RSUs that are excluded."""
    return {
        s.hardware_id
        for m in messages
        for s in m.status
        if s.level == DiagnosticStatus.ERROR and s.hardware_id.startswith("rsu_")
    }


def test_a_biased_rsu_is_named_and_the_track_holds(graph: Graph) -> None:
    odometry, truth = graph.collect(ODOMETRY, Odometry), graph.collect(TRUTH, Odometry)
    diagnostics = graph.collect("/diagnostics", DiagnosticArray)
    values = [f"-p {name}:={value}".split() for name, value in FAULT.items()]
    command = [sys.executable, "-c", NODE, "--ros-args", *[w for v in values for w in v]]
    graph.start("faults", command)
    graph.run("ekf_tracker", "ekf_tracker", parameters={"scenario": SCENARIO})
    graph.wait_for_nodes("faults", "ekf_tracker")
    graph.wait_for_subscribers(RSU_MEASUREMENTS)
    sensed = [f"-r {topic}:=/sensed{topic}".split() for topic in (RSU_INFO, RSU_MEASUREMENTS)]
    sensor = ["ros2", "run", "rsu_sensor", "rsu_sensor", "--ros-args"]
    graph.start(
        "rsu_sensor", [*sensor, "-p", f"scenario:={SCENARIO}", *[w for r in sensed for w in r]]
    )
    graph.wait_for_nodes("rsu_sensor")
    parameters = {"scenario": SCENARIO, "rate": 2.0}
    simulator = graph.run("vue_sim", "vue_sim", parameters=parameters)
    assert simulator.wait(120.0) == 0, simulator.describe()
    assert accused(diagnostics.messages) == {"rsu_2"}
    errors = list(horizontal_errors(list(truth.messages), list(odometry.messages)).values())
    assert len(errors) > 200
    assert max(errors[20:]) < 2.0  # 30 sd of a difference are tens of metres
