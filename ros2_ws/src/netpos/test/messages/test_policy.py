"""The SROS2 policy: what its schema demands, and what the table in docs/topics.md says."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
from netpos.messages.policy import ENCLAVES, allows, policy_xml

ROOT = Path(__file__).parents[5]
SHIPPED = ROOT / "ros2_ws/src/netpos_bringup/sros2/policy.xml"
NODES = {rights.node.strip("*_"): rights for rights in ENCLAVES.values()}

# policy.xsd 0.2.0 of sros2: element: (attributes demanded, attributes possible, children)
RULE = {"ALLOW", "DENY"}
SCHEMA: dict[str, tuple[set[str], dict[str, set[str]], set[str]]] = {
    "policy": ({"version"}, {"version": {"0.2.0"}}, {"enclaves"}),
    "enclaves": (set(), {}, {"enclave"}),
    "enclave": ({"path"}, {"path": set()}, {"profiles"}),
    "profiles": (set(), {"type": set()}, {"profile", "metadata"}),
    "profile": (
        {"ns", "node"},
        {"ns": set(), "node": set()},
        {"topics", "services", "actions"},
    ),
    "topics": (set(), {"publish": RULE, "subscribe": RULE}, {"topic"}),
    "services": (set(), {"reply": RULE, "request": RULE}, {"service"}),
    "actions": (set(), {"call": RULE, "execute": RULE}, {"action"}),
    "topic": (set(), {}, set()),
    "service": (set(), {}, set()),
    "action": (set(), {}, set()),
}
MAY_BE_EMPTY = {"profile", "topic", "service", "action"}


def faults(element: ET.Element) -> list[str]:
    """What an element has that the schema does not allow."""
    demanded, possible, children = SCHEMA[element.tag]
    found = [f"{element.tag} lacks {name}" for name in sorted(demanded - element.attrib.keys())]
    for name, value in element.attrib.items():
        if name not in possible or (possible[name] and value not in possible[name]):
            found.append(f"{element.tag} {name}={value}")
    if not len(element) and element.tag not in MAY_BE_EMPTY:
        found.append(f"{element.tag} is empty")
    for child in element:
        if child.tag not in children:
            found.append(f"{child.tag} in {element.tag}")
        else:
            found += faults(child)
    text = (element.text or "").strip()
    if bool(text) != (not children):
        found.append(f"{element.tag} says {text!r}")
    return found


def test_the_policy_follows_the_schema() -> None:
    assert faults(ET.fromstring(policy_xml())) == []


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        ('version="0.2.0"', 'version="1"', "policy version=1"),
        (' path="/netpos/rsu"', "", "enclave lacks path"),
        ('publish="ALLOW"', 'publish="YES"', "topics publish=YES"),
        ("<topic>/clock</topic>", "<topic />", "topic says ''"),
        ("<profiles>", "<profiles><topic>/x</topic>", "topic in profiles"),
    ],
)
def test_the_check_sees_what_is_wrong(old: str, new: str, fault: str) -> None:
    text = policy_xml()
    assert old in text
    assert fault in faults(ET.fromstring(text.replace(old, new)))


def test_the_shipped_policy_is_the_newest() -> None:
    """python -m netpos.messages.policy > ros2_ws/src/netpos_bringup/sros2/policy.xml"""
    assert SHIPPED.read_text() == policy_xml()


def table() -> list[tuple[str, str]]:
    """Topics and publishers of the table in docs/topics.md, devices and networks as ``x``."""
    found = []
    for line in (ROOT / "docs/topics.md").read_text().splitlines():
        cells = [cell.strip() for cell in line.split("|")[1:-1]]
        if len(cells) != 4 or not cells[0].startswith("`/"):
            continue
        names = [re.sub(r"<\w+>", "x", n) for n in re.findall(r"`([^`…]+)`", cells[0])]
        parts = cells[2].split(";")  # one for each topic, or one for all
        for name, part in zip(names, parts if len(parts) > 1 else parts * len(names), strict=True):
            nodes = set(re.findall(r"[a-z]+_[a-z]+|viz", part)) & NODES.keys()
            found += [(name, node) for node in nodes]
    return found


def test_who_publishes_a_topic_by_the_table_may() -> None:
    pairs = table()
    assert len(pairs) > 20
    assert {node for _, node in pairs} >= {"vue_sim", "rsu_sensor", "ekf_tracker", "viz"}
    assert [p for p in pairs if not allows(NODES[p[1]].published, p[0])] == []


def test_nobody_else_may() -> None:
    """Odometry comes from trackers, measurements from RSUs; recordings are played where asked."""
    for topic, enclaves in {
        "/vue_1/odometry": {"/netpos/tracker", "/netpos/fusion"},
        "/rsu/info": {"/netpos/rsu"},
        "/rsu/measurements": {"/netpos/rsu"},
        "/vue_1/initialpose": {"/netpos/simulator", "/netpos/operator"},
        "/vue_1/imu": {"/netpos/simulator", "/netpos/device"},
        "/tf": {"/netpos/tracker", "/netpos/fusion"},
    }.items():
        may = {path for path, rights in ENCLAVES.items() if allows(rights.published, topic)}
        assert may == enclaves | {"/netpos/player"}, topic
    services = {p for p, r in ENCLAVES.items() if allows(r.request, "/ekf_tracker/accept_rsus")}
    assert services == {"/netpos/operator"}
