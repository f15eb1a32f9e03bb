"""A setting of the network experiments by the library's default parameters: a tracker for each
network and the fusion of their tracks, as they run live, from the first fixes on.

Given are only the facts: what a fix's covariance is, which network it is of, that the object
accelerates, and where its network's server is, which is near the object when the run starts.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from netpos.estimation.state import POSITION
from netpos.evaluation.work import Work
from netpos.messages.values import Array, Field, NetworkTrack, RsuInfo, RsuMeasurement
from netpos.reproduction.dvornikov2017.stages import (
    VUE,
    FixNetwork,
    Ints,
    Setting,
    common_stamps_ns,
)
from netpos.reproduction.dvornikov2017.summary import NetworkSummary
from netpos.reproduction.dvornikov2017.truth import START_NS
from netpos.scenario.networks import fix_errors
from netpos.scenario.schema import NS
from netpos.tracking.config import TrackerConfig
from netpos.tracking.networks.chain import Chain
from netpos.tracking.networks.common_instant import at_common_instant
from netpos.tracking.networks.config import FusionConfig
from netpos.tracking.report import TrackOutput

RUNS = 200  # at most: every run is two trackers', message by message
TRACKER = TrackerConfig(motion_model="constant_acceleration")
FUSION = FusionConfig()

Estimates = dict[str, tuple[Array, Array]]
"""By estimator: errors (n, 2) and covariances (n, 2, 2) at the common instants, NaN where there is
no estimate."""


def _fixes(network: FixNetwork, setting: Setting, seed: int) -> list[RsuMeasurement]:
    """Fixes of a network (``Pass.fixes``) as messages."""
    stamps = network.stamps_ns(setting.duration_s)
    fixes = np.zeros((stamps.size, 3))
    fixes[:, :2] = setting.truth(seed, stamps)[:, :2]
    fixes[:, :2] += fix_errors(stamps, network.sd_m, seed, network.name, VUE)[:, :2]
    return [
        RsuMeasurement(
            stamp_ns=int(stamp),
            rsu_id=network.name,
            vue_id=VUE,
            fields=Field.POSITION,
            position=fix,
            position_cov=network.sd_m**2 * np.eye(3),
        )
        for stamp, fix in zip(stamps.tolist(), fixes, strict=True)
    ]


def _outputs(setting: Setting, seed: int) -> list[TrackOutput]:
    """Outputs of all trackers and of the fusion."""
    chain = Chain([network.name for network in setting.networks], TRACKER, FUSION)
    server = np.zeros(3)
    server[:2] = setting.truth(seed, np.array([START_NS]))[0, :2]
    measurements = []
    for network in setting.networks:
        chain.add_rsu(RsuInfo(rsu_id=network.name, position=server, network=network.name))
        measurements += _fixes(network, setting, seed)
    outputs: list[TrackOutput] = []
    for measurement in sorted(measurements, key=lambda m: m.stamp_ns):
        chain.add(measurement)
        outputs += chain.process()
    return outputs + chain.flush()


def run_defaults(setting: Setting, seed: int) -> Estimates:
    """One seed; the fused track is called by the method of the fusion."""
    outputs = _outputs(setting, seed)
    stamps = common_stamps_ns(setting)
    truth = setting.truth(seed, stamps)[:, :2]
    estimates: Estimates = {}
    for network in setting.networks:
        tracks = [o.track for o in outputs if o.track and o.track.network == network.name]
        estimates[network.name] = _moved(tracks, stamps, truth)
    fused = _empty(len(stamps))
    row_of_stamp = {int(stamp): k for k, stamp in enumerate(stamps.tolist())}
    for output in outputs:
        k = row_of_stamp.get(output.status.stamp_ns)
        same = output.status.vue_id == VUE and output.status.sources
        if k is not None and same and output.odometry is not None:
            fused[0][k] = output.odometry.position[:2] - truth[k]
            fused[1][k] = output.odometry.pose_cov[:2, :2]
    return estimates | {FUSION.method: fused}


def _moved(tracks: list[NetworkTrack], stamps: Ints, truth: Array) -> tuple[Array, Array]:
    """A network's newest track, moved to each common instant."""
    error, cov = _empty(len(stamps))
    heard = np.array([track.stamp_ns for track in tracks])
    newest = np.searchsorted(heard, stamps, side="right") - 1
    for k in np.flatnonzero(newest >= 0).tolist():
        track = tracks[newest[k]]
        if stamps[k] - track.stamp_ns <= FUSION.stale_s * 1e9:
            moved = at_common_instant([track], int(stamps[k]), FUSION.jerk_density)
            error[k], cov[k] = moved.mean[0, POSITION] - truth[k], moved.cov[0, POSITION, POSITION]
    return error, cov


def _empty(n: int) -> tuple[Array, Array]:
    return np.full((n, 2), np.nan), np.full((n, 2, 2), np.nan)


def _job(setting: Setting, seeds: range) -> list[Estimates]:
    return [run_defaults(setting, seed) for seed in seeds]


def summarise_defaults(work: Work, setting: Setting) -> NetworkSummary:
    """At most ``RUNS`` seeds of a setting's object, by default parameters."""
    setting = replace(setting, name=f"{setting.name}, defaults", tracker=TRACKER)
    few = work.with_runs(min(work.runs, RUNS))
    runs = [run for part in few.over_seeds(setting.name, _job, setting) for run in part]
    names = list(runs[0])
    return NetworkSummary(
        setting=setting,
        time_s=(common_stamps_ns(setting) - START_NS) / NS,
        errors={name: np.array([run[name][0] for run in runs]) for name in names},
        covs={name: np.array([run[name][1] for run in runs]) for name in names},
    )
