"""Nodes of the grid against walls and bodies: no node moves into them, and friction slows what slides along.

Of a body that is free to move, nodes inside and it collide without bounce, all at once. With P = n n' + t (1 - n n'), t
the share of the sliding that friction ends, and the body's motion at a node J u = u_v + u_w x r,

    (M + sum m J'P J) u = sum m J'P (v - v_body)

over the nodes that come nearer gives the change u of the body's motion that all of them together make. Nodes then meet
the body as it moves afterwards: however light it is, it is not thrown back and forth. What they lose the body gets.

Bodies that it sticks to have t = 1 and hold nodes that lead away as well: then P is the identity.

Pieces of a body that breaks are felt where they are and answer as all that they are glued to: its motion is what is
solved for, and its surface is where nodes are led. Of pieces whose surface is nearest to a point y inside of them,

    depth(y) = min(depth in the whole, distances to those pieces of it that have broken off)

as the outside of what holds together is that of the whole, and they.

Sums over nodes are of integers, so that they are the same in any order.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.arrays import Floats, Integers, LongIntegers, Vectors, on_device
from sim.core.box import Box
from sim.core.bundles import bundle, func
from sim.core.host_access import copied, put, take
from sim.core.launch import kernel
from sim.shapes.body_geometry import BodyGeometry
from sim.shapes.device_shapes import distance_to
from sim.shapes.moving_shapes import Bodies, MovingShapes, direction_out, distance_of, in_frame, velocity_at
from sim.soft.blocks import NODES, Blocks, place_of_node
from sim.soft.packing import REACH, room_left, share_before
from sim.soft.transfers import Nodes

Float64Array = NDArray[np.float64]

PARTS = 64  # of each sum, so that few threads meet at a number
QUANTA = 2.0**56  # of a sum, whose terms are over what they are at most together
TERMS = 27  # of a body's sums: 6 of J'P (v - v_body), 21 of J'P J, its upper triangle
UPPER = np.triu_indices(6)
UPPER_PLACE = {(int(row), int(column)): place for place, (row, column) in enumerate(zip(*UPPER, strict=True))}
STICKS = 1.0e30  # friction against a body that soft matter never leaves, nor slides on [-]
SLOW = 1.0e-12  # speed along a surface at which there is no direction of it [m/s]
SEAM = 2.0  # how much larger pieces are inside of their whole, in half widths of central differences


@bundle
class Touching(NamedTuple):
    """Bodies as nodes meet them, and the sums of what they do to each, (bodies,) but for sums."""

    bodies: Bodies
    count: ti.i32
    radius: Floats  # of a sphere around the centre of mass that holds the body [m]
    step: Floats  # half width of differences for normals [m]
    friction: Floats  # of soft matter against each [-]
    breaks: ti.template()  # whether some are pieces
    leader: Integers  # the first of those that move as one with it, of which the following is; its own if alone
    middle: Vectors  # centre of mass of what moves as one with it [m]
    size: Floats  # of a sphere around that which holds all of it [m]
    whole: Integers  # number of the shape that it is a piece of, behind those of the bodies; -1 of others
    holds: Integers  # whether it is glued to other pieces
    is_free: Integers
    gain: Vectors  # change of velocity in the collision [m/s]
    turn: Vectors  # of spin [1/s]
    sums: LongIntegers  # of the collision, (bodies * TERMS * PARTS,)
    impulse: LongIntegers  # linear and angular, (bodies * 6 * PARTS,)
    mass_unit: ti.f32  # [kg]
    speed_unit: ti.f32  # [m/s]


class BodyContacts:
    """The bodies of a scene as soft matter meets them: those that move, then those that stand.

    Args:
        geometries: of all bodies, one at least.
        moving: how many of them, the first ones, may move.
        friction: of soft matter against each body [-]; `STICKS` of those that it is glued to.
        mass: of all soft matter, and of what may move along with it [kg].
        wholes: what some bodies are pieces of, in their frame.
        whole_of: number of that, -1 of other bodies, (bodies,).
    """

    def __init__(
        self,
        geometries: Sequence[BodyGeometry],
        moving: int,
        friction: Sequence[float],
        mass: float,
        *,
        wholes: Sequence[BodyGeometry] = (),
        whole_of: NDArray[np.int64] | None = None,
    ) -> None:
        self._moving, self._mass, self._friction = moving, mass, np.array(friction, np.float32)
        self._shapes = MovingShapes([*geometries, *wholes])
        count, shown = len(geometries), len(geometries) + len(wholes)
        self._radius = copied(self._shapes.shapes.radius).astype(np.float64)[:count]
        self._size = self._radius
        self._position, self._velocity, self._spin = (np.zeros((shown, 3)) for _ in range(3))
        self._rotation = np.tile(np.eye(3), (shown, 1, 1))
        self._inverse_mass, self._inverse_inertia = np.zeros(count), np.zeros((count, 3, 3))
        arrays = [ti.Vector.ndarray(3, ti.f32, count) for _ in range(2)]
        sums = [ti.ndarray(ti.i64, count * terms * PARTS) for terms in (TERMS, 6)]
        shapes, none = self._shapes.shapes, np.full(count, -1)
        places = none if whole_of is None else np.where(whole_of >= 0, count + whole_of, -1)
        self._touching = Touching(
            self._shapes.bodies,
            count,
            shapes.radius,
            shapes.step,
            on_device(self._friction),
            bool(wholes),
            on_device(np.arange(count, dtype=np.int32)),
            ti.Vector.ndarray(3, ti.f32, count),
            on_device(self._size.astype(np.float32)),
            on_device(places.astype(np.int32)),
            on_device(np.zeros(count, np.int32)),
            on_device(np.zeros(count, np.int32)),
            *arrays,
            *sums,
            mass,
            1.0,
        )

    def rub(self, friction: Float64Array) -> None:
        """Take another friction against bodies [-], (bodies,); against those that soft matter sticks to it stays."""
        rubs = np.where(self._friction < STICKS, friction, STICKS).astype(np.float32)
        if not np.array_equal(rubs, self._friction):
            self._friction = rubs
            put(self._touching.friction, rubs)

    def stand(self, position: Float64Array, rotation: Float64Array) -> None:
        """Place the last bodies, which never move, (k, 3) and (k, 3, 3)."""
        last = slice(self._moving, self._moving + len(position))
        self._position[last], self._rotation[last] = position, rotation
        self._shapes.put(self._position, self._rotation, self._velocity, self._spin, 0.0)

    def move(
        self,
        position: Float64Array,
        rotation: Float64Array,
        velocity: Float64Array,
        spin: Float64Array,
        time_s: float,
        mobility: tuple[Float64Array, Float64Array],
        together: tuple[NDArray[np.int64], Float64Array] | None = None,
    ) -> None:
        """Place the bodies that move, as `MovingShapes.put`, with their inverse masses and inertias.

        Where some move as one, `together` has of each the first of those, and their centre of mass [m], (moving,) and
        (moving, 3); the first one has the mass of all then, about that, and the others none.
        """
        for all_of, own in (
            (self._position, position),
            (self._rotation, rotation),
            (self._velocity, velocity),
            (self._spin, spin),
            (self._inverse_mass, mobility[0]),
            (self._inverse_inertia, mobility[1]),
        ):
            all_of[: self._moving] = own
        self._shapes.put(self._position, self._rotation, self._velocity, self._spin, time_s)
        put(self._touching.is_free, (self._inverse_mass > 0.0).astype(np.int32))
        touching, count = self._touching, len(self._radius)
        middle = self._position[:count].copy()
        if together is not None:
            leader = np.arange(count)
            leader[: self._moving], middle[: self._moving] = together
            reach = np.linalg.norm(self._position[:count] - middle, axis=1) + self._radius
            self._size = np.zeros(count)
            np.maximum.at(self._size, leader, reach)
            put(touching.leader, leader)
            put(touching.size, self._size[leader])
            put(touching.holds, np.bincount(leader, minlength=count)[leader] > 1)
        put(touching.middle, middle)

    def resolve(self, blocks: Blocks, stored: int, nodes: Nodes, dt: float) -> None:
        """Let the nodes of stored blocks and the bodies collide in a step of dt [s]."""
        touching = self._touching = self._touching._replace(speed_unit=blocks.edge / dt)
        if (self._inverse_mass > 0.0).any():
            sum_collisions(blocks, stored, nodes, touching)
            self._find_gains()
        collide(blocks, stored, nodes, touching)

    def take_room(self, blocks: Blocks, stored: int, nodes: Nodes) -> None:
        """Take from the room of nodes what bodies fill."""
        take_room(blocks, stored, nodes, self._touching)

    def _find_gains(self) -> None:
        """Solve for what each body's motion gains."""
        touching, unit = self._touching, self._mass / QUANTA
        sums = take(touching.sums).astype(np.float64).reshape(-1, TERMS, PARTS).sum(axis=2) * unit
        gains = np.zeros((len(sums), 6))
        for number in np.flatnonzero(sums[:, :6].any(axis=1)):
            matrix, inverse = np.zeros((6, 6)), np.zeros((6, 6))
            matrix[UPPER] = sums[number, 6:]
            matrix += np.triu(matrix, 1).T
            inverse[:3, :3] = self._inverse_mass[number] * np.eye(3)
            inverse[3:, 3:] = self._inverse_inertia[number]
            # Angular parts are summed over a size, as the device has them.
            scale = np.repeat([1.0, self._size[number]], 3)
            matrix *= scale[:, None] * scale
            momentum = touching.speed_unit * scale * sums[number, :6]
            gains[number] = np.linalg.solve(np.eye(6) + inverse @ matrix, inverse @ momentum)
        put(touching.gain, gains[:, :3])
        put(touching.turn, gains[:, 3:])

    def take_impulses(self) -> tuple[Float64Array, Float64Array]:
        """Linear [N s] and angular impulse [N m s] on each body since the last call, (b, 3) each."""
        touching = self._touching
        sums = take(touching.impulse).astype(np.float64).reshape(-1, 6, PARTS).sum(axis=2)
        sums *= self._mass * touching.speed_unit / QUANTA
        return sums[:, :3], self._radius[:, None] * sums[:, 3:]


