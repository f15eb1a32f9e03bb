"""What other detectors would find of foot contacts: python scripts/contact_trials.py [FOLDER].

Every line says how many of the timed contacts of a recording at the waist are found, how many
detections are false, how many fall to contacts without a time; see docs/decisions/0021.

``rhythm`` is another principle than that of ``StepConfig.waist``: a template of 0.6 s of all axes
and of the jerk, learned by ridge regression for one foot and mirrored for the other, gives a score
of each foot; the most probable sequence of contacts is found by dynamic programming over their
times, with a cost for the same foot twice in a row and for unusual intervals. It looks into the
future and is told where the bouts are, which a detector is not.
"""

from __future__ import annotations

import itertools
import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import scipy.io
from netpos.evaluation.pedestrian import score_contacts
from netpos.inertial.loaders import WaistRecord, load_waist_imu
from netpos.inertial.steps import StepConfig, StepDetector
from scipy.ndimage import gaussian_filter1d
from scipy.signal import butter, sosfiltfilt

NAMES = ("HA_001", "HA_002")
CELL_S = 0.02
MIRROR = np.array([1, -1, 1, -1, 1, -1, 1.0])  # forward, left, up, roll, pitch, yaw, jerk
HALF_CELLS, RIDGE, BUMP_SD_S, ROUND_S = 15, 0.1, 0.05, 0.5
SHORTEST_S, LONGEST_S, TYPICAL_S = 0.3, 2.6, 0.65
SAME_FOOT, UNUSUAL = 0.1, 0.05


@dataclass(frozen=True)
class Walk:
    """A recording on cells of 20 ms: times (n,) s, channels (n, 7), whether inside a bout (n,),
    contact times of the left and the right foot."""

    record: WaistRecord
    times_s: np.ndarray
    channels: np.ndarray
    inside: np.ndarray
    left_s: np.ndarray
    right_s: np.ndarray

    def score(self, detected_ns: np.ndarray) -> str:
        """Of detections (n,)."""
        s = score_contacts(detected_ns, self.record.bouts)
        return f"{s.found} of {s.listed} found, {s.false} false, {s.unlisted} untimed"


def walk_of(path: Path) -> Walk:
    record = load_waist_imu(path)
    seconds = record.imu.stamp_ns * 1e-9
    times = np.arange(seconds[0], seconds[-1], CELL_S)
    raw = np.column_stack([record.imu.specific_force, record.imu.angular_velocity])
    band = butter(2, [0.5, 20.0], "band", fs=1 / np.median(np.diff(seconds)), output="sos")
    smooth = sosfiltfilt(band, raw, axis=0)
    channels = np.column_stack([np.interp(times, seconds, axis) for axis in smooth.T])
    force = np.column_stack([np.interp(times, seconds, axis) for axis in raw.T[:3]])
    jerk = np.linalg.norm(np.diff(force, axis=0, prepend=force[:1]), axis=1) / CELL_S
    strength = np.log(gaussian_filter1d(jerk, 2.5) + 2.0)
    channels = np.column_stack([channels, strength - np.median(strength)])
    inside = np.zeros(len(times), dtype=bool)
    for bout in record.bouts:
        ends = bout.initial_contact_ns[[0, -1]] * 1e-9
        inside |= (times > ends[0] - ROUND_S) & (times < ends[1] + ROUND_S)
    trial = scipy.io.loadmat(path, simplify_cells=True)["data"]["TimeMeasure1"]["Test11"]["Trial1"]
    feet: dict[str, list[float]] = {"L": [], "R": []}
    for bout in trial["Standards"]["INDIP"]["MicroWB"]:
        contacts = np.atleast_1d(bout["InitialContact_Event"])
        for time, foot in zip(
            contacts, np.atleast_1d(bout["InitialContact_LeftRight"]), strict=True
        ):
            feet[str(foot)[0]].append(float(time))
    left, right = (np.array([t for t in feet[foot] if np.isfinite(t)]) for foot in "LR")
    scale = channels[inside].std(axis=0)
    return Walk(record, times, channels / scale, inside, left, right)


def windows(walk: Walk) -> tuple[np.ndarray, np.ndarray]:
    """What is round every cell, as it is and mirrored: (n, features) each."""
    n = len(walk.times_s)
    padded = np.pad(walk.channels, ((HALF_CELLS, HALF_CELLS), (0, 0)))
    around = np.stack([padded[i : i + n] for i in range(0, 2 * HALF_CELLS + 1, 2)], axis=1)
    return around.reshape(n, -1), (around * MIRROR).reshape(n, -1)


