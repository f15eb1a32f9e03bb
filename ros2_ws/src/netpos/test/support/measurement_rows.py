"""Random RSUs, states and rows, and what they measure by SciPy, for the tests of the filters."""

from __future__ import annotations

import numpy as np
from filter_rows import row
from netpos.estimation.measurement import AXES, COMMON, HEADING, KIND, LEVER, ORIGIN, Kind
from netpos.estimation.rows import rsu_axes
from netpos.estimation.sensors.table import SENSORS
from netpos.estimation.state import POSITION, X
from netpos.messages.values import AngleConvention, Array, RsuInfo
from scipy.spatial.transform import Rotation

PLANAR = [Kind(s.kind) for s in SENSORS if s.of_offset or s.of_state]
SPATIAL = [Kind(s.kind) for s in SENSORS if s.of_offset or s.of_antenna or s.of_navigation]


def random_info(rng: np.random.Generator, convention: AngleConvention) -> RsuInfo:
    return RsuInfo(
        rsu_id="r",
        position=rng.uniform(-20, 20, 3),
        quaternion=Rotation.random(random_state=int(rng.integers(1 << 30))).as_quat(),
        angle_convention=convention,
    )


def random_state(rng: np.random.Generator, n: int = 9) -> Array:
    scale = np.array([40.0, 40.0, 8.0, 8.0, 100.0, 5.0, *([0.5] * (n - 6))])
    return rng.normal(size=n) * scale


def random_row(rng: np.random.Generator, kind: Kind, heading: int = -1) -> Array:
    """A row of an RSU with tilted axes (LINEAR: random H), own bias 6, common bias 8, and the
    device's antenna off its centre, which counts sideways only with a heading."""
    info = random_info(rng, AngleConvention.SPHERICAL)
    lever_arm = rng.uniform(-2, 2, 3)
    out = row(kind, 0.3, 1.0, 0, info.position, axes=rsu_axes(info), bias=6, lever_arm=lever_arm)
    out[COMMON], out[HEADING] = 8, heading
    return out


def closed_form(row: Array, x: Array, height_m: float) -> float:
    """h written with SciPy and NumPy only."""
    if row[KIND] == Kind.STEP_VELOCITY:
        turn = Rotation.from_euler("z", x[8])
        reported = turn.inv().apply([x[X.VX], x[X.VY], 0.0])[:2] / np.exp(x[6])
        return float(row[ORIGIN + 2 : ORIGIN + 4] @ reported)
    antenna = np.append(x[POSITION], height_m + row[LEVER + 2])
    if row[HEADING] >= 0:
        turn = Rotation.from_euler("z", x[int(row[HEADING])])
        antenna += turn.apply([row[LEVER], row[LEVER + 1], 0.0])
    d = antenna - row[ORIGIN:AXES]
    ux, uy, uz = Rotation.from_matrix(row[AXES:HEADING].reshape(3, 3)).apply(d)
    r = float(np.linalg.norm(d))
    value = {
        Kind.AZIMUTH: lambda: np.arctan2(uy, ux),
        Kind.ELEVATION: lambda: np.arcsin(uz / r),
        Kind.TOA: lambda: r + x[X.CLOCK],
        Kind.RANGE: lambda: r,
        Kind.LINEAR: lambda: row[ORIGIN : ORIGIN + 6] @ [*antenna[:2], *x[2:6]],
        Kind.SPEED: lambda: abs(complex(x[X.VX], x[X.VY])),
        Kind.COSINE_Y: lambda: uy / r,
        Kind.COSINE_Z: lambda: uz / r,
        Kind.PHASE: lambda: ux / r,  # an array of one radian along the x axis
        Kind.UNWRAPPED_PHASE: lambda: ux / r,
        Kind.TDOA: lambda: r - float(np.linalg.norm(d - row[AXES : AXES + 3])),  # reference: there
    }[Kind(int(row[KIND]))]()
    return float(value) + x[6] + x[8]
