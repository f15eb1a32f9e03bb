"""Bad input to running processes: exit code, one clear sentence, nothing lost, never a NaN."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest
from graph import LATCHED, Process
from nav_msgs.msg import Odometry
from netpos.bags import BagReader, BagWriter, codec
from netpos.messages.values import Field, RsuMeasurement
from netpos_msgs.msg import ClockState, RsuInfo, TrackStatus
from netpos_msgs.msg import RsuMeasurement as RsuMeasurementMessage
from netpos_node import CODEC
from rclpy.serialization import serialize_message
from runs import (
    CLOCK_STATE,
    INFOS,
    MEASUREMENTS,
    ODOMETRY,
    TRACK_STATUS,
    TRUTH,
    graphs,
    messages,
    netpos,
    run_netpos,
    script,
)

NAN = math.nan
MALFORMED = """\
rsus:
  units:
    - {id: rsu_1, position: [0.0, 0.0, 0.0]}
measurement:
  errors: {model: fixed, azimuth_sd_deg: 2.0, toa_sd_s: 50.0e-9}
devices:
  - route: {kind: waypoints, points: [[0.0, 0.0], [10.0, 0.0]]}
    speed_mps: -3.0
    beacon_interval_s: 0.1
"""


@dataclass(frozen=True)
class Bags:
    """A folder with a good bag and others that have something wrong."""

    folder: Path
    good: Path
    cut: Path
    blind: Path
    contents: dict[str, bytes] = field(default_factory=dict)


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(file.relative_to(folder)): file.read_bytes()
        for file in sorted(folder.rglob("*"))
        if file.is_file() and not file.relative_to(folder).parts[0].startswith("logs_")
    }


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> Bags:
    folder = tmp_path_factory.mktemp("bad_input")
    made = Bags(folder, folder / "good", folder / "cut", folder / "blind")
    netpos("run", "fast_pass", "--offline", "--bag", made.good)
    made.cut.mkdir()
    (recording,) = made.good.glob("*.mcap")
    content = recording.read_bytes()
    (made.cut / "cut_0.mcap").write_bytes(content[: len(content) * 2 // 3])
    with BagReader(made.good) as reader, BagWriter(made.blind) as writer:
        for entry in reader.messages():
            if entry.topic != TRUTH:
                writer.write_raw(entry.topic, entry.type_name, entry.cdr, entry.log_time_ns)
    (folder / "malformed.yaml").write_text(MALFORMED)
    (folder / "broken.yaml").write_text("rsus: [1, 2\nseed: 3\n")
    made.contents.update(contents(folder))
    return made


# Nodes: package, executable, arguments, what they say. {f} is the folder of bags.
NODES: dict[str, tuple[str, str, list[str], str]] = {
    "vue_sim scenario": ("vue_sim", "vue_sim", ["scenario:=nope"], "no scenario 'nope'; known:"),
    "rsu_sensor scenario": ("rsu_sensor", "rsu_sensor", ["scenario:=nope"], "fast_pass"),
    "tracker scenario": ("ekf_tracker", "ekf_tracker", ["scenario:=nope"], "no scenario 'nope'"),
    "malformed scenario": (
        *("vue_sim", "vue_sim", ["scenario:={f}/malformed.yaml"]),
        "malformed.yaml: line 8: devices.0.speed_mps",
    ),
    "broken scenario": (
        *("rsu_sensor", "rsu_sensor", ["scenario:={f}/broken.yaml"]),
        "broken.yaml: line 2: not valid YAML",
    ),
    "vue_sim rate": ("vue_sim", "vue_sim", ["rate:=-1.0"], "rate must be above 0"),
    "rsu_sensor seed": ("rsu_sensor", "rsu_sensor", ["seed:=-5"], "seed"),
    "unknown RSU": (
        *("rsu_sensor", "rsu_sensor", ["rsus:=[nope]", "scenario:=fast_pass"]),
        "rsus names nope, but scenario fast_pass has rsu_1, rsu_2",
    ),
    "tracker range": ("ekf_tracker", "ekf_tracker", ["gate_probability:=1.5"], "gate_probability"),
    "tracker choice": ("ekf_tracker", "ekf_tracker", ["filter:=magic"], "ekf, iekf"),
    "tracker type": ("ekf_tracker", "ekf_tracker", ["hold_s:=soon"], "hold_s"),
    "misspelt": ("vue_sim", "vue_sim", ["seeed:=3"], "no parameter 'seeed'; did you mean seed?"),
    "pdr range": ("pdr_node", "pdr_node", ["weinberg_k:=-1.0"], "weinberg_k"),
    "record output": ("netpos_bag", "record", ["output:={f}/good"], "never overwritten"),
    "record nothing": ("netpos_bag", "record", [], "--output DIR"),
    "play missing": ("netpos_bag", "play", ["bag:={f}/absent"], "absent"),
    "play cut": ("netpos_bag", "play", ["bag:={f}/cut"], "netpos recover"),
    "play rate": ("netpos_bag", "play", ["bag:={f}/good", "rate:=0.0"], "--rate must be > 0"),
}


@pytest.fixture(scope="module")
def refused(bags: Bags) -> Iterator[dict[str, Process]]:
    """All the processes above, started together."""
    with graphs(bags.folder) as (graph,):
        started = {}
        for name, (package, executable, parameters, _) in NODES.items():
            given = [a for p in parameters for a in ("-p", p.format(f=bags.folder))]
            started[name] = graph.run(package, executable, *(["--ros-args", *given] * bool(given)))
        yield started


@pytest.mark.parametrize("name", NODES)
def test_node_refuses_with_one_sentence(refused: dict[str, Process], name: str) -> None:
    process = refused[name]
    assert process.wait() == 2, process.describe()
    lines = [line for line in process.output.splitlines() if line.strip()]
    assert len(lines) == 1, process.output
    assert NODES[name][3] in lines[0]


# Command line: arguments, exit code, what it says; nothing in the folder changes.
COMMANDS: dict[str, tuple[str, int, str]] = {
    "run unknown": ("run nope --offline --bag {f}/new", 2, "no scenario 'nope'"),
    "run malformed": ("run {f}/malformed.yaml --bag {f}/new", 2, "line 8: devices.0.speed_mps"),
    "run onto a bag": ("run fast_pass --bag {f}/good", 2, "never overwritten"),
    "run offline onto a bag": ("run fast_pass --offline --bag {f}/good", 2, "never overwritten"),
    "replay missing": ("replay {f}/absent --out {f}/new", 2, "absent"),
    "replay cut": ("replay {f}/cut --out {f}/new", 2, "netpos recover"),
    "replay onto a bag": ("replay {f}/good --out {f}/blind", 2, "never overwritten"),
    "replay onto itself": ("replay {f}/good --out {f}/good", 2, "never overwritten"),
    "replay parameter": ("replay {f}/good --out {f}/new --set gate=1", 2, "gate"),
    "evaluate missing": ("evaluate {f}/absent", 2, "absent"),
    "evaluate cut": ("evaluate {f}/cut", 2, "netpos recover"),
    "evaluate blind": ("evaluate {f}/blind --errors {f}/x.png", 2, "needs ground truth"),
    "import of nothing": ("import ble-aoa {f}/absent {f}/new", 2, "does not exist"),
    "recover missing": ("recover {f}/absent", 2, "absent"),
}


@pytest.fixture(scope="module")
def commanded(bags: Bags) -> Iterator[dict[str, Process]]:
    """All the commands above, started together."""
    with graphs(bags.folder) as (graph,):
        started = {
            name: graph.start("netpos", ["netpos", *text.format(f=bags.folder).split()])
            for name, (text, _, _) in COMMANDS.items()
        }
        yield started


@pytest.mark.parametrize("name", COMMANDS)
def test_command_refuses_with_one_sentence(commanded: dict[str, Process], name: str) -> None:
    _, code, said = COMMANDS[name]
    process = commanded[name]
    assert process.wait() == code, process.describe()
    lines = [line for line in process.output.splitlines() if line.strip()]
    assert len(lines) == 1, process.output
    assert said in lines[0]


@pytest.mark.usefixtures("refused")
def test_nothing_was_lost_or_left_behind(bags: Bags, commanded: dict[str, Process]) -> None:
    for process in commanded.values():
        process.wait()
    names = {path.name for path in bags.folder.iterdir() if not path.name.startswith("logs_")}
    assert names == {"good", "cut", "blind", "malformed.yaml", "broken.yaml"}
    assert contents(bags.folder) == bags.contents


def test_import_never_overwrites(bags: Bags, tmp_path: Path) -> None:
    """A tiny recording in the form of the authors' own."""
    lines = ["1000,tag,-60,5.0,-10.0,-61,37,6501", "1100,tag,-60,5.5,-10.0,-61,37,6502"]
    (tmp_path / "beacons_a.csv").write_text("\n".join(lines) + "\n")
    (tmp_path / "truth_a.csv").write_text("1000,NaN,100,300\n2000,NaN,200,300\n")
    netpos("import", "ble-aoa", tmp_path, tmp_path / "new")
    before = contents(bags.folder)
    done = run_netpos("import", "ble-aoa", tmp_path, bags.good)
    assert done.returncode == 2
    assert "exists" in done.stderr
    assert contents(bags.folder) == before


