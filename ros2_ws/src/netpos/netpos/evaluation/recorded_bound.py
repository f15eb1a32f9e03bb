"""The posterior Cramér-Rao bound of a recorded run, for the tracker's own motion model."""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Iterable, Mapping

import numpy as np

from netpos.estimation.motion import SPEED_OF_LIGHT_MPS
from netpos.estimation.state import N_CORE, HeightState
from netpos.evaluation.bounds import bound_rmse, run_bound
from netpos.evaluation.pairing import Stamps, Trajectory
from netpos.messages.values import Array, InitialPose, RsuInfo, RsuMeasurement
from netpos.tracking.config import TrackerConfig
from netpos.tracking.estimators.epoch_rows import epoch_rows_of, planar_form
from netpos.tracking.estimators.models import height_state, motions_of, pose_state, slow_states
from netpos.tracking.rsus.rsu import Rsu


def recorded_bound_m(
    measurements: Iterable[RsuMeasurement],
    rsus: Mapping[str, RsuInfo],
    pose: InitialPose | None,
    truth: Trajectory,
    config: TrackerConfig,
    scored_ns: Stamps,
) -> float | None:
    """Smallest RMSE [m] at the stamps ``scored_ns`` that the measurements of a device allow.

    None where the recording does not determine it: motion models that interact or follow an IMU
    or a heading, RSUs with biases or coloured noise, fewer than two epochs within the truth.
    """
    known = {name: Rsu.of(info) for name, info in rsus.items()}
    simple = config.motion_model == "constant_velocity" and len(truth) > 1
    if not simple or not all(rsu.plain for rsu in known.values()):
        return None
    rows_by_stamp: dict[int, list[Array]] = defaultdict(list)
    biases, height = slow_states(config), height_state(config)  # and what differences share
    form = planar_form(height=height)
    first_ns, last_ns = int(truth.stamp_ns[0]), int(truth.stamp_ns[-1])
    heard = (m for m in measurements if m.rsu_id in known and first_ns <= m.stamp_ns <= last_ns)
    for stamp, together in itertools.groupby(heard, key=lambda m: m.stamp_ns):
        rows_by_stamp[stamp].append(epoch_rows_of(list(together), known, biases, form).rows)
    if len(rows_by_stamp) < 2:
        return None
    stamps = np.array(sorted(rows_by_stamp), dtype=np.int64)
    blocks = [np.vstack(rows_by_stamp[stamp]) for stamp in stamps.tolist()]
    prior = np.zeros((N_CORE + len(biases.sd),) * 2)
    prior[:N_CORE, :N_CORE] = _prior(config, pose)
    bounds = run_bound(
        stamps,
        np.cumsum([0, *map(len, blocks)]),
        np.vstack(blocks),
        truth.stamp_ns,
        _states(truth, height),
        prior + np.diag(np.square([*[0.0] * N_CORE, *biases.sd])),
        motions_of(config),
        bias=biases.arrays(),
        height_m=config.device_height_m,
    )
    scored = bounds[np.isin(stamps, scored_ns)]
    return bound_rmse(scored) if len(scored) else None


def _states(truth: Trajectory, height: HeightState) -> Array:
    """True states (T, 4), or (T, 7) with the height."""
    states = np.column_stack([truth.position[:, :2], truth.velocity[:, :2]])
    if not height.entry:
        return states
    above = truth.position[:, 2] - height.nominal_m
    return np.column_stack([states, np.zeros((len(truth), 2)), above])


def _prior(config: TrackerConfig, pose: InitialPose | None) -> Array:
    """Covariance (6, 6) of the prior before the first measurement."""
    if pose is not None:
        return pose_state(config, pose.position[:2], pose.cov[:2, :2])[1]
    reach, c = config.coverage_radius_m, SPEED_OF_LIGHT_MPS
    speed = config.initial_speed_sd_mps
    clock = [c * config.clock_offset_sd_s, c * config.clock_drift_sd]
    return np.diag(np.array([reach, reach, speed, speed, *clock]) ** 2)
