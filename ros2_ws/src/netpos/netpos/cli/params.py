"""``netpos params``: what can be set, and a file to set it with."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from netpos.cli.results import refuse_recording
from netpos.common.files import write_text

_WIDTH = 78


def params(
    search: Annotated[
        str, typer.Argument(help="Show only parameters with this word in name or meaning.")
    ] = "",
    dump: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.yaml", help="Write a commented file for the node ekf_tracker instead."
        ),
    ] = None,
    source: Annotated[
        str,
        typer.Option("--from", metavar="SOURCE", help="Take the values of this scenario or bag."),
    ] = "",
) -> None:
    """Show the parameters of the tracker: default, range and meaning."""
    from dataclasses import asdict  # noqa: PLC0415

    from netpos.scenario.settings import settings_from  # noqa: PLC0415
    from netpos.tracking.config import TrackerConfig  # noqa: PLC0415

    settings = settings_from(source)
    values = asdict(TrackerConfig.from_mapping(settings.parameters))
    if dump is None:
        from netpos.common.parameters import described_fields  # noqa: PLC0415

        for name, limits, text in described_fields(TrackerConfig):
            if search.lower() in f"{name} {text}".lower():
                shown = f"  ({limits})" if limits else ""
                typer.echo(f"{name}: {values[name]!r}{shown}\n    {text}")
        return
    refuse_recording(dump)
    if dump.exists():
        raise FileExistsError(f"{dump} exists; choose another name")
    write_text(dump, params_file(values, settings.vue_ids))
    typer.echo(
        f"wrote {dump}; start the tracker with: scripts/run_tracker.sh {dump}, or "
        f"ros2 run ekf_tracker ekf_tracker --ros-args --params-file {dump}"
    )


def params_file(values: dict[str, object], vue_ids: tuple[str, ...]) -> str:
    """A file of ROS parameters of the tracker, with the meaning of each above it."""
    import textwrap  # noqa: PLC0415

    import yaml  # noqa: PLC0415

    from netpos.common.parameters import described_fields  # noqa: PLC0415
    from netpos.tracking.config import TrackerConfig  # noqa: PLC0415

    def entry(name: str, value: object, text: str) -> list[str]:
        shown = list(value) if isinstance(value, tuple) else value
        told = yaml.safe_dump(shown, default_flow_style=True, width=1000)
        line = f"{name}: {told.removesuffix('...' + chr(10)).strip()}"
        comment = textwrap.wrap(text, _WIDTH, initial_indent="# ", subsequent_indent="# ")
        return [f"    {part}" for part in (*comment, line)]

    lines = [
        "# Parameters of the tracker, with their ranges.",
        "/**:  # in any namespace, under any name",
        "  ros__parameters:",
    ]
    lines += entry("vues", vue_ids, "devices whose topics exist from the start")
    for name, limits, text in described_fields(TrackerConfig):
        lines += entry(name, values[name], f"{text} ({limits})" if limits else text)
    return "\n".join(lines) + "\n"
