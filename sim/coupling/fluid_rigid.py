"""Two-way coupling of a particle fluid and the rigid bodies that move in it, and the samples of these that it feels."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sim.core.motion import rotation
from sim.core.solver import Coupling
from sim.coupling.completion import completing_factors
from sim.coupling.piece_samples import PieceSamples, samples_of_pieces
from sim.fluid.boundary import BodyStates, Boundary
from sim.fluid.boundary_akinci2012 import BoundarySamples, sink_samples
from sim.fluid.kernels import SUPPORT_IN_SPACINGS, Discretization
from sim.shapes.body_geometry import BodyGeometry
from sim.shapes.deformation import Deformation
from sim.shapes.sampling import sample_surface

if TYPE_CHECKING:
    from sim.fluid.fluid import SPHFluid
    from sim.rigid.solver import RigidSolver

REACH_ROOM = 1.05  # what a smooth way between samples of an animation may lead beyond them


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
        glue, boundary = rigid.glue, fluid.tank.boundary
        self._pieces = None if glue is None else PieceSamples(boundary, glue, rigid, fluid.tank.discretization)
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
        if glue is not None and self._pieces is not None:
            self._pieces.follow()
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
    samples, of_pieces = [], samples_of_pieces(rigid, spacing, support_in_spacings)
    for number, geometry in enumerate(rigid.solids):
        if number in of_pieces:
            samples.append(of_pieces[number])
            continue
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
