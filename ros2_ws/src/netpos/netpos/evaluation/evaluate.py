"""Score a recording: every device that has ground truth, in one pass over the bag."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from netpos.bags import BagReader
from netpos.evaluation.contents import Contents, Delivery, Progress, Recording, contents_of
from netpos.evaluation.metrics import SKIP_EPOCHS, Figures, Run, Scored, score
from netpos.evaluation.pairing import Poses, at_stamps
from netpos.evaluation.recorded_bound import recorded_bound_m
from netpos.evaluation.requirements import Verdict, judge
from netpos.evaluation.residuals import Series, series_of
from netpos.evaluation.survey import Survey, VueRecord, survey_vue
from netpos.evaluation.truth_time import TimeOffset, time_offset
from netpos.messages import topics
from netpos.messages.values import (
    Array,
    Odometry,
    RsuInfo,
    RsuMeasurement,
)
from netpos.tracking.config import TrackerConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class VueEvaluation:
    """One device: its run, the scored pairs with their figures, the verdicts, what was
    delivered, and, where asked for, what each RSU measured minus what it should have, and how much
    later the ground truth would have to be.
    """

    run: Run
    scored: Scored
    verdicts: tuple[Verdict, ...]
    delivery: Delivery
    series: tuple[Series, ...] = ()
    truth_time: TimeOffset | None = None

    @property
    def figures(self) -> Figures:
        """Errors, availability and consistency of the device; ``None`` where they cannot be
        computed."""
        return self.scored.figures


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluation:
    """Result of ``evaluate_bag``. ``networks``: of several networks, how each alone did, by
    network and device, under the devices' true names only. ``topics``: type and number of
    messages; ``notes``: what the importer did to the data, to be read before the figures;
    ``buildings``: (k, 4) rectangles x_min, y_min, x_max, y_max [m], none where the bag
    does not hold its scenario; ``facts``: how the bag was made."""

    path: Path
    skip: int
    vues: Mapping[str, VueEvaluation]
    networks: Mapping[str, Mapping[str, Scored]]
    rsus: tuple[RsuInfo, ...]
    buildings: Array
    topics: Mapping[str, tuple[str, int]]
    notes: tuple[str, ...] = ()
    facts: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def columns(self) -> dict[str, Figures]:
        """Figures by the name of their column in a table: devices, then devices by network."""
        fused = {name: vue.figures for name, vue in self.vues.items()}
        return fused | {
            f"{vue} by {network}": scored.figures
            for network, vues in self.networks.items()
            for vue, scored in vues.items()
        }

    def to_json(self) -> dict[str, Any]:
        """Plain types in the form of ``netpos evaluate --json``."""
        return {
            "bag": self.path.name,
            "skip": self.skip,
            "notes": list(self.notes),
            "vues": {name: vue.scored.figures.to_json() for name, vue in self.vues.items()},
            "networks": {
                network: {name: scored.figures.to_json() for name, scored in vues.items()}
                for network, vues in self.networks.items()
            },
            "requirements": {
                name: {verdict.name: verdict.to_json() for verdict in vue.verdicts}
                for name, vue in self.vues.items()
            },
            "delivery": {name: asdict(vue.delivery) for name, vue in self.vues.items()},
            "truth_time": {
                name: asdict(vue.truth_time) for name, vue in self.vues.items() if vue.truth_time
            },
            "topics": {
                topic: {"type": type_name, "messages": count}
                for topic, (type_name, count) in sorted(self.topics.items())
            },
        }


def _chosen(bag: BagReader, path: Path, vue: str | None) -> list[str]:
    """Devices to score; an error names what the bag lacks."""
    filled = {topics.split(topic) for topic, info in bag.topics.items() if info.count}
    with_truth = {name for name, topic in filled if topic == topics.GROUND_TRUTH}
    if not with_truth:
        raise ValueError(
            f"{path} is a bag without ground truth (no messages on /<vue>/ground_truth); "
            "record that topic to evaluate the run"
        )
    if vue is not None and vue not in with_truth:
        raise ValueError(
            f"{path} has no ground truth of {vue!r}; choose one of {', '.join(sorted(with_truth))}"
        )
    names = sorted(with_truth) if vue is None else [vue]
    if not any((name, topics.ODOMETRY) in filled for name in names):
        raise ValueError(
            f"{path} has no estimates (no messages on /<vue>/odometry); "
            f"make some with: netpos replay {path} --out NEW_BAG"
        )
    return names


def _with_bound(
    scored: Scored, recording: Recording, vue: str, config: TrackerConfig | None
) -> Scored:
    """The figures with the error over its bound, of a run that starts from one pose or none."""
    poses, rmse = recording.poses[vue], scored.figures.rmse_m
    if config is None or len(poses) > 1 or rmse is None:
        return scored
    bound = recorded_bound_m(
        recording.measured[vue],
        recording.rsus,
        poses[0] if poses else None,
        recording.truth[vue].trajectory(),
        config,
        scored.counted.estimate.stamp_ns,
    )
    if not bound:
        return scored
    return replace(scored, figures=replace(scored.figures, bound_ratio=rmse / bound))


def _surveyed(bag: BagReader, path: Path, vue: str | None) -> list[str]:
    """Devices that a tracker reported of; an error names what the bag lacks."""
    filled = {topics.split(topic) for topic, info in bag.topics.items() if info.count}
    tracked = {name for name, topic in filled if name and topic in topics.TRACKER_OUTPUTS}
    if not tracked:
        raise ValueError(
            f"{path} has no estimates (no messages on /<vue>/odometry or track_status); "
            f"make some with: netpos replay {path} --out NEW_BAG"
        )
    if vue is not None and vue not in tracked:
        raise ValueError(
            f"{path} has no device {vue!r}; choose one of {', '.join(sorted(tracked))}"
        )
    return sorted(tracked) if vue is None else [vue]


def assess_bag(
    path: os.PathLike[str] | str,
    *,
    skip: int = SKIP_EPOCHS,
    vue: str | None = None,
    truth: TruthOf | None = None,
    residuals: bool = False,
    progress: Progress | None = None,
) -> Evaluation | Survey:
    """Score a bag that a tracker has tracked.

    With ground truth every device gets its errors and verdicts (``Evaluation``), without it what
    the recording says of itself (``Survey``).

    Parameters
    ----------
    path : the bag, as a path or a recording
    skip : number of first estimates of each device that do not count
    vue : score this device only
    truth : ground truth from elsewhere, for one device
    residuals : also give what each RSU measured minus what it should have
    progress : called with the number of messages read

    Raises
    ------
    ValueError  not a readable bag, no estimates, no such device, or no device has more estimates
        than are skipped
    """
    path = Path(path)
    if truth is None and not _has_truth(path):
        return survey_bag(path, vue=vue, progress=progress)
    return evaluate_bag(
        path,
        skip=skip,
        vue=vue,
        truth=truth,
        residuals=residuals,
        truth_time=True,
        progress=progress,
    )


def _has_truth(path: Path) -> bool:
    with BagReader(path) as bag:
        return any(
            info.count and topics.split(topic)[1] == topics.GROUND_TRUTH
            for topic, info in bag.topics.items()
        )


def survey_bag(path: Path, *, vue: str | None = None, progress: Progress | None = None) -> Survey:
    """What a bag says of every device that a tracker reported of, or only of ``vue``, without
    ground truth.

    Raises
    ------
    ValueError  not a readable bag, no tracker's output, or no such device
    """
    held = contents_of(path, lambda bag: _surveyed(bag, path, vue), progress)
    recording, vues = held.recording, {}
    for name in held.names:
        record = VueRecord(
            track=recording.estimate[name].trajectory(),
            statuses=recording.status[name].kept,
            clock=recording.clock[name].offsets(),
            measurements=list(recording.measured[name]),
            errors=recording.errors[name],
        )
        learns = held.config is not None and held.config.learn_errors
        vues[name] = survey_vue(record, recording.rsus, learns)
    return Survey(
        path=path,
        vues=vues,
        rsus=held.rsus,
        buildings=held.buildings,
        topics=held.topics,
        notes=held.notes,
        facts=held.facts,
    )


TruthOf = Callable[[list[RsuInfo], list[RsuMeasurement], str], tuple[list[Odometry], str]]
"""Ground truth from elsewhere: of RSUs, measurements and a device's name, poses and a sentence."""


