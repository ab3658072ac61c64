"""Obstacles in a smoke's box that may move: which cells they fill now, and how fast they are there.

Who has something in the box marks its cells before each step of the smoke, with the velocity that the solid has at
their centres:

    obstacles = smoke.obstacles
    @ti.kernel
    def _mark(self):
        for i, j in ti.ndrange((1, nx + 1), (1, ny + 1)):
            for k in range(1, nz + 1):
                if <the centre obstacles.centre(i, j, k) lies inside>:
                    obstacles.mark(i, j, k, velocity)

The step itself then commits them: from there on they are the obstacles, and all marks are taken off. Where two mark the
same cell the later one's velocity counts; static solids are never overridden.
"""

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.smoke.grid import SmokeGrid
from sim.smoke.lanes import lane_count, lane_items, lane_place
from sim.smoke.reductions import Pair, RowReductions

AIR, MOVING, STATIC = range(3)
"""What a cell is. Beyond closed sides of the box all is static, beyond open ones air."""


@dataclass(frozen=True)
class Change:
    """What a commit changed.

    Attributes:
        cells: how many cells became air or solid.
        covered: density that was in cells that are solid now, summed over cells [-].
        uncovered: density in the cells that are air now, likewise.
    """

    cells: int
    covered: float
    uncovered: float


NO_CHANGE = Change(0, 0.0, 0.0)


class Mover(Protocol):
    """Somebody who marks cells."""

    def stable_dt(self) -> float:
        """Largest step [s] in which none of its solids gets farther than a cell in the box, as far as it can tell."""


def time_of_travel(distance: float, speed: float, acceleration: float) -> float:
    """Time t [s] in which nothing gets farther than a distance: v t + a t² = d; infinite at rest.

    The speed at the end of the time counts, v + a t, twice the way of a steady acceleration: one that sets in is no
    surprise. Distances are positive [m], speeds and accelerations not negative [m/s, m/s²].
    """
    if speed <= 0.0 and acceleration <= 0.0:
        return math.inf
    return 2.0 * distance / (speed + math.sqrt(speed * speed + 4.0 * acceleration * distance))


