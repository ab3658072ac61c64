"""Cloth against rigid bodies and walls: what touches in a substep."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.cloth.bundles import (
    CollidingBodies,
    Four,
    MovingPatches,
    PatchLists,
    PatchMotion,
    PushedBodies,
    Three,
    Touching,
    Walls,
    Weights,
)
from sim.cloth.contacts import WALL, ContactList, append_contact, closest_on_triangle, least_displacement, unit_or
from sim.cloth.near_pairs import LANES, on_gpu
from sim.cloth.self_collision import Box, Patches
from sim.cloth.state import ClothState
from sim.core.arrays import Floats, Integers, Vectors, on_device
from sim.core.bundles import func, with_room
from sim.core.host_access import copied, put
from sim.core.launch import kernel, large_kernel
from sim.core.motion.paths import Poses
from sim.core.reductions import LaneReduction, Share, reduced
from sim.core.scheduling import begin_sharing, next_item, workers_for
from sim.core.walls import Wall
from sim.shapes.body_geometry import BodyGeometry
from sim.shapes.device_shapes import CAPSULE, GRID, SPHERE, TORUS, DeviceShapes, Shapes, distance_to, surface_motion

Array = NDArray[np.float64]

LOAD_UNIT = 1.0e-6  # unit of sums of the square roots of mobilities, in the largest of them

_ROUND = (SPHERE, CAPSULE, TORUS)


LANES_OF_VERTICES = 8  # threads of a GPU for a patch of which vertices alone are looked at
PATCHES_AT_A_TIME = 4  # patches that a thread takes at a time: those that touch a body take some microseconds each

LARGEST_ADVANCE = 0.25
"""How far cloth and a body that it may meet may move against each other in a step, in half shortest edges of that
body."""

WALL_DEPTH = 4.0
"""Walls hold what is at most so far behind them, in thicknesses, or as far as a mean edge or the node's motion in the
step, if that is more: what left through an open face falls on outside."""

OF_TRIANGLES = 0.75
"""Part of their distance from bodies that triangles keep between their vertices, which alone push flat bodies then."""

LARGEST_LIFT = 0.25
"""How much farther from a round body than half their thickness vertices may be kept, in thicknesses, so that it does
not show between them: triangles need not be looked at, which have four times the contacts."""

SEARCH_LEVELS = 5  # how often the deepest point of a triangle is looked for around the last: to a 24th of its edges
AT_CORNER = 0.98  # what has this barycentric coordinate is a vertex

WITH_EDGES = 2
"""In `CollidingBodies.shows`: edges are looked at, too. Where a straight edge of a body leads through a triangle, one
point does not hold it: it turns about that."""

NO_BODIES, BODIES, SHOWN_BODIES = range(3)
"""What there is besides walls: nothing, bodies, bodies of which some may show between vertices."""

Corners = ti.types.matrix(3, 3, ti.f32)
"""Those of a triangle, in rows."""

WITH_ROUNDING = 1.00001
"""Bounds of how far patches reach and move are so much larger than computed: float32 loses some 1e-7 of them."""


@dataclass(frozen=True, eq=False)
class BodyMotion:
    """How the m bodies that move do; all others stand still.

    Attributes:
        velocity: of the centres of mass [m/s], (m, 3).
        angular_velocity: about world axes [rad/s], (m, 3).
        acceleration: that the coming substep will add, but for cloth [m/s²], (m, 3).
        inverse_mass: of all that moves as one with a body [1/kg], (m,); 0 for what no force moves.
        inverse_inertia: the same, about the common centre of mass, in world axes [1/(kg m²)], (m, 3, 3).
        leader: of each body the first of those that move as one, (m,); None where each moves on its own.
        arm: from the common centre of mass to its own, in world axes [m], (m, 3).
    """

    velocity: Array
    angular_velocity: Array
    acceleration: Array
    inverse_mass: Array
    inverse_inertia: Array
    leader: NDArray[np.int64] | None = None
    arm: Array | None = None


class RigidContact(DeviceShapes):
    """Finds where cloth touches bodies and walls: bodies that move, then those that stand still.

    Cloth stays half its thickness away from both. Its vertices are looked at, which keep a little more where a round
    body would show a little between them (`CollidingBodies.lift`); and where it may show more, the deepest point of
    each triangle. Nothing tunnels while bodies and cloth move by less than `LARGEST_ADVANCE` (`stable_dt`).

    Attributes:
        colliding: the bodies for kernels that find contacts.
        pushed: the bodies for kernels that push them.

    Args:
        geometries: of the bodies; those that move first.
        friction: of the bodies [-]; cloth and body have the geometric mean.
        walls: closed faces of the domain, which have the friction of the cloth.
        cloths: number of cloths.
    """

    def __init__(
        self, geometries: Sequence[BodyGeometry], friction: Sequence[float], walls: Sequence[Wall], cloths: int = 1
    ) -> None:
        super().__init__(geometries)
        b = self.count
        motion = ti.Vector.ndarray(3, ti.f32, 2 * max(b, 1))
        self.colliding: CollidingBodies = with_room(
            CollidingBodies,
            b,
            count=b,
            shapes=self.on_device,
            centre_of_mass=self.centre_of_mass,
            radius=self.radius,
            step=self.step,
            motion=motion,
            passes=ti.ndarray(ti.i32, max(b * cloths, 1)),
        )
        twice = {name: ti.Vector.ndarray(3, ti.f32, 2 * max(b, 1)) for name in ("motion_start", "motion_reached")}
        six = {name: ti.ndarray(ti.i64, 6 * max(b, 1)) for name in ("gathered", "impulse")}
        self.pushed: PushedBodies = with_room(
            PushedBodies, b, may_move=0, count=b, motion=motion, load_unit=1.0, glued=False, **twice, **six
        )
        self.set_friction(np.asarray(friction, dtype=np.float64))
        self._motion: BodyMotion | None = None
        self._leaders: NDArray[np.int64] | None = None  # of what moves as one, once some do
        self._time_s = 0.0
        self._advance = LARGEST_ADVANCE * 0.5 * np.array([geometry.shortest_edge for geometry in geometries])
        self._advance_on_device = on_device(self._advance)
        self._moving = ti.Vector.ndarray(4, ti.f32, max(len(geometries), 1))
        self._rates = LaneReduction(maxima=1, sums=0)
        self._is_warm = False  # `fastest_approach` is compiled in the first step, not in the first fast one
        self._radius = np.array([geometry.radius for geometry in geometries])
        self._velocity = np.zeros((len(geometries), 3))
        self._spin_speed = np.zeros(len(geometries))
        self._shows = np.zeros(len(geometries), dtype=bool)
        self._longest, self._largest_half = 0.0, 0.0
        self._taken = ti.ndarray(ti.i32, 1)
        low, high = np.full((len(walls), 3), -np.inf), np.full((len(walls), 3), np.inf)
        joined = {side: np.zeros((len(walls), 3)) for side in (1.0, -1.0)}
        for number, wall in enumerate(walls):
            others = [axis for axis in range(3) if axis != wall.axis]
            low[number, others], high[number, others] = wall.lower, wall.upper
            for other in walls:
                if other.axis != wall.axis:
                    joined[other.side][number, other.axis] = 1.0
        planes = np.reshape([[*wall.normal, wall.side * wall.offset] for wall in walls], (len(walls), 4))
        arrays = (on_device(each) for each in (planes, low, high, joined[1.0], joined[-1.0]))
        self._walls = Walls(len(walls), 0.0, *arrays)

    def set_passing(self, passing: NDArray[np.bool_]) -> None:
        """Say which cloths pass through which bodies, (cloths, b)."""
        if self.count:
            put(self.colliding.passes, passing.ravel())

    def set_friction(self, friction: Array) -> None:
        """Say how rough the bodies are: Coulomb's coefficients [-], (b,)."""
        if self.count:
            put(self.colliding.friction, friction)

    def set_spacing(self, mean_edge: float, longest: float) -> None:
        """Say how long edges of the coarsest cloth are, and the longest of all [m]."""
        self._walls, self._longest = self._walls._replace(spacing=mean_edge), longest

    def set_thickness(self, least: float, largest: float) -> None:
        """Say how thick cloths are at least and at most [m]: where they can be bodies may show between vertices."""
        b, shapes, colliding = self.count, self.on_device, self.colliding
        size, kind = (copied(each)[:b] for each in (shapes.size, shapes.kind))
        radius = np.where(kind == TORUS, size[:, 1], size[:, 0])
        # How far it shows at most through triangles whose vertices touch it; what is sharp, or a grid, by any height.
        sag = np.where(np.isin(kind, _ROUND), self._longest**2 / (6.0 * np.maximum(radius, 1.0e-30)), np.inf)
        missing = sag - 0.5 * (1.0 - OF_TRIANGLES) * least
        shows = missing > LARGEST_LIFT * least
        lift = np.where(shows, 0.0, np.maximum(missing, 0.0))
        if b:
            put(colliding.lift, lift)
        self._largest_half = 0.5 * largest + lift.max(initial=0.0)
        if (shows != self._shows).any():
            self._shows = shows
            put(colliding.shows, np.where(kind == SPHERE, 1, 2) * shows)

    def place(self, poses: Poses, motion: BodyMotion | None = None, time_s: float = 0.0) -> None:
        """Say where the bodies are at the start of a substep, at a time [s], and how they move; without motion they
        stand still."""
        b, self._time_s = self.count, time_s
        inverse_mass, inverse_inertia = np.zeros(b), np.zeros((b, 3, 3))
        self._velocity, self._spin_speed = np.zeros((b, 3)), np.zeros(b)
        self._motion = motion
        if motion is not None:
            m = len(motion.velocity)
            inverse_mass[:m], inverse_inertia[:m] = motion.inverse_mass, motion.inverse_inertia
            self._velocity[:m] = motion.velocity
            self._spin_speed[:m] = self._radius[:m] * np.linalg.norm(motion.angular_velocity, axis=1)
            for number, geometry in enumerate(self.geometries[:m]):
                if geometry.deformation is not None:
                    self._spin_speed[number] += geometry.deformation.speed(time_s)
        if b:
            colliding, pushed = self.colliding, self.pushed
            put(colliding.position, poses.position[:b])
            put(colliding.rotation, poses.rotation[:b])
            put(pushed.inverse_mass, inverse_mass)
            put(pushed.inverse_inertia, inverse_inertia)
            reach = self._radius
            if motion is not None and motion.leader is not None and motion.arm is not None:
                reach = reach + self._glue(motion.leader, motion.arm)
            mobility = inverse_mass + reach**2 * np.linalg.norm(inverse_inertia, axis=(1, 2))
            self.pushed = self.pushed._replace(
                may_move=int(pushed.may_move or inverse_mass.any()),
                load_unit=LOAD_UNIT * float(np.sqrt(mobility.max())) or 1.0,
            )

    def _glue(self, leader: NDArray[np.int64], arm: Array) -> Array:
        """Say which bodies move as one, as of `BodyMotion`; returns the lengths of all arms [m], (b,)."""
        m, leaders, arms = len(leader), np.arange(self.count), np.zeros((self.count, 3))
        leaders[:m], arms[:m] = leader, arm
        if self._leaders is None or (leaders != self._leaders).any():
            following, in_turn = np.full(self.count, -1), np.argsort(leaders, kind="stable")
            alike = leaders[in_turn[1:]] == leaders[in_turn[:-1]]
            following[in_turn[:-1][alike]] = in_turn[1:][alike]
            put(self.pushed.leader, leaders)
            put(self.pushed.next, following)
            self.pushed, self._leaders = self.pushed._replace(glued=True), leaders
        put(self.pushed.arm, arms)
        lengths: Array = np.linalg.norm(arms, axis=1)
        return lengths

    def begin_substep(self, dt: float) -> None:
        """Foresee how the bodies move in a substep of dt [s] that cloth does not push."""
        if self._motion is not None:
            b, motion = self.count, self._motion
            m = len(motion.velocity)
            shift, turn = np.zeros((b, 3)), np.zeros((b, 3))
            shift[:m] = dt * (motion.velocity + dt * motion.acceleration)
            turn[:m] = dt * motion.angular_velocity
            if b:
                put(self.colliding.motion, np.stack([shift, turn], axis=1).reshape(-1, 3))
            self.deform(self._time_s, dt)

    def stable_dt(self, state: ClothState, nodes: range, box: Box, *, at_most: float) -> float:
        """Largest step [s] for some nodes, of one cloth or of several.

        A node that is not near a body may come half of the way in a step.

        Args:
            state: at the start of a step.
            nodes: numbers of those that are looked at, one by one only if needed.
            box: middle and half edges of the box around their velocities [m/s], (3,) each.
            at_most: the largest step otherwise [s].
        """
        if not self.count:
            return at_most
        speed = np.linalg.norm(np.abs(box[0]) + box[1])
        rates = (speed + np.linalg.norm(self._velocity, axis=1) + self._spin_speed) / self._advance
        if self._is_warm and rates.max() * at_most <= 1.0:
            return at_most
        self._is_warm = True
        put(self._moving, np.concatenate([self._velocity, self._spin_speed[:, None]], axis=1))
        rate = fastest_approach(
            self._rates.over(len(nodes)),
            nodes.start,
            len(nodes),
            state.position,
            state.velocity,
            self.colliding,
            self._moving,
            self._advance_on_device,
            self._largest_half + self._longest / math.sqrt(3.0),  # a triangle's middle is no farther from a node
        )
        return min(at_most, 1.0 / max(float(rate), 1.0e-30))

    def find(
        self, state: ClothState, patches: Patches, moving: MovingPatches, contacts: ContactList, recovery: float
    ) -> Callable[[], list[int]]:
        """Append what touches in this substep. Asks for the numbers of the list's counter, the first of which is how
        many contacts were found in all; that is 0 from then on.

        Args:
            state: at the start of a substep.
            patches: of the cloths.
            moving: how they move in it, and how far contacts may displace each.
            contacts: the list.
            recovery: share of a missing distance that the substep gives back [-].
        """
        is_alone, shows = not (self._walls.count or self.count), self._shows.any()
        lanes = on_gpu(LANES if shows else LANES_OF_VERTICES)
        cloth = state.surface, state.inverse_mass, state.body
        return find_rigid_contacts.later(
            patches.lists,
            (lanes, 0 if is_alone else workers_for(patches.count * lanes)),
            self._taken,
            moving.motion,
            moving.margin,
            self._largest_half,
            Touching(*cloth, self._walls, self.colliding, recovery, contacts.found),
            SHOWN_BODIES if shows else BODIES if self.count else NO_BODIES,
        )


