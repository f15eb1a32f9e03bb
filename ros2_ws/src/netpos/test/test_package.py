"""netpos as a library: what it offers, declares and brings when pip installs it."""

from __future__ import annotations

import ast
import importlib.metadata
import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import netpos
import numpy as np
import pytest
import yaml
from netpos import messages, scenario
from netpos.bags import BagError, BagReader, BagWriter, codec
from netpos.estimation.compile import SENTENCE
from netpos.scenario.recording import Recording
from netpos.tracking.tracker import Tracker

SOURCE = Path(__file__).resolve().parents[1]
# Distributions whose modules have another name.
NAMES = {"yaml": "pyyaml", "PIL": "pillow"}
STRANGERS = {"netpos"}

USE = """
import sys
import numpy as np
import netpos

places = {"a0": np.array([0.0, 0.0, 2.0]), "a1": np.array([9.0, 0.0, 2.0])}
rsus = [netpos.RsuInfo(rsu_id=name, position=place) for name, place in places.items()]
kind = netpos.RsuMeasurement
range_of = {"vue_id": "tag", "fields": kind.RANGE, "range_m": 5.0, "range_var": 0.01}
measured = [kind(stamp_ns=k * 10**8, rsu_id=f"a{k % 2}", **range_of) for k in range(1, 30)]
netpos.write_bag(sys.argv[1], rsus=rsus, measurements=measured)
found = netpos.read_bag(sys.argv[1])
assert [m.range_m for m in found.measurements] == [5.0] * 29
assert [info.rsu_id for info in found.rsus] == ["a0", "a1"]
assert found.facts["tracker"] == ("{}\\n",)
assert netpos.Scenario.load("fast_pass").name == "fast_pass"
print(netpos.__file__)
"""


def declared(extra: str | None) -> set[str]:
    wanted = importlib.metadata.requires("netpos") or []
    found = set()
    for text in wanted:
        name = re.match(r"[A-Za-z0-9_.-]+", text)
        assert name is not None
        if (f'extra == "{extra}"' in text) if extra else "extra ==" not in text:
            found.add(name.group(0).lower())
    return found


def imported() -> set[str]:
    """Third-party modules that the library imports, at its top or inside functions."""
    found = set()
    for path in (SOURCE / "netpos").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                found |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                found.add(node.module.partition(".")[0])
    return found - set(sys.stdlib_module_names) - STRANGERS


def test_what_is_imported_is_declared_and_nothing_else() -> None:
    modules = {NAMES.get(name, name).lower() for name in imported()}
    optional = set().union(*(declared(extra) for extra in ("bench", "cluster", "parquet")))
    assert modules - optional == declared(None)
    assert optional - modules <= {"pyarrow"}  # pandas imports it


EIGHT = ["RsuInfo", "RsuMeasurement", "Scenario", "Tracker", "TrackerConfig"]
EIGHT += ["evaluate", "read_bag", "write_bag"]


def test_eight_names_are_offered_and_described() -> None:
    assert netpos.__all__ == EIGHT
    for name in (netpos, *(getattr(netpos, name) for name in EIGHT)):
        assert name.__doc__
    told: dict[str, Any] = {}
    exec("from netpos import *", told)
    assert set(told) - {"__builtins__"} == set(EIGHT)


@pytest.mark.parametrize("where", [messages, scenario.Scenario, Tracker, Recording])
def test_what_the_eight_take_and_give_is_described(where: Any) -> None:
    names = getattr(where, "__all__", [name for name in vars(where) if name[0] != "_"])
    offered = [vars(where)[name] for name in names]
    assert offered
    plain = [o for o in offered if callable(o) or isinstance(o, property | classmethod)]
    assert [o for o in plain if not o.__doc__] == []


def test_a_message_s_constants_are_those_of_ros() -> None:
    """The class of values has them under the names of the .msg file, with the same numbers."""
    for kind in (netpos.RsuInfo, netpos.RsuMeasurement, messages.TrackState):
        name = {"TrackState": "TrackStatus"}.get(kind.__name__, kind.__name__)
        text = (SOURCE.parent / "netpos_msgs" / "msg" / f"{name}.msg").read_text("utf-8")
        constants = re.findall(r"^uint\d+ ([A-Z]+)=(\d+)", text, re.MULTILINE)
        assert constants
        assert {(n, int(getattr(kind, n))) for n, _ in constants} == {
            (n, int(value)) for n, value in constants
        }


@pytest.mark.parametrize("name", ["Odometry", "simulate", "load_scenario", "tracker"])
def test_anything_else_is_refused_with_the_eight_names(name: str) -> None:
    message = f"no '{name}'; it offers {', '.join(EIGHT)}$"
    with pytest.raises(ImportError, match=message):
        exec(f"from netpos import {name}", {})
    with pytest.raises(AttributeError, match=message):
        getattr(netpos, name)
    assert not hasattr(netpos, name)


