"""The sides of the box that air passes: wind blows in through some, air that was at rest outside through the others.

Windward sides are closed faces to the pressure, which move: u.n = U.n. Zero pressure there would let obstacles slow the
wind down in time, as nothing but the air's inertia would drive it. What flows in has the whole velocity of the wind, so
the first cells behind these sides are given its components along the side as well, before each projection.

At the other open sides the air outside is still, so its total pressure is 0: where it comes in with the speed v its
pressure has fallen to p = -rho v²/2 (Bernoulli), where it leaves p = 0. With p = 0 on both, air would come in with an
energy of rho v²/2 that nobody has given it, and what it drives draws in more: cold fog in a box with an open top
reached several times the speed that its height can give. This is the directional condition of Bruneau & Fabrie 1994
and, with the whole factor, the tangential one of Bertoglio & Caiazzo 2014 reduced to the normal velocity; the velocity
along the side is that of the air outside (`Advection`).

One v of the square is that of before the projection, the other that of after it, and so belongs to the operator. With
q = p dt / h, half a cell from the side, u' = u - 2 (q - q_side) and q_side = -v u' dt / (2 h) become

    u' = (u - 2 q) / (1 + v dt / h),

a smaller conductance of the face and a smaller velocity before the projection: symmetric, positive, stable whatever dt,
and in a steady flow exactly Bernoulli's pressure. Where the air outside moves inwards itself, as forces of wind make
it, v is what comes on top of that.
"""

from collections.abc import Sequence

import taichi as ti

from sim.core.arrays import Floats
from sim.core.bundles import func
from sim.core.domain import Face
from sim.core.launch import kernel
from sim.core.parameters import Vector3
from sim.smoke.lanes import Grid, cell_counts, steps
from sim.smoke.multigrid_levels import Operator, invert_diagonal_at
from sim.smoke.obstacles import Air, flux_part, is_solid


def brake_inflow(
    air: Air,
    operator: Operator,
    open_sides: tuple[tuple[int, int], ...],
    cells: tuple[int, int, int],
    wind: Vector3,
    step: float,
) -> None:
    """Prepare the projection for air that comes in through open sides, each an axis and a side of it, 0 or 1.

    Outside it has the velocity of a wind [m/s].

    Velocities and conductances of inflow become smaller; of the latter those of the finest level, at the faces of the
    sides and the cells behind them. The coarser ones only precondition, and stay those of p = 0. What obstacles cover
    stays closed. A step is dt/h [s/m].
    """
    if open_sides:
        nx, ny, nz = cells
        _brake(open_sides, max(ny * nz, nx * nz, nx * ny), air, operator, ti.math.vec3(wind), step)


def start_wind(air: Air, wind: Vector3, windward: Sequence[Face]) -> None:
    """Let all air of the box move with the wind [m/s]; faces of solids are at rest."""
    for openness, velocity, speed in zip(air.openness, air.state.velocity, wind, strict=True):
        _set_open_faces(openness, velocity, speed)
    blow_in(air, wind, windward)


def blow_in(air: Air, wind: Vector3, windward: Sequence[Face]) -> None:
    """Give the sides that the wind blows onto, and the cells behind them, its velocity [m/s]."""
    cells = air.box.nx, air.box.ny, air.box.nz
    for name in windward:
        axis = "xyz".index(name[0])
        layer, face = (cells[axis], cells[axis] + 1) if name[1] == "+" else (1, 1)
        _set_side(axis, layer, face, air, ti.math.vec3(wind))


@kernel
def _brake(sides: ti.template(), places: ti.i32, air: Air, operator: Operator, wind: ti.math.vec3, step: ti.f32):
    box, solids, velocity = ti.static((air.box, air.solids, air.state.velocity))
    # All sides in one loop, a place of each a turn: starting a loop takes longer than running it.
    for n in range(places):
        for axis, side in ti.static(sides):
            cell = _cell_behind(box, axis, side, n)
            if cell > 0 and not is_solid(solids, cell):
                normal = ti.static((velocity.x, velocity.y, velocity.z)[axis])
                conductance = ti.static((operator.faces.x, operator.faces.y, operator.faces.z)[axis])
                face = cell + side * steps(box)[axis]
                sign = ti.static(1.0 - 2.0 * side)
                outside, inward = ti.max(sign * wind[axis], 0.0), sign * normal[face]
                drag = 1.0 + step * ti.max(inward - outside, 0.0)
                normal[face] = sign * (outside + (inward - outside) / drag)
                conductance[face] = 2.0 * flux_part(solids, axis, face) / drag
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


@kernel
def _set_open_faces(openness: Floats, velocity: Floats, speed: ti.f32):
    for at in range(velocity.shape[0]):
        velocity[at] = ti.select(openness[at] > 0.0, speed, 0.0)


@kernel
def _set_side(axis: ti.template(), layer: ti.i32, face: ti.i32, air: Air, wind: ti.math.vec3):
    box, openness, velocity = ti.static((air.box, air.openness, air.state.velocity))
    first, second = ti.static(((1, 2), (0, 2), (0, 1))[axis])
    cells, step = cell_counts(box), steps(box)
    end_a, end_b = cells[first], cells[second]
    # One more than cells, for the faces at their far ends.
    for a, b in ti.ndrange((1, end_a + 2), (1, end_b + 2)):
        beside = a * step[first] + b * step[second]
        at = layer * step[axis] + beside
        if a <= end_a and b <= end_b and not is_solid(air.solids, at):
            normal = ti.static((velocity.x, velocity.y, velocity.z)[axis])
            normal[face * step[axis] + beside] = wind[axis]
        for tangent in ti.static((first, second)):
            passes = ti.static((openness.x, openness.y, openness.z)[tangent])
            along = ti.static((velocity.x, velocity.y, velocity.z)[tangent])
            if passes[at] > 0.0:
                along[at] = wind[tangent]
