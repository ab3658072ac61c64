"""Forces on the particles, whatever the solver finds their pressure by, and their reaction on bodies and sheets."""

import math
from functools import partial
from typing import NamedTuple

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.arrays import Floats, Vectors, on_device
from sim.core.bundles import bundle
from sim.core.launch import kernel
from sim.fluid.air_drag import AirDrag
from sim.fluid.body_forces import Exerted
from sim.fluid.body_friction import BodyFriction
from sim.fluid.boundary import to_particle
from sim.fluid.kernels import inverse_distance, spline_slope
from sim.fluid.particles import Fluid, Particles, Phases
from sim.fluid.sheets import DENSITY
from sim.fluid.surface_tension import Cohesion, SurfaceTensionCSF, cohesion_becker_teschner2007
from sim.fluid.tank import ParticleTank
from sim.fluid.viscosity import (
    CALM_SPEED,
    CALMING,
    LAPLACIAN_FACTOR,
    SOFTENING,
    ImplicitViscosity,
    Viscosity,
    pair_viscosity,
    viscous_factor,
)
from sim.forces.field import ForceTable, change_of_velocity


@bundle
class Elastic(NamedTuple):
    """Pressure that follows the density, (capacity,) each."""

    pressure_term: Floats  # P_i [Pa]
    frequency_squared: Floats  # of each particle against its own pressure [1/s²]
    slope: ti.f32  # dp/d(rho/rho0) at rest density [Pa]
    is_given: ti.template()  # False where pressure is found later


