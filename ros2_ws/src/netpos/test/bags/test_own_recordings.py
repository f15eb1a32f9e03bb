"""Text files and ROS bags of anybody, against values worked out by hand."""

from __future__ import annotations

import gzip
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from imported_bag import values
from netpos.bags import BagError, BagReader
from netpos.bags.importers.common import recordings
from netpos.bags.importers.own.columns import Columns
from netpos.bags.importers.own.recording import Truth, import_csv, import_ros
from netpos.bags.importers.own.rsus import read_rsus
from netpos.bags.importers.own.truth import TUM, TruthColumns
from netpos.messages.values import Field, RsuInfo
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

C = 299_792_458.0
RSUS = [
    RsuInfo(rsu_id=name, position=np.array([x, y, 2.0]))
    for name, x, y in (("a1", 0.0, 0.0), ("a2", 10.0, 0.0), ("a3", 10.0, 10.0), ("5", 0.0, 10.0))
]


def written(tmp_path: Path, text: str, columns: Columns, name: str = "in.csv", **rest: Any) -> Any:
    """What the import of a text file has written, and its counts."""
    file = tmp_path / name
    file.write_bytes(gzip.compress(text.encode()) if name.endswith(".gz") else text.encode())
    counts = import_csv(file, tmp_path / "bag", columns, RSUS, **rest)
    return (*values(tmp_path / "bag"), counts)


@pytest.mark.parametrize("name", ["in.csv", "in.csv.gz"])
@pytest.mark.parametrize("sign", [",", "\t", ";", " "])
def test_one_measurement_a_line(tmp_path: Path, sign: str, name: str) -> None:
    text = "t,anchor,dist,power\n1000,a1,2500,-70\n1001.5,5.0,3000,-inf\n"
    columns = Columns.parse(
        "time=t,rsu=anchor,range=dist,rssi=power", "time=ms,range=mm", "range=100"
    )
    _, measured, _, counts = written(tmp_path, text.replace(",", sign), columns, name)
    assert [(m.stamp_ns, m.rsu_id, m.range_m, m.rssi_dbm) for m in measured] == [
        (1_000_000_000, "a1", 2.5, -70.0),
        (1_001_500_000, "5", 3.0, 0.0),
    ]
    assert all(m.fields == Field.RANGE for m in measured)
    assert [m.range_var for m in measured] == pytest.approx([0.01, 0.01])
    assert counts["RSSI not finite, taken as not measured"] == 1


def test_a_column_for_each_rsu_and_no_header(tmp_path: Path) -> None:
    columns = Columns.parse("time=1,range:a1=2,range:a2=3", sd="range=0.1")
    text = "1,3,4\n2,,4.5\n3,3.5,nan\n"
    _, measured, _, counts = written(tmp_path, text, columns)
    assert [(m.stamp_ns, m.rsu_id, m.range_m, m.expected) for m in measured] == [
        (10**9, "a1", 3.0, 2),
        (10**9, "a2", 4.0, 2),
        (2 * 10**9, "a2", 4.5, 1),
        (3 * 10**9, "a1", 3.5, 1),
    ]
    assert counts["empty values"] == 2


def test_every_quantity_in_its_unit(tmp_path: Path) -> None:
    columns = Columns.parse(
        "time=1,rsu=2,azimuth=3,elevation=4,toa=5,phase=6,x=7,y=8,z=9,azimuth_sd=10,toa_var=11",
        "time=iso,azimuth=deg,elevation=deg,toa=m,position=cm",
        "elevation=2,phase=0.1,position=50",
        lever_arm_m=(0.1, 0.2, 0.3),
    )
    text = f"1970-01-01T00:00:01.5Z,a1,90,-45,{C},0.5,100,200,300,3,{C**2}\n"
    _, (m,), _, _ = written(tmp_path, text, columns)
    assert m.stamp_ns == 1_500_000_000
    assert m.fields == Field.AZIMUTH | Field.ELEVATION | Field.TOA | Field.PHASE | Field.POSITION
    assert (m.azimuth_rad, m.elevation_rad) == pytest.approx((math.pi / 2, -math.pi / 4))
    assert (m.azimuth_var, m.elevation_var) == pytest.approx(
        (math.radians(3) ** 2, math.radians(2) ** 2)
    )
    assert (m.toa_s, m.toa_var, m.phase_difference_rad) == pytest.approx((1.0, 1.0, 0.5))
    np.testing.assert_allclose(m.position, [1.0, 2.0, 3.0])
    np.testing.assert_allclose(m.position_cov, 0.25 * np.eye(3))
    assert m.lever_arm == (0.1, 0.2, 0.3)


