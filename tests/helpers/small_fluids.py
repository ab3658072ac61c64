"""Builds small fluids in small boxes."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sim.core.domain import DomainParameters
from sim.fluid.boundary_akinci2012 import BoundarySamples, domain_wall_samples
from sim.fluid.fluid import SPHFluid
from sim.fluid.parameters import FluidParameters
from sim.fluid.solvers import SOLVERS
from sim.fluid.tank import FluidStart

EARTH = (0.0, 0.0, -9.81)
EVERY_FACE = ("x-", "x+", "y-", "y+", "z-", "z+")


def lattice(low: tuple[float, ...], high: tuple[float, ...], spacing: float) -> NDArray[np.float32]:
    """Cubic lattice that fills a box, half a spacing from its faces."""
    axes = [np.arange(a + spacing / 2, b - spacing / 4, spacing) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)


def make_fluid(
    domain: DomainParameters,
    positions: NDArray[np.float32],
    velocities: NDArray[np.float32] | None = None,
    gravity: tuple[float, float, float] = EARTH,
    bodies: Sequence[NDArray[np.float32]] = (),
    capacity: int | None = None,
    **parameters: object,
) -> SPHFluid:
    material = FluidParameters.model_validate(
        {"name": "water", "block": [{"shape": {"type": "box", "size": (1, 1, 1)}}], **parameters}
    )
    walls = domain_wall_samples(domain, material.spacing, material.support_in_spacings)
    start = FluidStart(
        (material,),
        domain=domain,
        gravity=gravity,
        positions=positions,
        velocities=np.zeros_like(positions) if velocities is None else velocities,
        boundary=BoundarySamples.of_bodies(walls, *bodies),
        capacity=capacity,
    )
    return SOLVERS[material.solver](start)


def steps(fluid: SPHFluid, count: int) -> None:
    """Advance by stable steps, of a frame at the most."""
    for _ in range(count):
        fluid.substep(min(fluid.stable_dt(), 1.0 / 60.0))


def run(fluid: SPHFluid, seconds: float) -> None:
    """Advance by stable steps until a duration has passed [s]; nothing may go wrong."""
    time = 0.0
    while time < seconds:
        dt = fluid.stable_dt()
        fluid.substep(dt)
        time += dt
        assert fluid.first_bad_quantity() is None