class Forces:
    """Gravity, viscosity, surface tension, drag of air, and pressure where it is known before the step.

    a_i = g - 1/rho0 [sum_j V (P_i + P_j) grad W_ij + sum_b V_b P_i grad W_ib] + viscosity + cohesion

    with P = p/(rho/rho0)², Monaghan's viscosity (`sim.fluid.viscosity`) and the cohesion of Becker & Teschner 2007, or
    implicit viscosity (`sim.fluid.viscosity`) and a continuum surface force in their place.

    Attributes:
        acceleration: of each particle [m/s²], (capacity,) of 3-vectors.
        artificial_viscosity: alpha c h/2 and what is added to it at most [m²/s], which stands where 2 (d + 2) nu does.
        csf: surface tension by a continuum surface force; None without.
        implicit_viscosity: the solve for stiff fluids; None where viscosity is explicit.
        air: drag of the air; None without air.
    """

    def __init__(
        self,
        tank: ParticleTank,
        phases: Phases,
        cohesion: Cohesion,
        *,
        signal_speed: float,
        speed_ratio: float,
        with_implicit: bool,
    ) -> None:
        """Prepare for the particles of a tank; `signal_speed` is c in the artificial viscosity [m/s].

        `speed_ratio` is that speed over the largest expected one [-].
        """
        self._tank, self._cohesion = tank, cohesion
        parameters, d = phases.shared, tank.discretization
        support, capacity = d.support_radius, tank.particles.capacity
        self.acceleration = ti.Vector.ndarray(3, ti.f32, capacity)
        wall_friction, smoothing_length = parameters.wall_friction, support / 2.0
        artificial = parameters.artificial_viscosity * signal_speed * smoothing_length
        fall_speed = math.sqrt(float(np.linalg.norm(tank.gravity)) * d.spacing)
        at_rest = CALMING * speed_ratio * fall_speed * smoothing_length
        calming = max(at_rest - artificial, 0.0) if artificial > 0.0 else 0.0
        steady = LAPLACIAN_FACTOR * cohesion.viscosity if artificial > 0.0 else 0.0
        self.artificial_viscosity = artificial + calming + steady
        self._viscosity = Viscosity(
            softening=SOFTENING * support**2,
            artificial=artificial,
            calming=calming,
            steady=steady,
            calm_speed_squared=(CALM_SPEED * fall_speed) ** 2,
            wall_friction=wall_friction,
            with_wall_friction=wall_friction > 0.0,
        )
        self._volume_gradient_factor = d.particle_volume * d.sigma / support
        self._explicit_materials = phases.materials
        self.implicit_viscosity: ImplicitViscosity | None = None
        if with_implicit:
            tank.body_forces.let_bodies_respond(tank.gravity, d)
            heaviest = float(phases.rest_densities.max())
            bodies = BodyFriction(tank.boundary, tank.body_forces.response, d.particle_volume, heaviest)
            self.implicit_viscosity = ImplicitViscosity(capacity, bodies, wall_friction, d)
            nothing = on_device(np.zeros(len(phases)))
            self._explicit_materials = phases.materials._replace(dynamic_viscosity=nothing)
        self.csf: SurfaceTensionCSF | None = (
            SurfaceTensionCSF(capacity, phases.parameters, d) if cohesion.is_csf else None
        )
        self.air: AirDrag | None = AirDrag(phases.parameters, d) if parameters.air_density > 0.0 else None
        density = tank.particles.density
        self._no_pressure = Elastic(density, density, 0.0, False)

    @property
    def _fluid(self) -> Fluid:
        """The fluid with the viscosity that forces know before the step."""
        return self._tank.on_device._replace(materials=self._explicit_materials)

    def begin_sheets(self) -> None:
        """Find the fluid that touches sheets at the start of a step, before anything acts between them."""
        body_forces = self._tank.body_forces
        if body_forces.sheets is not None:
            body_forces.sheets.begin_step(self._tank.on_device, body_forces.near, are_alone=body_forces.are_alone)

    def compute(self, dt: float, elastic: Elastic | None = None) -> None:
        """Fill `acceleration` with all forces known before a step of dt [s], and count their reaction."""
        tank, pressure, cohesion = self._tank, elastic or self._no_pressure, self._cohesion.is_becker_teschner2007
        spacing = tank.discretization.spacing
        compute_acceleration(self._fluid, pressure, self._viscosity, tank.gravity, spacing, cohesion, self.acceleration)
        if tank.outer_forces.accelerates:
            add_outer_forces(tank.particles.arrays, tank.outer_forces.now, dt, self.acceleration)
        if self.csf is not None:
            self.csf.add_acceleration(tank.on_device, self.acceleration)
            fill = partial(self.csf.fill_forces, tank.on_device)
            tank.body_forces.gather_others(fill, tank.boundary.samples, dt)
        if self.air is not None:
            self.air.add_acceleration(tank.on_device, tank.outer_forces.now, self.acceleration, dt)
        self._begin_reaction(None if elastic is None else elastic.pressure_term, dt)
        self.add_implicit_viscosity(dt)

    def exerted(self, pressure_term: ti.Ndarray | None, *, with_friction: bool) -> Exerted:
        """Forces on bodies by pressure, by explicit friction or by both."""
        fluid, with_pressure = self._fluid, pressure_term is not None
        pressure = pressure_term if with_pressure else fluid.particles.density
        friction = with_friction and self._viscosity.with_wall_friction
        return Exerted(fluid, pressure, self._volume_gradient_factor, self._viscosity, with_pressure, friction)

    def react(self, pressure_term: ti.Ndarray, dt: float) -> None:
        """Count the pressure of a step of dt [s], found after its other forces, as impulses on bodies.

        The particles must be where they felt it.
        """
        self._tank.body_forces.gather(self.exerted(pressure_term, with_friction=False), dt)

    def recoil_sheets(self, solve: int, dt: float) -> None:
        """Push the sheets' samples by the opposite of what acted on them in this solve of the last step."""
        if self._tank.body_forces.sheets is not None:
            self._tank.body_forces.sheets.recoil(dt, solve)

    def _begin_reaction(self, pressure_term: ti.Ndarray | None, dt: float) -> None:
        """Count what has acted so far on bodies and sheets; those that answer within the step then begin to fall."""
        body_forces = self._tank.body_forces
        sheets = body_forces.sheets
        if sheets is not None:
            sheets.solve = DENSITY
        if pressure_term is not None or self._viscosity.with_wall_friction:
            body_forces.gather(self.exerted(pressure_term, with_friction=True), dt)
        # After the gathering: the particles felt friction against samples that had not begun to fall or recoil.
        if body_forces.response is not None and not body_forces.are_alone:
            body_forces.response.fall(dt)
        if sheets is not None:
            sheets.recoil(dt, DENSITY)
        if sheets is not None and not body_forces.are_alone:
            sheets.add_missing_weight(self._tank.on_device, body_forces.near, dt)

    def add_implicit_viscosity(self, dt: float) -> None:
        """Add viscosity to all other accelerations, where it is implicit, and count its friction on bodies."""
        solver, tank = self.implicit_viscosity, self._tank
        if solver is None:
            return
        fluid, body_forces = tank.on_device, tank.body_forces
        viscosity = self._viscosity._replace(artificial=0.0, calming=0.0, steady=0.0)

        def friction_at(velocity: ti.Ndarray, sample_velocity: ti.Ndarray) -> Exerted:
            particles = fluid.particles._replace(velocity=velocity)
            moving = fluid._replace(particles=particles, samples=fluid.samples._replace(velocity=sample_velocity))
            exerted = self.exerted(None, with_friction=True)
            return exerted._replace(fluid=moving, viscosity=viscosity, with_friction=True)

        def friction(velocity: ti.Ndarray, sample_velocity: ti.Ndarray) -> NDArray[np.float64]:
            return body_forces.measure(friction_at(velocity, sample_velocity))

        solver.add_acceleration(tank.particles, fluid, friction, self.acceleration, dt)
        if self._viscosity.with_wall_friction:
            body_forces.gather(friction_at(solver.velocity, solver.bodies.found_velocity()), dt)


