"""Broad phase: which axis-aligned boxes overlap."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sim.rigid.contacts import Array, Indices

PAIRS_OF_A_BOX = 32  # for which there is room at first


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
    n, moved = len(order), moves.astype(np.int32)
    numbers, room = np.zeros(n, dtype=np.int32), PAIRS_OF_A_BOX
    starts, pairs = room * np.arange(n, dtype=np.int32), np.zeros((n * room, 2), dtype=np.int32)
    overlapping_boxes(boxes, axis, order, moved, room, starts, numbers, pairs)
    if int(numbers.max(initial=0)) > room:  # a large body among many: each place gets as much room as it needs
        starts, pairs = (np.cumsum(numbers) - numbers).astype(np.int32), np.zeros((int(numbers.sum()), 2), np.int32)
        overlapping_boxes(boxes, axis, order, moved, int(numbers.max()), starts, numbers, pairs)
    else:
        pairs = pairs[(np.arange(room) < numbers[:, None]).ravel()]
    first, second = pairs.astype(np.int64).T
    order = np.lexsort((second, first))
    return first[order], second[order]


def overlapping_on_host(lower: Array, upper: Array, moves: NDArray[np.bool_]) -> tuple[Indices, Indices]:
    """As `overlapping_pairs`, without kernels: for checks, which no device is started for.

    Boxes are searched for by their centres, in classes of like size: one floor does not make every stone large. n boxes
    of a few sizes cost n log n.
    """
    centre, half = 0.5 * (lower + upper), 0.5 * (upper - lower).max(axis=1)
    size = np.frexp(half)[1]
    classes = [np.flatnonzero(size == each) for each in np.unique(size)]
    trees = [cKDTree(centre[numbers]) for numbers in classes]
    pairs = [np.zeros((0, 2), dtype=np.int64)]
    for moving in (numbers[moves[numbers]] for numbers in classes):
        tree = cKDTree(centre[moving]) if len(moving) else None
        for partners, others in zip(classes, trees, strict=True) if tree is not None else ():
            reach = float(half[moving].max() + half[partners].max())
            near = tree.sparse_distance_matrix(others, reach, p=np.inf, output_type="ndarray")
            one, two = moving[near["i"]], partners[near["j"]]
            # Two that move find each other twice.
            found = (one != two) & (~moves[two] | (one < two))
            found &= np.all((lower[one] <= upper[two]) & (lower[two] <= upper[one]), axis=1)
            pairs.append(np.stack([one[found], two[found]], axis=1))
    first, second = np.sort(np.concatenate(pairs), axis=1).T
    order = np.lexsort((second, first))
    return first[order], second[order]
