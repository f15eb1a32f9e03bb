"""Pages of the site that are written from the code: parameters, messages, commands, API."""

from __future__ import annotations

import ast
import io
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import redirect_stdout, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import netpos
import typer
from netpos import messages
from netpos.cli.examples import EXAMPLES
from netpos.cli.main import app
from netpos.common.parameters import described_fields
from netpos.inertial.pdr_config import PdrConfig
from netpos.tracking.config import TrackerConfig
from netpos.tracking.networks.config import FusionConfig
from netpos_bag.parameters import play_flags, record_flags

SOURCE = Path(__file__).resolve().parents[2] / "ros2_ws" / "src"
Rows = Sequence[Sequence[str]]


def table(head: Sequence[str], rows: Rows) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(map(_cell, line))} |" for line in lines) + "\n"


def _cell(text: str) -> str:
    """Text of a cell; a bar in code is one already."""
    pieces = text.replace("\n", " ").split("`")
    pieces[::2] = [piece.replace("|", "\\|").replace("<", "&lt;") for piece in pieces[::2]]
    return "`".join(pieces)


def _code(value: object) -> str:
    shown = list(value) if isinstance(value, tuple) else value
    text = str(shown).lower() if isinstance(shown, bool) else str(shown)
    return f"`{text}`" if text else "empty"


def _config_table(config: type[Any], code: Callable[[object], str] = _code) -> str:
    defaults = asdict(config())
    rows = [
        [f"`{name}`", code(defaults[name]), limits or "see the meaning", text]
        for name, limits, text in described_fields(config)
    ]
    return table(["parameter", "default", "range", "meaning"], rows)


def node_parameters(package: str) -> Iterator[tuple[str, str, str]]:
    """Name, default and sentence of what a node declares one by one."""
    path = SOURCE / package / package / "parameters.py"
    tree = ast.parse(path.read_text(encoding="utf-8"))
    nodes: list[tuple[int, ast.AST]] = [
        (node.lineno, node) for node in ast.walk(tree) if isinstance(node, ast.Assign | ast.Call)
    ]
    text = ""
    for _, node in sorted(nodes, key=lambda entry: entry[0]):
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "text":
            text = ast.literal_eval(node.value)
        elif isinstance(node, ast.Call) and getattr(node.func, "id", "") == "declare":
            _, name, default, about = node.args
            if not isinstance(name, ast.Constant):
                continue
            description = text if isinstance(about, ast.Name) else ast.literal_eval(about)
            known = isinstance(default, ast.Constant)
            shown = _code(ast.literal_eval(default)) if known else "of the scenario"
            yield str(name.value), shown, str(description)


def _declared(package: str) -> str:
    rows = [[f"`{name}`", default, text] for name, default, text in node_parameters(package)]
    return table(["parameter", "default", "meaning"], rows)


def parameters_page() -> str:
    """Every parameter of every node."""
    steps = [[f"`{name}`", _code(value), text] for name, value, text in PdrConfig().entries()]
    return "\n\n".join(
        [
            "# Parameters",
            "This page is written from the code. `netpos params WORD` shows the parameters of the "
            "tracker with that word in name or meaning. `netpos params --dump params.yaml` writes "
            "all of them to a commented file.",
            "A value that is out of range stops the node with a sentence that names the "
            "parameter, the value and the range. A wrong name does so too.",
            "## Tracker: ekf_tracker",
            _config_table(TrackerConfig),
            "The node itself:",
            _declared("ekf_tracker"),
            "## Fusion of networks: track_fusion",
            _config_table(FusionConfig),
            "The node itself:",
            _declared("track_fusion"),
            "## Dead reckoning: pdr_node",
            table(["parameter", "default (carried)", "meaning"], steps),
            "The node itself:",
            _declared("pdr_node"),
            "## Simulated devices: vue_sim",
            _declared("vue_sim"),
            "## Simulated RSUs: rsu_sensor",
            _declared("rsu_sensor"),
            "## Recorder and player: netpos_bag",
            "Their options are parameters too: see [commands](commands.md#ros2-run-netpos_bag).",
        ]
    )


_CONSTANT = re.compile(r"^(\w+) (\w+)=(\S+)\s*(?:#\s*(.*))?$")
_FIELD = re.compile(r"^(\S+) (\w+)\s*(?:#\s*(.*))?$")


def _message(path: Path) -> str:
    head, constants, values = [], [], []
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.startswith("#"):
            head.append(line.lstrip("# "))
        elif constant := _CONSTANT.match(line):
            kind, name, value, about = constant.groups()
            constants.append([f"`{name}`", f"`{value}`", about or ""])
        elif value := _FIELD.match(line):
            kind, name, about = value.groups()
            values.append([f"`{name}`", f"`{kind}`", about or ""])
    parts = [f"## {path.stem}", " ".join(head), table(["field", "type", "meaning"], values)]
    if constants:
        parts.append(table(["constant", "value", "meaning"], constants))
    return "\n\n".join(parts)


