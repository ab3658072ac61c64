"""Mechanical pressure: what the forces between particles carry, a third of the trace of their stress.

The P of a solve are the multipliers that keep each particle at rest density. Where particles lie in disorder they
differ from neighbour to neighbour, and in the layer beside a wall, which is packed otherwise, they are a tenth higher;
the forces that they make bear the weight all the same. A stress is the sum over the bonds of a particle of force times
length (Irving & Kirkwood 1950), taken as a field by the kernel (Hardy 1982):

    s_i = -1/3 [1/2 sum_j V (P_i + P_j) r_ij W'_ij + c sum_b V_b P_i r_ib W'_ib]
    p_i = sum_j s_j W_ij / sum_j W_ij

where of a bond with a sample of a wall the share c lies in the fluid (`sim.fluid.kernels.wall_share`).
"""

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.arrays import Floats
from sim.core.launch import kernel
from sim.fluid.boundary import to_particle
from sim.fluid.kernels import Discretization, distance, spline, spline_slope, wall_share
from sim.fluid.particles import Fluid, ParticleSet


class MechanicalPressure:
    """Mechanical pressures of the particles, for who looks at them; no force is made of them."""

    def __init__(self, particles: ParticleSet, discretization: Discretization) -> None:
        self._particles = particles
        self._wall_share = wall_share(discretization.support_in_spacings)
        self._stress, self._pressure = (ti.ndarray(ti.f32, particles.capacity) for _ in range(2))

    def of(self, fluid: Fluid, pressure_term: ti.Ndarray) -> NDArray[np.generic]:
        """p_i [Pa] for P_i [Pa] in the order of the particles, (n,), float32."""
        compute_stress(fluid, pressure_term, self._wall_share, self._stress)
        interpolate(fluid, self._stress, self._pressure)
        return self._particles.host(self._pressure)


@kernel
def compute_stress(fluid: Fluid, pressure: Floats, wall_share: ti.f32, stress: Floats):
    """s_i."""
    particles, near, samples = ti.static((fluid.particles, fluid.near, fluid.samples))
    ti.loop_config(block_dim=128)
    for i in range(particles.count):
        x_i, pressure_i = particles.position[i], pressure[i]
        fluid_sum = 0.0
        first = near.start[i]
        for k in range(near.fluid_count[i]):
            j = near.indices[first + k * near.stride]
            q = distance((x_i - particles.position[j]).norm_sqr()) * fluid.inverse_support
            fluid_sum += (pressure_i + pressure[j]) * q * spline_slope(q)
        boundary_sum = 0.0
        first += near.fluid_count[i] * near.stride
        for k in range(near.boundary_count[i]):
            b = near.indices[first + k * near.stride]
            q = distance(to_particle(samples, b, x_i).norm_sqr()) * fluid.inverse_support
            boundary_sum += samples.volume[b] * q * spline_slope(q)
        total = 0.5 * fluid.volume * fluid_sum + wall_share * pressure_i * boundary_sum
        stress[i] = -fluid.sigma / 3.0 * total


@kernel
def interpolate(fluid: Fluid, values: Floats, field: Floats):
    """Mean of the values of a particle and its neighbours, weighted by the kernel."""
    particles, near = ti.static((fluid.particles, fluid.near))
    ti.loop_config(block_dim=128)
    for i in range(particles.count):
        x_i = particles.position[i]
        total, weight = values[i], 1.0  # w(0): the particle itself
        first = near.start[i]
        for k in range(near.fluid_count[i]):
            j = near.indices[first + k * near.stride]
            w = spline(distance((x_i - particles.position[j]).norm_sqr()) * fluid.inverse_support)
            total += w * values[j]
            weight += w
        field[i] = total / weight
