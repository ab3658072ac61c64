"""From a scene's parameters to a world of solvers, and to the particles they start with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sim.fluid.parameters import FluidParameters
from sim.rigid.static import StaticBody
from sim.scene import DomainParameters, SceneParameters
from sim.shapes.placement import build_solid
from sim.shapes.sampling import fill_with_particles
from sim.shapes.solid import Solid
from sim.smoke.parameters import SmokeParameters
from sim.solver import Solver
from sim.world import World

CLEARANCE_IN_SPACINGS = 0.5
"""A particle's centre keeps half a lattice spacing, its radius, from walls and solids."""

ROUNDING = 1.0e-3
"""Share of the clearance that a particle may come nearer: lattice points are float32, and a block that rests on a
body has its first layer exactly at the clearance."""


@dataclass(frozen=True)
class FluidFilling:
    """The particles that a fluid starts with.

    Attributes:
        positions: (n, 3) float32 [m].
        velocities: (n, 3) float32 [m/s].
    """

    positions: NDArray[np.float32]
    velocities: NDArray[np.float32]


def build_world(scene: SceneParameters, *, frames_per_second: float) -> World:
    """The solvers of a scene in their initial state; `sim.runtime.initialize` must have run.

    Raises:
        ShapeError: a shape cannot be built.
        ValueError: a body cannot start as described.
    """
    bodies = [StaticBody(parameters) for parameters in scene.rigid]
    fluids = [_build_fluid(fluid, scene, bodies) for fluid in scene.fluid]
    smokes = [_build_smoke(smoke, scene, bodies) for smoke in scene.smoke]
    return World([*fluids, *smokes], frames_per_second=frames_per_second, static_bodies=bodies)


def fill_fluid(fluid: FluidParameters, domain: DomainParameters, solids: Sequence[Solid]) -> FluidFilling:
    """Fill the fluid's blocks on lattices of spacing 2r, clear of walls, solids and each other.

    A place in two blocks belongs to the first.

    Raises:
        ShapeError: a block's shape cannot be built.
        ValueError: a block is left without a particle.
    """
    spacing = 2.0 * fluid.particle_radius
    clearance = CLEARANCE_IN_SPACINGS * spacing
    positions: list[NDArray[np.float32]] = []
    velocities: list[NDArray[np.float32]] = []
    for number, block in enumerate(fluid.block):
        points = fill_with_particles(build_solid(block), spacing, lower=domain.min, upper=domain.max)
        for solid in solids:
            outside = solid.signed_distance(points.astype(np.float64)) >= (1.0 - ROUNDING) * clearance
            points = points[outside]
        if positions and len(points):
            distance, _ = cKDTree(np.concatenate(positions)).query(points, distance_upper_bound=0.9 * spacing)
            free = ~np.isfinite(distance)
            points = points[free]
        if len(points) == 0:
            raise ValueError(
                f'fluid "{fluid.name}" block[{number}] has no particle: '
                "it is outside the domain, inside solids, or filled by the blocks before it"
            )
        positions.append(points)
        velocities.append(np.broadcast_to(np.float32(block.velocity), points.shape))
    return FluidFilling(np.concatenate(positions), np.ascontiguousarray(np.concatenate(velocities)))


def _build_fluid(fluid: FluidParameters, scene: SceneParameters, bodies: Sequence[StaticBody]) -> Solver:
    from sim.fluid.boundary_akinci2012 import BoundarySamples, domain_wall_samples, sink_samples
    from sim.fluid.wcsph import WCSPHSolver

    spacing = 2.0 * fluid.particle_radius
    filling = fill_fluid(fluid, scene.domain, [body.solid for body in bodies])
    samples = [
        sink_samples(
            _reachable(body.surface_samples(spacing), scene.domain, spacing), body.solid.signed_distance, spacing
        )
        for body in bodies
    ]
    boundary = BoundarySamples.of_bodies(domain_wall_samples(scene.domain, spacing), *samples)
    return WCSPHSolver(
        fluid,
        domain=scene.domain,
        gravity=scene.gravity,
        positions=filling.positions,
        velocities=filling.velocities,
        boundary=boundary,
    )


def _reachable(samples: NDArray[np.float32], domain: DomainParameters, spacing: float) -> NDArray[np.float32]:
    """The samples that fluid in the domain can come near: a body may stand partly or wholly outside."""
    margin = 2.0 * spacing
    inside = (samples >= np.asarray(domain.min) - margin) & (samples <= np.asarray(domain.max) + margin)
    return samples[inside.all(axis=1)]


def _build_smoke(smoke: SmokeParameters, scene: SceneParameters, bodies: Sequence[StaticBody]) -> Solver:
    from sim.smoke.solver import SmokeSolver

    return SmokeSolver(smoke, domain=scene.domain, gravity=scene.gravity, solids=[body.solid for body in bodies])
