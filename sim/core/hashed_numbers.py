"""Random numbers that are functions of a place, a time and a seed, so that a run that continues sees the same."""

import math

import numpy as np
import taichi as ti
from numpy.typing import ArrayLike, NDArray

ALL_BITS = 0xFFFFFFFF

GOLDEN = 2654435769  # an odd factor that spreads small numbers over all 32 bits (Knuth)

UInt32Array = NDArray[np.uint32]
_MULTIPLIERS = (np.uint64(0xD2511F53), np.uint64(0xCD9E8D57))
_WEYL = (0x9E3779B9, 0xBB67AE85)
_ROUNDS = 10
_LOW = np.uint64(0xFFFFFFFF)
_SHIFT = np.uint64(32)


@ti.func
def hash_bits(key: ti.u32):
    """32 bits from 32 bits (Jarzynski & Olano 2020, PCG)."""
    state = key * ti.u32(747796405) + ti.u32(2891336453)
    word = ((state >> ((state >> ti.u32(28)) + ti.u32(4))) ^ state) * ti.u32(277803737)
    return (word >> ti.u32(22)) ^ word


@ti.func
def hash_to_unit(key: ti.u32):
    """A number in [0, 1) from 32 bits."""
    return ti.cast(hash_bits(key) >> ti.u32(8), ti.f32) / 16777216.0


@ti.func
def hash_to_smooth(time: ti.f32, salt: ti.i32):
    """A number in [0, 1) that changes smoothly and takes new values at every whole time, as `smooth_noise`."""
    tick = ti.floor(time, ti.i32)
    first, last = hash_to_unit(ti.cast(salt ^ tick, ti.u32)), hash_to_unit(ti.cast(salt ^ (tick + 1), ti.u32))
    return first + (last - first) * (0.5 - 0.5 * ti.cos(ti.math.pi * (time - ti.cast(tick, ti.f32))))


def spread(seed: int) -> int:
    """32 bits by which to change the keys of a hash; 0 for seed 0."""
    return seed * GOLDEN & ALL_BITS


def smooth_noise(time: float, seed: int) -> float:
    """A number in [0, 1) that changes smoothly and takes new values at every whole time; for the host."""
    tick = math.floor(time)
    first, last = (_hash_to_unit(spread(seed) ^ (number & ALL_BITS)) for number in (tick, tick + 1))
    return first + (last - first) * (0.5 - 0.5 * math.cos(math.pi * (time - tick)))


def _hash_to_unit(key: int) -> float:
    """As `hash_to_unit`."""
    state = (key * 747796405 + 2891336453) & ALL_BITS
    word = (((state >> ((state >> 28) + 4)) ^ state) * 277803737) & ALL_BITS
    return (((word >> 22) ^ word) >> 8) / 16777216.0


def philox(counter: tuple[ArrayLike, ArrayLike, ArrayLike, ArrayLike], key: tuple[int, int]) -> UInt32Array:
    """Four random words for each counter, (4, n), the same in whatever order they are drawn (Salmon et al. 2011).

    Philox4x32-10: counters are arrays (n,) or numbers, all words are below 2^32.
    """
    words = [np.asarray(word, dtype=np.uint64) for word in np.broadcast_arrays(*map(np.atleast_1d, counter))]
    first, second = key
    for _ in range(_ROUNDS):
        left, right = _MULTIPLIERS[0] * words[0], _MULTIPLIERS[1] * words[2]
        words = [
            (right >> _SHIFT) ^ words[1] ^ np.uint64(first),
            right & _LOW,
            (left >> _SHIFT) ^ words[3] ^ np.uint64(second),
            left & _LOW,
        ]
        first, second = (first + _WEYL[0]) & 0xFFFFFFFF, (second + _WEYL[1]) & 0xFFFFFFFF
    return np.stack(words).astype(np.uint32)


def uniforms(counter: tuple[ArrayLike, ArrayLike, ArrayLike, ArrayLike], key: tuple[int, int]) -> NDArray[np.float64]:
    """Four numbers in [0, 1) for each counter, (4, n); see `philox`."""
    return philox(counter, key) * 2.0**-32