def messages_page() -> str:
    """The messages of netpos_msgs, from the comments of their definitions."""
    files = sorted((SOURCE / "netpos_msgs" / "msg").glob("*.msg"))
    intro = (
        "This page is written from the `.msg` files of `netpos_msgs`. SI units and radians "
        "everywhere; [topics](../topics.md) says who sends what to whom."
    )
    return "\n\n".join(["# Messages", intro, *map(_message, files)])


def _commands(command: Any, name: str) -> Iterator[tuple[str, Any]]:
    inner = getattr(command, "commands", None)
    if inner is None:
        yield name, command
        return
    for word, below in inner.items():
        yield from _commands(below, f"{name} {word}".strip())


def _option(parameter: Any) -> list[str]:
    if parameter.param_type_name == "argument":
        name = (parameter.metavar or parameter.name or "").upper()
        return [f"`{name}`", getattr(parameter, "help", None) or ""]
    names = ", ".join(f"`{name}`" for name in (*parameter.opts, *parameter.secondary_opts))
    value = f" `{parameter.metavar}`" if parameter.metavar else ""
    default = parameter.default
    shown = default not in (None, "", False, ()) and not callable(default)
    about = (parameter.help or "") + (f" Default: {_code(default)}." if shown else "")
    return [names + value, about]


def _command(name: str, command: Any) -> str:
    rows = [_option(p) for p in command.params if p.name != "help"]
    parts = [f"## netpos {name}", command.help or ""]
    if rows:
        parts.append(table(["argument or option", "meaning"], rows))
    if name in EXAMPLES:
        parts.append("\n".join(["```sh", *EXAMPLES[name], "```"]))
    return "\n\n".join(parts)


def _help(flags: Callable[[Sequence[str]], Any]) -> str:
    text = io.StringIO()
    with redirect_stdout(text), suppress(SystemExit):
        flags(["--help"])
    return f"```text\n{text.getvalue().strip()}\n```"


def commands_page() -> str:
    """Every command with its options and examples."""
    commands = _commands(typer.main.get_command(app), "")
    return "\n\n".join(
        [
            "# Commands",
            "This page is written from the code; `netpos COMMAND -h` shows the same. "
            "Exit status: 0 done, 1 the work failed, 2 bad usage, 130 interrupted. "
            "`netpos --install-completion` completes commands, options and names of scenarios in "
            "your shell.",
            *(_command(name, command) for name, command in commands),
            "## ros2 run netpos_bag",
            _help(record_flags),
            _help(play_flags),
        ]
    )


def api_page() -> str:
    """What ``import netpos`` and ``netpos.messages`` offer."""
    names = ", ".join(f"`{name}`" for name in netpos.__all__)
    intro = (
        f"`import netpos` offers {len(netpos.__all__)} names: {names}. These names and their "
        "arguments stay; what is below them may change "
        "([decision 0087](../decisions/0087-a-library-that-pip-installs.md)). "
        "[Your own RSUs](../tutorials/own_rsus.md) and the "
        "[notebooks](../notebooks/arrays_to_track.md) use them."
    )
    of_messages = (
        "What a tracker or a recording takes and gives besides `RsuInfo` and `RsuMeasurement`, "
        "each with the fields of its ROS message: `from netpos.messages import Odometry`. They "
        "change when the ROS messages do."
    )
    recording = _api("netpos.scenario.recording", "Recording", "A recording", inherited=True)
    return "\n\n".join(
        [
            "# Python API",
            intro,
            *(_api(*home, f"netpos.{name}") for name, home in netpos._HOME.items()),
            "## What read_bag returns",
            recording,
            "## What evaluate returns",
            _api("netpos.evaluation.evaluate", "Evaluation", "With ground truth"),
            _api("netpos.evaluation.evaluate", "VueEvaluation", "One device"),
            _api("netpos.evaluation.metrics", "Figures", "Its figures"),
            _api("netpos.evaluation.survey", "Survey", "Without ground truth"),
            "## Values of messages",
            of_messages,
            *(_api("netpos.messages.values", name, name) for name in messages.__all__),
        ]
    )


def _api(module: str, name: str, heading: str, *, inherited: bool = False) -> str:
    return (
        f"::: {module}.{name}\n    options:\n      heading: {heading}\n"
        f"      toc_label: {heading}\n      inherited_members: {str(inherited).lower()}"
    )
