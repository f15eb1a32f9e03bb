"""A scenario under several settings: the same seeds for each, figures as one tidy table."""

from __future__ import annotations

import importlib.util
import itertools
import tempfile
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.stats import bootstrap

from netpos.common.files import whole_file
from netpos.evaluation.evaluate import evaluate_bag
from netpos.evaluation.metrics import SKIP_EPOCHS
from netpos.evaluation.pictures import TRACK_COLOURS
from netpos.evaluation.work import Work
from netpos.messages.values import Array
from netpos.scenario import Scenario, load_scenario
from netpos.scenario.offline import simulate_to_bag
from netpos.scenario.replay import replay_bag
from netpos.scenario.settings import settings_from
from netpos.tracking.config import TrackerConfig

TABLES = (".csv", ".parquet")
CONFIDENCE = 0.95
_DRAWS = 2000


@dataclass(frozen=True, slots=True)
class Plan:
    """A scenario (name or file) and the values of each key to vary: ``devices.0.speed_mps``,
    ``tracker.hold_s``. Every combination of the values is a setting."""

    scenario: str
    values: Mapping[str, tuple[object, ...]]
    skip: int = SKIP_EPOCHS

    @property
    def settings(self) -> list[dict[str, object]]:
        """Every combination, the last key varying fastest."""
        return [
            dict(zip(self.values, chosen, strict=True))
            for chosen in itertools.product(*self.values.values())
        ]

    def load(self, setting: Mapping[str, object], seed: int | None = None) -> Scenario:
        """The scenario under a setting.

        Raises ``ValueError`` naming what is wrong with the scenario, the key or the value.
        """
        scenario = load_scenario(self.scenario, seed, setting)
        TrackerConfig.from_mapping(scenario.tracker)
        return scenario


def sweep(plan: Plan, work: Work) -> pd.DataFrame:
    """Run every setting with every seed of ``work``: a row for each setting, seed and device.

    Columns: the keys, ``seed``, ``vue``, and the figures of ``netpos evaluate`` that are numbers.

    Raises
    ------
    ValueError  a key or a value that the scenario cannot have, before anything is run
    """
    settings = plan.settings
    for setting in settings:
        plan.load(setting)
    seeds = range(work.seed, work.seed + work.runs)
    parts = [((index, seed),) for index in range(len(settings)) for seed in seeds]
    rows = itertools.chain.from_iterable(work.over("runs", _run, plan, parts))
    return pd.DataFrame(list(rows))


def _run(plan: Plan, part: tuple[tuple[int, int]]) -> list[dict[str, Any]]:
    """Simulate, track and score one setting with one seed."""
    ((index, seed),) = part
    setting = plan.settings[index]
    scenario = plan.load(setting, seed)
    with tempfile.TemporaryDirectory(prefix="netpos_sweep_") as folder:
        simulated, tracked = Path(folder) / "simulated", Path(folder) / "tracked"
        simulate_to_bag(scenario, simulated)
        replay_bag(simulated, tracked, settings=settings_from(str(simulated)))
        evaluation = evaluate_bag(tracked, skip=plan.skip)
    return [
        {**setting, "seed": seed, "vue": vue, **_numbers(figures.to_json())}
        for vue, figures in evaluation.columns().items()
    ]


def _numbers(figures: Mapping[str, Any]) -> dict[str, Any]:
    """Figures that are one number each; those of the start of a run under their own names."""
    flat = {**figures, **figures["initial"]}
    return {k: v for k, v in flat.items() if v is None or isinstance(v, int | float)}


@dataclass(frozen=True, slots=True, kw_only=True)
class Mean:
    """Of one setting: runs with a figure, those without, the mean of the figure and where it lies
    with 95 % probability (bootstrap over the runs)."""

    setting: dict[str, object]
    runs: int
    without: int
    mean: float | None
    interval: tuple[float, float] | None
    lost_tracks: int


