"""The drops that a spray particle stands for: many, of different sizes, as much liquid as the particle in all.

Sheets and ligaments break into drops whose diameters follow a Gamma distribution (`sim.whitewater.kinds`), about as
large as the capillary length. A drop has the same size and the same place about its particle in every frame: random
numbers are keyed by both.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import gammaincinv

from sim.core.drag import TENSION_OF_WATER
from sim.core.hashed_numbers import uniforms
from sim.whitewater.kinds import GAMMA_ORDER, LiquidKind
from sim.whitewater.liquid import LiquidState
from sim.whitewater.motion import FluidState

STIFF = 0.1
"""Ohnesorge number nu rho / sqrt(rho sigma d) above which viscosity keeps a drop of diameter d from breaking up
(Lefebvre & McDonell 2017, "Atomization and Sprays", section 2)."""

FIRST_REACH_IN_RADII, LARGEST_REACH_IN_RADII = 1.5, 5.0
"""How far apart its drops begin: about as wide as the particle. And how far they spread: to those of the next ones."""
SPREAD = 0.15
"""How fast they do, as a share of the particle's speed [-]."""
ALONG = 1.0
"""How much longer than wide the cloud of a particle's drops is, along its motion, as a share of the width [-]."""


@dataclass(frozen=True)
class Drops:
    """Balls of liquid in the air, in the order of their particles."""

    position: NDArray[np.float64]  # [m], (n, 3)
    velocity: NDArray[np.float64]  # [m/s], (n, 3)
    radius: NDArray[np.float64]  # [m], (n,)

    @property
    def volume(self) -> float:
        """Of all of them [m³]."""
        return float(4.0 / 3.0 * math.pi * (self.radius**3).sum())

    def kept(self, rows: NDArray[np.bool_]) -> Drops:
        """The drops of a mask (n,)."""
        return Drops(self.position[rows], self.velocity[rows], self.radius[rows])


def atomizes(*, viscosity: float, rest_density: float, particle_radius: float) -> bool:
    """Whether pieces as small as a particle break up further: by the Ohnesorge number.

    Viscosity is kinematic [m²/s], density in [kg/m³], and the radius half the particles' spacing [m].
    """
    diameter = 2.0 * particle_radius
    return viscosity * math.sqrt(rest_density / (TENSION_OF_WATER * diameter)) < STIFF


def spread(state: LiquidState, fluid: FluidState, *, particle_radius: float, dt: float) -> LiquidState:
    """The state with the reach of spray grown over a frame of dt [s], in the speed of its particle."""
    is_spray = state.kind == LiquidKind.SPRAY
    first, last = FIRST_REACH_IN_RADII * particle_radius, LARGEST_REACH_IN_RADII * particle_radius
    speed = np.linalg.norm(fluid.velocity.astype(np.float64), axis=1)
    grown = np.where(state.reach > 0.0, np.minimum(state.reach + SPREAD * speed * dt, last), first)
    return replace(state, reach=np.where(is_spray, grown, 0.0).astype(np.float32))


def drops_of(state: LiquidState, fluid: FluidState, *, particle_radius: float, count: int) -> Drops:
    """The drops of all spray, `count` of each particle.

    Those of a particle lie evenly in an ellipsoid about it, its `reach` wide and longer along its motion, and move away
    from it as that grows. Their volume is the particle's.
    """
    rows = np.flatnonzero(state.kind == LiquidKind.SPRAY)
    ids = np.repeat(state.particle_id[rows], count)
    number = np.tile(np.arange(count), len(rows))
    size, height, turn, depth = uniforms((ids, number, 0, 0), (0, 0))
    diameters = gammaincinv(GAMMA_ORDER, size).reshape(len(rows), count)
    volume = (2.0 * particle_radius) ** 3
    radii = diameters * np.cbrt(volume / (4.0 / 3.0 * math.pi * (diameters**3).sum(axis=1, keepdims=True)))

    z = 2.0 * height - 1.0
    across = np.sqrt(1.0 - z * z)
    place = np.stack([across * np.cos(2.0 * math.pi * turn), across * np.sin(2.0 * math.pi * turn), z], axis=1)
    place = (place * np.cbrt(depth)[:, None]).reshape(len(rows), count, 3)
    # The middle of a particle's drops is the particle.
    place -= ((radii**3)[..., None] * place).sum(axis=1, keepdims=True) / (radii**3).sum(axis=1)[:, None, None]

    velocity = fluid.velocity[rows].astype(np.float64)
    speed = np.linalg.norm(velocity, axis=1)
    direction = velocity / np.maximum(speed, np.finfo(np.float32).tiny)[:, None]
    place += ALONG * np.einsum("pdk,pk->pd", place, direction)[..., None] * direction[:, None]
    reach = state.reach[rows].astype(np.float64)
    grows = np.where(reach < np.float32(LARGEST_REACH_IN_RADII * particle_radius), SPREAD * speed, 0.0)
    position = fluid.position[rows].astype(np.float64)[:, None] + reach[:, None, None] * place
    drifting = velocity[:, None] + grows[:, None, None] * place
    return Drops(position.reshape(-1, 3), drifting.reshape(-1, 3), radii.reshape(-1))


def in_the_air(drops: Drops, liquid: NDArray[np.float32], *, particle_radius: float) -> Drops:
    """The drops that are not in the liquid, whose particles (n, 3) [m] are drawn as a surface.

    That reaches about a particle radius [m] from them.
    """
    if not len(liquid) or not len(drops.radius):
        return drops
    distance, _ = cKDTree(liquid).query(drops.position, distance_upper_bound=particle_radius)
    return drops.kept(~np.isfinite(distance))
