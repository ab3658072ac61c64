"""Inflow: layers of particles that leave their openings at an exact rate, pushed by a piston."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import taichi as ti
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sim.core.arrays import Integers, Vectors
from sim.core.bundles import bundle
from sim.core.cells import CellGrid, Grid, cell_of_point, row_of_cell
from sim.core.domain import DomainParameters
from sim.core.launch import kernel
from sim.core.motion import rotation
from sim.core.motion.paths import Motion
from sim.core.parameters import Vector3
from sim.core.scan import exclusive_scan, scan_scratch_length
from sim.fluid.boundary import BodyStates, at_origin
from sim.fluid.boundary_akinci2012 import BoundarySamples
from sim.fluid.dye import DYE
from sim.fluid.kernels import Discretization, wall_layers
from sim.fluid.opening import openings_of
from sim.fluid.opening_conflicts import is_same_opening
from sim.fluid.parameters import FluidParameters
from sim.fluid.particles import Layer, Particles, ParticleSet
from sim.shapes.parameters import Placement

FAR_IN_SUPPORTS = 4.0  # how far from the domain pistons wait that have nothing to do
BLOCKED_IN_SPACINGS = 0.75  # of a spacing, or the distance of layers if less: nearer to another one no particle is put
REACH_OF_LAST_LAYER = 0.9  # how far in front of its opening a layer ends as it leaves [layer distances]
MOUTH_DEPTH_IN_SPACINGS = 0.7  # how far behind the last layer of a wall's samples a mouth reaches that leads through it


@bundle
class Mouth(NamedTuple):
    """Space in front of an opening, as far as its last layer reaches, and how that moves."""

    centre: ti.math.vec3  # of the opening [m]
    first: ti.math.vec3  # unit vectors along its axes
    second: ti.math.vec3
    along: ti.math.vec3
    half_first: ti.f32  # half its sides [m]
    half_second: ti.f32
    depth: ti.f32  # of the space [m]
    velocity: ti.math.vec3  # of what is in the middle of the opening [m/s]
    spin: ti.math.vec3  # angular velocity [rad/s]
    phase: ti.i32  # number of the fluid


@dataclass(frozen=True)
class Carrier:
    """A moving body that an opening is fixed to."""

    body: int  # its number
    centre_of_mass: NDArray[np.float64]  # from its shape's origin, along its own axes [m], (3,)

    def motion(self, states: BodyStates, ahead_s: float) -> Motion:
        """Of the shape's origin, so long after the states hold [s]."""
        spin = states.angular_velocity[self.body]
        turn = rotation.exponential(ahead_s * spin)
        orientation = rotation.product(turn, rotation.from_matrix(states.rotation[self.body]))
        arm = rotation.rotated(orientation, -self.centre_of_mass)
        centre, velocity = states.position[self.body], states.velocity[self.body]
        return Motion(centre + ahead_s * velocity + arm, orientation, velocity + np.cross(spin, arm), spin)


