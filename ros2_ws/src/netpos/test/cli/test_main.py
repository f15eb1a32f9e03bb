"""Exit status, messages and files of the command line."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from netpos.bags import BagReader, BagWriter
from netpos.cli.runs import parse_setting
from netpos.scenario.load import scenario_files
from typer.testing import Result

Netpos = Callable[..., Result]

DESIGN_KEYS = {
    "n", "duration_s", "availability", "rmse_m", "mean_error_m", "p50_m", "p95_m", "p99_m",
    "max_m", "velocity_rmse_mps", "heading_rmse_deg", "clock_offset_sd_ns",
    "clock_offset_rmse_ns", "nees_mean", "nees_bounds", "nees_consistent", "nis_mean", "rejected",
    "bound_ratio",
}  # fmt: skip


def assert_refused(result: Result, *words: str, several: bool = False) -> None:
    """Status 2 and one sentence on stderr that says these words, or ``several``, a line each; no
    traceback."""
    assert result.exit_code == 2, result.output
    assert all(line.startswith("netpos: ") for line in result.stderr.splitlines())
    assert (result.stderr.count("\n") > 1) is several
    assert "Traceback" not in result.output
    for word in words:
        assert word in result.stderr


def test_evaluate_writes_the_agreed_keys(netpos: Netpos, bag: Path, tmp_path: Path) -> None:
    result = netpos("evaluate", bag, "--json", tmp_path / "out" / "figures.json")
    assert result.exit_code == 0, result.output
    content = json.loads((tmp_path / "out" / "figures.json").read_text())
    figures = content["vues"]["vue_1"]
    assert figures.keys() >= DESIGN_KEYS
    assert content.keys() >= {"vues", "requirements"}
    assert figures["n"] == 11
    assert figures["rmse_m"] == pytest.approx(0.25)
    for unknown in ("clock_offset_sd_ns", "nees_mean", "nis_mean", "rejected", "bound_ratio"):
        assert figures[unknown] is None


def test_evaluate_shows_units_and_values(netpos: Netpos, bag: Path) -> None:
    text = netpos("evaluate", bag, "--skip", 0).stdout
    row = next(line for line in text.splitlines() if "position RMSE " in line)
    assert "0.250" in row
    assert "position RMSE [m]" in text


def test_evaluate_draws(netpos: Netpos, bag: Path, tmp_path: Path) -> None:
    drawn, errors, bounds = (tmp_path / name for name in ("map.png", "errors.svg", "bounds.svg"))
    pictures = ("--map", drawn, "--errors", errors, "--bounds", bounds)
    assert netpos("evaluate", bag, *pictures).exit_code == 0
    assert drawn.read_bytes().startswith(b"\x89PNG")
    assert b"<svg" in errors.read_bytes()
    assert b"<svg" in bounds.read_bytes()
    assert errors.read_bytes() != bounds.read_bytes()


@pytest.mark.parametrize("command", ["evaluate", "recover"])
def test_a_missing_bag(netpos: Netpos, tmp_path: Path, command: str) -> None:
    assert_refused(netpos(command, tmp_path / "none"), "none", "does not exist")


def test_a_cut_off_bag_names_its_remedy(netpos: Netpos, cut_bag: Path) -> None:
    assert_refused(netpos("evaluate", cut_bag), f"netpos recover {cut_bag}")


def test_a_bag_without_ground_truth_tells_of_itself(
    netpos: Netpos, blind_bag: Path, tmp_path: Path
) -> None:
    drawn, figures = tmp_path / "map.png", tmp_path / "figures.json"
    result = netpos("evaluate", blind_bag, "--map", drawn, "--json", figures)
    assert result.exit_code == 0, result.output
    assert "No ground truth" in result.stdout
    assert "protection level" in result.stdout
    assert max(map(len, result.stdout.splitlines())) <= 80
    assert drawn.read_bytes().startswith(b"\x89PNG")
    said = json.loads(figures.read_text())
    assert said["ground_truth"] is False
    assert said["vues"]["vue_1"]["estimates"] > 0


@pytest.mark.parametrize("option", ["--errors", "--bounds"])
def test_a_picture_of_errors_needs_ground_truth(
    netpos: Netpos, blind_bag: Path, tmp_path: Path, option: str
) -> None:
    result = netpos("evaluate", blind_bag, option, tmp_path / "x.png")
    assert_refused(result, "needs ground truth")


def test_a_picture_never_goes_into_a_recording(netpos: Netpos, bag: Path) -> None:
    result = netpos("evaluate", bag, "--map", bag / "map.png")
    assert_refused(result, "is inside a recording")
    assert not (bag / "map.png").exists()


def test_a_folder_that_is_no_bag(netpos: Netpos, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("nothing")
    assert_refused(netpos("evaluate", tmp_path), "not a bag")


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("--skip", -1), "skip must be >= 0"),
        (("--vue", "vue_7"), "vue_7"),
        (("--map", "map.txt"), ".png"),
    ],
)
def test_bad_options_of_evaluate(
    netpos: Netpos, bag: Path, arguments: tuple[object, ...], word: str
) -> None:
    assert_refused(netpos("evaluate", bag, *arguments), word)


def test_scenarios_lists_those_that_load(netpos: Netpos) -> None:
    result = netpos("scenarios")
    assert result.exit_code == 0
    assert "metis_madrid" in result.stdout


def test_wrong_parameters_of_a_tracker_are_told_before_anything_is_simulated(
    netpos: Netpos, tmp_path: Path
) -> None:
    text = scenario_files()["fast_pass"].read_text()
    assert "tracker:\n" in text
    wrong = "tracker:\n  hold: 1.0\n  gate_probability: 1.5\n"
    file = tmp_path / "wrong.yaml"
    file.write_text(text.replace("tracker:\n", wrong))
    line = text[: text.index("tracker:")].count("\n") + 2
    result = netpos("run", file, "--offline", "--bag", tmp_path / "b")
    assert result.exit_code == 2
    first, second = result.stderr.splitlines()
    where = f"netpos: {file}: line"
    unknown = "unknown tracker parameter 'hold'; did you mean hold_s?"
    assert first == f"{where} {line}: tracker.hold: {unknown}"
    assert second.startswith(f"{where} {line + 1}: tracker.gate_probability: gate_prob")
    assert not (tmp_path / "b").exists()


def test_an_unknown_scenario(netpos: Netpos, tmp_path: Path) -> None:
    result = netpos("run", "atlantis", "--offline", "--bag", tmp_path / "b")
    assert_refused(result, "atlantis", "metis_madrid")
    assert not (tmp_path / "b").exists()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("rsus: [1, 2", ("line",)),
        ("- 1\n", ("mapping",)),
        ("seed: 1\nsped: 3\n", ("sped", "unknown key")),
    ],
)
def test_a_malformed_scenario(
    netpos: Netpos, tmp_path: Path, text: str, words: tuple[str, ...]
) -> None:
    file = tmp_path / "broken.yaml"
    file.write_text(text)
    result = netpos("run", file, "--offline", "--bag", tmp_path / "b")
    assert_refused(result, "broken.yaml", *words, several="sped" in words)


@pytest.mark.parametrize("mode", [(), ("--offline",)])
def test_run_never_overwrites(netpos: Netpos, bag: Path, mode: tuple[str, ...]) -> None:
    before = sorted((file, file.stat().st_mtime_ns) for file in bag.iterdir())
    assert_refused(netpos("run", "fast_pass", *mode, "--bag", bag), "exists", "another name")
    assert sorted((file, file.stat().st_mtime_ns) for file in bag.iterdir()) == before


def test_replay_never_overwrites(netpos: Netpos, bag: Path) -> None:
    assert_refused(netpos("replay", bag, "--out", bag), "exists")


@pytest.mark.parametrize("rate", [0, -1, "nan"])
def test_rate_must_be_positive(netpos: Netpos, tmp_path: Path, rate: object) -> None:
    result = netpos("run", "fast_pass", "--rate", rate, "--bag", tmp_path / "b")
    assert_refused(result, "--rate must be > 0")


def test_rate_is_for_the_live_graph(netpos: Netpos, tmp_path: Path) -> None:
    result = netpos("run", "fast_pass", "--offline", "--rate", 2, "--bag", tmp_path / "b")
    assert_refused(result, "--rate", "--offline")


def test_a_live_run_needs_ros2(
    netpos: Netpos, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = tmp_path / "scripts" / "run_graph.sh"
    script.parent.mkdir()
    script.touch()
    monkeypatch.setenv("NETPOS_ROOT", str(tmp_path))
    monkeypatch.setenv("PATH", "")
    assert_refused(netpos("run", "fast_pass", "--bag", tmp_path / "b"), "ros2 is not on PATH")


def test_a_live_run_needs_the_workspace(
    netpos: Netpos, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("NETPOS_ROOT", raising=False)
    assert_refused(netpos("run", "fast_pass", "--bag", tmp_path / "b"), "source env.sh")


@pytest.mark.parametrize(
    ("body", "status", "message"),
    [
        ("exit 7", 1, "the graph ended with status 7"),
        ("exit 0", 1, "without a recording"),
        ('cp -r "$NETPOS_ROOT/recorded" "$2"; echo "$@" > "$2.arguments"', 0, ""),
    ],
)
def test_a_live_run_reports_how_the_graph_ended(
    netpos: Netpos,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    body: str,
    status: int,
    message: str,
) -> None:
    """A stand-in for the shell script and for ros2 plays the graph; losses are told."""
    with BagWriter(tmp_path / "recorded") as recorded:
        recorded.note("lost", "/clock: 3")
    for name, text in (("run_graph.sh", body), ("ros2", "exit 0")):
        file = tmp_path / "scripts" / name
        file.parent.mkdir(exist_ok=True)
        file.write_text(f"#!/bin/sh\n{text}\n")
        file.chmod(0o755)
    monkeypatch.setenv("NETPOS_ROOT", str(tmp_path))
    monkeypatch.setenv("PATH", f"{tmp_path / 'scripts'}{os.pathsep}{os.environ['PATH']}")
    target = tmp_path / "live"
    result = netpos("run", "fast_pass", "--bag", target, "--rate", 4, "--seed", 9)
    assert result.exit_code == status
    assert message in result.stderr
    if status == 0:
        said = (tmp_path / "live.arguments").read_text()
        assert said == f"fast_pass {target} 4 9\n"
        assert "LOST while recording: 3 of /clock" in result.stderr


@pytest.mark.parametrize("setting", ["hold_s", "=1", "hold_s=[1"])
def test_a_setting_is_key_and_value(
    netpos: Netpos, bag: Path, tmp_path: Path, setting: str
) -> None:
    assert_refused(netpos("replay", bag, "--out", tmp_path / "b", "--set", setting), "--set")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("hold_s=0.5", ("hold_s", 0.5)),
        ("require_initial_pose=true", ("require_initial_pose", True)),
        ("process_noise=werner", ("process_noise", "werner")),
        ("name=a=b", ("name", "a=b")),
    ],
)
def test_settings_are_read_as_yaml(text: str, expected: tuple[str, object]) -> None:
    assert parse_setting(text) == expected


def test_an_offline_run_can_be_replayed_and_scored(netpos: Netpos, tmp_path: Path) -> None:
    """The offline bag holds simulation and estimates; replaying it gives the same estimates."""
    first, second = tmp_path / "first", tmp_path / "second"
    made = netpos("run", "fast_pass", "--offline", "--seed", 5, "--bag", first)
    assert made.exit_code == 0, made.output
    assert netpos("replay", first, "--out", second).exit_code == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["first", "second"]
    with BagReader(first) as a, BagReader(second) as b:
        topics = ["/vue_1/odometry", "/vue_1/clock_state", "/vue_1/track_status"]
        assert {"/clock", "/rsu/measurements", "/vue_1/ground_truth", *topics} <= a.topics.keys()
        estimates = [[(e.topic, e.cdr) for e in bag.messages(topics)] for bag in (a, b)]
        assert estimates[0] == estimates[1]
    assert netpos("evaluate", first).exit_code == 0


def test_an_unknown_parameter_of_the_tracker(netpos: Netpos, bag: Path, tmp_path: Path) -> None:
    result = netpos("replay", bag, "--out", tmp_path / "b", "--set", "hold=1")
    assert_refused(result, "'hold'", "hold_s")
    assert not (tmp_path / "b").exists()


def test_recover_saves_what_is_left(netpos: Netpos, cut_bag: Path) -> None:
    result = netpos("recover", cut_bag)
    assert result.exit_code == 0, result.output
    assert "62 messages" in result.stdout
    assert netpos("evaluate", cut_bag.parent / "walk_recovered").exit_code == 0


def test_recover_leaves_a_whole_bag_alone(netpos: Netpos, bag: Path) -> None:
    result = netpos("recover", bag)
    assert result.exit_code == 0
    assert "nothing to recover" in result.stdout


@pytest.mark.parametrize("kind", ["ble-aoa", "uwb-anchors", "car-imu-rtk"])
def test_import_of_nothing(netpos: Netpos, tmp_path: Path, kind: str) -> None:
    result = netpos("import", kind, tmp_path / "none", tmp_path / "b")
    assert_refused(result, "none")
    assert not (tmp_path / "b").exists()


def test_report_is_one_file_that_needs_no_network(
    netpos: Netpos, bag: Path, tmp_path: Path
) -> None:
    result = netpos("report", bag.parent, "--out", tmp_path / "out" / "report.html", "--skip", 0)
    assert result.exit_code == 0, result.output
    text = (tmp_path / "out" / "report.html").read_text()
    assert "<h2>walk</h2>" in text
    assert "position RMSE" in text
    assert "Plotly.newPlot" in text
    assert 'src="http' not in text


def test_report_says_which_bags_it_leaves_out(
    netpos: Netpos, bag: Path, raw_bag: Path, tmp_path: Path
) -> None:
    result = netpos("report", tmp_path, "--out", tmp_path / "r.html")
    assert result.exit_code == 0, result.output
    assert "raw has no estimates" in result.stderr
    assert "1 of 2 bags" in result.stdout
    assert "raw has no estimates" in (tmp_path / "r.html").read_text()


def test_report_of_a_bag_without_ground_truth(
    netpos: Netpos, bag: Path, blind_bag: Path, tmp_path: Path
) -> None:
    result = netpos("report", tmp_path, "--out", tmp_path / "r.html")
    assert result.exit_code == 0, result.output
    assert "2 of 2 bags" in result.stdout
    page = (tmp_path / "r.html").read_text()
    assert "blind (no ground truth)" in page
    assert "measured minus where the track is" in page


def test_report_of_a_bag_that_cannot_be_scored(
    netpos: Netpos, raw_bag: Path, tmp_path: Path
) -> None:
    result = netpos("report", raw_bag, "--out", tmp_path / "r.html")
    assert_refused(result, "raw has no estimates")


def test_report_of_nothing(netpos: Netpos, tmp_path: Path) -> None:
    assert_refused(netpos("report", tmp_path, "--out", tmp_path / "r.html"), "folder of bags")


def test_report_is_html(netpos: Netpos, bag: Path, tmp_path: Path) -> None:
    assert_refused(netpos("report", bag, "--out", tmp_path / "r.pdf"), ".html")


@pytest.mark.parametrize(
    "arguments",
    [("evaluate",), ("fly",), ("evaluate", "a", "--nothing"), ("import", "csv", "a", "b")],
)
def test_bad_usage(netpos: Netpos, arguments: tuple[str, ...]) -> None:
    assert netpos(*arguments).exit_code == 2


def test_help_loads_nothing_heavy() -> None:
    """What makes help slow must only load inside the commands."""
    heavy = ("numpy", "scipy", "numba", "matplotlib", "plotly", "rosbags", "pydantic")
    script = f"import sys, netpos.cli.main\nprint([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


def own_recording(folder: Path) -> tuple[str, ...]:
    """Arguments that import a small recording of three anchors: at (0, 0), (8, 0) and (0, 8)."""
    (folder / "rsus.yaml").write_text("rsus: {a: [0, 0, 0], b: [8, 0, 0], c: [0, 8, 0]}\n")
    lines, poses = ["t,a,b,c"], []
    for i in range(300):
        t, x, y = 10 + i / 10, 3 + math.sin(i / 40), 3 + math.cos(i / 40)
        ranges = (math.hypot(x, y), math.hypot(x - 8, y), math.hypot(x, y - 8))
        lines.append(",".join(f"{value:.4f}" for value in (t, *ranges)))
        poses.append(f"{t} {x} {y} 0 0 0 0 1")
    (folder / "own.csv").write_text("\n".join([*lines, "99,1"]))
    (folder / "walk.tum").write_text("\n".join(poses) + "\n")
    return (
        *("import", "csv", str(folder / "own.csv"), str(folder / "bag")),
        *("--map", "time=t,range:a=a,range:b=b,range:c=c", "--sd", "range=0.05"),
        *("--rsus", str(folder / "rsus.yaml"), "--truth", str(folder / "walk.tum")),
    )


def test_an_own_recording_is_imported_tracked_and_scored(netpos: Netpos, tmp_path: Path) -> None:
    imported = netpos(*own_recording(tmp_path), "--truth-align", "shift", "--device-height", "0")
    assert imported.exit_code == 0, imported.output
    assert "cut first or last lines: 1" in imported.stdout
    assert netpos("replay", tmp_path / "bag", "--out", tmp_path / "out").exit_code == 0
    scored = netpos("evaluate", tmp_path / "out", "--json", tmp_path / "out.json")
    assert scored.exit_code == 0, scored.output
    text = " ".join(scored.stdout.split())
    assert "truth aligned to the measurements: turned 0.00 deg" in text
    assert "skipped on import: cut first or last lines 1" in text
    figures = json.loads((tmp_path / "out.json").read_text())
    assert figures["vues"]["vue_1"]["rmse_m"] < 0.1


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        (("--truth-align", "rigidly"), "give none, shift or rigid"),
        (("--truth-time-offset", "soon"), "give seconds or auto"),
        (("--lever-arm", "1,2"), "takes three numbers"),
        (("--delimiter", "dot"), "give one of comma"),
        (("--set", "device_hight_m=1"), "device_height_m"),
    ],
)
def test_an_own_recording_with_a_bad_option(
    netpos: Netpos, tmp_path: Path, extra: tuple[str, ...], message: str
) -> None:
    assert_refused(netpos(*own_recording(tmp_path), *extra), message)
    assert not (tmp_path / "bag").exists()


def test_the_documented_program_writes_a_bag_that_is_tracked(
    netpos: Netpos, tmp_path: Path
) -> None:
    page = Path(__file__).parents[5] / "docs" / "own_recording.md"
    (program,) = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    assert len(program.splitlines()) <= 35
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    result = netpos("replay", tmp_path / "my_walk", "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert "600 epochs" in result.stdout


def test_compare_says_which_is_better(netpos: Netpos, bag: Path, tmp_path: Path) -> None:
    shutil.copytree(bag, tmp_path / "other")
    figures = tmp_path / "d.json"
    result = netpos("compare", bag, tmp_path / "other", "--skip", 0, "--json", figures)
    assert result.exit_code == 0, result.output
    assert "vue_1: other and walk are not told apart: +0.000 m" in result.stdout
    assert max(map(len, result.stdout.splitlines())) <= 80
    (difference,) = json.loads(figures.read_text())["differences"]
    assert difference["difference_m"] == 0.0
    assert_refused(netpos("compare", bag), "two bags or more")
