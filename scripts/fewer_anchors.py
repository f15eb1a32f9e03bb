"""Leave each anchor out of the UWB recordings in turn, thin them, and begin them later: ``python
scripts/fewer_anchors.py [--json FILE]``.

Nothing is tuned for these networks; without one of four anchors on a car the three that are left
may stand in one line, whose two sides nothing tells apart. Printed for each: the share of the
estimates that are TRACKING, their RMSE and largest error [m], their median level [m], how many
errors are above it, and the largest error over its level. The misses come first.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from netpos.evaluation.guarded_runs import Material, cases, outputs_of, thinned
from netpos.evaluation.pairing import Trajectory, pair
from netpos.messages.values import RsuMeasurement, TrackState

RECORDINGS = ("uwb_los", "uwb_nlos", "uwb_los_gap")
SHARES, BEGINNINGS, SEED = (0.5, 0.8), (0.1, 0.25, 0.4, 0.55, 0.7), 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """How a part of a recording was tracked; None where nothing was TRACKING."""

    recording: str
    part: str
    estimates: int
    tracking: float
    rmse_m: float | None = None
    largest_m: float | None = None
    level_m: float | None = None
    exceeded: int = 0
    worst_ratio: float | None = None


def parts(material: Material) -> Iterator[tuple[str, Material]]:
    """The recording, and what is left of it."""
    yield "whole", material
    measured = [item for item in material.items if isinstance(item, RsuMeasurement)]
    for name in sorted({item.rsu_id for item in measured}):
        left_out = {id(item) for item in measured if item.rsu_id == name}
        kept = [item for item in material.items if id(item) not in left_out]
        yield f"without {name}", replace(material, items=kept)
    for share in SHARES:
        yield f"without {share:.0%} of all ranges", thinned(material, share, SEED)
    first, last = material.items[0].stamp_ns, material.items[-1].stamp_ns
    for share in BEGINNINGS:
        begin_ns = first + round(share * (last - first))
        kept = [item for item in material.items if item.stamp_ns > begin_ns]
        yield f"from {share:.0%} on", replace(material, items=kept)


def row_of(recording: str, part: str, material: Material) -> Row:
    """Track a part, and score what is TRACKING."""
    outputs = [o for o in outputs_of(material) if o.odometry is not None]
    (truth,) = material.truth.values()
    pairs = pair(Trajectory.of(o.odometry for o in outputs if o.odometry), Trajectory.of(truth))
    statuses = {o.status.stamp_ns: o.status for o in outputs}
    known = [statuses[stamp] for stamp in pairs.estimate.stamp_ns.tolist()]
    tracking = np.array([status.state is TrackState.TRACKING for status in known])
    share = float(tracking.mean()) if tracking.size else 0.0
    row = Row(recording=recording, part=part, estimates=len(known), tracking=share)
    if not tracking.any():
        return row
    error = pairs.horizontal_error[tracking]
    level = np.array([status.protection_level_m for status in known])[tracking]
    return replace(
        row,
        rmse_m=float(np.sqrt(np.mean(error**2))),
        largest_m=float(error.max()),
        level_m=float(np.median(level)),
        exceeded=int((error > level).sum()),
        worst_ratio=float((error / level).max()),
    )


def main() -> None:
    """Print a line for each part, the misses first."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows = []
    for name in RECORDINGS:
        case = cases()[name]
        if case.missing:
            raise SystemExit(case.missing)
        (material,) = case.materials()
        rows += [row_of(name, part, left) for part, left in parts(material)]
    rows.sort(key=lambda row: -row.exceeded)
    for row in rows:
        text = f"{row.recording:12} {row.part:28} {row.estimates:5d} TRACKING {row.tracking:6.1%}"
        if row.rmse_m is not None:
            text += (
                f"  RMSE {row.rmse_m:6.2f} largest {row.largest_m:6.2f} level {row.level_m:6.2f}"
                f"  above it {row.exceeded:5d}, at most {row.worst_ratio:.2f} times"
            )
        print(text)
    if args.json is not None:
        args.json.write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n")


if __name__ == "__main__":
    main()
