"""Threads of rectangles in float64 with whole matrices: what the kernels compute."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sim.cloth import threads
from sim.cloth.bundles import Nodes, SpringArrays, ThreadWork
from sim.cloth.threads import LEAST_ALIKE, STRAIGHTENED, TURNED_EXPLICITLY

Floats = NDArray[np.float64]


@contextmanager
def threads_in_float64() -> Iterator[None]:
    """Solvers solve and straighten threads by these functions meanwhile."""
    with pytest.MonkeyPatch.context() as patch:
        for solve in (solve_threads, straighten_threads):
            patch.setattr(threads, solve.__name__, solve)
        yield


def solve_threads(
    springs: SpringArrays,
    bounds: tuple[int, ...],
    nodes: Nodes,
    dt: float,
    is_first: int,
    work: ThreadWork,
    _rows: int,
    colours: int,
) -> None:
    lattice, w, u = (read(array) for array in (nodes.lattice, nodes.inverse_mass, nodes.displacement))
    law, shift, multiplier, tension = (
        read(each) for each in (springs.law, springs.shift, work.multiplier, work.tension)
    )
    taut = work.is_taut.to_numpy()
    for piece, own, chain in pieces_of(springs, bounds, colours):
        at_start = -nodes.quantum * np.diff(lattice[chain], axis=0)
        d = at_start - np.diff(u[chain], axis=0)
        length, start_length = (np.linalg.norm(each, axis=1) for each in (d, at_start))
        is_alike = (at_start * d).sum(axis=1) > LEAST_ALIKE * start_length * length
        n = np.where(is_alike[:, None], at_start / start_length[:, None], d / length[:, None])
        compliance = 1.0 / (law[own, 1] * dt * dt)
        before = 0.0 * length if is_first else multiplier[own]
        weight = w[chain[:-1]] + w[chain[1:]]
        beside = -w[chain[1:-1]] * (n[:-1] * n[1:]).sum(axis=1)
        system = np.diag(weight + compliance) + np.diag(beside, 1) + np.diag(beside, -1)
        change = np.linalg.solve(system, law[own, 0] - shift[own] - length - compliance * before)
        push = np.zeros((len(chain), 3))
        push[:-1] += change[:, None] * n
        push[1:] -= change[:, None] * n
        u[chain] += w[chain, None] * push
        multiplier[own] = before + change
        stress = -multiplier[own] / length
        too_much = stress * weight > TURNED_EXPLICITLY
        tension[own] = np.where(too_much, STRAIGHTENED * (stress - TURNED_EXPLICITLY / np.maximum(weight, 1e-30)), 0.0)
        taut[piece] = too_much.any()
    work.is_taut.from_numpy(taut)
    for array, values in ((nodes.displacement, u), (work.multiplier, multiplier), (work.tension, tension)):
        array.from_numpy(values.astype(np.float32))


def straighten_threads(
    springs: SpringArrays,
    bounds: tuple[int, ...],
    nodes: Nodes,
    dt: float,
    work: ThreadWork,
    _rows: int,
    colours: int,
) -> None:
    w, u, tension = (read(array) for array in (nodes.inverse_mass, nodes.displacement, work.tension))
    predicted = read(nodes.carry) + dt * read(nodes.velocity)
    for piece, own, chain in pieces_of(springs, bounds, colours):
        if work.is_taut[piece]:
            change = np.where(w[chain, None] > 0.0, u[chain] - predicted[chain], 0.0)
            t = tension[own]
            laplacian = np.diag(np.append(t, 0.0) + np.append(0.0, t)) - np.diag(t, 1) - np.diag(t, -1)
            u[chain] += np.linalg.solve(np.eye(len(chain)) + w[chain, None] * laplacian, change) - change
    nodes.displacement.from_numpy(u.astype(np.float32))


def read(array: Any) -> Floats:
    values: Floats = array.to_numpy().astype(np.float64)
    return values


def pieces_of(
    springs: SpringArrays, bounds: tuple[int, ...], colours: int
) -> Iterator[tuple[int, slice, NDArray[np.int32]]]:
    """Number, springs and nodes of each piece of some colours, one after the other."""
    starts = springs.segment_start.to_numpy()
    ends = springs.nodes.to_numpy().reshape(-1, 2)
    for piece in range(bounds[0], bounds[colours]):
        own = slice(starts[piece], starts[piece + 1])
        yield piece, own, np.append(ends[own, 0], ends[own][-1, 1])
