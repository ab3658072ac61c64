"""Particles of a tank with their neighbours, boundaries and emitters: all that a solver moves."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
import taichi as ti

from sim.core.cells import CellGrid
from sim.core.neighbors import cells_per_radius
from sim.fluid.body_forces import BodyForces
from sim.fluid.boundary import Boundary
from sim.fluid.boundary_akinci2012 import BoundarySamples
from sim.fluid.box import Box, check_particles
from sim.fluid.checkpoints import check_checkpoint
from sim.fluid.discretization import Discretization
from sim.fluid.emitter import Emission
from sim.fluid.nozzles import is_felt_in_nozzles
from sim.fluid.particles import ParticleSet
from sim.fluid.sheet_forces import SheetForces
from sim.fluid.stepping import MotionSummary, ParticleStepper

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sim.core.domain import DomainParameters
    from sim.core.parameters import Vector3
    from sim.core.solver import Arrays
    from sim.fluid.parameters import FluidParameters
    from sim.fluid.phases import Phases
    from sim.fluid.sheet_samples import SheetSamples


@dataclass(frozen=True, eq=False)
class FluidStart:
    """A tank of fluids as it starts.

    Attributes:
        fluids: parameters of each fluid in the tank.
        domain: the box they live in.
        gravity: acceleration [m/s²].
        positions: particles [m], (n, 3), float32.
        velocities: their velocities [m/s], (n, 3), float32.
        boundary: samples of walls and of bodies that never move.
        phase: number of the fluid of each particle, (n,); 0 for all if omitted.
        moving: samples of moving bodies, relative to the centre of mass and in the axes of each.
        sheets: samples of sheets, which whoever moves these has to place before the first step.
        body_count: number of moving bodies; `ParticleTank.move_bodies` has to place them before the first step.
        body_speed: largest speed of moving bodies to expect [m/s].
        capacity: most particles that there can ever be; those at the start if omitted.
    """

    fluids: tuple[FluidParameters, ...]
    domain: DomainParameters
    gravity: Vector3
    positions: NDArray[np.float32]
    velocities: NDArray[np.float32]
    boundary: BoundarySamples
    phase: NDArray[np.int32] | None = None
    moving: BoundarySamples = field(default_factory=BoundarySamples.of_bodies)
    sheets: SheetSamples | None = None
    body_count: int = 0
    body_speed: float = 0.0
    capacity: int | None = None


class ParticleTank:
    """Particles of equal volume in a box with walls and openings; one fluid, or several.

    A particle that would pass a closed face is put back onto it and counted as a wall contact;
    one that passes an open face is removed and counted.

    Attributes:
        gravity: [m/s²].
        discretization: of all fluids.
        particles: with their neighbours.
        boundary: samples of walls, bodies and sheets.
        body_forces: what the fluid exerts on bodies and sheets.
        emission: the emitters.
        motion: of the particles in the last step.
        last_speed: largest speed of a particle in the last step [m/s]; `motion` foresees the inflow as well.
        peak_speed: largest speed of this frame [m/s].
        body_speed: largest speed of a sample of a body [m/s].
        sheet_speed: and of one of a sheet [m/s].
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
        """Take particles, walls and bodies.

        Args:
            start: all of them.
            phases: materials of the particles.
            discretization: of the fluids.
            skin: reach of the neighbour list beyond the support [support radii].
            carried: scalars per particle that its solver keeps from step to step, by name.
            sheets_answer: whether sheets answer to pressures that are tried within a step.
            looks_ahead: whether the next step looks at particles as far ahead as they went in the last one.

        Raises:
            ValueError: arrays of the wrong shape, not finite, or with particles outside the domain.
        """
        check_particles(start.positions, start.velocities, start.domain)
        self.gravity, self.discretization = start.gravity, discretization
        self._looks_ahead = looks_ahead
        self.removed = 0
        self._travelled = self._boundary_travelled = 0.0
        self.body_speed = self.sheet_speed = 0.0
        self._box = Box.of_domain(start.domain)
        self._stepper = ParticleStepper(self._box)
        self._search_radius = (1.0 + skin) * discretization.support_radius
        self.grid = CellGrid.covering_as_finely_as_fits(
            np.array(start.domain.min),
            np.array(start.domain.max),
            self._search_radius,
            reach=cells_per_radius(discretization.support_in_spacings),
        )
        self.emission = Emission(start.fluids, discretization, self.grid)
        sheets = BoundarySamples.of_bodies() if start.sheets is None else start.sheets.boundary
        self.boundary = Boundary(
            start.boundary,
            start.moving,
            is_smooth=is_felt_in_nozzles(
                start.boundary.positions, self.emission.openings, discretization.support_radius
            ),
            sheets=sheets,
            body_count=start.body_count,
            grid=self.grid,
            discretization=discretization,
        )
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
                materials=phases.materials,
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
            }
        )
        largest = float(np.sqrt((np.asarray(start.velocities, np.float64) ** 2).sum(axis=1).max(initial=0.0)))
        self.motion = MotionSummary(max_speed=largest, max_acceleration=float(np.linalg.norm(start.gravity)))
        self.last_speed = largest
        self._expect_inflow()
        self.begin_frame()
        self.find_neighbors()

    @property
    def boundary_speed(self) -> float:
        """Largest speed of a boundary sample [m/s]."""
        return float(np.maximum(self.body_speed, self.sheet_speed))  # which is NaN where either is

    def begin_frame(self) -> None:
        """Restart the counters of the frame, and its largest speed at the present one."""
        self.peak_speed = self.motion.max_speed
        self._wall_contacts = self._neighbor_searches = self._substeps = 0
        self.emission.begin_frame()

    def move_bodies(
        self,
        position: NDArray[np.float64],
        rotation: NDArray[np.float64],
        velocity: NDArray[np.float64],
        angular_velocity: NDArray[np.float64],
        *,
        elapsed_s: float,
    ) -> None:
        """Put the moving bodies where they are now.

        Args:
            position: centres of mass [m], (bodies, 3).
            rotation: from body to world axes, (bodies, 3, 3).
            velocity: of the centres of mass [m/s], (bodies, 3).
            angular_velocity: [rad/s], (bodies, 3).
            elapsed_s: time since they were placed last [s]; 0 where they are put there anew.
        """
        self._boundary_travelled += self.boundary.place(position, rotation, velocity, angular_velocity)
        speed = np.linalg.norm(velocity, axis=1) + np.linalg.norm(angular_velocity, axis=1) * self.boundary.reach
        self.body_speed = float(speed.max(initial=0.0))
        self._without_neighbors |= elapsed_s == 0.0

    def sheets_moved(self, distance: float, speed: float, *, elapsed_s: float) -> None:
        """Take note that the samples of sheets were placed anew.

        Args:
            distance: largest displacement of one of them [m].
            speed: the largest of them [m/s].
            elapsed_s: time since they were placed last [s]; 0 where they are put there anew.
        """
        self._boundary_travelled += distance
        self.sheet_speed = speed
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
        sheets.take_motion(self.particles, change, dt, self._box.walls)
        self._travelled += dt * largest_change
        self.motion = replace(self.motion, max_speed=self.motion.max_speed + largest_change)

    def advance(self, acceleration: ti.Ndarray, dt: float, frequency_squared: ti.Ndarray | None = None) -> None:
        """v_i += dt a_i, x_i += dt v_i, within the walls; then the emitters.

        Args:
            acceleration: of the particles [m/s²]; 0 afterwards for those in a nozzle.
            dt: the step [s].
            frequency_squared: square of the frequency at which each particle can swing [1/s²].
        """
        particles = self.particles
        self.emission.drive(particles, acceleration)
        self.motion = self._stepper.advance(
            particles.position, particles.velocity, acceleration, particles.count, dt, frequency_squared
        )
        emitted = self.emission.advance(particles, dt, self._next_particle_id)
        self._next_particle_id += emitted
        self._without_neighbors |= emitted > 0
        self.last_speed = self.motion.max_speed
        self.peak_speed = max(self.peak_speed, self.motion.max_speed)
        self._expect_inflow()
        self._travelled += self.motion.max_displacement
        self._wall_contacts += self.motion.touched
        self._substeps += 1

    def update_neighbors(self) -> None:
        """Find the neighbours anew where a pair could have closed the skin between them, or particles left or came.

        Whatever reads the neighbours asks for this first; so bodies and particles both have moved by then.
        """
        travelled = self._travelled + (self.motion.max_displacement if self._looks_ahead else 0.0)
        closed = travelled + max(travelled, self._boundary_travelled)
        skin = self._search_radius - self.discretization.support_radius
        if self._without_neighbors or self.motion.left or closed > skin:
            self.find_neighbors()

    def find_neighbors(self) -> None:
        """Sort the particles, drop those that left, and list the neighbours of all others."""
        particles = self.particles
        self.removed += particles.sort(*self._box.openings)
        particles.neighbors.build(
            self._search_radius,
            particles.sorted_points,
            particles.count,
            self.boundary.fixed_points,
            self.boundary.sort_moving(),
            self.boundary.moving_index,
        )
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
        particles, motion = self.particles, self.motion
        reference = particles.sorted_points[:3]
        sheets = self.body_forces.sheets
        return {
            **particles.host_arrays(),
            **self.boundary.checkpoint(),
            **self.emission.checkpoint(),
            "reference_position": np.stack([particles.host(axis) for axis in reference], axis=1),
            "travelled": np.array([self._travelled], dtype=np.float64),
            "boundary_travelled": np.array([self._boundary_travelled], dtype=np.float64),
            "boundary_speed": np.array([self.body_speed, self.sheet_speed], dtype=np.float64),
            "max_speed": np.array([motion.max_speed], dtype=np.float64),
            "max_acceleration": np.array([motion.max_acceleration], dtype=np.float64),
            "max_frequency": np.array([motion.max_frequency], dtype=np.float64),
            "max_displacement": np.array([motion.max_displacement], dtype=np.float64),
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
        check_checkpoint(
            arrays,
            name,
            capacity=particles.capacity,
            carried=tuple(particles.carried),
            body_states=self.boundary.bodies.states.shape,
            sheet_samples=self.boundary.sheet_count,
        )
        # The neighbour list has to be made from the positions it was made from before, then all move on.
        particles.load({**arrays, "position": arrays["reference_position"]})
        self.boundary.restore_reference(arrays)
        self.find_neighbors()
        particles.load(arrays)
        self.boundary.restore(arrays)
        self.body_speed, self.sheet_speed = arrays["boundary_speed"].tolist()
        self._travelled = float(arrays["travelled"][0])
        self._boundary_travelled = float(arrays["boundary_travelled"][0])
        measures = ("max_speed", "max_acceleration", "max_frequency", "max_displacement")
        self.motion = MotionSummary(**{measure: float(arrays[measure][0]) for measure in measures})
        self.removed = int(arrays["particles_removed"][0])
        self._next_particle_id = int(arrays["next_particle_id"][0])
        self.emission.restore(arrays)
        self.peak_speed = self.motion.max_speed
        if self.body_forces.sheets is not None:
            self.body_forces.sheets.restore(arrays)

    def _expect_inflow(self) -> None:
        """Let the next time step be right for what flows in during it."""
        self.motion = replace(self.motion, max_speed=max(self.motion.max_speed, self.emission.speed))