def _alone(bag: BagReader, path: Path, vue: str | None) -> list[str]:
    """The one device with estimates, for a truth from elsewhere."""
    filled = {topics.split(topic) for topic, info in bag.topics.items() if info.count}
    tracked = sorted(name for name, topic in filled if name and topic == topics.ODOMETRY)
    if vue is not None and vue in tracked:
        return [vue]
    if vue is not None or len(tracked) != 1:
        raise ValueError(
            f"{path} has estimates of {', '.join(tracked) or 'no device'}; choose with --vue the "
            "device of the ground truth"
        )
    return tracked


def evaluate_bag(
    path: Path,
    *,
    skip: int = SKIP_EPOCHS,
    vue: str | None = None,
    truth: TruthOf | None = None,
    residuals: bool = False,
    truth_time: bool = False,
    progress: Progress | None = None,
) -> Evaluation:
    """Score every device of a bag that has ground truth, or only ``vue``; with ``truth`` one
    device against that.

    The first ``skip`` estimates of each device do not count (fokin2020 leaves out 20).
    ``residuals``: with what each RSU measured against the truth. ``truth_time``: with the time
    offset of the truth, by what RSUs measured (``truth_time.time_offset``); a note says it where
    it matters. ``progress`` is called with the number of messages read.

    Raises
    ------
    ValueError  not a readable bag, no ground truth, no estimates, no such device, or no device has
                more estimates than are skipped
    """
    choose = _chosen if truth is None else _alone
    held = contents_of(path, lambda bag: choose(bag, path, vue), progress)
    recording, notes = held.recording, held.notes
    if truth is not None:
        (name,) = held.names
        poses, sentence = truth(list(held.rsus), list(recording.measured[name]), name)
        recording.truth[name] = Poses()  # one that the bag holds does not count beside it
        for pose in poses:
            recording.truth[name].append(pose)
        notes = (sentence, *notes)
    _check_skip(held, path, skip)
    networks: dict[str, dict[str, Scored]] = {}
    for network, name in held.networks:
        scored = score(recording.run(name, network), skip=skip)
        networks.setdefault(network, {})[name] = scored
    vues = {
        name: _evaluated(held, path, name, skip, residuals=residuals, truth_time=truth_time)
        for name in held.names
    }
    covered = [text for name, vue in vues.items() for text in _covered(name, vue.scored.figures)]
    late = [
        vue.truth_time.sentence(name, path if truth is None else None)
        for name, vue in vues.items()
        if vue.truth_time is not None and vue.truth_time.matters
    ]
    return Evaluation(
        path=path,
        skip=skip,
        vues=vues,
        networks=networks,
        rsus=held.rsus,
        buildings=held.buildings,
        topics=held.topics,
        notes=(*notes, *covered, *late),
        facts=held.facts,
    )


