"""Walls that a liquid wets: its surface ends flat on them, and what runs along them thinner than a particle is a film.

The mirror image of the particles behind a wall makes the contour of their density cross it at a right angle; what is
behind it is then folded onto it. A film has too few particles for a contour of its own: it is as thick as their volume
an area says (a height field over the wall), sampled on a lattice.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from render.meshes import SurfaceMesh

FILM_IN_SPACINGS = 2.5
"""Distance from a wall within which particles that are not crowded run along it as a film."""

WIDTH_IN_SPACINGS = 2.0
"""Standard deviation of the Gaussian that spreads a particle of a film over the wall: particles of FLIP that close a
film with cells of twice a spacing reach as far."""

THINNEST_IN_SPACINGS = 0.06
"""Thickness from which there is a film: a lone particle gives 0.04 where it is."""

CROWDED = 16
"""Neighbours within two spacings, images included, from which a particle is no part of a film: a flat face has 20, and
a layer at rest on a wall 21."""

MIRRORED_IN_SPACINGS = 1.25  # the layer at a wall, and half a spacing of disorder
_SUPPORT_IN_SPACINGS = 2.0
_INSET_IN_RADII = 0.1  # between surface and wall, so that they are not one
_LEAST_HEIGHT = 0.05  # of samples over the wall [spacings]: with their images they are one layer
_UPPER = 0.4  # height from which there are samples below, too [spacings]: else the film would be hollow


class Wall(NamedTuple):
    """A plane along two axes."""

    axis: int  # across it
    place: float  # [m]
    inwards: float  # sign of the direction to the liquid

    def distance(self, positions: NDArray[np.float32]) -> NDArray[np.float64]:
        """How far points (n, 3) [m] are from it [m], (n,)."""
        return np.asarray(self.inwards * (positions[:, self.axis] - self.place), np.float64)


@dataclass(frozen=True, eq=False)
class Walls:
    """The planes that bound a box; open faces are at infinity."""

    low: NDArray[np.float64]  # [m], (3,)
    high: NDArray[np.float64]  # [m], (3,)

    @classmethod
    def nowhere(cls) -> Walls:
        """No wall."""
        return cls(np.full(3, -np.inf), np.full(3, np.inf))

    def planes(self) -> Iterator[Wall]:
        """Those at a finite place."""
        for axis in range(3):
            for place, inwards in ((self.low[axis], 1.0), (self.high[axis], -1.0)):
                if np.isfinite(place):
                    yield Wall(axis, float(place), inwards)

    def inset(self, distance: float) -> Walls:
        """Planes that are inside by a distance [m], as single precision has them."""
        low, high = (self.low + distance).astype(np.float32), (self.high - distance).astype(np.float32)
        return Walls(low.astype(np.float64), high.astype(np.float64))


@dataclass(frozen=True, eq=False)
class Films:
    """Films on walls, as samples for a mesher."""

    position: NDArray[np.float32]  # of the samples [m], (m, 3)
    velocity: NDArray[np.float32]  # [m/s], (m, 3)
    replaces: NDArray[np.bool_]  # which particles the samples stand for, (n,)


@dataclass(frozen=True, eq=False)
class _Film:
    """A film over one wall, on a lattice of cells of a spacing."""

    near: NDArray[np.intp]  # particles within its reach
    cell: tuple[NDArray[np.intp], NDArray[np.intp]]  # of each of these
    thickness: NDArray[np.float64]  # [spacings], (nu, nv)
    velocity: NDArray[np.float64]  # [m/s], (nu, nv, 3)
    origin: NDArray[np.float64]  # of the lattice, along the wall [spacings], (2,)


def in_films(positions: NDArray[np.float32], walls: Walls, *, spacing: float) -> NDArray[np.bool_]:
    """Which particles (n, 3) [m] run along walls, near enough to each other to be a film, (n,)."""
    found = np.zeros(len(positions), bool)
    for _, film in _films(positions, np.zeros_like(positions), walls, spacing=spacing):
        found[film.near[film.thickness[film.cell] > THINNEST_IN_SPACINGS]] = True
    return found


def films(positions: NDArray[np.float32], velocities: NDArray[np.float32], walls: Walls, *, spacing: float) -> Films:
    """The films of particles (n, 3) [m] with velocities [m/s] on walls."""
    replaces = np.zeros(len(positions), bool)
    samples, motion = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for (axis, place, inwards), film in _films(positions, velocities, walls, spacing=spacing):
        covered = film.thickness > THINNEST_IN_SPACINGS
        replaces[film.near[covered[film.cell]]] = True
        height = np.maximum(film.thickness[covered] - 0.5, _LEAST_HEIGHT)
        along = [other for other in range(3) if other != axis]
        for share, has in ((1.0, np.ones(len(height), bool)), (0.5, height > _UPPER)):
            sample = np.empty((np.count_nonzero(has), 3))
            sample[:, along] = spacing * (film.origin + np.argwhere(covered)[has] + 0.5)
            sample[:, axis] = place + inwards * spacing * share * height[has]
            samples.append(sample)
            motion.append(film.velocity[covered][has])
    return Films(np.concatenate(samples).astype(np.float32), np.concatenate(motion).astype(np.float32), replaces)


def _films(
    positions: NDArray[np.float32], velocities: NDArray[np.float32], walls: Walls, *, spacing: float
) -> Iterator[tuple[Wall, _Film]]:
    """The films on each wall but the floor, where a liquid lies as its particles do."""
    upright = Walls(np.array([*walls.low[:2], -np.inf]), walls.high)
    sparse = _uncrowded(positions, upright, walls, spacing=spacing)
    for wall in upright.planes():
        near = sparse[wall.distance(positions[sparse]) < FILM_IN_SPACINGS * spacing]
        if len(near):
            yield wall, _film(near, positions[near], velocities[near], wall, walls, spacing=spacing)


def _uncrowded(positions: NDArray[np.float32], at: Walls, walls: Walls, *, spacing: float) -> NDArray[np.intp]:
    """Particles (n, 3) [m] that are near some walls and have few neighbours, images behind all walls included."""
    from scipy.spatial import cKDTree

    distance = np.full(len(positions), np.inf)
    for wall in at.planes():
        np.minimum(distance, wall.distance(positions), out=distance)
    near = np.flatnonzero(distance < FILM_IN_SPACINGS * spacing)
    if not len(near):
        return near
    around = positions[distance < (FILM_IN_SPACINGS + _SUPPORT_IN_SPACINGS) * spacing]
    all_around, _, _ = mirrored(around, around, walls, reach=_SUPPORT_IN_SPACINGS * spacing)
    counts = cKDTree(all_around).query_ball_point(positions[near], _SUPPORT_IN_SPACINGS * spacing, return_length=True)
    sparse: NDArray[np.intp] = near[counts - 1 < CROWDED]  # each counts itself
    return sparse


def _film(
    near: NDArray[np.intp],
    positions: NDArray[np.float32],
    velocities: NDArray[np.float32],
    wall: Wall,
    walls: Walls,
    *,
    spacing: float,
) -> _Film:
    """The film of the particles `near` a wall, which have these positions [m] and velocities [m/s], (m, 3)."""
    from scipy.ndimage import gaussian_filter

    along = [other for other in range(3) if other != wall.axis]
    places = positions[:, along].astype(np.float64) / spacing
    margin = np.ceil(5.0 * WIDTH_IN_SPACINGS)
    low, high = walls.low[along] / spacing, walls.high[along] / spacing
    origin = np.where(np.isfinite(low), low, np.floor(places.min(axis=0)) - margin)
    end = np.where(np.isfinite(high), high, np.ceil(places.max(axis=0)) + margin)
    cells = np.maximum(np.round(end - origin).astype(int), 1)
    place_in_cells = places - origin - 0.5
    first = np.floor(place_in_cells).astype(int)
    share = place_in_cells - first
    weights = np.concatenate([np.ones((len(near), 1)), velocities.astype(np.float64)], axis=1)
    sums = np.zeros((4, cells[0] * cells[1]))
    for corner in np.ndindex(2, 2):
        part = np.prod(np.where(corner, share, 1.0 - share), axis=1)
        u, v = np.clip(first + corner, 0, cells - 1).T
        cell = u * cells[1] + v
        sums += [np.bincount(cell, part * weight, minlength=sums.shape[1]) for weight in weights.T]
    # Beyond an edge of the wall the film is as at the edge; lattices without one end where there is none.
    thickness, *momentum = (gaussian_filter(each.reshape(cells), WIDTH_IN_SPACINGS, mode="nearest") for each in sums)
    velocity = np.stack(momentum, axis=-1) / np.maximum(thickness, np.finfo(np.float32).tiny)[..., None]
    u, v = np.clip(np.round(place_in_cells).astype(int), 0, cells - 1).T
    has_particles = np.zeros(cells, bool)
    has_particles[u, v] = True
    return _Film(near, (u, v), np.where(_closed(has_particles), thickness, 0.0), velocity, origin)


def _closed(cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells of a lattice, (nu, nv), with the gaps between them, which the Gaussian closes; but nothing beyond them.

    What is left of a liquid's uppermost layer at a wall would otherwise be a film that climbs it.
    """
    from scipy.ndimage import binary_closing

    reach = int(np.ceil(1.5 * WIDTH_IN_SPACINGS))
    across = np.arange(-reach, reach + 1)
    disc = np.add.outer(across**2, across**2) <= reach**2
    around = np.pad(cells, 2 * reach, mode="edge")  # beyond an edge of the wall it goes on
    closed: NDArray[np.bool_] = binary_closing(around, disc)[2 * reach : -2 * reach, 2 * reach : -2 * reach]
    return closed


