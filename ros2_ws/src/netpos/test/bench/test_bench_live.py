"""Rows of the live node from what the probe prints; the probe itself needs ROS and is a stub."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from netpos.bench import bench
from netpos.bench.common import LeftOut, Row, Unavailable
from netpos.bench.domains import claim_domain
from netpos.bench.live import (
    executable,
    flood_rows,
    latency_rows,
    load_rows,
    probe,
    ready_rows,
    surroundings,
)

PROBE = """#!/bin/sh
echo "$@" >>{folder}/calls
case "$*" in
{cases}
*) echo "something else: $*" >&2; exit 3 ;;
esac
"""


class Prefix:
    """An install prefix with a tracker and a probe that prints what the test says."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.write("ekf_tracker", "ekf_tracker", "#!/bin/sh\n")

    def write(self, package: str, name: str, text: str) -> Path:
        path = self._folder / "lib" / package / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        path.chmod(0o755)
        return path

    def answers(self, figures: dict[str, Any]) -> None:
        """What to print for arguments that contain a text."""
        cases = "\n".join(f"*'{k}'*) echo '{json.dumps(v)}' ;;" for k, v in figures.items())
        text = PROBE.format(folder=self._folder, cases=cases)
        self.write("netpos_bringup", "bench_probe", text)

    @property
    def calls(self) -> list[str]:
        return (self._folder / "calls").read_text().splitlines()


