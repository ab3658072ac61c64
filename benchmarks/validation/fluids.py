"""Builds the fluids of the cases, with any of the SPH solvers, and steps them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.validation.stepping import landing_steps
from sim.domain import DomainParameters

if TYPE_CHECKING:
    from sim.fluid.forces import SPHFluid

FLUID_SOLVERS = ("wcsph", "dfsph", "pcisph")

GRAVITY = 9.81
EARTH = (0.0, 0.0, -GRAVITY)
WEIGHTLESS = (0.0, 0.0, 0.0)
WATER = 1000.0
EVERY_FACE = ("x-", "x+", "y-", "y+", "z-", "z+")

Vectors = NDArray[np.float32]


def lattice(low: Sequence[float], high: Sequence[float], spacing: float) -> Vectors:
    """Cubic lattice that fills a box, half a spacing from its faces, (n, 3) [m]."""
    counts = [round((b - a) / spacing) for a, b in zip(low, high, strict=True)]
    axes = [a + spacing * (np.arange(count) + 0.5) for a, count in zip(low, counts, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)


def make_fluid(
    solver: str,
    domain: DomainParameters,
    positions: Vectors,
    *,
    spacing: float,
    velocities: Vectors | None = None,
    gravity: tuple[float, float, float] = EARTH,
    **parameters: Any,
) -> SPHFluid:
    """A fluid of given particles between the walls of a domain; water unless `parameters` say otherwise."""
    from sim.fluid.boundary_akinci2012 import BoundarySamples, domain_wall_samples
    from sim.fluid.parameters import FluidParameters
    from sim.fluid.solvers import SOLVERS

    material = FluidParameters.model_validate(
        {
            "name": "water",
            "solver": solver,
            "block": [{"shape": {"type": "box", "size": (1.0, 1.0, 1.0)}}],
            "particle_radius": spacing / 2.0,
            **parameters,
        }
    )
    return SOLVERS[solver](
        material,
        domain=domain,
        gravity=gravity,
        positions=positions,
        velocities=np.zeros_like(positions) if velocities is None else velocities.astype(np.float32),
        boundary=BoundarySamples.of_bodies(domain_wall_samples(domain, spacing)),
    )


def advance(fluid: SPHFluid, duration: float, *, cuts: int = 1) -> Iterator[float]:
    """Advance by a duration [s] and stop after each of so many equal parts of it; yields the time [s].

    Steps land on the stops exactly, as a frame's do.

    Raises:
        RuntimeError: the state is not finite or runs away.
    """
    part = duration / cuts
    for cut in range(1, cuts + 1):
        for dt in landing_steps(part, fluid.stable_dt):
            fluid.substep(dt)
        quantity = fluid.first_bad_quantity()
        if quantity is not None:
            raise RuntimeError(f"{fluid.name} diverged by t = {cut * part:.4g} s: {quantity}")
        yield cut * part


def run(fluid: SPHFluid, duration: float) -> None:
    """Advance by a duration [s]."""
    for _ in advance(fluid, duration):
        pass


def state_of(fluid: SPHFluid) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions [m] and velocities [m/s] by particle id, (n, 3) each, float64."""
    arrays = next(iter(fluid.snapshots().values())).arrays
    return arrays["position"].astype(np.float64), arrays["velocity"].astype(np.float64)