@func
def body_at(x: ti.math.vec3, touching: Touching, cell_size: ti.f32) -> ti.i32:
    """The body that a point is deepest in, or -1; those that matter sticks to reach out by half a cell.

    Pieces that hold together leave nothing between them, where their grids may not meet.
    """
    body, least = -1, 0.0
    for b in range(touching.count):
        glue = ti.select(touching.friction[b] >= STICKS, 0.5 * cell_size, 0.0)
        if (x - touching.bodies.position[b]).norm() < touching.radius[b] + glue:
            y = in_frame(x, b, touching.bodies)
            distance = distance_to(y, b, touching.bodies.shapes)
            if ti.static(touching.breaks):
                distance = within_whole(y, b, distance, touching)
            distance -= glue
            if distance < least:
                body, least = b, distance
    return body


@func
def distance_together(x: ti.math.vec3, body: ti.i32, touching: Touching) -> ti.f32:
    """Distance of a point from all that a body leads, negative inside: that from the whole while nothing broke off.

    Then it is the depth in the whole or the distance from what broke off inside, and that from the pieces outside.
    """
    (shapes,) = ti.static((touching.bodies.shapes,))
    y, holds = in_frame(x, body, touching.bodies), touching.holds[body] == 1
    distance = distance_to(y, ti.select(holds, touching.whole[body], body), shapes)
    if holds:
        is_whole, to_pieces = True, 1.0e30
        for other in range(touching.count):
            if touching.whole[other] == touching.whole[body]:
                there = distance_to(y, other, shapes)
                if touching.leader[other] == body:
                    to_pieces = ti.min(to_pieces, there)
                else:
                    is_whole, distance = False, ti.max(distance, -there)
        if distance > 0.0 and not is_whole:
            distance = to_pieces
    return distance


