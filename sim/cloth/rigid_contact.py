"""Cloth against rigid bodies and walls: what touches in a substep."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.arrays import Floats, Integers, Matrices, Vectors
from sim.cloth.loop_costs import NODE_AT_BODIES_NS, PATCH_AT_BODY_NS, PATCH_AT_WALLS_NS
from sim.cloth.patches import Patches
from sim.cloth.proximity import unit_or
from sim.cloth.proximity_contacts import WALL, ContactList, Quadruples, Weights, least_displacement
from sim.cloth.rigid_contact_bodies import CollisionBodies
from sim.cloth.self_collision_kernels import LANES, Four, Pairs, Triples
from sim.cloth.state import ClothState
from sim.launch import fast_launch
from sim.reductions import runs_on_gpu
from sim.rigid.contacts import Poses
from sim.rigid.geometry import BodyGeometry
from sim.rigid.shape_distances import CountTriples, distance_at
from sim.rigid.walls import Wall
from sim.short_loops import is_short
from sim.work_sharing import begin_sharing, next_item, workers_for

Array = NDArray[np.float64]
Planes = ti.types.ndarray(dtype=ti.math.vec4, ndim=1)

PATCHES_AT_A_TIME = 4
"""Patches that a thread takes at a time: those that touch a body take some microseconds each."""

LARGEST_ADVANCE = 0.25
"""How far cloth and bodies may move against each other in a step, in half shortest edges of the smallest body."""

WALL_DEPTH = 4.0
"""Walls hold what is at most so far behind them, in thicknesses, or as far as a mean edge or the node's motion in the
step, if that is more: what left through an open face falls on outside."""

SMALL_BODY = 4.0
"""Round bodies with a shorter edge, in mean edges of the cloth, are looked at between its vertices, too: larger ones
show by an eighth of an edge at most where vertices alone meet them."""


WITH_ROUNDING = 1.00001
"""Bounds of how far patches reach and move are so much larger than computed: float32 loses some 1e-7 of them."""


@dataclass(frozen=True, eq=False)
class BodyMotion:
    """How the m bodies that move do; all others stand still.

    Attributes:
        velocity: of the centres of mass [m/s], (m, 3).
        angular_velocity: about world axes [rad/s], (m, 3).
        acceleration: that the coming substep will add, but for cloth [m/s²], (m, 3).
        inverse_mass: [1/kg], (m,); 0 for what no force moves.
        inverse_inertia: in world axes [1/(kg m²)], (m, 3, 3).
    """

    velocity: Array
    angular_velocity: Array
    acceleration: Array
    inverse_mass: Array
    inverse_inertia: Array


class RigidContact:
    """Finds where cloth touches bodies and walls.

    Cloth stays half its thickness away from both. Its vertices are looked at, and where a body has sharp edges or is
    small (`set_spacing`) also the midpoints of its edges and triangles: so much of a corner may show through cloth as
    fits between them, and a body that fits between them, thinner than 0.7 edges or so, passes.
    The side that cloth is on is the one where the substep starts, so that nothing tunnels while bodies and cloth move
    by less than `LARGEST_ADVANCE` (`stable_dt`).

    Args:
        geometries: of the bodies; those that move first.
        friction: of the bodies [-]; cloth and body have the geometric mean.
        walls: closed faces of the domain, which have the friction of the cloth.
    """

    def __init__(self, geometries: Sequence[BodyGeometry], friction: Sequence[float], walls: Sequence[Wall]) -> None:
        self.bodies = CollisionBodies(geometries, friction)
        self._motion: BodyMotion | None = None
        self._surface_speed = 0.0
        self._has_edges = bool(self.bodies.has_edges.to_numpy()[: self.bodies.count].any())
        self._spacing, self._largest_half = 0.0, 0.0
        self._taken = ti.ndarray(ti.i32, 1)
        self._wall_count = len(walls)
        room = max(len(walls), 1)
        self._wall_plane = ti.Vector.ndarray(4, ti.f32, room)
        self._wall_low, self._wall_high, self._joined_low, self._joined_high = (
            ti.Vector.ndarray(3, ti.f32, room) for _ in range(4)
        )
        if walls:
            low, high = np.full((room, 3), -np.inf), np.full((room, 3), np.inf)
            joined = {side: np.zeros((room, 3)) for side in (1.0, -1.0)}
            for number, wall in enumerate(walls):
                others = [axis for axis in range(3) if axis != wall.axis]
                low[number, others], high[number, others] = wall.lower, wall.upper
                for other in walls:
                    if other.axis != wall.axis:
                        joined[other.side][number, other.axis] = 1.0
            planes = np.array([[*wall.normal, wall.side * wall.offset] for wall in walls])
            self._wall_plane.from_numpy(planes.astype(np.float32))
            self._wall_low.from_numpy(low.astype(np.float32))
            self._wall_high.from_numpy(high.astype(np.float32))
            self._joined_low.from_numpy(joined[1.0].astype(np.float32))
            self._joined_high.from_numpy(joined[-1.0].astype(np.float32))

    def set_spacing(self, mean_edge: float) -> None:
        """Say how far vertices of the coarsest cloth are apart [m]: what is small, and how deep walls hold."""
        self._spacing = mean_edge
        self.bodies.look_between_vertices(SMALL_BODY * mean_edge)
        self._has_edges = bool(self.bodies.has_edges.to_numpy()[: self.bodies.count].any())

    def set_thickness(self, largest: float) -> None:
        """Say how thick the cloth is at most [m]."""
        self._largest_half = 0.5 * largest

    def place(self, poses: Poses, motion: BodyMotion | None = None) -> None:
        """Say where the bodies are at the start of a substep, and how they move; without motion they stand still."""
        b = self.bodies.count
        inverse_mass, inverse_inertia = np.zeros(b), np.zeros((b, 3, 3))
        self._surface_speed, self._motion = 0.0, motion
        if motion is not None:
            m = len(motion.velocity)
            inverse_mass[:m], inverse_inertia[:m] = motion.inverse_mass, motion.inverse_inertia
            radius = np.array([geometry.radius for geometry in self.bodies.geometries[:m]])
            spin = np.linalg.norm(motion.angular_velocity, axis=1)
            speeds = np.linalg.norm(motion.velocity, axis=1) + radius * spin
            self._surface_speed = float(speeds.max(initial=0.0))
        self.bodies.place(poses, inverse_mass, inverse_inertia)

    def begin_substep(self, dt: float) -> None:
        """Foresee how the bodies move in a substep of dt [s] that cloth does not push."""
        if self._motion is not None:
            b, motion = self.bodies.count, self._motion
            m = len(motion.velocity)
            shift, turn = np.zeros((b, 3)), np.zeros((b, 3))
            shift[:m] = dt * (motion.velocity + dt * motion.acceleration)
            turn[:m] = dt * motion.angular_velocity
            self.bodies.set_motion(shift, turn)

    def stable_dt(self, speed: float) -> float:
        """Largest step [s] for cloth of this speed [m/s]."""
        relative = speed + self._surface_speed
        if relative == 0.0 or not self.bodies.count:
            return math.inf
        return LARGEST_ADVANCE * 0.5 * self.bodies.shortest_edge / relative

    def find(
        self,
        state: ClothState,
        patches: Patches,
        motion_arrays: tuple[ti.Ndarray, ...],
        contacts: ContactList,
        recovery: float,
    ) -> None:
        """Append what touches in this substep.

        Args:
            state: at the start of a substep.
            patches: of the cloths.
            motion_arrays: where they are and how they move in it, see `sim.cloth.patch_pairs.PatchPairs`.
            contacts: the list.
            recovery: share of a missing distance that the substep gives back [-].
        """
        lanes = LANES if runs_on_gpu() else 1
        own = (patches.count, lanes, patches.first_vertex, patches.vertices, *motion_arrays)
        cloth = (state.position, state.displacement, state.thickness, state.friction)
        if self._wall_count:
            find_wall_contacts(
                *own, self._largest_half, *cloth, self._wall_count, self._wall_plane, self._wall_low, self._wall_high,
                self._joined_low, self._joined_high, self._spacing, recovery, *contacts.found_arrays,
                is_short(patches.count, PATCH_AT_WALLS_NS),
            )  # fmt: skip
        if not self.bodies.count:
            return
        each = self.bodies
        bodies = (
            each.count, each.kind, each.size, each.has_edges, each.centre_of_mass, each.radius, each.step,
            each.friction, each.grid_values, each.grid_first, each.grid_origin, each.grid_spacing, each.grid_shape,
            each.position, each.rotation, each.motion,
        )  # fmt: skip
        workers = workers_for(patches.count * lanes), self._taken
        few_bodies = is_short(patches.count * each.count, PATCH_AT_BODY_NS)
        find_body_contacts_of_vertices(
            *own[:2], *workers, *own[2:], self._largest_half, *cloth, *bodies, recovery, *contacts.found_arrays,
            few_bodies and is_short(patches.vertex_count, NODE_AT_BODIES_NS),
        )  # fmt: skip
        if self._has_edges:
            find_body_contacts_between_vertices(
                patches.count, lanes, *workers, patches.first_edge, patches.edges, patches.first_triangle,
                patches.triangles, *motion_arrays, self._largest_half, *cloth, *bodies, recovery,
                *contacts.found_arrays, few_bodies and is_short(patches.between_count, NODE_AT_BODIES_NS),
            )  # fmt: skip


@fast_launch
@ti.kernel
def find_wall_contacts(
    patch_count: ti.i32, lanes: ti.i32, first_vertex: Integers, patch_vertices: Integers,
    centre: Vectors, shift: Vectors, turn: Vectors, patch_radius: Floats, rest: Floats, largest_half: ti.f32,
    position: Vectors, displacement: Vectors, thickness: Floats, vertex_friction: Floats,
    wall_count: ti.i32, plane: Planes, low: Vectors, high: Vectors, joined_low: Vectors, joined_high: Vectors,
    spacing: ti.f32, recovery: ti.f32,
    vertices: Quadruples, weights: Weights, normal: Vectors, floor: Floats, kind: Integers, arm: Vectors,
    friction: Floats, counter: Integers, capacity: ti.i32, is_short: ti.template(),
):  # fmt: skip
    """Append the vertices that reach a wall, of the patches that may; walls are flat, so that vertices are enough.

    Walls hold down to a depth, and where another wall joins them as far beyond it: what is behind two is led back by
    both.
    """
    if ti.static(is_short):
        ti.loop_config(serialize=True)
    for item in range(patch_count * lanes):
        m = item // lanes
        reach = shift[m].norm() + (1.0 + turn[m].norm()) * patch_radius[m] + rest[m] + largest_half
        for w in range(wall_count):
            is_near = plane[w].xyz.dot(centre[m]) - plane[w].w < WITH_ROUNDING * reach
            place = ti.select(is_near, first_vertex[m], first_vertex[m + 1])
            place += item % lanes
            while place < first_vertex[m + 1]:
                touch_wall(
                    patch_vertices[place], w, position, displacement, thickness, vertex_friction, plane, low, high,
                    joined_low, joined_high, spacing, recovery, vertices, weights, normal, floor, kind, arm, friction,
                    counter, capacity,
                )  # fmt: skip
                place += lanes


@ti.func
def touch_wall(
    i: ti.i32, w: ti.i32, position: Vectors, displacement: Vectors, thickness: Floats, vertex_friction: Floats,
    plane: Planes, low: Vectors, high: Vectors, joined_low: Vectors, joined_high: Vectors,
    spacing: ti.f32, recovery: ti.f32,
    vertices: Quadruples, weights: Weights, normal: Vectors, floor: Floats, kind: Integers, arm: Vectors,
    friction: Floats, counter: Integers, capacity: ti.i32,
):  # fmt: skip
    """Append a vertex if it reaches a wall."""
    x, half, n = position[i], 0.5 * thickness[i], plane[w].xyz
    distance = n.dot(x) - plane[w].w
    least = least_displacement(distance, half, recovery)
    if distance < half or n.dot(displacement[i]) < least:
        depth = ti.max(2.0 * WALL_DEPTH * half, spacing, displacement[i].norm())
        is_above = (x >= low[w] - depth * joined_low[w]).all()
        is_below = (x <= high[w] + depth * joined_high[w]).all()
        slot = capacity
        if is_above and is_below and distance > -depth:
            slot = ti.atomic_add(counter[0], 1)
        if slot < capacity:
            vertices[slot], weights[slot] = Four(i), ti.math.vec4(1.0, 0.0, 0.0, 0.0)
            normal[slot], floor[slot], kind[slot] = n, least, WALL
            arm[slot], friction[slot] = ti.math.vec3(0.0), vertex_friction[i]


@ti.func
def may_touch_bodies(
    m: ti.i32, centre: Vectors, shift: Vectors, turn: Vectors, patch_radius: Floats, rest: Floats,
    largest_half: ti.f32, body_count: ti.i32, radius: Floats, body_position: Vectors, motion: Vectors,
) -> ti.i32:  # fmt: skip
    """Whether points of a patch may come as near to a body's sphere as `touch_bodies` asks for."""
    may = 0
    for b in range(body_count):
        r = centre[m] - body_position[b]
        spin = motion[2 * b + 1]
        relative = (shift[m] - motion[2 * b] - spin.cross(r)).norm()
        relative += (turn[m].norm() + spin.norm()) * patch_radius[m] + rest[m]
        reach = WITH_ROUNDING * (radius[b] + patch_radius[m] + largest_half + relative)
        if r.norm_sqr() < reach * reach:
            may = 1
    return may


