"""Forces on the particles of every SPH solver: gravity, viscosity, cohesion, and pressure once it is known."""

from abc import abstractmethod
from dataclasses import replace
from typing import Any

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.arrays import Floats, Integers, Vectors
from sim.cells import Cells, cell_of_point, row_of_cell
from sim.fluid.kernels import inverse_distance, spline_slope
from sim.fluid.material_fluid import MaterialFluid
from sim.fluid.sheet_forces import DENSITY, SheetForces
from sim.fluid.sheet_samples import SheetSamples
from sim.fluid.surface_tension import cohesion_becker_teschner2007
from sim.fluid.viscosity import LAPLACIAN_FACTOR, SOFTENING, pair_viscosity, viscous_factor
from sim.launch import fast_launch
from sim.solver import Arrays


class SPHFluid(MaterialFluid):
    """A particle fluid with the forces that do not depend on how its pressure is found.

    a_i = g - 1/rho0 [sum_j V (P_i + P_j) grad W_ij + sum_b V_b P_i grad W_ib] + viscosity + cohesion

    with P = p/(rho/rho0)², Monaghan's viscosity (`sim.fluid.viscosity`) and the cohesion of Becker & Teschner 2007.
    """

    _pressure_slope = 0.0
    """dp/d(rho/rho0) at rest density [Pa], where pressure follows the density."""

    sheets_answer = False
    """Whether sheets answer to pressures that are tried within a step."""

    def __init__(self, *args: Any, sheets: SheetSamples | None = None, **keywords: Any) -> None:
        """Take particles, walls and bodies, as `ParticleFluid` does, and sheets."""
        super().__init__(*args, sheets=None if sheets is None else sheets.boundary, **keywords)
        self._acceleration = ti.Vector.ndarray(3, ti.f32, self._particles.capacity)
        if sheets is not None:
            self.body_forces.sheets = SheetForces(
                self.boundary, sheets, gravity=self.gravity, capacity=self.capacity, spacing=self.spacing,
                support_in_spacings=self.parameters.support_in_spacings, answers=self.sheets_answer,
            )  # fmt: skip

    def checkpoint(self) -> dict[str, NDArray[np.generic]]:
        """As of every particle fluid, with what it expects of sheets."""
        sheets = self.body_forces.sheets
        return {**super().checkpoint(), **({} if sheets is None else sheets.checkpoint())}

    def restore(self, arrays: Arrays) -> None:
        """Continue from a checkpoint bit for bit.

        Raises:
            ValueError: the arrays are not a checkpoint of this fluid.
        """
        super().restore(arrays)
        if self.body_forces.sheets is not None:
            self.body_forces.sheets.restore(arrays)

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
            Cells(*self._grid.shape), self._grid.reach,
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
        return self._pressures()[self._by_id()]

    def _pressures(self) -> NDArray[np.float32]:
        density, term = self._host(self._density), self._host(self._pressure_term)
        return (term * density**2).astype(np.float32)

    @property
    @abstractmethod
    def _pressure_term(self) -> ti.Ndarray:
        """P_i = p_i/(rho_i/rho0)² of each particle [Pa]."""

    @property
    @abstractmethod
    def _signal_speed(self) -> float:
        """Speed c in the artificial viscosity [m/s]."""

    @property
    def _artificial_viscosity(self) -> float:
        """alpha c h/2 [m²/s], which stands where 2 (d + 2) nu does."""
        return self.parameters.artificial_viscosity * self._signal_speed * self.support_radius / 2.0

    def _compute_acceleration(self, pressure_term: ti.Ndarray | None) -> None:
        """Fill `_acceleration` with gravity, viscosity, cohesion and, where its term P is given, pressure."""
        particles, parameters, phases = self._particles, self.parameters, self.phases
        assert pressure_term is None or self._frequency_squared is not None
        compute_acceleration(
            particles.position, particles.velocity, particles.phase, self._density,
            self._density if pressure_term is None else pressure_term,
            particles.count, *self._list,
            self.boundary.position, self.boundary.velocity, self.boundary.volume, self.boundary.friction_volume,
            self.boundary.moving_count > 0,
            phases.rest_density, self._explicit_viscosity, phases.surface_tension, len(phases) > 1,
            self.gravity, self.particle_volume, self._sigma, 1.0 / self.support_radius,
            pressure_term is not None, self._pressure_slope,
            SOFTENING * self.support_radius**2, self._artificial_viscosity,
            parameters.wall_friction, self.spacing, parameters.wall_friction > 0.0,
            self._with_kappa, self._acceleration,
            self._density if self._frequency_squared is None else self._frequency_squared,
        )  # fmt: skip
        self._add_surface_tension(self._acceleration)

    def _begin_sheets(self) -> None:
        """Find the fluid that touches sheets at the start of a step, before anything acts between them."""
        if self.body_forces.sheets is not None:
            self.body_forces.sheets.begin_step(self.body_forces.near, self._sheet_terms, self._particles.count)

    def _recoil_sheets(self, solve: int, dt: float) -> None:
        """Push the sheets' samples by the opposite of what acted on them in this solve of the last step."""
        if self.body_forces.sheets is not None:
            self.body_forces.sheets.begin_solve(solve)
            self.body_forces.sheets.recoil(dt)

    def sheets_moved(self, way: float, speed: float, *, elapsed_s: float) -> None:
        """Take note that the samples of sheets were placed anew.

        Args:
            way: how far any of them got at most [m].
            speed: the largest of them [m/s].
            elapsed_s: time since they were placed last [s]; 0 where they are put there anew.
        """
        self._boundary_travelled += way
        self._sheet_speed = speed
        self._without_neighbors |= elapsed_s == 0.0

    def take_sheet_motion(self, change: ti.Ndarray, largest_change: float, dt: float) -> None:
        """Let the fluid that touched sheets in the last step move along with them.

        Args:
            change: what the velocity of each sample of a sheet differs by from what the last step took it for [m/s].
            largest_change: norm of the largest of them [m/s].
            dt: that step [s].
        """
        sheets = self.body_forces.sheets
        assert sheets is not None
        sheets.take_motion(self._sheet_terms, self._particles.velocity, change, dt, walls=self._stepper.box.walls)
        self._travelled += dt * largest_change
        self._motion = replace(self._motion, max_speed=self._motion.max_speed + largest_change)

    def _react_on_bodies(self, pressure_term: ti.Ndarray | None, dt: float, *, with_friction: bool = True) -> None:
        """Count what the particles feel from moving bodies as impulses on these, for a step of dt [s].

        Call it with the positions and velocities that the particles felt it at. `with_friction` is False where
        friction was counted before, in the first call of the step. There, bodies that answer within the step begin to
        fall, as the particles do by `_compute_acceleration`.
        """
        sheets = self.body_forces.sheets
        if with_friction and sheets is not None:
            sheets.begin_solve(DENSITY)
        if pressure_term is not None or self.parameters.wall_friction > 0.0:
            self.body_forces.gather(*self._body_force_terms(pressure_term, with_friction=with_friction), dt=dt)
        # After the gathering: the particles felt friction against samples that had not begun to fall or recoil.
        if with_friction and self.body_forces.response is not None:
            self.body_forces.response.fall(dt)
        if with_friction and sheets is not None:
            sheets.recoil(dt)
            sheets.add_missing_weight(self.body_forces.near, self._sheet_terms, dt)

    @property
    def _sheet_terms(self) -> tuple[Any, ...]:
        """What `SheetForces` takes of the particles."""
        return self._particles.position, self._particles.phase, *self._list, self.phases.rest_density

    def _body_force_terms(self, pressure_term: ti.Ndarray | None, *, with_friction: bool) -> tuple[Any, ...]:
        """What the forces on bodies by pressure, by friction or by both are made of (`gather_sample_forces`)."""
        particles, phases = self._particles, self.phases
        return (
            particles.position, particles.velocity, particles.phase, self._density,
            self._density if pressure_term is None else pressure_term,
            phases.rest_density, self._explicit_viscosity,
            self.particle_volume * self._sigma / self.support_radius, 1.0 / self.support_radius,
            SOFTENING * self.support_radius**2, self._artificial_viscosity, self.parameters.wall_friction,
            pressure_term is not None, with_friction and self.parameters.wall_friction > 0.0,
        )  # fmt: skip


