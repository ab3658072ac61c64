"""Weakly compressible SPH (Becker & Teschner 2007) with the boundaries of Akinci et al. 2012."""

import math
from typing import Any

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.cells import Cells, Floats, Integers, Vectors, cell_of_point, row_of_cell
from sim.fluid.kernels import spline, spline_slope
from sim.fluid.particle_fluid import ParticleFluid
from sim.fluid.surface_tension import cohesion_becker_teschner2007
from sim.fluid.time_step import stable_time_step
from sim.fluid.viscosity import LAPLACIAN_FACTOR, SOFTENING, pair_viscosity, viscous_factor
from sim.parameters import Vector3
from sim.scene import DomainParameters
from sim.solver import Diagnostics

GAMMA = 7
"""Exponent of Tait's equation; the kernel multiplies it out."""

SPEED_RATIO = 10.0
"""Speed of sound over the largest expected speed: keeps compression near 1 % (Monaghan 1994)."""

SLOWEST_EXPECTED_SPEED = 0.1
"""Where neither gravity nor an initial velocity says what to expect [m/s]."""

TINY_DISTANCE = 1.0e-12
"""Keeps x_ij/|x_ij| finite where two particles coincide; their force is then 0 [m]."""

COHESION_SPEED_FACTOR = 1.5
"""Square of the speed to expect from cohesion over kappa/d.

Cohesion pulls a filled lattice together with the stress rho kappa sigma/6 sum_j |x_ij|² w_ij = 0.15 rho kappa/d, which
at rest compresses it by 0.1 % at this factor. The collapse of a cube to a drop compresses it more: 1.7 % for 5³
particles, 1.1 % for 8³ and 0.9 % for 12³, whatever kappa; half of the factor doubles that.
"""

RUNAWAY_RATIO = 3.0
"""Speeds beyond this multiple of the speed of sound are numerical, not physical."""


class WCSPHSolver(ParticleFluid):
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

    def __init__(self, *args: Any, **keywords: Any) -> None:
        """Take particles, walls and bodies, as `ParticleFluid` does."""
        super().__init__(*args, **keywords)
        positions, velocities = self._host(self._particles.position), self._host(self._particles.velocity)
        self.sound_speed = self.parameters.sound_speed or expected_sound_speed(
            positions,
            velocities,
            keywords["domain"],
            self.gravity,
            surface_tension=max(fluid.surface_tension for fluid in self.phases.parameters),
            spacing=self.spacing,
        )
        self._stiffness = float(self.phases.rest_densities.max()) * self.sound_speed**2 / GAMMA
        self._pressure_term = ti.ndarray(ti.f32, self._particles.capacity)
        self._acceleration = ti.Vector.ndarray(3, ti.f32, self._particles.capacity)

    def stable_dt(self) -> float:
        """Largest time step [s] for the current state, or the fixed one that the parameters name."""
        if self.parameters.dt != "adaptive":
            return float(self.parameters.dt)
        viscosity = float(self.phases.viscosities.max()) + self._artificial_viscosity / LAPLACIAN_FACTOR
        # The pressure of the densest fluid pushes particles of the lightest one.
        sound_speed = self.sound_speed * math.sqrt(self.phases.density_contrast)
        return stable_time_step(
            spacing=self.spacing,
            signal_speed=sound_speed + max(self._motion.max_speed, self._boundary_speed),
            acceleration=self._motion.max_acceleration,
            viscosity=viscosity * max(1.0, self.parameters.wall_friction),
            cohesion_rate=max(fluid.surface_tension for fluid in self.phases.parameters) * self._sigma,
            cfl=self.parameters.cfl,
        )

    def substep(self, dt: float) -> None:
        """Advance by dt [s]."""
        self._compute_density()
        self._compute_acceleration()
        self._advance_particles(self._acceleration, dt)
        self._update_neighbors()

    @property
    def _artificial_viscosity(self) -> float:
        """alpha c_s h/2 [m²/s], which stands where 2 (d + 2) nu does."""
        return self.parameters.artificial_viscosity * self.sound_speed * self.support_radius / 2.0

    def _bad_motion(self) -> str | None:
        if self._motion.non_finite:
            return f"{self._motion.non_finite} particles with a position or velocity that is not finite"
        limit = RUNAWAY_RATIO * self.sound_speed
        if self._motion.max_speed > limit:
            return (
                f"speed {self._motion.max_speed:.4g} m/s, beyond {RUNAWAY_RATIO:g} times "
                f"the speed of sound {self.sound_speed:.4g} m/s"
            )
        return None

    def boundary_forces(self) -> NDArray[np.float32]:
        """Pressure force of the fluid on each fixed boundary sample, in the order they were given [N], (m, 3).

        The reaction to the pressure part of a_i, gathered per sample: f_b = sum_i V V_b P_i grad_i W_ib.
        Samples beyond the reach of the fluid's grid feel nothing.
        """
        self._compute_density()
        boundary = self.boundary
        forces = ti.Vector.ndarray(3, ti.f32, max(boundary.count, 1))
        gather_boundary_forces(
            boundary.position, boundary.volume, boundary.fixed_count,
            self._particles.cells.cell_start, ti.math.vec3(*self._grid.origin), 1.0 / self._grid.cell_size,
            Cells(*self._grid.shape),
            self._particles.position, self._pressure_term,
            self.particle_volume * self._sigma / self.support_radius, 1.0 / self.support_radius,
            forces,
        )  # fmt: skip
        result = np.zeros((boundary.given_count, 3), dtype=np.float32)
        result[boundary.index] = forces.to_numpy()[: boundary.fixed_count]
        return result

    def pressures(self) -> NDArray[np.float32]:
        """Pressure of each particle [Pa], (n,), by particle id."""
        self._compute_density()
        density, term = self._host(self._density), self._host(self._pressure_term)
        return (term * density**2)[self._by_id()]

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
        particles = self._particles
        compute_density_and_pressure(
            particles.position, particles.count, *self._list, self.boundary.position, self.boundary.volume,
            self.particle_volume, self._sigma, 1.0 / self.support_radius, self._stiffness,
            self._density, self._pressure_term,
        )  # fmt: skip

    def _compute_acceleration(self) -> None:
        particles, parameters, phases = self._particles, self.parameters, self.phases
        compute_acceleration(
            particles.position, particles.velocity, particles.phase, self._density, self._pressure_term,
            particles.count, *self._list,
            self.boundary.position, self.boundary.velocity, self.boundary.volume, self.boundary.moving_count > 0,
            phases.rest_density, phases.dynamic_viscosity, phases.surface_tension, len(phases) > 1,
            ti.math.vec3(*self.gravity), self.particle_volume, self._sigma, 1.0 / self.support_radius,
            SOFTENING * self.support_radius**2, self._artificial_viscosity,
            parameters.wall_friction, self.spacing, parameters.wall_friction > 0.0,
            any(fluid.surface_tension > 0.0 for fluid in phases.parameters), self._acceleration,
        )  # fmt: skip


