"""Broad phase: which axis-aligned boxes overlap."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sim.rigid.contacts import Array, Indices

STEPS_AHEAD, ROOM = 5.0, 0.05
"""Boxes are searched for with room for the motion of so many steps, and for a part of their shortest edges."""


def overlapping_pairs(lower: Array, upper: Array, is_active: NDArray[np.bool_]) -> tuple[Indices, Indices]:
    """Pairs of boxes that overlap or touch, of which one at least is active: the lower number first, ascending.

    Boxes are searched for by their centres, in classes of like size: one floor does not make every stone large. n boxes
    of a few sizes cost n log n.

    Args:
        lower: corners [m], (n, 3).
        upper: the opposite ones [m], (n, 3).
        is_active: (n,).
    """
    centre, half = 0.5 * (lower + upper), 0.5 * (upper - lower).max(axis=1)
    size = np.frexp(half)[1]
    classes = [np.flatnonzero(size == each) for each in np.unique(size)]
    trees = [cKDTree(centre[numbers]) for numbers in classes]
    pairs = [np.zeros((0, 2), dtype=np.int64)]
    for active in (numbers[is_active[numbers]] for numbers in classes):
        tree = cKDTree(centre[active]) if len(active) else None
        for partners, others in zip(classes, trees, strict=True) if tree is not None else ():
            reach = float(half[active].max() + half[partners].max())
            near = tree.sparse_distance_matrix(others, reach, p=np.inf, output_type="ndarray")
            one, two = active[near["i"]], partners[near["j"]]
            # Two active ones find each other twice.
            found = (one != two) & (~is_active[two] | (one < two))
            found &= np.all((lower[one] <= upper[two]) & (lower[two] <= upper[one]), axis=1)
            pairs.append(np.stack([one[found], two[found]], axis=1))
    first, second = np.sort(np.concatenate(pairs), axis=1).T
    order = np.lexsort((second, first))
    return first[order], second[order]


class NearBoxes:
    """Pairs of boxes that overlap, from step to step: they are searched for anew when one has left a larger one."""

    def __init__(self) -> None:
        self._lower = self._upper = np.zeros((0, 3))
        self._is_active = np.zeros(0, dtype=bool)

    def overlapping(
        self, lower: Array, upper: Array, motion: Array, is_active: NDArray[np.bool_]
    ) -> tuple[Indices, Indices]:
        """As `overlapping_pairs` has them; surfaces get about so far in a step [m], (n,)."""
        is_known = len(self._lower) == len(lower) and not np.any(is_active & ~self._is_active)
        if not (is_known and np.all(lower >= self._lower) and np.all(upper <= self._upper)):
            room = (STEPS_AHEAD * motion + ROOM * (upper - lower).min(axis=1))[:, None]
            self._lower, self._upper, self._is_active = lower - room, upper + room, is_active
            self._first, self._second = overlapping_pairs(self._lower, self._upper, is_active)
        first, second = self._first, self._second
        found = is_active[first] | is_active[second]
        for axis in range(3):
            low, high = lower[:, axis], upper[:, axis]
            found &= (low[first] <= high[second]) & (low[second] <= high[first])
        return first[found], second[found]