@kernel
def compute_acceleration(
    fluid: Fluid,
    elastic: Elastic,
    viscosity: Viscosity,
    gravity: ti.math.vec3,
    spacing: ti.f32,
    with_cohesion: ti.template(),
    acceleration: Vectors,
):
    """All accelerations in one pass over the neighbours, or all but that by pressure; the terms stand at `Forces`.

    With pressure also the square of the frequency at which a particle would swing against the pressures that its own
    displacement makes, dp/d(rho/rho0) A_ii with A_ii as in `sim.fluid.pressure`: high where a particle is squeezed, or
    close to boundary fluid.samples.
    """
    particles, near, samples, materials = ti.static((fluid.particles, fluid.near, fluid.samples, fluid.materials))
    gradient_factor = fluid.sigma * fluid.inverse_support
    ti.loop_config(block_dim=128)
    for i in range(particles.count):
        x_i, v_i, rho_i = particles.position[i], fluid.particles.velocity[i], fluid.particles.density[i]
        pressure_i = 0.0
        if ti.static(elastic.is_given):
            pressure_i = elastic.pressure_term[i]
        own = 0
        if ti.static(fluid.materials.several):
            own = particles.phase[i]
        rho0, mu = materials.rest_density[own], LAPLACIAN_FACTOR * materials.dynamic_viscosity[own]
        fluid_sum = ti.math.vec3(0.0)
        gradient_sum = ti.math.vec3(0.0)
        square_sum = 0.0
        cohesion_sum = ti.math.vec3(0.0)
        first = near.start[i]
        for k in range(near.fluid_count[i]):
            j = near.indices[first + k * near.stride]
            x_ij = x_i - particles.position[j]
            r_squared = x_ij.norm_sqr()
            inverse_r = inverse_distance(r_squared)
            r = r_squared * inverse_r
            v_dot_x = (v_i - particles.velocity[j]).dot(x_ij)
            mu_ij, rho0_ij, alike = mu, rho0, 1.0
            if ti.static(fluid.materials.several):
                other = particles.phase[j]
                alike = ti.cast(other == own, ti.f32)
                mu_ij = pair_viscosity(mu, LAPLACIAN_FACTOR * materials.dynamic_viscosity[other])
                rho0_ij = 0.5 * (rho0 + materials.rest_density[other])
            viscous = viscous_factor(v_dot_x, r_squared, viscosity, mu_ij, rho0_ij)
            scale = 2.0 * viscous / (rho_i + particles.density[j])
            if ti.static(elastic.is_given):
                scale -= pressure_i + elastic.pressure_term[j]
            slope = spline_slope(r * fluid.inverse_support)
            gradient = slope * inverse_r * x_ij
            fluid_sum += scale * gradient
            if ti.static(elastic.is_given):
                gradient_sum += gradient
                lightness = 1.0
                if ti.static(fluid.materials.several):
                    lightness = rho0 / materials.rest_density[particles.phase[j]]
                square_sum += slope * slope * lightness
            if ti.static(with_cohesion):
                cohesion_sum += alike * cohesion_becker_teschner2007(r, fluid.inverse_support, spacing) * x_ij
        boundary_sum = ti.math.vec3(0.0)
        boundary_gradient = ti.math.vec3(0.0)
        first += near.fluid_count[i] * near.stride
        for k in range(near.boundary_count[i]):
            b = near.indices[first + k * near.stride]
            x_ib = to_particle(samples, b, x_i)
            r_squared = x_ib.norm_sqr()
            inverse_r = inverse_distance(r_squared)
            r = r_squared * inverse_r
            slope = spline_slope(r * fluid.inverse_support)
            if ti.static(viscosity.with_wall_friction):
                v_ib = v_i
                if ti.static(fluid.samples.with_moving):
                    v_ib -= samples.velocity[b]
                viscous = viscous_factor(v_ib.dot(x_ib), r_squared, viscosity, mu, rho0)
                boundary_sum += (
                    viscosity.wall_friction * viscous / rho_i * samples.friction_volume[b] * slope * inverse_r * x_ib
                )
            gradient = samples.volume[b] * slope * inverse_r * x_ib
            boundary_sum -= pressure_i * gradient
            boundary_gradient += gradient
        if ti.static(elastic.is_given):
            volume = fluid.volume
            diagonal = (volume * gradient_sum + boundary_gradient).norm_sqr() + volume * volume * square_sum
            stiffer = rho_i * rho_i * rho_i
            elastic.frequency_squared[i] = elastic.slope / rho0 * stiffer * stiffer * gradient_factor**2 * diagonal
        a_i = gravity + gradient_factor / rho0 * (fluid.volume * fluid_sum + boundary_sum)
        if ti.static(with_cohesion):
            a_i -= materials.surface_tension[own] * fluid.sigma * cohesion_sum
        acceleration[i] = a_i


@kernel
def add_outer_forces(particles: Particles, forces: ForceTable, dt: ti.f32, acceleration: Vectors):
    """Add the accelerations of forces from outside, and the means of their drag in dt [s]."""
    for i in range(particles.count):
        x_i, v_i = particles.position[i], particles.velocity[i]
        acceleration[i] += change_of_velocity(forces, particles.phase[i], x_i, v_i, dt) / dt
