"""Dye: a concentration that particles carry, and that diffuses between neighbours, of one fluid or of two.

Fick's law dc/dt = div(D grad c), with the Laplacian of Brookshaw 1985 for materials that differ (Cleary & Monaghan
1999, eq. 13 and 14): with the harmonic mean of the diffusivities the flux is continuous,

    dc_i/dt = 2 V sum_j D_ij (c_i - c_j) x_ij . grad W_ij / |x_ij|²,    D_ij = 2 D_i D_j / (D_i + D_j)

What i loses to j is what j gains, so that the dye of a tank stays the same to
rounding; dye that a particle takes along through an open face is gone with it. Walls let none through, as they have no
part in the sum. No value leaves the range of those that there were: steps longer than that allows are taken in parts.
"""

import math
from collections.abc import Sequence

import numpy as np
import taichi as ti

from sim.core.arrays import Floats, on_device
from sim.core.launch import kernel
from sim.fluid.kernels import Discretization, evaluate_slope, inverse_distance, lattice_offsets, spline_slope
from sim.fluid.parameters import FluidParameters
from sim.fluid.particles import Fluid, ParticleSet

DYE = "dye"
"""Name of the carried scalar, and of the array in snapshots."""
SQUEEZED = 2.0
"""How much more neighbours a particle exchanges with than in a lattice at rest, at most, for the length of a part."""

TINY_DIFFUSIVITY = 1.0e-30  # [m²/s]; below it nothing is exchanged


class Dye:
    """Diffusion of the dye of a tank, within its fluids and from one to the other."""

    def __init__(self, fluids: Sequence[FluidParameters], discretization: Discretization, capacity: int) -> None:
        """Prepare for so many particles."""
        self._diffusivity = on_device(np.array([fluid.dye_diffusivity for fluid in fluids]))
        most = max(fluid.dye_diffusivity for fluid in fluids)
        self._rate = SQUEEZED * most * exchange_rate(discretization)  # [1/s]
        self._out = ti.ndarray(ti.f32, max(capacity, 1))

    def diffuse(self, particles: ParticleSet, fluid: Fluid, dt: float) -> None:
        """Let it diffuse for dt [s] between neighbours that are up to date."""
        parts = max(1, math.ceil(self._rate * dt))
        for _ in range(parts if self._rate > 0.0 else 0):
            before = particles.carried[DYE]
            diffuse_dye(fluid, self._diffusivity, dt / parts, before, self._out)
            particles.carried[DYE], self._out = self._out, before


def exchange_rate(discretization: Discretization) -> float:
    """How fast a particle of a lattice exchanges its dye, over the diffusivity [1/m²]: 2 V sum_j |W'_ij| / |x_ij|."""
    d = discretization
    distances = np.linalg.norm(lattice_offsets(d.support_in_spacings), axis=1) * d.spacing
    distances = distances[distances > 0.0]
    return float(2.0 * d.particle_volume * (-evaluate_slope(distances, d.support_radius) / distances).sum())


@kernel
def diffuse_dye(fluid: Fluid, diffusivity: Floats, dt: ti.f32, dye: Floats, dye_out: Floats):
    """c_i after dt [s]; grad W_ij = (sigma/h) w' x_ij/|x_ij|."""
    particles, near = ti.static((fluid.particles, fluid.near))
    ti.loop_config(block_dim=128)
    for i in range(particles.count):
        x_i, c_i, own = particles.position[i], dye[i], diffusivity[particles.phase[i]]
        exchange = 0.0
        first = near.start[i]
        for k in range(near.fluid_count[i]):
            j = near.indices[first + k * near.stride]
            x_ij = x_i - particles.position[j]
            r_squared = x_ij.norm_sqr()
            inverse_r = inverse_distance(r_squared)
            other = diffusivity[particles.phase[j]]
            mean = 2.0 * own * other / ti.max(own + other, TINY_DIFFUSIVITY)
            # Two particles in one place have no slope, and exchange nothing.
            slope = spline_slope(r_squared * inverse_r * fluid.inverse_support) * inverse_r
            exchange += mean * slope * (c_i - dye[j])
        factor = 2.0 * dt * fluid.volume * fluid.sigma * fluid.inverse_support
        dye_out[i] = c_i + factor * exchange
