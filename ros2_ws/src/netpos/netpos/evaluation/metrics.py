"""Figures of one device's run. A figure that cannot be computed is None, never 0."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from netpos.evaluation.availability import (
    availability,
    lost_tracks,
    ready_stamps,
    rejected_share,
    unscored_s,
)
from netpos.evaluation.consistency import nees_test, nis_test, whitened
from netpos.evaluation.pairing import (
    MAX_TRUTH_GAP_S,
    ClockOffsets,
    Pairs,
    Stamps,
    Trajectory,
    has_height,
    pair,
    wrap_angle,
)
from netpos.messages.values import Array, TrackStatus

SKIP_EPOCHS = 20
LARGE_ERROR_M = 5.0
MIN_SPEED_MPS = 0.5
CONVERGED_ERROR_M = 1.0
CONVERGED_FOR_S = 1.0
NS = 1e9
NO_CLOCK = ClockOffsets.of(())


@dataclass(frozen=True, slots=True, kw_only=True)
class Initial:
    """Start of the run, in seconds after the first ground truth.

    first fix: first estimate; ready: first estimate in state TRACKING; 1 m: first estimate that
    opens a stretch of at least 1 s, without a pause above 1 s, in which every horizontal error is
    at most 1 m.
    """

    time_to_first_fix_s: float | None
    time_to_ready_s: float | None
    time_to_1m_s: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Figures:
    """Accuracy, availability and consistency of one device, after the convergence prefix of
    ``skipped`` estimates and from the first one in state TRACKING on.

    n: estimates scored. truth_share: share of the estimates at whose stamp there is ground truth;
    nothing is known of the others. initialising: estimates before the first in state TRACKING, 0
    where the recording has no track status. duration_s: from the first to the last scored.
    availability: share of the ground truth's span at which the newest ready estimate is at most
    0.2 s old (5 Hz, fokin2020's priority passage), convergence included; an estimate is ready in
    state TRACKING. measured: the same of measurements of RSUs, without steps and IMU. rmse_m,
    p50..max: horizontal position error; mean_error_m: mean horizontal
    error, which fokin2020:eq.34 calls RMSE; rmse_3d_m with the vertical; north, east, down: by
    axis, as deng2022 does. along_*, across_*: of the horizontal error along the true way and
    across it, where the true speed exceeds 0.5 m/s; along_nees: mean of the square of that part
    over its variance, 1 expected. A ground truth at the wrong time shows along the way alone.
    vertical_rmse_m: of the height, and vertical_error_m its mean, positive
    above the truth; None where the truth has no height (``pairing.has_height``).
    velocity_rmse_mps: horizontal, map axes. heading_rmse_deg: where the true speed exceeds 0.5
    m/s. clock_offset_sd_ns: standard deviation of the clock offset error about its mean;
    clock_offset_rmse_ns: about zero. nees_*: horizontal position, 2 degrees of freedom, bounds as
    wide as those of nees_n_eff independent epochs. nis_mean: mean NIS of epochs with measurements;
    nis_dof_mean: its expectation. rejected: all rejections counted up to the end; rejected_share:
    of the measurements (no IMU samples, no events such as a lost track) that the track accepted or
    refused, the share refused. lost_tracks: see ``lost_tracks``, None without track status.
    unscored_s: seconds of the ground truth's span without a scored estimate
    (``availability.unscored_s``): before the first one, after a loss, in gaps. share_above_5m:
    share of the estimates scored with an error above 5 m. protection_exceeded: share of the
    estimates with a horizontal error above the protection level of their status;
    protection_level_m: its median. bound_ratio: rmse_m over the posterior Cramer-Rao bound.
    """

    n: int
    duration_s: float | None = None
    availability: float | None = None
    rmse_m: float | None = None
    mean_error_m: float | None = None
    p50_m: float | None = None
    p95_m: float | None = None
    p99_m: float | None = None
    max_m: float | None = None
    velocity_rmse_mps: float | None = None
    heading_rmse_deg: float | None = None
    clock_offset_sd_ns: float | None = None
    clock_offset_rmse_ns: float | None = None
    nees_mean: float | None = None
    nees_bounds: tuple[float, float] | None = None
    nees_consistent: bool | None = None
    nis_mean: float | None = None
    rejected: int | None = None
    bound_ratio: float | None = None
    truth_share: float | None = None
    measured: float | None = None
    lost_tracks: int | None = None
    unscored_s: float | None = None
    share_above_5m: float | None = None
    rejected_share: float | None = None
    protection_exceeded: float | None = None
    protection_level_m: float | None = None
    rmse_3d_m: float | None = None
    north_rmse_m: float | None = None
    east_rmse_m: float | None = None
    down_rmse_m: float | None = None
    along_rmse_m: float | None = None
    across_rmse_m: float | None = None
    along_nees: float | None = None
    across_nees: float | None = None
    vertical_rmse_m: float | None = None
    vertical_error_m: float | None = None
    nees_n: int | None = None
    nees_n_eff: float | None = None
    nis_dof_mean: float | None = None
    nis_bounds: tuple[float, float] | None = None
    nis_consistent: bool | None = None
    rejected_by_reason: dict[str, int] | None = None
    output_rate_hz: float | None = None
    longest_gap_s: float | None = None
    speed_max_mps: float | None = None
    initial: Initial = field(
        default_factory=lambda: Initial(
            time_to_first_fix_s=None, time_to_ready_s=None, time_to_1m_s=None
        )
    )
    estimates: int = 0
    skipped: int = 0
    initialising: int = 0
    outside_truth: int = 0
    in_truth_gap: int = 0
    duplicates: int = 0
    invalid: int = 0

    def to_json(self) -> dict[str, Any]:
        """Plain types, keys as the field names."""
        figures = asdict(self)
        for name in ("nees_bounds", "nis_bounds"):
            figures[name] = None if figures[name] is None else list(figures[name])
        return figures


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """Data of one device in a recording. ``measured_ns``: when RSUs measured, None: not known."""

    truth: Trajectory
    estimate: Trajectory
    statuses: Sequence[TrackStatus] = ()
    measured_ns: Stamps | None = None
    clock: ClockOffsets = NO_CLOCK
    clock_truth: ClockOffsets = NO_CLOCK


@dataclass(frozen=True, slots=True, kw_only=True)
class Scored:
    """The figures of a run; ``pairs`` are all pairs of estimate and truth, those from ``from_ns``
    on (``counted``) make the figures.
    """

    figures: Figures
    pairs: Pairs
    counted: Pairs
    from_ns: int


def rms(values: Array) -> float | None:
    """Root mean square; None without values."""
    return float(np.sqrt(np.mean(values**2))) if values.size else None


def _percentiles(errors: Array) -> tuple[float | None, ...]:
    if not errors.size:
        return (None, None, None, None)
    return tuple(float(p) for p in np.percentile(errors, [50, 95, 99, 100]))


def time_to_converge(
    pairs: Pairs, limit_m: float = CONVERGED_ERROR_M, hold_s: float = CONVERGED_FOR_S
) -> int | None:
    """Stamp [ns] of the first estimate that opens a stretch of at least ``hold_s`` within
    ``limit_m``; None if there is none.

    A pause longer than ``hold_s`` ends a stretch.
    """
    hold_ns = round(hold_s * NS)
    begin = previous = None
    for stamp, error in zip(pairs.estimate.stamp_ns.tolist(), pairs.horizontal_error, strict=True):
        if error > limit_m:
            begin = None
        elif begin is None or stamp - previous > hold_ns:
            begin = stamp
        elif stamp - begin >= hold_ns:
            return int(begin)
        previous = stamp
    return None


def clock_error_series(run: Run, max_gap_s: float = MAX_TRUTH_GAP_S) -> tuple[Stamps, Array]:
    """Stamps (k,) and clock offset errors (k,) [ns], estimate minus the interpolated truth."""
    true = run.clock_truth.at(run.clock.stamp_ns, max_gap_s)
    has_truth = np.isin(run.clock.stamp_ns, true.stamp_ns)
    return true.stamp_ns, (run.clock.offset_s[has_truth] - true.offset_s) * NS


def _initial(run: Run, pairs: Pairs, ready_ns: Stamps) -> Initial:
    start = int(run.truth.stamp_ns[0])

    def after_start(stamp: int | None) -> float | None:
        return None if stamp is None else max(stamp - start, 0) / NS

    first = int(run.estimate.stamp_ns[0]) if len(run.estimate) else None
    ready = int(ready_ns[0]) if ready_ns.size else None
    return Initial(
        time_to_first_fix_s=after_start(first),
        time_to_ready_s=after_start(ready),
        time_to_1m_s=after_start(time_to_converge(pairs)),
    )


def _in_motion(pairs: Pairs) -> dict[str, Any]:
    """Errors of the heading, along the true way and across it."""
    velocity = pairs.truth.velocity[:, :2]
    moving = np.linalg.norm(velocity, axis=1) > MIN_SPEED_MPS
    turned = wrap_angle(pairs.estimate.heading - pairs.truth.heading)[moving]
    figures = {"heading_rmse_deg": rms(np.rad2deg(turned))}
    ahead = velocity[moving] / np.linalg.norm(velocity[moving], axis=1, keepdims=True)
    aside = np.column_stack([-ahead[:, 1], ahead[:, 0]])
    cov = pairs.estimate.position_cov[moving, :2, :2]
    for name, axis in (("along", ahead), ("across", aside)):
        error = (axis * pairs.error[moving, :2]).sum(axis=1)
        variance = np.einsum("ni,nij,nj->n", axis, cov, axis)
        known = variance > 0.0
        figures[f"{name}_rmse_m"] = rms(error)
        nees = error[known] ** 2 / variance[known]
        figures[f"{name}_nees"] = float(nees.mean()) if nees.size else None
    return figures


def _consistency(pairs: Pairs, statuses: Sequence[TrackStatus], from_ns: int) -> dict[str, Any]:
    normalised, _ = whitened(pairs.error[:, :2], pairs.estimate.position_cov[:, :2, :2])
    errors = nees_test(normalised)
    evaluated = [
        s for s in statuses if s.nis_dof > 0 and s.stamp_ns >= from_ns and np.isfinite(s.nis)
    ]
    innovations = nis_test(
        np.array([s.nis for s in evaluated], dtype=np.float64),
        np.array([s.nis_dof for s in evaluated], dtype=np.float64),
    )
    figures: dict[str, Any] = {"nees_n": len(normalised)}
    if errors is not None:
        figures |= {
            "nees_mean": errors.mean,
            "nees_bounds": errors.bounds,
            "nees_consistent": errors.consistent,
            "nees_n_eff": errors.n_eff,
        }
    if innovations is not None:
        figures |= {
            "nis_mean": innovations.mean,
            "nis_dof_mean": float(np.mean([s.nis_dof for s in evaluated])),
            "nis_bounds": innovations.bounds,
            "nis_consistent": innovations.consistent,
        }
    return figures


def _output(ready_ns: Stamps) -> dict[str, Any]:
    if ready_ns.size < 2:
        return {"output_rate_hz": None, "longest_gap_s": None}
    intervals = np.diff(ready_ns)
    return {
        "output_rate_hz": float(intervals.size * NS / intervals.sum()),
        "longest_gap_s": float(intervals.max() / NS),
    }


def _accuracy(scored: Pairs) -> dict[str, Any]:
    errors = scored.horizontal_error
    stamps = scored.estimate.stamp_ns
    p50, p95, p99, worst = _percentiles(errors)
    up = scored.error[has_height(scored.truth), 2]
    velocity_errors = (scored.estimate.velocity - scored.truth.velocity)[:, :2]
    return {
        "n": len(scored),
        "duration_s": float((stamps[-1] - stamps[0]) / NS) if stamps.size else None,
        "rmse_m": rms(errors),
        "rmse_3d_m": rms(np.linalg.norm(scored.error, axis=1)),
        "north_rmse_m": rms(scored.error[:, 1]),
        "east_rmse_m": rms(scored.error[:, 0]),
        "down_rmse_m": rms(scored.error[:, 2]),
        "vertical_rmse_m": rms(up),
        "vertical_error_m": float(up.mean()) if up.size else None,
        "mean_error_m": float(errors.mean()) if errors.size else None,
        "p50_m": p50,
        "p95_m": p95,
        "p99_m": p99,
        "max_m": worst,
        "share_above_5m": float((errors > LARGE_ERROR_M).mean()) if errors.size else None,
        "velocity_rmse_mps": rms(np.linalg.norm(velocity_errors, axis=1)),
        **_in_motion(scored),
    }


def _losses(statuses: Sequence[TrackStatus]) -> dict[str, Any]:
    if not statuses:
        return {}
    last = max(statuses, key=lambda status: status.stamp_ns)
    return {
        "lost_tracks": lost_tracks(statuses),
        "rejected": sum(last.rejected.values()),
        "rejected_by_reason": dict(last.rejected),
        "rejected_share": rejected_share(last),
    }


def _integrity(pairs: Pairs, statuses: Sequence[TrackStatus]) -> dict[str, Any]:
    level_by_stamp = {
        s.stamp_ns: s.protection_level_m for s in statuses if s.protection_level_m >= 0.0
    }
    levels = np.array(
        [level_by_stamp.get(stamp, np.nan) for stamp in pairs.estimate.stamp_ns.tolist()]
    )
    known = np.isfinite(levels)
    if not known.any():
        return {}
    exceeded = pairs.horizontal_error[known] > levels[known]
    return {
        "protection_exceeded": float(exceeded.mean()),
        "protection_level_m": float(np.median(levels[known])),
    }


def score(
    run: Run, *, skip: int = SKIP_EPOCHS, max_truth_gap_s: float = MAX_TRUTH_GAP_S
) -> Scored:
    """Figures of a run, with the pairs they come from.

    Neither the first ``skip`` estimates count nor those before the first in state TRACKING: an
    error of metres is what INITIALISING says. A track lost later and started anew does count.

    Raises
    ------
    ValueError  ``skip`` is negative or there is no ground truth
    """
    if skip < 0:
        raise ValueError(f"skip must be >= 0, got {skip}")
    if not len(run.truth):
        raise ValueError("there is no ground truth to score against")
    pairs = pair(run.estimate, run.truth, max_truth_gap_s)
    ready_ns = ready_stamps(run.estimate, run.statuses)
    stamps = run.estimate.stamp_ns
    initialising = int((stamps < ready_ns[0]).sum()) if ready_ns.size else len(stamps)
    left = stamps[max(skip, initialising) :]
    from_ns = int(left[0]) if left.size else int(np.iinfo(np.int64).max)
    scored = pairs.take(slice(int(np.searchsorted(pairs.estimate.stamp_ns, from_ns)), None))
    clock_ns, clock = clock_error_series(run, max_truth_gap_s)
    clock = clock[clock_ns >= from_ns]
    figures = Figures(
        truth_share=len(pairs) / len(run.estimate) if len(run.estimate) else None,
        availability=availability(run.truth.stamp_ns, ready_ns),
        measured=(
            None if run.measured_ns is None else availability(run.truth.stamp_ns, run.measured_ns)
        ),
        unscored_s=unscored_s(run.truth.stamp_ns, scored.estimate.stamp_ns, stamps),
        clock_offset_sd_ns=float(clock.std()) if clock.size else None,
        clock_offset_rmse_ns=rms(clock),
        speed_max_mps=float(np.linalg.norm(run.truth.velocity[:, :2], axis=1).max()),
        initial=_initial(run, pairs, ready_ns),
        estimates=len(run.estimate),
        skipped=min(skip, len(stamps)),
        initialising=initialising,
        outside_truth=pairs.outside,
        in_truth_gap=pairs.in_gap,
        duplicates=run.estimate.duplicates,
        invalid=run.estimate.invalid,
        **_accuracy(scored),
        **_output(ready_ns),
        **_consistency(scored, run.statuses, from_ns),
        **_losses(run.statuses),
        **_integrity(scored, run.statuses),
    )
    return Scored(figures=figures, pairs=pairs, counted=scored, from_ns=from_ns)
