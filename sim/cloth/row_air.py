"""Wind and gravity on a rectangle, eight columns at a time (see `row_blocks`): what `air` and `motion` do for lists."""

import taichi as ti

from sim.cloth.air import slowed
from sim.cloth.bundles import NodeMotion, Nodes, Rectangle, Wind
from sim.cloth.loop_costs import NODE_IN_ROWS_NS
from sim.cloth.parameters import ClothParameters
from sim.cloth.row_blocks import LANES, Block, rectangle_of, row_blocks, two_blocks
from sim.cloth.sheet import Grid
from sim.cloth.state import ClothState
from sim.core.arrays import Floats, Vectors
from sim.core.bundles import func
from sim.core.launch import kernel
from sim.core.parameters import Vector3
from sim.core.scheduling import is_short

LEAST_SQUARE = 1.0e-30
"""Smaller squares, of twice the area of a triangle [m^4] or a speed [m²/s²], have no direction."""


class RectangleAir:
    """The air at one rectangle, where it is the wind of the parameters and nothing slows it.

    Args:
        state: what it moves.
        grid: how the rectangle is divided.
        first_node: number of its first node.
        share: of each node of `state` in the force on any of its triangles, see `ClothAir`.
    """

    def __init__(self, state: ClothState, grid: Grid, first_node: int, share: ti.Ndarray) -> None:
        self._state, self._grid, self._share = state, grid, share
        self._blocks = row_blocks(grid.columns, grid.rows)
        self._rectangle = rectangle_of(grid, first_node)
        self._wind = Wind(ti.math.vec3(0.0), 0.0, 0.0, 0.0)
        self._is_short = is_short(grid.columns * grid.rows, NODE_IN_ROWS_NS)

    def take_parameters(self, cloth: ClothParameters) -> None:
        """Drag and wind as they are now."""
        self._wind = Wind(
            velocity=ti.math.vec3(*cloth.wind),
            drag=0.5 * cloth.air_density * cloth.drag,
            skin_drag=0.5 * cloth.air_density * cloth.skin_drag,
            mass=cloth.mass_per_area * 0.5 * self._grid.step_x * self._grid.step_y,
        )

    def predict(self, gravity: Vector3, dt: float) -> None:
        """Accelerate the nodes by gravity [m/s²] and air for dt [s]; displacements become where that leads."""
        state = self._state
        predict_in_wind(
            self._blocks,
            state.nodes,
            state.motion,
            state.position,
            self._share,
            self._rectangle,
            self._wind,
            gravity,
            dt,
            self._is_short,
        )


@func
def force_on_triangle(x_a, x_b, x_c, mean, free, wind: Wind, gravity, dt: ti.f32) -> ti.math.vec3:
    """`predict_in_air` without branches, for air that is given; `mean` is the velocity of the nodes."""
    cross = (x_b - x_a).cross(x_c - x_a)
    squared = cross.dot(cross)
    inverse = 1.0 / ti.sqrt(ti.max(squared, LEAST_SQUARE))
    area = 0.5 * squared * inverse
    normal = inverse * cross
    past = wind.velocity - mean - dt * free * gravity
    s_n = past.dot(normal)
    along = past - s_n * normal
    s_t = ti.sqrt(ti.max(along.dot(along), LEAST_SQUARE))
    mobility = free * area / wind.mass
    end_n = slowed(ti.abs(s_n), wind.drag * mobility, dt)
    end_t = slowed(s_t, wind.skin_drag * mobility, dt)
    push = ti.select(s_n < 0.0, -wind.drag, wind.drag) * end_n * end_n
    return area * (push * normal + (wind.skin_drag * end_t * end_t / s_t) * along)


