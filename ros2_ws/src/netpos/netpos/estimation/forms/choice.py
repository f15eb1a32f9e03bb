"""The compiled choice among the forms, by their number. Everything works in place."""

from __future__ import annotations

import math

from netpos.estimation.compile import inlined
from netpos.estimation.dispatch import Kernel, choose
from netpos.estimation.forms.form import copy_matrix
from netpos.estimation.forms.table import FORMS
from netpos.estimation.motion import add_velocity_step as add_to_cov
from netpos.messages.values import Array


@inlined
def _no_predict(_mean: Array, _P: Array, _dt: float, _motion: Array, _bias: Array) -> None:
    return


@inlined
def _no_update(
    _mean: Array,
    _P: Array,
    _rows: Array,
    _options: object,
    _gate_nis: Array,
    _accepted: Array,
    _work: Array,
) -> tuple[float, int]:
    return math.nan, 0


def _chosen(name: str, otherwise: Kernel) -> Kernel:
    return choose([(k, getattr(form, name)) for k, form in enumerate(FORMS)], otherwise)


predict = _chosen("predict", _no_predict)
"""``(number, mean, cov_or_sqrt, dt, motion, bias)``"""
update = _chosen("update", _no_update)
"""``(number, mean, cov_or_sqrt, rows, options, gate_nis, accepted, work)``"""
add_velocity_step = _chosen("add_velocity_step", add_to_cov)
"""``(number, sd, time_s, position_sd, cov_or_sqrt)``"""
write_cov = _chosen("write_cov", copy_matrix)
"""``(number, cov_or_sqrt, cov)``"""
write_cov_or_sqrt = _chosen("write_cov_or_sqrt", copy_matrix)
"""``(number, cov, cov_or_sqrt)``"""