@pytest.fixture
def prefix(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Prefix:
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/nowhere:{tmp_path}")
    return Prefix(tmp_path)


def load_figures(devices: int, traffic: float, **change: Any) -> dict[str, Any]:
    figures = {
        "devices": devices,
        "seconds": 4.0,
        "sent": 80 * devices,
        "handled": 80 * devices,
        "epochs": 40 * devices,
        "odometry": 40 * devices,
        "cpu_idle": 0.01,
        "cpu_traffic": traffic,
        "cpu_probe": 0.1,
        "lag_median_s": 0.001,
        "lag_p99_s": 0.004,
        "lag_max_s": 0.02,
        "probe_late_s": 0.001,
        "memory_mb": 200.0,
    }
    return {**figures, **change}


def as_rows(results: list[Any]) -> list[Row]:
    assert all(isinstance(row, Row) for row in results)
    return results


def test_latency_is_a_ratio_to_the_relay(prefix: Prefix) -> None:
    ours = {"median_s": 0.0009, "p99_s": 0.004, "lost": 0}
    theirs = {"median_s": 0.0006, "p99_s": 0.0008, "lost": 1}
    prefix.answers({"latency": {"epochs": 7, "tracker": ours, "relay": theirs}})
    median, p99 = as_rows(latency_rows(quick=True))
    assert (median.ratio, median.target, median.ok) == (pytest.approx(1.5), 2.0, True)
    assert (p99.ratio, p99.target, p99.ok) == (pytest.approx(5.0), 4.0, False)
    assert "unanswered: 0, relay 1" in median.note


def test_load_is_lossless_and_linear(prefix: Prefix) -> None:
    """0.01 s/s of idling is no cost of devices: the rest is 0.002 s/s for each."""
    runs = {f"--devices {n} ": load_figures(n, 0.002 * n) for n in (25, 50, 100)}
    prefix.answers(runs)
    lost, lag, cpu, memory, exponent = as_rows(load_rows(quick=True))
    assert (lost.ours, lost.ok) == (0.0, True)
    assert lag.ratio == pytest.approx(0.04)
    assert (cpu.ours, cpu.ok) == (pytest.approx(0.21), True)
    assert (memory.ratio, memory.ok) == (pytest.approx(0.8), True)
    assert exponent.ours == pytest.approx(1.0)
    assert exponent.ok
    assert all("--tracker" in call for call in prefix.calls)


@pytest.mark.parametrize("change", [{"handled": 7999}, {"odometry": 3999}])
def test_one_message_lost_is_too_many(prefix: Prefix, change: dict[str, int]) -> None:
    runs = {f"--devices {n} ": load_figures(n, 0.002 * n, **change) for n in (25, 50, 100)}
    prefix.answers(runs)
    lost = as_rows(load_rows(quick=True))[0]
    assert (lost.ours, lost.reference_value, lost.ok) == (1.0, 8000.0, False)


def test_quadratic_cost_is_not_ok(prefix: Prefix) -> None:
    runs = {f"--devices {n} ": load_figures(n, 1e-5 * n * n) for n in (25, 50, 100)}
    prefix.answers(runs)
    exponent = as_rows(load_rows(quick=True))[-1]
    assert exponent.ours == pytest.approx(2.0)
    assert not exponent.ok


def test_a_flood_is_measured_beside_the_same_without_it(prefix: Prefix) -> None:
    """What the tracker needs for the flood alone is its idling beside it."""
    flooded = load_figures(
        10, 0.2, cpu_idle=0.4, lag_p99_s=0.12, odometry=399, refused_of_flood=70_000
    )
    quiet = load_figures(10, 0.19, refused_of_flood=0)
    prefix.answers({"--rate 0 ": quiet, "--rate 20000 ": flooded})
    missing, lag, cpu = as_rows(flood_rows(quick=True))
    assert (missing.ours, missing.ok) == (1.0, False)
    assert "70000 messages of the flood" in missing.note
    assert (lag.ratio, lag.ok) == (pytest.approx(1.2), False)
    assert "Without the flood 4.0 ms" in lag.note
    assert (cpu.ours, cpu.ok) == (pytest.approx(0.6), True)
    assert "Without the flood 0.200 s/s" in cpu.note


def test_ready_takes_the_median(prefix: Prefix) -> None:
    figures = {
        "ready_s": [9.0, 1.0, 1.5],
        "odometry_s": [9.1, 2.5, 1.6],
        "cpu_s": [1.2, 0.8, 0.9],
        "memory_mb": 251.0,
    }
    prefix.answers({"ready": figures})
    ready, odometry, memory = as_rows(ready_rows(quick=True))
    assert (ready.ours, ready.ratio, ready.ok) == (1.5, 0.75, True)
    assert "9.00, 1.00, 1.50 s; 0.80 s of processor time" in ready.note
    assert (odometry.ours, odometry.ok) == (2.5, False)
    assert not memory.ok


def test_a_probe_that_fails_gives_its_last_words(prefix: Prefix) -> None:
    prefix.answers({})
    ((_, results),) = bench(["ready"])
    (left_out,) = results
    assert isinstance(left_out, LeftOut)
    assert "the probe failed: something else:" in left_out.reason


def test_a_probe_that_hangs_is_ended(prefix: Prefix, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("netpos.bench.live._TIMEOUT_S", 0.2)
    prefix.write("netpos_bringup", "bench_probe", "#!/bin/sh\nexec sleep 100\n")
    with pytest.raises(Unavailable, match="did not end within"):
        probe("ready")


@pytest.mark.parametrize("path", ["", "/nowhere"])
def test_without_ros_the_part_is_left_out(monkeypatch: pytest.MonkeyPatch, path: str) -> None:
    monkeypatch.setenv("AMENT_PREFIX_PATH", path)
    for part in ("ready", "latency", "load", "flood"):
        ((name, (left_out,)),) = bench([part])
        assert name == part
        assert isinstance(left_out, LeftOut)
        assert "source env.sh" in left_out.reason


def test_a_file_that_is_no_program_is_no_executable(prefix: Prefix) -> None:
    path = prefix.write("netpos_bringup", "bench_probe", "")
    path.chmod(0o644)
    with pytest.raises(Unavailable, match="netpos_bringup/bench_probe"):
        executable("netpos_bringup", "bench_probe")


def test_the_processes_keep_to_this_host(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "250")
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "0")
    with claim_domain() as ours, claim_domain() as theirs:
        assert ours != theirs
        assert {ours, theirs} <= set(range(1, 102))
    environment = surroundings(17)
    assert environment["ROS_DOMAIN_ID"] == "17"
    assert environment["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "LOCALHOST"
    assert "ROS_LOCALHOST_ONLY" not in environment
