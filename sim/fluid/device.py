"""A fluid as kernels read it."""

from typing import NamedTuple

import taichi as ti

from sim.core.bundles import bundle
from sim.core.neighbors import Neighbors
from sim.fluid.boundary import Samples
from sim.fluid.particles import Particles
from sim.fluid.phases import Materials


@bundle
class Fluid(NamedTuple):
    """Particles with their neighbours, and the kernel over them: what sums over neighbours read."""

    particles: Particles
    near: Neighbors
    samples: Samples  # of the boundary
    materials: Materials
    volume: ti.f32  # V of a particle [m³]
    sigma: ti.f32  # factor of the kernel, 8/(pi h³) [1/m³]
    inverse_support: ti.f32  # 1/h [1/m]
