"""Sheets in a fluid: what the fluid does to their samples, how these answer, and the fluid that moves along."""

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
import taichi as ti
from numpy.typing import NDArray
from scipy.optimize import brentq

from sim.core.arrays import Floats, Vectors, on_device
from sim.core.bundles import bundle, func
from sim.core.launch import kernel
from sim.core.parameters import Vector3
from sim.core.solver import Arrays
from sim.fluid.boundary import Boundary, NearParticles, Samples, Sheets, to_particle
from sim.fluid.boundary_akinci2012 import BoundarySamples
from sim.fluid.kernels import (
    SUPPORT_IN_SPACINGS,
    TINY_DISTANCE,
    Discretization,
    distance,
    evaluate,
    lattice_offsets,
    layer_field,
    particle_volume,
    spline,
    spline_slope,
)
from sim.fluid.particles import Fluid
from sim.fluid.stepping import Box

DIVERGENCE, DENSITY = 0, 1  # solves of a step whose forces last apart: of divergence, of density with all other forces
STEPS_REMEMBERED = 2  # after which arrays that took turns hold forces of the time alone
FULL_CONTACT = 0.5  # of the density that samples give to fluid at rest beside them: with it a particle touches in full
STANDOFF = 0.5  # distance from a sheet at which the first layer of a fluid is at rest [spacings], as at a wall
AMID_SAMPLES = 2.0  # density in the middle of a sheet by its samples alone; in the face of a wall 1.5


@bundle
class SheetReaction(NamedTuple):
    """What forces do to the samples of sheets, (m,) each."""

    mass: Floats  # with which they answer [kg]
    push: Vectors  # sum of the changes of their velocity since they were placed [m/s]
    expected: Vectors  # sum of the forces of a solve, which the next step expects [N]
    impulse: Vectors  # of all forces in the step [N s]


@dataclass(frozen=True, eq=False)
class SheetSamples:
    """One layer of samples of each sheet."""

    boundary: BoundarySamples  # samples of the sheets at rest, with volumes that let nothing through, (m, 3)
    own_mass: NDArray[np.float64]  # of the sheet's part that each stands for [kg], (m,)
    # of fluid that keeps its distance on both sides of that part without being displaced [m³], (m,)
    missing_volume: NDArray[np.float64]


@cache
def sheet_depth(support_in_spacings: float = SUPPORT_IN_SPACINGS) -> float:
    """How far behind a sheet, seen from either side, its samples are felt [spacings].

    A wall's lie 0.95 deep. Farther off their density rises more steeply towards the sheet, which has nothing behind it
    that would hold what has once got into it.
    """

    def excess(depth: float) -> float:
        amid, at_rest = (layer_field(distance, support_in_spacings)[0] for distance in (depth, depth + STANDOFF))
        return amid / at_rest * resting_field(support_in_spacings) - AMID_SAMPLES

    return float(brentq(excess, 0.1, support_in_spacings - STANDOFF - 0.01))


def volume_per_area(support_in_spacings: float = SUPPORT_IN_SPACINGS) -> float:
    """Volume of a sheet's samples over its area [spacings] that keeps a lattice of fluid at its distance."""
    field = layer_field(sheet_depth(support_in_spacings) + STANDOFF, support_in_spacings)[0]
    return resting_field(support_in_spacings) / field


def resting_field(support_in_spacings: float = SUPPORT_IN_SPACINGS) -> float:
    """Density that samples give to the first layer of a fluid at rest beside them [-]: what it lacks of 1."""
    offsets = lattice_offsets(support_in_spacings)
    beyond = np.linalg.norm(offsets[offsets[:, 2] > 0.0], axis=1)
    return particle_volume(1.0, support_in_spacings) * float(evaluate(beyond, support_in_spacings).sum())


def kept_away(support_in_spacings: float = SUPPORT_IN_SPACINGS) -> float:
    """How much farther from a sheet fluid on both sides of it is at rest than on one [spacings].

    What is on one side is pushed by what is on the other, and by the sheet as well. Under an even pressure both push as
    much as the fluid on its own side does, a sample with half of what a particle has (`wall_calibration`).
    """
    volume, depth = volume_per_area(support_in_spacings), sheet_depth(support_in_spacings)
    particle = 2.0 * particle_volume(1.0, support_in_spacings)

    def push(nearest: float) -> float:
        layers = np.arange(nearest, support_in_spacings)
        return particle * sum(layer_field(float(distance), support_in_spacings)[1] for distance in layers)

    def excess(gap: float) -> float:
        return volume * layer_field(depth + gap, support_in_spacings)[1] + push(2.0 * gap) - push(1.0)

    return float(brentq(excess, 0.4, 1.1)) - STANDOFF


