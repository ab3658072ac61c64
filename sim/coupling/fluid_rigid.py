"""Two-way coupling of a particle fluid and the rigid bodies that move in it, and the samples of these that it feels."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from sim.core.motion import rotation
from sim.core.solver import Coupling
from sim.fluid.boundary import BodyStates, Boundary
from sim.fluid.boundary_akinci2012 import BoundarySamples, sink_samples
from sim.fluid.kernels import SUPPORT_IN_SPACINGS, Discretization, evaluate, wall_calibration
from sim.shapes.body_geometry import BodyGeometry
from sim.shapes.deformation import Deformation
from sim.shapes.sampling import sample_surface
from sim.shapes.solid import SignedDistance, outward_normals

if TYPE_CHECKING:
    from sim.fluid.fluid import SPHFluid
    from sim.rigid.solver import RigidSolver

MOST_PROBES = 3000  # points at which a body's field is compared with the fluid that it displaces, at most
QUADRATURE_BITS = 8  # binary digits of the number of points in a cube around each; half of them are within the support
PROBES_AT_A_TIME = 1000  # the distances of some hundred points around each are asked for together: 6 MiB of points
OUTWARD_ROUNDS = 4  # steps by which points of the surface are moved out to where particles touch it
REACH_ROOM = 1.05  # what a smooth way between samples of an animation may lead beyond them
LEAST_FACTOR = (
    0.25  # at the usual support: amid a sheet of such samples there is 6/4 of the rest density, so none passes
)


class FluidRigidCoupling(Coupling):
    """The fluid pushes the bodies, and the bodies displace and push the fluid.

    A coupled step: the fluid steps with the bodies where they are and sums its impulses on them; the bodies take the
    impulses, then gravity and contacts, and move; the fluid's samples of the bodies follow. Impulses are opposite pair
    by pair and bodies get exactly what the fluid lost, so that linear and angular momentum are kept to rounding.
    Kinematic bodies push the fluid and feel nothing. Pieces of a body that breaks are one body for the fluid as long as
    they hold together, with one mass; what it does to each of them is told for itself, and stresses the others.

    Attributes:
        force: mean force of the fluid on each body in the last step [N], (n, 3); kinematic bodies have one too.
    """

    def __init__(self, fluid: SPHFluid, rigid: RigidSolver) -> None:
        """Couple the two; places the fluid's samples where the bodies are."""
        self.bodies = (fluid.name, rigid.name)
        self._fluid, self._rigid = fluid, rigid
        self.force: NDArray[np.float64] = np.zeros((len(rigid.bodies), 3))
        self._deforming = [
            DeformingSamples(fluid.tank.boundary, number, geometry, deformation, fluid.tank.discretization)
            for number, geometry in enumerate(rigid.solids)
            if (deformation := geometry.deformation) is not None
        ]
        self.follow(0.0)

    def exchange(self, dt: float) -> None:
        """Hand the fluid's impulses of its substep of dt [s] to the bodies."""
        linear, angular = (each[: len(self._rigid.bodies)] for each in self._fluid.body_forces.take_impulses())
        glue, bodies = self._rigid.glue, self._rigid.bodies
        if glue is not None:  # from the centre of what they move with to their own
            angular = angular - rotation.cross(bodies.position - glue.movers.position[glue.leader], linear)
        self._rigid.apply_impulses(linear, angular)
        self.force = linear / dt

    def follow(self, dt: float) -> None:
        """Put the fluid's samples where the bodies are after a substep of dt [s]; 0 before the first."""
        bodies, glue = self._rigid.bodies, self._rigid.glue
        for samples in self._deforming:
            samples.follow(self._rigid.time_s)
        states = BodyStates(bodies.position, bodies.rotation(), bodies.velocity, bodies.angular_velocity)
        if glue is not None:
            self._fluid.tank.boundary.glue(glue.leader, glue.arm)
            leads = glue.is_leader[:, None]
            states = states._replace(
                position=np.where(leads, glue.movers.position, bodies.position),
                velocity=np.where(leads, glue.movers.velocity, bodies.velocity),
            )
        self._fluid.tank.move_bodies(states, elapsed_s=dt)
        self.resume()

    def resume(self) -> None:
        """Hand the inverse masses of the bodies to the fluid, which saves where they are."""
        response = self._fluid.body_forces.response
        if response is not None:
            response.set_mobility(*self._rigid.mobility())


def samples_of_moving_bodies(
    rigid: RigidSolver, spacing: float, support_in_spacings: float = SUPPORT_IN_SPACINGS
) -> BoundarySamples:
    """Samples of every moving body, relative to its centre of mass and in its axes."""
    samples = []
    for geometry in rigid.solids:
        surface, signed_distance = geometry.samples(spacing), geometry.signed_distance
        deformation = geometry.deformation
        if deformation is not None:  # where its surface is largest, so that they are nowhere too far apart
            solid = deformation.solid(deformation.widest)
            surface, signed_distance = sample_surface(solid.mesh, spacing).astype(np.float64), solid.signed_distance
        sunk = sink_samples(surface, signed_distance, spacing, support_in_spacings)
        factors = completing_factors(sunk, surface, signed_distance, spacing, support_in_spacings)
        if deformation is not None:
            attached = deformation.attach(sunk.positions.astype(np.float64), deformation.widest)
            at_start = attached.at(deformation.vertices(0.0)[0]) - geometry.centre_of_mass
            sunk = replace(sunk, positions=at_start.astype(np.float32))
        samples.append(sunk.scaled(factors))
    return BoundarySamples.of_bodies(*samples)


class DeformingSamples:
    """The samples of a body that deforms: each keeps its place under the triangle that it is nearest to at the start.

    Their volumes are those of the samples of the animation, and linear in between: what a surface gains by stretching
    its samples gain.
    """

    def __init__(
        self,
        boundary: Boundary,
        body: int,
        geometry: BodyGeometry,
        deformation: Deformation,
        discretization: Discretization,
    ) -> None:
        """Take those that a boundary has of a body of this number."""
        self._boundary, self._body, self._deformation = boundary, body, deformation
        rows = slice(boundary.body_start[body], boundary.body_start[body + 1])
        own = BoundarySamples(*(getattr(boundary.moving, field.name)[rows] for field in fields(BoundarySamples)))
        attached = deformation.attach(own.positions.astype(np.float64) + geometry.centre_of_mass)
        self._track = deformation.track(lambda vertices: attached.at(vertices) - geometry.centre_of_mass)
        boundary.reach[body] = REACH_ROOM * float(np.linalg.norm(self._track.values, axis=2).max(initial=0.0))

        @lru_cache(maxsize=2)
        def volumes(sample: int) -> NDArray[np.float64]:
            placed = replace(own, positions=self._track.values[sample].astype(np.float32))
            return placed.volumes(discretization.spacing, discretization.support_in_spacings)

        self._volumes = volumes

    def follow(self, time_s: float) -> None:
        """Put them where the surface is at a time [s]."""
        position, velocity = self._track.at(time_s)
        sample, share = self._track.interval(time_s)
        volume = self._volumes(sample)
        if share > 0.0:
            volume = volume + share * (self._volumes(sample + 1) - volume)
        self._boundary.deform(self._body, position, velocity, volume)


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
