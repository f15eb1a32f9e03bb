"""What an operator is told of devices, RSUs and the input as a whole: a level and a sentence."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum

from netpos.estimation.motion import SPEED_OF_LIGHT_MPS
from netpos.messages.values import RsuErrors, StepCalibration, TrackState, TrackStatus
from netpos.tracking.door.refusals import Refused
from netpos.tracking.health.health import RsuReport, RsuState
from netpos.tracking.ordering.clocks import Stranger

_NOTHING: Mapping[str, RsuErrors] = {}
_NEVER: Mapping[str, int] = {}
_BIAS_SDS = 3.0  # sd of a bias that is mentioned
_STRETCH = 0.001  # share of the distance that is mentioned
_SCATTER = 1.5  # times as stated, or less than one over it
_LENGTHS = {"RANGE": "ranges", "TDOA": "time differences"}


class Level(IntEnum):
    """As in diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True, slots=True)
class Finding:
    """One line for an operator, and the figures behind it."""

    level: Level
    subject: str
    message: str
    hardware_id: str = ""
    values: Mapping[str, str] = field(default_factory=dict)


_DEVICE_LEVELS = {
    TrackState.WAITING: Level.WARN,
    TrackState.INITIALISING: Level.WARN,
    TrackState.TRACKING: Level.OK,
    TrackState.COASTING: Level.ERROR,  # it is measured, and nothing is taken
    TrackState.AMBIGUOUS: Level.WARN,
}
_RSU_LEVELS = {
    RsuState.OK: Level.OK,
    RsuState.SUSPECT: Level.WARN,
    RsuState.EXCLUDED: Level.ERROR,
}


def of_device(
    status: TrackStatus, refused: Refused | None = None, silent_s: float = 0.0
) -> Finding:
    """A device by its newest status; ``silent_s``: for so long nothing was told of it, 0: not
    long."""
    values = {
        "position_sd_m": f"{status.position_sd_m:.3f}",
        "protection_level_m": f"{status.protection_level_m:.3f}",
        "nis": f"{status.nis:.3f}",
        "nis_dof": str(status.nis_dof),
        "accepted": str(status.accepted),
        **_steps(status.steps),
        **{f"rejected: {reason}": str(n) for reason, n in sorted(status.rejected.items())},
    }
    places = [f"{100 * m.weight:.0f} % at ({m.x_m:.1f}, {m.y_m:.1f}) m" for m in status.modes]
    why = ", ".join(places) or status.reason
    state = status.state.name.lower() + (f": {why}" if why else "")
    level = _DEVICE_LEVELS[status.state]
    if silent_s:
        level, state = Level.STALE, f"silent for {silent_s:.0f} s; was {state}"
    poses = status.rejected.get("initialpose", 0)
    if poses:
        state = f"{state}; {poses} initialpose refused: the measurements exclude it"
    words = "" if refused is None else refused.words()
    if refused is not None and words:
        level = Level.ERROR if refused.all_of_it else max(level, Level.WARN)
        state = state if words in state else f"{state}; {words}"
    return Finding(level, status.vue_id, state, status.vue_id, values)


def _steps(steps: StepCalibration) -> dict[str, str]:
    """What of a person's steps is estimated."""
    said = {}
    if steps.length_factor_sd:
        said["step_length_factor"] = f"{steps.length_factor:.3f} +- {steps.length_factor_sd:.3f}"
    if steps.heading_offset_sd_rad:
        offset, sd = steps.heading_offset_rad, steps.heading_offset_sd_rad
        said["step_heading_offset_rad"] = f"{offset:.3f} +- {sd:.3f}"
    return said


def of_network(
    rsu_count: int, descriptions: Mapping[str, str], warnings: Sequence[str] = ()
) -> Finding:
    """All RSUs and the input as a whole; ``descriptions``: refused ones, and why."""
    refused = [f"RsuInfo of {rsu} refused: {fault}" for rsu, fault in sorted(descriptions.items())]
    known = f"{rsu_count} RSUs known" if rsu_count or refused else "no /rsu/info received yet"
    level = Level.WARN if warnings or not rsu_count else Level.OK
    if refused:
        level = Level.WARN if rsu_count else Level.ERROR
    return Finding(level, "rsus", "; ".join([known, *warnings, *refused]))