def learn(walk: Walk) -> tuple[np.ndarray, float]:
    """Weights (features,) and offset of the score of a left contact."""
    plain, mirrored = windows(walk)
    A = np.vstack([plain[walk.inside], mirrored[walk.inside]])
    bumps = [
        np.exp(-0.5 * ((walk.times_s[:, None] - feet) / BUMP_SD_S) ** 2).max(axis=1)[walk.inside]
        for feet in (walk.left_s, walk.right_s)
    ]
    y = np.concatenate(bumps)
    gram = A.T @ A + RIDGE * len(A) * np.eye(A.shape[1])
    return np.linalg.solve(gram, A.T @ (y - y.mean())), float(y.mean())


def decode(times_s: np.ndarray, scores: np.ndarray, threshold: float) -> list[float]:
    """Times of the best sequence of contacts; scores (2, n) of left and right."""
    lags = np.arange(round(SHORTEST_S / CELL_S), round(LONGEST_S / CELL_S) + 1)
    interval = -UNUSUAL * np.abs(np.log(lags * CELL_S / TYPICAL_S))
    n = len(times_s)
    value, before = np.full((2, n), -np.inf), np.full((2, n, 2), -1)
    for i, foot in itertools.product(range(n), range(2)):
        best = 0.0
        earlier = i - lags[lags <= i]
        for other in range(2 if len(earlier) else 0):
            gain = value[other, earlier] + interval[: len(earlier)] - SAME_FOOT * (other == foot)
            k = int(np.argmax(gain))
            if gain[k] > best:
                best, before[foot, i] = float(gain[k]), (other, earlier[k])
        value[foot, i] = scores[foot, i] - threshold + best
    foot, i = np.unravel_index(np.argmax(value), value.shape)
    detected_s = []
    while i >= 0:
        detected_s.append(float(times_s[i]))
        foot, i = before[foot, i]
    return detected_s[::-1]


def rhythm(walk: Walk, model: tuple[np.ndarray, float], threshold: float) -> np.ndarray:
    """Contacts (n,) ns by ``learn``'s model, bout by bout."""
    scores = np.stack([window @ model[0] + model[1] for window in windows(walk)])
    detected_s: list[float] = []
    for bout in walk.record.bouts:
        first, last = bout.initial_contact_ns[[0, -1]] * 1e-9
        use = (walk.times_s > first - 0.6) & (walk.times_s < last + 0.6)
        detected_s += decode(walk.times_s[use], scores[:, use], threshold)
    return np.rint(np.array(detected_s) * 1e9).astype(np.int64)


def detected(walk: Walk, config: StepConfig) -> np.ndarray:
    """Contacts (n,) ns of the detector in use."""
    detector, imu = StepDetector(config), walk.record.imu
    forces = zip(imu.stamp_ns.tolist(), imu.specific_force.tolist(), strict=True)
    return np.array([s.end_ns for stamp, force in forces for s in detector.add(stamp, force)])


def loosened(walks: dict[str, Walk]) -> None:
    """The detector in use under other thresholds, and the best for one recording on the other."""
    waist = StepConfig.waist()
    grid = itertools.product((4.0, 6.0, 8.0), (0.2, 0.3, 0.4), (3.0, 4.0, 5.0, 6.0))
    configs = [
        replace(waist, min_prominence=p, prominence_fraction=f, min_impact_hz=hz)
        for p, f, hz in grid
    ]
    detections = {
        name: [(detected(walk, config), config) for config in configs]
        for name, walk in walks.items()
    }
    for name, walk in walks.items():
        for ends, c in detections[name]:
            if c.min_impact_hz == waist.min_impact_hz:
                what = f"{c.min_prominence:g} m/s^3, fraction {c.prominence_fraction:g}"
                print(f"in use, {what}: {name}: {walk.score(ends)}")
    for train, test in (NAMES, NAMES[::-1]):

        def merit(index: int, walk: Walk = walks[train], name: str = train) -> int:
            s = score_contacts(detections[name][index][0], walk.record.bouts)
            return s.found - s.false

        best = max(range(len(configs)), key=merit)
        print(f"in use, best of {len(configs)} for {train}: {test}: ", end="")
        print(walks[test].score(detections[test][best][0]))


def main() -> None:
    """Print the lines; exit 1 where a recording is absent."""
    default = Path(__file__).resolve().parents[1].parent / "shared" / "data"
    data = Path(sys.argv[1] if len(sys.argv) > 1 else os.environ.get("NETPOS_DATA", default))
    try:
        walks = {name: walk_of(data / f"waist_imu/{name}/data.mat") for name in NAMES}
    except FileNotFoundError as error:
        sys.exit(f"netpos: {error}")
    loosened(walks)
    for train, test in (NAMES, NAMES[::-1]):
        model = learn(walks[train])
        for threshold in (0.1, 0.15, 0.2, 0.25, 0.3):
            ends = rhythm(walks[test], model, threshold)
            print(f"rhythm learned on {train}, {threshold:g}: {test}: {walks[test].score(ends)}")


if __name__ == "__main__":
    main()
