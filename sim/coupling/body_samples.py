"""Samples of the moving bodies' surfaces, as a particle fluid's boundary takes them."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sim.fluid.boundary_akinci2012 import BoundarySamples, sink_samples
from sim.fluid.kernels import SUPPORT_IN_SPACINGS, evaluate

if TYPE_CHECKING:
    from sim.rigid.solver import RigidSolver

SignedDistance = Callable[[NDArray[np.float64]], NDArray[np.float64]]

MOST_PROBES = 400
"""Points at which a body's field is compared with the fluid that it displaces: their mean is within 1 %."""

CELLS_PER_SPACING = 4
"""Fineness of the sum over the inside of a body."""

OUTWARD_ROUNDS = 4
"""Steps by which points of the surface are moved out to where particles touch it."""


def samples_of_moving_bodies(
    rigid: RigidSolver, spacing: float, support_in_spacings: float = SUPPORT_IN_SPACINGS
) -> BoundarySamples:
    """Samples of every moving body, relative to its centre of mass and in its axes.

    Args:
        rigid: the bodies, at rest or not: samples belong to the shape.
        spacing: particle spacing of the fluid [m].
        support_in_spacings: support radius of its kernel.
    """
    samples, factors = [], []
    for index in range(len(rigid.bodies)):
        surface, signed_distance = rigid.body_samples(index, spacing), rigid.signed_distance_in_body_frame(index)
        sunk = sink_samples(surface, signed_distance, spacing, support_in_spacings)
        samples.append(sunk)
        factor = completing_factor(sunk, surface, signed_distance, spacing, support_in_spacings)
        factors.append(np.full(len(sunk), factor))
    bare = BoundarySamples.of_bodies(*samples)
    return BoundarySamples(bare.positions, bare.body, np.concatenate([*factors, np.empty(0)]))


def completing_factor(
    samples: NDArray[np.floating],
    surface: NDArray[np.floating],
    signed_distance: SignedDistance,
    spacing: float,
    support_in_spacings: float = SUPPORT_IN_SPACINGS,
) -> float:
    """Factor on the volumes of a body's samples that completes the density of the fluid that touches the body.

    A particle that touches the body, half a spacing off, lacks the density that fluid in place of the body would give,
    the integral of W over the inside; the samples are to give as much in the mean over the surface. Flat walls do, by
    their calibration. The samples of a curved body lie on a smaller surface than the one they stand for, and give too
    little: a sphere of three spacings radius a fifth. Fluid would come nearer, and the body displace too little of it.
    Where a body is thinner than its samples should be deep, they give too much; but weaker samples all over would let
    fluid come too near elsewhere, so that the factor is 1 then.

    Args:
        samples: sunk into the body [m], (m, 3).
        surface: points spread evenly over its surface [m], (k, 3).
        signed_distance: of points (n, 3) to the surface [m], (n,); negative inside.
        spacing: particle spacing of the fluid [m].
        support_in_spacings: support radius of its kernel.
    """
    support = support_in_spacings * spacing
    random = np.random.default_rng(0)
    chosen = random.permutation(len(surface))[:MOST_PROBES]
    probes = _moved_out(np.asarray(surface, dtype=np.float64)[chosen], signed_distance, 0.5 * spacing)

    cell = spacing / CELLS_PER_SPACING
    axis = np.arange(-CELLS_PER_SPACING * support_in_spacings, CELLS_PER_SPACING * support_in_spacings + 1) * cell
    offsets = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    offsets = offsets[np.linalg.norm(offsets, axis=1) < support]
    weights = evaluate(np.linalg.norm(offsets, axis=1), support)
    weights /= weights.sum()
    missing = given = 0.0
    tree = cKDTree(samples)
    volumes = BoundarySamples.of_bodies(samples).volumes(spacing, support_in_spacings)
    for probe in probes:
        shifted = probe + offsets + cell * (random.random(3) - 0.5)
        missing += float(weights[signed_distance(shifted) < 0.0].sum())
        near = tree.query_ball_point(probe, support)
        distance = np.linalg.norm(np.asarray(samples, dtype=np.float64)[near] - probe, axis=1)
        given += float(volumes[near] @ evaluate(distance, support))
    if given == 0.0:
        return 1.0
    return max(1.0, missing / given * _flat_share(spacing, support_in_spacings))


def _flat_share(spacing: float, support_in_spacings: float) -> float:
    """What flat walls give a particle that touches them, over the integral of W behind the wall.

    It is below 1, as the first layer of a lattice misses the sum over the next layer rather than an integral.
    """
    support = support_in_spacings * spacing
    axis = spacing * np.arange(-np.ceil(support_in_spacings), np.ceil(support_in_spacings) + 1)
    layers = -spacing * np.arange(1, np.ceil(support_in_spacings) + 1)
    lattice = np.stack(np.meshgrid(axis, axis, layers, indexing="ij"), axis=-1).reshape(-1, 3)
    layer_sum = spacing**3 * float(evaluate(np.linalg.norm(lattice, axis=1), support).sum())
    # W integrated over the planes z = const is a function of z alone; the wall begins half a spacing off.
    fine = spacing / 40
    radius = fine * (np.arange(int(support / fine)) + 0.5)
    depth = 0.5 * spacing + radius
    distance = np.hypot(radius[:, None], depth[None, :])
    behind = float((2.0 * np.pi * radius[:, None] * evaluate(distance, support)).sum()) * fine**2
    return layer_sum / behind


def _moved_out(points: NDArray[np.float64], signed_distance: SignedDistance, distance: float) -> NDArray[np.float64]:
    """Points moved along the gradient of the distance to where it has this value [m], (n, 3)."""
    step = 0.1 * distance
    for _ in range(OUTWARD_ROUNDS):
        shifts = [np.eye(3)[axis] * step for axis in range(3)]
        gradient = np.stack(
            [signed_distance(points + shift) - signed_distance(points - shift) for shift in shifts], axis=1
        )
        normal = gradient / np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-12)
        points = points + (distance - signed_distance(points))[:, None] * normal
    return points
