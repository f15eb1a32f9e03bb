"""Cut silences out of the UWB recordings and see how the track comes back: ``python
scripts/silences.py [--cuts N] [--seed N] [--lengths 2,5,10] [--json FILE]``.

Each of ``N`` cuts a recording (default 15) has a random beginning and 1 to 60 s, or one of the
``--lengths``; the tracker gets nothing in between and 25 s after it. Printed: the cuts that come
back badly, then all together. A level that is never exceeded may be so because it is large
everywhere: its mean is printed, too.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from netpos.evaluation.guarded_runs import Material, cases, outputs_of
from netpos.evaluation.pairing import Trajectory, pair
from netpos.messages.values import TrackState

NS = 1_000_000_000
RECORDINGS = ("uwb_los", "uwb_nlos", "uwb_los_gap")
SEED = 5
LEAD_S = 20.0  # before a cut
AFTER_S = 25.0  # what is heard after it
JUDGED_S = (5.0, 20.0)
READY_S, RMSE_M = 3.0, 2.0  # a cut comes back badly beyond these


@dataclass(frozen=True, slots=True, kw_only=True)
class Cut:
    """How a track came back from one silence: seconds until TRACKING and RMSE [m] 5 to 20 s after
    it (None where there is none), TRACKING estimates, those above their protection level, and of
    them the largest error [m] and the mean level [m]."""

    recording: str
    begin_s: float
    silence_s: float
    ready_s: float | None
    rmse_m: float | None
    tracking: int
    exceeded: int
    largest_m: float
    level_m: float

    @property
    def bad(self) -> bool:
        """Late, far off, or TRACKING with an error above the level."""
        late = self.ready_s is None or self.ready_s > READY_S
        far = self.rmse_m is not None and self.rmse_m > RMSE_M
        return late or far or self.exceeded > 0


def cut(material: Material, name: str, begin_s: float, silence_s: float) -> Cut:
    """Leave ``silence_s`` out of a recording ``begin_s`` after its first measurement."""
    first = material.items[0].stamp_ns
    begin_ns = first + round(begin_s * NS)
    end_ns = begin_ns + round(silence_s * NS)
    last_ns = end_ns + round(AFTER_S * NS)
    kept = [m for m in material.items if not begin_ns <= m.stamp_ns < end_ns]
    heard = replace(material, items=[m for m in kept if m.stamp_ns <= last_ns])
    outputs = [o for o in outputs_of(heard) if o.odometry is not None]
    after = [o for o in outputs if o.status.stamp_ns >= end_ns]
    (truth,) = material.truth.values()
    pairs = pair(Trajectory.of(o.odometry for o in after if o.odometry), Trajectory.of(truth))
    error = dict(zip(pairs.estimate.stamp_ns.tolist(), pairs.horizontal_error, strict=True))
    tracking = [
        o.status
        for o in after
        if o.status.state is TrackState.TRACKING and o.status.stamp_ns in error
    ]
    since = {stamp: (stamp - end_ns) / NS for stamp in error}
    judged = [error[stamp] for stamp, s in since.items() if JUDGED_S[0] <= s <= JUDGED_S[1]]
    return Cut(
        recording=name,
        begin_s=round(begin_s, 1),
        silence_s=round(silence_s, 1),
        ready_s=(tracking[0].stamp_ns - end_ns) / NS if tracking else None,
        rmse_m=math.sqrt(float(np.mean(np.square(judged)))) if judged else None,
        tracking=len(tracking),
        exceeded=sum(bool(error[s.stamp_ns] > s.protection_level_m) for s in tracking),
        largest_m=max((float(error[s.stamp_ns]) for s in tracking), default=0.0),
        level_m=float(np.mean([s.protection_level_m for s in tracking])) if tracking else 0.0,
    )


def cuts_of(count: int, seed: int, lengths: list[float]) -> Iterator[Cut]:
    """``count`` random cuts of each recording, of the ``lengths`` [s] in turn where there are
    any."""
    rng, known = np.random.default_rng(seed), cases()
    for name in RECORDINGS:
        case = known[name]
        if case.missing:
            raise SystemExit(case.missing)
        (material,) = case.materials()
        lasted_s = (material.items[-1].stamp_ns - material.items[0].stamp_ns) / NS
        for k in range(count):
            silence_s = lengths[k % len(lengths)] if lengths else float(rng.uniform(1.0, 60.0))
            begin_s = float(rng.uniform(LEAD_S, lasted_s - silence_s - AFTER_S))
            yield cut(material, name, begin_s, silence_s)


def main() -> None:
    """Print the cuts and write them where asked to."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cuts", type=int, default=15, help="cuts of each recording")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--lengths", default="", help="of the silences [s], by commas")
    parser.add_argument("--json", type=Path, help="write all cuts there")
    arguments = parser.parse_args()
    lengths = [float(text) for text in arguments.lengths.split(",") if text]
    found = list(cuts_of(arguments.cuts, arguments.seed, lengths))
    for one in found:
        if one.bad:
            print(one)
    errors = [one.rmse_m for one in found if one.rmse_m is not None]
    count = sum(one.tracking for one in found)
    level_m = sum(one.tracking * one.level_m for one in found) / max(count, 1)
    print(
        f"{len(found)} cuts, {sum(one.bad for one in found)} bad; RMSE {JUDGED_S[0]:g} to"
        f" {JUDGED_S[1]:g} s after: median {np.median(errors):.2f}, largest {max(errors):.2f} m;"
        f" TRACKING above the level {sum(one.exceeded for one in found)} of"
        f" {count}, their mean level {level_m:.1f} m; largest error while TRACKING"
        f" {max(one.largest_m for one in found):.1f} m"
    )
    if arguments.json is not None:
        arguments.json.write_text(json.dumps([asdict(one) for one in found], indent=2) + "\n")


if __name__ == "__main__":
    main()
