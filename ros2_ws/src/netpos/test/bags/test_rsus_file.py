"""RSUs and what was learned of them, from a bag to a file and into another bag."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from netpos.bags import BagError, BagReader, BagWriter, codec
from netpos.bags.importers.own.rsus import read_rsus
from netpos.bags.recording import write_values
from netpos.bags.rsus_file import load_rsus, save_rsus
from netpos.cli.main import app
from netpos.evaluation import evaluate_bag
from netpos.messages.topics import RSU_INFO, RSU_LEARNED
from netpos.messages.values import (
    AngleConvention,
    Field,
    Odometry,
    RsuErrors,
    RsuInfo,
    RsuMeasurement,
)
from netpos.scenario.replay import replay_bag
from typer.testing import CliRunner

S = 1_000_000_000
SITES = np.array(
    [[15.0, 0.0, 3.0], [4.0, 12.0, 3.0], [-12.0, 7.0, 3.0], [-12.0, -7.0, 3.0], [4.0, -12.0, 3.0]]
)
BIAS = np.array([0.3, -0.2, 0.25, -0.3, 0.1])
INFOS = [RsuInfo(rsu_id=f"a{i}", position=site) for i, site in enumerate(SITES)]


def position_of(t: float) -> np.ndarray:
    return np.array([8.0 * math.cos(t / 8), 5.0 * math.sin(t / 8), 0.0])


def recorded(path: Path, seed: int, **tracker: object) -> Path:
    """A minute on an ellipse, with its truth; the ranges are biased, and nobody declares it."""
    rng, measurements, truth = np.random.default_rng(seed), [], []
    for k in range(300):
        t = k / 5.0
        stamp = round((1.0 + t) * S)
        d = np.linalg.norm(position_of(t) - SITES, axis=1) + BIAS + rng.normal(0.0, 0.1, 5)
        measurements += [
            RsuMeasurement(
                stamp_ns=stamp,
                rsu_id=f"a{i}",
                vue_id="vue_1",
                fields=Field.RANGE,
                range_m=float(d[i]),
                range_var=0.01,
            )
            for i in range(5)
        ]
        pose = Odometry(
            stamp_ns=stamp,
            vue_id="vue_1",
            position=position_of(t),
            quaternion=np.array([0.0, 0.0, 0.0, 1.0]),
            linear_velocity=np.zeros(3),
        )
        truth.append(pose)
    tracker = {"accel_density_mps2_sqrthz": 0.3, **tracker}
    write_values(path, rsus=INFOS, measurements=measurements, truth=truth, tracker=tracker)
    return path


@pytest.fixture(scope="module", name="bags")
def _bags(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rsus")
    replay_bag(recorded(folder / "monday", 1, learn_errors=True), folder / "learned")
    recorded(folder / "tuesday", 2)
    return folder


def test_what_was_learned_is_saved_and_serves_the_next_day(bags: Path, tmp_path: Path) -> None:
    saved = save_rsus(bags / "learned", tmp_path / "rsus.yaml")
    assert [info.rsu_id for info in saved] == ["a0", "a1", "a2", "a3", "a4"]
    spreads = np.array([info.range_bias_sd_m for info in saved])
    assert 0.1 < np.sqrt(np.mean(spreads**2)) < 0.6
    assert all(info.bias_correlation_time_s > 3.0 for info in saved)
    assert load_rsus(tmp_path / "rsus.yaml", bags / "tuesday", tmp_path / "told") == [
        info.rsu_id for info in saved
    ]
    nees = {}
    for source in (bags / "tuesday", tmp_path / "told"):
        replay_bag(source, tmp_path / f"{source.name}_track")
        nees[source.name] = (
            evaluate_bag(tmp_path / f"{source.name}_track").vues["vue_1"].scored.figures.nees_mean
        )
    assert nees["tuesday"] > 10.0
    assert nees["told"] < 0.3 * nees["tuesday"]


def learned_of(rsu_id: str, quantity: str, **learned: float) -> RsuErrors:
    """Of one quantity; what is not given is as stated."""
    as_stated = {
        "scatter": 1.0,
        "bias": 0.1,
        "bias_sd": 0.1,
        "bias_spread": 0.1,
        "correlation_time_s": 10.0,
        "stretch": 0.0,
        "stretch_sd": 0.0,
    }
    values = {name: (value,) for name, value in (as_stated | learned).items()}
    return RsuErrors(stamp_ns=S, rsu_id=rsu_id, vue_id="v", quantities=(quantity,), **values)  # type: ignore[arg-type]


def write_learned(bag: Path, learned: list[RsuErrors]) -> None:
    with BagWriter(bag) as writer:
        for info in INFOS:
            writer.write(RSU_INFO, codec().rsu_info_to_msg(info), S)
        for errors in learned:
            writer.write(RSU_LEARNED, codec().rsu_errors_to_msg(errors), S)


def test_the_biases_of_differences_are_those_of_their_rsus(tmp_path: Path) -> None:
    learned = [
        learned_of(pair, "TDOA", bias_spread=spread, correlation_time_s=time_s)
        for pair, spread, time_s in (("a1-a0", 0.4, 10.0), ("a2-a1", 0.2, 30.0))
    ]
    write_learned(tmp_path / "bag", learned)
    saved = {info.rsu_id: info for info in save_rsus(tmp_path / "bag", tmp_path / "rsus.yaml")}
    expected = {"a0": (0.14, 10.0), "a1": (0.02, 30.0), "a2": (0.02, 30.0), "a3": (0.0, 0.0)}
    for name, (variance, time_s) in expected.items():
        assert saved[name].range_bias_sd_m ** 2 == pytest.approx(variance)
        assert saved[name].bias_correlation_time_s == pytest.approx(time_s)


def test_distances_that_are_too_long_are_a_comment_of_the_file(tmp_path: Path) -> None:
    learned = [
        learned_of("a1", "RANGE", scatter=1.25, stretch=0.0694, stretch_sd=0.004),
        learned_of("a2", "RANGE"),
    ]
    write_learned(tmp_path / "bag", learned)
    save_rsus(tmp_path / "bag", tmp_path / "rsus.yaml")
    comments = [
        line.strip()
        for line in (tmp_path / "rsus.yaml").read_text().splitlines()
        if line.startswith("  #")
    ]
    assert comments == [
        "# learned; scatter over the sd stated: RANGE 1.25",
        "# learned; share by which distances are too long: RANGE 0.0694 +- 0.004",
        "# learned; scatter over the sd stated: RANGE 1.00",
    ]
    read = {info.rsu_id for info in read_rsus(tmp_path / "rsus.yaml")}
    assert read == {info.rsu_id for info in INFOS}


def test_a_file_reads_as_it_was_saved(bags: Path, tmp_path: Path) -> None:
    saved = save_rsus(bags / "learned", tmp_path / "rsus.yaml")
    for written, read in zip(saved, read_rsus(tmp_path / "rsus.yaml"), strict=True):
        assert read.rsu_id == written.rsu_id
        np.testing.assert_allclose(read.position, written.position, atol=1e-6)
        assert read.range_bias_sd_m == pytest.approx(written.range_bias_sd_m, abs=1e-6)
        assert read.bias_correlation_time_s == pytest.approx(
            written.bias_correlation_time_s, abs=1e-6
        )
    assert "# learned; scatter over the sd stated: RANGE " in (tmp_path / "rsus.yaml").read_text()


def test_every_field_of_an_rsu_is_kept(tmp_path: Path) -> None:
    turned = np.array([0.0, 0.0, math.sin(0.3), math.cos(0.3)])
    odd = [
        replace(INFOS[0], rsu_id="1", quaternion=turned),
        replace(INFOS[1], rsu_id="no", angle_convention=AngleConvention.CONE),
        replace(INFOS[2], rsu_id="p", baseline_m=0.2, wavelength_m=0.05, network="wifi"),
        replace(INFOS[3], rsu_id="q", azimuth_bias_sd_rad=0.01, bias_correlation_time_s=9.0),
    ]
    measured = [
        RsuMeasurement(
            stamp_ns=S, rsu_id=info.rsu_id, vue_id="v", fields=Field.RANGE, range_var=1.0
        )
        for info in odd
    ]
    write_values(tmp_path / "bag", rsus=odd, measurements=measured)
    save_rsus(tmp_path / "bag", tmp_path / "rsus.yaml")
    read = {info.rsu_id: info for info in read_rsus(tmp_path / "rsus.yaml")}
    for info in odd:
        back = read[info.rsu_id]
        np.testing.assert_allclose(back.quaternion, info.quaternion, atol=1e-8)
        assert back.angle_convention is info.angle_convention
        for name in ("baseline_m", "wavelength_m", "azimuth_bias_sd_rad", "network"):
            assert getattr(back, name) == getattr(info, name), name


def test_a_copy_keeps_all_but_the_output_of_a_tracker(bags: Path, tmp_path: Path) -> None:
    (tmp_path / "one.yaml").write_text("rsus: {a1: [4.5, 12.0, 3.0]}\n")
    assert load_rsus(tmp_path / "one.yaml", bags / "learned", tmp_path / "copy") == ["a1"]
    make = codec()
    with BagReader(tmp_path / "copy") as copy, BagReader(bags / "learned") as source:
        assert RSU_LEARNED in source.topics
        assert RSU_LEARNED not in copy.topics
        assert "/vue_1/odometry" not in copy.topics
        assert copy.metadata == source.metadata
        for name, info in copy.topics.items():
            assert info.count == source.topics[name].count
        infos = [make.rsu_info_from_msg(entry.message) for entry in copy.messages([RSU_INFO])]
    east = {info.rsu_id: float(info.position[0]) for info in infos}
    assert east == {"a0": 15.0, "a1": 4.5, "a2": -12.0, "a3": -12.0, "a4": 4.0}


def test_nothing_is_overwritten_and_mistakes_are_named(bags: Path, tmp_path: Path) -> None:
    (tmp_path / "there.yaml").write_text("x")
    with pytest.raises(FileExistsError, match=r"there.yaml exists and is never overwritten"):
        save_rsus(bags / "learned", tmp_path / "there.yaml")
    (tmp_path / "strange.yaml").write_text("rsus: {z9: [0, 0, 0]}\n")
    with pytest.raises(BagError, match=r"names z9, which .* does not know; it knows a0, a1"):
        load_rsus(tmp_path / "strange.yaml", bags / "tuesday", tmp_path / "copy")
    assert not (tmp_path / "copy").exists()
    (tmp_path / "bad.yaml").write_text("rsus: {a0: {position: [0, 0, 0], angle_convention: 7}}\n")
    with pytest.raises(BagError, match="angle_convention must be SPHERICAL or CONE, got 7"):
        read_rsus(tmp_path / "bad.yaml")


def test_the_commands(bags: Path, tmp_path: Path) -> None:
    def netpos(*arguments: object) -> tuple[int, str]:
        result = CliRunner().invoke(app, [str(argument) for argument in arguments])
        return result.exit_code, result.output

    file, copy = tmp_path / "rsus.yaml", tmp_path / "copy"
    assert netpos("rsus", "save", bags / "learned", file) == (0, f"wrote {file}: 5 RSUs\n")
    code, output = netpos("rsus", "load", file, bags / "tuesday", copy)
    assert (code, output) == (0, f"wrote {copy}: a0, a1, a2, a3, a4 as in {file}\n")
    assert netpos("rsus", "load", file, bags / "tuesday", copy)[0] == 2