def means(table: pd.DataFrame, keys: Sequence[str], figure: str) -> list[Mean]:
    """The mean of ``figure`` for each setting, in the order of the table.

    Raises ``ValueError`` for a figure that the table has not.
    """
    if figure not in table:
        known = ", ".join(sorted(set(table.columns) - {*keys, "seed", "vue"}))
        raise ValueError(f"no figure {figure!r}; known: {known}")
    cells = []
    for values, rows in table.groupby(list(keys), sort=False, dropna=False):
        of_it = pd.to_numeric(rows[figure]).dropna().to_numpy(dtype=np.float64)
        cells.append(
            Mean(
                setting=dict(zip(keys, values, strict=True)),
                runs=len(of_it),
                without=len(rows) - len(of_it),
                mean=float(of_it.mean()) if of_it.size else None,
                interval=_interval(of_it),
                lost_tracks=int(pd.to_numeric(rows["lost_tracks"]).sum()),
            )
        )
    return cells


def _interval(values: Array) -> tuple[float, float] | None:
    if values.size < 2:
        return None
    result = bootstrap(
        (values,), np.mean, n_resamples=_DRAWS, confidence_level=CONFIDENCE,
        method="percentile", rng=np.random.default_rng(0),
    )  # fmt: skip
    return float(result.confidence_interval.low), float(result.confidence_interval.high)


def draw_sweep(rows: Sequence[Mean], figure: str) -> Figure:
    """The figure against the first key, a line for each combination of the other keys, with
    intervals; settings without a figure are left out."""
    first = next(iter(rows[0].setting))
    values = list(dict.fromkeys(mean.setting[first] for mean in rows))
    numbers = all(isinstance(value, int | float) for value in values)
    places: dict[object, Any] = dict(
        zip(values, values if numbers else range(len(values)), strict=True)
    )
    lines: dict[str, list[Mean]] = defaultdict(list)
    for mean in rows:
        others = [f"{key} {value}" for key, value in mean.setting.items() if key != first]
        if mean.mean is not None:
            lines[", ".join(others)].append(mean)
    picture = Figure(figsize=(7.0, 4.5), layout="constrained")
    axes = picture.subplots()
    for index, (label, line) in enumerate(lines.items()):
        y = np.array([mean.mean for mean in line], dtype=np.float64)
        ends = np.array([mean.interval or (mean.mean, mean.mean) for mean in line])
        axes.errorbar(
            [places[mean.setting[first]] for mean in line],
            y,
            np.abs(ends - y[:, None]).T,
            color=TRACK_COLOURS[index % len(TRACK_COLOURS)],
            label=label or None,
            marker="o",
            capsize=3,
        )
    if not numbers:
        axes.set_xticks(range(len(values)), [str(value) for value in values])
    axes.set_xlabel(first)
    axes.set_ylabel(figure)
    axes.set_ylim(bottom=0.0)
    axes.grid(alpha=0.3)
    if len(lines) > 1:
        axes.legend()
    return picture


def check_table(path: Path) -> None:
    """Make sure, before the work starts, that a table can be written to ``path``.

    Raises
    ------
    ValueError  another kind of file, or Parquet where pyarrow is not installed
    """
    if path.suffix not in TABLES:
        raise ValueError(f"{path}: a table is a {' or a '.join(TABLES)} file")
    if path.suffix == ".parquet" and importlib.util.find_spec("pyarrow") is None:
        raise ValueError(f"{path} needs pyarrow: pip install 'netpos[parquet]'")
    path.parent.mkdir(parents=True, exist_ok=True)


def write_table(table: pd.DataFrame, path: Path) -> None:
    """As CSV or Parquet, by the name of the file; raises what ``check_table`` does."""
    check_table(path)
    with whole_file(path) as draft:
        if path.suffix == ".csv":
            table.to_csv(draft, index=False)
        else:
            table.to_parquet(draft, index=False)
