"""Largest speed of a fluid, as far as its start tells."""

import math

import numpy as np
from numpy.typing import NDArray

from sim.core.domain import DomainParameters
from sim.core.parameters import Vector3

SLOWEST_EXPECTED_SPEED = 0.1  # where neither gravity nor an initial velocity says what to expect [m/s]
COHESION_SPEED_FACTOR = 10.0
"""Square of the speed to expect from cohesion over the stress with which that pulls a filled lattice together, per
density: at rest it compresses the lattice by 0.1 %, and a cube that collapses to a drop by 1 to 2 %."""


def expected_speed(
    positions: NDArray[np.floating],
    velocities: NDArray[np.floating],
    domain: DomainParameters,
    gravity: Vector3,
    *,
    cohesion_stress: float = 0.0,
    body_speed: float = 0.0,
    outer_acceleration: float = 0.0,
) -> float:
    """Largest speed to expect [m/s], never 0.

    That is the initial one with a fall from the highest particle to the bottom, the corner of the domain that lies
    deepest along gravity; what cohesion asks for, whose stress over the density is `cohesion_stress` [m²/s²]; or that
    of the fastest body, `body_speed` [m/s], which fluid that it hits takes on. Forces from outside, of at most
    `outer_acceleration` [m/s²], act along the domain's diagonal on top.
    """
    initial = float((np.asarray(velocities, dtype=np.float64) ** 2).sum(axis=1).max(initial=0.0))
    diagonal = math.dist(domain.min, domain.max)
    by_forces = 2.0 * outer_acceleration * diagonal
    fall = math.sqrt(initial + square_of_fall_speed(positions, domain, gravity) + by_forces)
    cohesion = math.sqrt(COHESION_SPEED_FACTOR * cohesion_stress)
    return max(fall, cohesion, body_speed, SLOWEST_EXPECTED_SPEED)


def square_of_fall_speed(positions: NDArray[np.floating], domain: DomainParameters, gravity: Vector3) -> float:
    """2 g H [m²/s²] of a fall from the highest of the positions [m], (n, 3), to the domain's deepest corner."""
    g = np.asarray(gravity, dtype=np.float64)
    strength = float(np.linalg.norm(g))
    if strength == 0.0 or not len(positions):
        return 0.0
    corners = np.stack(np.meshgrid(*zip(domain.min, domain.max, strict=True)), axis=-1).reshape(-1, 3)
    down = g / strength
    height = float((corners @ down).max() - (np.asarray(positions, dtype=np.float64) @ down).min())
    return 2.0 * strength * max(height, 0.0)
