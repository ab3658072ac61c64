"""Room of nodes: the part of their splines' volume that walls and bodies leave, over which their mass is a density.

Sand that is a cell apart shares nodes, and comes together for the grid from there on; their density tells whether it
touches. Before a plane is the integral of the spline up to there; planes multiply. Deep in solids as much counts as in
a corner of three walls, so that nothing is divided by next to nothing.
"""

import taichi as ti

from sim.core.arrays import Floats
from sim.core.box import Box
from sim.core.bundles import func
from sim.core.launch import kernel
from sim.soft.blocks import NODES, Blocks, place_of_node

LEAST_ROOM = 0.125  # of a node's volume, in a corner of three walls
REACH = 1.5  # of a spline [edges]


@ti.func
def share_before(distance: ti.f32) -> ti.f32:
    """Part of a node's volume before a plane that it is a distance before [edges]; 0 or 1 beyond its reach."""
    d = ti.math.clamp(distance, -1.5, 1.5)
    near = 0.5 + 0.75 * d - d**3 / 3.0
    far = (1.5 - ti.abs(d)) ** 3 / 6.0
    return ti.select(ti.abs(d) < 0.5, near, ti.select(d < 0.0, far, 1.0 - far))


@func
def room_left(room: ti.f32, share: ti.f32, blocks: Blocks) -> ti.f32:
    """What a solid leaves of the room of a node [m³]."""
    return ti.max(room * share, LEAST_ROOM * blocks.edge**3)


@kernel
def find_room(blocks: Blocks, stored: ti.i32, mass: Floats, room: Floats, box: Box):
    """The volume of nodes within the closed faces of the domain [m³]; that of all space where they have no mass."""
    for n in range(stored * NODES):
        share = 1.0
        if mass[n] > 0.0:
            x = place_of_node(n, blocks)
            for axis in ti.static(range(3)):
                share *= share_before((x[axis] - box.wall_low[axis]) / blocks.edge)
                share *= share_before((box.wall_high[axis] - x[axis]) / blocks.edge)
        room[n] = room_left(blocks.edge**3, share, blocks)