def expected_sound_speed(
    positions: NDArray[np.floating],
    velocities: NDArray[np.floating],
    domain: DomainParameters,
    gravity: Vector3,
    *,
    surface_tension: float,
    spacing: float,
) -> float:
    """Ten times the largest speed to expect [m/s].

    That is the initial one with a fall from the highest particle to the bottom, the corner of the domain that lies
    deepest along gravity; or what cohesion, `surface_tension` kappa [m³/s²], asks for at this `spacing` d [m].
    """
    g = np.asarray(gravity, dtype=np.float64)
    strength = float(np.linalg.norm(g))
    height = 0.0
    if strength > 0.0 and len(positions):
        corners = np.stack(np.meshgrid(*zip(domain.min, domain.max, strict=True)), axis=-1).reshape(-1, 3)
        down = g / strength
        height = float((corners @ down).max() - (np.asarray(positions, dtype=np.float64) @ down).min())
    initial = float((np.asarray(velocities, dtype=np.float64) ** 2).sum(axis=1).max(initial=0.0))
    fall = math.sqrt(initial + 2.0 * strength * max(height, 0.0))
    cohesion = math.sqrt(COHESION_SPEED_FACTOR * surface_tension / spacing)
    return SPEED_RATIO * max(fall, cohesion, SLOWEST_EXPECTED_SPEED)


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
            fluid_sum += spline((x_i - position[neighbors[first + k * stride]]).norm() * inverse_support)
        boundary_sum = 0.0
        first += fluid_count[i] * stride
        for k in range(boundary_count[i]):
            b = neighbors[first + k * stride]
            boundary_sum += boundary_volume[b] * spline((x_i - boundary_position[b]).norm() * inverse_support)
        ratio = sigma * (volume * fluid_sum + boundary_sum)
        ratio_3 = ratio * ratio * ratio
        p_i = ti.max(stiffness * (ratio_3 * ratio_3 * ratio - 1.0), 0.0)
        density[i] = ratio
        pressure_term[i] = p_i / (ratio * ratio)


