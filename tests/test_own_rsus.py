"""RSUs of one's own: a file of parameters, the tracker alone, a recording that replays to
itself."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from feed import PLACES, measurement
from graph import LATCHED, Graph, wait_for_rsus
from nav_msgs.msg import Odometry
from netpos.bags import BagReader
from netpos.messages.values import RsuInfo
from netpos.scenario.settings import bag_settings
from netpos_msgs.msg import RsuInfo as RsuInfoMessage
from netpos_msgs.msg import RsuMeasurement
from netpos_node import CODEC
from runs import ESTIMATES, INFOS, MEASUREMENTS, assert_same, graphs, netpos


@pytest.fixture(name="graph")
def _graph(tmp_path: Path) -> Iterator[Graph]:
    with graphs(tmp_path) as (graph,):
        yield graph


def test_the_tracker_alone_with_a_file_of_parameters(
    graph: Graph, repository: Path, tmp_path: Path
) -> None:
    file, bag = tmp_path / "params.yaml", tmp_path / "recorded"
    netpos("params", "--dump", file)
    text = file.read_text(encoding="utf-8").replace("device_height_m: 0.0", "device_height_m: 1.3")
    file.write_text(text.replace("vues: [vue_1]", "vues: [tag_7]"), encoding="utf-8")
    odometry = graph.collect("/tag_7/odometry", Odometry)
    told = graph.collect("/diagnostics", DiagnosticArray)
    infos = graph.publisher(INFOS, RsuInfoMessage, LATCHED)
    measured = graph.publisher(MEASUREMENTS, RsuMeasurement)
    script = str(repository / "scripts" / "run_tracker.sh")
    process = graph.start("run_tracker", [script, str(file), "--bag", str(bag)])
    process.wait_for_output("netpos: tracking in ROS domain")
    for name, (x, y) in PLACES.items():
        info = RsuInfo(rsu_id=name, position=np.array([x, y, 0.0]))
        infos.publish(CODEC.rsu_info_to_msg(info))
    graph.wait_for_subscribers(MEASUREMENTS, 2)
    topics = [topic.replace("vue_1", "tag_7") for topic in ESTIMATES]
    for topic in topics:  # the recorder hears them, and this process the odometry
        graph.wait_for_subscribers(topic, 2 if topic.endswith("odometry") else 1)
    wait_for_rsus(told, len(PLACES))
    for k in range(60):
        for name in PLACES:
            measured.publish(measurement(name, 0.1 * k, "tag_7"))
    last = odometry.wait_for(50)[-1]
    assert last.pose.pose.position.z == pytest.approx(1.3)
    assert process.interrupt() == 0
    with BagReader(bag) as reader:
        parameters = bag_settings(reader).parameters
    wanted = yaml.safe_load(file.read_text(encoding="utf-8"))["/**"]["ros__parameters"]
    assert parameters == {name: value for name, value in wanted.items() if name != "vues"}
    netpos("replay", bag, "--out", tmp_path / "again")
    assert_same(tmp_path / "again", bag, topics, at_least=50)


def test_files_that_are_not_there_or_would_be_overwritten(
    graph: Graph, repository: Path, tmp_path: Path
) -> None:
    script = str(repository / "scripts" / "run_tracker.sh")
    (tmp_path / "bag").mkdir()
    for arguments, words in (
        (["none.yaml"], "netpos params --dump none.yaml"),
        (["--bag", str(tmp_path / "bag")], "never overwritten"),
        (["--frobnicate"], "scripts/run_tracker.sh [PARAMS.yaml]"),
    ):
        process = graph.start("run_tracker", [script, *arguments])
        assert process.wait() in {1, 2}
        assert words in process.describe()
