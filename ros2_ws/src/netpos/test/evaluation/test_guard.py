"""The guard itself: figures of many runs by hand, intervals at their ends, and what it notices."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from netpos.evaluation.evaluate import evaluate_bag
from netpos.evaluation.guard import (
    LEAST,
    Baseline,
    Interval,
    Pooled,
    baseline_of,
    losses,
    pooled,
    read_baselines,
)
from netpos.evaluation.guarded_runs import SEEDS, Material, Tracked, cases, thinned, track
from netpos.evaluation.metrics import Figures
from netpos.messages.values import RsuMeasurement
from netpos.scenario import load_scenario
from netpos.scenario.offline import simulate_to_bag
from netpos.scenario.replay import replay_bag

COMMITTED = Path(__file__).parents[5] / "tests" / "baselines"
NOTHING: Pooled = dict.fromkeys(LEAST)


def tracked(n: int, lost: int = 0, rejected: int = 0, judged: int = 0, **figures: Any) -> Tracked:
    return Tracked(Figures(n=n, **figures), lost, rejected, judged)


def first(name: str) -> Material:
    return next(cases()[name].materials())


def test_figures_of_many_runs_count_estimates_and_measurements() -> None:
    one = tracked(10, 1, 2, 50, rmse_m=1.0, nees_mean=1.0, nis_mean=3.0, nis_dof_mean=4.0)
    two = tracked(30, 0, 4, 150, rmse_m=3.0, nees_mean=2.0, nis_mean=5.0, nis_dof_mean=2.0)
    never = tracked(0, 1, 0, 0)
    figures = pooled([one, two, never])
    assert figures["rmse_m"] == pytest.approx(math.sqrt((10 * 1.0 + 30 * 9.0) / 40))
    assert figures["nees_mean"] == pytest.approx((10 * 1.0 + 30 * 2.0) / 40)
    assert figures["nis_over_dof"] == pytest.approx((10 * 3.0 + 30 * 5.0) / (10 * 4.0 + 30 * 2.0))
    assert figures["lost_tracks"] == 2
    assert figures["rejected_share"] == pytest.approx(6 / 200)
    assert figures["clock_offset_sd_ns"] is None
    assert pooled([never])["rmse_m"] is None
    assert pooled([never])["rejected_share"] is None
    assert figures.keys() == LEAST.keys()


def test_intervals_by_hand() -> None:
    full = {**NOTHING, "rmse_m": 2.0, "nees_mean": 1.5, "availability": 0.5, "lost_tracks": 1.0}
    full["heading_rmse_deg"] = 9.0
    others = [
        {**full, "rmse_m": 2.0 + d, "availability": 0.5 + a, "heading_rmse_deg": 9.0 + h}
        for d, a, h in ((0.3, 0.3, 1.0), (-0.1, -0.3, -2.0))
    ]
    figures = baseline_of(full, others, 7).figures
    change = math.sqrt((0.3**2 + 0.1**2) / 2)
    rmse = figures["rmse_m"]
    assert rmse is not None
    assert rmse.value == 2.0
    assert rmse.low == pytest.approx(2.0 - 3 * change, rel=1e-3)
    assert rmse.high == pytest.approx(2.0 + 3 * change, rel=1e-3)
    assert figures["nees_mean"] == Interval(1.5, 1.47, 1.53)  # unchanged: 2 %
    assert figures["availability"] == Interval(0.5, 0.0, 1.0)  # a share
    assert "heading_rmse_deg" not in figures  # 3 * sqrt(2.5) is more than half of 9
    assert figures["lost_tracks"] == Interval(1.0, 1.0, 1.0)  # every track counts
    assert figures["velocity_rmse_mps"] is None


@pytest.mark.parametrize(
    ("value", "kept"),
    [(0.95, True), (0.9499, False), (1.05, True), (1.0501, False), (None, False)],
)
def test_a_figure_leaves_at_the_ends_of_its_interval(value: float | None, kept: bool) -> None:
    baseline = Baseline(runs=1, figures={"rmse_m": Interval(1.0, 0.95, 1.05)})
    assert (losses("street", baseline, {"rmse_m": value}) == []) is kept


def test_a_loss_names_case_figure_value_interval_and_remedy() -> None:
    baseline = Baseline(runs=1, figures={"nees_mean": Interval(1.5, 1.25, 1.75), "rmse_m": None})
    (text,) = losses("street", baseline, {"nees_mean": 3.14159, "rmse_m": None})
    assert text == (
        "street: nees_mean is 3.142, its baseline is 1.5 (1.25 to 1.75); if this is meant, run"
        " `make baselines` and read the diff"
    )
    (text,) = losses("street", baseline, {"nees_mean": 1.5, "rmse_m": 0.5})
    assert "rmse_m is 0.5, its baseline is none" in text


def test_a_baseline_reads_back_and_has_a_line_for_each_figure(tmp_path: Path) -> None:
    figures = {"rmse_m": Interval(0.1, 0.09, 0.11), "lost_tracks": Interval(0, 0, 0), "a": None}
    text = Baseline(runs=3, figures=figures).to_text()
    (tmp_path / "street.json").write_text(text)
    assert read_baselines(tmp_path) == {"street": Baseline(runs=3, figures=figures)}
    assert list(json.loads(text)["figures"]) == sorted(figures)
    assert sum(name in line for line in text.splitlines() for name in ("rmse_m", "lost")) == 2


def test_only_measurements_are_thinned() -> None:
    material = first("intersection_turn")
    half = thinned(material, 0.5, 3)
    assert [i for i in half.items if not isinstance(i, RsuMeasurement)] == [
        i for i in material.items if not isinstance(i, RsuMeasurement)
    ]
    n = sum(isinstance(i, RsuMeasurement) for i in material.items)
    left = [i for i in half.items if isinstance(i, RsuMeasurement)]
    assert abs(len(left) - n / 2) < 4 * math.sqrt(n / 4)
    assert [i.stamp_ns for i in left] == sorted(i.stamp_ns for i in left)
    assert thinned(material, 0.5, 3).items == half.items
    assert thinned(material, 0.5, 4).items != half.items


@pytest.mark.parametrize("name", ["fast_pass", "two_networks"])
def test_guarded_figures_are_those_of_replay_and_evaluate(name: str, tmp_path: Path) -> None:
    simulate_to_bag(load_scenario(name, seed=SEEDS[0]), tmp_path / "bag")
    replay_bag(tmp_path / "bag", tmp_path / "replayed")
    (vue,) = evaluate_bag(tmp_path / "replayed").vues.values()
    (guarded,) = track(first(name))
    expected = replace(vue.scored.figures, bound_ratio=None)
    assert guarded.figures == expected


def test_a_lost_track_is_counted() -> None:
    """From the middle on azimuths and times are drawn at random."""
    material, rng = first("fast_pass_100hz"), np.random.default_rng(6)
    half = len(material.items) // 2

    def drawn(item: Any) -> Any:
        toa_s = item.toa_s + rng.uniform(-1e-4, 1e-4)
        return replace(item, azimuth_rad=rng.uniform(-math.pi, math.pi), toa_s=toa_s)

    broken = [drawn(i) if k > half else i for k, i in enumerate(material.items)]
    (sound,) = track(material)
    (lost,) = track(replace(material, items=broken))
    assert (sound.lost, sound.rejected) == (0, 0)
    assert lost.lost >= 1
    assert lost.rejected >= 10
    assert sound.judged > 800
    assert lost.rejected < lost.judged < sound.judged


Change = Callable[[Material], Material]


def each_measurement(change: Callable[[RsuMeasurement], RsuMeasurement]) -> Change:
    return lambda material: replace(
        material,
        items=[change(i) if isinstance(i, RsuMeasurement) else i for i in material.items],
    )


def declared(factor: float) -> Change:
    """Measurements that declare ``factor`` times their sd."""
    return each_measurement(
        lambda m: replace(m, azimuth_var=factor**2 * m.azimuth_var, toa_var=factor**2 * m.toa_var)
    )


def noisier() -> Change:
    """Half of the declared noise once more on every azimuth: 12 % more sd."""
    rng = np.random.default_rng(5)
    return each_measurement(
        lambda m: replace(
            m,
            azimuth_rad=m.azimuth_rad + 0.5 * math.sqrt(m.azimuth_var) * rng.standard_normal(),
            toa_s=m.toa_s + 0.5 * math.sqrt(m.toa_var) * rng.standard_normal(),
        )
    )


def process_noise(factor: float) -> Change:
    """``factor`` times the power of the acceleration."""

    def change(material: Material) -> Material:
        parameters = dict(material.settings.parameters)
        parameters["accel_density_mps2_sqrthz"] *= math.sqrt(factor)
        return replace(material, settings=replace(material.settings, parameters=parameters))

    return change


@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("change", "noticed"),
    [
        (declared(1.3), "nis_over_dof"),
        (declared(1 / 1.3), "nis_over_dof"),
        (noisier(), "nis_over_dof"),
        (process_noise(2.0), ""),
    ],
    ids=["declared sd x 1.3", "declared sd / 1.3", "12 % more noise", "process noise x 2"],
)
def test_what_makes_metis_worse_is_noticed(change: Change, noticed: str) -> None:
    runs = [run for m in cases()["metis_madrid"].materials() for run in track(change(m))]
    left = losses("metis_madrid", read_baselines(COMMITTED)["metis_madrid"], pooled(runs))
    assert any(text.startswith(f"metis_madrid: {noticed}") for text in left), left