def test_nanoseconds_of_today_are_exact(tmp_path: Path) -> None:
    columns = Columns.parse("time=1,rsu=2,range=3", sd="range=1")
    _, (m,), _, _ = written(tmp_path, "1764000000.123456789,a1,1\n", columns)
    assert m.stamp_ns == 1_764_000_000_123_456_789


PLAIN = Columns.parse("time=1,rsu=2,range=3", sd="range=0.1")


@pytest.mark.parametrize("text", ["1,a1,2\n2,a1,3\n3,a", "9,a\n1,a1,2\n2,a1,3\n"])
def test_a_cut_first_or_last_line_is_skipped_and_counted(tmp_path: Path, text: str) -> None:
    _, measured, _, counts = written(tmp_path, text, PLAIN)
    assert [m.range_m for m in measured] == [2.0, 3.0]
    assert counts["cut first or last lines"] == 1
    with BagReader(tmp_path / "bag") as bag:
        assert bag.metadata["skipped"] == "cut first or last lines 1"


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("2,a1,far", "in.csv, line 2: range 'far' in 3 is not a number; repair it or give"),
        ("2,a1,inf", "line 2: range in 3 is inf, not finite"),
        ("2,a1,-1", "line 2: range -1 in 3 is not positive"),
        ("noon,a1,1", "line 2: time 'noon' in 1 is not a number"),
        ("2,a1", "line 2: no column 3 among 2"),
        ("1,a1,2", "line 2: RSU a1 measures vue_1 a second time at this stamp"),
        ("0.5,a1,2", "line 2: RSU a1 is heard 0.5 s before its measurement above; a clock"),
    ],
)
def test_a_bad_line_is_named_or_skipped_and_counted(
    tmp_path: Path, line: str, message: str
) -> None:
    text = f"1,a1,2\n{line}\n3,a1,3\n"
    with pytest.raises(BagError, match=message):
        written(tmp_path, text, PLAIN)
    _, measured, _, counts = written(tmp_path, text, PLAIN, skip_bad_lines=True)
    assert [m.range_m for m in measured] == [2.0, 3.0]
    assert counts["lines that cannot be understood"] == 1


def test_a_file_out_of_order_is_sorted_when_asked(tmp_path: Path) -> None:
    _, measured, _, _ = written(tmp_path, "1,a1,2\n4,a1,4\n3,a1,3\n", PLAIN, any_order=True)
    assert [m.range_m for m in measured] == [2.0, 3.0, 4.0]


