"""The launch file and the shell script start the same nodes. ROS's ``launch`` is not among the
wheels: a few stand-ins note what the file asks it for."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator
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


def nodes(launch_file: ModuleType, **chosen: str) -> Iterator[dict[str, Any]]:
    """What is started, with the launch's arguments in place."""
    entities = list(launch_file.generate_launch_description().args[0])
    context = {
        e.args[0]: e.values["default_value"] for e in entities if "default_value" in e.values
    }
    context |= chosen
    while entities:
        entity = entities.pop(0)
        if isinstance(entity, OpaqueFunction):
            entities += entity.values["function"](context)
        elif isinstance(entity, Node):
            yield entity.values


def launched(launch_file: ModuleType, **chosen: str) -> set[tuple[Any, ...]]:
    """The same as package, executable, name, arguments and parameters."""
    return {
        (
            *(node[key] for key in ("package", "executable", "name")),
            tuple(node["arguments"]),
            tuple(sorted((n, _text(v)) for p in node["parameters"] for n, v in _items(p))),
        )
        for node in nodes(launch_file, **chosen)
    }


def _text(value: Any) -> str:
    return f"{value:.6f}" if isinstance(value, float) else str(value)


def _items(parameters: Any) -> Iterable[tuple[str, Any]]:
    return parameters.items() if isinstance(parameters, dict) else [("--params-file", parameters)]


def planned(repository: Path, *arguments: str) -> set[tuple[Any, ...]]:
    """What the shell scripts start, from the lines that they read."""
    script = str(repository / "scripts" / "graph_plan.py")
    lines = subprocess.run(
        [sys.executable, script, *arguments], capture_output=True, text=True, check=True
    ).stdout.splitlines()
    return {_parsed(line.split("\t")) for line in lines}


def _parsed(words: list[str]) -> tuple[Any, ...]:
    _, name, package, executable, *rest = words
    at = rest.index("--ros-args") if "--ros-args" in rest else len(rest)
    values = []
    for flag, value in zip(rest[at + 1 :: 2], rest[at + 2 :: 2], strict=True):
        if flag == "-r":
            assert value == f"__node:={name}"
        else:
            text = value if flag == "-p" else f"{flag}:={value}"
            values.append(tuple(text.split(":=", 1)))
    return package, executable, name, tuple(rest[:at]), tuple(sorted(values))


@pytest.mark.parametrize("scenario", ["metis_madrid", "two_networks", "pedestrian_walk"])
def test_the_launch_file_starts_what_the_script_starts(
    launch_file: ModuleType, repository: Path, scenario: str
) -> None:
    """Every process, with every argument and parameter."""
    by_launch = launched(launch_file, scenario=scenario, bag="a_bag", rate="10", seed="3")
    assert by_launch == planned(repository, "run", scenario, "a_bag", "10", "3")
    assert {"vue_sim", "rsu_sensor", "record"} < {executable for _, executable, *_ in by_launch}


@pytest.mark.parametrize("launch_file", ["tracker"], indirect=True)
@pytest.mark.parametrize(("params", "bag"), [("mine.yaml", "a_bag"), ("", "")])
def test_the_tracker_alone(
    launch_file: ModuleType, repository: Path, params: str, bag: str
) -> None:
    by_launch = launched(launch_file, params=params, bag=bag)
    assert by_launch == planned(repository, "tracker", params, bag)
    assert len(by_launch) == 1 + bool(bag)


@pytest.mark.parametrize("launch_file", ["tracker"], indirect=True)
def test_the_tracker_in_a_namespace(launch_file: ModuleType) -> None:
    started = list(nodes(launch_file, namespace="site_a", bag="a_bag"))
    assert [node["namespace"] for node in started] == ["site_a", "site_a"]


@pytest.mark.parametrize("script", ["run_graph", "play_bag", "run_tracker"])
def test_no_script_names_a_node_of_its_own(repository: Path, script: str) -> None:
    """What is started comes from the plan."""
    text = (repository / "scripts" / f"{script}.sh").read_text()
    assert re.search(r"^plan ", text, re.MULTILINE)
    assert not re.search(r"^ *start \S+ \w+ \w+|ros2 run ", text, re.MULTILINE)


def test_who_walks_is_dead_reckoned(launch_file: ModuleType) -> None:
    for bag, subscribers in (("", 1), ("a_bag", 2)):  # the recorder hears steps, too
        started = nodes(launch_file, scenario="pedestrian_walk", bag=bag)
        (reckoning,) = [n for n in started if n["package"] == "pdr_node"]
        assert reckoning["name"] == "pdr_vue_1"
        assert reckoning["parameters"] == [
            {"scenario": "pedestrian_walk", "vue": "vue_1", "subscribers": subscribers}
        ]


def test_every_walker_of_several_has_a_node(
    launch_file: ModuleType, repository: Path, tmp_path: Path
) -> None:
    text = (repository / SHIPPED / "pedestrian_walk.yaml").read_text()
    path = tmp_path / "crowd.yaml"
    path.write_text(text.replace("  - route:", "  - count: 3\n    route:"))
    started = nodes(launch_file, scenario=str(path))
    names = [n["name"] for n in started if n["package"] == "pdr_node"]
    assert names == ["pdr_vue_1", "pdr_vue_2", "pdr_vue_3"]


def test_all_that_is_started_exists(launch_file: ModuleType, repository: Path) -> None:
    shipped = [path.stem for path in (repository / SHIPPED).glob("*.yaml")]
    assert any(load_scenario(name).walkers for name in shipped)
    for name in shipped:
        for node in nodes(launch_file, scenario=name, bag="a_bag"):
            setup = repository / "ros2_ws" / "src" / node["package"] / "setup.py"
            assert f'"{node["executable"]} = ' in setup.read_text()