@kernel
def fastest_approach(
    share: Share,
    first: ti.i32,
    count: ti.i32,
    position: Vectors,
    velocity: Vectors,
    bodies: CollidingBodies,
    moving: Weights,
    advance: Floats,
    half: ti.f32,
) -> ti.f32:
    """Largest inverse of the step that a node and a body bear [1/s].

    `moving` has the velocity of each body's centre of mass and the speed by which it turns [m/s], `advance` how far
    what is near may move against it [m].
    """
    for lane in range(share.tree.lanes):
        largest = 0.0
        for k in range(share.items):
            n = lane * share.lane_step + k * share.item_step
            if n < count:
                i = first + n
                for b in range(bodies.count):
                    relative = (velocity[i] - moving[b].xyz).norm()
                    rate = (relative + moving[b].w) / advance[b]
                    room = (position[i] - bodies.position[b]).norm() - bodies.radius[b] - half
                    if room > 0.0:
                        rate = ti.min(rate, 2.0 * relative / room)
                    largest = ti.max(largest, rate)
        share.tree.partial[lane] = largest
    return reduced(share.tree.partial, share.tree.lanes, 1, 1, share.tree.nodes)[0]


@func
def touch_wall(i: ti.i32, w: ti.i32, allowed: ti.f32, near: Touching):
    """Append a vertex if it reaches a wall, or would if it were displaced by what is `allowed` besides [m].

    Walls hold down to a depth, and where another wall joins them as far beyond it: what is behind two is led back by
    both.
    """
    surface, walls = ti.static((near.surface, near.walls))
    x, half, n = surface.position[i], 0.5 * surface.thickness[i], walls.plane[w].xyz
    distance = n.dot(x) - walls.plane[w].w
    least = least_displacement(distance, half, near.recovery)
    if distance < half or n.dot(surface.displacement[i]) < least + allowed:
        depth = ti.max(2.0 * WALL_DEPTH * half, walls.spacing, surface.displacement[i].norm())
        is_above = (x >= walls.low[w] - depth * walls.joined_low[w]).all()
        is_below = (x <= walls.high[w] + depth * walls.joined_high[w]).all()
        if is_above and is_below and distance > -depth:
            weights, nothing = ti.math.vec4(1.0, 0.0, 0.0, 0.0), ti.math.vec3(0.0)
            append_contact(near.contacts, Four(i), weights, n, least, WALL, nothing, surface.friction[i])


