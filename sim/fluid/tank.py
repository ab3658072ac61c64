"""Particles of a tank with their neighbours, boundaries and emitters: all that a solver moves."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import taichi as ti

from sim.core.box import box_of
from sim.core.cells import CellGrid
from sim.core.neighbors import cells_per_radius
from sim.fluid.body_forces import BodyForces
from sim.fluid.boundary import BodyStates, Boundary, at_origin, states_of
from sim.fluid.boundary_akinci2012 import BoundarySamples
from sim.fluid.dye import DYE
from sim.fluid.emitter import Carrier, Emission
from sim.fluid.kernels import Discretization
from sim.fluid.particles import HOST_NAMES, Fluid, ParticleSet
from sim.fluid.sheets import SheetForces
from sim.fluid.stepping import MotionSummary, ParticleStepper
from sim.forces.field import ForceField, ForcesOn

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from sim.core.domain import DomainParameters
    from sim.core.parameters import Vector3
    from sim.core.solver import Arrays
    from sim.fluid.parameters import FluidParameters
    from sim.fluid.particles import Phases
    from sim.fluid.sheets import SheetSamples
    from sim.shapes.parameters import Placement


MEASURES = ("max_speed", "max_acceleration", "max_frequency", "max_displacement")  # of the last step, in a checkpoint


@dataclass(frozen=True, eq=False)
class FluidStart:
    """A tank of fluids as it starts; whoever moves bodies and sheets in it places them before the first step."""

    fluids: tuple[FluidParameters, ...]  # parameters of each fluid in the tank
    domain: DomainParameters  # the box they live in
    gravity: Vector3  # [m/s²]
    positions: NDArray[np.float32]  # of the particles [m], (n, 3), float32
    velocities: NDArray[np.float32]  # [m/s], (n, 3), float32
    boundary: BoundarySamples  # of walls and of bodies that never move
    phase: NDArray[np.int32] | None = None  # number of the fluid of each particle, (n,); 0 for all if omitted
    dye: NDArray[np.float32] | None = None  # concentration in each particle [-], (n,), float32; 0 for all if omitted
    moving: BoundarySamples = field(default_factory=BoundarySamples.of_bodies)  # about the centre of mass of each body
    sheets: SheetSamples | None = None
    body_count: int = 0  # moving bodies
    body_speed: float = 0.0  # largest speed of them to expect [m/s]
    followed: Mapping[str, Placement] = field(default_factory=dict)  # moving bodies that emitters follow, at the start
    carriers: Mapping[str, Carrier] = field(default_factory=dict)  # and which of the moving bodies they are
    capacity: int | None = None  # most particles that there can ever be; those at the start if omitted
    forces: ForceField | None = None  # from outside; none if omitted

    @cached_property
    def outer_forces(self) -> ForcesOn:
        """Those from outside on these fluids."""
        return (self.forces or ForceField(())).on([(fluid.name,) for fluid in self.fluids])


class ParticleTank:
    """Particles of equal volume in a box with walls and openings; one fluid, or several.

    A particle that would pass a closed face is put back onto it and counted as a wall contact;
    one that passes an open face is removed and counted.

    Attributes:
        particles: with their neighbours.
        boundary: samples of walls, bodies and sheets.
        body_forces: what the fluid exerts on bodies and sheets.
        outer_forces: those from outside on its fluids.
        emission: the emitters.
        motion: of the particles in the last step.
        last_speed: largest speed of a particle in the last step [m/s]; `motion` foresees the inflow as well.
        peak_speed: largest speed of this frame [m/s].
        body_speed, sheet_speed: largest speed of a sample of a body, and of a sheet [m/s].
        removed: particles removed since the start.
    """

    def __init__(
        self,
        start: FluidStart,
        phases: Phases,
        discretization: Discretization,
        *,
        skin: float,
        carried: tuple[str, ...],
        sheets_answer: bool,
        looks_ahead: bool,
    ) -> None:
        """Take particles, walls and bodies; `sim.fluid.fluid.SPHFluid` has the other arguments.

        Raises:
            ValueError: arrays of the wrong shape, not finite, or with particles outside the domain.
        """
        _check_particles(start)
        self.gravity, self.discretization, self._materials = start.gravity, discretization, phases.materials
        self._looks_ahead = looks_ahead
        self.outer_forces = start.outer_forces
        self.removed = 0
        self._travelled = self._boundary_travelled = 0.0
        self.body_speed = self.sheet_speed = 0.0
        self._box = box_of(start.domain)
        self._stepper = ParticleStepper(self._box)
        self._search_radius = (1.0 + skin) * discretization.support_radius
        reach, domain = cells_per_radius(discretization.support_in_spacings), start.domain
        self.grid = CellGrid.covering(np.array(domain.min), np.array(domain.max), self._search_radius, reach=reach)
        self.emission = Emission(
            start.fluids,
            discretization,
            self.grid,
            domain,
            start.gravity,
            bodies=start.followed,
            carriers=start.carriers,
        )
        fixed, moving = self.emission.open_mouths(start.boundary, start.moving)
        pistons = self.emission.piston_samples()
        self.boundary = Boundary(
            fixed,
            moving.with_bodies(pistons, first=start.body_count),
            is_smooth=self.emission.is_felt(start.boundary.positions),
            sheets=BoundarySamples.of_bodies() if start.sheets is None else start.sheets.boundary,
            body_count=start.body_count + len(pistons),
            grid=self.grid,
            discretization=discretization,
        )
        self._bodies = at_origin(start.body_count)
        self.body_forces = BodyForces(self.boundary, self.grid, self._search_radius)
        count = len(start.positions)
        capacity = max(start.capacity or 0, count)
        self.particles = ParticleSet(self.grid, capacity, carried=carried)
        if start.sheets is not None:
            self.body_forces.sheets = SheetForces(
                self.boundary,
                start.sheets,
                gravity=start.gravity,
                capacity=self.particles.capacity,
                discretization=discretization,
                answers=sheets_answer,
            )
        self._without_neighbors = False
        self._next_particle_id = count
        self.particles.load(
            {
                "position": np.ascontiguousarray(start.positions, dtype=np.float32),
                "velocity": np.ascontiguousarray(start.velocities, dtype=np.float32),
                "particle_id": np.arange(count, dtype=np.int32),
                "phase": np.zeros(count, np.int32) if start.phase is None else start.phase.astype(np.int32),
                DYE: np.zeros(count, np.float32) if start.dye is None else start.dye.astype(np.float32),
            }
        )
        self.last_speed = float(np.sqrt((np.asarray(start.velocities, np.float64) ** 2).sum(axis=1).max(initial=0.0)))
        strongest = float(np.linalg.norm(start.gravity)) + self.outer_forces.largest_acceleration
        self.motion = MotionSummary(self.last_speed, strongest)
        self.emission.carry(self._bodies)
        if pistons:
            self._place_bodies()
        self._expect_inflow()
        self.begin_frame()
        self.find_neighbors()

    @property
    def on_device(self) -> Fluid:
        """The fluid as kernels read it."""
        particles, d = self.particles, self.discretization
        arrays = particles.arrays, particles.neighbors.lists, self.boundary.samples, self._materials
        return Fluid(*arrays, d.particle_volume, d.sigma, d.inverse_support)

    @property
    def boundary_speed(self) -> float:
        """Largest speed of a boundary sample [m/s]."""
        return float(np.maximum(self.body_speed, self.sheet_speed))  # which is NaN where either is

    def begin_frame(self) -> None:
        """Restart the counters of the frame, and its largest speed at the present one."""
        self.peak_speed = self.motion.max_speed
        self._wall_contacts = self._neighbor_searches = self._substeps = 0
        self.emission.begin_frame()

    def move_bodies(self, states: BodyStates, *, elapsed_s: float) -> None:
        """Put the moving bodies where they are; 0 s have elapsed since the last time where they are put there anew."""
        # As a checkpoint holds them: a run that continues finds the same.
        self._bodies = BodyStates(*(each.astype(np.float32).astype(np.float64) for each in states))
        self.emission.carry(self._bodies)
        self._place_bodies()
        spin = np.linalg.norm(states.angular_velocity, axis=1)
        speed = np.linalg.norm(states.velocity, axis=1) + spin * self.boundary.reach[: len(spin)]
        speed += self.boundary.deforming_speed[: len(spin)]
        self.body_speed = float(speed.max(initial=0.0))
        self._without_neighbors |= elapsed_s == 0.0

    def sheets_moved(self, distance: float, speed: float, *, elapsed_s: float) -> None:
        """Take note that the samples of sheets were placed anew: largest displacement [m] and speed of one [m/s].

        `elapsed_s` is the time since they were placed last [s]; 0 where they are put there anew.
        """
        self._boundary_travelled += distance
        self.sheet_speed = speed
        self._without_neighbors |= elapsed_s == 0.0

    def take_sheet_motion(self, change: ti.Ndarray, largest_change: float, dt: float) -> None:
        """Let the fluid that touched sheets in the last step, of dt [s], move along with them.

        `change` is what the velocity of each sample of a sheet differs by from what that step took it for [m/s], and
        `largest_change` the norm of the largest of them.
        """
        sheets = self.body_forces.sheets
        assert sheets is not None
        sheets.take_motion(self.on_device, change, dt, self._box)
        self._travelled += dt * largest_change
        self.motion = replace(self.motion, max_speed=self.motion.max_speed + largest_change)

    def advance(self, acceleration: ti.Ndarray, dt: float, frequency_squared: ti.Ndarray | None = None) -> None:
        """v_i += dt a_i, x_i += dt v_i, within the walls; then the emitters.

        `frequency_squared` is that at which each particle can swing against its own pressure [1/s²].
        """
        particles = self.particles
        self.emission.hold_last_layers(particles, acceleration)
        self.motion = self._stepper.advance(
            particles.position, particles.velocity, acceleration, particles.count, dt, frequency_squared
        )
        emitted = self.emission.advance(particles, dt, self._next_particle_id)
        self._next_particle_id += emitted
        self._without_neighbors |= emitted > 0
        if self.emission.openings:
            self._place_bodies()
        self.last_speed = self.motion.max_speed
        self.peak_speed = max(self.peak_speed, self.motion.max_speed)
        self._expect_inflow()
        self._travelled += self.motion.max_displacement
        self._wall_contacts += self.motion.touched
        self._substeps += 1

    def forget_neighbors(self) -> None:
        """Have the neighbours found anew before they are needed next: particles changed places."""
        self._without_neighbors = True

    def update_neighbors(self) -> None:
        """Find the neighbours anew where a pair could have closed the skin between them, or particles left or came."""
        travelled = self._travelled + (self.motion.max_displacement if self._looks_ahead else 0.0)
        closed = travelled + max(travelled, self._boundary_travelled)
        skin = self._search_radius - self.discretization.support_radius
        if self._without_neighbors or self.motion.left or closed > skin:
            self.find_neighbors()

    def find_neighbors(self) -> None:
        """Sort the particles, drop those that left, and list the neighbours of all others."""
        particles = self.particles
        self.removed += particles.sort(self._box.keep_low, self._box.keep_high)
        points, count, fixed = particles.sorted_points, particles.count, self.boundary.fixed_points
        moving = self.boundary.sort_moving(), self.boundary.moving_index
        particles.neighbors.build(self._search_radius, points, count, fixed, *moving)
        self.body_forces.find_particles(particles.sorted_points)
        self._travelled = self._boundary_travelled = 0.0
        self._without_neighbors = False
        self.motion = replace(self.motion, left=0)
        self._neighbor_searches += 1

    def counters(self) -> dict[str, float]:
        """Counts of this frame, and of particles removed since the start."""
        return {
            "particles_removed": float(self.removed),
            **self.emission.diagnostics(),
            "wall_contacts": float(self._wall_contacts),
            "neighbor_searches": float(self._neighbor_searches),
            "substeps": float(self._substeps),
        }

    def checkpoint(self) -> dict[str, NDArray[np.generic]]:
        """The particles in the order of the neighbour list, and the positions that it was made from."""
        self.update_neighbors()
        return self._state()

    def _state(self) -> dict[str, NDArray[np.generic]]:
        particles, sheets = self.particles, self.body_forces.sheets
        reference = particles.sorted_points[:3]
        return {
            **particles.host_arrays(),
            **self.boundary.checkpoint(),
            **self.emission.checkpoint(),
            "reference_position": np.stack([particles.host(axis) for axis in reference], axis=1),
            "travelled": np.array([self._travelled], dtype=np.float64),
            "boundary_travelled": np.array([self._boundary_travelled], dtype=np.float64),
            "boundary_speed": np.array([self.body_speed, self.sheet_speed], dtype=np.float64),
            **{measure: np.array([getattr(self.motion, measure)], dtype=np.float64) for measure in MEASURES},
            "particles_removed": np.array([self.removed], dtype=np.int64),
            "next_particle_id": np.array([self._next_particle_id], dtype=np.int64),
            **({} if sheets is None else sheets.checkpoint()),
        }

    def restore(self, arrays: Arrays, name: str) -> None:
        """Continue from a checkpoint bit for bit.

        Raises:
            ValueError: the arrays are not a checkpoint of the fluid of this name.
        """
        particles = self.particles
        self._check_checkpoint(arrays, name)
        # The neighbour list has to be made from the positions it was made from before, then all move on.
        particles.load({**arrays, "position": arrays["reference_position"]})
        self.boundary.restore_reference(arrays)
        self.find_neighbors()
        particles.load(arrays)
        self.boundary.restore(arrays)
        self.body_speed, self.sheet_speed = arrays["boundary_speed"].tolist()
        self._travelled = float(arrays["travelled"][0])
        self._boundary_travelled = float(arrays["boundary_travelled"][0])
        self.motion = MotionSummary(**{measure: float(arrays[measure][0]) for measure in MEASURES})
        self.removed = int(arrays["particles_removed"][0])
        self._next_particle_id = int(arrays["next_particle_id"][0])
        self.emission.restore(arrays)
        count = len(self._bodies.position)
        self._bodies = BodyStates(*(each[:count] for each in states_of(arrays["body_states"].astype(np.float64))))
        self.emission.carry(self._bodies)
        self.peak_speed = self.motion.max_speed
        if self.body_forces.sheets is not None:
            self.body_forces.sheets.restore(arrays)

    def _check_checkpoint(self, arrays: Arrays, name: str) -> None:
        """Refuse arrays that are no checkpoint of this tank, whatever the number of particles."""
        expected = self._state()
        if missing := sorted(set(expected) - set(arrays)):
            raise ValueError(f'not a checkpoint of "{name}": it lacks {", ".join(missing)}')
        count, capacity = len(arrays["particle_id"]), self.particles.capacity
        if count > capacity:
            raise ValueError(f'the checkpoint has {count} particles, "{name}" has room for {capacity}')
        of_particles = {*HOST_NAMES, *self.particles.carried, "reference_position"}
        for key, own in expected.items():
            found, shape = arrays[key], (count, *own.shape[1:]) if key in of_particles else own.shape
            if found.shape != shape or found.dtype != own.dtype:
                raise ValueError(
                    f'checkpoint of "{name}": {key} must be {own.dtype} {shape}, got {found.dtype} {found.shape}'
                )

    def _place_bodies(self) -> None:
        """Put the samples of moving bodies and of the emitters' pistons where these are."""
        states = BodyStates(*map(np.concatenate, zip(self._bodies, self.emission.pistons(), strict=True)))
        self._boundary_travelled += self.boundary.place(states)

    def _expect_inflow(self) -> None:
        """Let the next time step be right for what flows in during it."""
        self.motion = replace(self.motion, max_speed=max(self.motion.max_speed, self.emission.speed))


def _check_particles(start: FluidStart) -> None:
    """Refuse particles of the wrong shape, not finite, or outside the domain."""
    positions, velocities, domain = start.positions, start.velocities, start.domain
    if positions.ndim != 2 or positions.shape[1] != 3 or velocities.shape != positions.shape:
        raise ValueError(f"positions and velocities must both be (n, 3), got {positions.shape} and {velocities.shape}")
    if not (np.isfinite(positions).all() and np.isfinite(velocities).all()):
        raise ValueError("positions and velocities must be finite numbers")
    outside = ((positions < np.float32(domain.min)) | (positions > np.float32(domain.max))).any(axis=1).sum()
    if outside:
        raise ValueError(f"{outside} of {len(positions)} particles start outside the domain")
