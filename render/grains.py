"""Grains of sand and snow: each particle of the material point method stands for many."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from render.point_clouds import PointCloud

GRAINS_A_PARTICLE = 8
PACKING = 0.6  # share of the volume that grains fill (random close packing is 0.64)
SPREAD = 0.25  # standard deviation of the logarithm of their radii
SEED = 20_261_130


def grains_of(
    position: NDArray[np.generic],
    velocity: NDArray[np.generic],
    particle_id: NDArray[np.generic],
    dye: NDArray[np.generic] | None = None,
    *,
    radius: float,
) -> PointCloud:
    """Grains of particles with a spacing of two radii [m]: at fixed places about each, of sizes of their own.

    A particle's grains are the same in every frame, whichever others there are: places and sizes are drawn from tables
    by its number. All of them fill `PACKING` of the particles' volume.

    Args:
        position: of particles [m], (n, 3).
        velocity: of particles [m/s], (n, 3).
        particle_id: which each is, (n,).
        dye: concentration in each [-], (n,); None where they have none.
        radius: half the spacing of particles at rest [m].
    """
    table = np.random.Generator(np.random.PCG64(SEED))
    rows = 4096
    # One grain in each eighth of the particle's cube, anywhere in it.
    corner = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    places = radius * (corner + table.uniform(-0.5, 0.5, (rows, GRAINS_A_PARTICLE, 3)))
    sizes = np.exp(SPREAD * table.standard_normal((rows, GRAINS_A_PARTICLE)))
    volume = PACKING * (2.0 * radius) ** 3
    sizes *= np.cbrt(volume / (4.0 / 3.0 * np.pi * (sizes**3).sum(axis=1).mean()))
    chosen = particle_id.astype(np.int64) % rows
    n = len(position) * GRAINS_A_PARTICLE
    return PointCloud(
        position=(position.astype(np.float32)[:, None] + places[chosen]).reshape(-1, 3).astype(np.float32),
        velocity=np.repeat(velocity, GRAINS_A_PARTICLE, axis=0).astype(np.float32),
        radius=sizes[chosen].ravel().astype(np.float32),
        lifetime=np.ones(n, np.float32),
        kind=np.zeros(n, np.uint8),
        dye=None if dye is None else np.repeat(dye, GRAINS_A_PARTICLE).astype(np.float32),
    )
