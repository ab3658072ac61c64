"""Rigid bodies that the air pushes while they push it: solved for together with the pressure.

What bodies push into a cell (`wall_flux`) is linear in their velocities, v and omega: w v + (r x w) omega, with the
arms r of the corners that they have. By Gauss' theorem w is also the area that the body has in the cell, with its
direction, so that the impulse q = p dt / h of the pressure changes these velocities by

    dv = -rho h³/m sum_cells w q,        domega = -rho h³ I^-1 sum_cells (r x w) q.

Both are transposes of each other: what pressure takes from the air, momentum and energy, the bodies get, and the
equation stays symmetric and positive, with a term of rank six for each body (Batty, Bertails & Bridson 2007):

    (A + sum_bodies rho h³ W M^-1 W^T) q = -h div u*.

It is the answer of the body to the pressure within the step, so that a body may be lighter than the air that it sets
in motion, or than that whose place it takes.
"""

from typing import NamedTuple

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.arrays import Floats, Integers, Matrices, Vectors
from sim.core.bundles import bundle, func, with_room
from sim.core.host_access import copied, put
from sim.core.launch import kernel
from sim.smoke.cut_cells import CHANGES, NEAR_SOLIDS
from sim.smoke.lanes import Grid, lane_items, lane_place, row_start, steps
from sim.smoke.obstacles import NOBODY, Obstacles, Solids, flux_part, mean_volume

Float64Array = NDArray[np.float64]

ROW = 5  # numbers of a row: body, i, j, first and last k


@bundle
class Carried(NamedTuple):
    """Bodies that are free, (n,) each, and the rows of cells that they may cut, (r,); lengths in cells."""

    rows: Integers  # `ROW` numbers each, sorted by bodies
    row_count: ti.i32
    first_row: Integers  # of each body, and the end of the last, (n + 1,)
    centre: Vectors  # of their masses, such that the corner (i, j, k) is at (i, j, k)
    ease: Floats  # mass of the air in a cell over that of the body [-]
    turning_ease: Matrices  # the same of inertia [-]
    push_of_row: Vectors  # sums of w q over a row [m/s], (r,)
    twist_of_row: Vectors  # and of r x w q
    push: Vectors  # over all rows of a body
    twist: Vectors
    change: Vectors  # dv [m/s]
    turn: Vectors  # h domega [m/s]


class FreeBodies:
    """The bodies of one scene that the air of a smoke may push, by their numbers.

    Attributes:
        carried: for kernels.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        rows, first_row = ti.ndarray(ti.i32, ROW * max(count, 1)), ti.ndarray(ti.i32, count + 1)
        self.carried = with_room(Carried, count, rows=rows, row_count=0, first_row=first_row)
        self._impulses, self._unit, self._cell_size = np.zeros((count, 6)), 0.0, 1.0

    def place(
        self,
        obstacles: Obstacles,
        corners: NDArray[np.int64],
        centre: Float64Array,
        inverse_mass: Float64Array,
        inverse_inertia: Float64Array,
        air_density: float,
    ) -> None:
        """Take bodies where they are at the end of a step.

        Args:
            obstacles: of the grid; corners are marked with the numbers of bodies there.
            corners: the lowest and the highest that each body may have, (n, 2, 3); none where one is above the other.
            centre: of what moves, in the world [m], (n, 3).
            inverse_mass: [1/kg], (n,); 0 for what gives no way to the air.
            inverse_inertia: tensors in the world's axes [1/(kg m²)], (n, 3, 3).
            air_density: [kg/m³].
        """
        grid, h = obstacles.grid, obstacles.grid.cell_size
        rows, starts = _rows_of(corners, np.array(grid.cells))
        self._unit, self._cell_size = air_density * h**3, h
        if len(rows) > self.carried.push_of_row.shape[0]:
            room = 2 * len(rows)
            self.carried = self.carried._replace(
                rows=ti.ndarray(ti.i32, ROW * room),
                push_of_row=ti.Vector.ndarray(3, ti.f32, room),
                twist_of_row=ti.Vector.ndarray(3, ti.f32, room),
            )
        filled = np.zeros(self.carried.rows.shape[0], np.int32)
        filled[: rows.size] = rows.ravel()
        self.carried = self.carried._replace(row_count=len(rows))
        for array, values in (
            (self.carried.rows, filled),
            (self.carried.first_row, starts.astype(np.int32)),
            (self.carried.centre, (centre - grid.origin) / h + 1.0),
            (self.carried.ease, self._unit * inverse_mass),
            (self.carried.turning_ease, self._unit * h * h * inverse_inertia),
        ):
            put(array, values)

    def hold(self) -> None:
        """Let none give way until they are placed anew."""
        self.carried.ease.fill(0.0)
        self.carried.turning_ease.fill(0.0)

    def begin(self) -> None:
        """Start a projection."""
        self._impulses[:] = 0.0

    def answer(self, box: Grid, solids: Solids, values: ti.Ndarray) -> None:
        """Find how velocities answer to impulses q of pressure [m/s]."""
        _answer(box, solids, self.carried, values)

    def take(self, box: Grid, solids: Solids, values: ti.Ndarray) -> None:
        """Let impulses q of pressure [m/s] act: corners of bodies change their velocities."""
        self.answer(box, solids, values)
        _change_corners(box, solids, self.carried)
        self._impulses[:, :3] -= self._unit * copied(self.carried.push)
        self._impulses[:, 3:] -= self._unit * self._cell_size * copied(self.carried.twist)

    def impulses(self) -> Float64Array:
        """What the last projection gave each [N s], and its moment about the centre of mass [N m s], (n, 6)."""
        return self._impulses.copy()


def _rows_of(corners: NDArray[np.int64], cells: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows of the cells beside corners, (r, `ROW`), and where those of each body begin, (n + 1,)."""
    low, high = np.maximum(corners[:, 0] - 1, 1), np.minimum(corners[:, 1], cells)
    counts = np.where((corners[:, 0] <= corners[:, 1]).all(axis=1), np.maximum(high - low + 1, 0).prod(axis=1) > 0, 0)
    wide = np.where(counts[:, None] > 0, high - low + 1, 0)
    of_body = wide[:, 0] * wide[:, 1]
    starts = np.concatenate([[0], np.cumsum(of_body)])
    body = np.repeat(np.arange(len(corners)), of_body)
    place = np.arange(starts[-1]) - starts[body]
    i, j = np.divmod(place, np.maximum(wide[body, 1], 1))
    columns = body, low[body, 0] + i, low[body, 1] + j, low[body, 2], high[body, 2]
    return np.stack(columns, axis=1), starts


