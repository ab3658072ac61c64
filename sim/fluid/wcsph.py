"""Weakly compressible SPH (Becker & Teschner 2007) with the boundaries of Akinci et al. 2012."""

import math

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.fluid.boundary_akinci2012 import BoundarySamples
from sim.fluid.kernels import normalization, spline, spline_slope
from sim.fluid.parameters import FluidParameters
from sim.fluid.particle_fluid import ParticleFluid
from sim.fluid.surface_tension import cohesion_becker_teschner2007
from sim.fluid.time_step import stable_time_step
from sim.fluid.viscosity import LAPLACIAN_FACTOR, SOFTENING, viscous_factor
from sim.neighbors import Cells, Floats, Integers, Vectors, cell_of_point, row_of_cell
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

    rho_i = sum_j m W_ij + sum_b Psi_b W_ib
    p_i = max(0, B ((rho_i/rho0)^7 - 1)), B = rho0 c_s²/7
    a_i = g - sum_j m (p_i/rho_i² + p_j/rho_j²) grad W_ij - sum_b Psi_b p_i/rho_i² grad W_ib + viscosity + cohesion
    v_i += dt a_i, x_i += dt v_i

    The force of a boundary sample (Akinci et al. 2012, eq. 9) has no mirrored second term p_i/rho0²: only this form
    is the derivative of the fluid's internal energy. With the second term walls feed energy into the fluid: a column
    at rest gained 1 J/kg within a second, whatever the time step.

    Momentum of fluid pairs is conserved to rounding; energy is not gained, but lost to viscosity and to the clamping
    of the pressure at 0. Unsupported: moving boundaries, several fluids.

    Args:
        parameters: the fluid.
        domain: the box it lives in.
        gravity: acceleration [m/s²].
        positions: particles [m], (n, 3), float32.
        velocities: their velocities [m/s], (n, 3), float32.
        boundary: samples of walls and bodies.

    Raises:
        ValueError: arrays of the wrong shape, not finite, or with particles outside the domain.
    """

    def __init__(
        self,
        parameters: FluidParameters,
        *,
        domain: DomainParameters,
        gravity: Vector3,
        positions: NDArray[np.float32],
        velocities: NDArray[np.float32],
        boundary: BoundarySamples,
    ) -> None:
        super().__init__(
            parameters,
            domain=domain,
            gravity=gravity,
            positions=positions,
            velocities=velocities,
            boundary=boundary,
        )
        self.sound_speed = parameters.sound_speed or expected_sound_speed(
            positions,
            velocities,
            domain,
            gravity,
            surface_tension=parameters.surface_tension,
            spacing=self.spacing,
        )
        self._pressure_term = ti.ndarray(ti.f32, self._particles.capacity)
        self._acceleration = ti.Vector.ndarray(3, ti.f32, self._particles.capacity)

    def stable_dt(self) -> float:
        """Largest time step [s] for the current state, or the fixed one that the parameters name."""
        if self.parameters.dt != "adaptive":
            return float(self.parameters.dt)
        viscosity = self.parameters.viscosity + self._artificial_viscosity / LAPLACIAN_FACTOR
        return stable_time_step(
            spacing=self.spacing,
            signal_speed=self.sound_speed + self._motion.max_speed,
            acceleration=self._motion.max_acceleration,
            viscosity=viscosity * max(1.0, self.parameters.wall_friction),
            cohesion_rate=self.parameters.surface_tension * normalization(self.support_radius),
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
        """Pressure force of the fluid on each boundary sample, in the order they were given [N], (m, 3).

        The reaction to the pressure part of a_i, gathered per sample: f_b = sum_i m Psi_b p_i/rho_i² grad_i W_ib.
        Samples beyond the reach of the fluid's grid feel nothing.
        """
        self._compute_density()
        forces = ti.Vector.ndarray(3, ti.f32, max(self.boundary.count, 1))
        sigma = normalization(self.support_radius)
        gather_boundary_forces(
            self.boundary.position, self.boundary.psi, self.boundary.count,
            self._particles.cells.cell_start, ti.math.vec3(*self._grid.origin), 1.0 / self._grid.cell_size,
            Cells(*self._grid.shape),
            self._particles.position, self._pressure_term,
            self.particle_mass * sigma / self.support_radius, 1.0 / self.support_radius,
            forces,
        )  # fmt: skip
        result = np.zeros((self.boundary.given_count, 3), dtype=np.float32)
        result[self.boundary.index] = forces.to_numpy()[: self.boundary.count]
        return result

    def pressures(self) -> NDArray[np.float32]:
        """Pressure of each particle [Pa], (n,), by particle id."""
        self._compute_density()
        density, term = self._host(self._density), self._host(self._pressure_term)
        return (term * density**2)[self._by_id()]

    def diagnostics(self) -> Diagnostics:
        """As for every particle fluid, with the elastic energy of the compression, m sum_i int p/rho² drho [J]."""
        common = super().diagnostics()
        ratio = np.maximum(self._host(self._density)[self._by_id()] / np.float64(self.parameters.rest_density), 1.0)
        per_mass = self.sound_speed**2 / GAMMA * ((ratio ** (GAMMA - 1) - 1.0) / (GAMMA - 1) + 1.0 / ratio - 1.0)
        return {
            **common,
            "elastic_energy": self.particle_mass * float(per_mass.sum()),
            "sound_speed": self.sound_speed,
        }

    def _compute_density(self) -> None:
        particles = self._particles
        rest_density = self.parameters.rest_density
        compute_density_and_pressure(
            particles.position, particles.count, particles.neighbors.start, particles.neighbors.boundary_start,
            particles.neighbors.end, particles.neighbors.indices, self.boundary.position, self.boundary.psi,
            self.particle_mass, normalization(self.support_radius), 1.0 / self.support_radius,
            rest_density, rest_density * self.sound_speed**2 / GAMMA, self._density, self._pressure_term,
        )  # fmt: skip

    def _compute_acceleration(self) -> None:
        particles, parameters = self._particles, self.parameters
        compute_acceleration(
            particles.position, particles.velocity, self._density, self._pressure_term, particles.count,
            particles.neighbors.start, particles.neighbors.boundary_start, particles.neighbors.end,
            particles.neighbors.indices,
            self.boundary.position, self.boundary.psi, ti.math.vec3(*self.gravity),
            self.particle_mass, normalization(self.support_radius), 1.0 / self.support_radius,
            SOFTENING * self.support_radius**2,
            LAPLACIAN_FACTOR * parameters.viscosity,
            self._artificial_viscosity,
            parameters.wall_friction, parameters.surface_tension, self.spacing,
            parameters.wall_friction > 0.0, parameters.surface_tension > 0.0, self._acceleration,
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
    position: Vectors, count: ti.i32, start: Integers, boundary_start: Integers, end: Integers, neighbors: Integers,
    boundary_position: Vectors, boundary_psi: Floats,
    mass: ti.f32, sigma: ti.f32, inverse_support: ti.f32, rest_density: ti.f32, stiffness: ti.f32,
    density: Floats, pressure_term: Floats,
):  # fmt: skip
    """rho_i = sum_j m W_ij + sum_b Psi_b W_ib, and p_i/rho_i² by Tait's equation with p_i >= 0."""
    ti.loop_config(block_dim=256)
    for i in range(count):
        x_i = position[i]
        fluid_sum = 1.0  # w(0): the particle itself
        for k in range(start[i], boundary_start[i]):
            fluid_sum += spline((x_i - position[neighbors[k]]).norm() * inverse_support)
        boundary_sum = 0.0
        for k in range(boundary_start[i], end[i]):
            b = neighbors[k]
            boundary_sum += boundary_psi[b] * spline((x_i - boundary_position[b]).norm() * inverse_support)
        rho_i = sigma * (mass * fluid_sum + boundary_sum)
        ratio = rho_i / rest_density
        ratio_3 = ratio * ratio * ratio
        p_i = ti.max(stiffness * (ratio_3 * ratio_3 * ratio - 1.0), 0.0)
        density[i] = rho_i
        pressure_term[i] = p_i / (rho_i * rho_i)


