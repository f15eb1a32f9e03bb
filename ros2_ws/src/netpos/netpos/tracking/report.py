"""What a track says at one epoch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from netpos.estimation.level.report import LEVEL_MAX_M
from netpos.messages.values import (
    ClockState,
    NetworkTrack,
    Odometry,
    RsuErrors,
    StepCalibration,
    TrackMode,
    TrackState,
    TrackStatus,
)
from netpos.tracking.config import TrackerConfig
from netpos.tracking.output import track_state

_NO_STEPS = StepCalibration()


@dataclass(slots=True)
class TrackOutput:
    """What a track says at one epoch; odometry is None until the first fix, clock until the first
    TOA. ``revised``: said before of the same epoch, without what came late. ``smoothed``: earlier
    epochs that are now ``fixed_lag_s`` old. ``network``: whose track it is, "" for that of all;
    ``track``: the same for others to fuse with their own. ``errors``: what is learned of the
    RSUs, where it has changed."""

    odometry: Odometry | None
    clock: ClockState | None
    status: TrackStatus
    revised: bool = False
    smoothed: tuple[Odometry, ...] = ()
    network: str = ""
    track: NetworkTrack | None = None
    errors: tuple[RsuErrors, ...] = ()


@dataclass(slots=True)
class EpochResult:
    """What became of the measurements of one epoch: NIS, its degrees of freedom and who sent what
    was accepted."""

    stamp_ns: int
    nis: float = 0.0
    dof: int = 0
    sources: tuple[str, ...] = ()


def total(refused: Mapping[str, int], rejected: Mapping[str, int]) -> dict[str, int]:
    """Measurements refused at the door or rejected by the track, by reason."""
    counts = dict(refused)
    for reason, number in rejected.items():
        counts[reason] = counts.get(reason, 0) + number
    return counts


@dataclass(frozen=True, slots=True, kw_only=True)
class EstimateStatus:
    """What a status says of an estimate: heard_ns, stamp of the last accepted measurement, None
    before the first fix, and what is missing for one; sd along the worst axis and protection level
    [m], -1: none; modes, where the device may be while that is not decided; whether it can be
    where the estimate is; calibration of step velocities; epochs in a row that were refused."""

    heard_ns: int | None = None
    missing: str = ""
    refused_in_row: int = 0
    position_sd_m: float = 0.0
    level_m: float = -1.0
    modes: tuple[TrackMode, ...] = ()
    is_at_a_place: bool = True
    steps: StepCalibration | None = None


NO_ESTIMATE = EstimateStatus()


def track_status(
    config: TrackerConfig,
    vue_id: str,
    epoch: EpochResult,
    accepted: int,
    rejected: dict[str, int],
    estimate: EstimateStatus = NO_ESTIMATE,
) -> TrackStatus:
    """Status of a track after an ``epoch``; accepted, rejected : counts since start."""
    modes = estimate.modes
    state = track_state(
        config,
        epoch.stamp_ns,
        estimate.heard_ns,
        estimate.position_sd_m,
        decided=not modes,
        bounded=estimate.level_m < LEVEL_MAX_M,
        placed=estimate.is_at_a_place,
    )
    return TrackStatus(
        stamp_ns=epoch.stamp_ns,
        vue_id=vue_id,
        state=state,
        nis=epoch.nis,
        nis_dof=epoch.dof,
        used=len(epoch.sources),
        accepted=accepted,
        rejected=rejected,
        sources=epoch.sources,
        position_sd_m=estimate.position_sd_m,
        protection_level_m=estimate.level_m,
        steps=estimate.steps or _NO_STEPS,
        modes=modes,
        reason=_reason(config, state, epoch.stamp_ns, estimate),
    )


def waiting_output(
    config: TrackerConfig,
    vue_id: str,
    epoch: EpochResult,
    accepted: int,
    rejected: dict[str, int],
    missing: str,
) -> TrackOutput:
    """What is told after an ``epoch`` without an estimate, for want of ``missing``."""
    open_ = EstimateStatus(missing=missing)
    status = track_status(config, vue_id, epoch, accepted, rejected, open_)
    return TrackOutput(None, None, status, network=config.network)


def _reason(
    config: TrackerConfig, state: TrackState, stamp_ns: int, estimate: EstimateStatus
) -> str:
    """Why a track is in a state that is not TRACKING."""
    match state:
        case TrackState.WAITING:
            return estimate.missing
        case TrackState.INITIALISING:
            if estimate.level_m >= LEVEL_MAX_M:
                return "nothing bounds the error: a manoeuvre would not show in what is measured"
            if not estimate.is_at_a_place:
                return "somewhere on a ring, an arc or between places; the estimate is their mean"
            limit_m = config.initial_position_sd_max_m
            return f"position sd {estimate.position_sd_m:.1f} m, above {limit_m:g} m"
        case TrackState.COASTING:
            unheard_s = (stamp_ns - (estimate.heard_ns or stamp_ns)) * 1e-9
            refused = f"; {estimate.refused_in_row} epochs in a row refused by the gate"
            return f"nothing taken for {unheard_s:.1f} s{refused * bool(estimate.refused_in_row)}"
        case TrackState.AMBIGUOUS:
            return f"at one of {len(estimate.modes)} places"
        case _:
            return ""
