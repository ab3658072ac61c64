"""Walls and bodies as samples of their surface (Akinci et al. 2012).

A sample b stands for the volume V_b = gamma / sum_k W_bk, the sum over the samples of the same body, itself included
(eq. 4), so that uneven sampling evens out. The factor gamma = 6 and the distance D = 1.45 d at which fluid rests from
the samples belong together: with both, one layer of samples has the density and the push of a half-space of fluid
(`sim.fluid.kernels.wall_calibration`). In the fluid's density a sample counts as Psi_b = rho0 V_b (eq. 5).

A support wider than usual takes two layers, each with its own factor and distance (`sim.fluid.kernels.wall_layers`).
Bodies too thin for the second one keep to one layer, whose push alone lets nothing pass. Walls of the domain are
products of lines, with volumes that are known (`domain_wall_samples`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq
from scipy.spatial import cKDTree

from sim.fluid.kernels import (
    SUPPORT_IN_SPACINGS,
    evaluate,
    lattice_offsets,
    layer_field,
    particle_volume,
    wall_calibration,
    wall_layers,
)
from sim.shapes.solid import SignedDistance, outward_normals

if TYPE_CHECKING:
    from sim.core.domain import DomainParameters

SINKING_ROUNDS, SINKING_FRACTION = 6, 0.6  # by which samples sink into a body: 0.4 % of the depth is left then
DEEP_ENOUGH = 0.95  # part of the second layer's depth at which its samples still do what they should


@dataclass(frozen=True)
class BoundarySamples:
    """Surface samples of the domain's walls and of all bodies.

    Fluid at rest keeps D = 1.45 spacings from a sample. So samples 0.95 spacings inside the solid let the fluid fill
    the space right up to the surface; from samples on the surface it keeps that much of a gap.
    """

    positions: NDArray[np.float32]  # samples [m], (m, 3), float32
    body: NDArray[np.int32]  # number of the body of each sample, (m,), int32; the domain's walls are one body
    factor: NDArray[np.float64]  # on the volume of each sample [-], (m,)
    layer: NDArray[np.int32]  # samples of one body and layer count each other in their volumes, (m,)
    known_volume: NDArray[np.float64]  # volume where it is known [m³], else 0, (m,)

    def __post_init__(self) -> None:
        if not np.isfinite(self.positions).all():
            raise ValueError("boundary samples must be finite numbers")
        if not np.isfinite(self.factor).all():
            raise ValueError("factors of boundary samples must be finite numbers")

    @classmethod
    def of_points(
        cls, points: NDArray[np.floating], *, factor: ArrayLike = 1.0, layer: ArrayLike = 0, known: ArrayLike = 0.0
    ) -> BoundarySamples:
        """Samples of one body [m], (m, 3), with factors, layers and known volumes of all, or of each, (m,)."""
        positions = np.asarray(points, dtype=np.float32)
        if positions.ndim != 2 or positions.shape[1] != 3:
            raise ValueError(f"boundary samples must be (m, 3), got {positions.shape}")
        factors, layers, volumes = (np.full(len(positions), value) for value in (factor, layer, known))
        return cls(positions, np.zeros(len(positions), np.int32), factors, layers.astype(np.int32), volumes)

    @classmethod
    def of_bodies(cls, *bodies: NDArray[np.floating] | BoundarySamples) -> BoundarySamples:
        """Samples of several bodies, each (m_k, 3) [m] or samples of one body already, numbered in this order."""
        own = [body if isinstance(body, BoundarySamples) else cls.of_points(body) for body in bodies]
        own = [replace(each, body=np.full_like(each.body, number)) for number, each in enumerate(own)]
        arrays = [
            [getattr(each, field.name) for field in fields(cls)] for each in own or [cls.of_points(np.empty((0, 3)))]
        ]
        return cls(*(np.concatenate(parts) for parts in zip(*arrays, strict=True)))

    def with_bodies(self, bodies: Sequence[BoundarySamples], first: int) -> BoundarySamples:
        """These samples and then those of further bodies, numbered from the first."""
        own = [self, *(replace(each, body=each.body + number) for number, each in enumerate(bodies, start=first))]
        arrays = ([getattr(each, field.name) for each in own] for field in fields(self))
        return BoundarySamples(*map(np.concatenate, arrays))

    def scaled(self, factor: float | NDArray[np.float64]) -> BoundarySamples:
        """The same samples with so many times their volumes [-], all of them or each, (m,)."""
        return replace(self, factor=factor * self.factor)

    def volumes(self, spacing: float, support_in_spacings: float = SUPPORT_IN_SPACINGS) -> NDArray[np.float64]:
        """Volume V_b of each sample [m³], (m,); a fluid's Psi_b is rho0 V_b."""
        support = support_in_spacings * spacing
        volumes = self.known_volume.copy()
        layers = np.stack([self.body, self.layer], axis=1)
        unknown = volumes == 0.0
        for own in np.unique(layers[unknown], axis=0):
            members = np.flatnonzero((layers == own).all(axis=1) & unknown)
            tree = cKDTree(self.positions[members])
            pairs = tree.query_pairs(support, output_type="ndarray")
            points = self.positions[members].astype(np.float64)
            weights = evaluate(np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1), support)
            sums = np.full(len(members), evaluate(0.0, support))
            for end in (0, 1):
                sums += np.bincount(pairs[:, end], weights=weights, minlength=len(members))
            volumes[members] = wall_calibration(support_in_spacings).volume_factor / sums
        return self.factor * volumes