@func
def bodies_near(m: ti.i32, patch: PatchMotion, largest_half: ti.f32, bodies: CollidingBodies) -> ti.i32:
    """To the spheres of how many bodies points of a patch may come as near as `touch_body` asks for."""
    near = 0
    for b in range(bodies.count):
        r = patch.centre[m] - bodies.position[b]
        spin = bodies.motion[2 * b + 1]
        relative = (patch.shift[m] - bodies.motion[2 * b] - spin.cross(r)).norm()
        relative += (patch.turn[m].norm() + spin.norm()) * patch.radius[m] + patch.rest[m]
        reach = WITH_ROUNDING * (bodies.radius[b] + patch.radius[m] + largest_half + relative)
        if r.norm_sqr() < reach * reach:
            near += 1
    return near


@func
def is_wall_near(m: ti.i32, w: ti.i32, patch: PatchMotion, largest_half: ti.f32, walls: Walls) -> ti.u1:
    """Whether points of a patch may come as near to a wall as `touch_wall` asks for."""
    reach = patch.shift[m].norm() + (1.0 + patch.turn[m].norm()) * patch.radius[m] + patch.rest[m]
    above = walls.plane[w].xyz.dot(patch.centre[m]) - walls.plane[w].w
    return above < WITH_ROUNDING * (reach + largest_half)


