"""Evaluation of many messages, many devices, and of what lies outside the ground truth."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from netpos.bags import BagWriter, codec
from netpos.cli.main import app
from netpos.evaluation import evaluate_bag
from netpos.messages.values import (
    ClockState,
    Field,
    Odometry,
    RsuInfo,
    RsuMeasurement,
    TrackState,
    TrackStatus,
)
from typer.testing import CliRunner

S = 1_000_000_000
KINDS = 7  # messages of a device and epoch


def written(
    bag: Path, devices: int, epochs: int, truth_epochs: int | None = None, error_m: float = 0.5
) -> Path:
    """Devices that drive east at 5 m/s, estimates ``error_m`` to the north, 10 a second."""
    convert = codec()
    places = [np.array([0.0, 20.0, 3.0]), np.array([100.0, -20.0, 3.0])]
    rsus = [RsuInfo(rsu_id=f"rsu_{i}", position=position) for i, position in enumerate(places)]
    with BagWriter(bag, metadata={"tracker": "{}"}) as out:
        for info in rsus:
            out.write("/rsu/info", convert.rsu_info_to_msg(info), 0)
        for k in range(epochs):
            stamp = S + k * S // 10
            for d in range(1, devices + 1):
                vue = f"vue_{d}"
                true = Odometry(
                    stamp_ns=stamp,
                    vue_id=vue,
                    position=np.array([0.5 * k, 0.0, 0.0]),
                    quaternion=np.array([0.0, 0.0, 0.0, 1.0]),
                    linear_velocity=np.array([5.0, 0.0, 0.0]),
                )
                pose_cov = np.diag([0.25, 0.25, 1.0, 0.04, 0.04, 0.01])
                estimate = replace(
                    true, position=true.position + np.array([0.0, error_m, 0.0]), pose_cov=pose_cov
                )
                clock = ClockState(stamp_ns=stamp, vue_id=vue, offset_s=1e-6, drift=0.0)
                status = TrackStatus(
                    stamp_ns=stamp, vue_id=vue, state=TrackState.TRACKING, nis=2.0, nis_dof=2,
                    accepted=2 * k, sources=("rsu_0", "rsu_1"), protection_level_m=2.0,
                )  # fmt: skip
                if truth_epochs is None or k < truth_epochs:
                    out.write(f"/{vue}/ground_truth", convert.odometry_to_msg(true), stamp)
                    out.write(
                        f"/{vue}/ground_truth_clock", convert.clock_state_to_msg(clock), stamp
                    )
                out.write(f"/{vue}/odometry", convert.odometry_to_msg(estimate), stamp)
                out.write(f"/{vue}/clock_state", convert.clock_state_to_msg(clock), stamp)
                out.write(f"/{vue}/track_status", convert.track_status_to_msg(status), stamp)
                for info in rsus:
                    measured = RsuMeasurement(
                        stamp_ns=stamp, rsu_id=info.rsu_id, vue_id=vue, sequence=k, expected=2,
                        fields=Field.RANGE, range_var=0.01,
                        range_m=float(np.linalg.norm(true.position - info.position)),
                    )  # fmt: skip
                    out.write("/rsu/measurements", convert.measurement_to_msg(measured), stamp)
    return bag


def test_memory_a_message(tmp_path: Path) -> None:
    """A million messages stay below 500 MB with the libraries, which take 150."""
    sizes, peaks = (400, 1600), []
    for epochs in sizes:
        bag = written(tmp_path / f"bag_{epochs}", 3, epochs)
        evaluate_bag(bag)  # what is loaded and compiled the first time
        tracemalloc.start()
        evaluate_bag(bag)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    messages = 3 * KINDS * (sizes[1] - sizes[0])
    assert (peaks[1] - peaks[0]) / messages < 340.0


def test_time_without_ground_truth_is_noted_and_no_part_of_the_availability(
    tmp_path: Path,
) -> None:
    evaluation = evaluate_bag(written(tmp_path / "bag", 1, 300, truth_epochs=101))
    figures = evaluation.vues["vue_1"].scored.figures
    assert figures.truth_share == pytest.approx(101 / 300)
    assert figures.outside_truth == 199
    assert evaluation.notes == (
        "vue_1: 199 of 300 estimates (66.3 %) are not scored: 199 before or after the ground "
        "truth, 0 in gaps",
    )


@pytest.mark.parametrize("skip", [60, 1000])
def test_a_prefix_that_leaves_nothing_is_a_mistake(tmp_path: Path, skip: int) -> None:
    bag = written(tmp_path / "bag", 2, 60)
    with pytest.raises(ValueError, match=f"60 estimates and the first {skip} are skipped; give"):
        evaluate_bag(bag, skip=skip)
    assert evaluate_bag(bag, skip=59).vues["vue_1"].scored.figures.n == 1


def test_ten_devices_are_readable_at_80_columns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A row for each; nothing is cut."""
    bag = written(tmp_path / "bag", 10, 40)
    monkeypatch.setenv("COLUMNS", "80")
    result = CliRunner().invoke(app, ["evaluate", str(bag)])
    assert result.exit_code == 0, result.output
    assert max(map(len, result.stdout.splitlines())) <= 80
    assert "…" not in result.stdout
    rows = [line.split() for line in result.stdout.splitlines() if line.startswith(" vue_7 ")]
    assert len(rows) >= 8
    assert any("0.500" in row for row in rows)  # RMSE
