"""What the documents promise to be complete: scenario keys, reasons for refusal, topics."""

from __future__ import annotations

import ast
import json
import pydoc
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import netpos
import pytest
import yaml
from netpos import messages
from netpos.estimation.sensors.table import readings
from netpos.messages import topics
from netpos.scenario import load_scenario
from netpos.scenario.schema import Scenario
from netpos.tracking.door import refusals

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
LIBRARY = ROOT / "ros2_ws/src/netpos/netpos"
TRACKING = LIBRARY / "tracking"
PAGES = [ROOT / "README.md", *DOCS.glob("*.md"), *DOCS.glob("tutorials/*.md")]
README_LINES = 120
# Parameters of tracker, fusion and dead reckoning are described on another page.
FREE = ("tracker", "fusion", "pdr")


def yaml_blocks(page: str) -> list[dict[str, Any]]:
    text = (DOCS / page).read_text(encoding="utf-8")
    return [yaml.safe_load(block) for block in re.findall(r"```yaml\n(.*?)```", text, re.DOTALL)]


FIRST, *OTHERS = yaml_blocks("scenarios.md")


def shown(content: Any, path: str = "") -> Iterator[str]:
    """Dotted keys of a scenario, without the indices of lists."""
    if isinstance(content, list):
        for item in content:
            yield from shown(item, path)
    elif isinstance(content, dict):
        for key, value in content.items():
            yield f"{path}{key}"
            if key not in FREE:
                yield from shown(value, f"{path}{key}.")


def known(schema: dict[str, Any], node: dict[str, Any], path: str = "") -> Iterator[str]:
    """Dotted keys that a scenario may have."""
    if "$ref" in node:
        node = schema["$defs"][node["$ref"].rpartition("/")[2]]
    variants = [*node.get("anyOf", ()), *node.get("oneOf", ())]
    for inner in [*variants, node["items"]] if "items" in node else variants:
        yield from known(schema, inner, path)
    for key, value in node.get("properties", {}).items():
        yield f"{path}{key}"
        yield from known(schema, value, f"{path}{key}.")


def test_every_key_of_a_scenario_has_an_example() -> None:
    schema = Scenario.model_json_schema()
    keys = set(known(schema, schema))
    assert {"devices.route.points", "measurement.errors.waveform.pilots"} <= keys
    assert keys - set().union(*map(set, map(shown, (FIRST, *OTHERS)))) == set()


@pytest.mark.parametrize("number", range(len(OTHERS) + 1))
def test_the_examples_of_scenarios_load(number: int, tmp_path: Path) -> None:
    changes = OTHERS[number - 1] if number else {}
    path = tmp_path / "example.yaml"
    path.write_text(yaml.safe_dump({**FIRST, **changes}), encoding="utf-8")
    assert load_scenario(str(path)).duration_s > 1.0


def test_every_scenario_is_in_the_table() -> None:
    text = (DOCS / "scenarios.md").read_text(encoding="utf-8")
    shipped = (ROOT / "ros2_ws/src/netpos_bringup/scenarios").glob("*.yaml")
    assert [path.stem for path in shipped if f"`{path.stem}`" not in text] == []


def reasons() -> set[str]:
    """Every word under which something is refused or counted."""
    found = set(refusals._SENTENCES)
    found |= {refusal.reason for _, reading in readings() for refusal in reading.refusals}
    for path in TRACKING.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        found |= set(re.findall(r'rejected\["(\w+)"\]', text))
        found |= set(re.findall(r'^ +Verdict\.\w+: "(\w+)"', text, re.MULTILINE))
    networks = (TRACKING / "networks" / "validation.py").read_text(encoding="utf-8")
    found |= set(re.findall(r'return "(\w+)"$', networks, re.MULTILINE))
    return found | {"unknown_network", "own_covariance"}


@pytest.mark.parametrize("page", ["troubleshooting.md", "topics.md"])
def test_every_reason_for_refusal_is_explained(page: str) -> None:
    assert {"gate", "negative_range", "clock_ahead", "shape"} <= reasons()
    text = (DOCS / page).read_text(encoding="utf-8")
    assert sorted(reason for reason in reasons() if f"`{reason}`" not in text) == []


@pytest.mark.parametrize(
    "name", ["AMBIGUOUS", "COASTING", "STALE", "INITIALISING", "WAITING", "NEES", "recorder"]
)
def test_troubleshooting_knows_what_a_user_sees(name: str) -> None:
    assert name in (DOCS / "troubleshooting.md").read_text(encoding="utf-8")


