"""The launch file and the shell script start the same nodes. ROS's ``launch`` is not among the
wheels: a few stand-ins note what the file asks it for."""

from __future__ import annotations

import importlib.util
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from netpos.scenario import load_scenario

SHIPPED = Path("ros2_ws/src/netpos_bringup/scenarios")


class Entity:
    """Whatever is made of ``launch``, with its arguments."""

    def __init__(self, *args: Any, **values: Any) -> None:
        self.args, self.values = args, values

    def perform(self, context: dict[str, str]) -> str:
        """Of a ``LaunchConfiguration``: its value."""
        return context[self.args[0]]


class Node(Entity):
    """A node to start."""


class OpaqueFunction(Entity):
    """A function that gives entities once the arguments are known."""


@pytest.fixture
def launch_file(
    repository: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> ModuleType:
    name = getattr(request, "param", "netpos")
    path = repository / f"ros2_ws/src/netpos_bringup/launch/{name}.launch.py"
    names = re.findall(
        r"^from (launch[\w.]*) import (?:\(([^)]*)\)|(.*))$", path.read_text(), re.MULTILINE
    )
    for module, several, one in names:
        stand_in = ModuleType(module)
        for name in re.findall(r"\w+", several or one):
            setattr(
                stand_in, name, {"Node": Node, "OpaqueFunction": OpaqueFunction}.get(name, Entity)
            )
        monkeypatch.setitem(sys.modules, module, stand_in)
    spec = importlib.util.spec_from_file_location("netpos_launch", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def nodes(launch_file: ModuleType, scenario: str, bag: str = "") -> Iterator[dict[str, Any]]:
    """What is started, with the launch's arguments in place."""
    context = {"scenario": scenario, "bag": bag, "params": scenario}
    entities = list(launch_file.generate_launch_description().args[0])
    while entities:
        entity = entities.pop(0)
        if isinstance(entity, OpaqueFunction):
            entities += entity.values["function"](context)
        elif isinstance(entity, Node):
            yield entity.values


def test_who_walks_is_dead_reckoned(launch_file: ModuleType) -> None:
    for name in ("pedestrian_walk", "pedestrian_rectangle"):
        (reckoning,) = [n for n in nodes(launch_file, name) if n["package"] == "pdr_node"]
        assert reckoning["name"] == "pdr_vue_1"
        assert reckoning["parameters"] == [{"scenario": name, "vue": "vue_1", "subscribers": 1}]
    recorded = list(nodes(launch_file, "pedestrian_walk", "a_bag"))
    (reckoning,) = [n for n in recorded if n["package"] == "pdr_node"]
    assert reckoning["parameters"][0]["subscribers"] == 2  # the recorder hears steps, too


def test_every_walker_of_several_has_a_node(
    launch_file: ModuleType, repository: Path, tmp_path: Path
) -> None:
    text = (repository / SHIPPED / "pedestrian_walk.yaml").read_text()
    path = tmp_path / "crowd.yaml"
    path.write_text(text.replace("  - route:", "  - count: 3\n    route:"))
    started = [n["name"] for n in nodes(launch_file, str(path)) if n["package"] == "pdr_node"]
    assert started == ["pdr_vue_1", "pdr_vue_2", "pdr_vue_3"]


def test_nobody_else_is(launch_file: ModuleType) -> None:
    packages = [n["package"] for n in nodes(launch_file, "metis_madrid")]
    assert sorted(packages) == ["ekf_tracker", "netpos_bag", "rsu_sensor", "vue_sim"]


def test_launch_file_and_script_start_the_same_kinds_of_nodes(
    launch_file: ModuleType, repository: Path
) -> None:
    scripts = [
        (repository / "scripts" / name).read_text() for name in ("run_graph.sh", "graph.sh")
    ]
    by_script = set(re.findall(r"^ *start \S+ (\w+) (\w+)", "\n".join(scripts), re.MULTILINE))
    shipped = [path.stem for path in (repository / SHIPPED).glob("*.yaml")]
    assert any(load_scenario(name).walkers for name in shipped)
    by_launch = {
        (node["package"], node["executable"])
        for name in shipped
        for node in nodes(launch_file, name, "a_bag")
    }
    assert by_launch == by_script


@pytest.mark.parametrize("launch_file", ["tracker"], indirect=True)
def test_the_tracker_alone(launch_file: ModuleType, repository: Path) -> None:
    """With a file of parameters and without; the same nodes as the script."""
    started = list(nodes(launch_file, "mine.yaml", "a_bag"))
    assert {n["package"]: n.get("parameters") for n in started} == {
        "ekf_tracker": ["mine.yaml"],
        "netpos_bag": None,
    }
    (tracker,) = [n for n in nodes(launch_file, "") if n["package"] == "ekf_tracker"]
    assert tracker["parameters"] == []
    script = (repository / "scripts" / "run_tracker.sh").read_text()
    assert set(re.findall(r"^ *start \S+ (\w+) (\w+)", script, re.MULTILINE)) == {
        (n["package"], n["executable"]) for n in started
    }
