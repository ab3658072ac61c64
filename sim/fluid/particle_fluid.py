"""What all particle fluids share: particles in a box, their neighbours, the state they save and report."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import taichi as ti

from sim.cells import CellGrid
from sim.fluid.body_forces import BodyForces
from sim.fluid.boundary import Boundary
from sim.fluid.boundary_akinci2012 import BoundarySamples
from sim.fluid.box import Box, check_particles
from sim.fluid.checkpoints import check_checkpoint
from sim.fluid.emitter import Emission
from sim.fluid.kernels import normalization, particle_volume
from sim.fluid.nozzles import is_felt_in_nozzles
from sim.fluid.particles import ParticleSet
from sim.fluid.phases import Phases
from sim.fluid.stepping import MotionSummary, ParticleStepper
from sim.neighbors import cells_per_radius
from sim.snapshots import Snapshot
from sim.solver import Remedies

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sim.domain import DomainParameters
    from sim.fluid.parameters import FluidParameters
    from sim.parameters import Vector3
    from sim.solver import Arrays, Diagnostics


class ParticleFluid(ABC):
    """Particles of equal volume in a box with walls and openings; one fluid, or several in one tank.

    A particle that would pass a closed face is put back onto it and counted as a wall contact;
    one that passes an open face is removed and counted.

    Densities are relative: rho_i/rho0_i = V sum_j W_ij + sum_b V_b W_ib, with the same volume V for all particles. At
    the interface of two fluids each keeps its own rest density then (Solenthaler & Pajarola 2008, for particles of
    equal volume); in one fluid it is the usual density, divided by rho0.

    Attributes:
        carried: scalars per particle that a solver keeps from step to step, by name.
    """

    carried: tuple[str, ...] = ()

    def __init__(
        self,
        parameters: FluidParameters | Sequence[FluidParameters],
        *,
        domain: DomainParameters,
        gravity: Vector3,
        positions: NDArray[np.float32],
        velocities: NDArray[np.float32],
        boundary: BoundarySamples,
        phase: NDArray[np.int32] | None = None,
        moving: BoundarySamples | None = None,
        sheets: BoundarySamples | None = None,
        body_count: int = 0,
        capacity: int | None = None,
    ) -> None:
        """Take particles, walls and bodies.

        Args:
            parameters: of the fluid, or of all fluids in the tank.
            domain: the box they live in.
            gravity: acceleration [m/s²].
            positions: particles [m], (n, 3), float32.
            velocities: their velocities [m/s], (n, 3), float32.
            boundary: samples of walls and of bodies that never move.
            phase: which of the fluids each particle is of, (n,); all of the first if omitted.
            moving: samples of moving bodies, relative to the centre of mass and in the axes of each.
            sheets: samples of sheets, which whoever moves these has to place before the first step.
            body_count: number of moving bodies; `move_bodies` has to place them before the first step.
            capacity: most particles that there can ever be; those at the start if omitted.

        Raises:
            ValueError: arrays of the wrong shape, not finite, or with particles outside the domain.
        """
        check_particles(positions, velocities, domain)
        self.phases = Phases(parameters if isinstance(parameters, Sequence) else (parameters,))
        self.parameters = self.phases.shared
        self.name = "+".join(self.phases.names)
        self.gravity = gravity
        self.spacing = 2.0 * self.parameters.particle_radius
        self.support_radius = self.parameters.support_in_spacings * self.spacing
        self.particle_volume = particle_volume(self.spacing, self.parameters.support_in_spacings)
        self.particles_removed = 0
        self._first_bad: str | None = None
        self._frequency_squared: ti.Ndarray | None = None
        self._travelled = self._boundary_travelled = 0.0
        self._body_speed = self._sheet_speed = 0.0

        box = Box.of_domain(domain)
        self._openings = box.openings
        self._stepper = ParticleStepper(box)
        self._search_radius = (1.0 + self.parameters.skin) * self.support_radius
        self._grid = CellGrid.covering_as_finely_as_fits(
            np.array(domain.min), np.array(domain.max), self._search_radius,
            reach=cells_per_radius(self.parameters.support_in_spacings),
        )  # fmt: skip
        self._emission = Emission(
            self.phases.parameters, spacing=self.spacing, particle_volume=self.particle_volume, grid=self._grid
        )
        self.boundary = Boundary(
            boundary,
            BoundarySamples.of_bodies() if moving is None else moving,
            is_smooth=is_felt_in_nozzles(boundary.positions, self._emission.openings, self.support_radius),
            sheets=BoundarySamples.of_bodies() if sheets is None else sheets,
            body_count=body_count,
            grid=self._grid,
            spacing=self.spacing,
            support_in_spacings=self.parameters.support_in_spacings,
        )
        self.body_forces = BodyForces(self.boundary, self._grid, self._search_radius)
        count = len(positions)
        self._particles = ParticleSet(self._grid, max(count, capacity or 0), carried=self.carried)
        self._density = ti.ndarray(ti.f32, self._particles.capacity)
        self._without_neighbors = False
        self._next_particle_id = count
        self._particles.load(
            {
                "position": np.ascontiguousarray(positions, dtype=np.float32),
                "velocity": np.ascontiguousarray(velocities, dtype=np.float32),
                "particle_id": np.arange(count, dtype=np.int32),
                "phase": np.zeros(count, dtype=np.int32) if phase is None else phase.astype(np.int32),
            }
        )
        largest = float(np.sqrt((np.asarray(velocities, dtype=np.float64) ** 2).sum(axis=1).max(initial=0.0)))
        self._motion = MotionSummary(max_speed=largest, max_acceleration=float(np.linalg.norm(gravity)))
        self._expect_inflow()
        self.begin_frame(0.0)
        self._find_neighbors()

    @property
    def particles(self) -> ParticleSet:
        """Where they are, for those that look at them between two substeps."""
        return self._particles

    @property
    def particle_count(self) -> int:
        """Particles that are still in the domain."""
        return self._particles.count

    @property
    def capacity(self) -> int:
        """Most particles that there can ever be."""
        return self._particles.capacity

    @property
    def cell_count(self) -> int:
        """Cells of the grid in which neighbours are searched; follows from the domain, not from the particles."""
        return self._grid.cell_count

    @property
    def mean_neighbors(self) -> float:
        """Places in the neighbour list per particle, skin, boundary samples and padding included."""
        return self._particles.neighbors.length / max(self._particles.count, 1)

    def begin_frame(self, time_s: float) -> None:  # noqa: ARG002  a fluid's counters do not depend on the time
        """Restart the counters of the frame, and its largest speed at the present one."""
        self._peak_speed = self._motion.max_speed
        self._wall_contacts = 0
        self._neighbor_searches = 0
        self._substeps = 0
        self._emission.begin_frame()

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
        self._body_speed = float(speed.max(initial=0.0))
        self._without_neighbors |= elapsed_s == 0.0

    def snapshots(self) -> dict[str, Snapshot]:
        """Positions, velocities, densities and pressures of the particles of each fluid, sorted by particle id."""
        self._compute_density()
        order = self._by_id()
        phase = self._host(self._particles.phase)[order]
        arrays = {
            "position": self._host(self._particles.position)[order],
            "velocity": self._host(self._particles.velocity)[order],
            "density": self._host(self._density)[order],
            "pressure": self._pressures()[order],
            "particle_id": self._host(self._particles.particle_id)[order],
        }
        snapshots = {}
        for number, fluid in enumerate(self.phases.parameters):
            own = {name: array[phase == number] for name, array in arrays.items()}
            own["density"] = own["density"] * np.float32(fluid.rest_density)
            snapshots[fluid.name] = Snapshot(
                kind="fluid",
                arrays=own,
                attributes={"particle_radius": fluid.particle_radius, "rest_density": fluid.rest_density},
            )
        return snapshots

    def checkpoint(self) -> dict[str, NDArray[np.generic]]:
        """The particles in the order of the neighbour list, and the positions that it was made from."""
        self._update_neighbors()
        return {
            **self._particles.host_arrays(),
            **self.boundary.checkpoint(),
            **self._emission.checkpoint(),
            "reference_position": np.stack([self._host(axis) for axis in self._particles.reference], axis=1),
            "travelled": np.array([self._travelled], dtype=np.float64),
            "boundary_travelled": np.array([self._boundary_travelled], dtype=np.float64),
            "boundary_speed": np.array([self._body_speed, self._sheet_speed], dtype=np.float64),
            "max_speed": np.array([self._motion.max_speed], dtype=np.float64),
            "max_acceleration": np.array([self._motion.max_acceleration], dtype=np.float64),
            "max_frequency": np.array([self._motion.max_frequency], dtype=np.float64),
            "max_displacement": np.array([self._motion.max_displacement], dtype=np.float64),
            "particles_removed": np.array([self.particles_removed], dtype=np.int64),
            "next_particle_id": np.array([self._next_particle_id], dtype=np.int64),
        }

    def restore(self, arrays: Arrays) -> None:
        """Continue from a checkpoint bit for bit.

        Raises:
            ValueError: the arrays are not a checkpoint of this fluid.
        """
        check_checkpoint(
            arrays, self.name, capacity=self.capacity, carried=self.carried,
            body_states=self.boundary.states.shape, sheet_samples=self.boundary.sheet_count,
        )  # fmt: skip
        # The neighbour list has to be made from the positions it was made from before, then all move on.
        self._particles.load({**arrays, "position": arrays["reference_position"]})
        self.boundary.restore_reference(arrays)
        self._find_neighbors()
        self._particles.load(arrays)
        self.boundary.restore(arrays)
        self._body_speed, self._sheet_speed = arrays["boundary_speed"].tolist()
        self._travelled = float(arrays["travelled"][0])
        self._boundary_travelled = float(arrays["boundary_travelled"][0])
        self._motion = MotionSummary(
            max_speed=float(arrays["max_speed"][0]),
            max_acceleration=float(arrays["max_acceleration"][0]),
            max_frequency=float(arrays["max_frequency"][0]),
            max_displacement=float(arrays["max_displacement"][0]),
        )
        self.particles_removed = int(arrays["particles_removed"][0])
        self._next_particle_id = int(arrays["next_particle_id"][0])
        self._emission.restore(arrays)
        self._peak_speed = self._motion.max_speed
        self._first_bad = None

    def synchronize(self) -> None:
        """Wait until the device has done all that it was asked to, as measurements of time need."""
        ti.sync()

    def diagnostics(self) -> Diagnostics:
        """Mass, momentum and energies, summed in float64 by particle id, and the numbers of this frame's steps.

        `max_speed` is the largest of the whole frame, every substep of it [m/s].
        """
        self._compute_density()
        order = self._by_id()
        position = self._host(self._particles.position)[order].astype(np.float64)
        velocity = self._host(self._particles.velocity)[order].astype(np.float64)
        mass = self._masses()[order]
        momentum = mass @ velocity
        return {
            "mass": float(mass.sum()),
            "momentum_x": float(momentum[0]),
            "momentum_y": float(momentum[1]),
            "momentum_z": float(momentum[2]),
            "kinetic_energy": 0.5 * float(mass @ (velocity**2).sum(axis=1)),
            "potential_energy": -float(mass @ (position @ np.array(self.gravity))),
            "max_speed": self._peak_speed,
            "max_compression": float(self._host(self._density).max(initial=0.0)) - 1.0,
            "particle_count": float(self.particle_count),
            **self._counts_of_fluids(),
            "particles_removed": float(self.particles_removed),
            **self._emission.diagnostics(),
            "wall_contacts": float(self._wall_contacts),
            "neighbor_searches": float(self._neighbor_searches),
            "substeps": float(self._substeps),
        }

    @abstractmethod
    def stable_dt(self) -> float:
        """Largest time step [s] for the current state."""

    @abstractmethod
    def substep(self, dt: float) -> None:
        """Advance by dt [s]."""

    def remedies(self) -> Remedies:
        """Smaller steps against pressures that overshoot; larger particles, or slower ones, cross less in a step."""
        return Remedies(
            runaway='use dt = "adaptive", or a smaller dt or cfl',
            short_steps="lower its initial speeds, or give it a larger particle_radius",
        )

    def first_bad_quantity(self) -> str | None:
        """The first non-finite or runaway quantity of any step since the start or `restore`, in words; costs nothing.

        A particle that diverged may leave the domain or come to rest at a wall before anybody asks.
        """
        return self._first_bad

    @abstractmethod
    def _bad_motion(self) -> str | None:
        """What was not finite or ran away in the last step, in words, or None."""

    @abstractmethod
    def _compute_density(self) -> None:
        """Fill `_density`, relative to the rest density, for the current positions and their neighbours."""

    @abstractmethod
    def _pressures(self) -> NDArray[np.float32]:
        """Pressure of each particle [Pa], (n,), not sorted, after `_compute_density`."""

    @property
    def _list(self) -> tuple[Any, ...]:
        """The neighbour list as the kernels take it: start, fluid_count, boundary_count, indices, stride."""
        neighbors = self._particles.neighbors
        return (
            neighbors.start, neighbors.fluid_count, neighbors.boundary_count, neighbors.indices, neighbors.stride,
        )  # fmt: skip

    @property
    def _sigma(self) -> float:
        """Factor of the kernel, 8/(pi h³) [1/m³]."""
        return normalization(self.support_radius)

    def _counts_of_fluids(self) -> dict[str, float]:
        """Particles of each fluid, where there are several."""
        if len(self.phases.names) == 1:
            return {}
        counts = np.bincount(self._host(self._particles.phase), minlength=len(self.phases.names))
        return {f"particle_count_{name}": float(of) for name, of in zip(self.phases.names, counts, strict=True)}

    def _masses(self) -> NDArray[np.float64]:
        """Mass of each particle, in their order [kg], (n,)."""
        return self.particle_volume * self.phases.rest_densities[self._host(self._particles.phase)]

    def _advance_particles(self, acceleration: ti.Ndarray, dt: float) -> None:
        particles = self._particles
        self._emission.drive(particles, acceleration)
        self._motion = self._stepper.advance(
            particles.position, particles.velocity, acceleration, particles.count, dt, self._frequency_squared
        )
        emitted = self._emission.advance(particles, dt, self._next_particle_id)
        self._next_particle_id += emitted
        self._without_neighbors |= emitted > 0
        self._first_bad = self._first_bad or self._bad_motion()
        self._peak_speed = max(self._peak_speed, self._motion.max_speed)
        self._expect_inflow()
        self._travelled += self._motion.max_displacement
        self._wall_contacts += self._motion.touched
        self._substeps += 1

    def _expect_inflow(self) -> None:
        """Let the next time step be right for what flows in during it."""
        self._motion = replace(self._motion, max_speed=max(self._motion.max_speed, self._emission.speed))

    def _update_neighbors(self) -> None:
        """Find the neighbours anew where a pair could have closed the skin between them, or particles left or came.

        Whatever reads the neighbours asks for this first; so bodies and particles both have moved by then.
        """
        closed = self._travelled + max(self._travelled, self._boundary_travelled)
        if self._without_neighbors or self._motion.left or closed > self._search_radius - self.support_radius:
            self._find_neighbors()

    def _find_neighbors(self) -> None:
        particles = self._particles
        self.particles_removed += particles.sort(*self._openings)
        moving = self.boundary.sort_moving()
        particles.neighbors.build(
            self._search_radius,
            particles.sorted_points,
            particles.count,
            self.boundary.fixed_points,
            moving,
            self.boundary.moving_index,
        )
        self.body_forces.find_particles(particles.sorted_points)
        self._travelled = self._boundary_travelled = 0.0
        self._without_neighbors = False
        self._motion = replace(self._motion, left=0)
        self._neighbor_searches += 1

    def _host(self, array: ti.Ndarray) -> NDArray[np.generic]:
        return array.to_numpy()[: self.particle_count]

    def _by_id(self) -> NDArray[np.int64]:
        return np.argsort(self._host(self._particles.particle_id))