@ti.data_oriented
class Obstacles:
    """The solid cells of one grid: static ones, and those that others mark step by step.

    Attributes:
        grid: the cells; its `solid` are the static ones.
        moving: whether anybody marks cells; without, nothing ever changes.
        movers: who does; steps are cut to follow them.
        state: AIR, MOVING or STATIC of each cell now, flat with ghosts, int32.
        marked: likewise, of the next commit.
        velocity_x, velocity_y, velocity_z: of the solid at the centres of MOVING cells [m/s], flat, float32; without
            a meaning elsewhere. Only there if `moving`.
    """

    def __init__(self, grid: SmokeGrid, *, moving: bool = False) -> None:
        self.grid, self.moving = grid, moving
        self._nx, self._ny, self._nz = grid.cells
        self._steps = (grid.padded[1] * grid.padded[2], grid.padded[2], 1)
        self._low, self._cell_size = grid.origin, grid.cell_size
        self._static = _static_state(grid)
        self._lanes = lane_count()
        self.movers: list[Mover] = []
        self.state = ti.field(ti.i32, shape=grid.size)
        if moving:
            self.marked = ti.field(ti.i32, shape=grid.size)
            self.velocity_x, self.velocity_y, self.velocity_z = (ti.field(ti.f32, shape=grid.size) for _ in range(3))
            self._rows = RowReductions(self._nx, self._ny)
            self.marked.from_numpy(self._static)
        self.state.from_numpy(self._static)

    @property
    def fields(self) -> list[ti.Field]:
        """All fields, four bytes a value."""
        moving = [self.marked, self.velocity_x, self.velocity_y, self.velocity_z] if self.moving else []
        return [self.state, *moving]

    @property
    def reductions(self) -> list[RowReductions]:
        """What it reduces rows with."""
        return [self._rows] if self.moving else []

    def stable_dt(self) -> float:
        """Largest step [s] in which no solid crosses more than a cell, so that none leaps over the smoke in its way.

        As far as the movers can tell: what collisions give within the step is unforeseen.
        """
        return min((mover.stable_dt() for mover in self.movers), default=math.inf)

    def is_air(self) -> NDArray[np.bool_]:
        """Which cells are air now, (nx, ny, nz)."""
        air: NDArray[np.bool_] = self.grid.trim(self.state.to_numpy(), self.grid.cells) == AIR
        return air

    def commit(self, density: ti.Field) -> Change:
        """Take the marked cells for the obstacles from now on, and clear the marks.

        Args:
            density: of smoke [-], flat; what covered and uncovered cells hold is summed up.
        """
        if not self.moving:
            return NO_CHANGE
        cells = self._swap(density)
        return Change(cells, *map(float, self._sum_changes())) if cells else NO_CHANGE

    def checkpoint(self) -> dict[str, NDArray[np.generic]]:
        """Which cells are moving solids, if any may be; their velocities have gone into the faces."""
        if not self.moving:
            return {}
        return {"obstacles": (self.state.to_numpy() == MOVING).reshape(self.grid.padded)}

    def restore(self, is_moving: NDArray[np.generic]) -> None:
        """Continue from the cells of a checkpoint, `padded`."""
        state = np.where(np.asarray(is_moving, bool).ravel(), np.int32(MOVING), self._static)
        self.state.from_numpy(state)
        self.marked.from_numpy(self._static)

    @ti.func
    def centre(self, i: ti.i32, j: ti.i32, k: ti.i32):
        """Centre of a cell [m]; cells count from 1."""
        return ti.Vector([self._low[0], self._low[1], self._low[2]]) + self._cell_size * (
            ti.Vector([float(i), float(j), float(k)]) - 0.5
        )

    @ti.func
    def mark(self, i: ti.i32, j: ti.i32, k: ti.i32, velocity):
        """A cell of the box, counted from 1, is solid in the coming step and moves there with a velocity [m/s]."""
        at = i * self._steps[0] + j * self._steps[1] + k
        if self.marked[at] != STATIC:
            self.marked[at] = MOVING
            self.velocity_x[at] = velocity[0]
            self.velocity_y[at] = velocity[1]
            self.velocity_z[at] = velocity[2]

    @ti.func
    def is_solid(self, at: ti.i32):
        """Whether the cell at a flat index is solid now."""
        return self.state[at] != AIR

    @ti.func
    def face_velocity(self, axis: ti.template(), at: ti.i32):
        """Velocity [m/s] of the solid across a closed face: of its solid cell, or the mean of both.

        For a rigid motion that of the cell is exact: v + omega x r does not change along its own direction.
        """
        velocity = 0.0
        if ti.static(self.moving):
            below = at - ti.static(self._steps[axis])
            solids = int(self.state[below] != AIR) + int(self.state[at] != AIR)
            total = self._speed(axis, below) + self._speed(axis, at)
            velocity = total / ti.max(1.0, float(solids))
        return velocity

    @ti.func
    def _speed(self, axis: ti.template(), at: ti.i32):
        component = ti.static((self.velocity_x, self.velocity_y, self.velocity_z)[axis])
        return ti.select(self.state[at] == MOVING, component[at], 0.0)

    @ti.kernel
    def _swap(self, density: ti.template()) -> ti.i32:
        changed = 0
        for i, j, lane in ti.ndrange((1, self._nx + 1), (1, self._ny + 1), self._lanes):
            row = i * self._steps[0] + j * self._steps[1]
            covered, uncovered = 0.0, 0.0
            in_row = 0
            for n in range(lane_items(self._nz, lane)):
                at = row + lane_place(n, lane)
                before, after = self.state[at], self.marked[at]
                if before != after:
                    in_row += 1
                    self.state[at] = after
                    if after == AIR:
                        uncovered += density[at]
                    else:
                        covered += density[at]
                if after == MOVING:
                    self.marked[at] = AIR
            self._rows.partial[self._rows.place(i, j, lane)] = ti.Vector([covered, uncovered])
            changed += in_row
        return changed

    @ti.kernel
    def _sum_changes(self) -> Pair:
        self._rows.sum_up()
        return self._rows.result[None]


def _static_state(grid: SmokeGrid) -> NDArray[np.int32]:
    """Flat state of a grid with its static solids alone."""
    state = np.full(grid.padded, STATIC, np.int32)
    inner = (slice(1, -1),) * 3
    for axis in range(3):
        for side in (0, 1):
            if grid.is_open(axis, side):
                ghosts = list(inner)
                ghosts[axis] = slice(-1, None) if side else slice(0, 1)
                state[tuple(ghosts)] = AIR
    state[inner] = np.where(grid.solid, STATIC, AIR)
    return state.ravel()
