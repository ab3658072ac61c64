"""What all particle fluids share: particles in a box, their neighbours, the state they save and report."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import taichi as ti

from sim.fluid.boundary import Boundary
from sim.fluid.kernels import SUPPORT_IN_SPACINGS, particle_volume
from sim.fluid.particles import EXPECTED_NEIGHBORS, ParticleSet
from sim.fluid.stepping import advance_particles
from sim.neighbors import GROWTH, CellGrid
from sim.snapshots import Snapshot

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sim.fluid.boundary_akinci2012 import BoundarySamples
    from sim.fluid.parameters import FluidParameters
    from sim.parameters import Vector3
    from sim.scene import DomainParameters
    from sim.solver import Arrays, Diagnostics

SKIN = 0.1
"""How much farther than the support the neighbour list reaches [support radii]: more means fewer rebuilds, and more
pairs in every step. Measurements: docs/performance.md."""

UNLIMITED = 1.0e30
"""Coordinate that no particle reaches [m]."""

CHECKPOINT_ARRAYS = {
    "position": ("float32", "vector"),
    "velocity": ("float32", "vector"),
    "particle_id": ("int32", "scalar"),
    "reference_position": ("float32", "vector"),
    "travelled": ("float64", "number"),
    "max_speed": ("float64", "number"),
    "max_acceleration": ("float64", "number"),
    "particles_removed": ("int64", "number"),
}
"""Type of each array of a checkpoint, and whether it has a vector or scalar per particle, or one number in all."""


@dataclass(frozen=True)
class MotionSummary:
    """What the last step did to the particles.

    Attributes:
        max_speed: largest |v_i|, before a wall stops it [m/s].
        max_acceleration: largest |a_i| [m/s²].
        max_displacement: largest way that a particle went [m].
        left: particles that passed an open face.
        non_finite: particles with a position or velocity that is NaN or infinite.
    """

    max_speed: float
    max_acceleration: float
    max_displacement: float = 0.0
    left: int = 0
    non_finite: int = 0


class ParticleFluid(ABC):
    """Particles of equal mass in a box with walls and openings.

    A particle that would pass a closed face is put back onto it and counted as a wall contact;
    one that passes an open face is removed and counted.
    """

    def __init__(
        self,
        parameters: FluidParameters,
        *,
        domain: DomainParameters,
        gravity: Vector3,
        positions: NDArray[np.float32],
        velocities: NDArray[np.float32],
        boundary: BoundarySamples,
    ) -> None:
        _check_particles(positions, velocities, domain)
        self.name = parameters.name
        self.parameters = parameters
        self.gravity = gravity
        self.spacing = 2.0 * parameters.particle_radius
        self.support_radius = SUPPORT_IN_SPACINGS * self.spacing
        self.particle_mass = parameters.rest_density * particle_volume(self.spacing)
        self.particles_removed = 0
        largest = float(np.sqrt((np.asarray(velocities, dtype=np.float64) ** 2).sum(axis=1).max(initial=0.0)))
        self._motion = MotionSummary(max_speed=largest, max_acceleration=float(np.linalg.norm(gravity)))
        self._first_bad: str | None = None
        self.begin_frame(0.0)

        self._walls = _limits(domain, of_walls=True)
        self._openings = _limits(domain, of_walls=False)
        self._search_radius = (1.0 + SKIN) * self.support_radius
        self._grid = CellGrid.covering(np.array(domain.min), np.array(domain.max), self._search_radius)
        self.boundary = Boundary(boundary, self._grid, self.spacing, parameters.rest_density)
        self._particles = ParticleSet(
            np.ascontiguousarray(positions, dtype=np.float32),
            np.ascontiguousarray(velocities, dtype=np.float32),
            self._grid,
        )
        self._density = ti.ndarray(ti.f32, self._particles.capacity)
        self._find_neighbors()

    @property
    def particle_count(self) -> int:
        """Particles that are still in the domain."""
        return self._particles.count

    @property
    def cell_count(self) -> int:
        """Cells of the grid in which neighbours are searched; follows from the domain, not from the particles."""
        return self._grid.cell_count

    @property
    def mean_neighbors(self) -> float:
        """Entries of the neighbour list per particle, skin and boundary samples included."""
        return self._particles.neighbors.length / max(self._particles.count, 1)

    def begin_frame(self, time_s: float) -> None:  # noqa: ARG002  a fluid's counters do not depend on the time
        """Restart the counters of the frame, and its largest speed at the present one."""
        self._peak_speed = self._motion.max_speed
        self._wall_contacts = 0
        self._neighbor_searches = 0
        self._substeps = 0

    def snapshots(self) -> dict[str, Snapshot]:
        """Positions, velocities and densities of the particles, sorted by particle id."""
        self._compute_density()
        order = self._by_id()
        return {
            self.name: Snapshot(
                kind="fluid",
                arrays={
                    "position": self._host(self._particles.position)[order],
                    "velocity": self._host(self._particles.velocity)[order],
                    "density": self._host(self._density)[order],
                    "particle_id": self._host(self._particles.particle_id)[order],
                },
                attributes={
                    "particle_radius": self.parameters.particle_radius,
                    "rest_density": self.parameters.rest_density,
                },
            )
        }

    def checkpoint(self) -> dict[str, NDArray[np.generic]]:
        """The particles in the order of the neighbour list, and the positions that it was made from."""
        particles = self._particles
        return {
            "position": self._host(particles.position),
            "velocity": self._host(particles.velocity),
            "particle_id": self._host(particles.particle_id),
            "reference_position": np.stack([self._host(axis) for axis in particles.reference], axis=1),
            "travelled": np.array([self._travelled], dtype=np.float64),
            "max_speed": np.array([self._motion.max_speed], dtype=np.float64),
            "max_acceleration": np.array([self._motion.max_acceleration], dtype=np.float64),
            "particles_removed": np.array([self.particles_removed], dtype=np.int64),
        }

    def restore(self, arrays: Arrays) -> None:
        """Continue from a checkpoint bit for bit.

        Raises:
            ValueError: the arrays are not a checkpoint of this fluid.
        """
        self._check_checkpoint(arrays)
        particles = self._particles
        # The neighbour list has to be made from the positions it was made from before, then the particles move on.
        particles.load(arrays["reference_position"], arrays["velocity"], arrays["particle_id"])
        self._find_neighbors()
        particles.load(arrays["position"], arrays["velocity"], arrays["particle_id"])
        self._travelled = float(arrays["travelled"][0])
        self._motion = MotionSummary(float(arrays["max_speed"][0]), float(arrays["max_acceleration"][0]))
        self.particles_removed = int(arrays["particles_removed"][0])
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
        density = self._host(self._density)
        momentum = self.particle_mass * velocity.sum(axis=0)
        return {
            "mass": self.particle_mass * self.particle_count,
            "momentum_x": float(momentum[0]),
            "momentum_y": float(momentum[1]),
            "momentum_z": float(momentum[2]),
            "kinetic_energy": 0.5 * self.particle_mass * float((velocity**2).sum()),
            "potential_energy": -self.particle_mass * float((position @ np.array(self.gravity)).sum()),
            "max_speed": self._peak_speed,
            "max_compression": float(density.max(initial=0.0)) / self.parameters.rest_density - 1.0,
            "particle_count": float(self.particle_count),
            "particles_removed": float(self.particles_removed),
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
        """Fill `_density` for the current positions."""

    def _advance_particles(self, acceleration: ti.Ndarray, dt: float) -> None:
        particles = self._particles
        motion = advance_particles(
            particles.position, particles.velocity, acceleration, particles.count, dt,
            *(ti.math.vec3(*corner) for corner in (*self._walls, *self._openings)),
        )  # fmt: skip
        self._motion = MotionSummary(
            max_speed=float(np.sqrt(motion.max_speed_squared)),
            max_acceleration=float(np.sqrt(motion.max_acceleration_squared)),
            max_displacement=float(np.sqrt(motion.max_displacement_squared)),
            left=int(motion.left),
            non_finite=int(motion.bad),
        )
        self._first_bad = self._first_bad or self._bad_motion()
        self._peak_speed = max(self._peak_speed, self._motion.max_speed)
        self._travelled += self._motion.max_displacement
        self._wall_contacts += int(motion.touched)
        self._substeps += 1

    def _update_neighbors(self) -> None:
        """Find the neighbours anew once two particles could have closed the skin between them, or one has left."""
        if self._motion.left or 2.0 * self._travelled > self._search_radius - self.support_radius:
            self._find_neighbors()

    def _find_neighbors(self) -> None:
        particles = self._particles
        self.particles_removed += particles.sort(*self._openings)
        particles.neighbors.build(
            self._search_radius,
            particles.reference,
            particles.cells.cell_start,
            particles.count,
            self.boundary.coordinates,
            self.boundary.cell_start,
        )
        self._travelled = 0.0
        self._neighbor_searches += 1

    def _host(self, array: ti.Ndarray) -> NDArray[np.generic]:
        return array.to_numpy()[: self.particle_count]

    def _by_id(self) -> NDArray[np.int64]:
        return np.argsort(self._host(self._particles.particle_id))

    def _check_checkpoint(self, arrays: Arrays) -> None:
        missing = sorted(set(CHECKPOINT_ARRAYS) - set(arrays))
        if missing:
            raise ValueError(f'not a checkpoint of "{self.name}": it lacks {", ".join(missing)}')
        count = len(arrays["particle_id"])
        if count > self._particles.capacity:
            raise ValueError(
                f'the checkpoint has {count} particles, "{self.name}" started with {self._particles.capacity}'
            )
        for name, (dtype, width) in CHECKPOINT_ARRAYS.items():
            shape = {"vector": (count, 3), "scalar": (count,), "number": (1,)}[width]
            found = arrays[name]
            if found.shape != shape or found.dtype != dtype:
                raise ValueError(
                    f'checkpoint of "{self.name}": {name} must be {dtype} {shape}, got {found.dtype} {found.shape}'
                )


def _check_particles(
    positions: NDArray[np.floating], velocities: NDArray[np.floating], domain: DomainParameters
) -> None:
    if positions.ndim != 2 or positions.shape[1] != 3 or velocities.shape != positions.shape:
        raise ValueError(f"positions and velocities must both be (n, 3), got {positions.shape} and {velocities.shape}")
    if not (np.isfinite(positions).all() and np.isfinite(velocities).all()):
        raise ValueError("positions and velocities must be finite numbers")
    outside = ((positions < np.float32(domain.min)) | (positions > np.float32(domain.max))).any(axis=1).sum()
    if outside:
        raise ValueError(f"{outside} of {len(positions)} particles start outside the domain")


def _limits(domain: DomainParameters, *, of_walls: bool) -> tuple[Vector3, Vector3]:
    """Lower and upper corner of the box of closed faces, or of open ones; out of reach where a face is the other."""
    low, high = list(domain.min), list(domain.max)
    for axis, name in enumerate("xyz"):
        if (f"{name}-" in domain.open_faces) == of_walls:
            low[axis] = -UNLIMITED
        if (f"{name}+" in domain.open_faces) == of_walls:
            high[axis] = UNLIMITED
    return (low[0], low[1], low[2]), (high[0], high[1], high[2])


def estimate_bytes(particle_count: int, boundary_count: int, cell_count: int) -> int:
    """Memory of a particle fluid on its device [bytes], for planning.

    Args:
        particle_count: particles at the start.
        boundary_count: samples of walls and bodies.
        cell_count: cells of the search for neighbours, which cover the whole domain.
    """
    vector, number = 12, 4
    state = 2 * (2 * vector + number) + vector  # position, velocity and id, sorted from and to; reference
    results = vector + 2 * number  # acceleration, density, pressure
    search = 5 * number + EXPECTED_NEIGHBORS * GROWTH * number  # cell, order, counts, starts; the list itself
    boundary = 2 * vector + 3 * number  # twice the positions, psi, cell, order
    cell = 3 * number  # where its particles and its samples start; the cursor of the sort
    return int(particle_count * (state + results + search) + boundary_count * boundary + cell_count * cell)
