"""Walls and bodies as samples of their surface (Akinci et al. 2012).

A sample b stands for the volume V_b = gamma / sum_k W_bk, the sum over the samples of the same body, itself included
(eq. 4), so that uneven sampling evens out. The factor gamma = 6 and the distance D = 1.45 d at which fluid rests from
the samples belong together: with both, one layer of samples has the density and the push of a half-space of fluid
(`sim.fluid.kernels.wall_calibration`). In the fluid's density a sample counts as Psi_b = rho0 V_b (eq. 5).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sim.fluid.kernels import SUPPORT_IN_SPACINGS, evaluate, wall_calibration

if TYPE_CHECKING:
    from sim.scene import DomainParameters

SignedDistance = Callable[[NDArray[np.float64]], NDArray[np.float64]]

SINKING_ROUNDS, SINKING_FRACTION = 6, 0.6
"""Rounds in which samples sink into a body, each by this part of the way that is left: 0.4 % of it is left then."""

FACES = ("x-", "x+", "y-", "y+", "z-", "z+")


@dataclass(frozen=True)
class BoundarySamples:
    """Surface samples of the domain's walls and of all bodies.

    Fluid at rest keeps D = 1.45 spacings from a sample. So samples 0.95 spacings inside the solid let the fluid fill
    the space right up to the surface; from samples on the surface it keeps that much of a gap.

    Attributes:
        positions: samples [m], (m, 3), float32.
        body: number of the body of each sample, (m,), int32; the domain's walls are one body.
        factor: on the volume of each sample [-], (m,); 1 if omitted.
    """

    positions: NDArray[np.float32]
    body: NDArray[np.int32]
    factor: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        if self.positions.ndim != 2 or self.positions.shape[1] != 3 or self.body.shape != self.positions.shape[:1]:
            raise ValueError(
                f"boundary samples must be (m, 3) with bodies (m,), got {self.positions.shape} and {self.body.shape}"
            )
        if not np.isfinite(self.positions).all():
            raise ValueError("boundary samples must be finite numbers")

    @classmethod
    def of_bodies(cls, *bodies: NDArray[np.floating]) -> BoundarySamples:
        """Samples of several bodies, each (m_k, 3) [m], numbered in this order."""
        numbers = [np.full(len(samples), number, dtype=np.int32) for number, samples in enumerate(bodies)]
        if not bodies:
            return cls(np.empty((0, 3), dtype=np.float32), np.empty(0, dtype=np.int32))
        return cls(np.concatenate(bodies).astype(np.float32).reshape(-1, 3), np.concatenate(numbers))

    def volumes(self, spacing: float, support_in_spacings: float = SUPPORT_IN_SPACINGS) -> NDArray[np.float64]:
        """Volume V_b of each sample [m³], (m,); a fluid's Psi_b is rho0 V_b.

        Args:
            spacing: particle spacing of the fluid [m].
            support_in_spacings: support radius of its kernel.
        """
        support = support_in_spacings * spacing
        volumes = np.empty(len(self.positions), dtype=np.float64)
        for body in np.unique(self.body):
            members = np.flatnonzero(self.body == body)
            tree = cKDTree(self.positions[members])
            pairs = tree.query_pairs(support, output_type="ndarray")
            points = self.positions[members].astype(np.float64)
            weights = evaluate(np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1), support)
            sums = np.full(len(members), evaluate(0.0, support))
            for end in (0, 1):
                sums += np.bincount(pairs[:, end], weights=weights, minlength=len(members))
            volumes[members] = wall_calibration(support_in_spacings).volume_factor / sums
        return volumes if self.factor is None else self.factor * volumes


def domain_wall_samples(
    domain: DomainParameters, spacing: float, support_in_spacings: float = SUPPORT_IN_SPACINGS
) -> NDArray[np.float32]:
    """Samples of the domain's closed faces [m], (m, 3): a lattice 0.95 spacings outside of each face.

    Neighbouring walls share their edges and corners, and every sample lies there once. A wall reaches one layer
    beyond an open face, so that fluid that runs along it is held until it has left.

    Args:
        domain: the box and its open faces.
        spacing: particle spacing of the fluid [m].
        support_in_spacings: support radius of its kernel; the samples lie deeper where it is wider than usual.
    """
    depth = (wall_calibration(support_in_spacings).standoff_in_spacings - 0.5) * spacing
    low, high = np.array(domain.min) - depth, np.array(domain.max) + depth
    # Whole numbers of intervals, so the lattice meets both ends; the sample volumes even out the small stretch.
    intervals = np.maximum(np.round((high - low) / spacing), 1).astype(int)
    axes = [np.linspace(low[axis], high[axis], intervals[axis] + 1) for axis in range(3)]
    faces = [_face_indices(face, intervals) for face in FACES if face not in domain.open_faces]
    indices = np.unique(np.concatenate([np.empty((0, 3), dtype=int), *faces]), axis=0)
    samples = np.stack([axes[axis][indices[:, axis]] for axis in range(3)], axis=1)
    return samples.astype(np.float32)


def sink_samples(
    samples: NDArray[np.floating],
    signed_distance: SignedDistance,
    spacing: float,
    support_in_spacings: float = SUPPORT_IN_SPACINGS,
) -> NDArray[np.float32]:
    """Move samples of a body's surface 0.95 spacings inside, so that fluid at rest touches the surface, (m, 3) [m].

    Where a body is thinner than twice that, its samples stop at the middle, and fluid keeps a gap.

    Args:
        samples: points on the surface [m], (m, 3).
        signed_distance: distance of points (k, 3) to the surface [m], (k,); negative inside.
        spacing: particle spacing of the fluid [m].
        support_in_spacings: support radius of its kernel; the samples sink deeper where it is wider than usual.
    """
    depth = (wall_calibration(support_in_spacings).standoff_in_spacings - 0.5) * spacing
    points = np.array(samples, dtype=np.float64)
    distance = signed_distance(points)
    step = 0.05 * spacing
    for _ in range(SINKING_ROUNDS):
        shifts = [np.eye(3)[axis] * step for axis in range(3)]
        gradient = np.stack(
            [signed_distance(points + shift) - signed_distance(points - shift) for shift in shifts], axis=1
        )
        normal = gradient / np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-12)
        moved = points - SINKING_FRACTION * (distance + depth)[:, None] * normal
        moved_distance = signed_distance(moved)
        # Only moves that come nearer to the wanted depth count: behind the middle of a thin part they would not.
        better = np.abs(moved_distance + depth) < np.abs(distance + depth)
        points[better], distance[better] = moved[better], moved_distance[better]
    return points.astype(np.float32)


def _face_indices(face: str, intervals: NDArray[np.integer]) -> NDArray[np.integer]:
    """Lattice indices of one face of a box of so many intervals, (m, 3)."""
    ranges = [np.arange(count + 1) for count in intervals]
    normal = "xyz".index(face[0])
    ranges[normal] = ranges[normal][:1] if face[1] == "-" else ranges[normal][-1:]
    return np.stack(np.meshgrid(*ranges, indexing="ij"), axis=-1).reshape(-1, 3)
