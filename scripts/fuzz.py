#!/usr/bin/env python3
"""Malformed messages, damaged bags and damaged scenarios: nothing raises, nothing wrong is taken.

    scripts/fuzz.py --messages 1000000 --bags 10000 --contents 1000 --yaml 1000 --seed 1

prints a table of what became of them, and every seed that failed. Exit status 1 if one did. Ctrl-C
ends it after the item it is at; the table then tells how far it came.
``bags`` have damaged bytes; ``contents`` are whole bags in which other messages, times, topics or
facts were written.
"""

from __future__ import annotations

import argparse
import random
import shutil
import signal
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import netpos
import numpy as np
from netpos.bags import BagError, BagReader, BagWriter, cdr_codec, codec, typestore
from netpos.bags.recover import recover
from netpos.cli.main import app
from netpos.messages import topics
from netpos.messages.network_tracks import network_track_from_msg
from netpos.messages.values import RsuInfo
from netpos.scenario.load import ScenarioError, load_scenario, scenario_files
from netpos.scenario.settings import bag_settings
from netpos.tracking import Tracker, TrackerConfig
from rosbags.serde import SerdeError
from typer.testing import CliRunner

BATCH = 500  # messages of one tracker
COMMANDS = ("read", "recover", "evaluate", "replay", "report", "compare", "rsus", "import")
CONTENT_COMMANDS = (*COMMANDS, "load", "truth")
SCENARIOS = ("fast_pass", "tdoa_yard", "pedestrian_walk", "intersection_turn")  # of messages
SLOW_S = 60.0  # for one message, bag or scenario
ODD = (0.0, -0.0, 5e-324, 1e-300, 1e300, -1e300, float("nan"), float("inf"), 1e9, -1e9)
_READ = {
    topics.RSU_INFO: "rsu_info",
    topics.RSU_MEASUREMENTS: "measurement",
    topics.GROUND_TRUTH: "odometry",
    topics.ODOMETRY: "odometry",
    topics.CLOCK_STATE: "clock_state",
    topics.TRACK_STATUS: "track_status",
    topics.BEACON: "beacon",
    topics.MAG: "magnetic_field",
}
_READ_OF = {  # what the topic, not the message, says whose it is
    topics.IMU: "imu",
    topics.INITIAL_POSE: "initial_pose",
    topics.STEP_VELOCITY: "velocity",
    topics.GROUND_SPEED: "ground_speed",
}
FED = ("RsuMeasurement", "InitialPose", "ImuSample", "Velocity", "GroundSpeed")


_stopped: list[int] = []


class FuzzError(AssertionError):
    """Something wrong was taken, or something not finite came out."""


