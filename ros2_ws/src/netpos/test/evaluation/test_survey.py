"""What a recording says of itself without ground truth, against errors that were put in."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from netpos.bags import BagWriter
from netpos.bags.recording import write_values
from netpos.cli.main import app
from netpos.evaluation import Survey, assess_bag, survey_bag
from netpos.evaluation.residuals import correlation_s
from netpos.evaluation.survey import SurveyedVue
from netpos.messages.values import Array, Field, RsuInfo, RsuMeasurement
from netpos.scenario.replay import replay_bag
from rosbags.typesys import Stores, get_typestore
from typer.testing import CliRunner

S = 1_000_000_000
SPEED_OF_LIGHT = 299_792_458.0
SITES = np.array(
    [[15.0, 0.0, 3.0], [4.0, 12.0, 3.0], [-12.0, 7.0, 3.0], [-12.0, -7.0, 3.0], [4.0, -12.0, 3.0]]
)
RATE_HZ, SECONDS = 5.0, 60.0


def gauss_markov(n: int, tau_s: float, dt_s: float, seed: int) -> Array:
    rng, decay = np.random.default_rng(seed), math.exp(-dt_s / tau_s)
    series = np.empty(n)
    series[0] = rng.normal()
    for k in range(1, n):
        series[k] = decay * series[k - 1] + math.sqrt(1 - decay**2) * rng.normal()
    return series


def recorded(
    folder: Path,
    *,
    bias: float = 0.0,
    noise_sd: float = 0.1,
    silence: tuple[float, float] = (1e9, 1e9),
    tdoa: bool = False,
    **tracker: Any,
) -> Path:
    """A device on an ellipse; RSU a0 reads ``bias`` m too much, all state 0.1 m; nothing is heard
    during ``silence`` s."""
    rng = np.random.default_rng(2)
    infos = [RsuInfo(rsu_id=f"a{i}", position=site) for i, site in enumerate(SITES)]
    measurements = []
    for k in range(int(SECONDS * RATE_HZ)):
        t = k / RATE_HZ
        if silence[0] <= t < silence[1]:
            continue
        position = np.array([8.0 * math.cos(t / 8), 5.0 * math.sin(t / 8), 0.0])
        d = np.linalg.norm(position - SITES, axis=1) + rng.normal(0.0, noise_sd, 5)
        d[0] += bias
        for i, distance in enumerate(d.tolist()):
            values: dict[str, Any] = {
                "fields": Field.RANGE,
                "range_m": distance,
                "range_var": 0.01,
            }
            if tdoa and i:
                values = {
                    "fields": Field.TDOA,
                    "reference_rsu_id": "a0",
                    "tdoa_s": (distance - d[0]) / SPEED_OF_LIGHT,
                    "tdoa_var": 0.02 / SPEED_OF_LIGHT**2,
                }
            elif tdoa:
                continue
            measurements.append(
                RsuMeasurement(
                    stamp_ns=round((1.0 + t) * S), rsu_id=f"a{i}", vue_id="vue_1", **values
                )
            )
    source = folder / "source"
    parameters = {"accel_density_mps2_sqrthz": 0.3, "clock_offset_sd_s": 0.0, **tracker}
    write_values(source, rsus=infos, measurements=measurements, tracker=parameters)
    replay_bag(source, folder / "track")
    return folder / "track"


def of(bag: Path) -> SurveyedVue:
    survey = assess_bag(bag)
    assert isinstance(survey, Survey)
    return survey.vues["vue_1"]


@pytest.fixture(scope="module", name="plain")
def _plain(tmp_path_factory: pytest.TempPathFactory) -> SurveyedVue:
    return of(recorded(tmp_path_factory.mktemp("plain")))


def test_a_sound_recording_has_nothing_to_suggest(plain: SurveyedVue) -> None:
    figures = plain.figures
    assert figures.suggestions == ()
    assert figures.span_s == pytest.approx(SECONDS - 1.0 / RATE_HZ)
    assert figures.estimates == pytest.approx(SECONDS * RATE_HZ, abs=2)
    assert figures.measurements == SECONDS * RATE_HZ * 5
    assert figures.states["tracking"] > 0.95
    assert sum(figures.states.values()) == pytest.approx(1.0, abs=0.01)
    assert figures.gaps == 0
    assert figures.nis is not None
    assert figures.nis.mean / figures.nis_dof == pytest.approx(1.0, abs=0.15)
    angle = np.linspace(0.0, SECONDS / 8, 10_000)
    way = np.linalg.norm(np.diff([8 * np.cos(angle), 5 * np.sin(angle)]), axis=0).sum()
    assert figures.way_m == pytest.approx(way, rel=0.1)


def test_residuals_scatter_as_the_noise_does(plain: SurveyedVue) -> None:
    assert [(row.rsu_id, row.quantity, row.unit) for row in plain.figures.residuals] == [
        (f"a{i}", "RANGE", "m") for i in range(5)
    ]
    for row in plain.figures.residuals:
        assert row.count == pytest.approx(SECONDS * RATE_HZ, abs=2)
        assert abs(row.bias) < 0.03
        assert 0.06 < row.scatter < 0.12  # the track follows them a little
        assert row.stated == pytest.approx(0.1)
        assert row.correlation_s is None
        assert row.far < 0.01


def test_an_rsu_that_measures_too_long_is_named(tmp_path: Path) -> None:
    vue = of(recorded(tmp_path, bias=0.4, isolate_rsus=False, gate_probability=1.0))
    first, *others = vue.figures.residuals
    assert first.bias > 0.15
    assert first.bias > 2.0 * max(abs(row.bias) for row in others)
    text = next(s for s in vue.figures.suggestions if s.startswith("RANGE of a0"))
    assert f"long by {first.bias:.2f} m, against the others: correct it" in text
    assert any(s.startswith("NIS ") and "too small" in s for s in vue.figures.suggestions)


def test_what_is_learned_is_shown_beside(tmp_path: Path) -> None:
    vue = of(recorded(tmp_path, bias=0.4, learn_errors=True))
    first = vue.figures.residuals[0]
    assert first.learned.startswith("ranges 0.")
    assert "long" in first.learned
    assert not any("set learn_errors" in s for s in vue.figures.suggestions)


def test_variances_that_are_too_large_are_reported(tmp_path: Path) -> None:
    vue = of(recorded(tmp_path, noise_sd=0.03))
    assert any("stated too large" in s for s in vue.figures.suggestions)


def test_a_common_excess_is_distinguished_from_that_of_one_rsu(tmp_path: Path) -> None:
    """The device is 2 m lower than its tracker thinks, and one RSU is off by itself."""
    bag = recorded(tmp_path, bias=0.5, device_height_m=2.0, isolate_rsus=False)
    suggestions = of(bag).figures.suggestions
    (text,) = (s for s in suggestions if s.startswith("RANGE of all RSUs"))
    assert "long by 0." in text
    assert "wrong height of the device" in text
    assert [s for s in suggestions if s.startswith("RANGE of a0 long by")]


def test_silence_is_counted(tmp_path: Path) -> None:
    figures = of(recorded(tmp_path, silence=(20.0, 32.0))).figures
    assert figures.gaps == 1
    assert figures.longest_gap_s == pytest.approx(12.2)
    assert figures.states["unheard"] == pytest.approx(11.2 / 59.8, abs=0.02)
    assert any("% of the time without a measurement" in s for s in figures.suggestions)


def test_time_differences_are_named_by_their_pair(tmp_path: Path) -> None:
    rows = of(recorded(tmp_path, tdoa=True)).figures.residuals
    assert [row.rsu_id for row in rows] == ["a1-a0", "a2-a0", "a3-a0", "a4-a0"]
    for row in rows:
        assert row.quantity == "TDOA"
        assert abs(row.bias) < 0.05
        assert 0.05 < row.scatter < 0.16


@pytest.mark.parametrize("tau_s", [1.0, 4.0])
def test_the_correlation_time_is_that_of_the_errors(tau_s: float) -> None:
    dt_s, n = 0.2, 20_000
    stamps = np.arange(n) * round(dt_s * S)
    times_s = [correlation_s(stamps, gauss_markov(n, tau_s, dt_s, seed)) for seed in range(5)]
    assert all(f is not None for f in times_s)
    assert np.mean(times_s) == pytest.approx(tau_s + dt_s / 2, rel=0.15)  # type: ignore[arg-type]
    white = np.random.default_rng(1).normal(size=n)
    assert correlation_s(stamps, white) is None
    assert correlation_s(stamps[:5], white[:5]) is None


def test_a_bag_without_estimates(tmp_path: Path) -> None:
    bag = recorded(tmp_path).parent / "source"
    with pytest.raises(ValueError, match=r"no estimates .* netpos replay"):
        survey_bag(bag)


def test_an_unknown_device(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no device 'vue_7'; choose one of vue_1"):
        survey_bag(recorded(tmp_path), vue="vue_7")


# a truth from elsewhere


def tum(path: Path, *, later_s: float = 0.0, turned_rad: float = 0.0) -> Path:
    """The true ellipse as a text file, with a clock and axes of its own."""
    cos, sin = math.cos(turned_rad), math.sin(turned_rad)
    lines = []
    for k in range(int(10 * SECONDS)):
        t = k / 10
        x, y = 8.0 * math.cos(t / 8), 5.0 * math.sin(t / 8)
        east, north = cos * x - sin * y + 100.0 * (turned_rad != 0.0), sin * x + cos * y
        lines.append(f"{1.0 + t + later_s:.3f} {east:.6f} {north:.6f} 0 0 0 0 1")
    path.write_text("\n".join(lines) + "\n")
    return path


def netpos(*arguments: object) -> tuple[int, str]:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    return result.exit_code, result.output


def figures_with(bag: Path, *options: object) -> tuple[dict[str, Any], list[str]]:
    file = bag.parent / "figures.json"
    code, output = netpos("evaluate", bag, "--json", file, *options)
    assert code == 0, output
    content = json.loads(file.read_text())
    return content["vues"]["vue_1"], content["notes"]


def test_a_truth_from_a_text_file(tmp_path: Path) -> None:
    bag = recorded(tmp_path)
    figures, notes = figures_with(bag, "--truth", tum(tmp_path / "truth.tum"))
    assert 0.02 < figures["rmse_m"] < 0.15
    assert 0.5 < figures["nees_mean"] < 4.0
    assert notes == ["truth from truth.tum"]


def test_a_truth_with_its_own_clock_and_axes_is_aligned_and_the_page_says_so(
    tmp_path: Path,
) -> None:
    bag = recorded(tmp_path)
    file = tum(tmp_path / "truth.tum", later_s=1000.0, turned_rad=0.7)
    options = ("--truth-time-offset", "auto", "--truth-align", "rigid")
    figures, (note, *_) = figures_with(bag, "--truth", file, *options)
    assert 0.01 < figures["rmse_m"] < 0.15
    turned, later = re.search(r"turned (\S+) deg, .* later by (\S+) s", note).groups()  # type: ignore[union-attr]
    assert float(turned) == pytest.approx(-math.degrees(0.7), abs=0.5)
    assert float(later) == pytest.approx(-1000.0, abs=0.05)
    assert note.endswith("figures are optimistic")


def test_a_truth_from_a_topic_of_another_bag(tmp_path: Path) -> None:
    bag = recorded(tmp_path)
    figures, _ = figures_with(bag, "--truth", bag, "--truth-topic", "/vue_1/odometry")
    assert figures["rmse_m"] < 0.02  # against itself, thinned


def on_earth(east: float, north: float, up: float) -> tuple[float, float, float]:
    """Latitude, longitude [deg] and height [m] of a point near ``ORIGIN``: from the definition of
    the ellipsoid, the inverse by Newton's method."""

    def ecef(latitude: float, longitude: float, height: float) -> Array:
        a, f = 6378137.0, 1 / 298.257223563
        e2 = f * (2 - f)
        n = a / math.sqrt(1 - e2 * math.sin(latitude) ** 2)
        ring = (n + height) * math.cos(latitude)
        polar = (n * (1 - e2) + height) * math.sin(latitude)
        return np.array([ring * math.cos(longitude), ring * math.sin(longitude), polar])

    lat, lon, h = math.radians(ORIGIN[0]), math.radians(ORIGIN[1]), ORIGIN[2]
    axes = np.array(
        [
            [-math.sin(lon), math.cos(lon), 0.0],
            [-math.sin(lat) * math.cos(lon), -math.sin(lat) * math.sin(lon), math.cos(lat)],
            [math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)],
        ]
    )
    wanted = ecef(lat, lon, h) + axes.T @ np.array([east, north, up])
    point = np.array([lat, lon, h])
    for _ in range(6):
        steps = np.array([1e-6, 1e-6, 1.0])
        slope = np.column_stack(
            [(ecef(*(point + d)) - ecef(*(point - d))) / (2 * d.sum()) for d in np.diag(steps)]
        )
        point = point + np.linalg.solve(slope, wanted - ecef(*point))
    return math.degrees(point[0]), math.degrees(point[1]), float(point[2])


