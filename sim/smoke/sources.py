"""Sources: regions that set smoke, heat and velocity to at least given values."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.arrays import Floats, Integers
from sim.core.bundles import bundle, func
from sim.core.hashed_numbers import hash_to_unit, smooth_noise, spread
from sim.core.host_access import copied
from sim.core.launch import kernel
from sim.core.motion import rotation
from sim.core.motion.paths import Motion
from sim.smoke.grid import SmokeGrid
from sim.smoke.lanes import Grid
from sim.smoke.obstacles import Air, is_solid, part_before
from sim.smoke.parameters import SmokeParameters, SmokeSourceParameters
from sim.smoke.source_motion import CELLS, BodyMotion, SourceMotion, SweptShape, motion_of

BLOCK, GPU_BLOCK = 256, 16  # cells whose emission one thread adds up
FLUCTUATION_CELLS = 4  # edge of the blocks of cells that fluctuate together: smaller ones are averaged away by the flow
FLUCTUATION_RATE_HZ = 20.0  # how often the fluctuation changes
BOUNDS_SPACING = 0.5  # of poses around which a box is put, over the reach of a shape
POSES_PER_CELL = 4.0  # a source that moves emits at poses that are a quarter of a cell apart at most


@bundle
class Noise(NamedTuple):
    """How the heat of a source fluctuates."""

    tick: ti.i32  # number of the present pattern
    salt: ti.i32  # of the seed
    first: ti.math.ivec3  # lowest cell of the grid, counted in the smoke's box: patterns stay where they are in that
    strength: ti.f32  # how far the heat falls short [-]


class _Places:
    """Cells that a source raises, or faces that it drives, as they are now; room grows as it is needed."""

    def __init__(self) -> None:
        self.count = 0
        self.indices = ti.ndarray(ti.i32, 1)
        self.shares, self.speeds = ti.ndarray(ti.f32, 1), ti.ndarray(ti.f32, 1)

    def put(
        self, indices: NDArray[np.int32], shares: NDArray[np.float64], speeds: NDArray[np.float64] | None = None
    ) -> None:
        """Take flat indices, covered parts [-] and, of faces, velocities [m/s], (n,) each."""
        self.count = len(indices)
        room = self.indices.shape[0]
        if self.count > room:
            room = max(self.count, 2 * room)
            self.indices, self.shares = ti.ndarray(ti.i32, room), ti.ndarray(ti.f32, room)
            self.speeds = ti.ndarray(ti.f32, room)
        for array, values in ((self.indices, indices), (self.shares, shares), (self.speeds, speeds)):
            if values is not None:
                padded = np.zeros(room, np.int32 if array is self.indices else np.float32)
                padded[: self.count] = values
                array.from_numpy(padded)


class Source:
    """One source on one grid: the open cells and faces, or parts of them, that it covers.

    A cell of which it covers a part is raised to that part of what whole ones are raised to, so that air at rest gets
    the source's values times its volume, wherever it lies between cells. What an obstacle covers just now emits
    nothing. A source that moves emits where it is in any part of the step, so that what it leaves behind in air at rest
    is its swept volume, however long the steps are.

    Velocity is imposed before the projection, which may change it: a source drives the flow, it is no inlet. So it
    never creates volume, and also blows in a closed box. Faces get it by the covered part of the cell around them
    (Fadlun et al. 2000, J. Comput. Phys. 161:35-60, section 2.3).

    Attributes:
        parameters: of the source.
        motion: how it moves; None if it stays.
        target_density, target_excess: what cells inside are raised to at full strength [-], [K above the air].
        cell_count: how many cells outside of static solids it covers a part of; if it moves, in the last step.
    """

    def __init__(self, parameters: SmokeSourceParameters, *, cell_size: float, ambient_temperature: float) -> None:
        """Prepare it; `enter` puts it into a grid of this cell size [m]."""
        self.parameters = parameters
        self.target_density = parameters.density
        self.target_excess = parameters.temperature - ambient_temperature
        self._cells, self._faces = _Places(), [_Places() for _ in range(3)]
        self._emitted = ti.ndarray(ti.f32, 1)
        # Random numbers of other seeds are others; seed 0 leaves the key of a patch as it is.
        self._salt = int(np.uint32(spread(parameters.seed)).view(np.int32))
        self.motion: SourceMotion | None = None
        self._shape = SweptShape(parameters, cell_size)
        turn, velocity = rotation.from_degrees(parameters.rotation_deg), np.asarray(parameters.velocity or (0.0,) * 3)
        self._own_velocity = rotation.rotated(rotation.conjugate(turn), velocity)
        if parameters.moves:
            self.motion = motion_of(parameters, self._shape.reach)
        else:
            self._rest = Motion(np.asarray(parameters.position, float), turn, np.zeros(3), np.zeros(3))

    def enter(self, grid: SmokeGrid) -> None:
        """Emit into this grid from now on."""
        self._grid, self._solid = grid, grid.pad(grid.solid).ravel()
        if self.motion is None:
            self._cover([self._rest])

    def bounds(self, begin_s: float, end_s: float) -> NDArray[np.float64]:
        """Corners of a box around where it is from one time to another [s], as far as that is known [m], (2, 3)."""
        if self.motion is None:
            return self._shape.bounds(self._rest)
        spacing = BOUNDS_SPACING * self._shape.reach
        boxes = np.stack([self._shape.bounds(pose) for pose in self.motion.poses(begin_s, end_s, spacing=spacing)])
        unseen = (end_s - begin_s) * self.motion.speed() if isinstance(self.motion, BodyMotion) else 0.0
        return np.stack([boxes[:, 0].min(axis=0) - spacing - unseen, boxes[:, 1].max(axis=0) + spacing + unseen])

    @property
    def cell_count(self) -> int:
        """See the class."""
        return self._cells.count

    @property
    def speed(self) -> float:
        """Largest component of the velocity that it imposes in the coming step [m/s]; 0 if it imposes none."""
        if self.parameters.velocity is None:
            return 0.0
        if self.motion is None:
            return max(map(abs, self.parameters.velocity))
        return math.hypot(*self.parameters.velocity) + self.motion.speed()

    def emit(self, air: Air, time_s: float, dt: float) -> float:
        """Bring the fields to the source's values in a step of dt [s] from a simulated time [s] on.

        Fluctuation and flicker are functions of place and time alone, so a run that continues sees the same.

        Returns:
            The density added, summed over the air of cells [-].
        """
        begin_s, end_s = self.parameters.span_of(time_s, time_s + dt)
        if self.motion is not None:
            self._cover(self.motion.poses(begin_s, end_s, spacing=self._grid.cell_size / POSES_PER_CELL))
        strength = self.parameters.largest_strength(begin_s, end_s) * self._steadiness(end_s)
        block = GPU_BLOCK if air.box.lanes > 1 else BLOCK
        blocks = -(-max(1, self._cells.count) // block)
        if self._emitted.shape[0] < blocks:
            self._emitted = ti.ndarray(ti.f32, blocks)
        tick, first = int(time_s * FLUCTUATION_RATE_HZ), ti.math.ivec3(self._grid.first)
        noise = Noise(tick, self._salt, first, self.parameters.fluctuation)
        targets = ti.math.vec2(strength * self.target_density, strength * self.target_excess)
        is_hot, count = self.target_excess >= 0.0, self._cells.count
        cells = self._cells.indices, self._cells.shares
        _raise_cells(air, *cells, count, noise, targets, is_hot, block, blocks, self._emitted)
        if self.parameters.velocity is not None:
            for faces, openness, velocity in zip(self._faces, air.openness, air.state.velocity, strict=True):
                _set_faces(faces.indices, faces.shares, faces.speeds, openness, velocity, faces.count)
        return float(copied(self._emitted)[:blocks].sum(dtype=np.float64))

    def add_fuel(self, air: Air, fuel: ti.Ndarray, time_s: float, dt: float) -> None:
        """Bring the fuel of the gas to the source's, in the cells of the `emit` before with the same step."""
        begin_s, end_s = self.parameters.span_of(time_s, time_s + dt)
        target = self.parameters.largest_strength(begin_s, end_s) * self._steadiness(end_s) * self.parameters.fuel
        _raise_fuel(air, self._cells.indices, self._cells.shares, self._cells.count, target, fuel)

    def _cover(self, poses: Sequence[Motion]) -> None:
        swept = self._shape.covered(self._grid, poses, CELLS)
        is_air = ~self._solid[swept.indices]
        self._cells.put(swept.indices[is_air], swept.shares[is_air])
        if self.parameters.velocity is None:
            return
        origins = np.stack([pose.position for pose in poses])
        spins = np.stack([pose.angular_velocity for pose in poses])
        blown = np.stack([pose.velocity + rotation.rotated(pose.orientation, self._own_velocity) for pose in poses])
        for axis, faces in enumerate(self._faces):
            swept = self._shape.covered(self._grid, poses, axis)
            turning = rotation.cross(spins[swept.poses], swept.places - origins[swept.poses])
            faces.put(swept.indices, swept.shares, (blown[swept.poses] + turning)[:, axis])

    def _steadiness(self, time_s: float) -> float:
        """What flickering leaves of its strength [-]."""
        flicker = self.parameters.flicker
        return 1.0 - flicker * smooth_noise(time_s * self.parameters.flicker_rate, self.parameters.seed)


