"""Broad phase: which axis-aligned boxes overlap."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim.rigid.contacts import Array, Indices


def overlapping_pairs(lower: Array, upper: Array, moves: NDArray[np.bool_]) -> tuple[Indices, Indices]:
    """Pairs of boxes that overlap or touch, of which one at least moves: the lower number first, ascending.

    Boxes are sorted along the axis on which they lie farthest apart; each is compared with those that begin before it
    ends (Cohen, Lin, Manocha & Ponamgi 1995, "I-COLLIDE").

    Args:
        lower: corners [m], (n, 3).
        upper: the opposite ones [m], (n, 3).
        moves: (n,).
    """
    from sim.rigid.collision_kernels import overlapping_boxes

    boxes = np.concatenate([lower, upper], axis=1)
    axis = int(np.argmax(np.std(lower, axis=0)))
    order = np.argsort(boxes[:, axis], kind="stable").astype(np.int32)
    numbers, starts = np.zeros(len(order), dtype=np.int32), np.zeros(len(order), dtype=np.int32)
    pairs = np.zeros((1, 2), dtype=np.int32)
    for fills in (0, 1):
        overlapping_boxes(boxes, axis, order, moves.astype(np.int32), fills, numbers, starts, pairs)
        if fills == 0:
            starts = (np.cumsum(numbers) - numbers).astype(np.int32)
            pairs = np.zeros((max(1, int(numbers.sum())), 2), dtype=np.int32)
    first, second = pairs[: int(numbers.sum())].astype(np.int64).T
    order = np.lexsort((second, first))
    return first[order], second[order]