@func
def allowed_between(m: ti.i32, patch: PatchMotion, margin: Floats, largest_half: ti.f32, near: Touching) -> ti.f32:
    """How far contacts may displace a patch into what it does not touch yet [m]: where several bodies or walls are
    near, one may push it into another, which has to be among its contacts then.
    """
    count = bodies_near(m, patch, largest_half + margin[m], near.bodies)
    for w in range(near.walls.count):
        count += ti.cast(is_wall_near(m, w, patch, largest_half + margin[m], near.walls), ti.i32)
    return ti.select(count > 1, margin[m], 0.0)


@func
def touch_body(
    b: ti.i32,
    v: Four,
    weight: ti.math.vec4,
    keeps: ti.f32,
    across: ti.math.mat3,
    half: ti.f32,
    allowed: ti.f32,
    near: Touching,
):
    """Append a body if a point of the cloth, the weighted mean of vertices, comes nearer to it than it keeps, or would
    with what is `allowed` besides [m].

    Of its gradient only what is `across` the element counts in which this point is the nearest to the body. How deep it
    is gets noted in thicknesses, if `half` of that is not 0.
    """
    surface, bodies = ti.static((near.surface, near.bodies))
    x, u = ti.math.vec3(0.0), ti.math.vec3(0.0)
    for k in ti.static(range(4)):
        if weight[k] != 0.0:
            x, u = x + weight[k] * surface.position[v[k]], u + weight[k] * surface.displacement[v[k]]
    r = x - bodies.position[b]
    relative = u - bodies.motion[2 * b] - bodies.motion[2 * b + 1].cross(r)
    comes = relative.norm() + allowed
    reach = bodies.radius[b] + keeps + comes
    if r.norm_sqr() < reach * reach:
        turned = bodies.rotation[b]
        y = turned.transpose() @ r + bodies.centre_of_mass[b]
        drift = ti.math.vec3(0.0)
        if ti.static(bodies.shapes.deforms):
            drift = turned @ surface_motion(y, b, bodies.shapes)
            relative -= drift
            comes = relative.norm() + allowed
        distance = distance_to(y, b, bodies.shapes)
        if half > 0.0 and -0.5 * distance / half > bodies.depth[b]:
            ti.atomic_max(bodies.depth[b], -0.5 * distance / half)
        if distance < keeps + comes:
            gradient = ti.math.vec3(0.0)
            for axis in range(3):  # not unrolled: a distance takes long to compile
                ahead = ti.math.vec3(0.0)
                ahead[axis] = bodies.step[b]
                gradient[axis] = distance_to(y + ahead, b, bodies.shapes) - distance_to(y - ahead, b, bodies.shapes)
            n = turned @ unit_or(gradient, y)
            n = unit_or(across @ n, n)
            least = least_displacement(distance, keeps, near.recovery)
            if distance < keeps or n.dot(relative) < least + allowed:
                friction = ti.sqrt(surface.friction[v[0]] * bodies.friction[b])
                slot = append_contact(near.contacts, v, weight, n, least, b, r, friction)
                if ti.static(near.contacts.drifts):
                    place = near.contacts.capacity + slot
                    if slot < near.contacts.capacity:
                        near.contacts.arm[place] = drift


