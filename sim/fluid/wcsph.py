"""Weakly compressible SPH (Becker & Teschner 2007) with the boundaries of Akinci et al. 2012."""

import math
from typing import Any

import numpy as np
import taichi as ti

from sim.arrays import Floats, Integers, Vectors
from sim.fluid.forces import SPHFluid
from sim.fluid.implicit_fluid import largest_eigenvalue
from sim.fluid.kernels import distance, spline
from sim.fluid.time_step import CFL_NUMBER, stable_time_step
from sim.fluid.viscosity import LAPLACIAN_FACTOR
from sim.launch import fast_launch
from sim.solver import Diagnostics

GAMMA = 7
"""Exponent of Tait's equation; the kernel multiplies it out."""

SPEED_RATIO = 10.0
"""Speed of sound over the largest expected speed: keeps compression near 1 % (Monaghan 1994)."""

RUNAWAY_RATIO = 3.0
"""Speeds beyond this multiple of the speed of sound are numerical, not physical."""


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
    is the derivative of the fluid's internal energy. With the second term walls feed energy into the fluid: a column
    at rest gained 1 J/kg within a second, whatever the time step.

    Momentum of fluid pairs is conserved to rounding; energy is not gained, but lost to viscosity and to the clamping
    of the pressure at 0.
    """

    speed_ratio = SPEED_RATIO

    def __init__(self, *args: Any, **keywords: Any) -> None:
        """Take particles, walls and bodies, as `ParticleFluid` does."""
        super().__init__(*args, **keywords)
        self.sound_speed = self.parameters.sound_speed or SPEED_RATIO * self._expected_speed
        self._stiffness = float(self.phases.rest_densities.max()) * self.sound_speed**2 / GAMMA
        self._pressure_terms = ti.ndarray(ti.f32, self._particles.capacity)
        self._frequency_squared = ti.ndarray(ti.f32, self._particles.capacity)
        self._frequency_ratio = math.sqrt(largest_eigenvalue(self.parameters.support_in_spacings))

    def stable_dt(self) -> float:
        """Largest time step [s] for the current state, or the fixed one that the parameters name."""
        if self.parameters.dt != "adaptive":
            return float(self.parameters.dt)
        artificial = self._artificial_viscosity / LAPLACIAN_FACTOR * max(1.0, self.parameters.wall_friction)
        # The pressure of the densest fluid pushes particles of the lightest one.
        sound_speed = self.sound_speed * math.sqrt(self.phases.density_contrast)
        limit = stable_time_step(
            spacing=self.spacing,
            signal_speed=sound_speed + max(self._motion.max_speed, self._boundary_speed),
            acceleration=self._motion.max_acceleration,
            viscosity=self._limiting_viscosity + artificial,
            cohesion_rate=self._cohesion_rate,
            pressure_frequency=self._frequency_ratio * self._motion.max_frequency,
            cfl=self.parameters.cfl,
        )
        return min(limit, self._emission.longest_step(self.parameters.cfl * CFL_NUMBER * self.spacing))

    def substep(self, dt: float) -> None:
        """Advance by dt [s]."""
        self._compute_density()
        self._begin_sheets()
        self._compute_acceleration(self._pressure_terms)
        self._react_on_bodies(self._pressure_terms, dt)
        self._apply_implicit_viscosity(self._acceleration, dt)
        self._advance_particles(self._acceleration, dt)

    @property
    def _pressure_slope(self) -> float:
        return self._stiffness * GAMMA

    @property
    def _pressure_term(self) -> ti.Ndarray:
        return self._pressure_terms

    @property
    def _signal_speed(self) -> float:
        return self.sound_speed

    @property
    def _runaway(self) -> tuple[float, str, float]:
        return RUNAWAY_RATIO, "the speed of sound", self.sound_speed

    def diagnostics(self) -> Diagnostics:
        """As for every particle fluid, with the elastic energy of the compression, V sum_i int p/r² dr [J]."""
        common = super().diagnostics()
        ratio = np.maximum(self._host(self._density)[self._by_id()].astype(np.float64), 1.0)
        per_volume = self._stiffness * ((ratio ** (GAMMA - 1) - 1.0) / (GAMMA - 1) + 1.0 / ratio - 1.0)
        return {
            **common,
            "elastic_energy": self.particle_volume * float(per_volume.sum()),
            "sound_speed": self.sound_speed,
        }

    def _compute_density(self) -> None:
        self._update_neighbors()
        particles = self._particles
        compute_density_and_pressure(
            particles.position, particles.count, *self._list, self.boundary.position, self.boundary.volume,
            self.particle_volume, self._sigma, 1.0 / self.support_radius, self._stiffness,
            self._density, self._pressure_terms,
        )  # fmt: skip


@fast_launch
@ti.kernel
def compute_density_and_pressure(
    position: Vectors, count: ti.i32,
    start: Integers, fluid_count: Integers, boundary_count: Integers, neighbors: Integers, stride: ti.template(),
    boundary_position: Vectors, boundary_volume: Floats,
    volume: ti.f32, sigma: ti.f32, inverse_support: ti.f32, stiffness: ti.f32,
    density: Floats, pressure_term: Floats,
):  # fmt: skip
    """rho_i/rho0 = sum_j V W_ij + sum_b V_b W_ib, and P_i by Tait's equation with p_i >= 0."""
    ti.loop_config(block_dim=128)
    for i in range(count):
        x_i = position[i]
        fluid_sum = 1.0  # w(0): the particle itself
        first = start[i]
        for k in range(fluid_count[i]):
            fluid_sum += spline(distance((x_i - position[neighbors[first + k * stride]]).norm_sqr()) * inverse_support)
        boundary_sum = 0.0
        first += fluid_count[i] * stride
        for k in range(boundary_count[i]):
            b = neighbors[first + k * stride]
            boundary_sum += boundary_volume[b] * spline(
                distance((x_i - boundary_position[b]).norm_sqr()) * inverse_support
            )
        ratio = sigma * (volume * fluid_sum + boundary_sum)
        ratio_3 = ratio * ratio * ratio
        p_i = ti.max(stiffness * (ratio_3 * ratio_3 * ratio - 1.0), 0.0)
        density[i] = ratio
        pressure_term[i] = p_i / (ratio * ratio)
