"""Particles that fill a volume, as many as it holds, to a particle.

A cubic lattice fits into few volumes: of a box of 7.5 spacings it leaves a fifth empty. So the number of particles
comes from the volume. They are on the places of a lattice whose cells have most of their volume inside: a cubic one, or
in a shape with flat sides one whose cells have the volume of a particle but constants that differ by some percent, such
that whole layers fit between the sides, and the topmost is partly empty. Particles that are nearer to a wall than fluid
at rest are pushed off it, and those around them apart.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sim.core.domain import DomainParameters
from sim.shapes.placement import PlacedSolid
from sim.shapes.primitives import Box, Capsule, Cone, Cylinder
from sim.shapes.sampling import fill_with_particles
from sim.shapes.solid import HasSignedDistance, ShapeError, outward_normals

Points = NDArray[np.float64]

ROUND_OFF = 1.0e-6  # slack, in spacings, that forgives decimal sizes such as 0.3 / 0.02 their binary round-off
CLEARANCE = 0.5  # of a particle from walls [spacings]
STRETCH_WEIGHT = 0.5  # of the largest stretch of a lattice against the share of the volume that it misplaces
CROWDING_WEIGHT = 3.0  # of the share of particles that have to be pushed off walls
TIGHT = 0.02  # share of empty places from which on all particles settle: there is too much where none is empty
MARGIN = 1.0e-3  # of the clearance: the first layer on a wall is exactly that far
NEAREST = 0.9  # particles of two volumes that are nearer to each other have to move, too [spacings]
MOVED_WITHIN = 4.0  # how far from those that have to move others may [spacings]
REACH, STEP, ROUNDS = 1.4, 0.05, 60  # of the push between them: how far [spacings], what part of the overlap, how often
COUNTED_CELLS = 200_000  # of a lattice on which the shares of a volume are measured
MOST_PLACES = 2**31
TRIED_PLACES = 200_000  # up to so many places several lattices are tried
SPREAD = np.array([0.7548776662466927, 0.5698402909980532, 0.8191725133961644])  # irrational steps: even in any subset
LAYERED = (Box, Cylinder, Cone, Capsule)  # shapes with flat sides or ends across their own axes


@dataclass(frozen=True)
class Surroundings:
    """What bounds a volume besides its own surface."""

    lower: Points  # corners of the domain [m], (3,)
    upper: Points
    walls: Sequence[HasSignedDistance] = ()  # bodies, from which particles keep half a spacing
    others: Sequence[HasSignedDistance] = ()  # volumes that are filled already, and which keep what they share
    open_lower: NDArray[np.bool_] = field(
        default_factory=lambda: np.zeros(3, dtype=bool)
    )  # domain faces without a wall
    open_upper: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(3, dtype=bool))

    @classmethod
    def in_domain(
        cls, domain: DomainParameters, walls: Sequence[HasSignedDistance], filled: Sequence[HasSignedDistance]
    ) -> Surroundings:
        """What bounds a volume: the domain, solid bodies, and the volumes that were filled before it."""
        open_faces = [np.array([f"{axis}{side}" in domain.open_faces for axis in "xyz"]) for side in "-+"]
        return cls(np.array(domain.min), np.array(domain.max), walls, filled, *open_faces)

    def near(self, solid: PlacedSolid) -> Surroundings:
        """Those of them that reach a solid."""

        def reaches(other: HasSignedDistance) -> bool:
            return bool(np.all(other.bounds[0] <= solid.bounds[1]) and np.all(solid.bounds[0] <= other.bounds[1]))

        walls, others = ([each for each in group if reaches(each)] for group in (self.walls, self.others))
        return replace(self, walls=walls, others=others)

    def of_walls(self, clearance: float) -> Surroundings:
        """The walls alone, without the others; particles that keep the clearance [m] may go to an open face."""
        lower, upper = self.lower - clearance * self.open_lower, self.upper + clearance * self.open_upper
        return Surroundings(lower, upper, self.walls)

    def room(self, points: Points) -> Points:
        """How far points (n, 3) are from all that bounds the volume [m], (n,); negative beyond."""
        nearest = np.minimum(points - self.lower, self.upper - points).min(axis=1)
        for each in (*self.walls, *self.others):
            nearest = np.minimum(nearest, each.signed_distance(points))
        return nearest


@dataclass(frozen=True)
class Amount:
    """How many particles a volume holds."""

    particles: int
    of_solid: float  # particles in the volume if nothing took a part of it, the domain aside [-]
    volume: float  # that is filled [m³]


def amount(solid: PlacedSolid, spacing: float, around: Surroundings) -> Amount:
    """The particles of a spacing [m] that a solid holds, within the domain, outside of walls and other volumes."""
    near = around.near(solid)
    inside = _clipped_volume(solid, near)
    volume = inside * _share(solid, spacing, near) if near.walls or near.others else inside
    return Amount(round(volume / spacing**3), inside / spacing**3, volume)


def pack(solid: PlacedSolid, spacing: float, around: Surroundings, taken: NDArray[np.floating]) -> NDArray[np.float32]:
    """Positions [m], (n, 3), of the particles of a spacing [m] that fill a solid; those taken, (k, 3), stay there.

    Raises:
        ShapeError: the lattice would have more than 2³¹ places.
    """
    near = around.near(solid)
    count = amount(solid, spacing, around).particles
    if count == 0:
        return np.empty((0, 3), dtype=np.float32)
    if not (near.walls or near.others) and _is_whole(solid, spacing, near):
        return fill_with_particles(solid, spacing, lower=around.lower, upper=around.upper)
    best, least, tightness = None, math.inf, 0.0
    walls = near.of_walls(CLEARANCE * spacing)
    for places, shares, stretch, excess in _lattices(solid, spacing, near):
        if len(places) < count:
            continue
        room = walls.room(places)
        chosen = _fullest(places, shares, count, spacing)
        misplaced = float((1.0 - shares[chosen]).sum() + shares.sum() - shares[chosen].sum()) / (2.0 * count)
        crowding = float((room[chosen] < (1.0 - MARGIN) * CLEARANCE * spacing).mean())
        score = misplaced + STRETCH_WEIGHT * stretch + excess + CROWDING_WEIGHT * crowding
        if score < least:
            best, least, tightness = places[chosen], score, excess
    assert best is not None
    return _settled(best, spacing, near, taken, is_tight=tightness > TIGHT).astype(np.float32)


def _is_upright(solid: PlacedSolid) -> bool:
    """Whether a solid is a box along the world's axes."""
    return isinstance(solid.shape, Box) and bool(np.allclose(np.abs(solid.rotation).max(axis=0), 1.0))


