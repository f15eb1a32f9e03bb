"""Accepting or rejecting the rows of one epoch by group, from a given innovation covariance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from netpos.estimation.compile import kernel, leaf
from netpos.estimation.measurement import GROUP
from netpos.estimation.sensors.row import group_count, group_end
from netpos.estimation.update.fit import distance2
from netpos.messages.values import Array

Indices = NDArray[np.int64]


@kernel
def gate_groups(
    rows: Array, innovation: Array, S: Array, gate_nis: Array, accepted: Array
) -> None:
    """Fill ``accepted`` (groups,) with 1 where a group's squared Mahalanobis distance is within
    its limit, else 0.

    rows : (m, ROW_WIDTH), rows of a group adjacent
    innovation, S : (m,), (m, m), with the gate variances
    gate_nis : (d + 1,) largest accepted distance for d degrees of freedom; the last entry serves
        all larger groups
    """
    start = 0
    while start < rows.shape[0]:
        group, stop = rows[start, GROUP], group_end(rows, start)
        distance = distance2(S[start:stop, start:stop].copy(), innovation[start:stop].copy())
        limit = gate_nis[min(stop - start, gate_nis.size - 1)]
        accepted[int(group)] = 1.0 if distance <= limit else 0.0
        start = stop


@kernel
def accepted_rows(rows: Array, accepted: Array) -> Indices:
    """Indices of the rows whose group is accepted, (used,)."""
    index = np.empty(rows.shape[0], np.int64)
    used = 0
    for i in range(rows.shape[0]):
        if accepted[int(rows[i, GROUP])] == 1.0:
            index[used] = i
            used += 1
    return index[:used]


@leaf
def fail_together(nis: float, used: int, gate_nis: Array) -> bool:
    """Whether ``used`` rows, accepted one by one, are farther off together (``nis``) than their
    limit; more rows than ``gate_nis`` has limits for are not judged together."""
    return bool(used < gate_nis.size and nis > gate_nis[used])


@kernel
def select_rows(
    rows: Array, innovation: Array, S: Array, gate_nis: Array, accepted: Array
) -> tuple[Indices, float]:
    """Indices of the rows to fuse, (used,), and their squared Mahalanobis distance together.

    Where three or more groups pass one by one but not together, a minority without which the
    others agree is left out, and its entries of ``accepted`` set to 0. Arguments as of
    ``gate_groups``.
    """
    index = accepted_rows(rows, accepted)
    nis = joint_nis(innovation, S, index)
    contradict = fail_together(nis, index.size, gate_nis)
    if contradict and leave_minority_out(rows, innovation, S, gate_nis, accepted):
        index = accepted_rows(rows, accepted)
        nis = joint_nis(innovation, S, index)
    return index, nis


@kernel
def leave_minority_out(
    rows: Array, innovation: Array, S: Array, gate_nis: Array, accepted: Array
) -> bool:
    """Of the accepted groups, take out one after the other, always that without which the rest
    agree best, until they do, but fewer than half of them; False, and nothing done, where that
    does not bring them within their limit."""
    groups = group_count(rows)
    before = accepted[:groups].copy()
    for _ in range((int(before.sum()) - 1) // 2):
        odd, least, limit = -1, np.inf, 0.0
        for group in range(groups):
            if accepted[group] == 0.0:
                continue
            accepted[group] = 0.0
            index = accepted_rows(rows, accepted)
            accepted[group] = 1.0
            nis = joint_nis(innovation, S, index)
            if nis - gate_nis[index.size] < least - limit:
                odd, least, limit = group, nis, gate_nis[index.size]
        if odd < 0:
            break
        accepted[odd] = 0.0
        if least <= limit:
            return True
    accepted[:groups] = before
    return False


@kernel
def joint_nis(innovation: Array, S: Array, index: Indices) -> float:
    """Squared Mahalanobis distance of the rows ``index`` (used,) together."""
    block = np.empty((index.size, index.size))
    for i in range(index.size):
        for j in range(index.size):
            block[i, j] = S[index[i], index[j]]
    return float(distance2(block, innovation[index]))
