"""Unscented Kalman filter: the square-root form with a covariance at its edges (decision 0136)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from netpos.estimation.compile import kernel, spliced
from netpos.estimation.factor import factor
from netpos.estimation.forms import srukf
from netpos.estimation.forms.form import FilterForm
from netpos.messages.values import Array

if TYPE_CHECKING:
    from netpos.estimation.engine import FilterOptions


@kernel
def predict(mean: Array, cov: Array, dt: float, motion: Array, bias: Array) -> None:
    """``srukf.predict`` of a covariance (n, n)."""
    if dt > 0.0:
        L = factor(cov)
        srukf.predict(mean, L, dt, motion, bias)
        srukf.write_cov(L, cov)


@kernel
def update(
    mean: Array, cov: Array, rows: Array, height_m: float, gate_nis: Array, accepted: Array
) -> tuple[float, int]:
    """``srukf.update`` of a covariance (n, n)."""
    L = factor(cov)
    nis, used = srukf.update(mean, L, rows, height_m, gate_nis, accepted)
    if used > 0:
        srukf.write_cov(L, cov)
    return nis, used


@spliced
def _update_form(
    mean: Array,
    cov: Array,
    rows: Array,
    options: FilterOptions,
    gate_nis: Array,
    accepted: Array,
    _work: Array,
) -> tuple[float, int]:
    nis, used = update(mean, cov, rows, options.height_m, gate_nis, accepted)
    return nis, used


FORM = FilterForm(name="ukf", predict=predict, update=_update_form)
