"""What one filter form is: the record that every module of this folder fills in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from netpos.estimation.compile import inlined
from netpos.estimation.dispatch import Kernel
from netpos.messages.values import Array


@inlined
def copy_matrix(source: Array, target: Array) -> None:
    """Write ``source`` (n, m) to ``target`` (n, m); an assignment would need memory of its own
    where the two may overlap."""
    for a in range(source.shape[0]):
        for b in range(source.shape[1]):
            target[a, b] = source[a, b]


@dataclass(frozen=True, slots=True, kw_only=True)
class FilterForm:
    """One way to carry a Gaussian from epoch to epoch. Everything works in place.

    A form carries mean (n,) and, as ``cov_or_sqrt`` (n, n), the covariance or what it has in its
    place.

    predict : ``(mean, cov_or_sqrt, dt, motion, bias)`` moves by dt seconds; nothing happens for
        dt <= 0. bias (2, k): stationary sd and time constant of each bias state
    update : ``(mean, cov_or_sqrt, rows, options, gate_nis, accepted, work)`` gates each group of
        ``rows`` (m, ROW_WIDTH) by ``gate_nis``, fuses what passes and returns the NIS of the rows
        fused and their number. ``options`` is ``engine.FilterOptions``, ``accepted`` (groups,) is
        filled with 0 or 1, ``work`` is of ``update.fusion.workspace``.

    The three that follow are None where the form carries the covariance itself.

    add_velocity_step : ``(sd, time_s, position_sd, cov_or_sqrt)`` as
        ``motion.add_velocity_step``
    write_cov : ``(cov_or_sqrt, cov)`` writes the covariance to cov (n, n)
    write_cov_or_sqrt : ``(cov, cov_or_sqrt)``, the other way
    """

    name: str
    """The word for the parameter ``filter``."""
    predict: Kernel
    update: Kernel
    add_velocity_step: Kernel | None = None
    write_cov: Kernel | None = None
    write_cov_or_sqrt: Kernel | None = None
    update_shared: Kernel | None = None
    """``kf.update`` of a linear form, which can say what of a covariance its own rows made;
    None: the form is not linear."""
    summary: str = ""
    """What the parameter's description says beside the name."""
    iterations: int = 1
    """Linearisations of one update at most."""
    parameters: Mapping[str, Any] = field(default_factory=dict)
    """Tracker parameters that this module declares: name and ``common.parameters`` field. Their
    values are ``FilterOptions.of_form``, in this order."""
    is_extended: bool = False
    """It is an extended Kalman filter, as the error-state filter of a strapdown track is."""
    follows_manoeuvres: bool = False
    """It needs no component for a manoeuvre that nobody has noticed."""

    @property
    def carries_cov(self) -> bool:
        """Whether ``cov_or_sqrt`` is the covariance."""
        return self.write_cov is None