def mirrored(
    positions: NDArray[np.float32], velocities: NDArray[np.float32], walls: Walls, *, reach: float
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.intp]]:
    """Samples (n, 3) and their images behind walls, edges and corners that they are within reach of [m].

    Returns positions [m], velocities [m/s], and which sample each is or is an image of; samples come first.
    """
    source = np.arange(len(positions))
    for axis, place, _ in walls.planes():
        near = np.abs(positions[:, axis] - place) < reach
        image, motion = positions[near].copy(), velocities[near].copy()
        image[:, axis] = 2.0 * place - image[:, axis]
        motion[:, axis] *= -1.0
        positions, velocities = np.concatenate([positions, image]), np.concatenate([velocities, motion])
        source = np.concatenate([source, source[near]])
    return positions, velocities, source


def planes_of_surface(walls: Walls, *, particle_radius: float) -> Walls:
    """Where a surface ends at walls, just before them."""
    return walls.inset(_INSET_IN_RADII * particle_radius)


def folded_onto(mesh: SurfaceMesh, planes: Walls) -> tuple[SurfaceMesh, NDArray[np.intp]]:
    """The surface with what is behind planes folded onto them, and their normals there; which vertices are left.

    Parts that are behind as a whole, images of what does not touch the wall, are left out.
    """
    behind = ((mesh.vertices < planes.low) | (mesh.vertices > planes.high)).any(axis=1)
    if not behind.any():
        return mesh, np.arange(len(behind))
    mesh, kept = _without_parts(mesh, behind)
    assert mesh.normals is not None
    vertices = np.clip(mesh.vertices, planes.low, planes.high).astype(np.float32)
    outwards = np.sign(mesh.vertices - vertices)
    is_folded = outwards.any(axis=1)
    normals = mesh.normals.copy()
    normals[is_folded] = outwards[is_folded] / np.linalg.norm(outwards[is_folded], axis=1, keepdims=True)
    return replace(mesh, vertices=vertices, normals=normals), kept


def _without_parts(mesh: SurfaceMesh, marked: NDArray[np.bool_]) -> tuple[SurfaceMesh, NDArray[np.intp]]:
    """The surface without the connected parts whose vertices are all marked, (n,); which vertices are left."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    assert mesh.normals is not None and mesh.velocities is not None
    count = len(mesh.vertices)
    ends = mesh.faces[:, :2].reshape(-1), mesh.faces[:, 1:].reshape(-1)  # two edges of each triangle join it
    graph = coo_matrix((np.ones(len(ends[0]), np.int8), ends), shape=(count, count))
    parts, part = connected_components(graph, directed=False)
    stays = np.bincount(part, ~marked, minlength=parts)[part] > 0
    number = np.cumsum(stays, dtype=np.int32) - 1
    left = SurfaceMesh(
        vertices=mesh.vertices[stays],
        faces=number[mesh.faces[stays[mesh.faces[:, 0]]]].astype(np.int32),
        normals=mesh.normals[stays],
        velocities=mesh.velocities[stays],
    )
    return left, np.flatnonzero(stays)
