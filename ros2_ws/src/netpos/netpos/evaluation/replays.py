"""Replay several bags, each with a tracker of its own."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from netpos.bags import BagReader
from netpos.evaluation.work import Work
from netpos.messages import topics
from netpos.scenario.replay import ReplaySummary, changed, replay_bag
from netpos.scenario.settings import TrackerSettings, bag_settings, tracker_fact
from netpos.tracking.config import TrackerConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class Replays:
    """Where the new bags go, under the names of the old ones, and how they are tracked: with
    ``settings``, by default those each bag holds, then ``overrides``."""

    out: Path
    settings: TrackerSettings | None = None
    overrides: Mapping[str, Any] = field(default_factory=dict)
    smooth: bool = False

    def target(self, bag: Path) -> Path:
        """Where a bag's track goes."""
        path = bag.resolve()
        return self.out / (path.stem if path.suffix == ".mcap" else path.name)


def replay_bags(
    bags: Sequence[Path], plan: Replays, work: Work
) -> Iterator[tuple[Path, ReplaySummary | str]]:
    """Track each bag; of one that cannot be tracked the reason. Those that are in ``plan.out``
    already, tracked with the same parameters, are left out: an interrupted run goes on.

    Raises
    ------
    ValueError  two bags of one name
    FileExistsError  what lies where a track would go is something else
    """
    names = Counter(plan.target(bag).name for bag in bags)
    for name, count in names.items():
        if count > 1:
            raise ValueError(f"{count} bags are called {name}; their tracks need a folder each")
    left = [(bag,) for bag in bags if not _is_done(bag, plan)]
    plan.out.mkdir(parents=True, exist_ok=True)
    results = work.over("bags", _replay, plan, left)
    yield from zip((bag for (bag,) in left), results, strict=True)


def _replay(plan: Replays, part: tuple[Path]) -> ReplaySummary | str:
    (bag,) = part
    try:
        return replay_bag(
            bag, plan.target(bag), plan.overrides, smooth=plan.smooth, settings=plan.settings
        )
    except ValueError as error:
        return str(error)


def _is_done(bag: Path, plan: Replays) -> bool:
    target = plan.target(bag)
    if not target.exists():
        return False
    with BagReader(bag) as source, BagReader(target) as replayed:
        settings = changed(plan.settings or bag_settings(source), plan.overrides)
        config = TrackerConfig.from_mapping(settings.parameters)
        wanted = tracker_fact(config, settings.rsus)
        smoothed = any(topics.split(t)[1] == topics.ODOMETRY_SMOOTHED for t in replayed.topics)
        if wanted.items() <= replayed.metadata.items() and smoothed == plan.smooth:
            return True
    raise FileExistsError(
        f"{target} exists and was tracked with other parameters; choose another --out"
    )