def domain_wall_samples(
    domain: DomainParameters, spacing: float, support_in_spacings: float = SUPPORT_IN_SPACINGS
) -> BoundarySamples:
    """Samples of the domain's closed faces, 0.95 spacings outside of each, or in two layers at a wide support.

    They are the products of lines along the axes, and weigh the products of what their coordinates do. At the usual
    support each wall ends at its own edges, and its samples lie between the particles of a lattice that fills the
    domain, as opposite to them they would hold it. Its last row lies a little beyond the edge (`last_row`), with which
    edges and corners are no denser than their faces make them. A wall goes on for a row beyond an open face.

    At a wide support, whose sums reach far around edges, a line has points like a lattice of fluid within the domain,
    and at either end one for each layer of the wall, which weighs as much as a sample of the layer. As the kernel is
    nearly such a product too, fluid has the density in corners that it has inside, to 1.5 %.
    """
    is_usual = support_in_spacings == SUPPORT_IN_SPACINGS
    insides = [
        _rows(domain, axis, spacing) if is_usual else _points(domain, axis, spacing, support_in_spacings)
        for axis in range(3)
    ]
    walls = [_layers(domain, axis, spacing, support_in_spacings) for axis in range(3)]
    positions, weights = [np.empty((0, 3))], [np.empty(0)]
    # Walls across x with all of y and z; then those across y, and across z, that are not among them.
    for across in range(3):
        chosen = [insides[a] if is_usual or a < across else np.concatenate([insides[a], walls[a]]) for a in range(3)]
        chosen[across] = walls[across]
        positions.append(np.stack(np.meshgrid(*(c[:, 0] for c in chosen), indexing="ij"), axis=-1).reshape(-1, 3))
        weights.append(np.einsum("i,j,k->ijk", *(c[:, 1] for c in chosen)).ravel())
    samples, weight = np.concatenate(positions), np.concatenate(weights)
    outside = np.maximum(np.maximum(domain.min - samples, samples - domain.max), 0.0)
    near = np.linalg.norm(outside, axis=1) < support_in_spacings * spacing
    known = weight[near] * particle_volume(spacing, support_in_spacings)
    return BoundarySamples.of_points(samples[near], known=known)


def sink_samples(
    samples: NDArray[np.floating],
    signed_distance: SignedDistance,
    spacing: float,
    support_in_spacings: float = SUPPORT_IN_SPACINGS,
) -> BoundarySamples:
    """Samples (m, 3) of a body's surface [m], moved 0.95 spacings inside, so that fluid at rest touches the surface.

    Where a body is thinner than twice that, its samples stop at the middle, and fluid keeps a gap.

    With a support wider than usual there are two layers of them. What cannot lie quite as deep as the second one should
    has as much less volume as leaves its field at the fluid that touches the surface the same. Where the body is too
    thin for the second layer, one layer stands for both: the first of two, alone, would keep nothing out.
    """
    return sunk_layers(samples, signed_distance, spacing, support_in_spacings)[0]


def sunk_layers(
    samples: NDArray[np.floating],
    signed_distance: SignedDistance,
    spacing: float,
    support_in_spacings: float = SUPPORT_IN_SPACINGS,
) -> tuple[BoundarySamples, NDArray[np.int64]]:
    """As `sink_samples`, and which sample of the surface each is made of, (k,)."""
    alone = wall_calibration(support_in_spacings)
    positions, _ = _sunk(samples, signed_distance, spacing, (alone.standoff_in_spacings - 0.5) * spacing)
    factor, layer = np.ones(len(positions)), np.zeros(len(positions), dtype=np.int32)
    source = np.arange(len(positions))
    if support_in_spacings != SUPPORT_IN_SPACINGS:
        near, far = wall_layers(support_in_spacings)
        far_depth = (far.standoff_in_spacings - 0.5) * spacing
        far_positions, reached = _sunk(samples, signed_distance, spacing, far_depth)
        is_deep = reached >= DEEP_ENOUGH * far_depth
        near_positions, _ = _sunk(samples, signed_distance, spacing, (near.standoff_in_spacings - 0.5) * spacing)
        positions = np.concatenate([np.where(is_deep[:, None], near_positions, positions), far_positions[is_deep]])
        weakened = _weakened(reached[is_deep] / spacing + 0.5, far.standoff_in_spacings, support_in_spacings)
        near_factor = np.where(is_deep, near.volume_factor / alone.volume_factor, 1.0)
        factor = np.concatenate([near_factor, far.volume_factor / alone.volume_factor * weakened])
        layer = np.repeat(np.arange(2, dtype=np.int32), [len(samples), np.count_nonzero(is_deep)])
        source = np.append(source, np.flatnonzero(is_deep))
    return BoundarySamples.of_points(positions, factor=factor, layer=layer), source


