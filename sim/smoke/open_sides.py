"""Open sides of the box: air from outside is at rest there, and brings no energy with it.

Outside the air is still, so its total pressure is 0: where it comes in with the speed v its pressure has fallen to
p = -rho v²/2 (Bernoulli), where it leaves p = 0. With p = 0 on both, air would come in with an energy of rho v²/2 that
nobody has given it, and what it drives draws in more: cold fog in a box with an open top reached several times the
speed that its height can give. This is the directional condition of Bruneau & Fabrie 1994 and, with the whole factor,
the tangential one of Bertoglio & Caiazzo 2014 reduced to the normal velocity; the velocity along the side is that of
the air outside (`Advection`).

One v of the square is that of before the projection, the other that of after it, and so belongs to the operator. With
q = p dt / h, half a cell from the side, u' = u - 2 (q - q_side) and q_side = -v u' dt / (2 h) become

    u' = (u - 2 q) / (1 + v dt / h),

a smaller conductance of the face and a smaller velocity before the projection: symmetric, positive, stable whatever dt,
and in a steady flow exactly Bernoulli's pressure.
"""

import taichi as ti

from sim.core.bundles import func
from sim.core.launch import kernel
from sim.smoke.arrays import Faces
from sim.smoke.lanes import Grid, cell_counts, steps
from sim.smoke.multigrid_levels import Coefficients, Operator, invert_diagonal_at
from sim.smoke.obstacles import Obstacles, Solids, is_solid


class OpenSides:
    """Lets air in through open sides with the total pressure of air at rest.

    Windward sides are no open ones here: there wind comes in with a given velocity.

    Args:
        obstacles: in the grid where the faces are; what they cover stays closed.
        velocity: of the faces [m/s].
        coefficients: of the pressure equation; those of the finest level follow the inflow, at the faces of open sides
            and the cells behind them. The coarser ones only precondition, and stay those of p = 0.
    """

    def __init__(self, obstacles: Obstacles, velocity: Faces, coefficients: Coefficients) -> None:
        self._obstacles, self._velocity, self._operator = obstacles, velocity, coefficients.operator
        nx, ny, nz = obstacles.grid.cells
        self._places = max(ny * nz, nx * nz, nx * ny)
        self._sides = tuple((axis, side) for axis in range(3) for side in (0, 1) if obstacles.grid.is_open(axis, side))

    def brake_inflow(self, dt: float) -> None:
        """Prepare the projection of a step of dt [s]; velocities and conductances of inflow become smaller."""
        if self._sides:
            obstacles, step = self._obstacles, dt / self._obstacles.grid.cell_size
            _brake(self._sides, self._places, obstacles.box, obstacles.solids, self._velocity, self._operator, step)


@kernel
def _brake(
    sides: ti.template(),
    places: ti.i32,
    box: Grid,
    solids: Solids,
    velocity: Faces,
    operator: Operator,
    step: ti.f32,
):
    # All sides in one loop, a place of each a turn: starting a loop takes longer than running it.
    for n in range(places):
        for axis, side in ti.static(sides):
            cell = _cell_behind(box, axis, side, n)
            if cell > 0 and not is_solid(solids, cell):
                normal = ti.static((velocity.x, velocity.y, velocity.z)[axis])
                conductance = ti.static((operator.faces.x, operator.faces.y, operator.faces.z)[axis])
                face = cell + side * steps(box)[axis]
                inward = normal[face] if ti.static(side == 0) else -normal[face]
                drag = 1.0 + step * ti.max(inward, 0.0)
                normal[face] /= drag
                conductance[face] = 2.0 / drag
    # Cells behind two sides are found twice, with the same result.
    for n in range(places):
        for axis, side in ti.static(sides):
            cell = _cell_behind(box, axis, side, n)
            if cell > 0:
                invert_diagonal_at(operator, cell, box.step_x, box.step_y)


@func
def _cell_behind(box: Grid, axis: ti.template(), side: ti.template(), place: ti.i32):
    """The cell behind a side at one of its places, row by row; 0 beyond the last."""
    cells, step = cell_counts(box), steps(box)
    first, second = ti.static(((1, 2), (0, 2), (0, 1))[axis])
    row = place // cells[second]
    behind = cells[axis] if ti.static(side == 1) else 1
    at = behind * step[axis] + (row + 1) * step[first] + (place % cells[second] + 1) * step[second]
    return ti.select(row < cells[first], at, 0)
