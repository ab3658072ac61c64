"""The lattice of particles in a layer that fills an opening: at the fluid's density, and as far apart as it can be."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import lru_cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from sim.shapes.openings import DiscOpening, OpeningShape, RectangleOpening
from sim.shapes.section import Section, section_of

NEAREST_IN_SPACINGS, FARTHEST_IN_SPACINGS = 0.82, 1.35  # of particles and of layers: nearer, they would burst out
LATTICE_CONSTANTS = 1.1, 0.9  # spacings of lattices that are cut to an opening [spacings], largest and smallest
LATTICES_TRIED = 41  # of them
SAME_DEPTH_IN_SPACINGS = 1.0e-3  # depths that differ by less are one


@lru_cache(maxsize=64)
def best_layer(
    shape: OpeningShape, area: float, spacing: float, particle_volume: float
) -> tuple[NDArray[np.float64], float] | None:
    """Places in the plane of an opening [m], (n, 2), and distance of layers [m], which keep particles farthest apart.

    None where all are too near or too far. Raises ShapeError where the shape cannot be built.

    Args:
        shape: of the opening.
        area: of it [m²].
        spacing: of the particles [m].
        particle_volume: of each [m³].
    """
    if isinstance(shape, RectangleOpening):
        layers = _rectangle_layers(shape.size, spacing)
    elif isinstance(shape, DiscOpening):
        layers = _cut_layers(_disc(shape.radius), area, spacing)
    else:
        layers = _cut_layers(section_of(shape), area, spacing)
    best, farthest = None, 0.0
    for places, nearest in layers:
        distance = len(places) * particle_volume / area
        is_possible = min(nearest, distance) >= NEAREST_IN_SPACINGS * spacing
        if is_possible and distance <= FARTHEST_IN_SPACINGS * spacing and min(nearest, distance) > farthest:
            best, farthest = (places, distance), min(nearest, distance)
            places.setflags(write=False)
    return best


def _rectangle_layers(sides: tuple[float, float], spacing: float) -> Iterator[tuple[NDArray[np.float64], float]]:
    """Lattices that fit a rectangle, stretched or squeezed, and their smaller spacing."""
    for counts in product(*((math.floor(side / spacing), math.ceil(side / spacing)) for side in sides)):
        if min(counts) < 1:
            continue
        x, y = (((np.arange(n) + 0.5) / n - 0.5) * side for n, side in zip(counts, sides, strict=True))
        gaps = [side / n for n, side in zip(counts, sides, strict=True) if n > 1]
        yield np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2), min(gaps, default=math.inf)


def _cut_layers(section: Section, area: float, spacing: float) -> Iterator[tuple[NDArray[np.float64], float]]:
    """Square lattices cut out of a section of an area [m²], around one of their points or between four, and spacings.

    Their cells have exactly that area in all: the jet would be denser or thinner than the fluid otherwise.
    """
    fewest, most = (math.ceil(area / (limit * spacing) ** 2) for limit in LATTICE_CONSTANTS)
    counts = np.unique(np.linspace(max(fewest, 1), max(most, 1), LATTICES_TRIED).round().astype(int))
    for count, *shift in product(counts, (0.0, 0.5), (0.0, 0.5)):
        constant = math.sqrt(area / count)
        reach = np.ceil(section.half_size / constant).astype(int) + 1
        x, y = ((np.arange(-end, end + 1) + own) * constant for end, own in zip(reach, shift, strict=True))
        points = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
        depth = section.depth(points)
        order = np.argsort(-depth, kind="stable")
        last, next_ = depth[order[count - 1]], depth[order[count]]
        # Those at one depth, such as four around the middle of a disc, belong together.
        if last >= 0.0 and last - next_ > SAME_DEPTH_IN_SPACINGS * spacing:
            yield points[np.sort(order[:count])], constant if count > 1 else math.inf


def _disc(radius: float) -> Section:
    return Section(
        np.full(2, radius), lambda points: radius - np.hypot(points[:, 0], points[:, 1]), math.pi * radius**2
    )