def _sunk(
    samples: NDArray[np.floating], signed_distance: SignedDistance, spacing: float, depth: float
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Samples of a surface moved to a depth under it [m], (m, 3), and how deep they are then [m], (m,)."""
    points = np.array(samples, dtype=np.float64)
    distance = signed_distance(points)
    for _ in range(SINKING_ROUNDS):
        normal = outward_normals(signed_distance, points, 0.05 * spacing)
        moved = points - SINKING_FRACTION * (distance + depth)[:, None] * normal
        moved_distance = signed_distance(moved)
        # Only moves that come nearer to the wanted depth count: behind the middle of a thin part they would not.
        better = np.abs(moved_distance + depth) < np.abs(distance + depth)
        points[better], distance[better] = moved[better], moved_distance[better]
    return points.astype(np.float32), -distance


def _weakened(standoff: NDArray[np.float64], wanted_standoff: float, support_in_spacings: float) -> NDArray[np.float64]:
    """Factor on volumes at a smaller distance from the fluid than wanted [spacings] that keeps their field the same."""
    distances = np.linspace(0.0, wanted_standoff, 65)
    fields = np.array([layer_field(distance, support_in_spacings)[0] for distance in distances])
    return fields[-1] / np.interp(standoff, distances, fields)


def _rows(domain: DomainParameters, axis: int, spacing: float) -> NDArray[np.float64]:
    """Coordinates of a wall's rows along an axis [m] with their weights in particles [-], (n, 2)."""
    low, high = domain.min[axis], domain.max[axis]
    count = max(round((high - low) / spacing), 1)
    apart = (high - low) / count
    at_low, at_high = _open_ends(domain, axis)
    rows = low + apart * np.arange(-int(at_low), count + int(at_high) + 1)
    rows[0] -= 0.0 if at_low else last_row() * spacing
    rows[-1] += 0.0 if at_high else last_row() * spacing
    return np.stack([rows, np.full(len(rows), apart / spacing)], axis=1)


def _points(domain: DomainParameters, axis: int, spacing: float, support_in_spacings: float) -> NDArray[np.float64]:
    """Coordinates of a lattice of fluid along an axis [m] with their weights in particles [-], (n, 2).

    Beyond an open face they go on for half of the support.
    """
    low, high = domain.min[axis], domain.max[axis]
    count = max(round((high - low) / spacing), 1)
    apart = (high - low) / count
    beyond = [math.ceil(0.5 * support_in_spacings) * is_open for is_open in _open_ends(domain, axis)]
    points = low + apart * (np.arange(-beyond[0], count + beyond[1]) + 0.5)
    return np.stack([points, np.full(len(points), apart / spacing)], axis=1)


def _layers(domain: DomainParameters, axis: int, spacing: float, support_in_spacings: float) -> NDArray[np.float64]:
    """Coordinates of the layers of the walls across an axis [m] with their weights in particles [-], (n, 2)."""
    ends = zip((domain.min[axis], domain.max[axis]), (-1.0, 1.0), _open_ends(domain, axis), strict=True)
    layers = [
        (end + sign * (layer.standoff_in_spacings - 0.5) * spacing, layer.volume_in_particles)
        for end, sign, is_open in ends
        if not is_open
        for layer in wall_layers(support_in_spacings)
    ]
    return np.array(layers).reshape(-1, 2)


def _open_ends(domain: DomainParameters, axis: int) -> tuple[bool, bool]:
    """Whether the domain is open at the lower and at the upper end of an axis."""
    low, high = (f"{'xyz'[axis]}{side}" in domain.open_faces for side in "-+")
    return low, high


@cache
def last_row() -> float:
    """How far beyond an edge the last row of a wall lies [spacings].

    Two walls that meet both stand for the fluid beyond both of them. With this row each leaves half of that out, in the
    first layer of a lattice. Its push along the wall stays the same, to 0.04 %, as the slope of its field has its
    largest value there: floors bear what stands on them, and side walls nothing.
    """
    wall = wall_calibration()
    offsets = lattice_offsets()
    beyond_both = np.linalg.norm(offsets[(offsets[:, :2] < 0.0).all(axis=1)], axis=1)
    twice = 0.5 * float(evaluate(beyond_both, SUPPORT_IN_SPACINGS).sum()) / wall.volume_in_particles
    along = np.hypot(np.arange(-2, 2) + 0.5, wall.standoff_in_spacings)

    def row(away: float) -> float:
        return float(evaluate(np.hypot(along, away), SUPPORT_IN_SPACINGS).sum())

    return float(brentq(lambda beyond: row(0.5) - row(0.5 + beyond) - twice, 0.0, 0.5))
