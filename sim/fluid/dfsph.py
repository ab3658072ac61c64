"""Divergence-free SPH (Bender & Koschier 2015) with the boundaries of Akinci et al. 2012."""

import numpy as np
import taichi as ti

from sim.core.arrays import Floats
from sim.core.launch import kernel
from sim.fluid.kernels import evaluate, lattice_offsets, particle_volume
from sim.fluid.particles import Fluid
from sim.fluid.pressure import IncompressibleFluid, PressureSystem, add_scaled, density_rate, not_negative
from sim.fluid.sheets import DIVERGENCE
from sim.fluid.tank import FluidStart

LEAST_ITERATIONS, LEAST_DIVERGENCE_ITERATIONS = 2, 1  # in any case (Bender & Koschier 2015, algorithms 3 and 2)
NOT_SOLVED = -1.0e6  # relative compression of what takes no part in a solve: so much room that its pressure stays 0

AT_SURFACE = 0.8
"""A particle that lacks more than this share of what the first layer at a flat surface lacks of the rest density is at
a free surface: it has room, and no divergence. The usual criterion, fewer than 20 neighbours, fails at walls of few
samples."""


class DFSPHSolver(IncompressibleFluid):
    """A fluid without divergence and without compression, by two pressure solves a step.

    With rho_i relative to the rest density and (D v)_i its rate of change (`sim.fluid.pressure`):

    1. rho_i = V sum_j W_ij + sum_b V_b W_ib, and 1/A_ii, the factor alpha_i/rho_i of the paper (eq. 9)
    2. divergence solve: P with dt (D v)_i <= 0 for v + dt a^p(P) (algorithm 2), not at the free surface
    3. a_i = gravity, viscosity, cohesion
    4. density solve: P with rho_i + dt (D v)_i <= 1 for v + dt (a + a^p(P)) (algorithm 3)
    5. v_i += dt (a_i + a_i^p), x_i += dt v_i

    kappa of the paper is P_i/rho_i here, and dt² A_ii P_i what that pressure takes away of the compression. Three
    things differ from the paper; docs/decisions/0016-implicit-pressure.md has the measurements. The pressures are
    iterated themselves, at least 0, so that a solve is one linear complementarity problem, and that of the density
    solve is what one would measure; it starts from that of the step before. Relaxation has momentum
    (`sim.fluid.pressure.momentum`). And of a compression that a particle has already, from walls or the error of
    linearization, a step takes back a part only (`IncompressibleFluid.correction`), as it turns into speed.

    Momentum of fluid pairs is conserved to rounding. The `pressure_term` is the sum of both pressures, as both act for
    the whole step: what hits something has much of it from the divergence solve.

    Attributes:
        least_density: below which a particle has no divergence [-].
    """

    carried = (*IncompressibleFluid.carried, "divergence_pressure")
    solved_for = ("density", "divergence")

    def __init__(self, start: FluidStart) -> None:
        """Take particles, walls and bodies."""
        super().__init__(start)
        self.least_density = 1.0 - AT_SURFACE * (1.0 - surface_density(self.discretization.support_in_spacings))

    @property
    def pressure_term(self) -> ti.Ndarray:
        """P_i of both solves of each particle [Pa], until the next step."""
        carried = self.particles.carried
        add_pressures(carried["pressure"], carried["divergence_pressure"], self.particles.count, self.next_pressure)
        return self.next_pressure

    def substep(self, dt: float) -> None:
        """Advance by dt [s]."""
        self.compute_density()
        self.begin_sheets()
        self.correct_divergence_error(dt)
        self.forces.compute(dt)
        self.predict_compression(dt)
        self.correct_density_error(dt)
        self.advance(dt)

    def correct_divergence_error(self, dt: float) -> None:
        """Make the velocities free of divergence, for a step of dt [s]."""
        carried, tolerance = self.particles.carried, self.parameters.divergence_tolerance
        pressure = carried["divergence_pressure"]
        self.forces.recoil_sheets(DIVERGENCE, dt)
        compute_divergence(self.tank.on_device, self.system, dt, self.least_density, pressure)
        error = self.mean_error(pressure, 0.0, self.system.compression)
        record, least = self.solves["divergence"], LEAST_DIVERGENCE_ITERATIONS
        if error <= tolerance:
            # One relaxation leaves less than there was. To measure how much less would take as long as to make it.
            self.accelerate_by(pressure)
            record.add(least, error, converged=True)
        else:
            pressure = self.solve(record, pressure, dt, least=least, tolerance=tolerance)
        carried["divergence_pressure"] = pressure
        self.forces.react(pressure, dt)
        add_scaled(self.particles.velocity, self.pressure_acceleration, dt, self.particles.count)

    def correct_density_error(self, dt: float) -> None:
        """Add the acceleration by the pressure that leaves no compression after a step of dt [s]."""
        carried, tolerance = self.particles.carried, self.parameters.density_tolerance
        self.start_from(carried["pressure"])
        carried["pressure"] = self.solve(
            self.solves["density"],
            carried["pressure"],
            dt,
            least=LEAST_ITERATIONS,
            tolerance=tolerance,
            aim=self.quiet_error(dt),
            correction=self.correction(dt),
        )
        self.forces.react(carried["pressure"], dt)
        add_scaled(self.forces.acceleration, self.pressure_acceleration, 1.0, self.particles.count)


def surface_density(support_in_spacings: float) -> float:
    """Relative density of the first layer of a lattice with a flat surface [-]."""
    offsets = lattice_offsets(support_in_spacings)
    distances = np.linalg.norm(offsets[offsets[:, 2] <= 0.0], axis=1)
    return particle_volume(1.0, support_in_spacings) * float(evaluate(distances, support_in_spacings).sum())


@kernel
def add_pressures(density_pressure: Floats, divergence_pressure: Floats, count: ti.i32, total: Floats):
    """P_i of both solves."""
    for i in range(count):
        total[i] = density_pressure[i] + divergence_pressure[i]


@kernel
def compute_divergence(fluid: Fluid, system: PressureSystem, dt: ti.f32, least_density: ti.f32, pressure: Floats):
    """Relative compression s_i = dt (D v)_i, and the first relaxation of it from P = 0.

    Below the least density a particle is `NOT_SOLVED`.
    """
    ti.loop_config(block_dim=128)
    for i in range(fluid.particles.count):
        rate = density_rate(fluid, i, fluid.particles.velocity, fluid.samples.velocity)
        s_i = dt * rate
        if fluid.particles.density[i] < least_density:
            s_i = NOT_SOLVED
        p_i = not_negative(system.relaxation / (dt * dt) * system.inverse_diagonal[i] * s_i)
        system.compression[i] = s_i
        pressure[i] = p_i
        system.relaxed_before[i] = p_i
