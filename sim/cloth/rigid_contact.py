"""Cloth against rigid bodies and walls: what touches in a substep."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.arrays import Floats, Integers, Matrices, Vectors
from sim.cloth.proximity import unit_or
from sim.cloth.proximity_contacts import WALL, ContactList, Quadruples, Weights, least_displacement
from sim.cloth.rigid_contact_bodies import CollisionBodies
from sim.cloth.self_collision_kernels import Four, Pairs, Triples
from sim.cloth.state import ClothState
from sim.launch import fast_launch
from sim.rigid.contacts import Poses
from sim.rigid.geometry import BodyGeometry
from sim.rigid.shape_distances import CountTriples, distance_at
from sim.rigid.walls import Wall

Array = NDArray[np.float64]
Planes = ti.types.ndarray(dtype=ti.math.vec4, ndim=1)

LARGEST_ADVANCE = 0.25
"""How far cloth and bodies may move against each other in a step, in half shortest edges of the smallest body."""

WALL_DEPTH = 4.0
"""Walls hold what is at most so far behind them, in thicknesses, or as far as a mean edge or the node's motion in the
step, if that is more: what left through an open face falls on outside."""

SMALL_BODY = 4.0
"""Round bodies with a shorter edge, in mean edges of the cloth, are looked at between its vertices, too: larger ones
show by an eighth of an edge at most where vertices alone meet them."""


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
        self._spacing = 0.0
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
        """Say how far vertices of the cloth are from each other [m]: what is small, and how deep walls hold."""
        self._spacing = mean_edge
        self.bodies.look_between_vertices(SMALL_BODY * mean_edge)
        self._has_edges = bool(self.bodies.has_edges.to_numpy()[: self.bodies.count].any())

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

    def find(self, state: ClothState, contacts: ContactList, recovery: float, found: int) -> int:
        """Append what touches in this substep; the number of contacts then, or needed.

        Args:
            state: at the start of a substep.
            contacts: the list.
            recovery: share of a missing distance that the substep gives back [-].
            found: number of contacts before.
        """
        cloth = (state.position, state.displacement, state.thickness, state.friction)
        if self._wall_count:
            found = find_wall_contacts(
                state.vertex_count, *cloth, self._wall_count, self._wall_plane, self._wall_low, self._wall_high,
                self._joined_low, self._joined_high, self._spacing, recovery, *contacts.found_arrays,
            )  # fmt: skip
        if not self.bodies.count:
            return int(found)
        each = self.bodies
        bodies = (
            each.count, each.kind, each.size, each.has_edges, each.centre_of_mass, each.radius, each.step,
            each.friction, each.grid_values, each.grid_first, each.grid_origin, each.grid_spacing, each.grid_shape,
            each.position, each.rotation, each.motion,
        )  # fmt: skip
        found = find_body_contacts_of_vertices(
            state.vertex_count, *cloth, *bodies, recovery, *contacts.found_arrays
        )  # fmt: skip
        if self._has_edges:
            found = find_body_contacts_between_vertices(
                state.edges, state.edge_count, state.triangles, state.triangle_count, *cloth, *bodies, recovery,
                *contacts.found_arrays,
            )  # fmt: skip
        return int(found)


@fast_launch
@ti.kernel
def find_wall_contacts(
    vertex_count: ti.i32, position: Vectors, displacement: Vectors, thickness: Floats, vertex_friction: Floats,
    wall_count: ti.i32, plane: Planes, low: Vectors, high: Vectors, joined_low: Vectors, joined_high: Vectors,
    spacing: ti.f32, recovery: ti.f32,
    vertices: Quadruples, weights: Weights, normal: Vectors, floor: Floats, kind: Integers, arm: Vectors,
    friction: Floats, counter: Integers, capacity: ti.i32,
) -> ti.i32:  # fmt: skip
    """Append the vertices that reach a wall; walls are flat, so that vertices are enough.

    Walls hold down to a depth, and where another wall joins them as far beyond it: what is behind two is led back by
    both.
    """
    for i in range(vertex_count):
        x, half = position[i], 0.5 * thickness[i]
        for w in range(wall_count):
            n = plane[w].xyz
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
    return counter[0]


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
    vertex_count: ti.i32, position: Vectors, displacement: Vectors, thickness: Floats, vertex_friction: Floats,
    body_count: ti.i32, shape_kind: Integers, size: Vectors, has_edges: Integers, centre_of_mass: Vectors,
    radius: Floats, step: Floats, body_friction: Floats, grid_values: Floats, grid_first: Integers,
    grid_origin: Vectors, grid_spacing: Floats, grid_shape: CountTriples,
    body_position: Vectors, rotation: Matrices, motion: Vectors, recovery: ti.f32,
    vertices: Quadruples, weights: Weights, normal: Vectors, floor: Floats, kind: Integers, arm: Vectors,
    friction: Floats, counter: Integers, capacity: ti.i32,
) -> ti.i32:  # fmt: skip
    """Append the contacts of vertices with bodies; returns the number of contacts so far."""
    for i in range(vertex_count):
        touch_bodies(
            position[i], displacement[i], 0.5 * thickness[i], vertex_friction[i],
            Four(i), ti.math.vec4(1.0, 0.0, 0.0, 0.0), False, recovery,
            body_count, shape_kind, size, has_edges, centre_of_mass, radius, step, body_friction, grid_values,
            grid_first, grid_origin, grid_spacing, grid_shape, body_position, rotation, motion,
            vertices, weights, normal, floor, kind, arm, friction, counter, capacity,
        )  # fmt: skip
    return counter[0]


@fast_launch
@ti.kernel
def find_body_contacts_between_vertices(
    edges: Pairs, edge_count: ti.i32, triangles: Triples, triangle_count: ti.i32,
    position: Vectors, displacement: Vectors, thickness: Floats, vertex_friction: Floats,
    body_count: ti.i32, shape_kind: Integers, size: Vectors, has_edges: Integers, centre_of_mass: Vectors,
    radius: Floats, step: Floats, body_friction: Floats, grid_values: Floats, grid_first: Integers,
    grid_origin: Vectors, grid_spacing: Floats, grid_shape: CountTriples,
    body_position: Vectors, rotation: Matrices, motion: Vectors, recovery: ti.f32,
    vertices: Quadruples, weights: Weights, normal: Vectors, floor: Floats, kind: Integers, arm: Vectors,
    friction: Floats, counter: Integers, capacity: ti.i32,
) -> ti.i32:  # fmt: skip
    """Append the contacts of midpoints of edges and triangles with bodies that have edges of their own."""
    for e in range(edge_count):
        a, b = edges[e][0], edges[e][1]
        touch_bodies(
            0.5 * (position[a] + position[b]), 0.5 * (displacement[a] + displacement[b]), 0.5 * thickness[a],
            vertex_friction[a], Four(a, b, a, a), ti.math.vec4(0.5, 0.5, 0.0, 0.0), True, recovery,
            body_count, shape_kind, size, has_edges, centre_of_mass, radius, step, body_friction, grid_values,
            grid_first, grid_origin, grid_spacing, grid_shape, body_position, rotation, motion,
            vertices, weights, normal, floor, kind, arm, friction, counter, capacity,
        )  # fmt: skip
    for t in range(triangle_count):
        a, b, c = triangles[t][0], triangles[t][1], triangles[t][2]
        third = 1.0 / 3.0
        touch_bodies(
            third * (position[a] + position[b] + position[c]),
            third * (displacement[a] + displacement[b] + displacement[c]), 0.5 * thickness[a],
            vertex_friction[a], Four(a, b, c, a), ti.math.vec4(third, third, third, 0.0), True, recovery,
            body_count, shape_kind, size, has_edges, centre_of_mass, radius, step, body_friction, grid_values,
            grid_first, grid_origin, grid_spacing, grid_shape, body_position, rotation, motion,
            vertices, weights, normal, floor, kind, arm, friction, counter, capacity,
        )  # fmt: skip
    return counter[0]