@func
def _is_near(solids: Solids, at: ti.i32):
    return (solids.words[at] & ti.static(NEAR_SOLIDS | CHANGES)) != 0


@func
def _share(axis: ti.template(), side: ti.template(), box: Grid, solids: Solids, at: ti.i32) -> ti.f32:
    """Part of a face's area through which solids that move with one of its corners push air into a cell.

    As `wall_flux` has it; negative on upper faces, where what moves along the axis leaves.
    """
    face = flux_part(solids, axis, at + side * steps(box)[axis])
    part = mean_volume(solids, at) - face
    return 0.25 * ti.static(1.0 - 2.0 * side) * part


@func
def flux_of_answer(box: Grid, solids: Solids, carried: Carried, i: ti.i32, j: ti.i32, k: ti.i32) -> ti.f32:
    """What bodies push into a cell by how their velocities change, over the area of a face [m/s]."""
    at, flux = row_start(box, i, j) + k, 0.0
    if _is_near(solids, at):
        for axis, side in ti.static(ti.ndrange(3, 2)):
            share = _share(axis, side, box, solids, at)
            if share != 0.0:
                for a, b in ti.static(ti.ndrange(2, 2)):
                    corner = _corner(axis, side, a, b)
                    body = solids.owner[at + corner.dot(steps(box))]
                    if body != NOBODY:
                        flux += share * _change_at(ti.Vector([i, j, k]) + corner, body, carried)[axis]
    return flux


@func
def _corner(axis: ti.template(), side: ti.template(), a: ti.template(), b: ti.template()):
    """From the lowest corner of a cell to one of a face of it."""
    first, second = ti.static(((1, 2), (0, 2), (0, 1))[axis])
    corner = ti.Vector([0, 0, 0])
    corner[axis], corner[first], corner[second] = side, a, b
    return corner


@func
def _arm(corner, body: ti.i32, carried: Carried) -> ti.math.vec3:
    """From the centre of a body to a corner [cells]."""
    return ti.cast(corner, ti.f32) - carried.centre[body]


@func
def _change_at(corner, body: ti.i32, carried: Carried) -> ti.math.vec3:
    """How the velocity of a body changes at a corner [m/s]."""
    return carried.change[body] + carried.turn[body].cross(_arm(corner, body, carried))


@kernel
def _answer(box: Grid, solids: Solids, carried: Carried, values: Floats):
    bodies = carried.ease.shape[0]
    for row in range(carried.row_count):
        body, i, j = carried.rows[ROW * row], carried.rows[ROW * row + 1], carried.rows[ROW * row + 2]
        push, twist = ti.math.vec3(0.0), ti.math.vec3(0.0)
        for k in range(carried.rows[ROW * row + 3], carried.rows[ROW * row + 4] + 1):
            at = row_start(box, i, j) + k
            if _is_near(solids, at) and values[at] != 0.0:
                for axis, side in ti.static(ti.ndrange(3, 2)):
                    share = values[at] * _share(axis, side, box, solids, at)
                    if share != 0.0:
                        for a, b in ti.static(ti.ndrange(2, 2)):
                            corner = _corner(axis, side, a, b)
                            if solids.owner[at + corner.dot(steps(box))] == body:
                                force = ti.math.vec3(0.0)
                                force[axis] = share
                                push += force
                                twist += _arm(ti.Vector([i, j, k]) + corner, body, carried).cross(force)
        carried.push_of_row[row], carried.twist_of_row[row] = push, twist
    for body in range(bodies):
        push, twist = ti.math.vec3(0.0), ti.math.vec3(0.0)
        for row in range(carried.first_row[body], carried.first_row[body + 1]):
            push += carried.push_of_row[row]
            twist += carried.twist_of_row[row]
        carried.push[body], carried.twist[body] = push, twist
        carried.change[body] = -carried.ease[body] * push
        carried.turn[body] = -(carried.turning_ease[body] @ twist)


@kernel
def _change_corners(box: Grid, solids: Solids, carried: Carried):
    for i, j, lane in ti.ndrange((1, box.nx + 2), (1, box.ny + 2), box.lanes):
        for n in range(lane_items(box, box.nz + 1, lane)):
            k = lane_place(box, n, lane)
            at = row_start(box, i, j) + k
            body = solids.owner[at]
            if body != NOBODY:
                change = _change_at(ti.Vector([i, j, k]), body, carried)
                solids.velocity.x[at] += change[0]
                solids.velocity.y[at] += change[1]
                solids.velocity.z[at] += change[2]