def one_sided_field(support_in_spacings: float = SUPPORT_IN_SPACINGS) -> float:
    """V sum_i W_ib over the particles of a lattice at rest on one side of a sheet [-]."""
    gaps = np.arange(STANDOFF, support_in_spacings)
    layers = sum(layer_field(float(gap), support_in_spacings)[0] for gap in gaps)
    return particle_volume(1.0, support_in_spacings) * layers


def one_sided_tilt(support_in_spacings: float = SUPPORT_IN_SPACINGS) -> float:
    """Length of the mean unit vector from a sheet to the particles of a lattice at rest on one side, weighted by W."""
    axis = np.arange(-np.ceil(support_in_spacings), np.ceil(support_in_spacings) + 1)
    gaps = np.arange(STANDOFF, support_in_spacings)
    # As a sample lies anywhere between the particles, and no less often in the middle of four than on one.
    offsets = np.stack(np.meshgrid(axis + 0.25, axis + 0.25, gaps, indexing="ij"), axis=-1).reshape(-1, 3)
    distances = np.linalg.norm(offsets, axis=1)
    weights = evaluate(distances, support_in_spacings)
    return float((weights * offsets[:, 2] / distances).sum() / weights.sum())


@bundle
class Contacts(NamedTuple):
    """Particles as they touched sheets at the start of the step, (capacity,) each."""

    position: Vectors  # where they were [m]
    mass: Floats  # m_i min(1, s_i/s_full) over s_i = sum_b V_b W_ib [kg]; 0 for those that touch none
    count: ti.i32  # particles there were


@bundle
class OneSide(NamedTuple):
    """Fluid at rest on one side of a sheet, as a sample sees it."""

    field: ti.f32  # V sum_i W_ib [-]
    tilt: ti.f32  # length of the mean unit vector to the particles, weighted by W [-]


