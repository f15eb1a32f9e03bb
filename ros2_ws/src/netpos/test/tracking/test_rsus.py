"""Which slow and coloured errors of an RSU enter which rows."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from netpos.estimation.measurement import ROW_WIDTH, Kind
from netpos.estimation.rows import RowErrors
from netpos.estimation.state import VELOCITY
from netpos.messages.values import AngleConvention, Field, RsuInfo, RsuMeasurement
from netpos.tracking.rsus.learning import LearnedErrors
from netpos.tracking.rsus.rsu import BiasStates, Rsu
from netpos.tracking.rsus.shift import DeviceState
from scipy.spatial.transform import Rotation

ALL = Field.AZIMUTH | Field.ELEVATION | Field.TOA | Field.RANGE

# No RSU measures them
OTHERS = (
    Kind.LINEAR,
    Kind.SPEED,
    Kind.STEP_VELOCITY,
    Kind.PLACE,
    Kind.BODY_VELOCITY,
    Kind.BODY_RATE,
)


def info(rsu_id: str = "a", **change: object) -> RsuInfo:
    values: dict[str, object] = {"rsu_id": rsu_id, "position": np.zeros(3)}
    return RsuInfo(**(values | change))  # type: ignore[arg-type]


def biased(rsu_id: str = "a", **change: object) -> Rsu:
    values = {
        "azimuth_bias_sd_rad": 0.01,
        "elevation_bias_sd_rad": 0.02,
        "range_bias_sd_m": 0.3,
        "bias_correlation_time_s": 50.0,
    }
    return Rsu.of(info(rsu_id, **(values | change)))


def measured(fields: Field = ALL, stamp_ns: int = 1, rsu_id: str = "a") -> RsuMeasurement:
    return RsuMeasurement(stamp_ns=stamp_ns, rsu_id=rsu_id, vue_id="v", fields=fields)


def test_bias_sd_by_kind() -> None:
    rsu = biased()
    assert {kind: rsu.bias_sd(kind) for kind in Kind if kind not in OTHERS} == {
        Kind.AZIMUTH: 0.01,
        Kind.COSINE_Y: 0.01,
        Kind.ELEVATION: 0.02,
        Kind.COSINE_Z: 0.02,
        Kind.TOA: 0.3,
        Kind.RANGE: 0.3,
        Kind.PHASE: 0.0,
        Kind.UNWRAPPED_PHASE: 0.0,
        Kind.TDOA: 0.3,
    }
    other = biased("b", range_bias_sd_m=0.4)
    assert rsu.bias_sd(Kind.TDOA, other) == pytest.approx(0.5)
    assert rsu.bias_sd(Kind.TOA, other) == 0.3


def test_kinds_follow_the_convention() -> None:
    assert biased().kinds(measured()) == (Kind.AZIMUTH, Kind.ELEVATION, Kind.TOA, Kind.RANGE)
    cone = biased(angle_convention=AngleConvention.CONE)
    assert cone.kinds(measured()) == (Kind.COSINE_Y, Kind.COSINE_Z, Kind.TOA, Kind.RANGE)
    assert biased().kinds(measured(Field.POSITION)) == ()


@pytest.mark.parametrize("yaw_deg", [0.0, 90.0, 200.0])
def test_a_cone_array_sees_the_half_plane_before_it(yaw_deg: float) -> None:
    turned = info(
        angle_convention=AngleConvention.CONE,
        quaternion=Rotation.from_euler("z", yaw_deg, degrees=True).as_quat(),
    )
    rsu = Rsu.of(turned)
    for off_deg, front in (
        (0, True),
        (89, True),
        (-89, True),
        (91, False),
        (-91, False),
        (180, False),
    ):
        a = math.radians(yaw_deg + off_deg)
        assert rsu.in_front(math.cos(a), math.sin(a)) is front
        assert Rsu.of(info()).in_front(math.cos(a), math.sin(a)) is True
    assert rsu.in_front(0.0, 0.0) is True


def errors_of(states: BiasStates, rsu: Rsu, m: RsuMeasurement) -> dict[Kind, RowErrors]:
    """Errors of the rows of a measurement, by kind."""
    kinds = rsu.kinds(m)
    return dict(zip(kinds, states.row_errors(rsu, m, np.ones(len(kinds))), strict=True))


def test_unbiased_white_rsu_has_no_states() -> None:
    states = BiasStates()
    assert states.row_errors(Rsu.of(info()), measured(), np.ones(4)) == ()
    assert (states.sd, states.tau_s) == ([], [])


def test_every_biased_quantity_has_its_own_state_once() -> None:
    states = BiasStates()
    first = errors_of(states, biased(), measured())
    assert {kind: errors.bias for kind, errors in first.items()} == {
        Kind.AZIMUTH: 6,
        Kind.ELEVATION: 7,
        Kind.TOA: 8,
        Kind.RANGE: 9,
    }
    assert {errors.common for errors in first.values()} == {-1}
    assert states.sd == [0.01, 0.02, 0.3, 0.3]
    assert states.tau_s == [50.0] * 4
    assert errors_of(states, biased(), measured()) == first
    b = biased("b", bias_correlation_time_s=9.0)
    other = errors_of(states, b, measured(Field.RANGE, rsu_id="b"))
    assert other[Kind.RANGE].bias == 10
    assert states.tau_s[4] == 9.0


@pytest.mark.parametrize(("since_s", "more"), [(0.1, 9.0), (0.25, 3.0), (1.0, 0.0), (5.0, 0.0)])
def test_values_of_a_second_share_what_linearising_leaves_out(since_s: float, more: float) -> None:
    """Of quantities with a slow error, from the second value on."""
    states, rsu, first = BiasStates(), biased(azimuth_bias_sd_rad=0.0), measured()
    assert {errors.same_bend for errors in errors_of(states, rsu, first).values()} == {0.0}
    states.accepted(rsu, first)
    later = replace(first, stamp_ns=first.stamp_ns + round(since_s * 1e9))
    more_of = {kind: errors.same_bend for kind, errors in errors_of(states, rsu, later).items()}
    assert more_of.pop(Kind.AZIMUTH) == 0.0
    assert list(more_of.values()) == pytest.approx([more] * 3)


def test_only_measured_quantities_get_states() -> None:
    states = BiasStates()
    unbiased = errors_of(states, biased(azimuth_bias_sd_rad=0.0), measured(Field.AZIMUTH))
    assert unbiased[Kind.AZIMUTH].bias == -1
    assert errors_of(states, biased(), measured(Field.ELEVATION))[Kind.ELEVATION].bias == 6
    assert states.sd == [0.02]


def test_common_bias_is_shared_by_the_ranges_of_a_network() -> None:
    states = BiasStates()
    common = {"common_range_bias_sd_m": 0.5, "common_bias_correlation_time_s": 70.0}
    found = [
        errors_of(states, Rsu.of(info(name, network=network, **common)), measured())
        for name, network in (("a", "n"), ("b", "n"), ("c", "m"))
    ]
    assert [[e[kind].common for kind in (Kind.TOA, Kind.RANGE)] for e in found] == [
        [6, 6],
        [6, 6],
        [7, 7],
    ]
    assert {errors[Kind.AZIMUTH].common for errors in found} == {-1}
    assert (states.sd, states.tau_s) == ([0.5, 0.5], [70.0, 70.0])


def test_an_rsu_named_like_a_network_has_its_own_state() -> None:
    states = BiasStates()
    rsu = biased("n", network="n", common_range_bias_sd_m=0.5, common_bias_correlation_time_s=7.0)
    errors = errors_of(states, rsu, measured(Field.RANGE))[Kind.RANGE]
    assert errors.bias != errors.common
    assert len(states.sd) == 2


def test_inflation_is_correlation_time_over_interval_since_the_last_accepted() -> None:
    states, rsu = BiasStates(), Rsu.of(info(noise_correlation_time_s=0.4))

    def inflation(stamp_ns: int) -> dict[Kind, float]:
        found = errors_of(states, rsu, measured(stamp_ns=stamp_ns))
        return {kind: errors.inflation for kind, errors in found.items()}

    assert inflation(10**9)[Kind.RANGE] == 1.0
    assert inflation(2 * 10**9)[Kind.RANGE] == 1.0  # not accepted: still the first
    states.accepted(rsu, measured(Field.RANGE, stamp_ns=2 * 10**9))
    soon = inflation(2_100_000_000)
    assert soon[Kind.RANGE] == pytest.approx(4.0)
    assert soon[Kind.AZIMUTH] == 1.0  # was not measured then
    assert inflation(2_500_000_000)[Kind.RANGE] == 1.0  # never below 1
    for stamp in (2 * 10**9, 10**9):
        assert inflation(stamp)[Kind.RANGE] == 1.0


def test_inflated_mean_has_the_variance_of_the_mean_of_coloured_noise() -> None:
    """n samples of an exponentially correlated error over a long time: the variance of their mean
    is S(0) / T, as if they were white with the inflated variance."""
    tau, dt, n = 0.5, 0.05, 200_000
    lags = np.arange(n)
    correlation = np.exp(-lags * dt / tau)
    of_mean = (n + 2 * np.sum((n - lags[1:]) * correlation[1:])) / n**2
    states, rsu = BiasStates(), Rsu.of(info(noise_correlation_time_s=2 * tau))
    states.accepted(rsu, measured(stamp_ns=10**9))
    m = measured(stamp_ns=10**9 + int(dt * 1e9))
    factor = errors_of(states, rsu, m)[Kind.RANGE].inflation
    assert factor / n == pytest.approx(of_mean, rel=2e-3)


def test_a_copy_goes_its_own_way() -> None:
    """A track goes back to it: what is heard afterwards must not be in it, nor the reverse."""
    first, second = biased("a"), biased("b")
    states = BiasStates()
    errors_of(states, first, measured())
    states.accepted(first, measured())
    twin = states.copy()
    kept = twin.arrays()
    errors_of(states, second, measured())
    states.accepted(first, measured(stamp_ns=5))
    np.testing.assert_array_equal(twin.arrays(), kept)
    assert [e.bias for e in errors_of(twin, first, measured()).values()] == [6, 7, 8, 9]
    assert set(twin._last_ns.values()) == {1}
    one = errors_of(twin, second, measured())
    assert one == errors_of(states, second, measured())
    assert len(twin.sd) == len(states.sd)


def test_errors_last_while_a_device_stands() -> None:
    """An estimated speed within its noise is no way on which errors could have changed."""
    states, rsu = BiasStates(learned=LearnedErrors()), Rsu.of(info())
    assert states.learned is not None
    errors_of(states, rsu, measured(Field.RANGE))
    nothing, cov = np.zeros((0, ROW_WIDTH)), 0.2**2 * np.eye(7)
    lasts = []
    for k, speed in enumerate([0.2, 0.2, 2.0]):
        mean = np.zeros(7)
        mean[VELOCITY] = speed, 0.0
        states.learn(nothing, np.ones(0), DeviceState((k + 1) * 10**9, mean, cov, 0.0, 0.5))
        lasts.append(states.tau_s[0])
    model = states.learned.models["rsu/a", "RANGE"]
    assert lasts[:2] == [model.time_s(0.0)] * 2
    assert lasts[2] == model.time_s(2.0) < 0.5 * lasts[0]
