"""``netpos geojson``: a bag for maps."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from netpos.cli.progress import doing
from netpos.cli.results import refuse_recording


def geojson(
    bag: Annotated[Path, typer.Argument(help="Bag with RSUs, tracks or ground truth.")],
    out: Annotated[Path, typer.Argument(metavar="FILE.geojson", help="File to write.")],
    datum: Annotated[
        str,
        typer.Option(
            help="Latitude, longitude [deg] and height [m] of the map's origin; default: that of "
            "the tracker."
        ),
    ] = "",
) -> None:
    """Write RSUs, tracks and ground truth of a bag as GeoJSON."""
    from netpos.bags.geojson import geojson_of  # noqa: PLC0415
    from netpos.bags.recording import RecordedValues  # noqa: PLC0415
    from netpos.common.files import write_text  # noqa: PLC0415

    refuse_recording(out)
    with doing("reading"):
        content = geojson_of(RecordedValues(bag), datum)
    write_text(out, json.dumps(content) + "\n")
    typer.echo(f"wrote {out}: {len(content['features'])} features")