def spoil(rng: random.Random, data: bytes, flips: int) -> bytes:
    """Bits flipped; sometimes cut, grown, or an odd number put in."""
    bad = bytearray(data)
    for _ in range(flips):
        if bad:
            bad[rng.randrange(len(bad))] ^= 1 << rng.randrange(8)
    kind = rng.random()
    if kind < 0.1:
        del bad[rng.randrange(len(bad) + 1) :]
    elif kind < 0.15:
        bad += rng.randbytes(rng.randrange(1, 64))
    elif kind < 0.6 and len(bad) > 16:
        at = 4 + 8 * rng.randrange((len(bad) - 4) // 8)
        bad[at : at + 8] = np.float64(rng.choice(ODD)).tobytes()
    return bytes(bad)


# messages


def recorded(path: Path) -> list[tuple[str, str, bytes]]:
    """(topic, type, bytes) of a bag."""
    with BagReader(path) as bag:
        return [(e.topic, e.type_name, e.cdr) for e in bag.messages()]


@cache
def described(path: Path) -> tuple[TrackerConfig, list[RsuInfo]]:
    """Parameters and RSUs of a bag."""
    with BagReader(path) as bag:
        config = TrackerConfig.from_mapping(dict(bag_settings(bag).parameters))
        infos = bag.messages([topics.RSU_INFO])
        return config, [codec().rsu_info_from_msg(entry.message) for entry in infos]


def tracker_of(path: Path) -> Tracker:
    """One with the RSUs and the parameters of a bag."""
    config, infos = described(path)
    made = Tracker(config)
    for info in infos:
        made.add_rsu(info)
    return made


def value_of(topic: str, type_name: str, cdr: bytes) -> Any:
    """The value of bytes as readers see it; None for what no value is made of.

    Raises ``ValueError`` or ``SerdeError`` for what is refused.
    """
    vue_id, name = topics.split(topic)
    name = name if vue_id else topic
    if name == topics.RSU_MEASUREMENTS:
        fast = cdr_codec().measurement(cdr)
        if fast is not None:
            return fast
    try:
        message = typestore().deserialize_cdr(cdr, type_name)
    except (ValueError, KeyError, IndexError, MemoryError) as error:  # as BagReader.decode
        raise BagError(str(error)) from error
    if name in _READ_OF:
        return getattr(codec(), f"{_READ_OF[name]}_from_msg")(message, vue_id)
    if type_name.endswith("/NetworkTrack"):
        return network_track_from_msg(message)
    read = _READ.get(name)
    return None if read is None else getattr(codec(), f"{read}_from_msg")(message)


def finite(tracker: Tracker, outputs: list[Any]) -> None:
    """Whatever comes out is finite, and can be written."""
    for output in outputs:
        if output.odometry is not None:
            o = output.odometry
            if not all(np.isfinite(v).all() for v in (o.position, o.pose_cov, o.linear_velocity)):
                raise FuzzError(f"not finite: {o}")
            cdr_codec().odometry(o)
        clock = output.clock
        if (
            clock is not None
            and not np.isfinite([clock.offset_s, clock.drift, *clock.cov.flat]).all()
        ):
            raise FuzzError(f"not finite: {clock}")
        cdr_codec().track_status(output.status)
    tracker.findings({}, {})


def message_batch(source: list[tuple[str, str, bytes]], path: Path, seed: int, n: int) -> Counter:
    """Feed ``n`` messages, seven of ten spoilt, to the codecs and a tracker."""
    rng, counts = random.Random(seed), Counter[str]()
    tracker = tracker_of(path)
    measured = [e for e in source if e[0] == topics.RSU_MEASUREMENTS or _is_input(e[0])]
    by_topic = list({entry[0]: entry for entry in source}.values())
    start = rng.randrange(len(measured))
    for i in range(n):  # measurements in their order, now and then something else
        topic, type_name, cdr = measured[(start + i) % len(measured)]
        if rng.random() < 0.3:
            topic, type_name, cdr = rng.choice(by_topic)
        if rng.random() < 0.7:
            cdr = spoil(rng, cdr, rng.randrange(4))
        try:
            value = value_of(topic, type_name, cdr)
        except (ValueError, SerdeError):
            counts["bytes refused"] += 1
            continue
        if topic == topics.RSU_INFO:
            try:
                tracker.add_rsu(value)
                counts["taken"] += 1
            except ValueError:
                counts["refused"] += 1
        elif type(value).__name__ in FED:
            counts["refused" if tracker.add(value) else "taken"] += 1
            finite(tracker, tracker.process())
        else:
            counts["decoded"] += 1
    finite(tracker, tracker.flush())
    return counts


def _is_input(topic: str) -> bool:
    return topics.split(topic)[1] in (topics.IMU, topics.STEP_VELOCITY, topics.INITIAL_POSE)


# bags


def content(path: Path) -> tuple[Counter, dict[str, str], dict[str, str]]:
    """Messages, types and facts of a bag."""
    with BagReader(path) as bag:
        messages = Counter((e.topic, e.type_name, e.log_time_ns, e.cdr) for e in bag.messages())
        types = {name: info.definition for name, info in bag.topics.items()}
        return messages, types, dict(bag.metadata)


def compare(path: Path, original: tuple[Counter, dict[str, str], dict[str, str]]) -> None:
    """Everything that is read is as it was before the damage."""
    messages, types, facts = content(path)
    if messages - original[0]:
        raise FuzzError("a message is not as it was recorded")
    said = {k: v for k, v in facts.items() if k != "recovered_from"}
    if not (types.items() <= original[1].items() and said.items() <= original[2].items()):
        raise FuzzError("a definition or a fact is not as it was recorded")


def damaged(source: Path, folder: Path, rng: random.Random) -> Path:
    """A copy of a bag with one to fifty flips, or cut, in one of its files or in both."""
    bag = folder / source.name
    shutil.copytree(source, bag)
    files = sorted(bag.iterdir())
    chosen = files if rng.random() < 0.2 else [rng.choice(files)]
    for file in chosen:
        file.write_bytes(spoil(rng, file.read_bytes(), rng.choice((0, 1, 1, 2, 5, 10, 50))))
    if rng.random() < 0.1:
        rng.choice(files).unlink()
    return bag


def rewritten(source: Path, folder: Path, rng: random.Random) -> Path:
    """A whole bag with one to fifty of its messages spoilt, and sometimes other times, topics or
    facts; every checksum is right."""
    bag, share = folder / source.name, rng.choice((0.003, 0.03, 0.3))
    odd_times = rng.random() < 0.2
    with BagReader(source) as whole:
        facts = dict(whole.metadata)
        if facts and rng.random() < 0.3:
            name = rng.choice(sorted(facts))
            spoilt = spoil(rng, facts[name].encode(), rng.randrange(1, 20))
            facts[name] = spoilt.decode(errors="replace")
        names = {name: name for name in whole.topics}
        if rng.random() < 0.2:
            names[rng.choice(sorted(names))] = rng.choice(("/x", "/vue_1", "/a/b/c", "/rsu/odd"))
        with BagWriter(bag, metadata=facts) as copy:
            for entry in whole.messages():
                cdr, time_ns = entry.cdr, entry.log_time_ns
                if rng.random() < share:
                    cdr = spoil(rng, cdr, rng.randrange(4)).ljust(4, b"\0")
                if odd_times and rng.random() < share:
                    time_ns = rng.choice((0, 1, time_ns // 2, 2**62, 2**63 - 1))
                copy.write_raw(names[entry.topic], entry.type_name, cdr, time_ns)
    return bag


def one_content(source: Path, seed: int) -> str:
    """What became of one bag with other content, with the command of its seed."""
    rng, command = random.Random(seed), CONTENT_COMMANDS[seed % len(CONTENT_COMMANDS)]
    folder = Path(tempfile.mkdtemp(prefix="netpos_fuzz_"))
    try:
        bag = rewritten(source, folder, rng)
        return f"{command}: {_outcome(command, source, bag, folder, content(bag))}"
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def one_bag(source: Path, original: Any, seed: int) -> str:
    """What became of one damaged bag with the command of its seed."""
    rng, command = random.Random(seed), COMMANDS[seed % len(COMMANDS)]
    folder = Path(tempfile.mkdtemp(prefix="netpos_fuzz_"))
    try:
        bag = damaged(source, folder, rng)
        return f"{command}: {_outcome(command, source, bag, folder, original)}"
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _outcome(command: str, source: Path, bag: Path, folder: Path, original: Any) -> str:
    if command not in ("read", "recover"):
        return _command(command, source, bag, folder, original)
    try:
        compare(bag if command == "read" else recover(bag).output or bag, original)
    except BagError:
        return "refused"
    return "done"


def _command(command: str, source: Path, bag: Path, folder: Path, original: Any) -> str:
    out = str(folder / "out")
    arguments = {
        "evaluate": ["evaluate", str(bag), "--json", f"{out}.json"],
        "replay": ["replay", str(bag), "--out", out],
        "report": ["report", str(bag), "--out", f"{out}.html"],
        "compare": ["compare", str(source), str(bag)],
        "rsus": ["rsus", "save", str(bag), f"{out}.yaml"],
        "import": [
            *("import", "ros", str(bag), out, "--topic", topics.RSU_MEASUREMENTS, "--map"),
            "time=header.stamp,rsu=rsu_id,azimuth=azimuth,toa=toa",
            *("--sd", "azimuth=0.03,toa=5e-8"),
        ],
        "load": ["rsus", "load", str(bag / "rsus.yaml"), str(bag), out],
        "truth": ["evaluate", str(source), "--truth", str(bag)],
    }[command]
    if command == "load":
        (bag / "rsus.yaml").write_text("rsus: {rsu_1: [0, 0, 0], rsu_2: [9, 0, 0]}\n")
    done = CliRunner().invoke(app, arguments)
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    if done.exit_code not in (0, 1, 2):
        raise FuzzError(f"exit status {done.exit_code}")
    if done.exit_code == 0 and command == "replay":
        inputs = Counter({k: n for k, n in original[0].items() if not _estimated(k[0])})
        found = Counter({k: n for k, n in content(Path(out))[0].items() if not _estimated(k[0])})
        if found != inputs:
            raise FuzzError("the input of a replay is not what was recorded")
    return "done" if done.exit_code == 0 else "refused"


def _estimated(topic: str) -> bool:
    return topics.is_tracker_output(topic)


# scenarios


def one_yaml(seed: int) -> str:
    """What became of one damaged scenario: refused in words, or loaded."""
    rng = random.Random(seed)
    files = sorted(scenario_files().values())
    text = rng.choice(files).read_bytes()
    lines = text.splitlines(keepends=True)
    kind = rng.randrange(4)
    if kind == 0:
        text = spoil(rng, text, rng.randrange(1, 20))
    elif kind == 1:
        rng.shuffle(lines)
        text = b"".join(lines)
    elif kind == 2:
        text = b"".join(line for line in lines if rng.random() < 0.9)
    else:
        words = text.split(b" ")
        values = (b"1e9", b"-1", b"nan", b".inf", b"[]", b"{}", b"null", b"1e308", b"'x'", b"0")
        for _ in range(rng.randrange(1, 4)):
            numbers = [i for i, w in enumerate(words) if w[:1].isdigit()]
            words[rng.choice(numbers)] = rng.choice(values) + b"\n"
        text = b" ".join(words)
    with tempfile.TemporaryDirectory(prefix="netpos_fuzz_") as folder:
        file = Path(folder) / "a.yaml"
        file.write_bytes(text)
        try:
            load_scenario(str(file))
        except ScenarioError as error:
            if "Traceback" in str(error) or str(file) not in str(error):
                raise FuzzError(f"says too little: {error}") from error
            return "refused"
    return "loaded"


# campaigns


def campaign(
    name: str, seeds: range, run: Callable[[int], Counter[str] | str]
) -> tuple[Counter[str], list[str]]:
    """Counts of what became of all, and what failed, by seed."""
    counts, failed = Counter[str](), []
    for seed in seeds:
        if _stopped:
            break
        begin_s = time.monotonic()
        try:
            told = run(seed)
            if time.monotonic() - begin_s > SLOW_S:
                raise FuzzError(f"took {time.monotonic() - begin_s:.0f} s")
            counts.update(told if isinstance(told, Counter) else [told])
        except Exception as error:
            counts["FAILED"] += 1
            words = " ".join(str(error).split())[:150]
            failed.append(f"{name} seed {seed}: {type(error).__name__}: {words}")
            print(failed[-1], flush=True)
    return counts, failed


def example(folder: Path, scenario: str = "fast_pass") -> Path:
    """A tracked run, in chunks of 50 messages."""
    run, tracked = folder / f"{scenario}_run", folder / f"{scenario}_tracked"
    bag = folder / scenario
    netpos.Scenario.load(scenario, seed=1).simulate(run).track(tracked)
    with BagReader(tracked) as source, BagWriter(bag, metadata=source.metadata) as copy:
        for name, info in source.topics.items():
            copy.add_topic(name, info.type_name, info.qos)
        for i, entry in enumerate(source.messages()):
            copy.write_raw(entry.topic, entry.type_name, entry.cdr, entry.log_time_ns)
            if i % 50 == 49:
                copy.flush()
    return bag


def fuzz(
    counts: dict[str, int], seed: int, bags: list[Path]
) -> tuple[dict[str, Counter], list[str]]:
    """Campaigns by name, so many items each, with damaged copies of the first of ``bags`` and with
    messages of all: counts by name, failures."""
    sources = [(recorded(path), path) for path in bags]
    original, bag = content(bags[0]), bags[0]
    messages = counts.get("messages", 0)

    def batch(s: int) -> Counter:
        return message_batch(*sources[s % len(sources)], s, min(BATCH, messages))

    runs: dict[str, Callable[[int], Counter | str]] = {
        "yaml": one_yaml,
        "bags": lambda s: one_bag(bag, original, s),
        "contents": lambda s: one_content(bag, s),
        "messages": batch,
    }
    found, failures = {}, []
    for name, run in runs.items():
        count = counts.get(name, 0)
        items = -(-count // BATCH) if name == "messages" else count
        found[name], failed = campaign(name, range(seed, seed + items), run)
        failures += failed
    return found, failures


def main() -> None:
    """Run the campaigns that were asked for."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    defaults = {"messages": 10_000, "bags": 100, "contents": 100, "yaml": 100}
    for name, default in (*defaults.items(), ("seed", 1)):
        parser.add_argument(f"--{name}", type=int, default=default)
    wanted = vars(parser.parse_args())
    warnings.simplefilter("ignore")
    signal.signal(signal.SIGINT, lambda number, _: _stopped.append(number))
    with tempfile.TemporaryDirectory(prefix="netpos_fuzz_") as folder:
        bags = [example(Path(folder), name) for name in SCENARIOS]
        found, failures = fuzz({name: wanted[name] for name in defaults}, wanted["seed"], bags)
    print("| campaign | what became of it | count |\n| --- | --- | --- |")
    for name, counts in found.items():
        for what, count in sorted(counts.items()):
            print(f"| {name} | {what} | {count} |")
    sys.exit(1 if failures else 0)


if __name__ == "__main__":
    main()
