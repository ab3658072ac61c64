"""Builds tanks of fluid with moving bodies in it, with any of the SPH solvers, and steps them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from benchmarks.validation.fluids import EARTH, lattice, state_of
from benchmarks.validation.rigid_bodies import body
from benchmarks.validation.stepping import landing_steps
from sim.domain import DomainParameters
from sim.rigid.parameters import RigidBodyParameters

SPACING = 0.02
"""Of the particles around bodies that are validated in water [m]."""

SIDE_IN_RADII = 6.0
"""Of the tank with a sphere in it, and the depth of its water."""


class Tank:
    """A fluid and bodies, coupled as a world couples them.

    Attributes:
        fluid: the fluid's solver.
        rigid: the bodies' solver.
        coupling: with the force on each body in the last step.
    """

    def __init__(
        self,
        solver: str,
        bodies: Sequence[RigidBodyParameters],
        *,
        domain: DomainParameters,
        depth: float,
        spacing: float,
        gravity: tuple[float, float, float] = EARTH,
        block: tuple[Sequence[float], Sequence[float]] | None = None,
        velocity: Sequence[float] = (0.0, 0.0, 0.0),
        **material: float,
    ) -> None:
        """Fill the tank around the bodies.

        Args:
            solver: of the fluid.
            bodies: dynamic or kinematic.
            domain: the tank.
            depth: of the water before the bodies displace some [m].
            spacing: of the particles [m].
            gravity: [m/s²].
            block: two corners of the water [m], where it does not fill the tank.
            velocity: of the water [m/s].
            material: of the fluid, where it is not the default.
        """
        from sim.coupling.body_samples import samples_of_moving_bodies
        from sim.coupling.body_speed import expected_body_speed
        from sim.coupling.fluid_rigid import FluidRigidCoupling
        from sim.fluid.boundary_akinci2012 import BoundarySamples, domain_wall_samples
        from sim.fluid.parameters import FluidParameters
        from sim.fluid.solvers import SOLVERS
        from sim.rigid.solver import RigidSolver
        from sim.shapes.placement import build_solid

        parameters = FluidParameters.model_validate(
            {
                "name": "water",
                "solver": solver,
                "block": [{"shape": {"type": "box", "size": (1.0, 1.0, 1.0)}}],
                "particle_radius": spacing / 2.0,
                **material,
            }
        )
        self.rigid = RigidSolver(bodies, domain=domain, gravity=gravity)
        low, high = block or (domain.min, (domain.max[0], domain.max[1], domain.min[2] + depth))
        points = lattice(low, high, spacing)
        for each in bodies:
            # As a job fills its blocks: centres keep a radius from solids, up to float32 rounding.
            points = points[build_solid(each).signed_distance(points.astype(np.float64)) >= 0.4995 * spacing]
        self.fluid = SOLVERS[solver](
            parameters,
            domain=domain,
            gravity=gravity,
            positions=points,
            velocities=np.broadcast_to(np.float32(velocity), points.shape).copy(),
            boundary=BoundarySamples.of_bodies(domain_wall_samples(domain, spacing)),
            moving=samples_of_moving_bodies(self.rigid, spacing),
            body_count=len(bodies),
            body_speed=expected_body_speed(bodies, self.rigid.solids, domain, gravity),
        )
        self.coupling = FluidRigidCoupling(self.fluid, self.rigid)

    def stable_dt(self) -> float:
        """Largest step [s] that fluid and bodies both take now."""
        return min(self.fluid.stable_dt(), self.rigid.stable_dt())

    def advance(self, duration: float, *, cuts: int) -> Iterator[float]:
        """Advance by a duration [s] and stop after each of so many equal parts; yields the time [s].

        Raises:
            RuntimeError: fluid or bodies are not finite or run away.
        """
        part = duration / cuts
        for cut in range(1, cuts + 1):
            for _ in self.steps(part):
                pass
            yield cut * part

    def steps(self, duration: float) -> Iterator[float]:
        """Take steps that land on a duration [s]; yields the length of each after it was taken [s].

        Raises:
            RuntimeError: fluid or bodies are not finite or run away.
        """
        for dt in landing_steps(duration, self.stable_dt):
            self.step(dt)
            yield dt
        quantity = self.fluid.first_bad_quantity() or self.rigid.first_bad_quantity()
        if quantity is not None:
            raise RuntimeError(f"the tank diverged: {quantity}")

    def step(self, dt: float) -> None:
        """One coupled substep of dt [s], in the order of `sim.world.World`."""
        self.fluid.substep(dt)
        self.coupling.exchange(dt)
        self.rigid.substep(dt)
        self.coupling.follow(dt)

    def astray(self) -> int:
        """Particles with their centre inside of a body by more than a tenth of a spacing, and those that left."""
        position, _ = state_of(self.fluid)
        inside = 0
        for number, turned in enumerate(self.rigid.bodies.rotation()):
            in_body = (position - self.rigid.bodies.position[number]) @ turned
            distance = self.rigid.signed_distance_in_body_frame(number)(in_body)
            inside += int((distance < -0.1 * self.fluid.spacing).sum())
        return inside + self.fluid.particles_removed


def submerged_sphere(solver: str, density: float | None, radius: float, **material: float) -> Tank:
    """A sphere in the middle of a cube of water.

    Args:
        solver: of the fluid.
        density: of the sphere [kg/m³]; without one it is held for good.
        radius: of the sphere [m].
        material: of the water, where it is not the default.
    """
    side = SIDE_IN_RADII * radius
    kind = {"kind": "kinematic"} if density is None else {"density": density}
    sphere = body("sphere", {"type": "sphere", "radius": radius}, position=(0.0, 0.0, side / 2.0), **kind)
    domain = DomainParameters(min=(-side / 2.0, -side / 2.0, 0.0), max=(side / 2.0, side / 2.0, 1.4 * side))
    return Tank(solver, [sphere], domain=domain, depth=side, spacing=SPACING, **material)
