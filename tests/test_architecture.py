"""The shape of the code: who may import whom, what a node package holds."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest
from netpos.estimation.forms import table as forms
from netpos.estimation.motion import table as motion

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "ros2_ws" / "src"
LIBRARY = SOURCE / "netpos" / "netpos"
NODE_PACKAGES = ("rsu_sensor", "vue_sim", "pdr_node", "ekf_tracker", "track_fusion")

# A room may import itself and the rooms named here; nothing imports backwards.
MAY_IMPORT: dict[str, set[str]] = {
    "messages": set(),
    "common": set(),
    "world": {"messages"},
    "radio": {"messages", "world"},
    "inertial": {"messages", "common", "world", "radio"},
    "estimation": {"messages", "common", "inertial"},
    "tracking": {"messages", "common", "world", "estimation", "inertial"},
    "bags": {"messages", "common", "world", "inertial"},
    # The sensors say what a simulator sends; a replay sends a recording through the tracker.
    "scenario": {
        *("messages", "common", "world", "radio", "inertial", "estimation", "tracking", "bags"),
    },
    "live": {"messages", "world", "bags"},
    "evaluation": {
        *("messages", "common", "world", "radio", "inertial", "estimation", "bags", "scenario"),
        "tracking",
    },
    "bench": {
        *("messages", "common", "world", "radio", "inertial", "estimation", "bags", "scenario"),
        *("tracking", "evaluation", "reproduction"),
    },
    "reproduction": {
        *("messages", "common", "world", "radio", "inertial", "estimation", "bags", "scenario"),
        *("tracking", "evaluation"),
    },
}


def python_files(folder: Path) -> list[Path]:
    """All Python files below a folder, generated ones left out."""
    return [
        path
        for path in sorted(folder.rglob("*.py"))
        if not {"build", "install", "log", ".venv", "__pycache__"} & set(path.parts)
    ]


def imports(path: Path, package: str = "") -> Iterator[str]:
    """The full names of the modules a file imports, at its top or inside functions.

    ``package`` is the dotted package of the file, against which relative imports are resolved.
    """
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"), str(path))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parts = package.split(".") if package else []
            base = parts[: len(parts) - node.level + 1] if node.level else []
            name = ".".join([*base, *([node.module] if node.module else [])])
            yield name
            yield from (f"{name}.{alias.name}" for alias in node.names)


def library_imports() -> Iterator[tuple[Path, str]]:
    for path in python_files(LIBRARY):
        package = ".".join(path.parent.relative_to(LIBRARY.parent).parts)
        for name in imports(path, package):
            yield path.relative_to(LIBRARY), name


def is_ros(module: str) -> bool:
    top = module.partition(".")[0]
    return (
        top in {"rclpy", "launch", "launch_ros", "tf2_ros", "rpyutils"}
        or top.startswith(("rosidl", "ament_"))
        or top.endswith(("_msgs", "_srvs", "_interfaces"))
    )


@pytest.mark.parametrize(
    ("text", "package", "found"),
    [
        ("import rclpy.node", "", {"rclpy.node"}),
        ("def f():\n    from nav_msgs.msg import Odometry", "", {"nav_msgs.msg.Odometry"}),
        ("from . import gate", "netpos.tracking", {"netpos.tracking.gate"}),
        ("from ..cli import app", "netpos.tracking", {"netpos.cli.app"}),
    ],
)
def test_imports_are_found(text: str, package: str, found: set[str], tmp_path: Path) -> None:
    """The rules below see absolute, relative and local imports."""
    (tmp_path / "module.py").write_text(text)
    assert found <= set(imports(tmp_path / "module.py", package))


def test_library_imports_no_ros() -> None:
    assert [f"{path}: {name}" for path, name in library_imports() if is_ros(name)] == []


def test_the_order_of_rooms_has_no_circle() -> None:
    order = list(TopologicalSorter(MAY_IMPORT).static_order())
    assert order.index("messages") == 0
    assert order.index("estimation") < order.index("tracking") < order.index("scenario")


def test_rooms_import_forwards_only() -> None:
    """The command line and the modules beside the rooms may import all; nothing imports them."""
    wrong = []
    for path, name in library_imports():
        room = path.parts[0]
        parts = name.split(".")
        if len(path.parts) == 1 or room == "cli" or parts[0] != "netpos" or len(parts) < 2:
            continue
        assert room in MAY_IMPORT, f"give the new room '{room}' its place in MAY_IMPORT"
        if parts[1] not in {room, "__version__", *MAY_IMPORT[room]}:
            wrong.append(f"{path}: {name}")
    assert wrong == []


@pytest.mark.parametrize("package", NODE_PACKAGES)
def test_node_package_is_three_files(package: str) -> None:
    files = {path.name for path in (SOURCE / package / package).glob("*.py")}
    assert files == {"__init__.py", "parameters.py", "conversions.py", "node.py"}


@pytest.mark.parametrize("package", NODE_PACKAGES)
def test_only_the_node_reads_a_clock(package: str) -> None:
    for path in (SOURCE / package / package).glob("*.py"):
        if path.name != "node.py":
            clocks = {"time", "datetime", "rclpy.clock"} & set(imports(path))
            assert not clocks, f"{path.name} imports {clocks}"


@pytest.mark.parametrize("package", NODE_PACKAGES)
def test_nodes_do_not_import_one_another(package: str) -> None:
    others = {"netpos_bag", *NODE_PACKAGES} - {package}
    for path in (SOURCE / package / package).glob("*.py"):
        assert not others & {name.split(".")[0] for name in imports(path)}, path.name


CORE = ("estimation/engine", "estimation/mixture/epoch", "tracking/estimators/estimates")
CORE += ("tracking/estimators/models", "tracking/config", "tracking/smoothing/planar")
CORE += ("estimation/mixture/sectors",)


@pytest.mark.parametrize("name", CORE)
def test_the_core_names_no_motion_model_and_no_filter_form(name: str) -> None:
    """Neither imports the module of one nor compares with its name."""
    names = (
        {m.name.lower() for m in motion.MODELS} | {*motion.SETS} | {f.name for f in forms.FORMS}
    )
    tree = ast.parse((LIBRARY / f"{name}.py").read_text(encoding="utf-8"))
    told: set[str] = set()
    for node in ast.walk(tree):
        match node:
            case ast.Constant(value=str(text)):
                told.add(text)
            case ast.Name(id=text) | ast.Attribute(attr=text) | ast.alias(name=text):
                told.add(text)
            case _:
                pass
    assert {text.lower() for text in told} & names == set()
