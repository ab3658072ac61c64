"""Builds tanks of fluid with moving bodies in it, with any of the SPH solvers, and steps them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from benchmarks.validation.fluids import EARTH, lattice
from sim.rigid.parameters import RigidBodyParameters
from sim.scene import DomainParameters


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

    def advance(self, duration: float, *, cuts: int) -> Iterator[float]:
        """Advance by a duration [s] and stop after each of so many equal parts; yields the time [s].

        Raises:
            RuntimeError: fluid or bodies are not finite or run away.
        """
        part = duration / cuts
        for cut in range(1, cuts + 1):
            remaining = part
            while remaining > 0.0:
                stable_dt = min(self.fluid.stable_dt(), self.rigid.stable_dt())
                left = max(1, math.ceil(remaining / stable_dt * (1.0 - 1.0e-9)))
                self.step(remaining / left)
                remaining = remaining - remaining / left if left > 1 else 0.0
            quantity = self.fluid.first_bad_quantity() or self.rigid.first_bad_quantity()
            if quantity is not None:
                raise RuntimeError(f"the tank diverged by t = {cut * part:.4g} s: {quantity}")
            yield cut * part

    def step(self, dt: float) -> None:
        """One coupled substep of dt [s], in the order of `sim.world.World`."""
        self.fluid.substep(dt)
        self.coupling.exchange(dt)
        self.rigid.substep(dt)
        self.coupling.follow(dt)

    def settle(self, duration: float) -> None:
        """Let the water come to rest for a time [s] while the bodies are held where they are."""
        bodies = self.rigid.bodies
        is_dynamic = bodies.is_dynamic.copy()
        bodies.is_dynamic[:] = False
        self.coupling.follow(0.0)
        for _ in self.advance(duration, cuts=1):
            pass
        bodies.is_dynamic[:] = is_dynamic
        self.coupling.follow(0.0)
