"""Mechanical pressure: what the forces between particles carry, a third of the trace of their stress.

The P of a solve are the multipliers that keep each particle at rest density. Where particles lie in disorder they
differ from neighbour to neighbour, and in the layer beside a wall, which is packed otherwise, they are a tenth higher;
the forces that they make bear the weight all the same. A stress is the sum over the bonds of a particle of force times
length (Irving & Kirkwood 1950),

    s_i = -1/3 [1/2 sum_j V (P_i + P_j) r_ij W'_ij + c sum_b V_b P_i r_ib W'_ib]

where of a bond with a sample of a wall the share c lies in the fluid (`sim.fluid.kernels.wall_share`). As a field it is
taken by the kernel (Hardy 1982). But particles at rest lie as grains do, jammed: their stress differs from one to the
next, and between the directions, most of all beside walls. What does not is the force on each of them, which is the
gradient of the pressure,

    g_i = sum_j V (P_i + P_j) grad W_ij + sum_b V_b P_i grad W_ib

So the means over neighbours are of what their pressures are here by that gradient, and are taken several times,

    p_i <- sum_j W_ij [p_j + (g_i + g_j)/2 . x_ij] / sum_j W_ij

from p = s: a field with the gradient of the forces, and with the level of the stress in some spacings around.
"""

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.arrays import Floats, Vectors
from sim.core.launch import kernel
from sim.fluid.boundary import to_particle
from sim.fluid.kernels import Discretization, distance, slope_over_distance, spline, wall_share
from sim.fluid.particles import Fluid, ParticleSet

PASSES = 8  # means over neighbours, which reach two spacings or so in all


class MechanicalPressure:
    """Mechanical pressures of the particles, for who looks at them; no force is made of them."""

    def __init__(self, particles: ParticleSet, discretization: Discretization) -> None:
        self._particles = particles
        self._wall_share = wall_share(discretization.support_in_spacings)
        self._gradient = ti.Vector.ndarray(3, ti.f32, particles.capacity)
        self._pressure, self._next = (ti.ndarray(ti.f32, particles.capacity) for _ in range(2))

    def stress_of(self, fluid: Fluid, pressure_term: ti.Ndarray) -> NDArray[np.generic]:
        """s_i [Pa] for P_i [Pa] in the order of the particles, (n,), float32."""
        compute_stress(fluid, pressure_term, self._wall_share, self._pressure, self._gradient)
        return self._particles.host(self._pressure)

    def of(self, fluid: Fluid, pressure_term: ti.Ndarray) -> NDArray[np.generic]:
        """p_i [Pa] for P_i [Pa] in the order of the particles, (n,), float32."""
        self.stress_of(fluid, pressure_term)
        for _ in range(PASSES):
            average(fluid, self._gradient, self._pressure, self._next)
            self._pressure, self._next = self._next, self._pressure
        return self._particles.host(self._pressure)


@kernel
def compute_stress(fluid: Fluid, pressure: Floats, wall_share: ti.f32, stress: Floats, gradient: Vectors):
    """s_i and g_i."""
    particles, near, samples = ti.static((fluid.particles, fluid.near, fluid.samples))
    ti.loop_config(block_dim=128)
    for i in range(particles.count):
        x_i, pressure_i = particles.position[i], pressure[i]
        bonds, fluid_sum = 0.0, ti.math.vec3(0.0)
        first = near.start[i]
        for k in range(near.fluid_count[i]):
            j = near.indices[first + k * near.stride]
            x_ij = x_i - particles.position[j]
            force = (pressure_i + pressure[j]) * slope_over_distance(x_ij.norm_sqr(), fluid.inverse_support) * x_ij
            bonds += force.dot(x_ij)
            fluid_sum += force
        boundary_bonds, boundary_sum = 0.0, ti.math.vec3(0.0)
        first += near.fluid_count[i] * near.stride
        for k in range(near.boundary_count[i]):
            b = near.indices[first + k * near.stride]
            x_ib = to_particle(samples, b, x_i)
            force = samples.volume[b] * slope_over_distance(x_ib.norm_sqr(), fluid.inverse_support) * x_ib
            boundary_bonds += force.dot(x_ib)
            boundary_sum += force
        factor = fluid.sigma * fluid.inverse_support
        stress[i] = -factor / 3.0 * (0.5 * fluid.volume * bonds + wall_share * pressure_i * boundary_bonds)
        gradient[i] = factor * (fluid.volume * fluid_sum + pressure_i * boundary_sum)


@kernel
def average(fluid: Fluid, gradient: Vectors, values: Floats, field: Floats):
    """Means of what the values of a particle and its neighbours are here by the gradient, weighted by the kernel."""
    particles, near = ti.static((fluid.particles, fluid.near))
    ti.loop_config(block_dim=128)
    for i in range(particles.count):
        x_i, g_i = particles.position[i], gradient[i]
        total, weight = values[i], 1.0  # w(0): the particle itself
        first = near.start[i]
        for k in range(near.fluid_count[i]):
            j = near.indices[first + k * near.stride]
            x_ij = x_i - particles.position[j]
            w = spline(distance(x_ij.norm_sqr()) * fluid.inverse_support)
            total += w * (values[j] + 0.5 * (g_i + gradient[j]).dot(x_ij))
            weight += w
        field[i] = total / weight
