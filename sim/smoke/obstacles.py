"""Obstacles in a smoke's box that may move: which cells they fill now, and how fast they are there.

Who has something in the box marks its cells before each step of the smoke, with the velocity that the solid has at
their centres:

    @kernel
    def _mark(box: Grid, marks: Marks, ...):
        for i, j in ti.ndrange((1, box.nx + 1), (1, box.ny + 1)):
            for k in range(1, box.nz + 1):
                if <the centre of the cell lies inside>:
                    mark(marks, row_start(box, i, j) + k, velocity)

    _mark(smoke.obstacles.box, smoke.obstacles.marks, ...)

The step itself then commits them: from there on they are the obstacles, and all marks are taken off. Where two mark the
same cell the later one's velocity counts; static solids are never overridden.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.arrays import Floats, Integers
from sim.core.bundles import bundle, func
from sim.core.host_access import copied
from sim.core.launch import kernel
from sim.smoke.arrays import Faces, State, new_faces
from sim.smoke.grid import SmokeGrid
from sim.smoke.lanes import Grid, device_grid, lane_items, lane_place, row_start, steps
from sim.smoke.reductions import Pair, Rows, new_rows, partial_place, sum_up

AIR, MOVING, STATIC = range(3)  # what a cell is. Beyond closed sides of the box all is static, beyond open ones air.


@dataclass(frozen=True)
class Change:
    """What a commit changed."""

    cells: int  # how many cells became air or solid
    covered: float  # density that was in cells that are solid now, summed over cells [-]
    uncovered: float  # density in the cells that are air now, likewise


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


@bundle
class Solids(NamedTuple):
    """The solid cells."""

    state: Integers  # AIR, MOVING or STATIC
    velocity: Faces  # components at the centres of MOVING cells [m/s]; of no meaning elsewhere
    moving: ti.template()  # whether there may be MOVING cells


@bundle
class Marks(NamedTuple):
    """The solid cells of the next commit."""

    state: Integers
    velocity: Faces


@bundle
class Air(NamedTuple):
    """The air of a smoke, and what is in its way, as kernels take it."""

    box: Grid
    solids: Solids
    openness: Faces  # positive on faces that air passes
    state: State


class Obstacles:
    """The solid cells of one grid: static ones, and those that others mark step by step.

    Attributes:
        grid: the cells; its `solid` are the static ones.
        box: the same for kernels.
        moving: whether anybody marks cells; without, nothing ever changes.
        movers: who does; steps are cut to follow them.
        solids: the cells now; their velocities are there only if `moving`.
        marks: likewise, of the next commit.
    """

    def __init__(self, grid: SmokeGrid, *, moving: bool = False) -> None:
        self.grid, self.box, self.moving = grid, device_grid(grid.cells), moving
        self._static = _static_state(grid)
        self.movers: list[Mover] = []
        velocity = new_faces(grid.size if moving else 1)
        self.solids = Solids(ti.ndarray(ti.i32, grid.size), velocity, moving)
        self.marks = Marks(ti.ndarray(ti.i32, grid.size if moving else 1), velocity)
        self._rows = new_rows(self.box) if moving else None
        self.solids.state.from_numpy(self._static)
        if moving:
            self.marks.state.from_numpy(self._static)

    def stable_dt(self) -> float:
        """Largest step [s] in which no solid crosses more than a cell, so that none leaps over the smoke in its way.

        As far as the movers can tell: what collisions give within the step is unforeseen.
        """
        return min((mover.stable_dt() for mover in self.movers), default=math.inf)

    def is_air(self) -> NDArray[np.bool_]:
        """Which cells are air now, (nx, ny, nz)."""
        air: NDArray[np.bool_] = self.grid.trim(copied(self.solids.state), self.grid.cells) == AIR
        return air

    def commit(self, density: ti.Ndarray) -> Change:
        """Take the marked cells for the obstacles from now on; sums up the smoke of those covered and uncovered."""
        if not self.moving:
            return NO_CHANGE
        cells = int(_swap(self.box, self.solids.state, self.marks.state, density, self._rows))
        return Change(cells, *map(float, _sum_changes(self._rows))) if cells else NO_CHANGE

    def checkpoint(self) -> dict[str, NDArray[np.generic]]:
        """Which cells are moving solids, if any may be; their velocities have gone into the faces."""
        if not self.moving:
            return {}
        return {"obstacles": (self.solids.state.to_numpy() == MOVING).reshape(self.grid.padded)}

    def restore(self, is_moving: NDArray[np.generic]) -> None:
        """Continue from the cells of a checkpoint, `padded`."""
        state = np.where(np.asarray(is_moving, bool).ravel(), np.int32(MOVING), self._static)
        self.solids.state.from_numpy(state)
        self.marks.state.from_numpy(self._static)


@func
def mark(marks: Marks, at: ti.i32, velocity):
    """The cell at a flat index is solid in the coming step and moves there with a velocity [m/s]."""
    if marks.state[at] != STATIC:
        marks.state[at] = MOVING
        marks.velocity.x[at] = velocity[0]
        marks.velocity.y[at] = velocity[1]
        marks.velocity.z[at] = velocity[2]


@func
def is_solid(solids: Solids, at: ti.i32):
    """Whether the cell at a flat index is solid now."""
    return solids.state[at] != AIR


@func
def face_velocity(box: Grid, solids: Solids, axis: ti.template(), at: ti.i32):
    """Velocity [m/s] of the solid across a closed face: of its solid cell, or the mean of both.

    For a rigid motion that of the cell is exact: v + omega x r does not change along its own direction.
    """
    velocity = 0.0
    if ti.static(solids.moving):
        component = ti.static((solids.velocity.x, solids.velocity.y, solids.velocity.z)[axis])
        below = at - steps(box)[axis]
        count = int(solids.state[below] != AIR) + int(solids.state[at] != AIR)
        total = ti.select(solids.state[below] == MOVING, component[below], 0.0)
        total += ti.select(solids.state[at] == MOVING, component[at], 0.0)
        velocity = total / ti.max(1.0, float(count))
    return velocity


@kernel
def _swap(box: Grid, state: Integers, marked: Integers, density: Floats, rows: Rows) -> ti.i32:
    changed = 0
    for i, j, lane in ti.ndrange((1, box.nx + 1), (1, box.ny + 1), box.lanes):
        covered, uncovered = 0.0, 0.0
        in_row = 0
        for n in range(lane_items(box, box.nz, lane)):
            at = row_start(box, i, j) + lane_place(box, n, lane)
            before, after = state[at], marked[at]
            if before != after:
                in_row += 1
                state[at] = after
                if after == AIR:
                    uncovered += density[at]
                else:
                    covered += density[at]
            if after == MOVING:
                marked[at] = AIR
        rows.partial[partial_place(box, i, j, lane)] = ti.Vector([covered, uncovered])
        changed += in_row
    return changed


@kernel
def _sum_changes(rows: Rows) -> Pair:
    sum_up(rows)
    return rows.nodes[0]


def _static_state(grid: SmokeGrid) -> NDArray[np.int32]:
    """Flat state of a grid with its static solids alone."""
    state = np.full(grid.padded, STATIC, np.int32)
    inner = (slice(1, -1),) * 3
    for axis, side in grid.open_sides:
        ghosts = list(inner)
        ghosts[axis] = slice(-1, None) if side else slice(0, 1)
        state[tuple(ghosts)] = AIR
    state[inner] = np.where(grid.solid, STATIC, AIR)
    return state.ravel()


class AirForce(Protocol):
    """Something in the air that pushes it, such as cloth."""

    def stable_dt(self) -> float:
        """Largest step [s] that it bears."""

    def accelerate(self, dt: float) -> None:
        """Add what it gives in a step of dt [s] to the velocities of open faces, after the air was carried along."""
