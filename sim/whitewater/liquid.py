"""Bulk, sheets and spray: what each particle of a fluid stands for, told from one cached frame to the next.

A particle's kind follows from what is around it: how many particles the support radius h holds, how flat they lie
(eigenvalues of their weighted covariance, Yu & Turk 2013), and how large the piece of liquid is that it hangs together
with. Each rule has one threshold to become a kind and a laxer one to stay it, and a kind is kept for some frames, so
that nothing flickers.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from sim.whitewater.fluid_field import SUPPORT_IN_SPACINGS, FluidField
from sim.whitewater.kinds import LiquidKind
from sim.whitewater.motion import FluidState
from sim.whitewater.obstacles import Obstacles

CROWDED = 16
"""Neighbours from which a particle is inside of the liquid or on its surface: a lattice has 32 within h, its flat face
20, a flat film 12, a thread 4."""

LINK_IN_SPACINGS = 1.5
"""Particles as near as this hang together: a film stretched to 1.5 times its spacing is the thinnest that the contour
of its density still closes."""

SPRAY_PIECE, STAYING_SPRAY_PIECE = 12, 24
"""Pieces of fewer particles break up into spray, and spray is part of a piece again that has as many as the second:
8 particles are two thick in each direction, which is what smoothing leaves of a blob."""

LONELY, STAYING_LONELY = 1, 3
"""As few neighbours or fewer within h make spray of a particle at the frayed end of a piece, and keep it spray: within
a thread there are 4, and 2 where it is stretched."""

FLAT, STAYING_FLAT = 0.1, 0.2
"""Least over largest eigenvalue of the covariance below which surroundings are a sheet or a thread, and stay one:
0 in a single layer, 0.3 on a flat face and in two layers, 1 inside."""

KEPT_FRAMES = 4
"""For so many frames a kind is kept, but where spray falls into the crowd: so only what will not be there so soon, as
it flies, becomes spray."""


@dataclass(frozen=True)
class LiquidState:
    """The particles of one fluid as what they are at a frame: all that the next frame needs to know."""

    particle_id: NDArray[np.int32]  # (n,) int32, ascending
    kind: NDArray[np.uint8]  # values of `LiquidKind`, (n,), uint8
    held: NDArray[np.uint8]  # frames since the last change of kind, 255 at most, (n,), uint8
    reach: NDArray[np.float32]  # how far the drops of spray have spread from its particle [m], (n,), float32

    @classmethod
    def empty(cls) -> LiquidState:
        """No particles."""
        bytes_ = np.zeros(0, np.uint8)
        return cls(np.zeros(0, np.int32), bytes_, bytes_, np.zeros(0, np.float32))

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, NDArray[np.generic]]) -> LiquidState:
        """The particles of a frame's datasets, by name."""
        return cls(
            arrays["particle_id"].astype(np.int32, copy=False),
            arrays["liquid"].astype(np.uint8, copy=False),
            arrays["held"].astype(np.uint8, copy=False),
            arrays["reach"].astype(np.float32, copy=False),
        )


def next_liquid(
    before: LiquidState,
    tank: FluidState,
    particle_id: NDArray[np.int32],
    *,
    particle_radius: float,
    frame_dt: float,
    atomizes: bool,
    lies: NDArray[np.bool_],
) -> LiquidState:
    """The kinds of a fluid's particles at a frame; `sim.core.runtime.initialize` must have run.

    `reach` is as before, and 0 for what has just become spray: `drops.grown_reach` lets it grow.

    Args:
        before: the same fluid one frame before; empty at the first.
        tank: all particles of the tank at this frame, of one radius [m]: fluids that touch are one piece.
        particle_id: those of this fluid, (n,), ascending.
        particle_radius: [m], half the spacing of the particles at rest.
        frame_dt: time between frames [s].
        atomizes: whether pieces break up; a liquid too stiff for it has no spray.
        lies: which particles walls and bodies hold, (n,): what is left on a floor is no spray.
    """
    spacing = 2.0 * particle_radius
    rows = np.searchsorted(tank.particle_id, particle_id)
    neighbors, flatness, piece = (each[rows] for each in _surroundings(tank, spacing))

    kind, held, reach = (np.zeros(len(particle_id), dtype) for dtype in (np.uint8, np.uint8, np.float32))
    is_new = np.ones(len(particle_id), bool)
    _, now, then = np.intersect1d(particle_id, before.particle_id, assume_unique=True, return_indices=True)
    kind[now], held[now], reach[now], is_new[now] = before.kind[then], before.held[then], before.reach[then], False

    was_spray, was_sheet = kind == LiquidKind.SPRAY, kind == LiquidKind.SHEET
    small = piece < np.where(was_spray, STAYING_SPRAY_PIECE, SPRAY_PIECE)
    lonely = neighbors <= np.where(was_spray, STAYING_LONELY, LONELY)
    flat = (flatness < np.where(was_sheet, STAYING_FLAT, FLAT)) & (neighbors < CROWDED)
    breaks_up = atomizes & (small | lonely) & ~lies
    new = np.flatnonzero(breaks_up & ~was_spray)
    breaks_up[new] = ~_falls_in(tank, rows[new], KEPT_FRAMES * frame_dt, spacing)
    wanted = np.where(breaks_up, LiquidKind.SPRAY, np.where(flat, LiquidKind.SHEET, LiquidKind.BULK))
    swallowed = was_spray & ((neighbors >= CROWDED) | lies)
    changes = (wanted != kind) & (is_new | swallowed | (held >= KEPT_FRAMES))
    kind = np.where(changes, wanted, kind).astype(np.uint8)
    # What is there from the start has been what it is for long.
    held = np.where(is_new, 255, np.where(changes, 1, np.minimum(held, 254) + 1)).astype(np.uint8)
    reach = np.where((kind == LiquidKind.SPRAY) & ~changes, reach, np.float32(0.0)).astype(np.float32)
    return LiquidState(particle_id, kind, held, reach)


