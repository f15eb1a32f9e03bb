"""What is drawn of what is published: when, where, in which colour, and what is not."""

from __future__ import annotations

import math

import numpy as np
import pytest
from netpos.live.scene import (
    BUILDING_COLOUR,
    SIGHT_COLOURS,
    STATE_COLOURS,
    Scene,
    SceneConfig,
)
from netpos.live.shapes import Kind, Shape
from netpos.messages.values import (
    Odometry,
    RsuInfo,
    RsuMeasurement,
    TrackMode,
    TrackState,
    TrackStatus,
)
from netpos.world.frames import quaternion_from_yaw
from scipy.stats import chi2

NS = 1_000_000_000


def odometry(at_s: float, x: float = 1.0, vue: str = "vue_1", sd: float = 1.0) -> Odometry:
    return Odometry(
        stamp_ns=round(NS * at_s),
        vue_id=vue,
        position=np.array([x, 2.0, 0.5]),
        quaternion=quaternion_from_yaw(0.3),
        linear_velocity=np.zeros(3),
        pose_cov=np.diag([sd**2] * 6),
    )


def status(at_s: float, state: TrackState = TrackState.TRACKING, **values: object) -> TrackStatus:
    return TrackStatus(stamp_ns=round(NS * at_s), vue_id="vue_1", state=state, **values)  # type: ignore[arg-type]


def measured(at_s: float, rsu: str, vue: str = "vue_1") -> RsuMeasurement:
    return RsuMeasurement(stamp_ns=round(NS * at_s), rsu_id=rsu, vue_id=vue)


def rsu(name: str, x: float = 0.0, **values: object) -> RsuInfo:
    return RsuInfo(rsu_id=name, position=np.array([x, 0.0, 6.0]), **values)  # type: ignore[arg-type]


def of(shapes: list[Shape], group: str) -> list[Shape]:
    return [shape for shape in shapes if shape.group == group]


def test_buildings_and_rsus_are_the_map() -> None:
    scene = Scene(SceneConfig(building_height_m=20.0))
    scene.set_buildings(np.array([[0.0, 10.0, 4.0, 16.0]]))
    scene.add_rsu(rsu("a", 7.0, quaternion=quaternion_from_yaw(1.0)))
    (building,) = of(scene.map_shapes(), "buildings")
    assert (building.kind, building.colour) == (Kind.BOX, BUILDING_COLOUR)
    assert building.position == (2.0, 13.0, 10.0)
    assert building.size == (4.0, 6.0, 20.0)
    (unit,) = of(scene.map_shapes(), "rsus")
    assert unit.position == (7.0, 0.0, 6.0)
    assert unit.yaw_rad == pytest.approx(1.0)
    assert [s.text for s in of(scene.map_shapes(), "rsu names")] == ["a"]
    scene.add_rsu(rsu("a", 8.0))  # its new place
    assert [s.position[0] for s in of(scene.map_shapes(), "rsus")] == [8.0]
    scene.clear_rsus()
    assert of(scene.map_shapes(), "rsus") == []
    assert len(of(scene.map_shapes(), "buildings")) == 1


def test_a_device_its_ellipse_and_its_level() -> None:
    scene = Scene()
    scene.add_odometry(odometry(1.0, sd=2.0), "", 0.0)
    scene.add_status(status(1.0, protection_level_m=9.0), "", 0.0)
    shapes = scene.shapes(0.1)
    (device,) = of(shapes, "devices")
    assert device.colour == STATE_COLOURS[TrackState.TRACKING]
    assert device.yaw_rad == pytest.approx(0.3)
    (ellipse,) = of(shapes, "ellipses")
    assert ellipse.size[:2] == pytest.approx(2 * [2 * 2.0 * math.sqrt(chi2.ppf(0.95, 2))])
    (level,) = of(shapes, "protection levels")
    assert np.hypot(*(level.points[:, :2] - [1.0, 2.0]).T) == pytest.approx(9.0)
    assert [s.text for s in of(shapes, "device names")] == ["vue_1 TRACKING"]
    scene.add_status(status(1.1, protection_level_m=-1.0), "", 0.1)  # not computed
    assert of(scene.shapes(0.1), "protection levels") == []


def test_a_status_after_the_estimate_widens_the_ellipse() -> None:
    scene = Scene()
    scene.add_odometry(odometry(1.0, sd=2.0), "", 0.0)
    scene.add_status(status(4.0, TrackState.COASTING, position_sd_m=30.0), "", 3.0)
    (ellipse,) = of(scene.shapes(3.0), "ellipses")
    assert ellipse.size[:2] == pytest.approx(2 * [2 * 30.0 * math.sqrt(chi2.ppf(0.95, 2))])


def test_modes_are_circles_whose_area_is_their_probability() -> None:
    scene = Scene()
    modes = (TrackMode(weight=0.8, x_m=1.0, y_m=2.0), TrackMode(weight=0.2, x_m=9.0, y_m=2.0))
    scene.add_odometry(odometry(1.0), "", 0.0)
    scene.add_status(status(1.0, TrackState.AMBIGUOUS, modes=modes), "", 0.0)
    drawn = of(scene.shapes(0.0), "modes")
    assert [s.position[:2] for s in drawn] == [(1.0, 2.0), (9.0, 2.0)]
    assert drawn[0].size[0] ** 2 / drawn[1].size[0] ** 2 == pytest.approx(4.0)
    assert [s.text for s in of(scene.shapes(0.0), "mode weights")] == ["80 %", "20 %"]


