"""A recorded drive from end to end, against evo on the values that went in."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evo.core import metrics, sync
from evo.core.trajectory import PoseTrajectory3D
from netpos.bags import BagError
from netpos.evaluation import evaluate_bag
from netpos.evaluation.pictures import draw_errors, draw_map, ellipse_axes, save
from netpos.messages.values import RsuMeasurement

DESIGN_KEYS = [
    "n", "duration_s", "availability", "rmse_m", "mean_error_m", "p50_m", "p95_m", "p99_m",
    "max_m", "velocity_rmse_mps", "heading_rmse_deg", "clock_offset_sd_ns",
    "clock_offset_rmse_ns", "nees_mean", "nees_bounds", "nees_consistent", "nis_mean", "rejected",
    "bound_ratio",
]  # fmt: skip


def evo_rmse(truth: list[Any], estimates: list[Any]) -> float:
    paths = [
        PoseTrajectory3D(
            positions_xyz=np.array([p.position for p in poses]),
            orientations_quat_wxyz=np.array([np.roll(p.quaternion, 1) for p in poses]),
            timestamps=np.array([(p.stamp_ns - truth[0].stamp_ns) / 1e9 for p in poses]),
        )
        for poses in (truth, estimates)
    ]
    pair = sync.associate_trajectories(
        *paths, sync_method=sync.SyncMethod.interpolation, max_diff=0.1
    )
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data(pair)
    return float(ape.get_statistic(metrics.StatisticsType.rmse))


def test_a_recorded_drive(drive_bag: Path, drive: Any) -> None:
    figures = evaluate_bag(drive_bag).vues["vue_1"].scored.figures
    assert figures.n == 180
    assert figures.duration_s == pytest.approx(17.9)
    assert figures.rmse_m == pytest.approx(evo_rmse(drive.truth, drive.estimates[20:]), abs=1e-3)
    assert figures.heading_rmse_deg == pytest.approx(0.5, abs=0.02)
    assert figures.clock_offset_sd_ns == pytest.approx(drive.clock_errors_ns[20:].std(), rel=1e-6)
    assert figures.rejected == 3
    assert figures.availability == pytest.approx(1 - 0.553 / 20.0, abs=1e-9)
    assert figures.measured == pytest.approx(1 - 0.053 / 20.0, abs=1e-9)
    assert figures.output_rate_hz == pytest.approx(10.0)


def test_lost_measurements_are_counted(drive_bag: Path) -> None:
    delivery = evaluate_bag(drive_bag).vues["vue_1"].delivery
    assert (delivery.received, delivery.expected, delivery.missing) == (399, 400, 1)
    assert (delivery.duplicates, delivery.out_of_order) == (0, 0)
    assert (delivery.beacons, delivery.epochs) == (None, 200)


def measurement(stamp_ns: int, sequence: int, rsu: str, expected: int) -> RsuMeasurement:
    return RsuMeasurement(
        stamp_ns=stamp_ns, rsu_id=rsu, vue_id="vue_1", sequence=sequence, expected=expected
    )


@pytest.mark.parametrize(("expected", "missing"), [(2, 1), (0, None)])
def test_repeated_and_late_measurements_are_counted(
    tmp_path: Path, drive: Any, record: Callable[..., Path], expected: int, missing: int | None
) -> None:
    """RSU a reports beacon 1 twice; beacon 0 arrives from both RSUs after that."""
    seen = [(2, 1, "a"), (2, 1, "a"), (1, 0, "a"), (1, 0, "b")]
    bag = record(tmp_path / "late", drive, measurements=[measurement(*m, expected) for m in seen])
    delivery = evaluate_bag(bag).vues["vue_1"].delivery
    assert (delivery.received, delivery.epochs) == (4, 2)
    assert (delivery.duplicates, delivery.out_of_order) == (1, 2)
    assert delivery.missing == missing


def test_json_has_the_agreed_keys_and_reads_back(drive_bag: Path) -> None:
    content = evaluate_bag(drive_bag).to_json()
    figures = content["vues"]["vue_1"]
    assert list(figures)[: len(DESIGN_KEYS)] == DESIGN_KEYS
    assert set(content["requirements"]["vue_1"]) == {"tsp", "v2x_set_1", "v2x_set_2", "v2x_set_3"}
    assert figures["bound_ratio"] > 0.0
    assert json.loads(json.dumps(content, allow_nan=False)) == content


def test_networks_are_scored_apart(
    tmp_path: Path, drive: Any, drive_bag: Path, record: Callable[..., Path]
) -> None:
    """What a network says of a device whose truth is known, against that; under another name it
    cannot be told."""
    aside = [replace(o, position=o.position + np.array([3.0, 0.0, 0.0])) for o in drive.estimates]
    others = {
        "/networks/wifi/vue_1/odometry": drive.estimates,
        "/networks/wimax/vue_1/odometry": aside,
        "/networks/wimax/stranger/odometry": aside,
    }
    bag = record(tmp_path / "networks", drive, others=others)
    content = evaluate_bag(bag).to_json()
    assert set(content["networks"]) == {"wifi", "wimax"}
    assert set(content["networks"]["wimax"]) == {"vue_1"}
    fused, wifi = content["vues"]["vue_1"], content["networks"]["wifi"]["vue_1"]
    assert list(wifi) == list(fused)
    assert wifi["rmse_m"] == fused["rmse_m"]
    assert wifi["clock_offset_sd_ns"] is None
    assert content["networks"]["wimax"]["vue_1"]["rmse_m"] > 1.5 * fused["rmse_m"]
    assert list(evaluate_bag(bag).columns()) == ["vue_1", "vue_1 by wifi", "vue_1 by wimax"]
    assert evaluate_bag(drive_bag).to_json()["networks"] == {}


def test_the_same_bag_gives_the_same_figures(drive_bag: Path) -> None:
    assert evaluate_bag(drive_bag).to_json() == evaluate_bag(drive_bag).to_json()


def test_a_bag_without_ground_truth(
    tmp_path: Path, drive: Any, record: Callable[..., Path]
) -> None:
    bag = record(tmp_path / "blind", drive, truth=False)
    with pytest.raises(ValueError, match="blind is a bag without ground truth"):
        evaluate_bag(bag)


def test_a_bag_without_estimates(tmp_path: Path, drive: Any, record: Callable[..., Path]) -> None:
    bag = record(tmp_path / "raw", drive, estimates=False)
    with pytest.raises(ValueError, match=r"no estimates .* netpos replay"):
        evaluate_bag(bag)


def test_an_unknown_device(drive_bag: Path) -> None:
    with pytest.raises(ValueError, match=r"no ground truth of 'vue_9'; choose one of vue_1"):
        evaluate_bag(drive_bag, vue="vue_9")


def test_a_missing_bag(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="does not exist"):
        evaluate_bag(tmp_path / "nothing")


def test_ellipse_axes_of_a_turned_covariance() -> None:
    """95 % of a unit Gaussian lie within sqrt(-2 ln 0.05) = 2.4477 (Rayleigh)."""
    angle = np.deg2rad(30.0)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    major, minor, degrees = ellipse_axes((turn @ np.diag([4.0, 1.0]) @ turn.T)[None])
    radius = np.sqrt(-2 * np.log(0.05))
    np.testing.assert_allclose([major[0], minor[0]], [4 * radius, 2 * radius], rtol=1e-9)
    assert degrees[0] % 180 == pytest.approx(30.0)


def test_the_map_names_what_it_draws(drive_bag: Path, tmp_path: Path) -> None:
    figure = draw_map(evaluate_bag(drive_bag))
    axes = figure.axes[0]
    legend = axes.get_legend()
    assert legend is not None
    labels = {text.get_text() for text in legend.get_texts()}
    assert {"ground truth", "vue_1 estimate", "95 % ellipse", "RSU"} <= labels
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("east [m]", "north [m]")
    assert axes.get_aspect() == 1.0
    save(figure, tmp_path / "new" / "map.svg")
    assert ET.parse(tmp_path / "new" / "map.svg").getroot().tag.endswith("svg")


def test_errors_are_drawn_per_component(drive_bag: Path) -> None:
    figure = draw_errors(evaluate_bag(drive_bag))
    assert [axes.get_ylabel() for axes in figure.axes] == [
        "east [m]", "north [m]", "horizontal [m]", "heading [°]", "clock [ns]",
    ]  # fmt: skip


def test_pictures_need_a_known_format(drive_bag: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"written as \.png, \.svg, \.pdf"):
        save(draw_map(evaluate_bag(drive_bag)), tmp_path / "map.bmp")
