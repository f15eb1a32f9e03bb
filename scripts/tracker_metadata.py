"""Print what a recording says of the parameters of its tracker:
python scripts/tracker_metadata.py SOURCE [ARGUMENT...]

SOURCE is a scenario or bag, the arguments are those of the tracker (-p NAME:=VALUE).
"""

from __future__ import annotations

import sys
from dataclasses import asdict, fields
from typing import Any

import yaml
from netpos.tracking import TrackerConfig
from netpos.tracking.settings import as_metadata, settings_from


def main() -> None:
    """NAME=VALUE, each ended by a zero byte; exit 2 for what cannot be used."""
    source, *arguments = sys.argv[1:]
    try:
        settings = settings_from(source)
        given = {**settings.parameters, **_parameters(arguments)}
        metadata = as_metadata(asdict(TrackerConfig.from_mapping(given)), settings)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    for name, value in metadata.items():
        print(f"{name}={value}", end="\0")


def _parameters(arguments: list[str]) -> dict[str, Any]:
    """Those of ``TrackerConfig`` in the arguments of a node."""
    names = {field.name for field in fields(TrackerConfig)}
    pairs = (argument.partition(":=") for argument in arguments)
    return {name: yaml.safe_load(value) for name, sign, value in pairs if sign and name in names}


if __name__ == "__main__":
    main()