@kernel
def take_room(blocks: Blocks, stored: ti.i32, nodes: Nodes, touching: Touching):
    """Take from the room of nodes what bodies fill; those that hold together as one."""
    for n in range(stored * NODES):
        if nodes.mass[n] > 0.0:
            x = place_of_node(n, blocks)
            for b in range(touching.count):
                middle, size = touching.bodies.position[b], touching.radius[b]
                if ti.static(touching.breaks):
                    middle = touching.middle[b]
                    size = ti.select(touching.leader[b] == b, touching.size[b], -REACH * blocks.edge)
                if (x - middle).norm() < size + REACH * blocks.edge:
                    distance = 0.0
                    if ti.static(touching.breaks):
                        distance = distance_together(x, b, touching) / blocks.edge
                    else:
                        distance = distance_of(x, b, touching.bodies) / blocks.edge
                    if distance < REACH:
                        nodes.room[n] = room_left(nodes.room[n], share_before(distance), blocks)


@func
def within_whole(y: ti.math.vec3, body: ti.i32, distance: ti.f32, touching: Touching) -> ti.f32:
    """Distance of a point from a piece, to which it has a distance [m], that leaves nothing between those that hold."""
    result = distance
    if touching.holds[body] == 1:
        of_whole = distance_to(y, touching.whole[body], touching.bodies.shapes)
        result = ti.max(distance - ti.static(SEAM) * touching.step[body], of_whole)
    return result


