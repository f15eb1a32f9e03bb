"""The shipped RViz configuration and Foxglove layout show topics that exist."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from ament_index_python.packages import get_package_share_directory
from netpos.messages import topics
from netpos_msgs.msg import TrackStatus

SHARE = Path(get_package_share_directory("netpos_bringup"))
ROOT = Path(__file__).resolve().parents[4]
VUE = "vue_1"
EXISTING = {
    topics.VIZ_MAP,
    topics.VIZ_MARKERS,
    topics.path_of(VUE),
    topics.DIAGNOSTICS,
    *(
        topics.of_vue(VUE, name)
        for name in (topics.ODOMETRY, topics.TRACK_STATUS, topics.INITIAL_POSE)
    ),
}


def rviz() -> Any:
    return yaml.safe_load((SHARE / "rviz" / "netpos.rviz").read_text(encoding="utf-8"))


def layout() -> Any:
    return json.loads((SHARE / "foxglove" / "netpos.json").read_text(encoding="utf-8"))


def texts(content: Any) -> Iterator[str]:
    """All texts in nested lists and mappings, keys too."""
    if isinstance(content, dict):
        for key, value in content.items():
            yield str(key)
            yield from texts(value)
    elif isinstance(content, list):
        for value in content:
            yield from texts(value)
    elif isinstance(content, str):
        yield content


def named_topics(content: Any) -> set[str]:
    """Topics named in a configuration; a field of a message comes after a dot."""
    found = {text.partition(".")[0] for text in texts(content) if text.startswith("/")}
    return {text for text in found if " " not in text}


@pytest.mark.parametrize("content", [rviz(), layout()], ids=["rviz", "foxglove"])
def test_topics_exist_and_are_documented(content: Any) -> None:
    named = named_topics(content)
    assert {topics.VIZ_MAP, topics.VIZ_MARKERS, topics.path_of(VUE)} <= named
    assert named <= EXISTING
    table = (ROOT / "docs" / "topics.md").read_text(encoding="utf-8")
    for topic in named:
        assert f"`{topic.replace(VUE, '<vue>')}`" in table, topic


def test_rviz_asks_for_what_is_latched_as_latched() -> None:
    displays = rviz()["Visualization Manager"]["Displays"]
    durable = {
        display["Topic"]["Value"]: display["Topic"]["Durability Policy"]
        for display in displays
        if "Topic" in display
    }
    assert durable.pop(topics.VIZ_MAP) == "Transient Local"
    assert set(durable.values()) == {"Volatile"}
    assert rviz()["Visualization Manager"]["Global Options"]["Fixed Frame"] == "map"


def test_panels_of_the_layout_are_those_that_are_configured() -> None:
    def panels(node: Any) -> Iterator[str]:
        if isinstance(node, str):
            yield node
        else:
            yield from panels(node["first"])
            yield from panels(node["second"])

    assert sorted(panels(layout()["layout"])) == sorted(layout()["configById"])


def test_plotted_fields_exist() -> None:
    plotted = set()
    for text in texts(layout()["configById"]):
        topic, _, name = text.partition(".")
        if topic == topics.of_vue(VUE, topics.TRACK_STATUS):
            plotted.add(name)
    assert plotted == {"position_sd", "protection_level", "state"}
    assert plotted <= TrackStatus.get_fields_and_field_types().keys()
