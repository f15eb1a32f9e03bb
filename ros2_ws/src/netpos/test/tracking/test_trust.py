"""Who may say where the RSUs are: the list, the first, or anybody."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from netpos.bags import BagReader, BagWriter, codec
from netpos.bags.rsus_file import rsus_text
from netpos.messages import topics
from netpos.messages.values import Field, RsuInfo, RsuMeasurement
from netpos.scenario.replay import replay_bag
from netpos.scenario.settings import TrackerSettings, bag_settings
from netpos.tracking import Tracker, TrackerConfig
from netpos.tracking.health.diagnosis import Level

T0 = 1_000_000_000
TRUE = np.array([12.0, 31.0])
SITES = {"a": (0.0, 0.0), "b": (60.0, 0.0), "c": (60.0, 60.0), "d": (0.0, 60.0)}
INFOS = [RsuInfo(rsu_id=k, position=np.array([*v, 0.0])) for k, v in SITES.items()]


def moved(info: RsuInfo, metres: float) -> RsuInfo:
    return replace(info, position=info.position + np.array([metres, 0.0, 0.0]))


def turned(info: RsuInfo, degrees: float) -> RsuInfo:
    half = math.radians(degrees) / 2.0
    return replace(info, quaternion=np.array([0.0, 0.0, math.sin(half), math.cos(half)]))


def ranges(k: int) -> list[RsuMeasurement]:
    rng = np.random.default_rng(k)
    return [
        RsuMeasurement(
            stamp_ns=T0 + k * 100_000_000,
            rsu_id=name,
            vue_id="vue_1",
            expected=4,
            fields=Field.RANGE,
            range_m=float(np.linalg.norm(TRUE - site) + 0.1 * rng.standard_normal()),
            range_var=0.01,
        )
        for name, site in SITES.items()
    ]


def drive(tracker: Tracker, epochs: range) -> list[Any]:
    outputs = []
    for k in epochs:
        for m in ranges(k):
            tracker.add(m)
        outputs += tracker.process()
    return outputs


def error_m(outputs: list[Any]) -> float:
    return float(np.linalg.norm(outputs[-1].odometry.position[:2] - TRUE))


def message(tracker: Tracker, subject: str) -> tuple[Level, str]:
    (found,) = [f for f in tracker.findings({}, {}) if f.subject == subject]
    return found.level, found.message


def of(trust: str, rsus: list[RsuInfo] | None = None) -> Tracker:
    tracker = Tracker(TrackerConfig(trust=trust), rsus or [])
    for info in INFOS:
        tracker.add_rsu(info)
    return tracker


@pytest.mark.parametrize(("trust", "largest_m", "least_m"), [("first", 0.2, 0.0), ("any", 99, 20)])
def test_rsus_sent_again_elsewhere(trust: str, largest_m: float, least_m: float) -> None:
    """All four, 50 m aside: the first poses stand; with ``any`` the track goes along."""
    tracker = of(trust)
    drive(tracker, range(20))
    for info in INFOS:
        if trust == "first":
            with pytest.raises(ValueError, match=f"{info.rsu_id} says it is 50 m from where"):
                tracker.add_rsu(moved(info, 50.0))
        else:
            tracker.add_rsu(moved(info, 50.0))
    assert least_m <= error_m(drive(tracker, range(20, 80))) <= largest_m


def test_a_refused_move_is_counted_and_named_until_an_operator_accepts_it() -> None:
    tracker = of("first")
    for _ in range(3):
        with pytest.raises(ValueError, match="accept_rsus"):
            tracker.add_rsu(moved(INFOS[0], 50.0))
    tracker.add_rsu(INFOS[0])  # the honest one, sent again, hides nothing
    level, said = message(tracker, "rsu a")
    assert level is Level.ERROR
    assert "a says it is 50 m from where it was before" in said
    assert tracker.refusals.refused_descriptions() == {"a": 3}
    assert tracker.accept_rsus() == ["a"]
    assert tracker.refused_rsus() == {}
    tracker.add_rsu(moved(INFOS[0], 50.0))
    with pytest.raises(ValueError, match="RSU refused"):
        tracker.add_rsu(INFOS[0])
    assert tracker.accept_rsus() == ["a"]
    assert tracker.accept_rsus() == []


def test_tolerance_of_a_pose() -> None:
    """1 cm and 0.1 degrees from the first pose, however small the steps."""
    tracker = of("first")
    tracker.add_rsu(moved(INFOS[0], 0.0099))
    with pytest.raises(ValueError, match="RSU refused"):
        tracker.add_rsu(moved(INFOS[0], 0.0101))
    with pytest.raises(ValueError, match="RSU refused"):
        tracker.add_rsu(moved(INFOS[0], 2 * 0.0099))
    tracker.add_rsu(turned(INFOS[1], 0.09))
    tracker.add_rsu(replace(INFOS[1], quaternion=-INFOS[1].quaternion))  # the same rotation
    with pytest.raises(ValueError, match=r"b says it is turned by 0\.11 deg"):
        tracker.add_rsu(turned(INFOS[1], 0.11))
    with pytest.raises(ValueError, match="network"):
        tracker.add_rsu(replace(INFOS[2], network="other"))
    tracker.add_rsu(replace(INFOS[2], range_bias_sd_m=1.0, bias_correlation_time_s=9.0))


def test_a_list_shuts_others_out() -> None:
    """The listed are known without an RsuInfo; a stranger is refused and named."""
    tracker = Tracker(TrackerConfig(trust="listed"), INFOS)
    assert error_m(drive(tracker, range(20))) < 0.2
    with pytest.raises(ValueError, match="x is not in rsus_file"):
        tracker.add_rsu(RsuInfo(rsu_id="x", position=np.zeros(3)))
    assert tracker.rsu_count == 4
    stranger = replace(ranges(20)[0], rsu_id="x")
    assert tracker.add(stranger) == "unknown_rsu"
    level, said = message(tracker, "rsu x")
    assert level is Level.ERROR
    assert "x is not in rsus_file" in said
    with pytest.raises(ValueError, match="rsus_file"):
        tracker.add_rsu(moved(INFOS[0], 1.0))
    assert tracker.accept_rsus() == []  # the file is the operator's word


def test_a_list_that_is_missing_or_unsound() -> None:
    with pytest.raises(ValueError, match="set rsus_file"):
        Tracker(TrackerConfig(trust="listed"))
    with pytest.raises(ValueError, match="list of RSUs is refused: bias sd of a"):
        Tracker(rsus=[replace(INFOS[0], range_bias_sd_m=-1.0)])
    with pytest.raises(ValueError, match="trust must be one of listed, first, any"):
        TrackerConfig(trust="all")


def test_text_of_a_list_keeps_every_digit() -> None:
    rng = np.random.default_rng(3)
    q = rng.normal(size=4)
    info = RsuInfo(
        rsu_id="no",  # a YAML word
        position=rng.normal(size=3) * 1e5,
        quaternion=q / np.linalg.norm(q),
        azimuth_bias_sd_rad=1.0 / 3.0,
        bias_correlation_time_s=1e-5 / 7.0,
        network="5",
    )
    (again,) = TrackerSettings(rsus=rsus_text([info])).rsu_list
    for name in ("position", "quaternion"):
        assert getattr(again, name).tobytes() == getattr(info, name).tobytes()
    plain = {"position": info.position, "quaternion": info.quaternion}
    assert replace(again, **plain) == replace(info, **plain)


def recorded(path: Path) -> Path:
    """Truth-free recording in which ``a`` is described 50 m aside after all measurements."""
    make = codec()
    with BagWriter(path, metadata={"tracker": "{}"}) as bag:
        for info in INFOS:
            bag.write(topics.RSU_INFO, make.rsu_info_to_msg(info), T0)
        for k in range(30):
            for m in ranges(k):
                bag.write(topics.RSU_MEASUREMENTS, make.measurement_to_msg(m), m.stamp_ns)
        last = T0 + 4 * 10**9
        bag.write(topics.RSU_INFO, make.rsu_info_to_msg(moved(INFOS[0], 50.0)), last)
    return path


def payload(bag: Path) -> list[bytes]:
    with BagReader(bag) as source:
        return [e.cdr for e in source.messages(["/vue_1/odometry"])]


def test_replays_take_the_list_along(tmp_path: Path) -> None:
    """A bag tracked with a list holds it: its own replay gives the same bytes, without the
    file."""
    bag, file = recorded(tmp_path / "bag"), tmp_path / "rsus.yaml"
    file.write_text(rsus_text(INFOS[1:]))
    wanted = {"trust": "listed", "rsus_file": str(file)}
    summary = replay_bag(bag, tmp_path / "listed", wanted)
    assert set(summary.refused_rsus) == {"a"}
    assert summary.rejected["vue_1"]["unknown_rsu"] == 30
    file.unlink()
    replay_bag(tmp_path / "listed", tmp_path / "again")
    assert payload(tmp_path / "again") == payload(tmp_path / "listed")
    with BagReader(tmp_path / "again") as source:
        assert [i.rsu_id for i in bag_settings(source).rsu_list] == ["b", "c", "d"]


def test_replay_keeps_the_first_pose(tmp_path: Path) -> None:
    summary = replay_bag(recorded(tmp_path / "bag"), tmp_path / "out")
    assert summary.refused_rsus.keys() == {"a"}
    assert summary.rejected["vue_1"] == {}