@func
def nearest_outside(y: ti.math.vec3, body: ti.i32, touching: Touching) -> ti.i32:
    """The shape whose surface is where a point of a piece, and of those that it holds to, is nearest to their outside:
    their whole, or what has broken off it; a body that holds to nothing itself.
    """
    (shapes,) = ti.static((touching.bodies.shapes,))
    shape = body
    if touching.holds[body] == 1:
        shape = touching.whole[body]
        depth = -distance_to(y, shape, shapes)
        for other in range(touching.count):
            if touching.whole[other] == touching.whole[body] and touching.leader[other] != touching.leader[body]:
                distance = distance_to(y, other, shapes)
                if distance < depth:
                    shape, depth = other, distance
    return shape


@func
def outward(x: ti.math.vec3, body: ti.i32, touching: Touching) -> ti.math.vec3:
    """Normal of the surface that is nearest to a point in a body, or in pieces that hold together."""
    (shapes,) = ti.static((touching.bodies.shapes,))
    y, shape, sign = in_frame(x, body, touching.bodies), body, 1.0
    if ti.static(touching.breaks):
        shape = nearest_outside(y, body, touching)
        sign = ti.select(shape == body or shape == touching.whole[body], 1.0, -1.0)
    return sign * (touching.bodies.rotation[body] @ direction_out(y, shape, touching.step[shape], shapes))


@ti.func
def slid(velocity: ti.math.vec3, normal: ti.math.vec3, friction: ti.f32) -> ti.math.vec3:
    """A velocity relative to a surface after friction and without what leads into it; none where it sticks."""
    into = velocity.dot(normal)
    result = velocity
    if friction >= STICKS:
        result = ti.math.vec3(0.0)
    elif into < 0.0:
        along = velocity - into * normal
        result = along * ti.max(0.0, 1.0 + friction * into / ti.max(along.norm(), SLOW))
    return result


@func
def add_parts(sums: LongIntegers, at: ti.i32, n: ti.i32, value: ti.f32):
    """Add to a sum, in one of its parts."""
    ti.atomic_add(sums[at * PARTS + n % PARTS], ti.cast(value * ti.static(QUANTA), ti.i64))