def test_the_rooms_are_those_that_are_there() -> None:
    told = re.findall(r"^``(\w+)``  ", str(netpos.__doc__).partition("Rooms")[2], re.MULTILINE)
    there = {path.parent.name for path in (SOURCE / "netpos").glob("*/__init__.py")}
    assert set(told) == there


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from the source archive, as from a package index."""
    out = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(out), str(SOURCE)]
    made = subprocess.run(command, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stdout + made.stderr
    (found,) = out.glob("*.whl")
    return found


def test_a_wheel_brings_messages_and_scenarios(wheel: Path) -> None:
    held = set(zipfile.ZipFile(wheel).namelist())
    for folder, kind in (("netpos_msgs/msg", "msg"), ("netpos_bringup/scenarios", "yaml")):
        room = {"msg": "netpos/bags/msg", "yaml": "netpos/scenario/scenarios"}[kind]
        names = {path.name for path in (SOURCE.parent / folder).glob(f"*.{kind}")}
        assert names
        assert {f"{room}/{name}" for name in names} <= held
    assert "netpos/evaluation/report/page.html" in held
    assert not any(name.startswith("test/") for name in held)


def test_a_wheel_writes_and_reads_bags_without_ros(wheel: Path, tmp_path: Path) -> None:
    """No ROS, no source tree: definitions and scenarios come with the library."""
    site = tmp_path / "site"
    zipfile.ZipFile(wheel).extractall(site)
    environment = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(("AMENT", "ROS", "COLCON", "NUMBA", "NETPOS"))
    }
    script = tmp_path / "use.py"
    script.write_text(USE, encoding="utf-8")
    bag = tmp_path / "a_walk"
    made = subprocess.run(
        [sys.executable, str(script), str(bag)],
        env=environment | {"PYTHONPATH": str(site)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert made.returncode == 0, made.stderr
    assert made.stdout.strip().startswith(str(site))
    with BagReader(bag) as reader:
        assert reader.topics["/rsu/measurements"].count == 29


KERNEL = """
from netpos.estimation.compile import leaf

@leaf
def double(x):
    return 2 * x

print(double(2.0), double(3))
"""


def test_the_first_compilation_says_so_and_no_other(tmp_path: Path) -> None:
    script = tmp_path / "kernel.py"
    script.write_text(KERNEL, encoding="utf-8")
    told = []
    for _ in range(2):
        made = subprocess.run(
            [sys.executable, str(script)],
            env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kernels")},
            capture_output=True,
            text=True,
            check=True,
        )
        assert made.stdout == "4.0 6\n"
        told.append(made.stderr)
    assert told == [SENTENCE, ""]


def test_a_bag_is_read_as_it_was_tracked(tmp_path: Path) -> None:
    scenario = netpos.Scenario.load("fast_pass", 3, {"max_duration_s": 2.0})
    run = scenario.simulate(tmp_path / "run")
    assert not run.odometry
    found = run.track(tmp_path / "track")
    assert found.path == tmp_path / "track"
    epochs = {m.sequence for m in run.measurements}
    assert len(found.status["vue_1"]) == len(epochs)
    assert len(found.odometry["vue_1"]) == len(found.clock["vue_1"])
    states = [status.state for status in found.status["vue_1"]]
    assert len(found.odometry["vue_1"]) == len(states) - states.count(messages.TrackState.WAITING)
    assert {info.rsu_id for info in found.rsus} == {m.rsu_id for m in found.measurements}
    evaluation = netpos.evaluate(found, skip=2)
    last = found.odometry["vue_1"][-1]
    true = next(t for t in found.truth["vue_1"] if t.stamp_ns == last.stamp_ns)
    errors = evaluation.vues["vue_1"].scored.pairs.horizontal_error
    assert float(np.hypot(*(last.position - true.position)[:2])) == pytest.approx(errors[-1])


def test_a_recording_is_tracked_with_other_parameters(tmp_path: Path) -> None:
    run = netpos.Scenario.load("fast_pass", 3, {"max_duration_s": 2.0}).simulate(tmp_path / "run")
    usual = run.track(tmp_path / "usual")
    loose = run.track(tmp_path / "loose", {"accel_sd_mps2": 20.0}, smooth=True)
    assert yaml.safe_load(loose.facts["tracker"][0])["accel_sd_mps2"] == 20.0
    spread = [r.odometry["vue_1"][-1].twist_cov[0, 0] for r in (usual, loose)]
    assert spread[1] > 2.0 * spread[0]
    with BagReader(Path(loose)) as bag:
        assert bag.topics["/vue_1/odometry_smoothed"].count == len(loose.odometry["vue_1"])
    with pytest.raises(ValueError, match="speed"):
        run.track(tmp_path / "odd", {"speed": 1.0})


def test_a_bag_of_other_types_under_our_names_is_refused(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "odd") as bag:
        bag.write("/rsu/info", codec().clock_to_msg(1), 1)
    with pytest.raises(BagError, match="/rsu/info holds rosgraph_msgs"):
        netpos.read_bag(tmp_path / "odd")


def test_the_example_of_the_readme_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (SOURCE.parents[2] / "README.md").read_text(encoding="utf-8")
    example = text[text.index("## As a library") :].partition("```python\n")[2].partition("```")[0]
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(example, names)
    assert 0.0 < float(capsys.readouterr().out) < 2.0
    assert names["last"].stamp_ns == names["track"].odometry["vue_1"][-1].stamp_ns