def of_rsus(
    reports: Iterable[RsuReport],
    refused: Mapping[str, Refused],
    descriptions: Mapping[str, str],
    strangers: Mapping[str, Stranger],
    errors: Mapping[str, RsuErrors] = _NOTHING,
    described: Mapping[str, int] = _NEVER,
) -> list[Finding]:
    """Every RSU heard, or of which something was refused, by name; ``errors``: the newest that is
    learned; ``described``: how many descriptions were refused since start."""
    heard = {report.rsu_id: report for report in reports}
    names = sorted({*heard, *refused, *descriptions, *strangers, *described})
    return [
        _with_errors(
            _of_rsu(
                name,
                heard.get(name),
                refused.get(name),
                descriptions.get(name),
                strangers.get(name),
                described.get(name, 0),
            ),
            errors.get(name),
        )
        for name in names
    ]


def _with_errors(finding: Finding, errors: RsuErrors | None) -> Finding:
    """With what is learned of an RSU; it is no fault."""
    said = errors_in_words(errors) if errors is not None else ""
    if errors is None:
        return finding
    values = dict(finding.values)
    for k, quantity in enumerate(errors.quantities):
        values[f"learned bias: {quantity}"] = f"{errors.bias[k]:.4g} +- {errors.bias_sd[k]:.2g}"
        values[f"learned scatter: {quantity}"] = f"{errors.scatter[k]:.2f}"
        if errors.stretch_sd[k] > 0.0:
            said_of = f"{errors.stretch[k]:.4f} +- {errors.stretch_sd[k]:.2g}"
            values[f"learned stretch: {quantity}"] = said_of
    message = f"{finding.message}; {said}" if said else finding.message
    return replace(finding, message=message, values=values)


def errors_in_words(errors: RsuErrors) -> str:
    """What is learned of the errors of an RSU, a phrase for each quantity that is not as stated:
    "ranges 7.0 % long, 0.12 m long, scatter 3.1 times as stated"; empty where all are."""
    phrases = []
    for quantity, scatter, bias, sd, stretch, stretch_sd in zip(
        errors.quantities,
        errors.scatter,
        errors.bias,
        errors.bias_sd,
        errors.stretch,
        errors.stretch_sd,
        strict=True,
    ):
        faults = []
        if abs(stretch) > max(_BIAS_SDS * stretch_sd, _STRETCH):
            faults.append(f"{100.0 * abs(stretch):.1f} % {'long' if stretch > 0.0 else 'short'}")
        if abs(bias) > _BIAS_SDS * sd:
            faults.append(_off(quantity, bias))
        if not 1.0 / _SCATTER < scatter < _SCATTER:
            faults.append(f"scatter {scatter:.1f} times as stated")
        if faults:
            name = _LENGTHS.get(quantity, quantity.lower())
            phrases.append(f"{name} {', '.join(faults)}")
    return "; ".join(phrases)


def _off(quantity: str, bias: float) -> str:
    if quantity in _LENGTHS:
        return f"{abs(bias):.2f} m {'long' if bias > 0.0 else 'short'}"
    if quantity == "TOA":
        late = "late" if bias > 0.0 else "early"
        return f"{abs(bias) / SPEED_OF_LIGHT_MPS * 1e9:.1f} ns {late}"
    if quantity.startswith("COSINE"):
        return f"off by {bias:.3f}"
    return f"off by {math.degrees(bias):.1f} deg"


def _of_rsu(
    name: str,
    report: RsuReport | None,
    refused: Refused | None,
    fault: str | None,
    stranger: Stranger | None,
    described: int,
) -> Finding:
    level, said, values = Level.OK, [], {}
    if report is not None:
        level, values = _RSU_LEVELS[report.state], _figures(report)
    if described:
        values = {**values, "refused: RsuInfo": str(described)}
    if fault is not None:
        level = Level.ERROR
        said.append(f"RsuInfo refused: {fault}")
    if stranger is not None:
        level = Level.ERROR
        said.append(stranger.words())
    if refused is not None:
        values |= {f"refused: {reason}": str(n) for reason, n in sorted(refused.counts.items())}
        if refused.words():
            level = Level.ERROR if refused.all_of_it else max(level, Level.WARN)
            said.append(refused.words())
    heard = stranger is None and not (said and report is not None and report.state is RsuState.OK)
    if report is not None and heard:
        said.append(report.text)
    return Finding(level, f"rsu {name}", "; ".join(said) or "ok", name, values)


def _figures(report: RsuReport) -> dict[str, str]:
    return {
        "age_s": f"{report.age_s:.1f}",
        "rate_hz": f"{report.rate_hz:.1f}",
        "accept_ratio": f"{report.accept_ratio:.2f}",
        "measurements": str(report.measurements),
        **{f"innovation: {k}": f"{v:.4g}" for k, v in sorted(report.mean_innovation.items())},
        **{f"innovation / sd: {k}": f"{v:.2f}" for k, v in sorted(report.mean_normalised.items())},
    }