@kernel
def predict_in_wind(
    blocks: ti.template(),
    nodes: Nodes,
    motion: NodeMotion,
    position: Vectors,
    share: Floats,
    grid: Rectangle,
    wind: Wind,
    gravity: ti.math.vec3,
    dt: ti.f32,
    is_short: ti.template(),
):
    """Forces on both triangles of every cell, then what the nodes around them make of these.

    Cells whose two numbers add up to something even have the diagonal from their first node a to c, the others that
    from b to d: triangles (a, b, c) and (a, c, d), or (a, b, d) and (b, c, d).
    """
    if ti.static(is_short):
        ti.loop_config(serialize=True)
    for j in range(grid.rows):
        for k in range(grid.strips):
            q = j * grid.strips + k
            x, y, z = Block(0.0), Block(0.0), Block(0.0)
            v_x, v_y, v_z = Block(0.0), Block(0.0), Block(0.0)
            shares, free = Block(0.0), Block(0.0)
            for at in range(ti.min(LANES, grid.columns - k * LANES)):
                i = grid.first + j * grid.columns + k * LANES + at
                x[at], y[at], z[at] = position[i].x, position[i].y, position[i].z
                v_x[at], v_y[at], v_z[at] = motion.velocity[i].x, motion.velocity[i].y, motion.velocity[i].z
                shares[at] = share[i]
                free[at] = ti.select(nodes.inverse_mass[i] > 0.0, share[i], 0.0)
            blocks.u_x[q], blocks.u_y[q], blocks.u_z[q] = x, y, z
            blocks.v_x[q], blocks.v_y[q], blocks.v_z[q] = v_x, v_y, v_z
            blocks.share[q], blocks.free_share[q] = shares, free
    if ti.static(is_short):
        ti.loop_config(serialize=True)
    for j in range(grid.rows - 1):
        for k in range(grid.strips):
            q = j * grid.strips + k
            p = q + grid.strips
            x_0, y_0, z_0 = (
                two_blocks(blocks.u_x, q, q + 1),
                two_blocks(blocks.u_y, q, q + 1),
                two_blocks(blocks.u_z, q, q + 1),
            )
            x_1, y_1, z_1 = (
                two_blocks(blocks.u_x, p, p + 1),
                two_blocks(blocks.u_y, p, p + 1),
                two_blocks(blocks.u_z, p, p + 1),
            )
            v_x0, v_y0, v_z0 = (
                two_blocks(blocks.v_x, q, q + 1),
                two_blocks(blocks.v_y, q, q + 1),
                two_blocks(blocks.v_z, q, q + 1),
            )
            v_x1, v_y1, v_z1 = (
                two_blocks(blocks.v_x, p, p + 1),
                two_blocks(blocks.v_y, p, p + 1),
                two_blocks(blocks.v_z, p, p + 1),
            )
            s_0, s_1 = two_blocks(blocks.share, q, q + 1), two_blocks(blocks.share, p, p + 1)
            f_0, f_1 = two_blocks(blocks.free_share, q, q + 1), two_blocks(blocks.free_share, p, p + 1)
            lower_x, lower_y, lower_z = Block(0.0), Block(0.0), Block(0.0)
            upper_x, upper_y, upper_z = Block(0.0), Block(0.0), Block(0.0)
            cells = grid.columns - 1 - k * LANES
            for at in range(LANES):
                rises = (at + j) % 2 == 0
                x_a, x_b = ti.math.vec3(x_0[at], y_0[at], z_0[at]), ti.math.vec3(x_0[at + 1], y_0[at + 1], z_0[at + 1])
                x_d, x_c = ti.math.vec3(x_1[at], y_1[at], z_1[at]), ti.math.vec3(x_1[at + 1], y_1[at + 1], z_1[at + 1])
                v_a = s_0[at] * ti.math.vec3(v_x0[at], v_y0[at], v_z0[at])
                v_b = s_0[at + 1] * ti.math.vec3(v_x0[at + 1], v_y0[at + 1], v_z0[at + 1])
                v_d = s_1[at] * ti.math.vec3(v_x1[at], v_y1[at], v_z1[at])
                v_c = s_1[at + 1] * ti.math.vec3(v_x1[at + 1], v_y1[at + 1], v_z1[at + 1])
                lower_free = f_0[at] + f_0[at + 1] + ti.select(rises, f_1[at + 1], f_1[at])
                upper_free = ti.select(rises, f_0[at], f_0[at + 1]) + f_1[at + 1] + f_1[at]
                lower = force_on_triangle(
                    x_a,
                    x_b,
                    ti.select(rises, x_c, x_d),
                    v_a + v_b + ti.select(rises, v_c, v_d),
                    lower_free,
                    wind,
                    gravity,
                    dt,
                )
                upper = force_on_triangle(
                    ti.select(rises, x_a, x_b),
                    x_c,
                    x_d,
                    ti.select(rises, v_a, v_b) + v_c + v_d,
                    upper_free,
                    wind,
                    gravity,
                    dt,
                )
                is_cell = at < cells
                lower_x[at] = ti.select(is_cell, lower.x, 0.0)
                lower_y[at] = ti.select(is_cell, lower.y, 0.0)
                lower_z[at] = ti.select(is_cell, lower.z, 0.0)
                upper_x[at] = ti.select(is_cell, upper.x, 0.0)
                upper_y[at] = ti.select(is_cell, upper.y, 0.0)
                upper_z[at] = ti.select(is_cell, upper.z, 0.0)
            blocks.lower_x[q], blocks.lower_y[q], blocks.lower_z[q] = lower_x, lower_y, lower_z
            blocks.upper_x[q], blocks.upper_y[q], blocks.upper_z[q] = upper_x, upper_y, upper_z
    if ti.static(is_short):
        ti.loop_config(serialize=True)
    for j in range(grid.rows):
        for k in range(grid.strips):
            q = j * grid.strips + k
            force_x = force_around(blocks.lower_x, blocks.upper_x, j, k, grid.rows, grid.strips)
            force_y = force_around(blocks.lower_y, blocks.upper_y, j, k, grid.rows, grid.strips)
            force_z = force_around(blocks.lower_z, blocks.upper_z, j, k, grid.rows, grid.strips)
            for at in range(ti.min(LANES, grid.columns - k * LANES)):
                i = grid.first + j * grid.columns + k * LANES + at
                w_i = nodes.inverse_mass[i]
                if w_i > 0.0:
                    force = ti.math.vec3(force_x[at], force_y[at], force_z[at])
                    v_i = motion.velocity[i] + dt * gravity + dt * w_i * share[i] * force
                    motion.velocity[i] = v_i
                    nodes.displacement[i] = motion.carry[i] + dt * v_i
                else:
                    nodes.displacement[i] = motion.carry[i]