def test_everything_but_figures_is_in_proportion() -> None:
    """Twice the size: arrows, letters and lines are twice as large, ellipses and levels not."""
    sizes = []
    for size_m in (2.0, 4.0):
        scene = Scene(SceneConfig(size_m=size_m))
        scene.add_rsu(rsu("a"))
        scene.add_odometry(odometry(1.0), "", 0.0)
        scene.add_measurement(measured(1.0, "a"))
        modes = (TrackMode(weight=1.0, x_m=1.0, y_m=2.0),)
        about = {"modes": modes, "protection_level_m": 9.0}
        scene.add_status(status(1.0, TrackState.AMBIGUOUS, **about), "", 0.0)
        shapes = [*scene.map_shapes(), *scene.shapes(0.0)]
        sizes.append({shape.group: np.array(shape.size) for shape in shapes})
        (level,) = of(shapes, "protection levels")
        assert np.hypot(*(level.points[0, :2] - [1.0, 2.0])) == pytest.approx(9.0)
    small, large = sizes
    assert (large.pop("ellipses") == small.pop("ellipses")).all()
    assert (large.pop("modes")[:2] == 2 * small.pop("modes")[:2]).all()
    assert len(large) == 7
    for group, size in large.items():
        assert size == pytest.approx(2 * small[group]), group


def test_lines_of_sight_tell_what_was_fused() -> None:
    scene = Scene(SceneConfig(sight_s=0.25))
    for name in ("a", "b", "c", "d"):
        scene.add_rsu(rsu(name, 5.0))
    scene.add_odometry(odometry(1.0), "", 0.0)
    for name in ("a", "b"):
        scene.add_measurement(measured(2.0, name))
    scene.add_status(status(2.0, sources=("a",)), "", 0.0)
    scene.add_odometry(odometry(2.0, x=3.0), "", 0.0)
    scene.add_measurement(measured(2.1, "c"))  # no status of it yet
    scene.add_measurement(measured(1.5, "d"))  # too long ago
    scene.add_measurement(measured(2.0, "unknown"))
    scene.add_measurement(measured(2.0, "a", vue="another"))
    lines = {s.name: s for s in of(scene.shapes(0.0), "lines of sight")}
    assert {name: line.colour for name, line in lines.items()} == {
        "a vue_1": SIGHT_COLOURS[True],
        "b vue_1": SIGHT_COLOURS[False],
        "c vue_1": SIGHT_COLOURS[None],
    }
    assert lines["a vue_1"].points.tolist() == [[5.0, 0.0, 6.0], [3.0, 2.0, 0.5]]


def test_measurements_of_a_network_belong_to_its_own_track() -> None:
    scene = Scene()
    scene.add_rsu(rsu("w", network="wifi"))
    scene.add_odometry(odometry(1.0, vue="phone"), "wifi", 0.0)
    scene.add_odometry(odometry(1.0, vue="phone"), "", 0.0)
    scene.add_measurement(measured(1.0, "w", "phone"))
    assert [s.name for s in of(scene.shapes(0.0), "lines of sight")] == ["w wifi/phone"]


def test_a_silent_device_vanishes_and_comes_back() -> None:
    scene = Scene(SceneConfig(silent_s=10.0))
    scene.add_odometry(odometry(1.0), "", 0.0)
    scene.add_odometry(odometry(1.0, vue="vue_2"), "", 5.0)
    assert {s.name for s in of(scene.shapes(10.0), "devices")} == {"vue_1", "vue_2"}
    scene.add_status(status(9.0, TrackState.COASTING), "", 10.5)  # goes on without an estimate
    assert {s.name for s in of(scene.shapes(10.6), "devices")} == {"vue_2"}
    assert scene.paths(10.6).keys() == {("", "vue_2")}
    scene.add_odometry(odometry(12.0), "", 11.0)
    assert {s.name for s in of(scene.shapes(11.0), "devices")} == {"vue_1", "vue_2"}


def test_a_path_has_points_of_its_step_and_the_newest_one() -> None:
    scene = Scene(SceneConfig(path_step_m=1.0, path_points=5))
    for k in range(31):
        scene.add_odometry(odometry(1.0 + 0.1 * k, x=0.4 * k), "", 0.0)
    points = scene.paths(0.0)["", "vue_1"]
    stamps = [stamp for stamp, _ in points]
    assert len(points) == 5
    assert points[-1][1][0] == pytest.approx(12.0)
    assert stamps == sorted(set(stamps))
    steps = np.diff([position[0] for _, position in points])
    assert (steps[:-1] >= 1.0).all()
    scene.add_odometry(odometry(4.0, x=12.3), "", 0.0)  # a revised one replaces the last
    assert scene.paths(0.0)["", "vue_1"][-1][1][0] == 12.3
    scene.add_odometry(odometry(0.5, x=0.0), "", 0.0)  # time was set back
    assert len(scene.paths(0.0)["", "vue_1"]) == 1


def test_what_is_not_finite_or_in_another_frame_is_not_drawn() -> None:
    scene = Scene()
    scene.add_odometry(odometry(1.0, x=math.nan), "", 0.0)
    scene.add_odometry(odometry(1.0, sd=math.inf), "", 0.0)
    scene.add_status(status(1.0, protection_level_m=math.nan), "", 0.0)
    scene.add_rsu(rsu("a", math.inf))
    scene.add_rsu(rsu("b", frame_id="odom"))
    assert scene.shapes(0.0) == scene.map_shapes() == []
    assert scene.refused == {
        "odometry not finite": 2,
        "track_status not finite": 1,
        "RsuInfo not finite": 1,
        "RsuInfo not in map": 1,
    }
