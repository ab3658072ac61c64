"""Two-way coupling of soft matter and the particle fluid that it is in: each of its particles is a sample of it."""

import math

import numpy as np
import taichi as ti

from sim.core.arrays import Floats, Vectors
from sim.core.host_access import copied
from sim.core.launch import kernel
from sim.core.reductions import LaneReduction, Results, Share, reduced_tree
from sim.core.solver import Coupling
from sim.fluid.boundary import Samples, Sheets
from sim.fluid.boundary_akinci2012 import BoundarySamples
from sim.fluid.fluid import SPHFluid
from sim.fluid.sheets import SheetSamples
from sim.soft.solver import SoftSolver
from sim.soft.transfers import Load, Particles

MAXIMA = 3

FULLNESS = 1.2
"""Volume of a sample over that of its particle. Samples push by the fluid's pressure alone, where more fluid would push
by its own as well; with this much, fluid rests 0.4 spacings off a flat face and is displaced as if it were half of one
(docs/decisions/0075)."""


def samples_of_soft(soft: SoftSolver) -> SheetSamples:
    """A sample for each particle."""
    particles = soft.particles
    points = BoundarySamples.of_points(copied(particles.position), known=FULLNESS * soft.volume)
    own_mass = copied(soft.masses)[soft.owner].astype(np.float64)
    return SheetSamples(BoundarySamples.of_bodies(points), own_mass, np.zeros(particles.count))


class SoftFluidCoupling(Coupling):
    """The fluid pushes soft matter, is pushed aside by it, and moves along where it touches.

    A coupled step, as of cloth (`sim.fluid.sheets` says why): the fluid steps, its samples of the particles of soft
    matter answering as if they had the mass m_b of the fluid that touches them; then particles p = b take the impulses
    J_b to the grid, together with that fluid, of velocity u_b where their own is v_b; and the touching fluid gets the
    difference between what became of v_b and u_b. With gravity, which the fluid has felt already, particles bring

        m_b + m_p,   m_p v_p + J_b + m_b (u_b - dt g)

    to the grid, and the affine part of their velocity has both masses. Linear momentum is kept to rounding. Angular
    momentum is not quite, as fluid takes part at some distance from the samples.
    """

    def __init__(self, fluid: SPHFluid, soft: SoftSolver) -> None:
        """Couple the two; the fluid was made with the samples of soft matter."""
        sheets = fluid.body_forces.sheets
        assert sheets is not None
        self.bodies = (fluid.name, soft.name)
        self._fluid, self._soft, self._sheets = fluid, soft, sheets
        self._change = ti.Vector.ndarray(3, ti.f32, soft.particles.count)
        self._reduction = LaneReduction(maxima=MAXIMA, sums=0)
        soft.let_touch()
        self.follow(0.0)

    def exchange(self, dt: float) -> None:
        """Lay the fluid's impulses of its substep of dt [s], and the fluid that touches, onto the particles."""
        boundary, fallen = self._fluid.boundary, dt * ti.math.vec3(self._soft.gravity)
        impulse, mass = self._sheets.impulse, self._sheets.mass
        load_particles(boundary.samples, boundary.sheets, impulse, mass, fallen, self._soft.load)

    def follow(self, dt: float) -> None:
        """Let the touching fluid move along, and put the samples where the particles are; dt [s] is 0 at the start."""
        particles, boundary = self._soft.particles, self._fluid.boundary
        share = self._reduction.over(particles.count)
        results = measure_particles(particles, boundary.samples, boundary.sheets, self._change, share)
        change, distance, speed = (math.sqrt(value) for value in self._reduction.unpack(results)[:MAXIMA].tolist())
        if dt > 0.0:
            self._fluid.tank.take_sheet_motion(self._change, change, dt)
        self.resume()
        self._fluid.tank.sheets_moved(distance, speed, elapsed_s=dt)

    def resume(self) -> None:
        """Put the samples where the particles are."""
        boundary = self._fluid.boundary
        place_particles(self._soft.particles, boundary.samples, boundary.sheets)


@kernel
def load_particles(samples: Samples, sheets: Sheets, impulse: Vectors, mass: Floats, fallen: ti.math.vec3, load: Load):
    """m_b, and J_b + m_b (u_b - dt g)."""
    for s in range(sheets.count):
        load.mass[s] = mass[s]
        load.momentum[s] = impulse[s] + mass[s] * (samples.velocity[sheets.first + s] - fallen)


@kernel
def measure_particles(particles: Particles, samples: Samples, sheets: Sheets, change: Vectors, share: Share) -> Results:
    """Change of each sample's velocity; the largest squares of that, of its displacement, and of its speed."""
    for lane in range(share.tree.lanes):
        largest = ti.math.vec3(0.0)
        for k in range(share.items):
            p = lane * share.lane_step + k * share.item_step
            if p < particles.count:
                dv_p = ti.math.vec3(0.0)
                if particles.body[p] >= 0:
                    v_p = particles.velocity[p]
                    dv_p = v_p - samples.velocity[sheets.first + p]
                    moved = (particles.position[p] - samples.position[sheets.first + p]).norm_sqr()
                    largest = ti.max(largest, ti.math.vec3(dv_p.norm_sqr(), moved, v_p.norm_sqr()))
                change[p] = dv_p
        for q in ti.static(range(3)):
            share.tree.partial[q * share.tree.lanes + lane] = largest[q]
    return reduced_tree(share.tree)


@kernel
def place_particles(particles: Particles, samples: Samples, sheets: Sheets):
    """Samples where the particles are, as fast as these."""
    for p in range(particles.count):
        s = sheets.first + p
        samples.position[s] = particles.position[p]
        samples.velocity[s] = particles.velocity[p]
