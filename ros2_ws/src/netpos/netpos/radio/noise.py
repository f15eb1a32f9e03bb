"""Counter-based noise: the same (seed, stream, counter) gives the same numbers in any process, in
any order, with no state.

Philox4x64-10 of J. K. Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011. A
stream is a 128-bit key made of the seed and the stream's name; the counter is normally a stamp.
One call yields four uniforms or four standard normals."""

from __future__ import annotations

import hashlib
import math

import numpy as np
import numpy.typing as npt
from numba import njit

Array = npt.NDArray[np.float64]
Key = npt.NDArray[np.uint64]

_MULTIPLIER_0 = np.uint64(0xD2E7470EE14C6C93)
_MULTIPLIER_1 = np.uint64(0xCA5A826395121157)
_WEYL_0 = np.uint64(0x9E3779B97F4A7C15)
_WEYL_1 = np.uint64(0xBB67AE8584CAA73B)
_LOW_HALF = np.uint64(0xFFFFFFFF)
_HALF_BITS = np.uint64(32)
_MANTISSA_SHIFT = np.uint64(11)
_ROUNDS = 10

NORMALS_PER_DRAW = 4


def stream_key(seed: int, name: str) -> Key:
    """(2,) key of the stream ``name`` under ``seed`` (any integer >= 0)."""
    if seed < 0:
        raise ValueError(f"seed must be >= 0, got {seed}")
    digest = hashlib.blake2b(f"{seed}/{name}".encode(), digest_size=16).digest()
    return np.frombuffer(digest, dtype="<u8").astype(np.uint64)


def generator(seed: int, name: str) -> np.random.Generator:
    """NumPy generator of a stream, for draws made once per run (routes, clock starts, biases)."""
    return np.random.Generator(np.random.Philox(key=stream_key(seed, name)))


@njit(cache=True)
def _multiply(a: np.uint64, b: np.uint64) -> tuple[np.uint64, np.uint64]:
    """High and low word of the 128-bit product."""
    a_low, a_high = a & _LOW_HALF, a >> _HALF_BITS
    b_low, b_high = b & _LOW_HALF, b >> _HALF_BITS
    low = a_low * b_low
    middle = a_high * b_low + (low >> _HALF_BITS)
    cross = a_low * b_high + (middle & _LOW_HALF)
    return a_high * b_high + (middle >> _HALF_BITS) + (cross >> _HALF_BITS), a * b


@njit(cache=True)
def philox(
    c0: np.uint64, c1: np.uint64, c2: np.uint64, c3: np.uint64, k0: np.uint64, k1: np.uint64
) -> tuple[np.uint64, np.uint64, np.uint64, np.uint64]:
    """Four random words of a 256-bit counter under a 128-bit key."""
    for _ in range(_ROUNDS):
        high_0, low_0 = _multiply(_MULTIPLIER_0, c0)
        high_1, low_1 = _multiply(_MULTIPLIER_1, c2)
        c0, c1, c2, c3 = high_1 ^ c1 ^ k0, low_1, high_0 ^ c3 ^ k1, low_0
        k0 = k0 + _WEYL_0
        k1 = k1 + _WEYL_1
    return c0, c1, c2, c3


@njit(cache=True)
def _uniform(word: np.uint64) -> float:
    """In (0, 1), never an end point: 53 bits plus half a step."""
    return ((word >> _MANTISSA_SHIFT) + 0.5) * 2.0**-53


@njit(cache=True)
def draw_uniform(stamp: int, second: int, key: Key) -> float:
    """A uniform number in (0, 1) of a counter (stamp, second, 0)."""
    word, _, _, _ = philox(
        np.uint64(stamp), np.uint64(second), np.uint64(0), np.uint64(0), key[0], key[1]
    )
    return float(_uniform(word))


@njit(cache=True)
def draw_normals(
    stamp: int, second: int, third: int, key: Key
) -> tuple[float, float, float, float]:
    """Four standard normals of a counter (stamp, second, third) (Box-Muller)."""
    w0, w1, w2, w3 = philox(
        np.uint64(stamp), np.uint64(second), np.uint64(third), np.uint64(0), key[0], key[1]
    )
    r0 = math.sqrt(-2.0 * math.log(_uniform(w0)))
    r1 = math.sqrt(-2.0 * math.log(_uniform(w2)))
    t0 = 2.0 * math.pi * _uniform(w1)
    t1 = 2.0 * math.pi * _uniform(w3)
    return r0 * math.cos(t0), r0 * math.sin(t0), r1 * math.cos(t1), r1 * math.sin(t1)


@njit(cache=True)
def _normals(stamps: npt.NDArray[np.int64], blocks: int, key: Key) -> Array:
    out = np.empty((stamps.size, NORMALS_PER_DRAW * blocks))
    for i in range(stamps.size):
        for block in range(blocks):
            a, b, c, d = draw_normals(stamps[i], block, 0, key)
            out[i, 4 * block] = a
            out[i, 4 * block + 1] = b
            out[i, 4 * block + 2] = c
            out[i, 4 * block + 3] = d
    return out


def normals(stamps_ns: npt.ArrayLike, count: int, key: Key) -> Array:
    """(n, count) standard normals of the stream ``key`` at stamps (n,) [integer ns]."""
    stamps = np.atleast_1d(np.asarray(stamps_ns, dtype=np.int64))
    blocks = -(-count // NORMALS_PER_DRAW)
    drawn: Array = _normals(stamps, blocks, key)[:, :count]
    return drawn