@ti.func
def touch_bodies(
    x: ti.math.vec3, u: ti.math.vec3, half: ti.f32, own_friction: ti.f32, corners: Four, weight: ti.math.vec4,
    only_edged: ti.template(), recovery: ti.f32,
    body_count: ti.i32, shape_kind: Integers, size: Vectors, has_edges: Integers, centre_of_mass: Vectors,
    radius: Floats, step: Floats, body_friction: Floats, grid_values: Floats, grid_first: Integers,
    grid_origin: Vectors, grid_spacing: Floats, grid_shape: CountTriples,
    body_position: Vectors, rotation: Matrices, motion: Vectors,
    vertices: Quadruples, weights: Weights, normal: Vectors, floor: Floats, kind: Integers, arm: Vectors,
    friction: Floats, counter: Integers, capacity: ti.i32,
):  # fmt: skip
    """Append the bodies that a point of the cloth, at x with displacement u, comes nearer than half its thickness."""
    for b in range(body_count):
        r = x - body_position[b]
        relative = u - motion[2 * b] - motion[2 * b + 1].cross(r)
        reach = radius[b] + half + relative.norm()
        looked_at = 1 if ti.static(not only_edged) else has_edges[b]
        if looked_at == 1 and r.norm_sqr() < reach * reach:
            turned = rotation[b]
            y = turned.transpose() @ r + centre_of_mass[b]
            distance = distance_at(
                y, b, shape_kind, size, grid_values, grid_first, grid_origin, grid_spacing, grid_shape
            )
            if distance < half + relative.norm():
                gradient = ti.math.vec3(0.0)
                for axis in ti.static(range(3)):
                    ahead = ti.math.vec3(0.0)
                    ahead[axis] = step[b]
                    gradient[axis] = distance_at(
                        y + ahead, b, shape_kind, size, grid_values, grid_first, grid_origin, grid_spacing, grid_shape
                    ) - distance_at(
                        y - ahead, b, shape_kind, size, grid_values, grid_first, grid_origin, grid_spacing, grid_shape
                    )
                n = turned @ unit_or(gradient, y)
                least = least_displacement(distance, half, recovery)
                if distance < half or n.dot(relative) < least:
                    slot = ti.atomic_add(counter[0], 1)
                    if slot < capacity:
                        vertices[slot], weights[slot], normal[slot], floor[slot] = corners, weight, n, least
                        kind[slot], arm[slot] = b, r
                        friction[slot] = ti.sqrt(own_friction * body_friction[b])