class SheetForces:
    """Forces of a fluid on the samples of sheets, and what becomes of the fluid that touches them.

    Water is a hundred times as heavy as the cloth that holds it, and the cloth's springs are stiffer than that. So
    fluid and cloth take their steps one after the other, each with a Robin condition for what the other will do
    (Burman, Durst & Guzmán 2022), whose weight is the mass of the fluid that touches the sheet. Momentum is kept:

    1. The fluid's step. Sample b answers to the pressure that is tried as if it had the mass m_b of the fluid that
       touches it, and were pushed by the opposite of the last step's force f*, as the springs did then:
       u_b = v_b + dt (f_b - f*_b)/m_b. In a state that lasts f = f*, and the sample stays where the springs hold it.
    2. The cloth's step (`sim.coupling.cloth_fluid`): nodes with their own mass and that of the fluid that touches them,
       from their own velocity and u_b, under the impulse of f and the springs.
    3. The touching fluid gets the difference between the sheet's velocity and u_b.

    Explicit pressure (WCSPH) needs no answer within a step: m_b is infinite there, as a wall's, since within a step of
    the sound only the touching layer feels the sheet.

    Attributes:
        impulse: of the fluid on each sample in the last step [N s], (m,) vec3.
        push: u_b - v_b of the last step [m/s], (m,) vec3.
        mass: of the fluid that touched each sample at the start of the step [kg], (m,).
        solve: `DIVERGENCE` or `DENSITY`, as the forces of which forces count now.
    """

    def __init__(
        self,
        boundary: Boundary,
        sheets: SheetSamples,
        *,
        gravity: Vector3,
        capacity: int,
        discretization: Discretization,
        answers: bool,
    ) -> None:
        """Prepare for the sheets' samples of a boundary, which may answer within the fluid's step."""
        self._boundary, self.answers, self._discretization = boundary, answers, discretization
        self._gravity = ti.math.vec3(*gravity)
        support = discretization.support_in_spacings
        self._full_field = FULL_CONTACT * resting_field(support)
        self._one_side = OneSide(one_sided_field(support), one_sided_tilt(support))
        count = boundary.sheet_count
        self._own_mass, self._missing_volume = on_device(sheets.own_mass), on_device(sheets.missing_volume)
        self.mass, self._answering_mass, self._answer = (ti.ndarray(ti.f32, count) for _ in range(3))
        self.impulse, self.push, *forces = (on_device(np.zeros((count, 3))) for _ in range(6))
        self._expected, self._found = forces[:2], forces[2:]
        self.solve = DIVERGENCE
        self._steps_alone = 0
        self._contacts = Contacts(ti.Vector.ndarray(3, ti.f32, capacity), ti.ndarray(ti.f32, capacity), 0)

    def begin_step(self, fluid: Fluid, near: NearParticles, *, are_alone: bool) -> None:
        """Forget the impulses of the last step, and find the masses with which samples answer in this one.

        `are_alone` says that no particle is near any sample.
        """
        sheets = self._boundary.sheets
        self._expected, self._found = self._found, self._expected
        self._steps_alone = self._steps_alone + 1 if are_alone else 0
        if self._are_at_rest:
            self._contacts = self._contacts._replace(count=0)
            return
        self._contacts = self._contacts._replace(count=fluid.particles.count)
        forgotten = self.impulse, self.push, *self._found
        masses = self.mass, self._own_mass, self._answering_mass
        begin_sheet_step(fluid, near, sheets, self._full_field, self._contacts, *masses, *forgotten, self.answers)

    @property
    def _are_at_rest(self) -> bool:
        """Whether nothing touches now, nor did in the steps whose forces count: all is 0, and stays so."""
        return self._steps_alone > STEPS_REMEMBERED

    def recoil(self, dt: float, solve: int) -> None:
        """Push the samples for dt [s] by the opposite of what acted on them in this solve of the last step."""
        self.solve = solve
        if self.answers and not self._are_at_rest:
            sheets, samples = self._boundary.sheets._replace(skipped=0), self._boundary.samples
            push_sheet_samples(self._expected[solve], sheets, -dt, self._answering_mass, samples, self.push)

    @property
    def reaction(self) -> SheetReaction:
        """What forces of the present solve do."""
        return SheetReaction(self._answering_mass, self.push, self._found[self.solve], self.impulse)

    def add_to_diagonal(
        self, fluid: Fluid, near: NearParticles, relaxation: float, inverse_diagonal: ti.Ndarray
    ) -> None:
        """Add the sheets' share in A to its diagonal, such that relaxation by the diagonal converges.

        Their part of A is B_ij = V sum_b n_ib . n_jb / m_b with n_ib = V_b grad W_ib, and by Cauchy's inequality the
        diagonal matrix of V sum_b |n_ib| sum_j |n_jb| / m_b bounds it.

        1/A_ii becomes 1/(A_ii + omega times the bound), as the bound needs no relaxation omega.
        """
        sheets, d = self._boundary.sheets, self._discretization
        gradient_factor = d.sigma * d.inverse_support
        weight = relaxation * d.particle_volume
        mass, answer = self._answering_mass, self._answer
        add_sheets_to_diagonal(fluid, near, sheets, mass, answer, gradient_factor, weight, inverse_diagonal)

    def add_missing_weight(self, fluid: Fluid, near: NearParticles, dt: float) -> None:
        """Count the weight of the water that samples keep away and that a thin sheet would not, for a step of dt [s].

        Fluid keeps its distance from samples, as from a plate, and that plate would float. The water that is missing
        weighs on the sheet instead: what is lifted is the volume that the sheet has.
        """
        d = self._discretization
        sheets, factor, gravity_dt = self._boundary.sheets, d.particle_volume * d.sigma, dt * self._gravity
        add_missing_weight(fluid, near, sheets, self._missing_volume, factor, self._one_side, gravity_dt, self.impulse)

    def take_motion(self, fluid: Fluid, change: ti.Ndarray, dt: float, box: Box) -> None:
        """Give the fluid that touched at the start of the step of dt [s] the changes of velocity of the samples [m/s].

        Positions follow as if it had been so during the step, up to the walls of the box.
        """
        if self._contacts.count:
            take_sheet_motion(fluid, self._contacts, self._boundary.sheets, change, dt, box)

    def checkpoint(self) -> dict[str, NDArray[np.float32]]:
        """The forces of the last step, which the next one expects."""
        return {f"sheet_force_{solve}": force.to_numpy() for solve, force in enumerate(self._found)}

    def restore(self, arrays: Arrays) -> None:
        """Continue from a checkpoint."""
        for solve, force in enumerate(self._found):
            force.from_numpy(np.ascontiguousarray(arrays[f"sheet_force_{solve}"]))
        self._steps_alone = 0


