"""How much whitewater each fluid particle makes, and where it comes to be."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sim.core.hashed_numbers import uniforms
from sim.whitewater.cloud import WhitewaterCloud, WhitewaterKind
from sim.whitewater.motion import FluidState
from sim.whitewater.parameters import WhitewaterParameters

_COUNTS, _PLACES, _FATES = 0, 1, 2  # streams of random numbers

Float64Array = NDArray[np.float64]


Moment = tuple[int, int]
"""Frame and its substep, which random numbers are keyed by besides the particle."""


def clamp_potential(values: NDArray[np.floating], low: float, high: float) -> Float64Array:
    """Phi(I, low, high) = (min(I, high) - min(I, low)) / (high - low) (Ihmsen et al. 2012, eq. 1)."""
    potential = np.asarray(values, dtype=np.float64)
    return (np.minimum(potential, high) - np.minimum(potential, low)) / (high - low)


def generation_rate(
    velocity: NDArray[np.floating],
    trapped_air: NDArray[np.floating],
    wave_crest: NDArray[np.floating],
    parameters: WhitewaterParameters,
) -> Float64Array:
    """Whitewater particles that each fluid particle makes [1/s], (n,): I_k (k_ta I_ta + k_wc I_wc) (eq. 9).

    The kinetic energy of eq. 7 is taken per unit mass, from speeds, so that it does not depend on the particle radius.
    Velocities are (n, 3) [m/s], trapped air [m/s] and wave crest [-] (n,).
    """
    p = parameters
    energy = np.einsum("ij,ij->i", velocity, velocity, dtype=np.float64)
    kinetic = clamp_potential(energy, p.min_speed**2, p.max_speed**2)
    air = clamp_potential(trapped_air, p.min_trapped_air, p.max_trapped_air)
    crest = clamp_potential(wave_crest, p.min_wave_crest, p.max_wave_crest)
    return kinetic * (p.trapped_air_rate * air + p.wave_crest_rate * crest)


def generate(
    state: FluidState,
    rate: Float64Array,
    dt: float,
    *,
    particle_radius: float,
    room: int,
    moment: Moment,
    parameters: WhitewaterParameters,
) -> tuple[WhitewaterCloud, int]:
    """The whitewater of one substep: in the cylinder that each fluid particle sweeps (their section 3.2).

    The number is rate dt, rounded up or down at random so that its mean is right. A place is r = r_V sqrt(X) across and
    X |v| dt along the velocity; the velocity is the fluid's, and `spread` of it outwards. Where there is no room for so
    many, fewer are made, and the number of those left out is returned as well. The state is that at the end of the
    substep of dt [s], the rate of each of its particles [1/s], (n,).
    """
    source, sample = _sources(state, rate * dt, moment, parameters.seed)
    wanted = len(source)
    if wanted > room:
        # Evenly thinned, so that no region goes without.
        chosen = np.arange(room) * wanted // max(room, 1)
        source, sample = source[chosen], sample[chosen]
    ids = state.particle_id[source]
    across, angle, along, _ = uniforms((ids, sample, *moment), (parameters.seed, _PLACES))
    size, life, _, _ = uniforms((ids, sample, *moment), (parameters.seed, _FATES))
    velocity = state.velocity[source].astype(np.float64)
    speed = np.linalg.norm(velocity, axis=1)
    share = np.sqrt(across)
    outwards = share[:, None] * _direction_across(velocity, 2.0 * math.pi * angle)
    position = state.position[source] + particle_radius * outwards + (dt * along)[:, None] * velocity
    smallest, largest = parameters.radius_min_in_radii, parameters.radius_max_in_radii
    shortest, longest = parameters.lifetime_min, parameters.lifetime_max
    born = WhitewaterCloud(
        position=position.astype(np.float32),
        velocity=(velocity + (parameters.spread * speed)[:, None] * outwards).astype(np.float32),
        # Squared, for there are more small bubbles than large ones.
        radius=(particle_radius * (smallest + (largest - smallest) * size**2)).astype(np.float32),
        lifetime=(shortest + (longest - shortest) * life).astype(np.float32),
        kind=np.full(len(source), WhitewaterKind.SPRAY, np.uint8),
    )
    return born, wanted - len(source)


def _sources(
    state: FluidState, expected: Float64Array, moment: Moment, seed: int
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """For each new particle the row of its fluid particle, and its number among those of the same one."""
    active = np.flatnonzero(expected > 0.0)
    chance, _, _, _ = uniforms((state.particle_id[active], np.zeros(len(active), np.intp), *moment), (seed, _COUNTS))
    counts = np.floor(expected[active] + chance).astype(np.intp)
    source = np.repeat(active, counts)
    first = np.repeat(np.cumsum(counts) - counts, counts)
    return source, np.arange(len(source)) - first


def _direction_across(velocity: Float64Array, angle: Float64Array) -> Float64Array:
    """Unit vectors at right angles to velocities (n, 3), turned about them by an angle [rad]."""
    axis = velocity / np.linalg.norm(velocity, axis=1, keepdims=True)
    # The world axis that is farthest from the velocity gives a cross product that is never short.
    helper = np.eye(3)[np.argmin(np.abs(axis), axis=1)]
    first = np.cross(axis, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * np.cross(axis, first)
