"""The particles that the fluids of a tank start with."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sim.fluid.opening import openings_of
from sim.shapes.filled_volume import Surroundings, pack
from sim.shapes.placement import build_solid

if TYPE_CHECKING:
    from sim.core.domain import DomainParameters
    from sim.fluid.parameters import FluidParameters
    from sim.shapes.solid import Solid


FREE_OF_SHEETS = 0.45  # least distance from a sheet at the start [spacings]: at rest half of one
FULL_DOMAIN = 1.1  # particles that a domain holds at most over those that fill it at rest; emitters stop there


@dataclass(frozen=True)
class FluidFilling:
    """The particles that the fluids of a tank start with."""

    positions: NDArray[np.float32]  # (n, 3) float32 [m]
    velocities: NDArray[np.float32]  # (n, 3) float32 [m/s]
    phase: NDArray[np.int32]  # which of the fluids each particle is of, (n,) int32
    dye: NDArray[np.float32]  # concentration of dye [-], (n,) float32


def fill_fluids(
    fluids: Sequence[FluidParameters],
    domain: DomainParameters,
    solids: Sequence[Solid],
    sheets: tuple[NDArray[np.floating], NDArray[np.floating]] | None = None,
) -> FluidFilling:
    """Fill the blocks of all fluids with particles of spacing 2r, as many as their volumes hold.

    They are clear of walls and solids. What two blocks share belongs to the first, of the first fluid that has it.
    Nor do they lie in sheets, which are given by points on them, at most a spacing from each other [m], and normals
    there, (m, 3) each.

    Raises:
        ShapeError: a block's shape cannot be built.
        ValueError: a block is left without a particle.
    """
    positions, velocities = [np.empty((0, 3), np.float32)], [np.empty((0, 3), np.float32)]
    phase, dye = [np.empty(0, np.int32)], [np.empty(0, np.float32)]
    filled: list[Solid] = []
    for index, fluid in enumerate(fluids):
        spacing = fluid.spacing
        for number, block in enumerate(fluid.block):
            solid = build_solid(block)
            points = pack(solid, spacing, Surroundings.in_domain(domain, solids, filled), np.concatenate(positions))
            filled.append(solid)
            if sheets is not None and len(points):
                places, normals = sheets
                distance, nearest = cKDTree(places).query(points)
                height = np.abs(np.einsum("nx,nx->n", points - places[nearest], normals[nearest]))
                points = points[(height > FREE_OF_SHEETS * spacing) | (distance > spacing)]
            if len(points) == 0:
                raise ValueError(
                    f'fluid "{fluid.name}" block[{number}] has no particle: '
                    "it is outside the domain, inside solids, or filled by the blocks before it"
                )
            positions.append(points)
            velocities.append(np.broadcast_to(np.float32(block.velocity), points.shape))
            phase.append(np.full(len(points), index, dtype=np.int32))
            dye.append(np.full(len(points), block.dye, dtype=np.float32))
    return FluidFilling(*map(np.concatenate, (positions, velocities, phase, dye)))


def particle_capacity(
    fluids: Sequence[FluidParameters], domain: DomainParameters, filling: FluidFilling, particle_volume: float
) -> int:
    """Most particles that there can be: those at the start, and what emitters may add to a domain that is not full."""
    counts = np.bincount(filling.phase, minlength=len(fluids))
    most = counts.astype(np.float64)
    for number, opening in openings_of(fluids, particle_volume):
        most[number] += opening.total_particles
    caps = [math.inf if fluid.max_particles is None else fluid.max_particles for fluid in fluids]
    total = float(np.maximum(counts, np.minimum(most, caps)).sum())
    full = FULL_DOMAIN * math.prod(np.subtract(domain.max, domain.min)) / particle_volume
    return max(len(filling.phase), int(min(total, full)))