@func
def deepest_on_triangle(y: Corners, in_middle: ti.f32, b: ti.i32, shapes: Shapes) -> ti.math.vec3:
    """Barycentric coordinates of the point of a triangle, in the frame of a shape, that is deepest in it or nearest.

    Of balls exact; else the best of six points around the best so far, ever nearer, from the middle on.
    """
    best, least, step = ti.math.vec3(1.0 / 3.0), in_middle, 1.0 / 3.0
    if shapes.kind[b] == SPHERE:
        best = closest_on_triangle(ti.math.vec3(0.0), y[0, :], y[1, :], y[2, :])
    else:
        for level in range(SEARCH_LEVELS):
            around = best
            for k in range(6):
                way = ti.math.vec3(ti.cast(k % 3 == 0, ti.f32) - ti.cast(k % 3 == 2, ti.f32), 0.0, 0.0)
                way[1] = ti.cast(k % 3 == 1, ti.f32) - ti.cast(k % 3 == 0, ti.f32)
                way[2] = -way[0] - way[1]
                share = ti.max(around + ti.select(k < 3, step, -step) * way, 0.0)
                share /= share.sum()
                distance = distance_to(y.transpose() @ share, b, shapes)
                if distance < least:
                    least, best = distance, share
            if level > 0:
                step *= 0.5
    return best