@fast_launch
@ti.kernel
def compute_acceleration(
    position: Vectors, velocity: Vectors, phase: Integers, density: Floats, pressure_term: Floats, count: ti.i32,
    start: Integers, fluid_count: Integers, boundary_count: Integers, neighbors: Integers, stride: ti.template(),
    boundary_position: Vectors, boundary_velocity: Vectors, boundary_volume: Floats, friction_volume: Floats,
    with_moving: ti.template(),
    rest_density: Floats, dynamic_viscosity: Floats, surface_tension: Floats, several: ti.template(),
    gravity: ti.math.vec3, volume: ti.f32, sigma: ti.f32, inverse_support: ti.f32, with_pressure: ti.template(),
    pressure_slope: ti.f32, softening: ti.f32, artificial: ti.f32, wall_friction: ti.f32, spacing: ti.f32,
    with_wall_friction: ti.template(), with_cohesion: ti.template(), acceleration: Vectors, frequency_squared: Floats,
):  # fmt: skip
    """All accelerations in one pass over the neighbours, or all but that by pressure; the terms stand at the solver.

    With pressure also the square of the frequency at which a particle would swing against the pressures that its own
    displacement makes, dp/d(rho/rho0) A_ii with A_ii as in `sim.fluid.pressure_kernels`: high where a particle is
    squeezed, or close to boundary samples. `pressure_slope` is dp/d(rho/rho0) at rest density [Pa].
    """
    gradient_factor = sigma * inverse_support
    ti.loop_config(block_dim=128)
    for i in range(count):
        x_i, v_i, rho_i = position[i], velocity[i], density[i]
        pressure_i = 0.0
        if ti.static(with_pressure):
            pressure_i = pressure_term[i]
        own = 0
        if ti.static(several):
            own = phase[i]
        rho0, mu = rest_density[own], LAPLACIAN_FACTOR * dynamic_viscosity[own]
        fluid_sum = ti.math.vec3(0.0)
        gradient_sum = ti.math.vec3(0.0)
        square_sum = 0.0
        cohesion_sum = ti.math.vec3(0.0)
        first = start[i]
        for k in range(fluid_count[i]):
            j = neighbors[first + k * stride]
            x_ij = x_i - position[j]
            r_squared = x_ij.norm_sqr()
            inverse_r = inverse_distance(r_squared)
            r = r_squared * inverse_r
            v_dot_x = (v_i - velocity[j]).dot(x_ij)
            mu_ij, rho0_ij, alike = mu, rho0, 1.0
            if ti.static(several):
                other = phase[j]
                alike = ti.cast(other == own, ti.f32)
                mu_ij = pair_viscosity(mu, LAPLACIAN_FACTOR * dynamic_viscosity[other])
                rho0_ij = 0.5 * (rho0 + rest_density[other])
            viscous = viscous_factor(v_dot_x, r_squared, softening, mu_ij, artificial * rho0_ij)
            scale = 2.0 * viscous / (rho_i + density[j])
            if ti.static(with_pressure):
                scale -= pressure_i + pressure_term[j]
            slope = spline_slope(r * inverse_support)
            gradient = slope * inverse_r * x_ij
            fluid_sum += scale * gradient
            if ti.static(with_pressure):
                gradient_sum += gradient
                lightness = 1.0
                if ti.static(several):
                    lightness = rho0 / rest_density[phase[j]]
                square_sum += slope * slope * lightness
            if ti.static(with_cohesion):
                cohesion_sum += alike * cohesion_becker_teschner2007(r, inverse_support, spacing) * x_ij
        boundary_sum = ti.math.vec3(0.0)
        boundary_gradient = ti.math.vec3(0.0)
        first += fluid_count[i] * stride
        for k in range(boundary_count[i]):
            b = neighbors[first + k * stride]
            x_ib = x_i - boundary_position[b]
            r_squared = x_ib.norm_sqr()
            inverse_r = inverse_distance(r_squared)
            r = r_squared * inverse_r
            slope = spline_slope(r * inverse_support)
            if ti.static(with_wall_friction):
                v_ib = v_i
                if ti.static(with_moving):
                    v_ib -= boundary_velocity[b]
                viscous = viscous_factor(v_ib.dot(x_ib), r_squared, softening, mu, artificial * rho0)
                boundary_sum += wall_friction * viscous / rho_i * friction_volume[b] * slope * inverse_r * x_ib
            gradient = boundary_volume[b] * slope * inverse_r * x_ib
            boundary_sum -= pressure_i * gradient
            boundary_gradient += gradient
        if ti.static(with_pressure):
            diagonal = (volume * gradient_sum + boundary_gradient).norm_sqr() + volume * volume * square_sum
            stiffer = rho_i * rho_i * rho_i
            frequency_squared[i] = pressure_slope / rho0 * stiffer * stiffer * gradient_factor**2 * diagonal
        a_i = gravity + gradient_factor / rho0 * (volume * fluid_sum + boundary_sum)
        if ti.static(with_cohesion):
            a_i -= surface_tension[own] * sigma * cohesion_sum
        acceleration[i] = a_i


