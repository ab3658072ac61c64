"""Colours for springs, so that no two of one colour share a node and a colour can be solved in parallel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_HASH = np.uint64(0x9E3779B97F4A7C15)
"""2^64 over the golden ratio (Knuth 1973, vol. 3, 6.4): consecutive numbers get priorities far from each other."""


def greedy_colours(nodes: NDArray[np.integer], node_count: int) -> NDArray[np.int32]:
    """A colour for each spring, (m,), such that springs of one colour share no node.

    Colour by colour, a maximal set of independent springs is taken from those left: in rounds, each time those that
    come before all their neighbours in a fixed order (Luby 1986, with priorities that are hashed instead of drawn).
    The same springs always get the same colours.

    Args:
        nodes: of each spring, (m, arity).
        node_count: number of nodes.
    """
    count = len(nodes)
    priority = np.empty(count, dtype=np.int64)
    priority[np.argsort(np.arange(count, dtype=np.uint64) * _HASH, kind="stable")] = np.arange(count)
    colours = np.full(count, -1, dtype=np.int32)
    left = np.arange(count)
    colour = 0
    while len(left):
        candidates = left
        taken = np.zeros(node_count, dtype=bool)
        while len(candidates):
            first = np.full(node_count, count, dtype=np.int64)
            np.minimum.at(first, nodes[candidates].ravel(), np.repeat(priority[candidates], nodes.shape[1]))
            chosen = candidates[(first[nodes[candidates]] == priority[candidates, None]).all(axis=1)]
            colours[chosen] = colour
            taken[nodes[chosen].ravel()] = True
            candidates = candidates[~taken[nodes[candidates]].any(axis=1)]
        left = left[colours[left] < 0]
        colour += 1
    return colours
