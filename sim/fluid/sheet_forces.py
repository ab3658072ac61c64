"""Sheets in a fluid: what the fluid does to their samples, how these answer, and the fluid that moves along."""

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.solver import Arrays
from sim.fluid.boundary import Boundary, NearParticles
from sim.fluid.discretization import Discretization
from sim.fluid.particles import ParticleSet
from sim.fluid.phases import Materials
from sim.fluid.sheet_kernels import (
    Contacts,
    accelerate_sheet_samples,
    add_missing_weight,
    add_sheets_to_diagonal,
    clear_vectors,
    count_impulses,
    gather_contact_mass,
    push_sheet_samples,
    sum_sheet_gradients,
    take_larger,
    take_sheet_motion,
    weigh_contacts,
)
from sim.fluid.sheet_samples import SheetSamples, one_sided_field, one_sided_tilt, resting_field

DIVERGENCE, DENSITY = SOLVES = 0, 1
"""Solves of a step whose forces are expected to last apart from each other: of divergence, and of density with all
other forces."""

FULL_CONTACT = 0.5
"""Share of the density that samples give to fluid at rest beside them with which a particle touches them in full."""


class SheetForces:
    """Forces of a fluid on the samples of sheets, and what becomes of the fluid that touches them.

    Water is a hundred times as heavy as the cloth that holds it, and the cloth's springs are stiffer than that. So
    neither may a sheet be a wall for the fluid, and take the forces after the step (it would be thrown back and forth
    by the fluid it has to move), nor be as light as it is: fluid and cloth take their steps one after the other, each
    with a Robin condition for what the other will do (Burman, Durst & Guzmán 2022). The weight of the
    condition is a mass that exists, that of the fluid that touches the sheet. So momentum is kept exactly:

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
    """

    def __init__(
        self,
        boundary: Boundary,
        sheets: SheetSamples,
        *,
        gravity: tuple[float, float, float],
        capacity: int,
        discretization: Discretization,
        materials: Materials,
        answers: bool,
    ) -> None:
        """Prepare for the sheets' samples of a boundary.

        Args:
            boundary: holds their positions, velocities and volumes.
            sheets: what they stand for.
            gravity: [m/s²].
            capacity: most particles that there can be.
            discretization: of the fluid.
            materials: of its particles.
            answers: whether samples answer within the fluid's step.
        """
        self._boundary, self.answers, self._discretization = boundary, answers, discretization
        self._materials = materials
        self._gravity = ti.math.vec3(*gravity)
        support = discretization.support_in_spacings
        self._full_field = FULL_CONTACT * resting_field(support)
        self._one_side = one_sided_field(support), one_sided_tilt(support)
        count = boundary.sheet_count
        self._own_mass, self._missing_volume = _floats(sheets.own_mass), _floats(sheets.missing_volume)
        self.mass, self._answering_mass = ti.ndarray(ti.f32, count), ti.ndarray(ti.f32, count)
        self._answer = ti.ndarray(ti.f32, count)
        self.impulse, self.push = _zeros(count), _zeros(count)
        self._expected = [_zeros(count) for _ in SOLVES]
        self._found = [_zeros(count) for _ in SOLVES]
        self._solve = DIVERGENCE
        self._contacts = Contacts(ti.Vector.ndarray(3, ti.f32, capacity), ti.ndarray(ti.f32, capacity), 0)

    def begin_step(self, particles: ParticleSet, near: NearParticles) -> None:
        """Forget the impulses of the last step, and find the masses with which samples answer in this one."""
        boundary, smoothing = self._boundary, self._discretization.smoothing
        self._expected, self._found = self._found, self._expected
        for vectors in (self.impulse, self.push, *self._found):
            clear_vectors(vectors, boundary.sheet_count)
        self._contacts = self._contacts._replace(count=particles.count)
        weigh_contacts(
            particles.arrays,
            particles.near,
            self._materials,
            boundary.samples,
            boundary.sheets,
            smoothing,
            self._full_field,
            self._contacts,
        )
        gather_contact_mass(
            particles.arrays,
            near,
            boundary.samples,
            boundary.sheets,
            smoothing,
            self._contacts.mass,
            self.mass,
        )
        if self.answers:
            take_larger(self.mass, self._own_mass, boundary.sheet_count, self._answering_mass)

    def begin_solve(self, solve: int) -> None:
        """From now on forces count as those of this solve of the step, `DIVERGENCE` or `DENSITY`."""
        self._solve = solve

    def recoil(self, dt: float) -> None:
        """Push the samples by the opposite of what acted on them in this solve of the last step, as springs did then.

        Args:
            dt: the step [s].
        """
        if self.answers:
            self._push(self._expected[self._solve], 0, -dt)

    def count_forces(self, force: ti.Ndarray, dt: float) -> None:
        """Count forces on the moving samples [N] for a step of dt [s]; those of sheets answer to them."""
        sheets = self._boundary.sheets
        count_impulses(force, sheets, dt, self._found[self._solve], self.impulse)
        if self.answers:
            self._push(force, sheets.skipped, dt)

    def accelerate(self, force: ti.Ndarray, acceleration: ti.Ndarray) -> None:
        """Fill in the accelerations of the sheets' samples by forces on the moving samples that are only tried."""
        accelerate_sheet_samples(force, self._boundary.sheets, self._answering_mass, acceleration)

    def add_to_diagonal(
        self, particles: ParticleSet, near: NearParticles, relaxation: float, inverse_diagonal: ti.Ndarray
    ) -> None:
        """Add the sheets' share in A to its diagonal, such that relaxation by the diagonal converges.

        Their part of A is B_ij = V sum_b n_ib . n_jb / m_b with n_ib = V_b grad W_ib, and by Cauchy's inequality the
        diagonal matrix of V sum_b |n_ib| sum_j |n_jb| / m_b bounds it.

        Args:
            particles: of the fluid.
            near: those near each moving sample.
            relaxation: omega that multiplies the inverse diagonal in the solve; the bound needs none.
            inverse_diagonal: 1/A_ii [kg/m]; becomes 1/(A_ii + omega times the bound).
        """
        samples, sheets = self._boundary.samples, self._boundary.sheets
        inverse_support = self._discretization.smoothing.inverse_support
        gradient_factor = self._discretization.sigma * inverse_support
        weight = relaxation * self._discretization.particle_volume
        sum_sheet_gradients(
            particles.arrays,
            near,
            samples,
            sheets,
            gradient_factor,
            inverse_support,
            self._answering_mass,
            self._answer,
        )
        add_sheets_to_diagonal(
            particles.arrays,
            particles.near,
            samples,
            sheets,
            self._answer,
            gradient_factor,
            inverse_support,
            weight,
            inverse_diagonal,
        )

    def add_missing_weight(self, particles: ParticleSet, near: NearParticles, dt: float) -> None:
        """Count the weight of the water that samples keep away and that a thin sheet would not, for a step of dt [s].

        Fluid keeps its distance from samples, as from a plate, and that plate would float. The water that is missing
        weighs on the sheet instead: what is lifted is the volume that the sheet has.
        """
        boundary, d = self._boundary, self._discretization
        add_missing_weight(
            particles.arrays,
            near,
            self._materials,
            boundary.samples,
            boundary.sheets,
            self._missing_volume,
            d.particle_volume * d.sigma,
            *self._one_side,
            d.smoothing.inverse_support,
            dt * self._gravity,
            self.impulse,
        )

    def take_motion(
        self,
        particles: ParticleSet,
        change: ti.Ndarray,
        dt: float,
        walls: tuple[tuple[float, float, float], tuple[float, float, float]],
    ) -> None:
        """Give the fluid that touched at the start of the step the changes of velocity of the samples.

        Positions follow as if it had been so during the step.

        Args:
            particles: of the fluid.
            change: of the velocity of each sample [m/s].
            dt: the step [s].
            walls: two corners that hold the particles [m].
        """
        boundary, smoothing = self._boundary, self._discretization.smoothing
        take_sheet_motion(
            particles.arrays,
            particles.near,
            self._materials,
            self._contacts,
            boundary.samples,
            boundary.sheets,
            change,
            smoothing,
            dt,
            walls[0],
            walls[1],
        )

    def checkpoint(self) -> dict[str, NDArray[np.float32]]:
        """The forces of the last step, which the next one expects."""
        return {f"sheet_force_{solve}": force.to_numpy() for solve, force in enumerate(self._found)}

    def restore(self, arrays: Arrays) -> None:
        """Continue from a checkpoint."""
        for solve, force in enumerate(self._found):
            force.from_numpy(np.ascontiguousarray(arrays[f"sheet_force_{solve}"], dtype=np.float32))

    def _push(self, force: ti.Ndarray, skipped: int, factor: float) -> None:
        push_sheet_samples(
            force,
            self._boundary.sheets._replace(skipped=skipped),
            factor,
            self._answering_mass,
            self._boundary.samples,
            self.push,
        )


def _zeros(count: int) -> ti.Ndarray:
    array = ti.Vector.ndarray(3, ti.f32, count)
    array.fill(0.0)
    return array


def _floats(values: NDArray[np.floating]) -> ti.Ndarray:
    array = ti.ndarray(ti.f32, len(values))
    array.from_numpy(np.asarray(values, dtype=np.float32))
    return array
