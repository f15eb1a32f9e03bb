"""The columns of a measurement row.

A row is a float vector of ``ROW_WIDTH`` entries, so that an epoch of any mixture of sensors is one
array a compiled kernel can take:

    KIND, VALUE, VARIANCE (for the update), GATE_VARIANCE (of a single value: smaller where
    successive errors are correlated),
    BIAS, COMMON (state indices of the biases in it, or -1), GROUP (rows of one group are accepted
    or rejected together),
    ORIGIN 3 (RSU position, m), AXES 9 (rotation map -> RSU axes, row-major),
    HEADING (state index of the device's heading, or -1), LEVER 3 (of the antenna in the device, m;
    forward and left count only where there is a heading), BLOCKED (probability that the path was
    blocked; 0: the option's), HEIGHT (state index of the device's height over the nominal one; 0:
    the height is known), REFERENCE (state index of the bias that is subtracted, that of the RSU a
    difference counts from; 0: none), SAME_BEND (how many more values of its RSU have the
    same bend, which is what linearising leaves out, while the device stays), OUTLIER_SHARE (how
    many of the values of its RSU are outliers; 0: as many as of others)

A sensor may keep other figures in ORIGIN and AXES; its module says which.
"""

from __future__ import annotations

from netpos.estimation.compile import inlined
from netpos.messages.values import Array

KIND, VALUE, VARIANCE, GATE_VARIANCE, BIAS, COMMON, GROUP, ORIGIN = range(8)
AXES = 10
HEADING, LEVER, BLOCKED, HEIGHT, REFERENCE, SAME_BEND, OUTLIER_SHARE = 19, 20, 23, 24, 25, 26, 27
ROW_WIDTH = 28


@inlined
def group_count(rows: Array) -> int:
    """Number of groups of ``rows`` (m, ROW_WIDTH), m > 0, numbered 0, 1, ... in their order."""
    return int(rows[rows.shape[0] - 1, GROUP]) + 1


@inlined
def group_end(rows: Array, start: int) -> int:
    """Index after the last row of the group that begins at ``start``."""
    stop = start + 1
    while stop < rows.shape[0] and rows[stop, GROUP] == rows[start, GROUP]:
        stop += 1
    return stop
