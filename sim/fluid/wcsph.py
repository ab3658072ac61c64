"""Weakly compressible SPH (Becker & Teschner 2007) with the boundaries of Akinci et al. 2012."""

import math

import numpy as np
import taichi as ti

from sim.core.arrays import Floats
from sim.core.launch import kernel
from sim.core.solver import Diagnostics
from sim.fluid.boundary import to_particle
from sim.fluid.fluid import SPHFluid
from sim.fluid.forces import Elastic
from sim.fluid.kernels import distance, spline
from sim.fluid.particles import Fluid
from sim.fluid.pressure import largest_eigenvalue
from sim.fluid.tank import FluidStart
from sim.fluid.traits import CFL_NUMBER, TRAITS, stable_time_step

GAMMA = 7  # exponent of Tait's equation; the kernel multiplies it out


class WCSPHSolver(SPHFluid):
    """A fluid of particles whose pressure follows its density, stepped by symplectic Euler.

    rho_i/rho0 = sum_j V W_ij + sum_b V_b W_ib
    p_i = max(0, B ((rho_i/rho0)^7 - 1)), B = rho0 c_s²/7, and P_i = p_i/(rho_i/rho0)²
    a_i = g - 1/rho0 [sum_j V (P_i + P_j) grad W_ij + sum_b V_b P_i grad W_ib] + viscosity + cohesion
    v_i += dt a_i, x_i += dt v_i

    In one fluid these are the usual equations with m = rho0 V and Psi_b = rho0 V_b. Several fluids share B, that of the
    densest, so that all of them are compressed alike; the pair forces V² (P_i + P_j) grad W_ij are equal and opposite
    whatever the densities.

    The force of a boundary sample (Akinci et al. 2012, eq. 9) has no mirrored second term p_i/rho0²: only this form
    is the derivative of the fluid's internal energy. Momentum of fluid pairs is conserved to rounding; energy is lost
    to viscosity and to the clamping of the pressure at 0.

    Attributes:
        elastic: pressures of the present positions.
        frequency_ratio: frequency of the stiffest swing of many particles over that of one against its own pressure.
    """

    speed_ratio = TRAITS["wcsph"].speed_ratio
    runaway = 3.0, "the speed of sound"

    def __init__(self, start: FluidStart) -> None:
        """Take particles, walls and bodies."""
        super().__init__(start)
        self._stiffness = float(self.phases.rest_densities.max()) * self.sound_speed**2 / GAMMA
        terms, frequencies = (ti.ndarray(ti.f32, self.particles.capacity) for _ in range(2))
        self.elastic = Elastic(terms, frequencies, self._stiffness * GAMMA, True)
        self.frequency_ratio = math.sqrt(largest_eigenvalue(self.discretization.support_in_spacings))

    def substep(self, dt: float) -> None:
        """Advance by dt [s]."""
        self.compute_density()
        self.forces.begin_sheets()
        self.forces.compute(dt, self.elastic)
        self.advance(dt, self.elastic.frequency_squared)

    def compute_density(self) -> None:
        """Relative density of each particle by summation, and its pressure by Tait's equation."""
        self.tank.update_neighbors()
        compute_density_and_pressure(self.tank.on_device, self._stiffness, self.elastic.pressure_term)

    def adapt_time_step(self) -> float:
        """Largest time step [s] for the current state."""
        motion, cfl = self.tank.motion, self.parameters.cfl
        # The pressure of the densest fluid pushes particles of the lightest one.
        sound_speed = self.sound_speed * math.sqrt(self.phases.density_contrast)
        limit = stable_time_step(
            spacing=self.spacing,
            signal_speed=sound_speed + max(motion.max_speed, self.tank.boundary_speed),
            acceleration=motion.max_acceleration,
            viscosity=self.limiting_viscosity,
            cohesion_rate=self.cohesion.rate,
            pressure_frequency=self.frequency_ratio * motion.max_frequency,
            cfl=cfl,
        )
        return min(limit, self.tank.emission.longest_step(cfl * CFL_NUMBER * self.spacing))

    @property
    def sound_speed(self) -> float:
        """Numerical speed of sound [m/s]."""
        return self.signal_speed

    @property
    def pressure_term(self) -> ti.Ndarray:
        """P_i = p_i/(rho_i/rho0)² of each particle [Pa]."""
        return self.elastic.pressure_term

    def diagnostics(self) -> Diagnostics:
        """As for every particle fluid, with the elastic energy of the compression, V sum_i int p/r² dr [J]."""
        common, particles = super().diagnostics(), self.particles
        ratio = np.maximum(particles.host(particles.density)[particles.order_by_id()].astype(np.float64), 1.0)
        per_volume = self._stiffness * ((ratio ** (GAMMA - 1) - 1.0) / (GAMMA - 1) + 1.0 / ratio - 1.0)
        return {
            **common,
            "elastic_energy": self.particle_volume * float(per_volume.sum()),
            "sound_speed": self.sound_speed,
        }


@kernel
def compute_density_and_pressure(fluid: Fluid, stiffness: ti.f32, pressure_term: Floats):
    """rho_i/rho0 = sum_j V W_ij + sum_b V_b W_ib, and P_i by Tait's equation with p_i >= 0."""
    ti.loop_config(block_dim=128)
    for i in range(fluid.particles.count):
        x_i = fluid.particles.position[i]
        fluid_sum = 1.0  # w(0): the particle itself
        first = fluid.near.start[i]
        for k in range(fluid.near.fluid_count[i]):
            x_j = fluid.particles.position[fluid.near.indices[first + k * fluid.near.stride]]
            fluid_sum += spline(distance((x_i - x_j).norm_sqr()) * fluid.inverse_support)
        boundary_sum = 0.0
        first += fluid.near.fluid_count[i] * fluid.near.stride
        for k in range(fluid.near.boundary_count[i]):
            b = fluid.near.indices[first + k * fluid.near.stride]
            r = distance(to_particle(fluid.samples, b, x_i).norm_sqr())
            boundary_sum += fluid.samples.volume[b] * spline(r * fluid.inverse_support)
        ratio = fluid.sigma * (fluid.volume * fluid_sum + boundary_sum)
        ratio_3 = ratio * ratio * ratio
        p_i = ti.max(stiffness * (ratio_3 * ratio_3 * ratio - 1.0), 0.0)
        fluid.particles.density[i] = ratio
        pressure_term[i] = p_i / (ratio * ratio)