@kernel
def begin_sheet_step(
    fluid: Fluid,
    near: NearParticles,
    sheets: Sheets,
    full_field: ti.f32,
    contacts: Contacts,
    mass: Floats,
    own_mass: Floats,
    answering_mass: Floats,
    impulse: Vectors,
    push: Vectors,
    divergence_force: Vectors,
    density_force: Vectors,
    answers: ti.template(),
):
    """Clear what counts anew in a step, and share out the fluid that touches sheets.

    Mass of each particle that touches sheets, m_i min(1, s_i/s_full), over s_i = sum_b V_b W_ib [kg], and where it is;
    m_b = sum_i contact_i V_b W_ib of each sample, and the mass with which it answers, at least its own.
    """
    for s in range(sheets.count):
        for vectors in ti.static((impulse, push, divergence_force, density_force)):
            vectors[s] = ti.math.vec3(0.0)
    for i in range(fluid.particles.count):
        x_i = fluid.particles.position[i]
        field = 0.0
        first = fluid.near.start[i] + fluid.near.fluid_count[i] * fluid.near.stride
        for k in range(fluid.near.boundary_count[i]):
            b = fluid.near.indices[first + k * fluid.near.stride]
            if b >= sheets.first:
                r = distance(to_particle(fluid.samples, b, x_i).norm_sqr())
                field += fluid.samples.volume[b] * spline(r * fluid.inverse_support)
        field *= fluid.sigma
        mass_i = fluid.volume * fluid.materials.rest_density[fluid.particles.phase[i]]
        contacts.position[i] = x_i
        contacts.mass[i] = ti.select(field > 0.0, mass_i / ti.max(field, full_field), 0.0)
    for s in range(sheets.count):
        b = sheets.first + s
        m = sheets.skipped + s
        total = 0.0
        for k in range(near.start[m], near.start[m] + near.count[m]):
            i = near.particles[k]
            r = distance(to_particle(fluid.samples, b, fluid.particles.position[i]).norm_sqr())
            total += contacts.mass[i] * spline(r * fluid.inverse_support)
        mass_b = fluid.sigma * fluid.samples.volume[b] * total
        mass[s] = mass_b
        if ti.static(answers):
            answering_mass[s] = ti.max(mass_b, own_mass[s])


@kernel
def push_sheet_samples(force: Vectors, sheets: Sheets, factor: ti.f32, mass: Floats, samples: Samples, push: Vectors):
    """v_b += factor f_b/m_b, and the sum of these pushes since the samples were placed."""
    push_sheets(force, sheets, factor, mass, samples, push)


@func
def push_sheets(force: Vectors, sheets: Sheets, factor: ti.f32, mass: Floats, samples: Samples, push: Vectors):
    """As `push_sheet_samples`."""
    for s in range(sheets.count):
        change = factor / mass[s] * force[sheets.skipped + s]
        samples.velocity[sheets.first + s] += change
        push[s] += change


@func
def react_of_sheets(
    force: Vectors, sheets: Sheets, dt: ti.f32, reaction: SheetReaction, samples: Samples, answers: ti.template()
):
    """Count forces on the moving samples [N] for a step of dt [s]; those of sheets may answer to them."""
    for s in range(sheets.count):
        reaction.impulse[s] += dt * force[sheets.skipped + s]
        reaction.expected[s] += force[sheets.skipped + s]
    if ti.static(answers):
        push_sheets(force, sheets, dt, reaction.mass, samples, reaction.push)


@func
def answer_of_sheets(force: Vectors, sheets: Sheets, mass: Floats, acceleration: Vectors):
    """a_b = f_b/m_b."""
    for s in range(sheets.count):
        acceleration[sheets.first + s] = force[sheets.skipped + s] / mass[s]