@pytest.mark.parametrize(
    ("mapping", "units", "sd", "message"),
    [
        ("rsu=2,range=3", "", "range=1", "must name the time"),
        ("time=1,rsu=2", "", "", "names nothing measured"),
        ("time=1,range=3", "", "range=1", "must name the RSU"),
        ("time=1,rsu=2,range=3", "", "", "give --sd range=..., as the data sheet says"),
        ("time=1,rsu=2,rang=3", "", "", "knows no 'rang'; did you mean range?"),
        ("time=1,rsu=2,range", "", "", "NAME=VALUE pairs between commas, got 'range'"),
        ("time=1,rsu=2,range=3,range=4", "", "", "names range twice"),
        ("time=1,rsu=2,range=3", "range=inch", "range=1", "--units range=inch: give one of m"),
        ("time=1,rsu=2,range=3", "ranges=m", "range=1", "knows no 'ranges'; did you mean range"),
        ("time=1,rsu=2,range=3", "", "range=0", "--sd range=0: give a number > 0"),
        ("time=1,rsu=2,range=3", "", "range=x", "'x' is not a number"),
        ("time=1,range:=3", "", "range=1", "is written range:a1=3"),
    ],
)
def test_a_mapping_that_says_too_little(mapping: str, units: str, sd: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Columns.parse(mapping, units, sd)


def test_a_header_without_the_column_names_the_nearest(tmp_path: Path) -> None:
    columns = Columns.parse("time=tim,rsu=anchor,range=dist", sd="range=1")
    with pytest.raises(BagError, match=r"no column 'tim'; did you mean time\?"):
        written(tmp_path, "time,anchor,dist\n1,a1,2\n", columns)


def test_rsus_of_files(tmp_path: Path) -> None:
    table, text = tmp_path / "rsus.csv", tmp_path / "rsus.yaml"
    table.write_text("rsu,x,y,z,yaw_deg\na,1,2,3,90\n7.0,4,5,6,\n")
    text.write_text("rsus:\n  a: {position: [1, 2, 3], yaw_deg: 90}\n  7: [4, 5, 6]\n")
    for file in (table, text):
        a, b = read_rsus(file)
        assert (a.rsu_id, b.rsu_id) == ("a", "7")
        np.testing.assert_allclose(a.position, [1, 2, 3])
        np.testing.assert_allclose(b.position, [4, 5, 6])
        half = math.sqrt(0.5)
        np.testing.assert_allclose(a.quaternion, [0, 0, half, half], atol=1e-12)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("r.yaml", "a: [1]\n", "three finite numbers"),
        ("r.yaml", "a: [1, 2, .nan]\n", "three finite numbers"),
        ("r.yaml", "a: {position: [1, 2, 3], networks: x}\n", "did you mean network?"),
        ("r.yaml", "a: here\n", "give .x, y, z. or fields"),
        ("r.yaml", "- 1\n", "names no RSU"),
        ("r.yaml", "a: [", "line 2: not valid YAML"),
        ("r.csv", "rsu,x,y\na,1,2\na,3,4\n", "names a twice"),
        ("r.csv", "rsu,x\na,1\n", "no column 'y'"),
    ],
)
def test_rsus_that_cannot_be_read(tmp_path: Path, name: str, text: str, message: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(BagError, match=message):
        read_rsus(tmp_path / name)


def walk(n: int = 60) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Times from 100 s and places of a bent walk between the RSUs."""
    t = np.arange(n * 10) / 10.0
    return t + 100.0, np.column_stack([2 + 0.1 * t, 5 + 2 * np.sin(t / 8), np.full(len(t), 1.0)])


def ranges_of_walk() -> str:
    lines = []
    for t, position in zip(*walk(), strict=True):
        d = [np.linalg.norm(position - info.position) for info in RSUS]
        lines.append(",".join(f"{v:.6f}" for v in (t, *d)))
    return "\n".join(lines) + "\n"


WALK = Columns.parse("time=1,range:a1=2,range:a2=3,range:a3=4,range:5=5", sd="range=0.1")


@pytest.mark.parametrize("way", ["shift", "rigid"])
def test_truth_with_axes_and_a_clock_of_its_own(tmp_path: Path, way: Any) -> None:
    angle = math.radians(25.0) if way == "rigid" else 0.0
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    times, places = walk()
    surveyed = (places[:, :2] - [3.0, -4.0]) @ turn  # map = turn @ own + (3, -4)
    truth = tmp_path / "truth.csv"
    rows = "\n".join(f"{t - 77.3},{x},{y}" for t, (x, y) in zip(times, surveyed, strict=True))
    truth.write_text("t,x,y\n" + rows + "\n")
    columns = TruthColumns.parse("time=t,x=x,y=y")
    asked = Truth(source=truth, columns=columns, offset_s=None, align=way, height_m=1.0)
    _, _, poses, _ = written(tmp_path, ranges_of_walk(), WALK, truth=asked)
    stamps = np.array([pose.stamp_ns for pose in poses]) / 1e9
    expected = np.column_stack([np.interp(stamps, times, places[:, axis]) for axis in range(2)])
    positions = np.array([pose.position[:2] for pose in poses])
    assert np.abs(positions - expected).max() < 0.03
    with BagReader(tmp_path / "bag") as bag:
        sentence = bag.metadata["truth_alignment"]
    assert f"turned {math.degrees(angle):.0f}." in sentence or way == "rigid"
    assert "later by 77." in sentence
    assert "figures are optimistic" in sentence


def test_tum_truth_keeps_its_heading(tmp_path: Path) -> None:
    truth = tmp_path / "truth.tum"
    half = math.radians(15.0)
    truth.write_text(
        "".join(f"{t} 1 2 3 0 0 {math.sin(half)} {math.cos(half)}\n" for t in (100, 101, 102))
    )
    asked = Truth(source=truth, columns=TruthColumns(sources=TUM), offset_s=0.5)
    _, _, poses, _ = written(tmp_path, ranges_of_walk(), WALK, truth=asked)
    assert [pose.stamp_ns for pose in poses] == [100_500_000_000 + i * 10**9 for i in range(3)]
    for pose in poses:
        np.testing.assert_allclose(pose.position, [1, 2, 3])
        np.testing.assert_allclose(pose.quaternion[2:], [math.sin(half), math.cos(half)])


def test_truth_in_the_same_file_may_be_shorter(tmp_path: Path) -> None:
    file = tmp_path / "in.csv"
    file.write_text("1,a1,5,1,0,1\n2,a1,5,2,1,1\n3,a1,5,3,2,1\n4,a1,5,nan,nan,nan\n")
    truth = Truth(source=file, columns=TruthColumns.parse("time=4,x=5,y=6"))
    counts = import_csv(file, tmp_path / "bag", PLAIN, RSUS, truth=truth)
    assert counts["/vue_1/ground_truth"] == 3
    assert counts["empty poses of the truth"] == 1
    _, _, poses = values(tmp_path / "bag")
    np.testing.assert_allclose([pose.linear_velocity[0] for pose in poses], 1.0)


def test_an_rsu_without_a_position_is_named(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="no position of RSU nine"):
        written(tmp_path, "1,a1,2\n2,nine,3\n3,a1,3\n", PLAIN)


def ros1_bag(path: Path) -> Path:
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(
        get_types_from_msg(
            "std_msgs/Header header\nuint8 to\ngeometry_msgs/Point place\nfloat32[] d",
            "uwb/msg/Range",
        )
    )
    types = store.types
    with Writer(path) as bag:
        connection = bag.add_connection("/uwb", "uwb/msg/Range", typestore=store)
        for i in range(3):
            stamp = types["builtin_interfaces/msg/Time"](sec=5, nanosec=i * 10**8)
            header = types["std_msgs/msg/Header"](seq=i, stamp=stamp, frame_id="")
            point = types["geometry_msgs/msg/Point"](x=1.0 + i % 2, y=2.0, z=3.0)
            distances = np.array([4.0 + i, 9.0], dtype=np.float32)
            message = types["uwb/msg/Range"](header=header, to=i % 2, place=point, d=distances)
            raw = store.serialize_ros1(message, "uwb/msg/Range")
            bag.write(connection, 6 * 10**9 + i, raw)
    return path


def test_a_ros_1_bag_with_a_type_of_its_own(tmp_path: Path) -> None:
    source = ros1_bag(tmp_path / "in.bag")
    columns = Columns.parse(
        "time=header.stamp,rsu=to,range=d[0],rsu_x=place.x,rsu_y=place.y,rsu_z=place.z",
        sd="range=0.1",
    )
    counts = import_ros(source, tmp_path / "bag", columns, "/uwb", [])
    assert counts == {"/rsu/info": 2, "/rsu/measurements": 3}
    infos, measured, _ = values(tmp_path / "bag")
    assert {info.rsu_id: info.position.tolist() for info in infos} == {
        "0": [1.0, 2.0, 3.0],
        "1": [2.0, 2.0, 3.0],
    }
    assert [(m.stamp_ns, m.rsu_id, m.range_m) for m in measured] == [
        (5_000_000_000, "0", 4.0),
        (5_100_000_000, "1", 5.0),
        (5_200_000_000, "0", 6.0),
    ]


@pytest.mark.parametrize(
    ("topic", "mapping", "message"),
    [
        ("/uwbs", "time=header.stamp,rsu=to,range=d[0]", "no topic /uwbs; did you mean /uwb?"),
        ("/uwb", "time=header.stmp,rsu=to,range=d[0]", "message 1: no field 'header.stmp'; did "),
        ("/uwb", "time=header.stamp,rsu=to,range=d[7]", "message 1: no element 'd.7.'"),
    ],
)
def test_a_bag_without_what_is_asked(
    tmp_path: Path, topic: str, mapping: str, message: str
) -> None:
    source = ros1_bag(tmp_path / "in.bag")
    with pytest.raises(BagError, match=message):
        import_ros(source, tmp_path / "bag", Columns.parse(mapping, sd="range=1"), topic, RSUS)


def test_a_real_ros_1_bag(tmp_path: Path) -> None:
    data = recordings("uwb_ranging")
    if data is None:
        pytest.skip("uwb_ranging is not there; set NETPOS_DATA to the folder of the recordings")
    position_columns = (
        "rsu_x=responder_location.x,rsu_y=responder_location.y,rsu_z=responder_location.z"
    )
    columns = Columns.parse(
        f"time=header.stamp,rsu=responder_id,range=distance,{position_columns}", sd="range=0.1"
    )
    truth = Truth(
        source="/vicon_xb/viconPoseTopic",
        columns=TruthColumns.parse("time=header.stamp,x=pose.position.x,y=pose.position.y"),
    )
    counts = import_ros(
        data / "four_anchors" / "data_example.bag",
        tmp_path / "bag",
        columns,
        "/uwb_endorange_info",
        [],
        truth=truth,
    )
    assert counts["/rsu/info"] == 4
    assert counts["/rsu/measurements"] == 1444