@kernel
def sum_collisions(blocks: Blocks, stored: ti.i32, nodes: Nodes, touching: Touching):
    """J'P (v - v_body) and J'P J of the nodes that come nearer to bodies that are free to move.

    Lengths over the size of what moves as one, masses over the unit, speeds over theirs.
    """
    for n in range(stored * NODES):
        if nodes.mass[n] > 0.0:
            x = place_of_node(n, blocks)
            body = body_at(x, touching, blocks.edge)
            leader = touching.leader[ti.max(body, 0)]
            if body >= 0 and touching.is_free[leader] == 1:
                normal = outward(x, body, touching)
                velocity = nodes.velocity[n] - velocity_at(x, body, touching.bodies)
                into = velocity.dot(normal)
                friction = touching.friction[body]
                if into < 0.0 or friction >= STICKS:
                    along = velocity - into * normal
                    kept = ti.min(1.0, friction * ti.abs(into) / ti.max(along.norm(), SLOW))
                    if friction >= STICKS:
                        kept = 1.0
                    mass = nodes.mass[n] / touching.mass_unit
                    arm = (x - touching.middle[body]) / touching.size[body]
                    stops = mass * (into * normal + kept * along) / touching.speed_unit
                    turns = arm.cross(stops)
                    for k in ti.static(range(3)):
                        add_parts(touching.sums, leader * TERMS + k, n, stops[k])
                        add_parts(touching.sums, leader * TERMS + 3 + k, n, turns[k])
                    # Columns of P J, and J' of each.
                    for row in ti.static(range(6)):
                        unit = ti.math.vec3(0.0)
                        unit[ti.static(row % 3)] = 1.0
                        motion = unit
                        if ti.static(row >= 3):
                            motion = unit.cross(arm)
                        through = motion.dot(normal)
                        held = mass * (through * normal + kept * (motion - through * normal))
                        twist = arm.cross(held)
                        for column in ti.static(range(row, 6)):
                            place = ti.static(6 + UPPER_PLACE[row, column])
                            value = held[ti.static(column % 3)]
                            if ti.static(column >= 3):
                                value = twist[ti.static(column % 3)]
                            add_parts(touching.sums, leader * TERMS + place, n, value)


@kernel
def collide(blocks: Blocks, stored: ti.i32, nodes: Nodes, touching: Touching):
    """Let nodes in bodies move along with them or away; bodies that are free get what nodes lose."""
    for n in range(stored * NODES):
        if nodes.mass[n] > 0.0:
            x = place_of_node(n, blocks)
            body = body_at(x, touching, blocks.edge)
            if body >= 0:
                leader, arm = touching.leader[body], x - touching.middle[body]
                frame = velocity_at(x, body, touching.bodies) + touching.gain[leader] + touching.turn[leader].cross(arm)
                normal = outward(x, body, touching)
                before = nodes.velocity[n]
                after = frame + slid(before - frame, normal, touching.friction[body])
                nodes.velocity[n] = after
                if touching.is_free[leader] == 1:
                    share = nodes.mass[n] / touching.mass_unit
                    lost = share * (before - after) / touching.speed_unit
                    turned = ((x - touching.bodies.position[body]) / touching.radius[body]).cross(lost)
                    for k in ti.static(range(3)):
                        add_parts(touching.impulse, body * 6 + k, n, lost[k])
                        add_parts(touching.impulse, body * 6 + 3 + k, n, turned[k])


@kernel
def stop_at_walls(blocks: Blocks, stored: ti.i32, nodes: Nodes, box: Box, friction: ti.f32):
    """Let nodes on and behind the closed faces of the domain move along them or away."""
    slack = 1.0e-3 * blocks.edge
    for n in range(stored * NODES):
        if nodes.mass[n] > 0.0:
            x = place_of_node(n, blocks)
            velocity = nodes.velocity[n]
            for axis in ti.static(range(3)):
                normal = ti.math.vec3(0.0)
                if x[axis] < box.wall_low[axis] + slack:
                    normal[axis] = 1.0
                elif x[axis] > box.wall_high[axis] - slack:
                    normal[axis] = -1.0
                if normal[axis] != 0.0:
                    velocity = slid(velocity, normal, friction)
            nodes.velocity[n] = velocity