@ti.kernel
def compute_acceleration(
    position: Vectors, velocity: Vectors, phase: Integers, density: Floats, pressure_term: Floats, count: ti.i32,
    start: Integers, fluid_count: Integers, boundary_count: Integers, neighbors: Integers, stride: ti.template(),
    boundary_position: Vectors, boundary_velocity: Vectors, boundary_volume: Floats, with_moving: ti.template(),
    rest_density: Floats, dynamic_viscosity: Floats, surface_tension: Floats, several: ti.template(),
    gravity: ti.math.vec3, volume: ti.f32, sigma: ti.f32, inverse_support: ti.f32,
    softening: ti.f32, artificial: ti.f32, wall_friction: ti.f32, spacing: ti.f32,
    with_wall_friction: ti.template(), with_cohesion: ti.template(), acceleration: Vectors,
):  # fmt: skip
    """All accelerations in one pass over the neighbours; the terms stand at the solver."""
    gradient_factor = sigma * inverse_support
    ti.loop_config(block_dim=128)
    for i in range(count):
        x_i, v_i, rho_i, pressure_i = position[i], velocity[i], density[i], pressure_term[i]
        own = 0
        if ti.static(several):
            own = phase[i]
        rho0, mu = rest_density[own], LAPLACIAN_FACTOR * dynamic_viscosity[own]
        fluid_sum = ti.math.vec3(0.0)
        cohesion_sum = ti.math.vec3(0.0)
        first = start[i]
        for k in range(fluid_count[i]):
            j = neighbors[first + k * stride]
            x_ij = x_i - position[j]
            r_squared = x_ij.norm_sqr()
            r = ti.sqrt(r_squared)
            v_dot_x = (v_i - velocity[j]).dot(x_ij)
            mu_ij, rho0_ij, alike = mu, rho0, 1.0
            if ti.static(several):
                other = phase[j]
                alike = ti.cast(other == own, ti.f32)
                mu_ij = pair_viscosity(mu, LAPLACIAN_FACTOR * dynamic_viscosity[other])
                rho0_ij = 0.5 * (rho0 + rest_density[other])
            viscous = viscous_factor(v_dot_x, r_squared, softening, mu_ij, artificial * rho0_ij)
            scale = 2.0 * viscous / (rho_i + density[j]) - pressure_i - pressure_term[j]
            fluid_sum += scale * spline_slope(r * inverse_support) / (r + TINY_DISTANCE) * x_ij
            if ti.static(with_cohesion):
                cohesion_sum += alike * cohesion_becker_teschner2007(r, inverse_support, spacing) * x_ij
        boundary_sum = ti.math.vec3(0.0)
        first += fluid_count[i] * stride
        for k in range(boundary_count[i]):
            b = neighbors[first + k * stride]
            x_ib = x_i - boundary_position[b]
            r_squared = x_ib.norm_sqr()
            r = ti.sqrt(r_squared)
            scale = -pressure_i
            if ti.static(with_wall_friction):
                v_ib = v_i
                if ti.static(with_moving):
                    v_ib -= boundary_velocity[b]
                viscous = viscous_factor(v_ib.dot(x_ib), r_squared, softening, mu, artificial * rho0)
                scale += wall_friction * viscous / rho_i
            boundary_sum += boundary_volume[b] * scale * spline_slope(r * inverse_support) / (r + TINY_DISTANCE) * x_ib
        a_i = gravity + gradient_factor / rho0 * (volume * fluid_sum + boundary_sum)
        if ti.static(with_cohesion):
            a_i -= surface_tension[own] * sigma * cohesion_sum
        acceleration[i] = a_i


@ti.kernel
def gather_boundary_forces(
    boundary_position: Vectors, boundary_volume: Floats, boundary_count: ti.i32,
    cell_start: Integers, origin: ti.math.vec3, inverse_cell_size: ti.f32, shape: Cells,
    position: Vectors, pressure_term: Floats,
    volume_gradient_factor: ti.f32, inverse_support: ti.f32, force: Vectors,
):  # fmt: skip
    """Reaction to the pressure acceleration that each sample causes, summed in the order of the sorted particles."""
    for b in range(boundary_count):
        x_b = boundary_position[b]
        cell = cell_of_point(x_b, origin, inverse_cell_size, shape)
        total = ti.math.vec3(0.0)
        for dz in range(-1, 2):
            for dy in range(-1, 2):
                row = row_of_cell(cell, dy, dz, shape)
                for i in range(cell_start[row - 1], cell_start[row + 2]):
                    x_ib = position[i] - x_b
                    r = x_ib.norm()
                    total += pressure_term[i] * spline_slope(r * inverse_support) / (r + TINY_DISTANCE) * x_ib
        force[b] = volume_gradient_factor * boundary_volume[b] * total