@fast_launch
@ti.kernel
def find_body_contacts_of_vertices(
    patch_count: ti.i32, lanes: ti.i32, workers: ti.i32, taken: Integers, first_vertex: Integers,
    patch_vertices: Integers, centre: Vectors, shift: Vectors, turn: Vectors, patch_radius: Floats, rest: Floats,
    largest_half: ti.f32,
    position: Vectors, displacement: Vectors, thickness: Floats, vertex_friction: Floats,
    body_count: ti.i32, shape_kind: Integers, size: Vectors, has_edges: Integers, centre_of_mass: Vectors,
    radius: Floats, step: Floats, body_friction: Floats, grid_values: Floats, grid_first: Integers,
    grid_origin: Vectors, grid_spacing: Floats, grid_shape: CountTriples,
    body_position: Vectors, rotation: Matrices, motion: Vectors, recovery: ti.f32,
    vertices: Quadruples, weights: Weights, normal: Vectors, floor: Floats, kind: Integers, arm: Vectors,
    friction: Floats, counter: Integers, capacity: ti.i32, is_short: ti.template(),
):  # fmt: skip
    """Append the contacts of vertices with bodies."""
    begin_sharing(taken, 0)
    if ti.static(is_short):
        ti.loop_config(serialize=True)
    for worker in range(workers):
        item = next_item(-1, worker, taken, 0, PATCHES_AT_A_TIME)
        while item < patch_count * lanes:
            m = item // lanes
            may_touch = may_touch_bodies(
                m, centre, shift, turn, patch_radius, rest, largest_half, body_count, radius, body_position, motion
            )
            place = ti.select(may_touch == 1, first_vertex[m], first_vertex[m + 1]) + item % lanes
            while place < first_vertex[m + 1]:
                i = patch_vertices[place]
                touch_bodies(
                    position[i], displacement[i], 0.5 * thickness[i], vertex_friction[i],
                    Four(i), ti.math.vec4(1.0, 0.0, 0.0, 0.0), False, recovery,
                    body_count, shape_kind, size, has_edges, centre_of_mass, radius, step, body_friction, grid_values,
                    grid_first, grid_origin, grid_spacing, grid_shape, body_position, rotation, motion,
                    vertices, weights, normal, floor, kind, arm, friction, counter, capacity,
                )  # fmt: skip
                place += lanes
            item = next_item(item, worker, taken, 0, PATCHES_AT_A_TIME)