@ti.kernel
def gather_boundary_forces(
    boundary_position: Vectors, boundary_volume: Floats, boundary_count: ti.i32,
    cell_start: Integers, origin: ti.math.vec3, inverse_cell_size: ti.f32, shape: Cells,
    reach: ti.i32, position: Vectors, pressure_term: Floats,
    volume_gradient_factor: ti.f32, inverse_support: ti.f32, force: Vectors,
):  # fmt: skip
    """Reaction to the pressure acceleration that each sample causes, summed in the order of the sorted particles."""
    for b in range(boundary_count):
        x_b = boundary_position[b]
        cell = cell_of_point(x_b, origin, inverse_cell_size, shape, reach)
        total = ti.math.vec3(0.0)
        for dz in range(-reach, reach + 1):
            for dy in range(-reach, reach + 1):
                row = row_of_cell(cell, dy, dz, shape)
                for i in range(cell_start[row - reach], cell_start[row + reach + 1]):
                    x_ib = position[i] - x_b
                    inverse_r = inverse_distance(x_ib.norm_sqr())
                    r = x_ib.norm_sqr() * inverse_r
                    total += pressure_term[i] * spline_slope(r * inverse_support) * inverse_r * x_ib
        force[b] = volume_gradient_factor * boundary_volume[b] * total
