"""Random numbers by their place, not by their turn: Philox4x32-10 (Salmon et al. 2011, "Parallel random numbers").

A number depends on a key and a counter alone, so it is the same however often, and in whatever order, it is drawn.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

UInt32Array = NDArray[np.uint32]

_MULTIPLIERS = (np.uint64(0xD2511F53), np.uint64(0xCD9E8D57))
_WEYL = (0x9E3779B9, 0xBB67AE85)
_ROUNDS = 10
_LOW = np.uint64(0xFFFFFFFF)
_SHIFT = np.uint64(32)


def philox(counter: tuple[ArrayLike, ArrayLike, ArrayLike, ArrayLike], key: tuple[int, int]) -> UInt32Array:
    """Four random words for each counter, (4, n); counters are arrays (n,) or numbers, all words are below 2^32."""
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