@fast_launch
@ti.kernel
def find_body_contacts_between_vertices(
    patch_count: ti.i32, lanes: ti.i32, workers: ti.i32, taken: Integers, first_edge: Integers,
    edges: Pairs, first_triangle: Integers, triangles: Triples,
    centre: Vectors, shift: Vectors, turn: Vectors, patch_radius: Floats, rest: Floats, largest_half: ti.f32,
    position: Vectors, displacement: Vectors, thickness: Floats, vertex_friction: Floats,
    body_count: ti.i32, shape_kind: Integers, size: Vectors, has_edges: Integers, centre_of_mass: Vectors,
    radius: Floats, step: Floats, body_friction: Floats, grid_values: Floats, grid_first: Integers,
    grid_origin: Vectors, grid_spacing: Floats, grid_shape: CountTriples,
    body_position: Vectors, rotation: Matrices, motion: Vectors, recovery: ti.f32,
    vertices: Quadruples, weights: Weights, normal: Vectors, floor: Floats, kind: Integers, arm: Vectors,
    friction: Floats, counter: Integers, capacity: ti.i32, is_short: ti.template(),
):  # fmt: skip
    """Append the contacts of midpoints of edges and triangles with bodies that have edges of their own."""
    begin_sharing(taken, 0)
    if ti.static(is_short):
        ti.loop_config(serialize=True)
    for worker in range(workers):
        item = next_item(-1, worker, taken, 0, PATCHES_AT_A_TIME)
        while item < patch_count * lanes:
            m = item // lanes
            may_touch = may_touch_bodies(
                m, centre, shift, turn, patch_radius, rest, largest_half, body_count, radius, body_position, motion
            )
            place = ti.select(may_touch == 1, first_edge[m], first_edge[m + 1]) + item % lanes
            while place < first_edge[m + 1]:
                a, b = edges[place][0], edges[place][1]
                touch_bodies(
                    0.5 * (position[a] + position[b]), 0.5 * (displacement[a] + displacement[b]), 0.5 * thickness[a],
                    vertex_friction[a], Four(a, b, a, a), ti.math.vec4(0.5, 0.5, 0.0, 0.0), True, recovery,
                    body_count, shape_kind, size, has_edges, centre_of_mass, radius, step, body_friction, grid_values,
                    grid_first, grid_origin, grid_spacing, grid_shape, body_position, rotation, motion,
                    vertices, weights, normal, floor, kind, arm, friction, counter, capacity,
                )  # fmt: skip
                place += lanes
            place = ti.select(may_touch == 1, first_triangle[m], first_triangle[m + 1]) + item % lanes
            while place < first_triangle[m + 1]:
                a, b, c = triangles[place][0], triangles[place][1], triangles[place][2]
                third = 1.0 / 3.0
                touch_bodies(
                    third * (position[a] + position[b] + position[c]),
                    third * (displacement[a] + displacement[b] + displacement[c]), 0.5 * thickness[a],
                    vertex_friction[a], Four(a, b, c, a), ti.math.vec4(third, third, third, 0.0), True, recovery,
                    body_count, shape_kind, size, has_edges, centre_of_mass, radius, step, body_friction, grid_values,
                    grid_first, grid_origin, grid_spacing, grid_shape, body_position, rotation, motion,
                    vertices, weights, normal, floor, kind, arm, friction, counter, capacity,
                )  # fmt: skip
                place += lanes
            item = next_item(item, worker, taken, 0, PATCHES_AT_A_TIME)
