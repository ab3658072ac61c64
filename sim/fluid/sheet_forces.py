"""Sheets in a fluid: what the fluid does to their samples, how these answer, and the fluid that moves along."""

from typing import Any

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.fluid.boundary import Boundary
from sim.fluid.kernels import normalization, particle_volume
from sim.fluid.sheet_kernels import (
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
from sim.solver import Arrays

DIVERGENCE, DENSITY = SOLVES = 0, 1
"""Solves of a step whose forces are expected to last apart from each other: of divergence, and of density with all
other forces."""

FULL_CONTACT = 0.5
"""Share of the density that samples give to fluid at rest beside them with which a particle touches them in full."""

NearList = tuple[ti.Ndarray, ti.Ndarray, ti.Ndarray]


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
        self, boundary: Boundary, sheets: SheetSamples, *, gravity: tuple[float, float, float], capacity: int,
        spacing: float, support_in_spacings: float, answers: bool,
    ) -> None:  # fmt: skip
        """Prepare for the sheets' samples of a boundary.

        Args:
            boundary: holds their positions, velocities and volumes.
            sheets: what they stand for.
            gravity: [m/s²].
            capacity: most particles that there can be.
            spacing: of the particles [m].
            support_in_spacings: support radius of the kernel.
            answers: whether samples answer within the fluid's step.
        """
        self._boundary, self.answers = boundary, answers
        self._gravity = ti.math.vec3(*gravity)
        support = support_in_spacings * spacing
        self._volume, self._sigma = particle_volume(spacing, support_in_spacings), normalization(support)
        self._inverse_support = 1.0 / support
        self._full_field = FULL_CONTACT * resting_field(support_in_spacings)
        self._one_side = one_sided_field(support_in_spacings), one_sided_tilt(support_in_spacings)
        count = boundary.sheet_count
        self._own_mass, self._missing_volume = _floats(sheets.own_mass), _floats(sheets.missing_volume)
        self.mass, self._answering_mass = ti.ndarray(ti.f32, count), ti.ndarray(ti.f32, count)
        self._answer = ti.ndarray(ti.f32, count)
        self.impulse, self.push = _zeros(count), _zeros(count)
        self._expected = [_zeros(count) for _ in SOLVES]
        self._found = [_zeros(count) for _ in SOLVES]
        self._solve = DIVERGENCE
        self._count = 0
        self._contact, self._start = ti.ndarray(ti.f32, capacity), ti.Vector.ndarray(3, ti.f32, capacity)

    def begin_step(self, near: NearList, particles: tuple[Any, ...], count: int) -> None:
        """Forget the impulses of the last step, and find the masses with which samples answer in this one.

        Args:
            near: particles near each moving sample.
            particles: their position, phase, neighbour list, and rest density of each phase, as kernels take them.
            count: number of particles.
        """
        self._expected, self._found = self._found, self._expected
        for vectors in (self.impulse, self.push, *self._found):
            clear_vectors(vectors, self._boundary.sheet_count)
        self._weigh(near, particles, count)
        if self.answers:
            take_larger(self.mass, self._own_mass, self._boundary.sheet_count, self._answering_mass)

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
        boundary = self._boundary
        skipped, count = boundary.body_sample_count, boundary.sheet_count
        count_impulses(force, skipped, count, dt, self._found[self._solve], self.impulse)
        if self.answers:
            self._push(force, skipped, dt)

    def accelerate(self, force: ti.Ndarray, acceleration: ti.Ndarray) -> None:
        """Fill in the accelerations of the sheets' samples by forces on the moving samples that are only tried."""
        boundary = self._boundary
        accelerate_sheet_samples(
            force, boundary.body_sample_count, boundary.sheet_count, self._answering_mass, boundary.first_sheet,
            acceleration,
        )  # fmt: skip

    def add_to_diagonal(
        self, near: NearList, particles: tuple[Any, ...], count: int, *, relaxation: float,
        inverse_diagonal: ti.Ndarray,
    ) -> None:  # fmt: skip
        """Add the sheets' share in A to its diagonal, such that relaxation by the diagonal converges.

        Their part of A is B_ij = V sum_b n_ib . n_jb / m_b with n_ib = V_b grad W_ib, and by Cauchy's inequality the
        diagonal matrix of V sum_b |n_ib| sum_j |n_jb| / m_b bounds it.

        Args:
            near: particles near each moving sample.
            particles: as for `begin_step`.
            count: number of particles.
            relaxation: omega that multiplies the inverse diagonal in the solve; the bound needs none.
            inverse_diagonal: 1/A_ii [kg/m]; becomes 1/(A_ii + omega times the bound).
        """
        boundary = self._boundary
        position, _, *neighbor_list = particles[:-1]
        gradient_factor = self._sigma * self._inverse_support
        sum_sheet_gradients(
            *self._samples, *near, position, gradient_factor, self._inverse_support, self._answering_mass, self._answer,
        )  # fmt: skip
        add_sheets_to_diagonal(
            position, count, *neighbor_list, boundary.position, boundary.first_sheet, self._answer, gradient_factor,
            self._inverse_support, relaxation * self._volume, inverse_diagonal,
        )  # fmt: skip

    def add_missing_weight(self, near: NearList, particles: tuple[Any, ...], dt: float) -> None:
        """Count the weight of the water that samples keep away and that a thin sheet would not, for a step of dt [s].

        Fluid keeps its distance from samples, as from a plate, and that plate would float. The water that is missing
        weighs on the sheet instead: what is lifted is the volume that the sheet has.

        Args:
            near: particles near each moving sample.
            particles: as for `begin_step`.
            dt: the step [s].
        """
        boundary = self._boundary
        position, phase, *_, rest_density = particles
        add_missing_weight(
            boundary.position, boundary.first_sheet, boundary.body_sample_count, boundary.sheet_count, *near,
            position, phase, rest_density, self._missing_volume, self._volume * self._sigma, *self._one_side,
            self._inverse_support, dt * self._gravity, self.impulse,
        )  # fmt: skip

    def take_motion(
        self, particles: tuple[Any, ...], velocity: ti.Ndarray, change: ti.Ndarray, dt: float, *, walls: Any
    ) -> None:
        """Give the fluid that touched at the start of the step these changes of velocity of the samples [m/s].

        Positions follow as if it had been so during the step of dt [s]; `walls`, two corners [m], hold them.
        """
        boundary = self._boundary
        position, phase, *neighbor_list, rest_density = particles
        take_sheet_motion(
            position, velocity, phase, self._start, self._contact, self._count, *neighbor_list,
            boundary.position, boundary.volume, boundary.first_sheet, change, rest_density, self._volume, self._sigma,
            self._inverse_support, dt, *(ti.math.vec3(*corner) for corner in walls),
        )  # fmt: skip

    def checkpoint(self) -> dict[str, NDArray[np.float32]]:
        """The forces of the last step, which the next one expects."""
        return {f"sheet_force_{solve}": force.to_numpy() for solve, force in enumerate(self._found)}

    def restore(self, arrays: Arrays) -> None:
        """Continue from a checkpoint."""
        for solve, force in enumerate(self._found):
            force.from_numpy(np.ascontiguousarray(arrays[f"sheet_force_{solve}"], dtype=np.float32))

    @property
    def _samples(self) -> tuple[Any, ...]:
        """Positions and volumes of all samples, the first of sheets among them and among moving ones, their number."""
        boundary = self._boundary
        return (
            boundary.position, boundary.volume, boundary.first_sheet, boundary.body_sample_count, boundary.sheet_count
        )  # fmt: skip

    def _push(self, force: ti.Ndarray, skipped: int, factor: float) -> None:
        boundary = self._boundary
        push_sheet_samples(
            force, skipped, boundary.sheet_count, factor, self._answering_mass, boundary.first_sheet,
            boundary.velocity, self.push,
        )  # fmt: skip

    def _weigh(self, near: NearList, particles: tuple[Any, ...], count: int) -> None:
        boundary = self._boundary
        self._count = count
        position, phase, *neighbor_list, rest_density = particles
        weigh_contacts(
            position, phase, count, *neighbor_list, boundary.position, boundary.volume, boundary.first_sheet,
            rest_density, self._volume, self._sigma, self._inverse_support, self._full_field, self._start,
            self._contact,
        )  # fmt: skip
        gather_contact_mass(
            *self._samples, *near, position, self._contact, self._sigma, self._inverse_support, self.mass
        )


def _zeros(count: int) -> ti.Ndarray:
    array = ti.Vector.ndarray(3, ti.f32, count)
    array.fill(0.0)
    return array


def _floats(values: NDArray[np.floating]) -> ti.Ndarray:
    array = ti.ndarray(ti.f32, len(values))
    array.from_numpy(np.asarray(values, dtype=np.float32))
    return array