def _is_whole(solid: PlacedSolid, spacing: float, around: Surroundings) -> bool:
    """Whether a solid is a box of a whole number of spacings along each of the world's axes."""
    layers = (np.minimum(solid.bounds[1], around.upper) - np.maximum(solid.bounds[0], around.lower)) / spacing
    return _is_upright(solid) and bool(np.abs(layers - layers.round()).max() < ROUND_OFF)


def _clipped_volume(solid: PlacedSolid, around: Surroundings) -> float:
    """Volume of a solid within the domain [m³]."""
    low, high = np.maximum(solid.bounds[0], around.lower), np.minimum(solid.bounds[1], around.upper)
    if np.any(high <= low):
        return 0.0
    if np.array_equal(low, solid.bounds[0]) and np.array_equal(high, solid.bounds[1]):
        return solid.volume
    if _is_upright(solid):
        return float(np.prod(high - low))
    return solid.volume * _share(solid, 0.0, Surroundings(around.lower, around.upper), clipped=True)


def _share(solid: PlacedSolid, spacing: float, around: Surroundings, *, clipped: bool = False) -> float:
    """Share of a solid's volume in the domain that is free of what is around it; or of all of it, if so clipped."""
    low, high = solid.bounds
    if not clipped:
        low, high = np.maximum(low, around.lower), np.minimum(high, around.upper)
    step = max(0.5 * spacing, (float(np.prod(high - low)) / COUNTED_CELLS) ** (1.0 / 3.0))
    counts = np.maximum(np.ceil((high - low) / step), 1.0)
    axes = [start + (np.arange(n) + 0.5) * ((end - start) / n) for start, end, n in zip(low, high, counts, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    depth = -solid.signed_distance(points)
    whole = np.clip(0.5 + depth / step, 0.0, 1.0)
    free = np.clip(0.5 + np.minimum(depth, around.room(points)) / step, 0.0, 1.0)
    if not clipped:
        inside = np.minimum(points - around.lower, around.upper - points).min(axis=1)
        whole = np.minimum(whole, np.clip(0.5 + inside / step, 0.0, 1.0))
    return float(free.sum() / whole.sum()) if whole.any() else 0.0


def _lattices(
    solid: PlacedSolid, spacing: float, around: Surroundings
) -> Iterator[tuple[Points, NDArray[np.float64], float, float]]:
    """Lattices around a solid: places [m], (m, 3), and shares of their cells inside, (m,).

    With their largest stretch along an axis, and how many more places they have than particles [-].
    """
    axes = solid.rotation if isinstance(solid.shape, LAYERED) else np.eye(3)
    upper = solid.scale * solid.shape.support((solid.rotation.T @ axes).T)
    lower = -solid.scale * solid.shape.support(-(solid.rotation.T @ axes).T)
    is_upright = bool(np.allclose(np.abs(axes).max(axis=0), 1.0))
    corners = np.stack([lower, upper])
    if is_upright:
        # Along world axes, in some order and direction: the domain cuts it.
        ends = (np.stack([around.lower, around.upper]) - solid.position) @ axes
        corners = np.stack([np.maximum(lower, ends.min(axis=0)), np.minimum(upper, ends.max(axis=0))])
    extent = corners[1] - corners[0]
    if np.prod(extent / spacing + 1.0) > MOST_PLACES:
        edges = " x ".join(f"{edge:g}" for edge in extent)
        raise ShapeError(
            f"filling {edges} m at a spacing of {spacing:g} m takes {np.prod(extent / spacing):.2g} lattice points; "
            "use a larger spacing or a smaller volume"
        )
    for lines in _choices(solid, extent, spacing, axes):
        steps = np.array([line.step for line in lines])
        grid = np.stack(np.meshgrid(*(line.places for line in lines), indexing="ij"), axis=-1).reshape(-1, 3)
        places = solid.position + (corners[0] + grid) @ axes.T
        shares = _shares(solid, places, lines, steps, around)
        kept = shares > 0.0
        strains = np.log(steps / spacing)
        yield places[kept], shares[kept], float(np.abs(strains).max()), max(0.0, -float(strains.sum()))


@dataclass(frozen=True)
class _Line:
    """Places along one axis."""

    step: float  # distance of them [m]
    places: NDArray[np.float64]  # from the lower end [m], (n,)
    share: NDArray[np.float64]  # of the cell of each between the two ends [-], (n,)

    def reversed(self, length: float) -> _Line:
        """The same from the other end."""
        return _Line(self.step, (length - self.places)[::-1], self.share[::-1])


def _fitted(length: float, count: int, spacing: float) -> _Line:
    """So many places from end to end, the outer ones half a spacing off the ends at least."""
    step = length / count
    places = (np.arange(count) + 0.5) * step
    if count > 1 and 0.5 * spacing > places[0]:
        places = np.linspace(0.5 * spacing, length - 0.5 * spacing, count)
    return _Line(step, places, np.ones(count))


def _stacked(length: float, step: float, spacing: float) -> _Line:
    """Places at a distance from the lower end on, as far as cells are partly inside."""
    return _partly_inside(length, step, max(0.5 * step, 0.5 * spacing) + step * np.arange(math.ceil(length / step) + 1))


def _centred(length: float, step: float) -> _Line:
    """Places at a distance to either side of the middle, as far as cells are partly inside."""
    count = math.floor(length / step + ROUND_OFF)
    return _partly_inside(length, step, 0.5 * length - 0.5 * (count - 1) * step + step * np.arange(-1, count + 1))


def _partly_inside(length: float, step: float, places: NDArray[np.float64]) -> _Line:
    share = (np.minimum(places + 0.5 * step, length) - np.maximum(places - 0.5 * step, 0.0)) / step
    kept = share > ROUND_OFF
    return _Line(step, places[kept], np.minimum(share[kept], 1.0))


def _choices(
    solid: PlacedSolid, extent: NDArray[np.float64], spacing: float, axes: NDArray[np.float64]
) -> Iterator[tuple[_Line, ...]]:
    """Lines of places along the three axes whose cells have the volume of a particle."""
    volume, up = spacing**3, int(np.argmax(np.abs(axes[2])))
    sides = [axis for axis in range(3) if axis != up]
    layers = extent / spacing
    fits = [sorted({max(1, math.floor(each + ROUND_OFF)), max(1, math.ceil(each - ROUND_OFF))}) for each in layers]
    if isinstance(solid.shape, Box):
        # Whole layers between all sides, some places empty; or between four of them, and the last layer partly so.
        for counts in product(*fits):
            yield tuple(_fitted(float(e), n, spacing) for e, n in zip(extent, counts, strict=True))
        for counts in product(*(fits[axis] for axis in sides)):
            lines = {axis: _fitted(float(extent[axis]), n, spacing) for axis, n in zip(sides, counts, strict=True)}
            lines[up] = _stacked(float(extent[up]), volume / math.prod(line.step for line in lines.values()), spacing)
            if axes[2, up] < 0.0:
                lines[up] = lines[up].reversed(float(extent[up]))
            yield tuple(lines[axis] for axis in range(3))
        return
    yield tuple(_centred(float(e), spacing) for e in extent)
    if isinstance(solid.shape, LAYERED) or math.prod(layers) < TRIED_PLACES:
        for count in fits[up]:
            # Layers across the upright axis, and squares in them.
            line = _fitted(float(extent[up]), count, spacing)
            lines = {axis: _centred(float(extent[axis]), math.sqrt(volume / line.step)) for axis in sides} | {up: line}
            yield tuple(lines[axis] for axis in range(3))


def _shares(
    solid: PlacedSolid, places: Points, lines: Sequence[_Line], steps: NDArray[np.float64], around: Surroundings
) -> NDArray[np.float64]:
    """Share of each place's cell that is inside [-], (m,)."""
    width = float(np.prod(steps)) ** (1.0 / 3.0)
    if isinstance(solid.shape, Box):
        x, y, z = np.meshgrid(*(line.share for line in lines), indexing="ij")
        own = (x * y * z).ravel()
    else:
        own = np.clip(0.5 - solid.signed_distance(places) / width, 0.0, 1.0)
    if (
        not (around.walls or around.others)
        and np.all(solid.bounds[0] >= around.lower)
        and np.all(solid.bounds[1] <= around.upper)
    ):
        return own
    return np.minimum(own, np.clip(0.5 + around.room(places) / width + ROUND_OFF, 0.0, 1.0))


def _fullest(places: Points, shares: NDArray[np.float64], count: int, spacing: float) -> NDArray[np.int64]:
    """The places with the largest shares, in their order; of equal ones every so many."""
    if len(places) == count:
        return np.arange(count)
    rank = np.round(shares / (10.0 * ROUND_OFF))
    evenly = np.mod(np.round((places - places.min(axis=0)) / spacing, 3) @ SPREAD, 1.0)
    return np.sort(np.lexsort((evenly, -rank))[:count])


def _settled(
    points: Points, spacing: float, around: Surroundings, taken: NDArray[np.floating], *, is_tight: bool
) -> Points:
    """The points moved off walls by half a spacing, and apart where they had to move there [m], (n, 3)."""
    clearance = CLEARANCE * spacing
    walls = around.of_walls(clearance)
    fixed = np.asarray(taken, dtype=np.float64).reshape(-1, 3)
    if len(fixed):
        low, high = points.min(axis=0) - spacing, points.max(axis=0) + spacing
        fixed = fixed[((fixed >= low) & (fixed <= high)).all(axis=1)]
    is_near = (walls.room(points) < (1.0 - MARGIN) * clearance) | is_tight
    if len(fixed):
        is_near |= cKDTree(fixed).query(points)[0] < NEAREST * spacing
    if not is_near.any():
        return points
    moving = cKDTree(points[is_near]).query(points)[0] < MOVED_WITHIN * spacing
    own = _off_walls(points[moving], walls, clearance)
    fixed = np.concatenate([points[~moving], fixed])
    for _ in range(ROUNDS):
        everything = np.concatenate([own, fixed])
        pairs = cKDTree(everything).query_pairs(REACH * spacing, output_type="ndarray")
        pairs = pairs[pairs[:, 0] < len(own)]
        apart = everything[pairs[:, 0]] - everything[pairs[:, 1]]
        distance = np.maximum(np.linalg.norm(apart, axis=1), 1.0e-6 * spacing)
        push = (STEP * (REACH * spacing - distance) / distance)[:, None] * apart
        moved = np.zeros_like(everything)
        for column, sign in ((0, 1.0), (1, -1.0)):
            for axis in range(3):
                moved[:, axis] += sign * np.bincount(pairs[:, column], weights=push[:, axis], minlength=len(everything))
        own = _off_walls(own + moved[: len(own)], walls, clearance)
    settled = points.copy()
    settled[moving] = own
    return settled


def _off_walls(points: Points, walls: Surroundings, clearance: float) -> Points:
    """The points moved out of walls and off them, as far as that goes."""
    for solid in walls.walls:
        near = np.flatnonzero(
            ((points >= solid.bounds[0] - clearance) & (points <= solid.bounds[1] + clearance)).all(axis=1)
        )
        lacking = clearance - solid.signed_distance(points[near])
        near, lacking = near[lacking > 0.0], lacking[lacking > 0.0]
        if len(near):
            normal = outward_normals(solid.signed_distance, points[near], 0.1 * clearance)
            points[near] += lacking[:, None] * normal
    low, high = walls.lower + clearance, walls.upper - clearance
    middle = 0.5 * (walls.lower + walls.upper)
    return np.clip(points, np.minimum(low, middle), np.maximum(high, middle))