@kernel
def _raise_cells(
    air: Air,
    cells: Integers,
    shares: Floats,
    count: ti.i32,
    noise: Noise,
    targets: ti.math.vec2,
    is_hot: ti.template(),
    size: ti.i32,
    blocks: ti.i32,
    added: Floats,
):
    """Raise density and heat to their targets, and lower the excess of what is colder than the air."""
    density, excess = ti.static((air.state.density, air.state.excess))
    for block in range(blocks):
        emitted = 0.0
        for n in range(block * size, ti.min((block + 1) * size, count)):
            at = cells[n]
            if not is_solid(air.solids, at):
                before = density[at]
                after = ti.max(before, shares[n] * targets[0])
                density[at] = after
                emitted += part_before(air.solids, at) * (after - before)
                target = (1.0 - noise.strength * _fluctuate(air.box, at, noise)) * shares[n] * targets[1]
                excess[at] = ti.max(excess[at], target) if ti.static(is_hot) else ti.min(excess[at], target)
        added[block] = emitted


@kernel
def _raise_fuel(air: Air, cells: Integers, shares: Floats, count: ti.i32, target: ti.f32, fuel: Floats):
    for n in range(count):
        if not is_solid(air.solids, cells[n]):
            fuel[cells[n]] = ti.max(fuel[cells[n]], shares[n] * target)