ORIGIN = (60.0, 30.25, 17.0)


def fixes(folder: Path) -> Path:
    """A ROS bag with the true places as NavSatFix."""
    store, name = get_typestore(Stores.ROS2_JAZZY), "sensor_msgs/msg/NavSatFix"
    types = store.types
    with BagWriter(folder) as bag:
        for k in range(int(SECONDS * RATE_HZ)):
            t = k / RATE_HZ
            latitude, longitude, height = on_earth(8.0 * math.cos(t / 8), 5.0 * math.sin(t / 8), 0)
            stamp_ns = round((t + 1.0) * S)
            stamp = types["builtin_interfaces/msg/Time"](sec=stamp_ns // S, nanosec=stamp_ns % S)
            message = types[name](
                header=types["std_msgs/msg/Header"](stamp=stamp, frame_id="gnss"),
                status=types["sensor_msgs/msg/NavSatStatus"](status=0, service=1),
                latitude=latitude,
                longitude=longitude,
                altitude=height,
                position_covariance=np.zeros(9),
                position_covariance_type=0,
            )
            bag.write_raw("/fix", name, bytes(store.serialize_cdr(message, name)), stamp_ns)
    return folder


def test_a_truth_of_latitudes_from_a_satellite_receiver(tmp_path: Path) -> None:
    bag, truth = recorded(tmp_path), fixes(tmp_path / "gnss")
    known, _ = figures_with(bag, "--truth", tum(tmp_path / "t.tum"))
    there = ("--truth", truth, "--truth-topic", "/fix")
    figures, _ = figures_with(bag, *there, "--truth-origin", ",".join(map(str, ORIGIN)))
    assert figures["rmse_m"] == pytest.approx(known["rmse_m"], abs=2e-3)
    figures, (note, *_) = figures_with(bag, *there, "--truth-align", "rigid")
    assert figures["rmse_m"] < 0.15
    assert "optimistic" in note
    result = CliRunner().invoke(app, ["evaluate", str(bag), *map(str, there)])
    assert result.exit_code == 2
    assert "--truth-origin" in result.stderr


def test_a_truth_that_cannot_be_used_is_one_sentence(tmp_path: Path) -> None:
    bag = recorded(tmp_path)
    code, output = netpos("evaluate", bag, "--truth-align", "rigid")
    assert (code, output) == (
        2,
        "netpos: options of the ground truth need --truth: name its file or bag\n",
    )
    code, output = netpos("evaluate", bag, "--truth", tmp_path / "none.tum")
    assert code == 2
    assert "none.tum" in output
    code, output = netpos("evaluate", bag, "--truth", tum(tmp_path / "t.tum"), "--vue", "vue_7")
    assert code == 2
    assert "has estimates of vue_1; choose with --vue" in output
