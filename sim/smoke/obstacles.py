"""Obstacles in a smoke's box that may move: what they leave open now and did before, and how fast they are.

Who has something in the box marks the corners of cells before each step of the smoke, with their signed distance from
the solid in cells and the velocity that the solid has there, on both sides of its surface and a cell beyond:

    @kernel
    def _mark(box: Grid, marks: Marks, ...):
        for i, j in ti.ndrange((1, box.nx + 2), (1, box.ny + 2)):
            for k in range(1, box.nz + 2):
                mark(marks, row_start(box, i, j) + k, distance, velocity, NOBODY)

    _mark(smoke.obstacles.box, smoke.obstacles.marks, ...)

The lowest corner of a cell has its index. The step itself then commits them: from there on they are the obstacles, and
all marks are taken off. Of several solids the nearest counts. What they leave open: `cut_cells`.
"""

import math
from typing import NamedTuple, Protocol

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.arrays import Floats, Integers
from sim.core.bundles import bundle, func
from sim.core.host_access import copied
from sim.core.launch import kernel
from sim.smoke.arrays import Faces, State, new_faces, new_floats
from sim.smoke.cut_cells import FAR, ROUNDING, find_keepers, mark_keepers, measure_areas, measure_volumes
from sim.smoke.grid import SmokeGrid
from sim.smoke.lanes import Grid, device_grid, lane_items, lane_place, row_start, steps

NOBODY = -1  # owner of corners of what no air moves


class Mover(Protocol):
    """Somebody who marks corners."""

    def stable_dt(self) -> float:
        """Largest step [s] in which none of its solids gets farther than a cell in the box, as far as it can tell."""

    def exchange(self, dt: float) -> None:
        """Mark them where they are, at the end of a step of dt [s]."""

    def reach(self, duration_s: float) -> list[NDArray[np.float64]]:
        """Lower and upper corner, (2, 3), of where each of its free bodies may come in so long [m], from now on."""


def time_of_travel(distance: float, speed: float, acceleration: float) -> float:
    """Time t [s] in which nothing gets farther than a distance: v t + a t² = d; infinite at rest.

    The speed at the end of the time counts, v + a t, twice the way of a steady acceleration: one that sets in is no
    surprise. Distances are positive [m], speeds and accelerations not negative [m/s, m/s²].
    """
    if speed <= 0.0 and acceleration <= 0.0:
        return math.inf
    return 2.0 * distance / (speed + math.sqrt(speed * speed + 4.0 * acceleration * distance))


@bundle
class Solids(NamedTuple):
    """What the solids leave open, and where they are; of no meaning without `cuts`."""

    area: Faces  # open parts of faces [-]; of moving solids the means of before and after the last commit
    volume: Floats  # open parts of cells [-], 1 in ghosts
    before: Floats  # the same before the last commit
    words: Integers  # who keeps what small cells hold (`cut_cells`)
    distance: Floats  # of corners from solids, not beyond `FAR` [cells]; negative inside
    velocity: Faces  # of the nearest solid at corners [m/s]
    owner: Integers  # number of the free body that this is at corners (`free_bodies`), or `NOBODY`
    cuts: ti.template()  # whether there are or may be solids
    moving: ti.template()  # whether they may move
    carries: ti.template()  # whether some are free bodies


@bundle
class Marks(NamedTuple):
    """The solids of the next commit."""

    distance: Floats
    velocity: Faces
    owner: Integers
    carries: ti.template()


@bundle
class Air(NamedTuple):
    """The air of a smoke, and what is in its way, as kernels take it."""

    box: Grid
    solids: Solids
    openness: Faces  # positive on faces that air passes
    state: State