def test_every_topic_is_described() -> None:
    text = (DOCS / "topics.md").read_text(encoding="utf-8")
    device = (topics.BEACON, topics.GROUND_TRUTH, topics.GROUND_TRUTH_CLOCK, topics.IMU,
              topics.MAG, topics.STEP, topics.STEP_VELOCITY, topics.GROUND_SPEED,
              topics.INITIAL_POSE, *topics.TRACKER_OUTPUTS)  # fmt: skip
    names = [*(f"/<vue>/{name}" for name in device), *topics.RUN_TOPICS]
    names += [topics.CLOCK, topics.RSU_INFO, topics.RSU_MEASUREMENTS, topics.RSU_LEARNED]
    names += [topics.DIAGNOSTICS, topics.TF, topics.tracks_of("<network>")]
    assert [name for name in names if f"`{name}`" not in text and name != "/<vue>/mag"] == []


DECISIONS = sorted((DOCS / "decisions").glob("0*.md"))


@pytest.mark.parametrize("path", DECISIONS, ids=lambda path: path.stem[:4])
def test_a_decision_has_a_status_and_a_row_in_the_table(path: Path) -> None:
    """A decision is accepted or void since a later one; the table has its title and status."""
    title, _, status, *_ = path.read_text(encoding="utf-8").splitlines()
    number = path.stem[:4]
    assert title.startswith(f"# {number}: ")
    state = re.match(r"Status: (accepted|void since \[(\d{4})\])", status)
    assert state is not None
    table = (DOCS / "decisions" / "README.md").read_text(encoding="utf-8")
    (row,) = [line for line in table.splitlines() if f"]({path.name})" in line]
    _, cell, name, now, about, _ = row.split("|")
    assert cell.strip() == f"[{number}]({path.name})"
    assert name.strip() == title.removeprefix(f"# {number}: ")
    assert now.strip().startswith(f"void since {state[2]}" if state[2] else "accepted")
    assert about.strip()


def test_the_readme_is_two_screens() -> None:
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) <= README_LINES
    assert max(map(len, lines)) <= 400


# Pages for who changes netpos use what is inside.
INSIDE = {
    *("adding_a_sensor.md", "adding_a_motion_model_or_filter.md", "adding_a_split.md"),
    "robustness.md",
}


def python_of_pages() -> Iterator[tuple[str, str]]:
    """Python that a user is shown, with the name of its page."""
    for path in PAGES:
        text = path.read_text(encoding="utf-8")
        for block in re.findall(r"```python[^\n]*\n(.*?)```", text, re.DOTALL):
            if path.name not in INSIDE:
                yield path.name, block
    for path in DOCS.glob("notebooks/*.ipynb"):
        for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
            if cell["cell_type"] == "code":
                yield path.name, "".join(cell["source"])


def test_pages_use_public_names_and_each_is_used() -> None:
    used: set[str] = set()
    for page, block in python_of_pages():
        for node in ast.walk(ast.parse(block)):
            match node:
                case ast.Attribute(value=ast.Name(id="netpos"), attr=name):
                    used.add(name)
                case ast.Import(names=names):
                    inside = [a.name for a in names if a.name.startswith("netpos.")]
                    assert inside == [], page
                case ast.ImportFrom(module="netpos.messages", names=names):
                    assert {alias.name for alias in names} <= set(messages.__all__), page
                case ast.ImportFrom(module=str(module), names=names):
                    assert not module.startswith("netpos."), page
                    used |= {alias.name for alias in names if module == "netpos"}
    assert used == set(netpos.__all__)


@pytest.mark.parametrize("path", [*PAGES, *DOCS.glob("results/*.md")], ids=lambda path: path.stem)
def test_modules_and_files_that_a_page_names_exist(path: Path) -> None:
    """Decisions keep the names of their day."""
    text = path.read_text(encoding="utf-8")
    for name in re.findall(r"`(netpos(?:\.\w+)+)`", text):
        if not name.endswith((".json", ".rviz")):
            assert pydoc.locate(name) is not None, name
    rooms = "|".join(folder.name for folder in LIBRARY.iterdir() if folder.is_dir())
    for name in re.findall(rf"`((?:{rooms})/[\w/.]*)`", text):
        assert (LIBRARY / name).exists(), name


def test_public_names_are_decided_and_described() -> None:
    decision = (DOCS / "decisions/0087-a-library-that-pip-installs.md").read_text("utf-8")
    named = re.search(r"Public are eight names: ([^.]*)\.", decision)
    assert named is not None
    assert re.findall(r"`(\w+)`", named.group(1)) == netpos.__all__
    described = str(netpos.__doc__).partition("-\n")[2].partition("\n\n")[0]
    assert sorted(re.findall(r"``(\w+)``", described)) == sorted(netpos.__all__)