@kernel
def add_sheets_to_diagonal(
    fluid: Fluid,
    near: NearParticles,
    sheets: Sheets,
    mass: Floats,
    answer: Floats,
    gradient_factor: ti.f32,
    weight: ti.f32,
    inverse_diagonal: Floats,
):
    """1/A_ii becomes 1/(A_ii + weight sum_b |n_ib| sum_j |n_jb| / m_b), n_ib = V_b grad W_ib.

    What a sample has in it, V_b sum_j |n_jb| / m_b, is its `answer`.
    """
    for s in range(sheets.count):
        m = sheets.skipped + s
        total = 0.0
        for k in range(near.start[m], near.start[m] + near.count[m]):
            x_i = fluid.particles.position[near.particles[k]]
            r = distance(to_particle(fluid.samples, sheets.first + s, x_i).norm_sqr())
            total -= spline_slope(r * fluid.inverse_support)
        v_b = fluid.samples.volume[sheets.first + s]
        answer[s] = gradient_factor * v_b * v_b * total / mass[s]
    for i in range(fluid.particles.count):
        x_i = fluid.particles.position[i]
        bound = 0.0
        first = fluid.near.start[i] + fluid.near.fluid_count[i] * fluid.near.stride
        for k in range(fluid.near.boundary_count[i]):
            b = fluid.near.indices[first + k * fluid.near.stride]
            if b >= sheets.first:
                r = distance(to_particle(fluid.samples, b, x_i).norm_sqr())
                bound -= answer[b - sheets.first] * spline_slope(r * fluid.inverse_support)
        inverse = inverse_diagonal[i]
        inverse_diagonal[i] = inverse / (1.0 + weight * gradient_factor * bound * inverse)


@kernel
def add_missing_weight(
    fluid: Fluid,
    near: NearParticles,
    sheets: Sheets,
    missing_volume: Floats,
    factor: ti.f32,
    one_side: OneSide,
    gravity_dt: ti.math.vec3,
    impulse: Vectors,
):
    """J_b += dt g rho0 V of the fluid that would be where samples keep it away, if they had no more volume than cloth.

    Nothing where it is on one side only, where the mean of the unit vectors to the particles, weighted by W, is
    `one_side.tilt` long; all of it from half of that on, which disorder alone may give on both sides; and less where
    the sum of V W is less than that on one side at rest.
    """
    for s in range(sheets.count):
        x_b = fluid.samples.position[sheets.first + s]
        m = sheets.skipped + s
        total = 0.0
        weighted = 0.0
        tilt = ti.math.vec3(0.0)
        for k in range(near.start[m], near.start[m] + near.count[m]):
            i = near.particles[k]
            x_ib = fluid.particles.position[i] - x_b
            r = distance(x_ib.norm_sqr())
            weight = spline(r * fluid.inverse_support)
            total += weight
            tilt += weight / (r + TINY_DISTANCE) * x_ib
            weighted += weight * fluid.materials.rest_density[fluid.particles.phase[i]]
        if total > 0.0:
            tilted = tilt.norm() / (one_side.tilt * total)
            part = ti.min(factor * total / one_side.field, 1.0) * ti.min(ti.max(2.0 - 2.0 * tilted, 0.0), 1.0)
            impulse[s] += part * missing_volume[s] * weighted / total * gravity_dt


@kernel
def take_sheet_motion(fluid: Fluid, contacts: Contacts, sheets: Sheets, change: Vectors, dt: ti.f32, box: Box):
    """v_i += sum_b phi_ib dv_b with m_i phi_ib = contact_i V_b W_ib, as if it had been so during the step.

    Who would pass a wall is put back onto it, as at the end of the fluid's own step.
    """
    for i in range(contacts.count):
        if contacts.mass[i] > 0.0:
            x_i = contacts.position[i]
            total = ti.math.vec3(0.0)
            first = fluid.near.start[i] + fluid.near.fluid_count[i] * fluid.near.stride
            for k in range(fluid.near.boundary_count[i]):
                b = fluid.near.indices[first + k * fluid.near.stride]
                if b >= sheets.first:
                    r = distance(to_particle(fluid.samples, b, x_i).norm_sqr())
                    total += fluid.samples.volume[b] * spline(r * fluid.inverse_support) * change[b - sheets.first]
            mass = fluid.volume * fluid.materials.rest_density[fluid.particles.phase[i]]
            dv = fluid.sigma * contacts.mass[i] / mass * total
            v_i = fluid.particles.velocity[i] + dv
            free = fluid.particles.position[i] + dt * dv
            x_end = ti.min(ti.max(free, box.wall_low), box.wall_high)
            for axis in ti.static(range(3)):
                if x_end[axis] != free[axis]:
                    v_i[axis] = 0.0
            fluid.particles.velocity[i] = v_i
            fluid.particles.position[i] = x_end