@ti.kernel
def compute_acceleration(
    position: Vectors, velocity: Vectors, density: Floats, pressure_term: Floats, count: ti.i32,
    start: Integers, boundary_start: Integers, end: Integers, neighbors: Integers,
    boundary_position: Vectors, boundary_psi: Floats, gravity: ti.math.vec3,
    mass: ti.f32, sigma: ti.f32, inverse_support: ti.f32,
    softening: ti.f32, nu: ti.f32, artificial: ti.f32, wall_friction: ti.f32, cohesion: ti.f32, spacing: ti.f32,
    with_wall_friction: ti.template(), with_cohesion: ti.template(), acceleration: Vectors,
):  # fmt: skip
    """All accelerations in one pass over the neighbours; the terms stand at the solver."""
    gradient_factor = sigma * inverse_support
    ti.loop_config(block_dim=256)
    for i in range(count):
        x_i, v_i, rho_i, pressure_i = position[i], velocity[i], density[i], pressure_term[i]
        fluid_sum = ti.math.vec3(0.0)
        cohesion_sum = ti.math.vec3(0.0)
        for k in range(start[i], boundary_start[i]):
            j = neighbors[k]
            x_ij = x_i - position[j]
            r_squared = x_ij.norm_sqr()
            r = ti.sqrt(r_squared)
            v_dot_x = (v_i - velocity[j]).dot(x_ij)
            viscous = viscous_factor(v_dot_x, r_squared, softening, nu, artificial)
            scale = 2.0 * viscous / (rho_i + density[j]) - pressure_i - pressure_term[j]
            fluid_sum += scale * spline_slope(r * inverse_support) / (r + TINY_DISTANCE) * x_ij
            if ti.static(with_cohesion):
                cohesion_sum += cohesion_becker_teschner2007(r, inverse_support, spacing) * x_ij
        boundary_sum = ti.math.vec3(0.0)
        for k in range(boundary_start[i], end[i]):
            b = neighbors[k]
            x_ib = x_i - boundary_position[b]
            r_squared = x_ib.norm_sqr()
            r = ti.sqrt(r_squared)
            scale = -pressure_i
            if ti.static(with_wall_friction):
                viscous = viscous_factor(v_i.dot(x_ib), r_squared, softening, nu, artificial)
                scale += wall_friction * viscous / rho_i
            boundary_sum += boundary_psi[b] * scale * spline_slope(r * inverse_support) / (r + TINY_DISTANCE) * x_ib
        a_i = gravity + gradient_factor * (mass * fluid_sum + boundary_sum)
        if ti.static(with_cohesion):
            a_i -= cohesion * sigma * cohesion_sum
        acceleration[i] = a_i


@ti.kernel
def gather_boundary_forces(
    boundary_position: Vectors, boundary_psi: Floats, boundary_count: ti.i32,
    cell_start: Integers, origin: ti.math.vec3, inverse_cell_size: ti.f32, shape: Cells,
    position: Vectors, pressure_term: Floats,
    mass_gradient_factor: ti.f32, inverse_support: ti.f32, force: Vectors,
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
        force[b] = mass_gradient_factor * boundary_psi[b] * total
