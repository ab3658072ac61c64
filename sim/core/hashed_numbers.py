"""Random numbers that are functions of a place, a time and a seed, so that a run that continues sees the same."""

import math

import taichi as ti

ALL_BITS = 0xFFFFFFFF

GOLDEN = 2654435769  # an odd factor that spreads small numbers over all 32 bits (Knuth)


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
