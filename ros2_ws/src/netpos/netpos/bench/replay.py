"""Offline replay of a METIS bag against real time and against merely reading and decoding it."""

from __future__ import annotations

import math
import shutil
import tempfile
import time
from pathlib import Path

from rosbags.rosbag2 import Reader

from netpos.bags import BagReader, codec, typestore
from netpos.bench.common import Result, faster, side_by_side, within
from netpos.messages import topics
from netpos.scenario.replay import reading_of, replay_bag
from netpos.scenario.settings import bag_settings
from netpos.tracking import Tracker, TrackerConfig

_REAL_TIME, _ROSBAGS = 300.0, 2.0


def _simulate(bag: Path, quick: bool) -> None:
    from netpos.scenario import load_scenario  # noqa: PLC0415 - only this row simulates
    from netpos.scenario.offline import simulate_to_bag  # noqa: PLC0415

    simulate_to_bag(load_scenario("fast_pass" if quick else "metis_madrid"), bag)


def read_and_track(path: Path) -> int:
    """Read the bag's RSU messages and track; returns the number of estimates."""
    with BagReader(path) as bag:
        config = TrackerConfig.from_mapping(bag_settings(bag).parameters)
        tracker, estimates = Tracker(config), 0
        for entry in bag.messages([topics.RSU_INFO]):
            tracker.add_rsu(codec().rsu_info_from_msg(entry.message))
        read = {t: reading_of(t, info, config) for t, info in bag.topics.items()}
        consumed = {t: item_of for t, item_of in read.items() if item_of is not None}
        for entry in bag.messages(consumed):
            tracker.add(consumed[entry.topic](entry))
            estimates += len(tracker.process())
        return estimates + len(tracker.flush())


def consumed_topics(path: Path) -> set[str]:
    """The topics that ``read_and_track`` reads."""
    with BagReader(path) as bag:
        config = TrackerConfig.from_mapping(bag_settings(bag).parameters)
        consumed = {t for t, info in bag.topics.items() if reading_of(t, info, config) is not None}
        return {*consumed, topics.RSU_INFO}


def read_and_decode(path: Path, wanted: set[str]) -> int:
    """What rosbags alone needs for the messages of ``wanted`` topics: read them and make them
    objects; returns their number."""
    store, count = typestore(), 0
    with Reader(path) as reader:
        connections = [c for c in reader.connections if c.topic in wanted]
        for connection, _, cdr in reader.messages(connections):
            store.deserialize_cdr(cdr, connection.msgtype)
            count += 1
    return count


def _rewrite(source: Path, folder: Path, rounds: int) -> float:
    """Seconds of a whole replay, with the bag it writes; the best of ``rounds``."""
    best = math.inf
    for _ in range(rounds):
        start = time.perf_counter()
        replay_bag(source, folder / "out")
        best = min(best, time.perf_counter() - start)
        shutil.rmtree(folder / "out")
    return best


def replay_rows(quick: bool) -> list[Result]:
    """Replay of a METIS run (quick: a short one) with and without the bag it writes."""
    with tempfile.TemporaryDirectory() as name:
        source = Path(name) / "in"
        _simulate(source, quick)
        with BagReader(source) as bag:
            lasted_s = (bag.end_ns - bag.start_ns) * 1e-9
            total = sum(info.count for info in bag.topics.values())
        wanted = consumed_topics(source)
        decoded = read_and_decode(source, wanted)
        cost = side_by_side(
            {
                "track": (lambda: read_and_track(source), 1),
                "decode": (lambda: read_and_decode(source, wanted), 1),
            },
            2 if quick else 7,
        )
        whole = _rewrite(source, Path(name), 1 if quick else 7)
    track, decode = cost["track"], cost["decode"]
    what = "offline replay of a METIS bag" if not quick else "offline replay of a short bag"
    return [
        faster(
            f"{what}, read + track + write",
            whole,
            "real time",
            lasted_s,
            _REAL_TIME,
            f"Copies all {total} messages of the bag and adds the estimates; "
            f"{whole / decode:.1f}x rosbags' reading and decoding of the {decoded} it consumes.",
        ),
        faster(f"{what}, read + track", track, "real time", lasted_s, _REAL_TIME),
        within(
            f"{what}, read + track",
            track,
            "rosbags reads and decodes the same messages",
            decode,
            _ROSBAGS,
            note=f"Both: open the bag, take the {decoded} messages the tracker consumes. "
            "Neither writes.",
        ),
    ]