@ti.func
def force_around(lower: ti.template(), upper: ti.template(), j, k, rows, strips):
    """Sum over the triangles of LANES nodes; places of a row that are no cells have no force.

    A node whose two numbers add up to something even has all eight triangles around it, another one four of them.
    """
    force = Block(0.0)
    q = j * strips + k
    here = ti.min(j, rows - 2) * strips + k
    below = ti.max(q - strips, 0)
    before_here, before_below = ti.max(here - 1, 0), ti.max(below - 1, 0)
    lower_here, upper_here = two_blocks(lower, before_here, here), two_blocks(upper, before_here, here)
    lower_below, upper_below = two_blocks(lower, before_below, below), two_blocks(upper, before_below, below)
    for at in range(LANES):
        own, before = at + LANES, at + LANES - 1
        all_of_them = ti.select((at + j) % 2 == 0, 1.0, 0.0)
        has_before = k * LANES + at > 0
        above = lower_here[own] + all_of_them * upper_here[own]
        above += ti.select(has_before, lower_here[before] + all_of_them * upper_here[before], 0.0)
        under = upper_below[own] + all_of_them * lower_below[own]
        under += ti.select(has_before, upper_below[before] + all_of_them * lower_below[before], 0.0)
        force[at] = ti.select(j < rows - 1, above, 0.0) + ti.select(j > 0, under, 0.0)
    return force
