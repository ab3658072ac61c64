"""The order in which rows of joints are eliminated, and the pattern of their matrix and its factor."""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.rigid.contacts import Indices

Counts = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Elimination:
    """Rows of joints in the order of their elimination, and where A = J M⁻¹ Jᵀ and its factor L are not 0.

    Rows that joints link through bodies that may move are a component, and stand together.
    """

    joint: Indices  # of each row, (r,)
    number: Indices  # of the row among those of its joint, (r,)
    parent: Counts  # of each row in the elimination tree, -1 at its root, (r,)
    column: Counts  # where the entries of A on and above the diagonal begin, by column, (r + 1,)
    entry_rows: Counts  # their rows, (e,)
    factor: Counts  # where the entries of L below the diagonal begin, by column, (r + 1,)
    components: Counts  # first row and end of each component, (c, 2)
    component: Indices  # number of that of each row, (r,)
    pairs: Indices  # products that make the entries: entry, row and side, column and side, (p, 5)


def elimination_of(bodies: Indices, counts: Sequence[int], is_dynamic: NDArray[np.bool_]) -> Elimination:
    """The order by least degree (Tinney & Walker 1967), which fills nothing in where joints make a tree.

    Args:
        bodies: numbers of the two bodies of each joint, (j, 2).
        counts: rows of each joint.
        is_dynamic: bodies that joints link, (n,).
    """
    owners: dict[int, list[int]] = {}
    for joint, pair in enumerate(bodies.tolist()):
        for body in pair:
            if is_dynamic[body]:
                owners.setdefault(body, []).append(joint)
    neighbours: list[set[int]] = [set() for _ in counts]
    for joints in owners.values():
        for joint in joints:
            neighbours[joint].update(joints)
    for joint, near in enumerate(neighbours):
        near.discard(joint)
    order = _by_component(_by_degree(neighbours, counts), neighbours)

    joint = np.array([each for each, _ in order for _ in range(counts[each])], dtype=np.int64)
    number = np.array([row for each, _ in order for row in range(counts[each])], dtype=np.int64)
    component = np.array([group for each, group in order for _ in range(counts[each])], dtype=np.int64)
    rows_of: dict[int, list[int]] = {}
    for row, each in enumerate(joint.tolist()):
        rows_of.setdefault(each, []).append(row)
    column, entry_rows, pairs = [0], [], []
    for k, each in enumerate(joint.tolist()):
        above = [i for other in (each, *neighbours[each]) for i in rows_of[other] if i <= k]
        for i in sorted(above):
            first, second = bodies[joint[i]], bodies[each]
            shared = [(a, b) for a in range(2) for b in range(2) if first[a] == second[b] and is_dynamic[first[a]]]
            pairs += [(len(entry_rows), i, a, k, b) for a, b in shared]
            entry_rows.append(i)
        column.append(len(entry_rows))
    parent, filled = _tree(column, entry_rows)
    groups = np.unique(component)
    return Elimination(
        joint,
        number,
        np.array(parent, dtype=np.int32),
        np.array(column, dtype=np.int32),
        np.array(entry_rows, dtype=np.int32),
        np.concatenate([[0], np.cumsum(filled)]).astype(np.int32),
        np.stack([np.searchsorted(component, groups), np.searchsorted(component, groups, "right")], axis=1).astype(
            np.int32
        ),
        component,
        np.array(pairs, dtype=np.int64).reshape(-1, 5),
    )


def _by_degree(neighbours: Sequence[set[int]], counts: Sequence[int]) -> list[int]:
    """Joints in the order of the fewest rows that are left beside them."""
    left = [set(near) for near in neighbours]
    degree = [sum(counts[each] for each in near) for near in left]
    heap = [(size, joint) for joint, size in enumerate(degree)]
    heapq.heapify(heap)
    order, done = [], [False] * len(counts)
    while heap:
        size, joint = heapq.heappop(heap)
        if done[joint] or size != degree[joint]:
            continue
        done[joint] = True
        order.append(joint)
        for near in left[joint]:
            left[near] |= left[joint]
            left[near] -= {near, joint}
            degree[near] = sum(counts[each] for each in left[near])
            heapq.heappush(heap, (degree[near], near))
    return order


def _by_component(order: Sequence[int], neighbours: Sequence[set[int]]) -> list[tuple[int, int]]:
    """Joints, each with the number of those that hang together with it, these one after the other."""
    group = [-1] * len(neighbours)
    for start in range(len(neighbours)):
        stack = [start] if group[start] < 0 else []
        while stack:
            joint = stack.pop()
            if group[joint] < 0:
                group[joint] = start
                stack += neighbours[joint]
    names = {start: number for number, start in enumerate(sorted(set(group)))}
    return sorted(((joint, names[group[joint]]) for joint in order), key=lambda each: each[1])


def _tree(column: Sequence[int], entry_rows: Sequence[int]) -> tuple[list[int], list[int]]:
    """Parents in the elimination tree, and entries of each column of L below the diagonal (Davis 2005)."""
    count = len(column) - 1
    parent, filled, flag = [-1] * count, [0] * count, [-1] * count
    for k in range(count):
        flag[k] = k
        for i in entry_rows[column[k] : column[k + 1]]:
            node = i
            while flag[node] != k:
                if parent[node] < 0:
                    parent[node] = k
                filled[node] += 1
                flag[node] = k
                node = parent[node]
    return parent, filled