@pytest.mark.parametrize(
    ("source", "out", "said"),
    [("absent", "new", "no bag at"), ("good", "blind", "never overwritten")],
)
def test_play_script_refuses(bags: Bags, source: str, out: str, said: str) -> None:
    before = contents(bags.folder)
    with graphs(bags.folder) as (graph,):
        process = script(graph, "play_bag", bags.folder / source, bags.folder / out)
        assert process.wait() == 1
        assert said in process.output
    assert contents(bags.folder) == before


# Messages to a running tracker.


def spoilt(good: RsuMeasurement) -> list[tuple[str, RsuMeasurement]]:
    """Measurements no tracker may use, with the reason it shall give."""
    ranged = replace(good, fields=Field.RANGE, range_m=10.0, range_var=1.0)
    return [
        ("unknown_rsu", replace(good, rsu_id="nobody")),
        ("not_finite", replace(good, azimuth_rad=NAN)),
        ("not_finite", replace(good, toa_s=math.inf)),
        ("not_finite", replace(good, azimuth_var=NAN)),
        ("variance", replace(good, azimuth_var=-0.01)),
        ("variance", replace(good, toa_var=0.0)),
        ("negative_range", replace(ranged, range_m=-1.0)),
        ("variance", replace(ranged, range_var=-1.0)),
        ("no_fields", replace(good, fields=Field(0))),
        ("zero_stamp", replace(good, stamp_ns=0)),
    ]