class Obstacles:
    """The solids in one grid: static ones, and those that others mark step by step.

    Attributes:
        grid: the cells; its `distance` is from the static ones.
        box: the same for kernels.
        moving: whether anybody marks corners; without, nothing ever changes.
        movers: who does; steps are cut to follow them.
        solids: now.
        marks: of the next commit.
    """

    def __init__(self, grid: SmokeGrid, *, moving: bool = False, carries: bool = False) -> None:
        """Take a grid, and whether others will mark corners, free bodies among them."""
        self.grid, self.box, self.moving = grid, device_grid(grid.cells), moving
        self.movers: list[Mover] = []
        cuts = moving or grid.has_solids
        size, of_movers = grid.size if cuts else 1, grid.size if moving else 1
        volume, distance, velocity = new_floats(size), new_floats(size), new_faces(of_movers)
        before = new_floats(size) if moving else volume
        for array in (volume, before):
            array.fill(1.0)
        words, owner = ti.ndarray(ti.i32, size), ti.ndarray(ti.i32, size if carries else 1)
        owner.fill(NOBODY)
        kinds = cuts, moving, carries
        self.solids = Solids(new_faces(size), volume, before, words, distance, velocity, owner, *kinds)
        self.marks = Marks(new_floats(of_movers), velocity, owner, carries)
        self._static, self._distance_before = new_floats(of_movers), new_floats(size) if moving else distance
        if cuts:
            distance.from_numpy(self._flat(grid.distance))
            if moving:
                for array in (self._static, self.marks.distance):
                    array.copy_from(distance)
            self._settle()

    def stable_dt(self) -> float:
        """Largest step [s] in which no solid crosses more than a cell, so that none leaps over the smoke in its way.

        As far as the movers can tell: what collisions give within the step is unforeseen.
        """
        return min((mover.stable_dt() for mover in self.movers), default=math.inf)

    def open_volume(self) -> NDArray[np.float32]:
        """Open parts of the cells now, (nx, ny, nz)."""
        if not self.solids.cuts:
            return np.ones(self.grid.cells, np.float32)
        return self.grid.trim(copied(self.solids.volume), self.grid.cells)

    def is_air(self) -> NDArray[np.bool_]:
        """Which cells are open now, in part at least, (nx, ny, nz)."""
        air: NDArray[np.bool_] = self.open_volume() > 0.0
        return air

    def commit(self) -> bool:
        """Take the marked solids for the obstacles from now on; returns whether anything that they leave open changed.

        It also does where they stop, since `before` then is what is now.
        """
        if not self.moving:
            return False
        moved = bool(_swap(self.box, self.solids, self._distance_before, self._static, self.marks.distance))
        changed = moved or self._moved
        self._moved = moved
        if changed:
            self._measure()
        return changed

    def checkpoint(self) -> dict[str, NDArray[np.generic]]:
        """Distances of the corners, if any solid may move; velocities have gone into the faces."""
        if not self.moving:
            return {}
        return {"obstacles": self.solids.distance.to_numpy().reshape(self.grid.padded)}

    def restore(self, distance: NDArray[np.generic]) -> None:
        """Continue from the distances of a checkpoint, `padded`."""
        self.solids.distance.from_numpy(np.ascontiguousarray(distance, np.float32).ravel())
        self.marks.distance.copy_from(self._static)
        self._settle()

    def _settle(self) -> None:
        """Take the solids for having been where they are."""
        if self.moving:
            self._distance_before.copy_from(self.solids.distance)
        self._measure()
        self._measure()
        self._moved = True

    def _measure(self) -> None:
        solids, distances = self.solids, (self.solids.distance, self._distance_before)
        measure_volumes(self.box, distances[0], solids.volume, solids.before)
        volumes = solids.volume, solids.before
        find_keepers(self.box, *distances, *volumes, solids.words, self.moving)
        mark_keepers(self.box, *volumes, solids.words)
        for axis, area in enumerate(solids.area):
            measure_areas(axis, self.box, *distances, *volumes, area, self.moving)

    def _flat(self, distance: NDArray[np.float32]) -> NDArray[np.float32]:
        padded = np.full(self.grid.padded, FAR, np.float32)
        padded[1:, 1:, 1:] = distance
        return padded.ravel()


