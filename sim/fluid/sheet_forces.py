"""Sheets in a fluid: what the fluid does to their samples, how these answer, and the fluid that moves along."""

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.arrays import on_device
from sim.core.parameters import Vector3
from sim.core.solver import Arrays
from sim.fluid.boundary import Boundary, NearParticles
from sim.fluid.device import Fluid
from sim.fluid.discretization import Discretization
from sim.fluid.sheet_kernels import (
    Contacts,
    OneSide,
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

# Solves of a step whose forces last apart from each other: of divergence, and of density with all other forces.
DIVERGENCE, DENSITY = 0, 1

# Share of the density that samples give to fluid at rest beside them with which a particle touches them in full.
FULL_CONTACT = 0.5


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
        self._solve = DIVERGENCE
        self._contacts = Contacts(ti.Vector.ndarray(3, ti.f32, capacity), ti.ndarray(ti.f32, capacity), 0)

    def begin_step(self, fluid: Fluid, near: NearParticles) -> None:
        """Forget the impulses of the last step, and find the masses with which samples answer in this one."""
        sheets = self._boundary.sheets
        self._expected, self._found = self._found, self._expected
        for vectors in (self.impulse, self.push, *self._found):
            clear_vectors(vectors, sheets.count)
        self._contacts = self._contacts._replace(count=fluid.particles.count)
        weigh_contacts(fluid, sheets, self._full_field, self._contacts)
        gather_contact_mass(fluid, near, sheets, self._contacts.mass, self.mass)
        if self.answers:
            take_larger(self.mass, self._own_mass, sheets.count, self._answering_mass)

    def begin_solve(self, solve: int) -> None:
        """From now on forces count as those of this solve of the step, `DIVERGENCE` or `DENSITY`."""
        self._solve = solve

    def recoil(self, dt: float) -> None:
        """Push the samples for dt [s] by the opposite of what acted on them in this solve of the last step."""
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
        sum_sheet_gradients(fluid, near, sheets, gradient_factor, self._answering_mass, self._answer)
        add_sheets_to_diagonal(fluid, sheets, self._answer, gradient_factor, weight, inverse_diagonal)

    def add_missing_weight(self, fluid: Fluid, near: NearParticles, dt: float) -> None:
        """Count the weight of the water that samples keep away and that a thin sheet would not, for a step of dt [s].

        Fluid keeps its distance from samples, as from a plate, and that plate would float. The water that is missing
        weighs on the sheet instead: what is lifted is the volume that the sheet has.
        """
        d = self._discretization
        add_missing_weight(
            fluid,
            near,
            self._boundary.sheets,
            self._missing_volume,
            d.particle_volume * d.sigma,
            self._one_side,
            dt * self._gravity,
            self.impulse,
        )

    def take_motion(self, fluid: Fluid, change: ti.Ndarray, dt: float, walls: tuple[Vector3, Vector3]) -> None:
        """Give the fluid that touched at the start of the step of dt [s] the changes of velocity of the samples [m/s].

        Positions follow as if it had been so during the step, up to the walls, two corners [m].
        """
        take_sheet_motion(fluid, self._contacts, self._boundary.sheets, change, dt, *walls)

    def checkpoint(self) -> dict[str, NDArray[np.float32]]:
        """The forces of the last step, which the next one expects."""
        return {f"sheet_force_{solve}": force.to_numpy() for solve, force in enumerate(self._found)}

    def restore(self, arrays: Arrays) -> None:
        """Continue from a checkpoint."""
        for solve, force in enumerate(self._found):
            force.from_numpy(np.ascontiguousarray(arrays[f"sheet_force_{solve}"]))

    def _push(self, force: ti.Ndarray, skipped: int, factor: float) -> None:
        push_sheet_samples(
            force,
            self._boundary.sheets._replace(skipped=skipped),
            factor,
            self._answering_mass,
            self._boundary.samples,
            self.push,
        )
