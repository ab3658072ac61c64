"""Builds small tanks of fluid with moving bodies."""

from collections.abc import Sequence

import numpy as np
from coupled_steps import CoupledSteps
from numpy.typing import NDArray
from small_fluids import EARTH, EVERY_FACE, lattice

from sim.core.domain import DomainParameters
from sim.core.world import World
from sim.coupling.body_speed import expected_body_speed
from sim.coupling.fluid_rigid import FluidRigidCoupling, samples_of_moving_bodies
from sim.fluid.boundary_akinci2012 import BoundarySamples, domain_wall_samples
from sim.fluid.parameters import FluidParameters
from sim.fluid.solvers import SOLVERS
from sim.fluid.tank import FluidStart
from sim.rigid.groups import with_groups
from sim.rigid.parameters import RigidBodyParameters
from sim.rigid.solver import RigidSolver
from sim.shapes.placement import build_solid

SPACING = 0.02
WEIGHTLESS = (0.0, 0.0, 0.0)
OPEN_SPACE = DomainParameters(min=(-0.5,) * 3, max=(0.5,) * 3, open_faces=EVERY_FACE)


class Tank(CoupledSteps):
    """A fluid, bodies, and the world that steps both."""

    def __init__(
        self,
        bodies: Sequence[dict],
        *,
        domain: DomainParameters,
        water: tuple[tuple[float, ...], tuple[float, ...]],
        gravity: tuple[float, float, float] = EARTH,
        water_velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
        solver: str = "wcsph",
        frames_per_second: float = 60.0,
        **material: object,
    ) -> None:
        tables = [RigidBodyParameters.model_validate({"name": f"body{k}", **body}) for k, body in enumerate(bodies)]
        parameters = with_groups(tables)
        self.rigid = RigidSolver(parameters, domain=domain, gravity=gravity)
        fluid = FluidParameters.model_validate(
            {"name": "water", "block": [{"shape": {"type": "box", "size": (1, 1, 1)}}], "solver": solver, **material}
        )
        self.spacing = fluid.spacing
        points = lattice(*water, self.spacing)
        for body in parameters:
            points = points[build_solid(body).signed_distance(points.astype(np.float64)) >= 0.4995 * self.spacing]
        start = FluidStart(
            (fluid,),
            domain=domain,
            gravity=gravity,
            positions=points,
            velocities=np.broadcast_to(np.float32(water_velocity), points.shape).copy(),
            boundary=BoundarySamples.of_bodies(domain_wall_samples(domain, self.spacing, fluid.support_in_spacings)),
            moving=samples_of_moving_bodies(self.rigid, self.spacing, fluid.support_in_spacings),
            body_count=len(parameters),
            body_speed=expected_body_speed(parameters, self.rigid.solids, domain, gravity),
        )
        tank = SOLVERS[solver](start)
        super().__init__(tank, self.rigid, FluidRigidCoupling(tank, self.rigid))
        self.world = World([self.fluid, self.rigid], frames_per_second=frames_per_second, couplings=[self.coupling])

    def settle(self, duration: float) -> None:
        """Let the fluid come to rest for a time [s] while the bodies are held."""
        bodies = self.rigid.bodies
        is_dynamic = bodies.is_dynamic.copy()
        bodies.is_dynamic[:] = False
        self.coupling.resume()
        self.run(duration)
        bodies.is_dynamic[:] = is_dynamic
        self.coupling.resume()

    def momentum(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Linear [N s] and angular momentum about the origin [N m s] of fluid and dynamic bodies."""
        arrays = self.fluid.snapshots()["water"].arrays
        x, v = arrays["position"].astype(np.float64), arrays["velocity"].astype(np.float64)
        m = self.fluid.particle_volume * self.fluid.parameters.rest_density
        bodies = self.rigid.diagnostics()
        linear = [bodies[f"momentum_{axis}"] for axis in "xyz"]
        angular = [bodies[f"angular_momentum_{axis}"] for axis in "xyz"]
        return m * v.sum(axis=0) + linear, m * np.cross(x, v).sum(axis=0) + angular
