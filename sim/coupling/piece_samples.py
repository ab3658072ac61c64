"""The samples that a fluid feels of pieces which are glued together: those of the surface that is free now."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim.coupling.completion import completing_factors
from sim.fluid.boundary import Boundary
from sim.fluid.boundary_akinci2012 import BoundarySamples, sunk_layers
from sim.fluid.kernels import SUPPORT_IN_SPACINGS, Discretization
from sim.rigid.glue import Glue, Whole
from sim.rigid.solver import RigidSolver
from sim.shapes.cutting import cut_of, united
from sim.shapes.placement import PlacedSolid
from sim.shapes.sampling import sample_surface
from sim.shapes.solid import SignedDistance

COVERED = 0.1  # depth from which on a sample is covered [spacings]: facets of what is round lie inside of it
SHARD = 0.1  # spacing of what the sample of a shard is chosen of [spacings]

Float64Array = NDArray[np.float64]


def samples_of_pieces(rigid: RigidSolver, spacing: float, support_in_spacings: float) -> dict[int, BoundarySamples]:
    """Samples of each piece, by its number, on its surface and without volume; `PieceSamples` sinks and weighs them.

    Those of the whole's surface, each of the piece that it is on, and then those of the faces inside of it: a body that
    holds has the samples of one that cannot break. As many layers of them as a support takes.
    """
    found = {}
    layers = 1 if support_in_spacings == SUPPORT_IN_SPACINGS else 2
    for whole in rigid.glue.wholes if rigid.glue is not None else ():
        solid = whole.solid()
        outer = sample_surface(solid.rest_mesh(), spacing).astype(np.float64)
        own = [rigid.solids[piece].solid for piece in whole.pieces]
        nearest = np.argmin([piece.signed_distance(outer) for piece in own], axis=0)
        for number, (piece, part) in enumerate(zip(whole.pieces, own, strict=True)):
            inner = sample_surface(part.rest_mesh(), spacing).astype(np.float64)
            inner = inner[solid.signed_distance(inner) < -COVERED * spacing]
            if not len(inner) and not (nearest == number).any():  # a shard, which is felt by one sample at least
                finer = sample_surface(part.rest_mesh(), SHARD * spacing).astype(np.float64)
                inner = finer[np.argsort(solid.signed_distance(finer), kind="stable")[:1]]
            points = np.concatenate([outer[nearest == number], inner]) - rigid.solids[piece].centre_of_mass
            layer = np.repeat(np.arange(layers), len(points))
            found[int(piece)] = BoundarySamples.of_points(np.tile(points, (layers, 1)), factor=0.0, layer=layer)
    return found


class PieceSamples:
    """Where the samples of glued pieces are, and their volumes, by what holds together.

    Each component is sunk and completed as the body that it is; samples of faces that are covered do not count. What a
    component is made of tells all, so that a run that continues finds the same.
    """

    def __init__(self, boundary: Boundary, glue: Glue, rigid: RigidSolver, discretization: Discretization) -> None:
        """Take those that a boundary has of all bodies; a discretization is the fluid's."""
        self._boundary, self._glue, self._rigid, self._discretization = boundary, glue, rigid, discretization
        self._whole_of = {int(piece): whole for whole in glue.wholes for piece in whole.pieces}
        self._known: dict[tuple[int, ...], tuple[NDArray[np.int64], Float64Array, Float64Array]] = {}
        self._surface = boundary.moving.positions.astype(np.float64)  # about the centre of each body
        self._leader = np.empty(0, dtype=glue.leader.dtype)  # as the samples have it

    def follow(self) -> None:
        """Let pieces move with what they are glued to, and feel the fluid where they are free."""
        glue = self._glue
        if np.array_equal(glue.leader, self._leader):
            return
        self._leader = glue.leader.copy()
        leaders = np.unique(glue.leader[list(self._whole_of)])
        components = [tuple(map(int, np.flatnonzero(glue.leader == leader))) for leader in leaders]
        self._known = {each: self._known[each] if each in self._known else self._made(each) for each in components}
        rows, position, volume = map(np.concatenate, zip(*self._known.values(), strict=True))
        self._boundary.glue(glue.leader, glue.arm, rows, position, volume)

    def _made(self, pieces: tuple[int, ...]) -> tuple[NDArray[np.int64], Float64Array, Float64Array]:
        """The samples of pieces that hold together: their rows, places and volumes."""
        moving, centre = self._boundary.moving, self._glue.centre
        rows = np.flatnonzero(np.isin(moving.body, pieces))
        of_piece, layer = moving.body[rows], moving.layer[rows]
        distance = self._solid_of(pieces)
        surface = self._surface[rows] + centre[of_piece]
        spacing, support = self._discretization.spacing, self._discretization.support_in_spacings
        nearest = np.flatnonzero(layer == 0)
        free = nearest[distance(surface[nearest]) > -COVERED * spacing]
        sunk, source = sunk_layers(surface[free], distance, spacing, support)
        sunk = sunk.scaled(completing_factors(sunk, surface[free], distance, spacing, support))
        places, volumes = self._surface[rows].copy(), np.zeros(len(rows))
        for number in np.unique(sunk.layer):
            mine = sunk.layer == number
            at = free[source[mine]] if number == 0 else _in_layer(free[source[mine]], of_piece, layer, int(number))
            places[at] = sunk.positions[mine].astype(np.float64) - centre[of_piece[at]]
            volumes[at] = sunk.volumes(spacing, support)[mine]
        return rows, places, volumes

    def _solid_of(self, pieces: tuple[int, ...]) -> SignedDistance:
        """Distances to the surface of pieces that hold together, in the frame of their whole."""
        whole: Whole = self._whole_of[pieces[0]]
        if len(pieces) == 1:
            return self._rigid.solids[pieces[0]].solid.signed_distance
        if len(pieces) == len(whole.pieces):
            return whole.solid().signed_distance
        cut = cut_of(whole.shape).pieces
        parts = [cut[number] for number in np.flatnonzero(np.isin(whole.pieces, pieces))]
        return PlacedSolid(united(parts), whole.scale, np.eye(3), np.zeros(3)).signed_distance


def _in_layer(
    rows: NDArray[np.int64], of_piece: NDArray[np.int32], layer: NDArray[np.int32], number: int
) -> NDArray[np.int64]:
    """Rows of the same samples in another layer: those of a piece follow each other, layer by layer."""
    counts = np.bincount(of_piece[layer == 0], minlength=int(of_piece.max()) + 1)
    found: NDArray[np.int64] = rows + number * counts[of_piece[rows]]
    return found
