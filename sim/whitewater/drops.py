"""The drops that a spray particle stands for: many, of different sizes, as much liquid as the particle in all.

Sheets and ligaments break into drops whose diameters follow a Gamma distribution about the width of the ligament, and
the widths one of their own (`sim.whitewater.kinds`). They break one after the other: a particle that has just become
spray is a few large drops, and the more they spread, the more and finer they are. A drop has the same size and the same
place about its particle in every frame: random numbers are keyed by both.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import gammainc, gammaincinv

from sim.core.hashed_numbers import uniforms
from sim.core.water import TENSION_OF_WATER
from sim.whitewater.kinds import (
    GAMMA_ORDER,
    LARGEST_SHARE,
    LIGAMENT_ORDER,
    LiquidKind,
    bounds_of_drops,
    drops_of_mean,
)
from sim.whitewater.liquid import LiquidState
from sim.whitewater.motion import FluidState

STIFF = 0.1
"""Ohnesorge number nu rho / sqrt(rho sigma d) above which viscosity keeps a drop of diameter d from breaking up
(Lefebvre & McDonell 2017, "Atomization and Sprays", section 2)."""

FIRST_REACH_IN_RADII = 1.5
"""How far apart the drops of a particle begin, in radii: about as wide as it."""
LEAST_REACH_IN_RADII, LARGEST_REACH_IN_RADII = 5.0, 16.0
"""How far they spread at least and at most: between, to those of the particles around them."""
REACH_IN_GAPS, NEXT = 1.2, 4
"""That is, so many times as far as the fourth nearest particle of spray: clouds that wide are one."""
SPREAD = 0.15
"""How fast they do, as a share of the particle's speed [-]."""
ALONG = 1.0
"""How much longer than wide the cloud of a particle's drops is, along its motion, as a share of the width [-]."""
FIRST_PIECES = 4
"""Drops that a particle breaks into at once. Each breaks in two now and then, until the least reach is reached."""
FARTHEST = 3.0
"""Of a cloud's drops from its middle, in standard deviations."""
_THINNEST = 0.01  # of ligaments, in their mean width: a millionth is thinner
_DIFFER = 0.04  # a ball of a particle's radius has 0.524 of its volume, so that none of two reaches it
_ROUND_OFF = 1e-6  # of reaches in single precision: none is less than itself


@dataclass(frozen=True)
class Drops:
    """Balls of liquid in the air, in the order of their particles."""

    position: NDArray[np.float64]  # [m], (n, 3)
    velocity: NDArray[np.float64]  # [m/s], (n, 3)
    radius: NDArray[np.float64]  # [m], (n,)
    particle_id: NDArray[np.int32]  # of the particle that each is of, (n,)

    @property
    def volume(self) -> float:
        """Of all of them [m³]."""
        return float(4.0 / 3.0 * math.pi * (self.radius**3).sum())

    def kept(self, rows: NDArray[np.bool_]) -> Drops:
        """The drops of a mask (n,)."""
        return Drops(self.position[rows], self.velocity[rows], self.radius[rows], self.particle_id[rows])


def atomizes(*, viscosity: float, rest_density: float, particle_radius: float) -> bool:
    """Whether pieces as small as a particle break up further: by the Ohnesorge number.

    Viscosity is kinematic [m²/s], density in [kg/m³], and the radius half the particles' spacing [m].
    """
    diameter = 2.0 * particle_radius
    return viscosity * math.sqrt(rest_density / (TENSION_OF_WATER * diameter)) < STIFF


@dataclass(frozen=True)
class Reach:
    """How wide the drops of each particle lie about it, (n,); 0 for what is no spray."""

    width: NDArray[np.float32]  # [m]
    rate: NDArray[np.float64]  # how fast it grows [m/s]


def grown_reach(state: LiquidState, fluid: FluidState, *, particle_radius: float, dt: float) -> Reach:
    """The reach of spray after a frame of dt [s]: it grows with the particle's speed, up to the next particles."""
    width, rate = np.zeros(len(state.kind), np.float32), np.zeros(len(state.kind))
    rows = np.flatnonzero(state.kind == LiquidKind.SPRAY)
    if not len(rows):
        return Reach(width, rate)
    speed = np.linalg.norm(fluid.velocity[rows].astype(np.float64), axis=1)
    position, before = fluid.position[rows], state.reach[rows].astype(np.float64)
    gaps, _ = cKDTree(position).query(position, [NEXT + 1])  # each is the nearest of its own
    least, most = LEAST_REACH_IN_RADII * particle_radius, LARGEST_REACH_IN_RADII * particle_radius
    widest = np.maximum(np.clip(REACH_IN_GAPS * gaps[:, 0], least, most), before)
    grown = np.minimum(before + SPREAD * speed * dt, widest)
    is_new = before == 0.0
    width[rows] = np.where(is_new, FIRST_REACH_IN_RADII * particle_radius, grown)
    rate[rows] = np.where(is_new, SPREAD * speed, (grown - before) / dt)
    return Reach(width, rate)