@large_kernel
def find_rigid_contacts(
    patches: PatchLists,
    work: ti.math.ivec2,
    taken: Integers,
    motion: PatchMotion,
    margin: Floats,
    largest_half: ti.f32,
    near: Touching,
    meets: ti.template(),
) -> ti.math.ivec2:
    """Append the contacts of vertices with walls, which are flat, so that vertices are enough; if cloth `meets` bodies,
    also with these, and if some show between vertices, those of triangles, each at its deepest point.

    `work` has the threads that share a patch, and workers (`sim.core.scheduling`). Returns the first two numbers of the
    list's counter, of which one is 0 then.
    """
    vertices, surface, contacts = ti.static((patches.vertices, near.surface, near.contacts))
    walls, bodies = ti.static((near.walls, near.bodies))
    lanes, workers_end = work[0], work[1]
    begin_sharing(taken, 0)
    for worker in range(workers_end):
        item = next_item(-1, worker, taken, 0, PATCHES_AT_A_TIME)
        while item < vertices.count * lanes:
            m = item // lanes
            allowed = allowed_between(m, motion, margin, largest_half, near)
            for w in range(walls.count):
                comes = is_wall_near(m, w, motion, largest_half + allowed, walls)
                place = ti.select(comes, vertices.first[m], vertices.first[m + 1]) + item % lanes
                while place < vertices.first[m + 1]:
                    touch_wall(vertices.nodes[place], w, allowed, near)
                    place += lanes
            if ti.static(meets != NO_BODIES):
                is_near = bodies_near(m, motion, largest_half + allowed, bodies) > 0
                place = ti.select(is_near, vertices.first[m], vertices.first[m + 1]) + item % lanes
                while place < vertices.first[m + 1]:
                    i = vertices.nodes[place]
                    half, weight = 0.5 * surface.thickness[i], ti.math.vec4(1.0, 0.0, 0.0, 0.0)
                    noted, across = ti.select(near.inverse_mass[i] > 0.0, half, 0.0), ti.Matrix.identity(ti.f32, 3)
                    for b in range(bodies.count):
                        if bodies.passes[near.cloth[i] * bodies.count + b] == 0:
                            touch_body(b, Four(i), weight, half + bodies.lift[b], across, noted, allowed, near)
                    place += lanes
                if ti.static(meets == SHOWN_BODIES):
                    # One loop over edges, then triangles: what it does is compiled once, which takes seconds.
                    edges = patches.first_edge[m + 1] - patches.first_edge[m]
                    end = edges + patches.first_triangle[m + 1] - patches.first_triangle[m]
                    place = ti.select(is_near, item % lanes, end)
                    while place < end:
                        corners = Three(0)
                        if place < edges:
                            ends = patches.edges[patches.first_edge[m] + place]
                            corners = Three(ends[0], ends[1], ends[1])
                        else:
                            corners = patches.triangles[patches.first_triangle[m] + place - edges]
                        for b in range(bodies.count):
                            passes = bodies.passes[near.cloth[corners[0]] * bodies.count + b] == 1
                            if bodies.shows[b] > ti.cast(place < edges, ti.i32) and not passes:
                                touch_triangle(b, corners, allowed, near)
                        place += lanes
            item = next_item(item, worker, taken, 0, PATCHES_AT_A_TIME)
    found = ti.math.ivec2(contacts.counter[0], contacts.counter[1])
    contacts.counter[2] = ti.select(contacts.counter[3] == 1 and found[0] <= contacts.capacity, found[0], 0)
    contacts.counter[0] = 0
    return found