@func
def _fluctuate(box: Grid, at: ti.i32, noise: Noise):
    """A number in [0, 1) that a few neighbouring cells share."""
    patch_i = (noise.first[0] + at // box.step_x) // FLUCTUATION_CELLS
    patch_j = (noise.first[1] + at // box.step_y % (box.ny + 2)) // FLUCTUATION_CELLS
    patch_k = (noise.first[2] + at % box.step_y) // FLUCTUATION_CELLS
    patch = (patch_i * 1024 + patch_j) * 1024 + patch_k
    # The odd factor (Knuth's) spreads ticks over all bits, so that they do not shift the pattern.
    key = ti.cast(patch, ti.u32) ^ (ti.cast(noise.tick, ti.u32) * ti.u32(2654435769))
    return hash_to_unit(key ^ ti.cast(noise.salt, ti.u32))


@kernel
def _set_faces(faces: Integers, shares: Floats, speeds: Floats, openness: Floats, velocity: Floats, count: ti.i32):
    for n in range(count):
        at = faces[n]
        if openness[at] > 0.0:
            velocity[at] = (1.0 - shares[n]) * velocity[at] + shares[n] * speeds[n]


def sources_of(parameters: SmokeParameters) -> Sequence[Source]:
    """The sources of a smoke, in no grid yet."""
    given = {"cell_size": parameters.cell_size, "ambient_temperature": parameters.ambient_temperature}
    return [Source(source, **given) for source in parameters.source]


def require_cells(parameters: SmokeParameters, sources: Sequence[Source], grid: SmokeGrid) -> None:
    """Look whether all sources of a smoke can emit in its grid.

    Raises:
        ValueError: a source that stays covers no open cell: it lies outside the box or in a solid.
    """
    for number, source in enumerate(sources):
        if source.motion is None and source.cell_count == 0:
            raise ValueError(
                f'smoke "{parameters.name}", source {number}: it covers no cell; move it into the box '
                f"from {grid.origin} to {grid.upper} m, and out of solids"
            )