def drops_of(
    state: LiquidState, fluid: FluidState, reach: Reach, *, particle_radius: float, diameter: float, most: int
) -> Drops:
    """The drops of all spray, of this mean diameter [m] where `most` a particle allow them.

    Those of a particle lie in an ellipsoid about it, densest in the middle, its reach wide and longer along its motion,
    and move away from it as that grows. Their volume is the particle's.
    """
    rows = np.flatnonzero(state.kind == LiquidKind.SPRAY)
    particle_id, width = state.particle_id[rows], reach.width[rows].astype(np.float64)
    count = _numbers(particle_id, particle_radius=particle_radius, diameter=diameter, most=most)
    owner = np.repeat(np.arange(len(rows)), count)
    number = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
    size, height, turn, depth = uniforms((particle_id[owner], number, 0, 0), (0, 0))
    share = gammaincinv(GAMMA_ORDER, size) ** 3
    share /= _sums(share, owner, len(rows))[owner]

    z = 2.0 * height - 1.0
    across, distance = np.sqrt(1.0 - z * z), _distance(depth)
    place = np.stack(
        [
            distance * across * np.cos(2.0 * math.pi * turn),
            distance * across * np.sin(2.0 * math.pi * turn),
            distance * z,
        ],
        axis=1,
    )
    pieces = _pieces(count, width / particle_radius)
    first = np.cumsum(pieces) - pieces
    piece = (first[owner] + number * pieces[owner] // count[owner]).astype(np.intp)
    owner = np.repeat(np.arange(len(rows)), pieces)
    place, share = _middles(place, share, piece, len(owner))
    share = _no_marbles(share, owner, pieces)
    # The middle of a particle's drops is the particle.
    middle, _ = _middles(place, share, owner, len(rows))
    place -= middle[owner]

    velocity = fluid.velocity[rows].astype(np.float64)
    speed = np.linalg.norm(velocity, axis=1)
    direction = velocity / np.maximum(speed, np.finfo(np.float32).tiny)[:, None]
    place += ALONG * np.einsum("dk,dk->d", place, direction[owner])[:, None] * direction[owner]
    return Drops(
        fluid.position[rows].astype(np.float64)[owner] + width[owner, None] * place,
        velocity[owner] + reach.rate[rows][owner, None] * place,
        2.0 * particle_radius * np.cbrt(share / (4.0 / 3.0 * math.pi)),
        particle_id[owner],
    )


def _numbers(particle_id: NDArray[np.int32], *, particle_radius: float, diameter: float, most: int) -> NDArray[np.intp]:
    """How many drops each particle breaks into at last, by the width of the ligament that it is of, (n,)."""
    of_mean = drops_of_mean(particle_radius=particle_radius, diameter=diameter, most=most)
    share, _, _, _ = uniforms((particle_id, 0, 1, 0), (0, 0))
    width = gammaincinv(LIGAMENT_ORDER, share) / LIGAMENT_ORDER
    fewest, most = bounds_of_drops(of_mean=of_mean, most=most)
    return np.clip(np.rint(of_mean / np.maximum(width, _THINNEST) ** 3), fewest, most).astype(np.intp)


def _no_marbles(share: NDArray[np.float64], owner: NDArray[np.intp], pieces: NDArray[np.intp]) -> NDArray[np.float64]:
    """The shares that drops have of their particle with one above `LARGEST_SHARE` about that, the others the rest.

    No two are equal: a radius tells drops apart.
    """
    is_large = (share > LARGEST_SHARE) & (pieces[owner] > 1)
    smaller = LARGEST_SHARE - _DIFFER * (1.0 - share)
    factor = np.ones(len(pieces))
    factor[owner[is_large]] = (1.0 - smaller[is_large]) / (1.0 - share[is_large])
    return np.where(is_large, smaller, share * factor[owner])


def _pieces(count: NDArray[np.intp], reach_in_radii: NDArray[np.float64]) -> NDArray[np.intp]:
    """How many drops each particle is by now, of so many at last, (n,); their logarithm grows with that of the reach.

    They double, so that those of before are whole drops or pairs.
    """
    share = np.log(reach_in_radii / FIRST_REACH_IN_RADII) / math.log(LEAST_REACH_IN_RADII / FIRST_REACH_IN_RADII)
    doublings = np.floor(np.log2(np.maximum(count / FIRST_PIECES, 1.0)) * share + _ROUND_OFF)
    some = np.minimum(count, FIRST_PIECES * 2 ** np.maximum(doublings, 0.0).astype(np.intp))
    pieces: NDArray[np.intp] = np.where(share < 1.0 - _ROUND_OFF, some, count)
    return pieces


def _distance(depth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distances of a normal distribution in space, cut off far out, by equally distributed numbers; (n,).

    Their root mean square is that of a ball of radius 1.
    """
    places = np.linspace(0.0, FARTHEST, 512)
    share = gammainc(1.5, 0.5 * places**2)
    inner = np.interp(depth, share / share[-1], places)
    return np.asarray(inner / math.sqrt(5.0))


def _sums(values: NDArray[np.float64], group: NDArray[np.intp], count: int) -> NDArray[np.float64]:
    return np.bincount(group, values, minlength=count)


def _middles(
    place: NDArray[np.float64], share: NDArray[np.float64], group: NDArray[np.intp], count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Middle and share of groups of drops, (count, 3) and (count,)."""
    total = _sums(share, group, count)
    middle = np.stack([_sums(share * column, group, count) / total for column in place.T], axis=1)
    return middle, total


def in_the_air(drops: Drops, liquid: NDArray[np.float32], *, particle_radius: float) -> Drops:
    """The drops that are not in the liquid, whose particles (n, 3) [m] are drawn as a surface.

    That reaches about a particle radius [m] from them.
    """
    if not len(liquid) or not len(drops.radius):
        return drops
    distance, _ = cKDTree(liquid).query(drops.position, distance_upper_bound=particle_radius)
    return drops.kept(~np.isfinite(distance))