@func
def touch_triangle(b: ti.i32, corners: Three, allowed: ti.f32, near: Touching):
    """Append a body if it comes too near to a triangle between its corners, or to an edge: a, b, b; `allowed` is as of
    `touch_body`.

    What is nearest at an edge is left to that where edges are looked at, too. A triangle with a corner that a pin holds
    in the body is where the job wants it. The distance to a convex body sags nowhere by more than three times what it
    does in the middle of a triangle.
    """
    surface, bodies = ti.static((near.surface, near.bodies))
    v, third = corners, 1.0 / 3.0
    half = 0.5 * surface.thickness[v[0]]
    y, x = Corners(0.0), Corners(0.0)
    comes, nearest = 0.0, 1.0e30
    for k in ti.static(range(3)):
        r = surface.position[v[k]] - bodies.position[b]
        relative = surface.displacement[v[k]] - bodies.motion[2 * b] - bodies.motion[2 * b + 1].cross(r)
        comes, nearest = ti.max(comes, relative.norm() + allowed), ti.min(nearest, r.norm())
        at = bodies.rotation[b].transpose() @ r + bodies.centre_of_mass[b]
        for axis in ti.static(range(3)):
            x[k, axis], y[k, axis] = surface.position[v[k]][axis], at[axis]
        if ti.static(bodies.shapes.deforms):
            comes = ti.max(comes, relative.norm() + allowed + surface_motion(at, b, bodies.shapes).norm())
    size = ti.max((y[1, :] - y[0, :]).norm(), (y[2, :] - y[0, :]).norm())
    if nearest < bodies.radius[b] + half + size + comes:
        in_middle = distance_to(y.transpose() @ ti.math.vec3(third), b, bodies.shapes)
        # Outside of its grid a distance is at most three times too large: the body is in the grid, it is 1-Lipschitz.
        is_grid = bodies.shapes.kind[b] == GRID
        if ti.select(is_grid, third * in_middle, in_middle) < half + size + comes:
            sag, is_held = -in_middle, False
            for k in range(3):
                share = ti.math.vec3(ti.cast(k == 0, ti.f32), ti.cast(k == 1, ti.f32), ti.cast(k == 2, ti.f32))
                distance = distance_to(y.transpose() @ share, b, bodies.shapes)
                sag += third * distance
                held = ti.select(k == 0, v[0], ti.select(k == 1, v[1], v[2]))
                if near.inverse_mass[held] == 0.0 and distance < 0.0:
                    is_held = True
            is_convex = not is_grid and bodies.shapes.kind[b] != TORUS
            if not is_held and not (is_convex and 3.0 * sag < (1.0 - OF_TRIANGLES) * half):
                share = deepest_on_triangle(y, in_middle, b, bodies.shapes)
                across = ti.Matrix.identity(ti.f32, 3)
                if v[1] == v[2]:
                    along = unit_or(x[1, :] - x[0, :], x[2, :])
                    across -= along.outer_product(along)
                    share = ti.math.vec3(share[0], share[1] + share[2], 0.0)
                elif bodies.shows[b] == WITH_EDGES:
                    n = unit_or((x[1, :] - x[0, :]).cross(x[2, :] - x[0, :]), x[2, :])
                    across = n.outer_product(n)
                    if share.min() < 1.0 - AT_CORNER:
                        share[0] = 1.0
                if share.max() < AT_CORNER:
                    weight = ti.math.vec4(share[0], share[1], share[2], 0.0)
                    three = Four(v[0], v[1], v[2], v[0])
                    touch_body(b, three, weight, OF_TRIANGLES * half, across, half, allowed, near)