class Emission:
    """The emitters of all fluids of a tank.

    A layer of an opening leaves when its volume has come out, and is put where it is by then at the end of the first
    step after that: neither the rate nor the lattice depends on the steps. Where a particle of a layer would be too
    near to another one, or outside the domain, it is dropped, and counted, as is a whole layer that does not fit under
    the cap of its fluid, or into the arrays.

    Particles are free as soon as they have left. What is behind them in the pipe that an opening is the end of is a
    piston: boundary samples, as far from the last layer as those of a wall from fluid at rest, that move on with the
    inflow, and back by a layer when one leaves. Of a wall or body that an opening lies in, the piston stands for the
    samples in its mouth, which weigh nothing, and stays there when nothing flows.

    A piston pushes as fluid does, and does not pull: by the pressure that cohesion makes in a jet it would throw it
    out. Where a fluid has surface tension its last layer is held until the next one leaves, while it flows.

    Attributes:
        time_s: simulated time [s].
        emitted: particles emitted since the start.
        blocked: particles dropped in this frame as their place was taken.
        capped: particles not emitted in this frame as there are too many.
        openings: of all emitters.
    """

    def __init__(
        self,
        fluids: Sequence[FluidParameters],
        discretization: Discretization,
        grid: CellGrid,
        domain: DomainParameters,
        gravity: Vector3,
        *,
        bodies: Mapping[str, Placement],
        carriers: Mapping[str, Carrier],
    ) -> None:
        """Take the emitters of fluids, and the bodies that they follow by name: as they start, and which they are.

        Raises:
            ValueError: an opening is too narrow.
        """
        self.time_s = 0.0
        self.emitted = self.blocked = self.capped = 0
        self._fluids, self._grid, self._domain, self._gravity = tuple(fluids), grid, domain, np.array(gravity)
        self._discretization, self._spacing = discretization, discretization.spacing
        openings = openings_of(fluids, discretization.particle_volume, bodies)
        self._phase, self.openings = [number for number, _ in openings], [opening for _, opening in openings]
        self._dyes = [emitter.dye for fluid in fluids for emitter in fluid.emitter]
        self._carriers = [None if each.follow is None else carriers[each.follow] for each in self.openings]
        self._layers = np.zeros(len(self.openings), dtype=np.int64)
        self._states, self._states_s = at_origin(0), 0.0
        self._is_plug = np.zeros(len(self.openings), dtype=bool)
        # Emitters that share an opening in turn share one plug: the first one's.
        self._stands_in = [
            next(k for k, each in enumerate(self.openings) if each is own or is_same_opening(each, own, self._spacing))
            for own in self.openings
        ]
        most = max((len(opening.places) for opening in self.openings), default=1)
        self._places, self._velocities = (ti.Vector.ndarray(3, ti.f32, most) for _ in range(2))
        self._free = ti.ndarray(ti.i32, most)
        self._order = ti.ndarray(ti.i32, most + 1)
        self._scratch = ti.ndarray(ti.i32, scan_scratch_length(most))

    def begin_frame(self) -> None:
        """Restart the counters of the frame."""
        self.blocked = self.capped = 0

    @property
    def speed(self) -> float:
        """Largest speed of what flows in now [m/s]."""
        flowing = [k for k, opening in enumerate(self.openings) if opening.inflow.is_open(self.time_s)]
        return max((self._speed_of(k) for k in flowing), default=0.0)

    def longest_step(self, distance: float) -> float:
        """Longest step [s] in which no layer of an emitter that begins gets farther than that from its opening [m]."""
        waiting = [opening for opening in self.openings if self.time_s < opening.start_s and opening.speed > 0.0]
        return min((opening.start_s - self.time_s + distance / opening.speed for opening in waiting), default=math.inf)

    def carry(self, states: BodyStates) -> None:
        """Take where the moving bodies are now."""
        self._states, self._states_s = states, self.time_s

    def hold_last_layers(self, particles: ParticleSet, acceleration: ti.Ndarray) -> None:
        """Let the last layers of fluids with surface tension move as their pistons do, and not accelerate."""
        for number, opening in enumerate(self.openings):
            if self._fluids[self._phase[number]].surface_tension == 0.0 or not opening.inflow.is_open(self.time_s):
                continue
            passed, speed = self._since_last_layer(number)
            if speed == 0.0:
                continue
            motion = self._carrier_motion(number, self.time_s)
            centre = opening.to_world(np.zeros((1, 3)), motion)
            axes = rotation.rotated(motion.orientation, opening.axes)
            first, second = opening.half_size
            mouth = Mouth(
                *map(tuple, (centre[0], *axes)),
                half_first=first,
                half_second=second,
                depth=passed + REACH_OF_LAST_LAYER * opening.layer_distance,
                velocity=tuple(opening.velocity_at(centre, motion, speed)[0]),
                spin=tuple(motion.angular_velocity),
                phase=self._phase[number],
            )
            hold_particles(particles.arrays, acceleration, mouth)

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

    def open_mouths(self, fixed: BoundarySamples, moving: BoundarySamples) -> tuple[BoundarySamples, BoundarySamples]:
        """The samples of walls, and of moving bodies about their centres of mass, without weight in the openings."""
        layers = wall_layers(self._discretization.support_in_spacings)
        depth = (layers[-1].standoff_in_spacings - 0.5 + MOUTH_DEPTH_IN_SPACINGS) * self._spacing
        weights = [np.ones(len(samples.positions)) for samples in (fixed, moving)]
        for number, (opening, carrier) in enumerate(zip(self.openings, self._carriers, strict=True)):
            if opening.path is not None:
                continue
            samples, weight, motion = fixed, weights[0], opening.placement
            if carrier is not None:
                samples, weight = moving, weights[1]
                motion = Motion(-carrier.centre_of_mass, np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3), np.zeros(3))
            in_mouth = opening.is_behind(samples.positions.astype(np.float64), motion, self._spacing, depth)
            in_mouth &= carrier is None or samples.body == carrier.body
            weight[in_mouth] = 0.0
            self._is_plug[number] = in_mouth.any()
        return fixed.scaled(weights[0]), moving.scaled(weights[1])

    def is_felt(self, positions: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Whether a layer that leaves an opening at rest can feel a sample at one of these positions [m], (m, 3); (m,).

        Such samples of walls and bodies at rest exert no friction, by which they would brake the jet at once.
        """
        felt = np.zeros(len(positions), dtype=bool)
        for opening in self.openings:
            if not opening.moves:
                distance, _ = cKDTree(opening.points(1)).query(positions)
                felt |= distance < self._discretization.support_radius + opening.layer_distance
        return felt

    def piston_samples(self) -> list[BoundarySamples]:
        """The samples of the pistons, along the axes of each opening, from the last layer that left it."""
        d = self._discretization
        pistons = []
        for opening in self.openings:
            # A place stands for so much of the area: V / L, where it would be V / d in a lattice.
            rows = [
                np.pad(opening.places, ((0, 0), (0, 1)), constant_values=-layer.standoff_in_spacings * d.spacing)
                for layer in wall_layers(d.support_in_spacings)
            ]
            volume = d.particle_volume * d.spacing / opening.layer_distance
            known = [
                np.full(len(opening.places), layer.volume_in_particles * volume)
                for layer in wall_layers(d.support_in_spacings)
            ]
            pistons.append(BoundarySamples.of_points(np.concatenate(rows), known=np.concatenate(known)))
        return pistons

    def pistons(self) -> BodyStates:
        """Where the pistons are now: the poses of the samples of each."""
        if not self.openings:
            return at_origin(0)
        rows = [self._piston(number) for number in range(len(self.openings))]
        return BodyStates(*(np.stack(each) for each in zip(*rows, strict=True)))

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

    def _carrier_motion(self, number: int, time_s: float) -> Motion:
        """What carries an opening, at a time [s] not long after the bodies were placed."""
        carrier = self._carriers[number]
        body = None if carrier is None else carrier.motion(self._states, time_s - self._states_s)
        return self.openings[number].motion(time_s, body)

    def _speed_of(self, number: int) -> float:
        """Largest speed of what flows out of an opening now [m/s]."""
        opening, motion = self.openings[number], self._carrier_motion(number, self.time_s)
        if not opening.moves:
            return opening.speed
        corners = opening.to_world(opening.places_of(1), motion)
        return float(np.linalg.norm(opening.velocity_at(corners, motion, opening.speed), axis=1).max())

    def _piston(self, number: int) -> tuple[NDArray[np.float64], ...]:
        """Position, rotation, velocity and angular velocity of a piston."""
        opening = self.openings[number]
        is_open = opening.inflow.is_open(self.time_s)
        if not is_open and not self._is_waiting_plug(number):
            corner = np.array(self._domain.max) + FAR_IN_SUPPORTS * self._discretization.support_radius
            return corner, np.eye(3), np.zeros(3), np.zeros(3)
        motion = self._carrier_motion(number, self.time_s)
        passed, speed = self._since_last_layer(number) if is_open else (0.0, 0.0)
        centre = opening.to_world(np.array([[0.0, 0.0, 0.5 * opening.layer_distance + passed]]), motion)
        rows = rotation.rotated(motion.orientation, opening.axes)
        return centre[0], rows.T, opening.velocity_at(centre, motion, speed)[0], motion.angular_velocity

    def _since_last_layer(self, number: int) -> tuple[float, float]:
        """How far the piston has moved since a layer left [m], and its speed [m/s], relative to the opening."""
        opening, left = self.openings[number], self._layers[number]
        gone = 0.0 if left == 0 else left - 1 + opening.count_of(0) / len(opening.places)
        passed = opening.inflow.travel_at(self.time_s) - gone * opening.layer_distance
        return passed, opening.inflow.speed_at(self.time_s)

    def _is_waiting_plug(self, number: int) -> bool:
        """Whether an opening lies in a wall, and is what closes it while nothing flows."""
        if not self._is_plug[number] or self._stands_in[number] != number:
            return False
        same = [each for k, each in enumerate(self.openings) if self._stands_in[k] == number]
        return not any(each.inflow.is_open(self.time_s) for each in same)

    def _emit_layer(self, number: int, layer: int, particles: ParticleSet, sorted_count: int, first_id: int) -> None:
        opening, phase = self.openings[number], self._phase[number]
        count = opening.count_of(layer)
        if count > self._room(phase, particles):
            self.capped += count
            return
        leaves_s = opening.leaves_at(layer)
        motion = self._carrier_motion(number, leaves_s)
        points = opening.to_world(opening.places_of(layer), motion)
        velocities = opening.velocity_at(points, motion, opening.inflow.speed_at(leaves_s))
        flown_s = self.time_s - leaves_s
        points = points + flown_s * velocities + 0.5 * flown_s**2 * self._gravity
        velocities = velocities + flown_s * self._gravity
        inside = ((points >= self._domain.min) & (points <= self._domain.max)).all(axis=1)
        points, velocities = points[inside], velocities[inside]
        self.blocked += count - len(points)
        if not len(points):
            return
        for array, rows in ((self._places, points), (self._velocities, velocities)):
            padded = np.zeros((array.shape[0], 3), dtype=np.float32)
            padded[: len(rows)] = rows
            array.from_numpy(padded)
        candidates = Layer(
            self._places, self._velocities, len(points), phase, free=self._free, order=self._order, first_id=first_id
        )
        clearance = BLOCKED_IN_SPACINGS * min(self._spacing, opening.layer_distance)
        find_free_places(
            candidates, particles.arrays, particles.cells.cell_start, self._grid.on_device, sorted_count, clearance
        )
        added = exclusive_scan(self._free, len(points), self._scratch, self._order)
        particles.append(candidates, added, {DYE: self._dyes[number]})
        self.emitted += added
        self.blocked += len(points) - added

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


@kernel
def hold_particles(particles: Particles, acceleration: Vectors, mouth: Mouth):
    """v_i = that of the opening and its inflow, a_i = 0, for particles of its fluid in front of it."""
    for i in range(particles.count):
        arm = particles.position[i] - mouth.centre
        depth = arm.dot(mouth.along)
        is_across = (
            ti.abs(arm.dot(mouth.first)) < mouth.half_first and ti.abs(arm.dot(mouth.second)) < mouth.half_second
        )
        if particles.phase[i] == mouth.phase and depth > 0.0 and depth < mouth.depth and is_across:
            particles.velocity[i] = mouth.velocity + mouth.spin.cross(arm)
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
        x_k = layer.places[k]
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
