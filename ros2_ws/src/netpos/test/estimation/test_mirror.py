"""Mirror images of a device, against geometry and against sums of Gaussians by SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from filter_rows import make_cov, row
from netpos.estimation.measurement import AXES, Kind
from netpos.estimation.mixture.gaussians import Mixture
from netpos.estimation.mixture.mirror import Mirror, mirror_of
from netpos.messages.values import Array
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

N = 8  # a state with two slow errors
HEIGHT_M = 1.0


def turned(angle: float, *places: tuple[float, float, float]) -> Array:
    """``places`` along x, turned about the vertical axis and moved."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array(places) @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + [5, -9, 0]


def ranges(places: Array, kind: Kind = Kind.RANGE, variance: float = 0.01) -> Array:
    return np.array([row(kind, 7.0, variance, i, place) for i, place in enumerate(places)])


def mixture(seed: int, count: int = 3) -> Mixture:
    rng = np.random.default_rng(seed)
    covs = np.array([make_cov(rng, N) for _ in range(count)])
    logs = rng.normal(0.0, 1.0, count)
    return Mixture(rng.normal(0.0, 9.0, (count, N)), covs, logs - logsumexp(logs))


def log_density(of: Mixture, at: Array) -> float:
    terms = [multivariate_normal(m, c).logpdf(at) for m, c in zip(of.means, of.covs, strict=True)]
    return float(logsumexp(of.log_weights + terms))


@pytest.mark.parametrize("angle", [0.0, 0.7, 2.5])
@pytest.mark.parametrize("kind", [Kind.RANGE, Kind.TOA])
def test_rsus_in_one_vertical_plane_leave_a_mirror(angle: float, kind: Kind) -> None:
    """However high each is, and however many they are."""
    places = turned(angle, (0.0, 0.0, 3.0), (6.0, 0.0, 1.0), (2.5, 0.0, 8.0))
    for count in (2, 3):
        mirror = mirror_of(ranges(places[:count], kind), N, HEIGHT_M)
        assert mirror is not None
        assert abs(mirror.across @ (np.cos(angle), np.sin(angle))) < 1e-12
        assert mirror.across @ (mirror.point - places[2, :2]) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_a_range_is_the_same_for_a_device_and_its_image(seed: int) -> None:
    """By the distances themselves; slow errors, clock and all covariances between them stay."""
    places = turned(0.4, (0.0, 0.0, 3.0), (6.0, 0.0, 1.0))
    mirror = mirror_of(ranges(places), N, HEIGHT_M)
    assert mirror is not None
    here = mixture(seed)
    there = mirror.image(here)
    for place in places[:, :2]:
        np.testing.assert_allclose(
            np.hypot(*(there.means[:, :2] - place).T), np.hypot(*(here.means[:, :2] - place).T)
        )
    assert np.abs(there.means[:, :2] - here.means[:, :2]).min() > 1e-3
    np.testing.assert_allclose(np.hypot(*there.means[:, 2:4].T), np.hypot(*here.means[:, 2:4].T))
    np.testing.assert_array_equal(there.means[:, 4:], here.means[:, 4:])
    np.testing.assert_allclose(np.linalg.eigvalsh(there.covs), np.linalg.eigvalsh(here.covs))
    back = mirror.image(there)
    np.testing.assert_allclose(back.means, here.means, atol=1e-12)
    np.testing.assert_allclose(back.covs, here.covs, atol=1e-12)


def told_apart() -> dict[str, Array]:
    places = turned(0.4, (0.0, 0.0, 3.0), (6.0, 0.0, 1.0))
    off_the_plane = turned(0.4, (0.0, 0.0, 3.0), (6.0, 0.0, 1.0), (3.0, 0.01, 1.0))
    angle = row(Kind.AZIMUTH, 0.3, 1e-4, 2, places[0])
    east = row(Kind.LINEAR, 1.0, 0.1, 2, h=[1.0, 0, 0, 0, 0, 0])
    return {
        "one RSU": ranges(places[:1]),
        "one mast": ranges(np.array([places[0], places[0] + [0.0, 0.0, 4.0]])),
        "an RSU 1 cm off the plane": ranges(off_the_plane),
        "an angle": np.vstack([ranges(places), angle]),
        "a position": np.vstack([ranges(places), east]),
        "no RSU": east[None],
    }


@pytest.mark.parametrize("case", sorted(told_apart()))
def test_what_tells_a_device_from_its_image_leaves_no_mirror(case: str) -> None:
    assert mirror_of(told_apart()[case], N, HEIGHT_M) is None


def test_differences_of_arrival_and_the_speed_do_not_tell_it_from_its_image() -> None:
    """A difference does where the RSU it counts from is off the plane."""
    places = turned(0.4, (0.0, 0.0, 3.0), (6.0, 0.0, 1.0), (3.0, 4.0, 1.0))
    mirror = mirror_of(ranges(places[:2]), N, HEIGHT_M)
    assert mirror is not None
    difference = row(Kind.TDOA, 0.3, 1e-4, 0, places[0])
    difference[AXES : AXES + 3] = places[1] - places[0]
    speed = row(Kind.SPEED, 2.0, 1e-4, 1)
    assert mirror.leaves(np.array([difference, speed]), N, HEIGHT_M)
    assert mirror_of(np.vstack([ranges(places[:2]), speed]), N, HEIGHT_M) is not None
    difference[AXES : AXES + 3] = places[2] - places[0]
    assert not mirror.leaves(difference[None], N, HEIGHT_M)


@pytest.mark.parametrize("seed", range(4))
def test_half_of_both_sides_is_both_sides(seed: int) -> None:
    """The density of a mixture that is the same on both sides, at random places; whichever half is
    carried."""
    rng = np.random.default_rng(seed)
    mirror = Mirror(rng.normal(0.0, 5.0, 2), np.array([0.6, -0.8]))
    both = mirror.both_sides(mixture(seed))
    half = mirror.one_side(both)
    assert half.log_weights.size == 3
    assert np.exp(half.log_weights).sum() == pytest.approx(1.0)
    again = mirror.both_sides(half)
    for at in rng.normal(0.0, 9.0, (20, N)):
        expected = log_density(both, at)
        assert log_density(again, at) == pytest.approx(expected, abs=1e-9)
        image = mirror.image(Mixture(at[None], np.eye(N)[None], np.zeros(1))).means[0]
        assert log_density(again, image) == pytest.approx(expected, abs=1e-9)


def test_a_device_on_the_plane_is_one_place() -> None:
    """Its components lie on both sides already, and none is moved away from the others."""
    mirror = Mirror(np.zeros(2), np.array([0.0, 1.0]))
    means = np.array([[4.0, 0.1, 0.0, -1.0, 0.0, 0.0], [4.0, -0.1, 0.0, -1.0, 0.0, 0.0]])
    some = Mixture(means, np.tile(0.04 * np.eye(6), (2, 1, 1)), np.log([0.6, 0.4]))
    half = mirror.one_side(some)
    np.testing.assert_array_equal(half.means, means)
