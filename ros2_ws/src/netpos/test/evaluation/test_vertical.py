"""The vertical error of an evaluation, and none where the truth has no height."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from imported_bag import values
from netpos.bags.importers.own.columns import Columns
from netpos.bags.importers.own.recording import Truth, import_csv
from netpos.bags.importers.own.truth import TruthColumns
from netpos.evaluation.metrics import Run, score
from netpos.evaluation.pairing import Trajectory
from netpos.messages.values import UNKNOWN_HEIGHT_VAR, Odometry, RsuInfo

NS = 1_000_000_000


def path(ups: list[float], z_var: float = 0.0) -> Trajectory:
    cov = np.zeros((6, 6))
    cov[2, 2] = z_var
    return Trajectory.of(
        Odometry(
            stamp_ns=(k + 1) * NS // 10,
            vue_id="v",
            position=np.array([0.1 * k, 0.0, up]),
            quaternion=np.array([0.0, 0.0, 0.0, 1.0]),
            linear_velocity=np.array([1.0, 0.0, 0.0]),
            pose_cov=cov + np.diag([1.0, 1.0, 0.0, 0.0, 0.0, 0.0]),
        )
        for k, up in enumerate(ups)
    )


def test_rmse_and_mean_of_the_height() -> None:
    estimate = path([1.1, 1.3, 0.8, 1.2])
    figures = score(Run(truth=path([1.0] * 4), estimate=estimate), skip=0).figures
    assert figures.vertical_error_m == pytest.approx(0.1)
    assert figures.vertical_rmse_m == pytest.approx(np.sqrt(0.18 / 4.0))
    assert figures.down_rmse_m == pytest.approx(figures.vertical_rmse_m)


@pytest.mark.parametrize(
    ("z_var", "known"), [(0.999 * UNKNOWN_HEIGHT_VAR, True), (UNKNOWN_HEIGHT_VAR, False)]
)
def test_a_truth_without_height_has_no_vertical_error(z_var: float, known: bool) -> None:
    run = Run(truth=path([0.0] * 4, z_var), estimate=path([1.1, 1.3, 0.8, 1.2]))
    figures = score(run, skip=0).figures
    assert (figures.vertical_rmse_m is not None) == known
    assert (figures.vertical_error_m is not None) == known
    assert figures.rmse_m == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("with_z", [False, True])
def test_an_imported_truth_says_whether_it_has_a_height(tmp_path: Path, with_z: bool) -> None:
    lines = ["t,a,r,x,y,z", *(f"{1 + k / 10},a1,2.0,{k / 10},0,1.5" for k in range(5))]
    (tmp_path / "in.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    mapping = "time=t,x=x,y=y" + (",z=z" if with_z else "")
    import_csv(
        tmp_path / "in.csv",
        tmp_path / "bag",
        Columns.parse("time=t,rsu=a,range=r", "", "range=0.1"),
        [RsuInfo(rsu_id="a1", position=np.zeros(3))],
        truth=Truth(source=tmp_path / "in.csv", columns=TruthColumns.parse(mapping)),
    )
    _, _, truth = values(tmp_path / "bag")
    assert len(truth) == 5
    assert {pose.pose_cov[2, 2] for pose in truth} == {0.0 if with_z else UNKNOWN_HEIGHT_VAR}
    assert {pose.position[2] for pose in truth} == {1.5 if with_z else 0.0}