@func
def mark(marks: Marks, at: ti.i32, distance: ti.f32, velocity, owner: ti.i32):
    """The corner at a flat index is so far from a solid in the coming step [cells], which moves there so fast [m/s].

    The owner is the number of a free body, or `NOBODY`.
    """
    rounded = ti.select(ti.abs(distance) < ROUNDING, 0.0, distance)
    if rounded < marks.distance[at]:
        marks.distance[at] = rounded
        marks.velocity.x[at] = velocity[0]
        marks.velocity.y[at] = velocity[1]
        marks.velocity.z[at] = velocity[2]
        if ti.static(marks.carries):
            marks.owner[at] = owner


@func
def wall_flux(box: Grid, solids: Solids, at: ti.i32) -> ti.f32:
    """What solids push into a cell, over the area of a face [m/s]: the integral of u_solid.n over their surface in it.

    By Gauss' theorem of what crosses the closed parts of its faces, less what the solid itself spreads inside.
    """
    through, spread = 0.0, 0.0
    for axis in ti.static(range(3)):
        along = steps(box)[axis]
        low, high = _solid_velocity(axis, box, solids, at), _solid_velocity(axis, box, solids, at + along)
        through += (1.0 - flux_part(solids, axis, at)) * low - (1.0 - flux_part(solids, axis, at + along)) * high
        spread += low - high
    return through - (1.0 - mean_volume(solids, at)) * spread


@func
def _solid_velocity(axis: ti.template(), box: Grid, solids: Solids, at: ti.i32) -> ti.f32:
    """Velocity of solids across the face of which the lowest corner is at an index [m/s]."""
    first, second = ti.static(((1, 2), (0, 2), (0, 1))[axis])
    speed = ti.static((solids.velocity.x, solids.velocity.y, solids.velocity.z)[axis])
    a, b = steps(box)[first], steps(box)[second]
    return 0.25 * ((speed[at] + speed[at + a]) + (speed[at + b] + speed[at + a + b]))


@func
def is_solid(solids: Solids, at: ti.i32):
    """Whether nothing of the cell at a flat index is open now."""
    solid = False
    if ti.static(solids.cuts):
        solid = solids.volume[at] == 0.0
    return solid


@func
def part_before(solids: Solids, at: ti.i32) -> ti.f32:
    """Open part of the cell at a flat index before the last commit, which is that of what it holds until then [-]."""
    part = 1.0
    if ti.static(solids.cuts):
        part = solids.before[at]
    return part


@func
def mean_volume(solids: Solids, at: ti.i32) -> ti.f32:
    """Open part of a cell, the mean of before and after the last commit."""
    volume = 1.0
    if ti.static(solids.moving):
        volume = 0.5 * (solids.before[at] + solids.volume[at])
    elif ti.static(solids.cuts):
        volume = solids.volume[at]
    return volume


@func
def flux_part(solids: Solids, axis: ti.template(), at: ti.i32) -> ti.f32:
    """Part of a face across an axis through which air flows with the velocity of the face."""
    part = 1.0
    if ti.static(solids.cuts):
        part = ti.static((solids.area.x, solids.area.y, solids.area.z)[axis])[at]
    return part


@kernel
def _swap(box: Grid, solids: Solids, before: Floats, static: Floats, marked: Floats) -> ti.i32:
    changed = 0
    for i, j, lane in ti.ndrange((1, box.nx + 2), (1, box.ny + 2), box.lanes):
        in_row = 0
        for n in range(lane_items(box, box.nz + 1, lane)):
            at = row_start(box, i, j) + lane_place(box, n, lane)
            before[at] = solids.distance[at]
            in_row += int(solids.distance[at] != marked[at])
            solids.distance[at] = marked[at]
            if marked[at] >= static[at]:
                solids.velocity.x[at] = 0.0
                solids.velocity.y[at] = 0.0
                solids.velocity.z[at] = 0.0
                if ti.static(solids.carries):
                    solids.owner[at] = NOBODY
            marked[at] = static[at]
        changed += in_row
    return changed


class AirForce(Protocol):
    """Something in the air that pushes it, such as cloth."""

    def stable_dt(self) -> float:
        """Largest step [s] that it bears."""

    def accelerate(self, dt: float) -> None:
        """Add what it gives in a step of dt [s] to the velocities of open faces, after the air was carried along."""