def hangs_together(tank: FluidState, *, particle_radius: float) -> NDArray[np.bool_]:
    """Which particles of a tank, of one radius [m], are no spray by this frame alone, (n,)."""
    neighbors, _, piece = _surroundings(tank, 2.0 * particle_radius)
    whole: NDArray[np.bool_] = (piece >= SPRAY_PIECE) & (neighbors > LONELY)
    return whole


def _surroundings(tank: FluidState, spacing: float) -> tuple[NDArray[np.int32], NDArray[np.float64], NDArray[np.int64]]:
    """Neighbours within h, flatness and size of the piece of every particle, (n,) each.

    Where a crowded particle belongs to a piece it is as large as any: its size is that of the whole tank.
    """
    count = len(tank.position)
    link = LINK_IN_SPACINGS * spacing
    around = _field(tank, spacing).neighborhoods(CROWDED, link)
    flatness, piece = np.ones(count), np.full(count, count, np.int64)
    thin = np.flatnonzero(around.neighbors < CROWDED)
    if not len(thin):
        return around.neighbors, flatness, piece
    eigenvalues = np.linalg.eigvalsh(around.covariance[thin].astype(np.float64) / (SUPPORT_IN_SPACINGS * spacing) ** 2)
    flatness[thin] = np.maximum(eigenvalues[:, 0], 0.0) / np.maximum(eigenvalues[:, 2], np.finfo(np.float32).tiny)
    pairs = cKDTree(tank.position[thin]).query_pairs(link, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(len(thin),) * 2)
    pieces, label = connected_components(graph, directed=False)
    size = np.bincount(label, minlength=pieces)
    size[np.bincount(label, around.touches_crowd[thin], minlength=pieces) > 0] = count
    piece[thin] = size[label]
    return around.neighbors, flatness, piece


def _falls_in(tank: FluidState, rows: NDArray[np.intp], ahead_s: float, spacing: float) -> NDArray[np.bool_]:
    """Which of these particles are in the crowd if all fly on as they do for some time [s]."""
    if not len(rows):
        return np.zeros(0, bool)
    flown = tank.position.astype(np.float64) + ahead_s * tank.velocity
    counts = cKDTree(flown).query_ball_point(flown[rows], SUPPORT_IN_SPACINGS * spacing, return_length=True)
    found: NDArray[np.bool_] = counts - 1 >= CROWDED  # they count themselves
    return found


def lie_on(solids: Obstacles, fluid: FluidState, *, particle_radius: float, frame_dt: float) -> NDArray[np.bool_]:
    """Which particles walls and bodies hold: a spacing near, and slow enough to be there as long as a kind is kept."""
    spacing, speed = 2.0 * particle_radius, np.linalg.norm(fluid.velocity.astype(np.float64), axis=1)
    slow = np.flatnonzero(speed * KEPT_FRAMES * frame_dt < spacing)
    lies = np.zeros(len(fluid.position), bool)
    lies[slow] = solids.free_share(fluid.position[slow].astype(np.float64), spacing, 1.0) < 1.0
    return lies


def _field(tank: FluidState, spacing: float) -> FluidField:
    corners = [tank.position.min(axis=0), tank.position.max(axis=0)] if len(tank.position) else np.zeros((2, 3))
    field = FluidField(np.asarray(corners, np.float64), spacing / 2.0, len(tank.position))
    field.update(tank)
    return field