@pytest.fixture(scope="module")
def attacked(bags: Bags) -> Iterator[tuple[list[Any], list[Any], Counter[str], str]]:
    """Odometry, statuses, what was sent by reason, and the log of a tracker that hears fast_pass
    with spoilt measurements among the good ones."""
    read = codec()
    infos = [read.rsu_info_from_msg(m) for m in messages(bags.good, INFOS)]
    good = [read.measurement_from_msg(m) for m in messages(bags.good, MEASUREMENTS)]
    sent: Counter[str] = Counter()
    with graphs(bags.folder) as (graph,):
        odometry = graph.collect(ODOMETRY, Odometry)
        status = graph.collect(TRACK_STATUS, TrackStatus)
        graph.collect(CLOCK_STATE, ClockState)
        info_out = graph.publisher(INFOS, RsuInfo, LATCHED)
        out = graph.publisher(MEASUREMENTS, RsuMeasurementMessage)
        for info in infos:
            info_out.publish(CODEC.rsu_info_to_msg(info))
        info_out.publish(
            CODEC.rsu_info_to_msg(replace(infos[0], position=infos[0].position * NAN))
        )
        tracker = graph.run(
            "ekf_tracker", "ekf_tracker", parameters={"scenario": "fast_pass", "subscribers": 1}
        )
        tracker.wait_for_output("tracking vue_1")
        graph.wait_for_subscribers(MEASUREMENTS)
        tracker.wait_for_output("RSU refused: pose of rsu_1 is not finite")
        for index, measurement in enumerate(good):
            if index % 20 == 5:
                for reason, bad in spoilt(measurement):
                    out.publish(CODEC.measurement_to_msg(bad))
                    sent[reason] += 1
            out.publish(CODEC.measurement_to_msg(measurement))
            if index == 61:  # the 31st epoch is complete
                status.wait_for(31)
                out.publish(CODEC.measurement_to_msg(measurement))
                out.publish(CODEC.measurement_to_msg(good[0]))
                sent += Counter(duplicate=1, late=1)
        status.wait_for(51)
        odometry.wait_for(len(messages(bags.good, ODOMETRY)))  # another topic, maybe later
        yield list(odometry.messages), list(status.messages), sent, tracker.output
        assert tracker.interrupt() == 0, tracker.describe()


def test_spoilt_measurements_are_counted_by_reason(attacked: Any) -> None:
    _, statuses, sent, log = attacked
    last = statuses[-1]
    counted = Counter(
        {r: int(n) for r, n in zip(last.rejection_reasons, last.rejection_counts, strict=True)}
    )
    assert +counted == sent
    assert last.rejected == sent.total()
    assert "refused a RsuMeasurement" in log
    assert "Traceback" not in log


def test_spoilt_measurements_change_no_bit_of_the_estimates(attacked: Any, bags: Bags) -> None:
    """Nothing good is lost with them: the odometry is that of the run without them."""
    received, _, _, _ = attacked
    make = codec()
    with BagReader(bags.good) as reader:
        wanted = [bytes(entry.cdr) for entry in reader.messages([ODOMETRY])]
    assert len(received) == len(wanted)
    for message, cdr in zip(received, wanted, strict=True):
        assert same_bits(message, cdr)
        value = make.odometry_from_msg(message)
        assert all(math.isfinite(x) for x in (*value.position, *value.pose_cov.ravel()))
        assert all(math.isfinite(x) for x in (*value.linear_velocity, *value.twist_cov.ravel()))


def same_bits(message: Any, cdr: bytes) -> bool:
    """Equal when serialised; the 4 bytes of padding before the pose belong to no field."""
    sent = bytes(serialize_message(message))
    return len(sent) == len(cdr) and sent[:40] == cdr[:40] and sent[44:] == cdr[44:]


def test_statuses_are_finite(attacked: Any) -> None:
    for status in attacked[1]:
        assert math.isfinite(status.nis)
        assert math.isfinite(status.position_sd)
