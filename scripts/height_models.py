"""Compare models of an unknown height on the drone of ``uwb_tdoa``: a plain extended Kalman filter
with constant horizontal velocity, and the height as a first-order Gauss-Markov process or with a
constant vertical velocity."""

from __future__ import annotations

import argparse
import csv
import gzip
import math
import os
import sys
from pathlib import Path

import numpy as np
from netpos.messages.values import Array
from real_data_readers import TDOA_ANCHORS_M

NOISE_SD_M, ACCEL_DENSITY, GATE_NIS, SKIP_S = 0.11, 0.5, 15.0, 5.0
MEAN_M = 1.4
Model = tuple[str, float, float]
"""Name; Gauss-Markov: sd [m] and time constant [s]; constant velocity: density, and 0."""
MODELS: tuple[Model, ...] = (
    ("constant velocity", 0.25, 0.0),
    ("constant velocity", 0.5, 0.0),
    ("constant velocity", 1.0, 0.0),
    ("Gauss-Markov", 1.0, 3.0),
    ("Gauss-Markov", 1.0, 10.0),
    ("Gauss-Markov", 1.0, 30.0),
    ("Gauss-Markov", 2.0, 30.0),
    ("Gauss-Markov", 1.0, 100.0),
)


def read(file: Path) -> tuple[Array, Array]:
    """Measurements (n, 4), idA, idB, difference m, time s, and truth (k, 4), x, y, z m, time s."""
    with gzip.open(file, "rt", encoding="utf-8") as lines:
        rows = list(csv.reader(lines))[1:]
    table = np.array([[float(cell) if cell else math.nan for cell in row] for row in rows])
    return table[np.isfinite(table[:, 2]), :4], table[np.isfinite(table[:, 7]), 4:8]


def transition(model: Model, dt: float) -> tuple[Array, Array]:
    """F and Q of x, y, vx, vy, the height over its mean and its rate."""
    name, size, tau_s = model
    F, Q = np.eye(6), np.zeros((6, 6))
    walk = np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])
    for p, v in ((0, 2), (1, 3)):
        F[p, v], Q[np.ix_([p, v], [p, v])] = dt, ACCEL_DENSITY**2 * walk
    if name == "Gauss-Markov":
        F[4, 4] = keep = math.exp(-dt / tau_s)
        Q[4, 4] = size**2 * (1.0 - keep**2)
    else:
        F[4, 5], Q[4:, 4:] = dt, size**2 * walk
    return F, Q


def track(measured: Array, model: Model) -> Array:
    """Time, x, y and height (n, 4) after each measurement."""
    x, P, last = np.zeros(6), np.diag([4.0, 4.0, 1.0, 1.0, 1.0, 1.0]), float(measured[0, 3])
    found = np.empty((len(measured), 4))
    for k, (a, b, value, t) in enumerate(measured.tolist()):
        F, Q = transition(model, t - last)
        x, P, last = F @ x, F @ P @ F.T + Q, t
        place = x[[0, 1, 4]] + [0.0, 0.0, MEAN_M]
        to, other = place - TDOA_ANCHORS_M[int(b)], place - TDOA_ANCHORS_M[int(a)]
        h = np.zeros(6)
        h[[0, 1, 4]] = to / np.linalg.norm(to) - other / np.linalg.norm(other)
        S = h @ P @ h + NOISE_SD_M**2
        left = value - float(np.linalg.norm(to) - np.linalg.norm(other))
        if left * left <= GATE_NIS * S or t < measured[0, 3] + 2.0:
            K = P @ h / S
            x, P = x + K * left, P - np.outer(K, h @ P)
        found[k] = t, x[0], x[1], x[4] + MEAN_M
    return found


def main(arguments: list[str] | None = None) -> int:
    """Print a table; 1 where the recording is not there."""
    root = Path(__file__).resolve().parents[1]
    usual = Path(os.environ.get("NETPOS_DATA", root.parent / "shared" / "data"))
    parser = argparse.ArgumentParser(description="Compare models of an unknown height.")
    parser.add_argument("--data", type=Path, default=usual, help="folder of the recordings")
    file = parser.parse_args(arguments).data / "uwb_tdoa" / "const1_trial1_tdoa2.csv.gz"
    if not file.exists():
        sys.stderr.write(f"netpos: {file} does not exist; name the folder with --data\n")
        return 1
    measured, truth = read(file)
    print("| height | sd or density | time, s | horizontal, m | vertical, mean, m | its sd, m |")
    print("|---|---|---|---|---|---|")
    for model in MODELS:
        found = track(measured, model)
        scored = found[(found[:, 0] > found[0, 0] + SKIP_S) & (found[:, 0] < truth[-1, 3])]
        true = np.array([np.interp(scored[:, 0], truth[:, 3], truth[:, i]) for i in range(3)]).T
        off = scored[:, 1:] - true
        flat = math.sqrt(float(np.mean(np.square(off[:, :2]).sum(axis=1))))
        up = off[:, 2]
        name, size, tau_s = model
        time = f"{tau_s:g}" if tau_s else "–"
        print(f"| {name} | {size:g} | {time} | {flat:.4f} | {up.mean():.3f} | {up.std():.3f} |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