def _evaluated(
    held: Contents, path: Path, name: str, skip: int, *, residuals: bool, truth_time: bool
) -> VueEvaluation:
    """One device against its truth; what the recording holds of it is not needed after."""
    recording = held.recording
    run = recording.run(name)
    if not len(run.truth):
        raise ValueError(f"{path}: no message on /{name}/ground_truth has finite values")
    scored = _with_bound(score(run, skip=skip), recording, name, held.config)
    series: list[Series] = []
    if residuals:
        clock = run.clock_truth if run.clock_truth.stamp_ns.size else run.clock
        stamps = run.estimate.stamp_ns
        there = at_stamps(run.truth, stamps)
        series = series_of(recording.measured[name], recording.rsus, there, clock.at(stamps))
    offset = None
    if truth_time:
        offset = time_offset(list(recording.measured[name]), recording.rsus, run.truth)
    _, beacons = held.topics.get(topics.of_vue(name, topics.BEACON), ("", None))
    delivery = recording.delivery[name].result(beacons)
    recording.forget(name)
    return VueEvaluation(
        run=run,
        scored=scored,
        verdicts=judge(scored.figures, scored.counted.horizontal_error),
        delivery=delivery,
        series=tuple(series),
        truth_time=offset,
    )


def _check_skip(held: Contents, path: Path, skip: int) -> None:
    """A prefix that leaves nothing to score is a mistake, not a result."""
    longest = max(len(held.recording.estimate[name]) for name in held.names)
    if 0 < longest <= skip:
        raise ValueError(
            f"{path} has {longest} estimates and the first {skip} are skipped; "
            f"give --skip {min(longest // 2, SKIP_EPOCHS)} to score the others"
        )


def _covered(name: str, figures: Figures) -> list[str]:
    """A sentence where some of the estimates have no ground truth to be scored by."""
    without = figures.outside_truth + figures.in_truth_gap
    if not without:
        return []
    share = 100.0 * without / figures.estimates
    return [
        f"{name}: {without} of {figures.estimates} estimates ({share:.1f} %) are not scored: "
        f"{figures.outside_truth} before or after the ground truth, {figures.in_truth_gap} in gaps"
    ]
