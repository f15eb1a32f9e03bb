"""A real recording beside its yardsticks: netpos, netpos with default parameters, a snapshot and a
plain Kalman filter, all from the same bag against the same truth."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from netpos.bags import BagReader
from netpos.evaluation.devices import Together, together
from netpos.evaluation.evaluate import evaluate_bag
from netpos.evaluation.metrics import SKIP_EPOCHS, Figures, Run, score
from netpos.evaluation.pairing import Stamps, Trajectory
from netpos.evaluation.yardsticks import (
    Kind,
    Observations,
    Space,
    observations_of_devices,
    plain_ekf,
    snapshots,
)
from netpos.messages import topics
from netpos.messages.values import TrackStatus
from netpos.scenario.replay import replay_bag
from netpos.scenario.settings import bag_settings
from netpos.tracking.config import TrackerConfig

Json = dict[str, Any]

# What a recording is, not how a tracker is set: these stay with default parameters.
FACTS = frozenset(
    {
        *("motion_model", "network", "gravity_mps2", "earth_rate", "latitude_deg"),
        *("device_height_m", "device_height_sd_m", "device_height_time_s"),
    }
)
# Figures of an estimate's accuracy, and figures of a whole run.
ACCURACY = (
    *("n", "rmse_m", "p50_m", "p95_m", "max_m", "nees_mean", "nees_bounds", "share_above_5m"),
    *("along_rmse_m", "across_rmse_m", "along_nees", "across_nees"),
)
WHOLE = (
    "availability",
    "measured",
    "nis_mean",
    "lost_tracks",
    "unscored_s",
    "rejected",
    "rejected_share",
    "protection_exceeded",
    "protection_level_m",
)
# Figures of the time that a run takes.
TIMES = ("availability", "unscored_s", "time_to_first_fix_s")


@dataclass(frozen=True, slots=True, kw_only=True)
class Recording:
    """One row to measure. bag: as imported; space: what the yardsticks solve for; range_sd_m:
    their sd of a range, None for what the RSUs state; reference: the authors' RMSE [m]; kinds:
    what the yardsticks use; skip: estimates at the start of each device that do not count."""

    name: str
    bag: Path
    space: Space
    range_sd_m: float | None = None
    reference: float | None = None
    kinds: Collection[Kind] = tuple(Kind)
    skip: int = SKIP_EPOCHS


def recording_row(recording: Recording, folder: Path) -> Json:
    """Replay into ``folder`` with the bag's parameters, with default ones, with what is declared
    alone and with learned errors; run the yardsticks, and score all alike. Several devices are
    scored as one, one after another.

    ``rmse_m`` and the other figures of accuracy of a baseline are of the tracker's epochs that
    count; ``own`` holds those of all its epochs but the first ``recording.skip``. Figures of time
    of a baseline are None for several devices.

    Raises
    ------
    ValueError  the bag has no ground truth or no measurement, or no estimate came of it
    FileExistsError  ``folder`` has a bag of this name
    """
    ours = _replayed(recording, folder / recording.name, {})
    if ours is None:
        raise ValueError(f"{recording.bag}: no estimate was made; netpos replay says why")
    defaults = _replayed(
        recording, folder / f"{recording.name}_defaults", default_parameters(recording.bag)
    )
    learning = _learning(recording.bag)
    other = None
    if learning is not None:
        name = "declared" if learning else "learned"
        changed = {"learn_errors": not learning}
        other = _replayed(recording, folder / f"{recording.name}_{name}", changed)
    mine, plain, changed_so = (
        None if run is None else figures_of(run.figures) for run in (ours, defaults, other)
    )
    seen = observations_of_devices(
        recording.bag, ours.offset_ns, range_sd_m=recording.range_sd_m, kinds=recording.kinds
    )
    baselines = baseline_figures(
        ours.observations(seen),
        recording.space,
        ours.run.truth,
        ours.counted_ns,
        recording.skip,
    )
    if len(ours.offset_ns) > 1:  # the time between two devices is nobody's
        baselines = {name: row | dict.fromkeys(TIMES) for name, row in baselines.items()}
    return {
        "name": recording.name,
        "reference": recording.reference,
        "truth_time": _at_its_time(recording, folder / recording.name, ours, seen),
        **baselines,
        "ours": mine,
        "defaults": plain,
        "declared": changed_so if learning else mine,
        "learned": mine if learning else changed_so,
    }


def _at_its_time(
    recording: Recording, replayed: Path, ours: Together, seen: Mapping[str, Observations]
) -> Json | None:
    """RMSE [m] where the ground truth is as much later as fits the measurements best, which is the
    same for all columns; None where that changes little, or there are several devices."""
    if len(ours.offset_ns) > 1:
        return None
    (vue,) = evaluate_bag(replayed, skip=recording.skip, truth_time=True).vues.values()
    if vue.truth_time is None or not vue.truth_time.matters:
        return None
    offset_ns = round(1e9 * vue.truth_time.offset_s)
    truth = replace(vue.run.truth, stamp_ns=vue.run.truth.stamp_ns + offset_ns)
    mine = figures_of(score(replace(vue.run, truth=truth), skip=recording.skip).figures)
    others = baseline_figures(
        ours.observations(seen), recording.space, truth, ours.counted_ns, recording.skip
    )
    return {
        **asdict(vue.truth_time),
        **{name: {"rmse_m": figures["rmse_m"]} for name, figures in others.items()},
        "ours": {key: mine[key] for key in ("rmse_m", "nees_mean", "nees_bounds")},
    }


def _learning(bag: Path) -> bool | None:
    """Whether the tracker of a bag learns the errors of RSUs; None: its motion model cannot."""
    with BagReader(bag) as source:
        config = TrackerConfig.from_mapping(bag_settings(source).parameters)
    return None if config.is_strapdown else config.learn_errors


def default_parameters(bag: Path) -> Json:
    """Overrides that give every parameter a bag carries its default again, but for the facts of
    the recording (``FACTS``)."""
    with BagReader(bag) as source:
        carried = bag_settings(source).parameters
    usual = TrackerConfig()
    return {name: getattr(usual, name) for name in carried if name not in FACTS}


def _replayed(recording: Recording, out: Path, overrides: Json) -> Together | None:
    """The devices of a replay; None where it made no estimate."""
    replay_bag(recording.bag, out, overrides)
    with BagReader(out) as bag:
        filled = [topics.split(topic) for topic, info in bag.topics.items() if info.count]
    if not any(name == topics.ODOMETRY for _, name in filled):
        return None
    return together(evaluate_bag(out, skip=recording.skip).vues)


def baseline_figures(
    seen: Observations,
    space: Space,
    truth: Trajectory,
    counted: Stamps | None = None,
    skip: int = SKIP_EPOCHS,
) -> dict[str, Json]:
    """Figures of both yardsticks; accuracy at the stamps ``counted`` (None: at all of their own)
    and, as ``own``, at all of their own."""
    filtered = plain_ekf(seen, space)
    runs: list[tuple[str, Trajectory, list[TrackStatus]]] = [
        ("snapshot", snapshots(seen, space), []),
        ("plain_ekf", filtered.estimate, filtered.statuses),
    ]
    rows: dict[str, Json] = {}
    for name, estimate, statuses in runs:
        run = Run(truth=truth, estimate=estimate, statuses=statuses)
        whole = score(run, skip=skip).figures
        rows[name] = figures_of(whole)
        if counted is not None:
            rows[name]["own"] = {key: rows[name][key] for key in ACCURACY}
            kept = estimate.take(np.isin(estimate.stamp_ns, counted))
            shared = score(Run(truth=truth, estimate=kept), skip=0).figures.to_json()
            rows[name] |= {key: shared.get(key) for key in ACCURACY}
    return rows


def figures_of(figures: Figures) -> Json:
    """The figures of a row; None where one cannot be computed."""
    content = figures.to_json()
    return {
        **{key: content.get(key) for key in (*ACCURACY, *WHOLE)},
        "nis_expected": content["nis_dof_mean"],
        "time_to_first_fix_s": content["initial"]["time_to_first_fix_s"],
    }
