"""Find and read scenario files. Every error message names the file, the line and the key."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from netpos.common.parameters import FaultsError
from netpos.common.yaml_text import YamlError, compose_yaml, dump_yaml
from netpos.scenario.schema import Scenario

_SHARED = Path("share/netpos_bringup/scenarios")
_SHIPPED = Path(__file__).parent / "scenarios"
_YAML_1_2_FLOAT = re.compile(r"^[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)[eE][-+]?[0-9]+$")


class ScenarioError(FaultsError):
    """A scenario that cannot be used; the text names file, line, key and remedy."""


class _Loader(yaml.SafeLoader):  # type: ignore[misc]
    """YAML 1.2 floats: 1e-3 is a number, not text."""


_Loader.add_implicit_resolver("tag:yaml.org,2002:float", _YAML_1_2_FLOAT, list("-+.0123456789"))


def _folders() -> list[Path]:
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    return [Path(p) / _SHARED for p in prefixes if p] + [_SHIPPED]


def scenario_files() -> dict[str, Path]:
    """Installed scenarios by name; those of the library fill in what is not installed."""
    files: dict[str, Path] = {}
    for folder in _folders():
        for path in sorted(folder.glob("*.yaml")):
            files.setdefault(path.stem, path)
    return files


def scenario_names() -> tuple[str, ...]:
    """Names that ``load_scenario`` finds, sorted."""
    return tuple(sorted(scenario_files()))


def load_scenario(
    name_or_path: str, seed: int | None = None, changes: Mapping[str, object] | None = None
) -> Scenario:
    """Read a scenario by name or by path of a YAML file.

    ``seed`` replaces the file's seed. ``changes`` replaces single values before validation, keys
    with dots and list indices: ``{"devices.0.beacon_interval_s": 0.01}``.

    Raises
    ------
    ScenarioError  no such scenario, not YAML, unknown or missing keys, values out of range
    """
    path = _find(name_or_path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ScenarioError(f"{path}: cannot be read: {error}") from error
    return _parse(path, text, {} if seed is None else {"seed": seed}, changes or {})


def scenario_text(scenario: Scenario) -> str:
    """A scenario as YAML, with the seed it runs with; ``scenario_of_text`` reads it."""
    content = scenario.model_dump(mode="json", exclude_unset=True)
    return dump_yaml({**content, "seed": scenario.seed}, sort_keys=False)


def scenario_of_text(text: str, path: Path) -> Scenario:
    """The scenario of a text read from ``path``. Raises ``ScenarioError`` as ``load_scenario``."""
    return _parse(path, text, {}, {})


def _parse(
    path: Path, text: str, given: Mapping[str, object], changes: Mapping[str, object]
) -> Scenario:
    node = _compose(path, text)
    try:
        content: dict[str, Any] = yaml.load(text, _Loader)
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        raise ScenarioError(f"{path}: not valid YAML: {' '.join(str(error).split())}") from error
    content.setdefault("name", path.stem)
    content.update(given)
    for key, value in changes.items():
        _change(content, key, value)
    try:
        return Scenario.model_validate(content)
    except ValidationError as error:
        raise ScenarioError(_describe(path, node, error)) from error


def place_of(name_or_path: str, *keys: str) -> str:
    """File, line and key of a value of a readable scenario: "a.yaml: line 3: tracker.x"."""
    path = _find(name_or_path)
    text, line = _locate(_compose(path, path.read_text(encoding="utf-8")), keys)
    return f"{path}: line {line}: {text}"


def _find(name_or_path: str) -> Path:
    if name_or_path.endswith((".yaml", ".yml")) or os.sep in name_or_path:
        path = Path(name_or_path)
        if not path.is_file():
            raise ScenarioError(f"no scenario file {name_or_path}")
        return path
    files = scenario_files()
    if name_or_path not in files:
        raise ScenarioError(
            f"no scenario {name_or_path!r}; known: {', '.join(sorted(files)) or 'none'}, "
            "or give the path of a YAML file"
        )
    return files[name_or_path]


def _compose(path: Path, text: str) -> yaml.MappingNode:
    try:
        node = compose_yaml(text, _Loader)
    except YamlError as error:
        raise ScenarioError(f"{path}: {error}") from error
    if not isinstance(node, yaml.MappingNode):
        raise ScenarioError(f"{path}: a scenario is a mapping of keys to values")
    _check_keys(path, node)
    return node


def _check_keys(path: Path, node: yaml.Node) -> None:
    """Refuse keys that are given twice, or are no words."""
    if isinstance(node, yaml.SequenceNode):
        for item in node.value:
            _check_keys(path, item)
    if not isinstance(node, yaml.MappingNode):
        return
    seen: dict[str, int] = {}
    for key, value in node.value:
        line = key.start_mark.line + 1
        if not isinstance(key, yaml.ScalarNode):
            raise ScenarioError(f"{path}: line {line}: a key is a word, no list and no mapping")
        if key.value in seen:
            raise ScenarioError(
                f"{path}: line {line}: {key.value} was given already in line {seen[key.value]}"
            )
        seen[key.value] = line
        _check_keys(path, value)


def _change(content: Any, dotted: str, value: object) -> None:
    *parents, last = [int(part) if part.isdigit() else part for part in dotted.split(".")]
    try:
        for part in parents:
            content = content.setdefault(part, {}) if isinstance(content, dict) else content[part]
        content[last] = value
    except (KeyError, IndexError, TypeError) as error:
        raise ScenarioError(f"change {dotted}: the scenario has no such place") from error


def _describe(path: Path, root: yaml.Node, error: ValidationError) -> str:
    """One sentence per error."""
    lines = []
    complaints = error.errors(include_url=False)
    for item in complaints:
        if item["type"] == "too_short" and any(
            other["loc"][: len(item["loc"])] == item["loc"] and other is not item
            for other in complaints
        ):
            continue  # short only of the entries the others complain about
        keys, line = _locate(root, item["loc"])
        text = item["msg"].removeprefix("Value error, ")
        if item["type"] in {"extra_forbidden", "unexpected_keyword_argument"}:
            text = "unknown key; check its spelling or remove it"
        elif item["type"] == "missing":
            text = "is missing"
        elif not isinstance(item["input"], dict | list | tuple):
            text = f"{text[:1].lower()}{text[1:]}, got {item['input']!r}"
        lines.append(f"{path}: line {line}: {keys or 'scenario'}: {text}")
    return "\n".join(lines)


def _locate(root: yaml.Node, loc: tuple[int | str, ...]) -> tuple[str, int]:
    """Dotted key and line of an error, without parts that only name a variant of the schema."""
    node, line, keys = root, root.start_mark.line + 1, []
    for position, part in enumerate(loc):
        if isinstance(node, yaml.MappingNode):
            entry = next(((k, v) for k, v in node.value if k.value == part), None)
            if entry is not None:
                line, node = entry[0].start_mark.line + 1, entry[1]
            elif position < len(loc) - 1:
                continue
        elif (
            isinstance(node, yaml.SequenceNode)
            and isinstance(part, int)
            and part < len(node.value)
        ):
            node = node.value[part]
            line = node.start_mark.line + 1
        keys.append(str(part))
    return ".".join(keys), line
