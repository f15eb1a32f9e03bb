"""``netpos import csv`` and ``netpos import ros``: anybody's recording, without code."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast, get_args

import typer

from netpos.cli.progress import doing
from netpos.cli.runs import parse_setting, refuse_existing

if TYPE_CHECKING:
    from netpos.bags.importers.own.columns import Columns
    from netpos.bags.importers.own.recording import Truth
    from netpos.messages.values import RsuInfo

Bag = Annotated[Path, typer.Argument(help="Bag to write; it must not exist.")]
Map = Annotated[
    str,
    typer.Option(
        "--map",
        metavar="NAME=WHERE,...",
        help="Which column (header or number from 1) or field holds time, rsu, range, azimuth, "
        "elevation, toa, phase, tdoa (with reference), x, y, z, vue, rssi, line_of_sight; "
        "range:a1=3 where each RSU has a column; range_sd or range_var where the spread is given.",
    ),
]
Units = Annotated[
    str,
    typer.Option(
        metavar="NAME=UNIT,...",
        help="time: s, ms, us, ns, iso; range and position: m, cm, mm, km, ft; angles: rad, deg; "
        "toa: s, ms, us, ns, m. Default: SI.",
    ),
]
Sd = Annotated[
    str,
    typer.Option(
        metavar="NAME=VALUE,...",
        help="Standard deviation, as in the data sheet, in the unit of the quantity.",
    ),
]
Rsus = Annotated[
    Path | None,
    typer.Option(help="YAML (rsus: {a0: [x, y, z]}) or CSV (rsu,x,y,z) with the RSUs' positions."),
]
Vue = Annotated[str, typer.Option(help="Name of the device where no column names it.")]
Height = Annotated[float | None, typer.Option(help="Height of the device in the map, m.")]
Lever = Annotated[
    str | None,
    typer.Option(metavar="X,Y,Z", help="Antenna in the device's axes, forward-left-up, m."),
]
TruthMap = Annotated[
    str | None,
    typer.Option(
        metavar="NAME=WHERE,...",
        help="Where time, x, y, z (or latitude, longitude, height) and yaw or qx, qy, qz, qw of "
        "the truth are. An Odometry, PoseStamped or NavSatFix topic needs none.",
    ),
]
TruthOrigin = Annotated[
    str | None,
    typer.Option(
        metavar="LATITUDE,LONGITUDE,HEIGHT",
        help="Where on earth the origin of map is, for a truth in latitude and longitude.",
    ),
]
TruthUnits = Annotated[
    str,
    typer.Option(metavar="NAME=UNIT,...", help="Units of time, position and yaw of the truth."),
]
Offset = Annotated[
    str,
    typer.Option(
        metavar="SECONDS|auto", help="Seconds to add to the times of the truth; auto finds them."
    ),
]
Align = Annotated[
    str,
    typer.Option(
        metavar="none|shift|rigid",
        help="Move (shift), or turn and move (rigid), the truth onto the measurements; the "
        "figures say so.",
    ),
]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Parameter of the tracker, kept in the bag; may be repeated.",
    ),
]
AnyOrder = Annotated[
    bool, typer.Option("--any-order", help="Accept lines that are not in the order of time.")
]
Skip = Annotated[
    bool, typer.Option("--skip-bad-lines", help="Skip and count what cannot be understood.")
]


def import_csv(
    file: Annotated[
        Path,
        typer.Argument(
            help="Text file with columns between commas, tabs, semicolons or blanks; .gz too."
        ),
    ],
    bag: Bag,
    mapping: Map,
    units: Units = "",
    sd: Sd = "",
    rsus: Rsus = None,
    vue: Vue = "vue_1",
    device_height: Height = None,
    lever_arm: Lever = None,
    delimiter: Annotated[
        str | None, typer.Option(help="comma, tab, semicolon or blank. Default: detected.")
    ] = None,
    truth: Annotated[
        Path | None, typer.Option(help="Text file with the truth; TUM needs no --truth-map.")
    ] = None,
    truth_map: TruthMap = None,
    truth_units: TruthUnits = "",
    truth_time_offset: Offset = "0",
    truth_align: Align = "none",
    truth_origin: TruthOrigin = None,
    settings: Settings = None,
    skip_bad_lines: Skip = False,
    any_order: AnyOrder = False,
) -> None:
    """Ranges, angles, times or fixes of any text file.

    One measurement a line, or one column for each RSU.
    """
    from netpos.bags.importers.own.recording import import_csv as work  # noqa: PLC0415
    from netpos.bags.importers.own.records import DELIMITERS  # noqa: PLC0415

    refuse_existing(bag)
    if delimiter is not None and delimiter not in DELIMITERS:
        raise ValueError(f"--delimiter {delimiter}: give one of {', '.join(DELIMITERS)}")
    with doing("importing"):
        counts = work(
            file,
            bag,
            _columns(mapping, units, sd, vue, lever_arm),
            _rsus(rsus),
            truth=truth_option(
                truth,
                truth_map,
                truth_units,
                truth_time_offset,
                truth_align,
                device_height,
                truth_origin,
            ),
            delimiter=DELIMITERS[delimiter] if delimiter else None,
            skip_bad_lines=skip_bad_lines,
            any_order=any_order,
            tracker=_tracker(settings, device_height),
        )
    tell(bag, counts)


def import_ros(
    source: Annotated[
        Path, typer.Argument(help="ROS 1 .bag, or ROS 2 bag (folder, .mcap, .db3).")
    ],
    bag: Bag,
    topic: Annotated[str, typer.Option(help="Topic with the measurements.")],
    mapping: Map,
    units: Units = "",
    sd: Sd = "",
    rsus: Rsus = None,
    vue: Vue = "vue_1",
    device_height: Height = None,
    lever_arm: Lever = None,
    truth_topic: Annotated[str | None, typer.Option(help="Topic with the truth.")] = None,
    truth_map: TruthMap = None,
    truth_units: TruthUnits = "",
    truth_time_offset: Offset = "0",
    truth_align: Align = "none",
    truth_origin: TruthOrigin = None,
    settings: Settings = None,
    skip_bad_lines: Skip = False,
    any_order: AnyOrder = False,
) -> None:
    """Ranges, angles, times or fixes of a topic of any ROS 1 or ROS 2 bag.

    Fields are given by their path; the RSU's own position may be one of them.
    """
    from netpos.bags.importers.own.recording import import_ros as work  # noqa: PLC0415

    refuse_existing(bag)
    with doing("importing"):
        counts = work(
            source,
            bag,
            _columns(mapping, units, sd, vue, lever_arm),
            topic,
            _rsus(rsus),
            truth=truth_option(
                truth_topic,
                truth_map,
                truth_units,
                truth_time_offset,
                truth_align,
                device_height,
                truth_origin,
            ),
            skip_bad_messages=skip_bad_lines,
            any_order=any_order,
            tracker=_tracker(settings, device_height),
        )
    tell(bag, counts)


def three(text: str, option: str) -> tuple[float, float, float]:
    """Three numbers between commas; ValueError for anything else."""
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"{option} takes three numbers such as 0,0.05,0, got {text!r}") from None
    return x, y, z


def tell(bag: Path, counts: Mapping[str, int]) -> None:
    """Print what was written and skipped, and what to do next."""
    from netpos.bags import BagReader  # noqa: PLC0415
    from netpos.bags.recording import TRUTH_ALIGNMENT  # noqa: PLC0415

    for topic, count in sorted(counts.items()):
        typer.echo(f"  {topic}: {count}")
    with BagReader(bag) as written:
        aligned = written.metadata.get(TRUTH_ALIGNMENT)
    if aligned:
        typer.echo(aligned)
    typer.echo(f"wrote {bag}; track it with: netpos replay {bag} --out NEW_BAG")


def _columns(mapping: str, units: str, sd: str, vue: str, lever_arm: str | None) -> Columns:
    from netpos.bags.importers.own.columns import Columns  # noqa: PLC0415

    arm = (0.0, 0.0, 0.0) if lever_arm is None else three(lever_arm, "--lever-arm")
    return Columns.parse(mapping, units, sd, vue_id=vue, lever_arm_m=arm)


def _rsus(file: Path | None) -> list[RsuInfo]:
    from netpos.bags.importers.own.rsus import read_rsus  # noqa: PLC0415

    return [] if file is None else read_rsus(file)


def _tracker(settings: list[str] | None, height_m: float | None) -> dict[str, object]:
    from netpos.tracking.config import TrackerConfig  # noqa: PLC0415

    chosen: dict[str, object] = dict(parse_setting(text) for text in settings or [])
    if height_m is not None:
        chosen["device_height_m"] = height_m
    TrackerConfig.from_mapping(chosen)
    return chosen


def truth_option(
    source: Path | str | None,
    mapping: str | None,
    units: str,
    offset: str,
    way: str,
    height_m: float | None,
    origin: str | None = None,
) -> Truth | None:
    """The truth that the options describe; ``source``: a text file (Path) or a topic."""
    from netpos.bags.importers.own.alignment import Way  # noqa: PLC0415
    from netpos.bags.importers.own.recording import Truth  # noqa: PLC0415
    from netpos.bags.importers.own.truth import TUM, TruthColumns  # noqa: PLC0415

    if source is None:
        if mapping is not None or way != "none":
            raise ValueError("options of the ground truth need one: name its file or topic")
        return None
    if mapping is None:
        if isinstance(source, Path) and source.suffix not in {".tum", ".txt"}:
            raise ValueError("--truth-map must say where time, x and y of the truth are")
        columns = TruthColumns(sources=TUM) if isinstance(source, Path) else None
    else:
        columns = TruthColumns.parse(mapping, units)
    if way not in get_args(Way):
        raise ValueError(f"--truth-align {way}: give none, shift or rigid")
    try:
        offset_s = None if offset == "auto" else float(offset)
    except ValueError:
        raise ValueError(f"--truth-time-offset {offset}: give seconds or auto") from None
    return Truth(
        source=source,
        columns=columns,
        offset_s=offset_s,
        align=cast("Way", way),
        height_m=height_m or 0.0,
        origin=None if origin is None else three(origin, "--truth-origin"),
    )
