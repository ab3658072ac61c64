"""Inflow: layers of particles that leave their openings at an exact rate."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.arrays import Integers, Vectors, on_device
from sim.core.bundles import bundle
from sim.core.cells import CellGrid, Grid, cell_of_point, row_of_cell
from sim.core.launch import kernel
from sim.core.scan import exclusive_scan, scan_scratch_length
from sim.fluid.kernels import Discretization
from sim.fluid.opening import Opening, openings_of
from sim.fluid.parameters import FluidParameters
from sim.fluid.particles import Layer, Particles, ParticleSet

EDGE_IN_SPACINGS = 0.1  # how much wider than its opening a nozzle is: places of a layer may lie on its edge
BLOCKED_IN_SPACINGS = 0.9  # of a spacing, or the distance of layers if less: nearer to another one no particle is put


@bundle
class Nozzle(NamedTuple):
    """Space in which particles move at the speed of the inflow, whatever pushes."""

    centre: ti.math.vec3  # of the opening [m]
    inflow: ti.math.vec3  # velocity [m/s]
    first: ti.math.vec3  # unit vectors along the sides of the opening
    second: ti.math.vec3
    half_first: ti.f32  # half the lengths of these sides, or the radius of a disc twice [m]
    half_second: ti.f32
    is_round: ti.i32  # whether it is a disc
    reach: ti.f32  # depth times speed [m²/s]


class Emission:
    """The emitters of all fluids of a tank.

    Layer n of an opening leaves at start + n T, T = layer distance / speed, and is put where it is by then at the end
    of the first step after that: neither the rate nor the lattice depends on the steps. Where a particle of a layer
    would be too near to another one it is dropped, and counted, as is a whole layer that does not fit under the cap of
    its fluid, or into the arrays.

    Attributes:
        time_s: simulated time [s].
        emitted: particles emitted since the start.
        blocked: particles dropped in this frame as their place was taken.
        capped: particles not emitted in this frame as there are too many.
    """

    def __init__(self, fluids: Sequence[FluidParameters], discretization: Discretization, grid: CellGrid) -> None:
        """Take the emitters of these fluids.

        Raises:
            ValueError: an opening is too narrow.
        """
        self.time_s = 0.0
        self.emitted = self.blocked = self.capped = 0
        self._fluids, self._grid = tuple(fluids), grid
        self._spacing = discretization.spacing
        openings = openings_of(fluids, discretization.particle_volume)
        self._phase, self.openings = [number for number, _ in openings], [opening for _, opening in openings]
        # Where emitters share a nozzle, the newest rules.
        self._oldest_first = [
            (opening, _nozzle(opening, EDGE_IN_SPACINGS * self._spacing))
            for opening in sorted(self.openings, key=lambda opening: opening.start_s)
        ]
        self._places = [on_device(opening.points) for opening in self.openings]
        self._layers = np.zeros(len(self.openings), dtype=np.int64)
        most = max((len(opening.points) for opening in self.openings), default=1)
        self._free = ti.ndarray(ti.i32, most)
        self._order = ti.ndarray(ti.i32, most + 1)
        self._scratch = ti.ndarray(ti.i32, scan_scratch_length(most))

    def begin_frame(self) -> None:
        """Restart the counters of the frame."""
        self.blocked = self.capped = 0

    @property
    def speed(self) -> float:
        """Largest speed of what flows in now [m/s]."""
        flowing = [opening.speed for opening in self.openings if opening.start_s <= self.time_s < opening.end_s]
        return max(flowing, default=0.0)

    def longest_step(self, distance: float) -> float:
        """Longest step [s] in which no layer of an emitter that begins gets farther than that from its opening [m]."""
        waiting = [opening for opening in self.openings if self.time_s < opening.start_s]
        return min((opening.start_s - self.time_s + distance / opening.speed for opening in waiting), default=math.inf)

    def drive(self, particles: ParticleSet, acceleration: ti.Ndarray) -> None:
        """Give all particles in a nozzle the velocity of its inflow, and no acceleration."""
        for opening, nozzle in self._oldest_first:
            if opening.start_s <= self.time_s < opening.drained_s:
                drive_nozzle(particles.arrays, acceleration, nozzle)

    def advance(self, particles: ParticleSet, dt: float, first_id: int) -> int:
        """Put the layers that have left after a step of dt [s] among the particles; returns how many were emitted.

        The particles are advanced already, in the cells of their last search for neighbours; `first_id` is the id of
        the next one.
        """
        if not self.openings:
            return 0
        self.time_s += dt
        before, sorted_count = self.emitted, particles.count
        for number, opening in enumerate(self.openings):
            for layer in range(self._layers[number], opening.layers_due(self.time_s)):
                self._layers[number] = layer + 1
                self._emit_layer(number, layer, particles, sorted_count, first_id + self.emitted - before)
        return self.emitted - before

    def diagnostics(self) -> dict[str, float]:
        """What the emitters did; nothing where there are none."""
        if not self.openings:
            return {}
        return {
            "particles_emitted": float(self.emitted),
            "emission_blocked": float(self.blocked),
            "emission_capped": float(self.capped),
        }

    def checkpoint(self) -> dict[str, NDArray[np.generic]]:
        """State of the emitters; nothing where there are none."""
        if not self.openings:
            return {}
        return {
            "emission_time": np.array([self.time_s]),
            "emission_count": np.array([self.emitted], dtype=np.int64),
            "emission_layers": self._layers.copy(),
        }

    def restore(self, arrays: Mapping[str, NDArray[np.generic]]) -> None:
        """Continue from a checkpoint."""
        if self.openings:
            self.time_s = float(arrays["emission_time"][0])
            self.emitted = int(arrays["emission_count"][0])
            self._layers[:] = arrays["emission_layers"]

    def _emit_layer(self, number: int, layer: int, particles: ParticleSet, sorted_count: int, first_id: int) -> None:
        opening, phase = self.openings[number], self._phase[number]
        count = len(opening.points)
        if count > self._room(phase, particles):
            self.capped += count
            return
        moved = tuple(opening.layer_at(layer, self.time_s)[0] - opening.points[0])
        places = self._places[number], count, moved, tuple(opening.velocity), phase
        candidates = Layer(*places, free=self._free, order=self._order, first_id=first_id)
        clearance = BLOCKED_IN_SPACINGS * min(self._spacing, opening.layer_distance)
        find_free_places(
            candidates, particles.arrays, particles.cells.cell_start, self._grid.on_device, sorted_count, clearance
        )
        added = exclusive_scan(self._free, count, self._scratch, self._order)
        particles.append(candidates, added)
        self.emitted += added
        self.blocked += count - added

    def _room(self, phase: int, particles: ParticleSet) -> int:
        """Particles that may still come of a fluid."""
        room = particles.capacity - particles.count
        cap = self._fluids[phase].max_particles
        if cap is None:
            return room
        present = particles.count
        if len(self._fluids) > 1:
            present = int(count_phase(particles.arrays.phase, particles.count, phase))
        return min(room, cap - present)


def _nozzle(opening: Opening, edge: float) -> Nozzle:
    """The nozzle of an opening, wider than that by an edge [m]."""
    vectors = (tuple(vector) for vector in (opening.centre, opening.velocity, *opening.axes))
    first, second = opening.half_size
    return Nozzle(*vectors, first + edge, second + edge, int(opening.is_round), opening.nozzle_depth * opening.speed)


@kernel
def drive_nozzle(particles: Particles, acceleration: Vectors, nozzle: Nozzle):
    """v_i = velocity of the inflow, a_i = 0, in a nozzle."""
    for i in range(particles.count):
        from_centre = particles.position[i] - nozzle.centre
        depth = from_centre.dot(nozzle.inflow)
        if depth > 0.0 and depth < nozzle.reach:
            u = from_centre.dot(nozzle.first) / nozzle.half_first
            v = from_centre.dot(nozzle.second) / nozzle.half_second
            inside = ti.max(ti.abs(u), ti.abs(v)) < 1.0
            if nozzle.is_round != 0:
                inside = u * u + v * v < 1.0
            if inside:
                particles.velocity[i] = nozzle.inflow
                acceleration[i] = ti.math.vec3(0.0)


@kernel
def find_free_places(
    layer: Layer, particles: Particles, cell_start: Integers, grid: Grid, sorted_count: ti.i32, clearance: ti.f32
):
    """1 for each place without a particle nearer than the clearance, else 0.

    Particles have moved by less than the skin since they were sorted; the cells to either side are wider than both
    together. Those that other layers brought in this step, from `sorted_count` on, are in no cell yet.
    """
    for k in range(layer.count):
        x_k = layer.places[k] + layer.moved
        cell = cell_of_point(x_k, grid)
        near = 0
        for dz in range(-grid.reach, grid.reach + 1):
            for dy in range(-grid.reach, grid.reach + 1):
                row = row_of_cell(cell, dy, dz, grid)
                for j in range(cell_start[row - grid.reach], cell_start[row + grid.reach + 1]):
                    near += ti.cast((particles.position[j] - x_k).norm_sqr() < clearance * clearance, ti.i32)
        for j in range(sorted_count, particles.count):
            near += ti.cast((particles.position[j] - x_k).norm_sqr() < clearance * clearance, ti.i32)
        layer.free[k] = ti.cast(near == 0, ti.i32)


@kernel
def count_phase(phase: Integers, count: ti.i32, wanted: ti.i32) -> ti.i32:
    """Particles of a fluid; a sum of integers, exact in any order."""
    total = 0
    for i in range(count):
        total += ti.cast(phase[i] == wanted, ti.i32)
    return total
