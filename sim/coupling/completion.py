"""Volumes of a body's samples that complete the density of the fluid which touches it, whatever the body's form."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from sim.fluid.boundary_akinci2012 import BoundarySamples
from sim.fluid.kernels import SUPPORT_IN_SPACINGS, evaluate, wall_calibration
from sim.shapes.solid import SignedDistance, outward_normals

MOST_PROBES = 3000  # points at which a body's field is compared with the fluid that it displaces, at most
QUADRATURE_BITS = 8  # binary digits of the number of points in a cube around each; half of them are within the support
PROBES_AT_A_TIME = 1000  # the distances of some hundred points around each are asked for together: 6 MiB of points
OUTWARD_ROUNDS = 4  # steps by which points of the surface are moved out to where particles touch it
LEAST_FACTOR = (
    0.25  # at the usual support: amid a sheet of such samples there is 6/4 of the rest density, so none passes
)


def least_factor(support_in_spacings: float = SUPPORT_IN_SPACINGS) -> float:
    """Least factor on a sample's volume [-]: a sheet of such samples has 1.5 times the rest density at any support."""
    usual, wide = wall_calibration(), wall_calibration(support_in_spacings)
    return LEAST_FACTOR * (usual.volume_factor / wide.volume_factor)


def completing_factors(
    samples: BoundarySamples,
    surface: NDArray[np.floating],
    signed_distance: SignedDistance,
    spacing: float,
    support_in_spacings: float = SUPPORT_IN_SPACINGS,
) -> NDArray[np.float64]:
    """Factors on the volumes of a body's samples that complete the density of the fluid that touches the body, (m,).

    A particle that touches the body, half a spacing off, lacks the density that fluid in place of the body would give,
    the integral of W over the inside; the samples are to give as much all over the surface. Flat walls do, by their
    calibration. The samples of a curved body lie on a smaller surface than the one they stand for, and give too little:
    a sphere of three spacings radius a fifth. Fluid would come nearer, and the body displace too little of it. Where a
    body is thinner than its samples should be deep, they give too much, and the body would displace too much.

    A sample's factor is the mean of what lacks at the points of the surface that it reaches, over the mean of what they
    get, both weighted by its part in them. Nearby samples have similar factors then, which exact completeness at every
    point would not give: which of them gives how much is an ill-posed question.

    Samples are sunk into the body; points of its surface are spread evenly [m], (k, 3).
    """
    support = support_in_spacings * spacing
    chosen = np.random.default_rng(0).permutation(len(surface))[:MOST_PROBES]
    probes = _moved_out(np.asarray(surface, dtype=np.float64)[chosen], signed_distance, 0.5 * spacing)
    lacking = _flat_share(spacing, support_in_spacings) * _share_inside(probes, signed_distance, support)

    points = samples.positions.astype(np.float64)
    pairs = cKDTree(probes).sparse_distance_matrix(cKDTree(points), support, output_type="coo_matrix")
    volumes = samples.volumes(spacing, support_in_spacings)
    weights = csr_matrix(
        (volumes[pairs.col] * evaluate(pairs.data, support), (pairs.row, pairs.col)), shape=pairs.shape
    )
    given = np.asarray(weights.sum(axis=1)).ravel()
    given_by_reached = weights.T @ given
    reached = given_by_reached > 0.0
    if not reached.any():
        return np.ones(len(points))
    if not (weights.T @ lacking).any():
        # So small that its inside falls between the points of the quadrature.
        return np.full(len(points), least_factor(support_in_spacings))
    factors = (weights.T @ lacking)[reached] / given_by_reached[reached]
    # Means that weigh strong points more are too low; over the whole surface nothing is to lack.
    factors *= lacking.sum() / (weights[:, np.flatnonzero(reached)] @ factors).sum()
    factors = np.maximum(factors, least_factor(support_in_spacings))
    # A large body has too few probes for all its samples: the others do as those nearby.
    return factors[cKDTree(points[reached]).query(points)[1]]


def _share_inside(probes: NDArray[np.float64], signed_distance: SignedDistance, support: float) -> NDArray[np.float64]:
    """Integral of W over the inside of a body around each probe [-], (n,)."""
    from scipy.stats import qmc  # takes longer to load than all the rest of a simulation without floating bodies

    # Points of low discrepancy: of a lattice whole layers would change sides where a face is parallel to it.
    cube = 2.0 * qmc.Sobol(3, seed=1).random_base2(QUADRATURE_BITS) - 1.0
    offsets = support * cube[np.linalg.norm(cube, axis=1) < 1.0]
    weights = evaluate(np.linalg.norm(offsets, axis=1), support)
    weights /= weights.sum()
    shares = [np.empty(0)]
    for batch in np.array_split(probes, max(1, math.ceil(len(probes) / PROBES_AT_A_TIME))):
        inside = signed_distance((batch[:, None] + offsets).reshape(-1, 3)) < 0.0
        shares.append(inside.reshape(len(batch), len(offsets)) @ weights)
    return np.concatenate(shares)


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
    for _ in range(OUTWARD_ROUNDS):
        normal = outward_normals(signed_distance, points, 0.1 * distance)
        points = points + (distance - signed_distance(points))[:, None] * normal
    return points
