"""Strands: the edges of a mesh in rows, as straight as they run, so that they can be solved as threads are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim.cloth.colouring import greedy_colours

Floats = NDArray[np.float64]
Indices = NDArray[np.int32]

STRAND_LENGTH = 32
"""Most edges of a strand: the ring of a tube is cut somewhere, and a GPU needs many strands."""

STRAIGHT = -0.7
"""Edges continue each other at a vertex if the cosine of the angle between them is at most that, 135 degrees."""


def strands_of(edges: Indices, vertices: Floats) -> tuple[Indices, Indices, Indices, Indices]:
    """Rows of edges in which each but the first starts where the one before ends; no row meets a vertex twice.

    Args:
        edges: vertices at their ends, (e, 2).
        vertices: positions [m], (n, 3).

    Returns:
        Strand by strand: the number of each edge, (e,); its ends in the direction of the strand, (e, 2); its strand,
        (e,); the colour of its strand, (e,). Strands of one colour share no vertex.
    """
    partner = _straight_continuations(edges, vertices)
    order, ends, strand = _rows(edges, partner)
    starts = np.flatnonzero(np.diff(strand, prepend=-1))
    lengths = np.diff(np.append(starts, len(strand)))
    column = np.minimum(np.arange(STRAND_LENGTH + 1), lengths[:, None])  # shorter ones repeat their last vertex
    members = np.where(column == 0, ends[starts, :1], ends[starts[:, None] + np.maximum(column - 1, 0), 1])
    return order, ends, strand, greedy_colours(members, len(vertices))[strand]


def _straight_continuations(edges: Indices, vertices: Floats) -> NDArray[np.int64]:
    """For end h % 2 of edge h // 2, the end of another edge at the same vertex that continues it, or -1, (2 e,).

    At every vertex the straightest pair of edges is taken, then the straightest of those left, and so on.
    """
    vertex = edges.ravel()
    along = vertices[edges[:, ::-1].ravel()] - vertices[vertex]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    at_vertex = np.argsort(vertex, kind="stable")
    count = np.bincount(vertex, minlength=len(vertices))
    first = np.cumsum(count) - count
    pairs = []
    for gap in range(1, int(count.max(initial=1))):  # each end with the one so many places on at its vertex
        here = np.arange(len(vertex) - gap)
        here = here[here + gap < (first + count)[vertex[at_vertex[here]]]]
        pairs.append(np.stack([at_vertex[here], at_vertex[here + gap]], axis=1))
    both = np.concatenate(pairs) if pairs else np.empty((0, 2), dtype=np.int64)
    cosine = np.einsum("ki,ki->k", along[both[:, 0]], along[both[:, 1]])
    order = np.lexsort((both[:, 1], both[:, 0], np.round(cosine, 6)))  # equal angles by number, whatever their rounding
    partner = np.full(len(vertex), -1, dtype=np.int64)
    for one, other in both[order[cosine[order] <= STRAIGHT]].tolist():
        if partner[one] < 0 and partner[other] < 0:
            partner[one], partner[other] = other, one
    return partner


def _rows(edges: Indices, partner: NDArray[np.int64]) -> tuple[Indices, Indices, Indices]:
    """Follow the continuations: number, ends and strand of each edge, in the order in which they were passed."""
    following, ends = partner.tolist(), edges.ravel().tolist()
    is_passed = [False] * len(edges)
    order: list[int] = []
    ways: list[tuple[int, int]] = []
    strand: list[int] = []
    loose = [end for end in range(len(ends)) if following[end] < 0]
    for start in (*loose, *range(0, len(ends), 2)):  # rows with two ends first; what is left then are rings
        entry, number, met = start, strand[-1] + 1 if strand else 0, {ends[start]}
        while entry >= 0 and not is_passed[entry // 2]:
            leaving = entry ^ 1
            if len(met) > STRAND_LENGTH or ends[leaving] in met:
                number, met = number + 1, {ends[entry]}
            is_passed[entry // 2] = True
            order.append(entry // 2)
            ways.append((ends[entry], ends[leaving]))
            strand.append(number)
            met.add(ends[leaving])
            entry = following[leaving]
    return np.array(order, dtype=np.int32), np.array(ways, dtype=np.int32), np.array(strand, dtype=np.int32)
