"""Leave each RSU out of the recordings in turn, and two of four; thin them, begin them later, and
run them backwards: ``python scripts/fewer_rsus.py [RECORDING…] [--parts KIND…] [--workers N]
[--json FILE]``.

Nothing is tuned for these networks; without one of four anchors on a car the three that are left
may stand in one line, whose two sides nothing tells apart, and two anchors have two sides always.
A recording that runs backwards is another one: other beginnings, other ends of each silence, other
errors to be learned before others. Printed for each part, of all kinds or of the ``--parts``
chosen: the share of the estimates that are TRACKING, how often the state changes, their RMSE and
largest error [m], their median level [m], how many errors are above it, the largest error over its
level, and the RMSE [m] of the plain Kalman filter at the same stamps from the same measurements.
The misses come first. The file has the parts of each recording together, and one by one.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from netpos.evaluation.guarded_runs import Material, material_of, outputs_of, thinned
from netpos.evaluation.pairing import Trajectory, pair
from netpos.evaluation.recordings import Recording
from netpos.evaluation.yardsticks import Observations, observations_of_bag, plain_ekf
from netpos.messages.values import RsuMeasurement, TrackState
from real_data import DATA, Source, sources

SHARES, BEGINNINGS, SEED = (0.5, 0.8), (0.1, 0.25, 0.4, 0.55, 0.7), 1
BACKWARDS = (0.0, 0.35, 0.7)  # how much of it is left out
HALVED = 4  # RSUs of a network of which two are left out
KINDS = ("whole", "without", "from", "two", "backwards")


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """How a part of a recording was tracked; None where nothing was TRACKING."""

    recording: str
    part: str
    estimates: int
    tracking: float
    changes: int = 0
    rmse_m: float | None = None
    largest_m: float | None = None
    level_m: float | None = None
    exceeded: int = 0
    worst_ratio: float | None = None
    plain_m: float | None = None


def without(material: Material, left_out: Collection[str]) -> Material:
    """The same without what some RSUs measured, or measured against."""
    kept = [
        item
        for item in material.items
        if not isinstance(item, RsuMeasurement)
        or (item.rsu_id not in left_out and item.reference_rsu_id not in left_out)
    ]
    return replace(material, items=kept)


def later(material: Material, share: float) -> Material:
    """The same from ``share`` of its time on."""
    first, last = material.items[0].stamp_ns, material.items[-1].stamp_ns
    begin_ns = first + round(share * (last - first))
    return replace(material, items=[item for item in material.items if item.stamp_ns > begin_ns])


class Part(NamedTuple):
    """What is left of a recording, and the measurements of all of it as the plain filter takes
    them."""

    name: str
    material: Material
    everything: Observations


def backwards(material: Material, everything: Observations) -> tuple[Material, Observations]:
    """What the RSUs measured, and the truth, from the last to the first, stamped as from the first
    to the last."""
    measured = [item for item in material.items if isinstance(item, RsuMeasurement)]
    both_ns = measured[0].stamp_ns + measured[-1].stamp_ns
    truth = {
        vue: [replace(odometry, stamp_ns=both_ns - odometry.stamp_ns) for odometry in way[::-1]]
        for vue, way in material.truth.items()
    }
    items = [replace(item, stamp_ns=both_ns - item.stamp_ns) for item in measured[::-1]]
    columns = {f.name: getattr(everything, f.name)[::-1] for f in fields(everything)}
    columns["stamp_ns"] = both_ns - columns["stamp_ns"]
    return replace(material, items=items, truth=truth), Observations(**columns)


def parts(material: Material, everything: Observations) -> Iterator[Part]:
    """The recording, and what is left of it; each name begins with one of ``KINDS``."""

    def part(name: str, left: Material) -> Part:
        return Part(name, left, everything)

    yield part("whole", material)
    measured = [item for item in material.items if isinstance(item, RsuMeasurement)]
    heard = {item.rsu_id for item in measured} | {item.reference_rsu_id for item in measured}
    names = sorted(heard - {""})
    for name in names:
        yield part(f"without {name}", without(material, [name]))
    for share in SHARES:
        yield part(f"without {share:.0%} of all", thinned(material, share, SEED))
    for share in BEGINNINGS:
        yield part(f"from {share:.0%} on", later(material, share))
    for two in combinations(names, 2) if len(names) == HALVED else ():
        yield part(f"two, without {' and '.join(two)}", without(material, two))
    turned, turned_round = backwards(material, everything)
    for share in BACKWARDS:
        begun = f" from {share:.0%} on" if share else ""
        left = later(turned, share) if share else turned
        yield Part(f"backwards{begun}", left, turned_round)


def seen_of(everything: Observations, material: Material) -> Observations:
    """What the plain filter is given: the measurements of ``material``."""
    at = {info.rsu_id: tuple(info.position) for info in material.rsus}
    kept = {(m.stamp_ns, at[m.rsu_id]) for m in material.items if isinstance(m, RsuMeasurement)}
    stamps, places = everything.stamp_ns.tolist(), map(tuple, everything.rsu.tolist())
    return everything.take(np.array([key in kept for key in zip(stamps, places, strict=True)]))


def row_of(recording: Recording, part: str, material: Material, seen: Observations) -> Row:
    """Track a part, and score what is TRACKING."""
    outputs = [o for o in outputs_of(material) if o.odometry is not None]
    truth = Trajectory.of(next(iter(material.truth.values())))
    states = [o.status.state for o in outputs]
    changes = sum(a is not b for a, b in pairwise(states))
    row = Row(
        recording=recording.name,
        part=part,
        estimates=len(outputs),
        tracking=0.0,
        changes=changes,
    )
    tracked = [o for o in outputs if o.status.state is TrackState.TRACKING]
    if not tracked:
        return row
    pairs = pair(Trajectory.of(o.odometry for o in tracked if o.odometry), truth)
    levels = {o.status.stamp_ns: o.status.protection_level_m for o in tracked}
    error = pairs.horizontal_error
    level = np.array([levels[stamp] for stamp in pairs.estimate.stamp_ns.tolist()])
    plain = plain_ekf(seen, recording.space).estimate
    plain = plain.take(np.isin(plain.stamp_ns, pairs.estimate.stamp_ns))
    plain_error = pair(plain, truth).horizontal_error
    return replace(
        row,
        tracking=len(tracked) / len(outputs),
        rmse_m=float(np.sqrt(np.mean(error**2))),
        largest_m=float(error.max()),
        level_m=float(np.median(level)),
        exceeded=int((error > level).sum()),
        worst_ratio=float((error / level).max()),
        plain_m=float(np.sqrt(np.mean(plain_error**2))) if plain_error.size else None,
    )


def rows_of(source: Source, chosen: Sequence[str]) -> list[Row]:
    """The parts of a recording whose names begin with one of the ``chosen`` words."""
    recorded, path, load, used = source
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "bag"
        load(path, bag)
        recording = Recording(name=recorded, bag=bag, **used)
        material = material_of(bag)
        everything = observations_of_bag(bag, range_sd_m=recording.range_sd_m)
        found = [
            row_of(recording, name, left, seen_of(seen, left))
            for name, left, seen in parts(material, everything)
            if name.startswith(tuple(chosen))
        ]
    sys.stderr.write(f"{recorded}: {len(found)} parts\n")
    return found


def text_of(row: Row) -> str:
    """A line of the table."""
    text = f"{row.recording:32} {row.part:20} {row.estimates:6d} TRACKING {row.tracking:6.1%}"
    text += f", {row.changes} changes"
    if row.rmse_m is None:
        return text
    text += (
        f"  RMSE {row.rmse_m:6.3f} largest {row.largest_m:6.2f} level {row.level_m:6.2f}"
        f"  above it {row.exceeded:5d}, at most {row.worst_ratio:.2f} times"
    )
    return text if row.plain_m is None else f"{text}  plain {row.plain_m:.3f}"


def summary_of(recording: str, rows: list[Row]) -> dict[str, Any]:
    """Of all parts of a recording together; ``over_plain``: the RMSE of each over that of the
    plain filter."""
    scored = round(sum(row.tracking * row.estimates for row in rows))
    above = sum(row.exceeded for row in rows)
    ratios = [row.rmse_m / row.plain_m for row in rows if row.rmse_m and row.plain_m]
    return {
        "name": recording,
        "networks": len(rows),
        "networks_above": sum(row.exceeded > 0 for row in rows),
        "errors_above": f"{above:,} of {scored:,}",
        "largest_over_level": max(row.worst_ratio or 0.0 for row in rows),
        "worse_than_plain": sum(ratio > 1.0 for ratio in ratios),
        "over_plain": float(np.median(ratios)) if ratios else None,
        "parts": [asdict(row) for row in rows],
    }


def main() -> None:
    """Print a line for each part, the misses first."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("recordings", nargs="*", metavar="RECORDING")
    parser.add_argument("--parts", nargs="+", default=KINDS, choices=KINDS)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    # The stations of the car's drive are simulated.
    real = [source for source in sources(DATA) if "simulated" not in source[0]]
    chosen = [
        s for s in real if s[1].exists() and (not args.recordings or s[0] in args.recordings)
    ]
    if not chosen:
        raise SystemExit(f"none of these recordings lies in {DATA}; set NETPOS_DATA")
    with ProcessPoolExecutor(args.workers) as pool:
        rows = [
            row for found in pool.map(partial(rows_of, chosen=args.parts), chosen) for row in found
        ]
    rows.sort(key=lambda row: -row.exceeded)
    for row in rows:
        print(text_of(row))
    if args.json is not None:
        names = dict.fromkeys(row.recording for row in rows)
        found = [
            summary_of(name, [row for row in rows if row.recording == name]) for name in names
        ]
        args.json.write_text(json.dumps({"rows": found}, indent=1) + "\n")


if __name__ == "__main__":
    main()
