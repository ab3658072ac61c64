"""Two-way coupling of soft matter and cloths, whose sheets part the grid: CPIC (Hu et al. 2018) with exact sums.

A particle near a sheet has no share in the nodes on the other side of the sheet's tangent plane at the point nearest to
it. What it would have given them, stresses included, meets the sheet instead: it collides without bounce, with
friction, and goes with the sheet for the step. With M and P the mass and momentum of that part of a particle, v the
sheet's velocity there and n its normal towards the particle,

    w = slid(P/M - v),   J = M (P/M + dt g - v - w)

goes to the corners of the triangle, together with M, by barycentric coordinates; the cloth takes its step; and the part
has v' + w then. A part that leads away from the sheet goes on as it is. So linear momentum is kept to rounding, however
light the sheet is, and what lies on one side knows nothing of what lies on the other.

No particle passes: it is held a little off the plane of its nearest triangle, and put back where its way and that of a
triangle have crossed. What sheets or walls leave no room for may pass in the end, and is counted.
"""

import math
from typing import NamedTuple

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.cloth.contacts import closest_on_triangle, distance_to_triangle, unit_or
from sim.cloth.solver import ClothSolver
from sim.cloth.state import NodeLoad
from sim.core.arrays import Floats, Integers, LongIntegers, Vectors, on_device
from sim.core.box import Box
from sim.core.bundles import bundle, func
from sim.core.launch import kernel
from sim.core.reductions import LaneReduction, Results, Share, reduced_tree
from sim.core.solver import Coupling
from sim.soft.blocks import EDGE, NODES, SUPPORT, Blocks, Triple, base_of, block_of, place_of, within_block
from sim.soft.contact import QUANTA, slid
from sim.soft.solver import SoftSolver
from sim.soft.transfers import SHARES, Particles, Parting, affine_momentum, is_hidden, pull_of, weight_at

REACH = 2.0  # distance of a particle from a sheet from which on it is parted from nodes [cells]
NEAR = 1.0  # distance from a sheet within which a particle could pass it in a step [cells]
ON_SHEET = 1.0e-3  # distance from a sheet below which a node is on neither side [cells]
LEAST_GAP = 0.02  # of a particle and a sheet [cells]
CROSSED = 1.0e-3  # distance from a triangle below which a way has crossed it [cells]
STEEPEST = 0.7  # cosine of the angle to a rim's normal within which a particle is over the sheet
FALSE_POSITIONS = 6  # steps towards when a particle crosses a triangle
MOST_ROUNDS = 4  # of putting particles back in a step
LOOSE = 1.0 + 1.0e-4  # factor on a distance that must not be too small by rounding
TERMS = 4  # of a node's sums: mass and impulse
FRACTIONS = 2.0**29  # steps of what keys compare, in a range of 1

Corners = ti.types.ndarray(dtype=ti.math.ivec3, ndim=1)


@bundle
class Sheets(NamedTuple):
    """Triangles of all cloths, (k,), and their nodes, (m,)."""

    corners: Corners
    rim: Integers  # bits: whether side 0, 1, 2 of the triangle, opposite to that corner, and corner 0, 1, 2, are on one
    friction: Floats  # of soft matter against each triangle [-]
    before: Vectors  # where nodes are at the start of a step [m]
    place: Vectors  # where they are at its end [m]
    velocity: Vectors  # [m/s]
    sums: LongIntegers  # of what nodes get, (m * TERMS,)
    count: ti.i32  # of triangles
    nodes: ti.i32
    mass_unit: ti.f32  # [kg]
    speed_unit: ti.f32  # [m/s]


@bundle
class Met(NamedTuple):
    """Particles as they meet sheets, (n,) each."""

    key: LongIntegers  # of what is to be done first: a number from 0 to 1, and its triangle
    start: Vectors  # where they are at the start of a step [m]
    triangle: Integers  # the nearest one, -1 if none is near
    bound: Floats  # distance beyond which there is none that is nearest [m]
    weights: Vectors  # barycentric coordinates of the nearest point on it
    normal: Vectors  # from there to the particle
    touches: Integers  # whether it goes with the sheet


class SoftClothCoupling(Coupling):
    """Cloths carry soft matter, lie on it and hold it together; see the module.

    A coupled step: soft matter brings its momenta to the grid; cloths take what meets them, with its mass, and step;
    soft matter takes its velocities back and moves.
    """

    def __init__(self, soft: SoftSolver, cloth: ClothSolver) -> None:
        self.bodies = (soft.name, cloth.name)
        self._soft, self._cloth = soft, cloth
        state, count = cloth.state, soft.particles.count
        vectors = [ti.Vector.ndarray(3, ti.f32, count) for _ in range(3)]
        integers = [ti.ndarray(ti.i32, count) for _ in range(2)]
        key, bound = ti.ndarray(ti.i64, count), ti.ndarray(ti.f32, count)
        self._met = Met(key, vectors[0], integers[0], bound, vectors[1], vectors[2], integers[1])
        own = soft.parameters[0].friction
        friction = state.host.of_triangles([math.sqrt(own * each.friction) for each in cloth.parameters])
        self._sheets = Sheets(
            state.triangles,
            on_device(rims_of(state.host.triangles, state.host.edges.of_side)),
            on_device(friction),
            *(ti.Vector.ndarray(3, ti.f32, state.vertex_count) for _ in range(2)),
            state.velocity,
            ti.ndarray(ti.i64, state.vertex_count * TERMS),
            state.triangle_count,
            state.vertex_count,
            soft.mass,
            1.0,
        )
        self._sheets.sums.fill(0)
        self._load = NodeLoad(state.vertex_count)
        self._reduction = LaneReduction(maxima=1, sums=0)
        cloth.loads.append(self._load)
        soft.let_part(self._find_hidden)
        self.resume()

    def _find_hidden(self, blocks: Blocks) -> None:
        """Find the nodes behind sheets."""
        self._blocks = blocks
        particles, met, state = self._soft.particles, self._met, self._cloth.state
        place_nodes(state.position, state.carry, self._sheets.before)
        find_nearest(blocks, particles, self._sheets, met, REACH * blocks.edge)
        find_hidden(blocks, particles, self._sheets, met, self._soft.parting)

    def exchange(self, dt: float) -> None:
        """Lay what meets the sheets onto their nodes."""
        soft = self._soft
        self._sheets = self._sheets._replace(speed_unit=self._blocks.edge / dt)
        met = soft.masses, soft.volume, self._sheets, self._met, soft.parting
        meet(self._blocks, soft.particles, *met, ti.math.vec3(soft.gravity), dt)
        take_sums(self._sheets, self._load.mass, self._load.impulse)

    def follow(self, dt: float) -> None:
        """Let soft matter go on, with the sheets where it meets them, and keep it on its side of these."""
        particles, state, blocks = self._soft.particles, self._cloth.state, self._blocks
        go_along(particles, self._sheets, self._met, self._soft.parting)
        self._soft.end_substep(dt)
        place_nodes(state.position, state.carry, self._sheets.place)
        gap = LEAST_GAP * blocks.edge
        hold_off(particles, self._sheets, self._met, self._soft.box, gap)
        for turn in range(MOST_ROUNDS + 1):
            crossed = find_crossings(blocks, particles, self._sheets, self._met)
            if crossed == 0:
                break
            if turn == MOST_ROUNDS:
                self._soft.passed += crossed
            else:
                put_back(particles, self._sheets, self._met, self._soft.box, gap)
        self._soft.placed_by_others()
        self.resume()

    def resume(self) -> None:
        """Tell soft matter how fast the sheets are."""
        share = self._reduction.over(self._sheets.nodes)
        self._soft.met_speed = math.sqrt(float(self._reduction.unpack(largest_square(self._sheets, share))[0]))


def rims_of(triangles: NDArray[np.int32], of_side: NDArray[np.int64]) -> NDArray[np.int32]:
    """Bits of `Sheets.rim`, (k,).

    Args:
        triangles: (k, 3).
        of_side: edge of side s of triangle t, from corner s on, at 3 t + s.
    """
    is_rim = (np.bincount(of_side)[of_side] == 1).reshape(-1, 3)
    ends = triangles[:, [[0, 1], [1, 2], [2, 0]]][is_rim]
    on_rim = np.isin(triangles, ends)
    bits = np.hstack([is_rim[:, [1, 2, 0]], on_rim])
    return (bits << np.arange(6)).sum(axis=1).astype(np.int32)


@func
def key_of(value: ti.f32, number: ti.i32) -> ti.i64:
    """A number from 0 to 1 and a triangle, in their order."""
    return (ti.cast(value * ti.static(FRACTIONS), ti.i64) << 32) + ti.cast(number, ti.i64)


@ti.func
def no_key() -> ti.i64:
    """Larger than all keys."""
    return ti.cast(1, ti.i64) << 62


@func
def normal_at(t: ti.i32, sheets: Sheets, place: Vectors) -> ti.math.vec3:
    """Normal of a triangle."""
    n = sheets.corners[t]
    return unit_or((place[n[1]] - place[n[0]]).cross(place[n[2]] - place[n[0]]), ti.math.vec3(0.0, 0.0, 1.0))


@func
def mixed(t: ti.i32, weights: ti.math.vec3, sheets: Sheets, values: Vectors) -> ti.math.vec3:
    """Value at a point of a triangle of what nodes have."""
    n = sheets.corners[t]
    return weights[0] * values[n[0]] + weights[1] * values[n[1]] + weights[2] * values[n[2]]


@kernel
def place_nodes(position: Vectors, carry: Vectors, place: Vectors):
    """Where nodes are, with what their positions have been rounded by."""
    for n in range(position.shape[0]):
        place[n] = position[n] + carry[n]


@func
def cells_around(t: ti.i32, sheets: Sheets, reach: ti.f32, blocks: Blocks):
    """Lowest and highest cell that may hold particles within reach of a triangle at the start of a step."""
    n = sheets.corners[t]
    a, b, c = sheets.before[n[0]], sheets.before[n[1]], sheets.before[n[2]]
    low, high = base_of(ti.min(a, ti.min(b, c)) - reach, blocks), base_of(ti.max(a, ti.max(b, c)) + reach, blocks)
    last = EDGE * blocks.shape - 1
    return ti.max(0, ti.min(low, last)), ti.max(0, ti.min(high, last))


@func
def cell_at(node: Triple, blocks: Blocks) -> ti.i32:
    """Number of a cell of the lattice, -1 where it is not stored."""
    block = blocks.number[block_of(node, blocks)]
    return ti.select(block >= 0, block * NODES + within_block(node), -1)


@kernel
def find_nearest(blocks: Blocks, particles: Particles, sheets: Sheets, met: Met, reach: ti.f32):
    """The triangle nearest to each particle within a reach [m], as a key; the lowest number of several.

    Those whose box is farther off than the one that was nearest in the step before are left out. What is found does not
    depend on which that was.
    """
    for p in range(particles.count):
        x_p = particles.position[p]
        met.key[p] = no_key()
        met.start[p] = x_p
        n = sheets.corners[ti.max(met.triangle[p], 0)]
        a, b, c = sheets.before[n[0]], sheets.before[n[1]], sheets.before[n[2]]
        known = distance_to_triangle(ti.math.vec3(0.0), a - x_p, b - x_p, c - x_p)
        met.bound[p] = ti.min(reach, LOOSE * known + (LOOSE - 1.0) * reach)
    for t in range(sheets.count):
        n = sheets.corners[t]
        a, b, c = sheets.before[n[0]], sheets.before[n[1]], sheets.before[n[2]]
        lower, upper = ti.min(a, ti.min(b, c)), ti.max(a, ti.max(b, c))
        low, high = cells_around(t, sheets, reach, blocks)
        for z in range(low[2], high[2] + 1):
            for y in range(low[1], high[1] + 1):
                for x in range(low[0], high[0] + 1):
                    cell = cell_at(Triple(x, y, z), blocks)
                    if cell >= 0:
                        for s in range(blocks.sort.cell_start[cell], blocks.sort.cell_start[cell + 1]):
                            p = blocks.sort.order[s]
                            x_p = particles.position[p]
                            off_box = ti.max(0.0, ti.max(lower - x_p, x_p - upper)).norm()
                            if off_box < met.bound[p]:
                                distance = distance_to_triangle(ti.math.vec3(0.0), a - x_p, b - x_p, c - x_p)
                                if distance < reach:
                                    ti.atomic_min(met.key[p], key_of(distance / reach, t))


@kernel
def find_hidden(blocks: Blocks, particles: Particles, sheets: Sheets, met: Met, parting: Parting):
    """Nearest points, and the nodes behind the plane there; of no use beside a rim."""
    for p in range(particles.count):
        met.triangle[p] = -1
        met.touches[p] = 0
        hidden = 0
        if met.key[p] < no_key():
            t = ti.cast(met.key[p], ti.i32)
            n = sheets.corners[t]
            x_p = particles.position[p]
            a, b, c = sheets.before[n[0]] - x_p, sheets.before[n[1]] - x_p, sheets.before[n[2]] - x_p
            weights = closest_on_triangle(ti.math.vec3(0.0), a, b, c)
            to_sheet = weights[0] * a + weights[1] * b + weights[2] * c
            of_triangle = normal_at(t, sheets, sheets.before)
            normal = of_triangle
            if to_sheet.norm() > ON_SHEET * LEAST_GAP * blocks.edge:
                normal = -to_sheet.normalized()
            on_rim = 0
            for k in ti.static(range(3)):
                on_rim |= int(weights[k] <= 0.0) & sheets.rim[t] >> k
                on_rim |= int(weights[k] >= 1.0) & sheets.rim[t] >> (3 + k)
            if on_rim & 1 == 0 or ti.abs(normal.dot(of_triangle)) > STEEPEST:
                met.triangle[p] = t
                met.weights[p] = weights
                met.normal[p] = normal
                to_corner = ti.cast(base_of(x_p, blocks), ti.f32) - place_of(x_p, blocks) - to_sheet / blocks.edge
                for lane in range(SHARES):
                    step = Triple(lane % SUPPORT, lane // SUPPORT % SUPPORT, lane // SUPPORT**2)
                    if (to_corner + ti.cast(step, ti.f32)).dot(normal) <= ON_SHEET:
                        hidden |= 1 << lane
        parting.hidden[p] = hidden


@kernel
def meet(
    blocks: Blocks,
    particles: Particles,
    masses: Floats,
    volume: ti.f32,
    sheets: Sheets,
    met: Met,
    parting: Parting,
    gravity: ti.math.vec3,
    dt: ti.f32,
):
    """Masses and impulses of what meets the sheets; ghosts move relative to the sheet where it goes along."""
    pull = pull_of(volume, blocks, dt)
    for p in range(particles.count):
        if parting.hidden[p] != 0:
            own = masses[particles.body[p]]
            to_corner = ti.cast(base_of(particles.position[p], blocks), ti.f32) - place_of(
                particles.position[p], blocks
            )
            share = 0.0
            arm = ti.math.vec3(0.0)
            for lane in range(SHARES):
                if is_hidden(parting.hidden[p], lane):
                    step = Triple(lane % SUPPORT, lane // SUPPORT % SUPPORT, lane // SUPPORT**2)
                    away = to_corner + ti.cast(step, ti.f32)
                    share += weight_at(away)
                    arm += weight_at(away) * away
            ghost = ti.math.vec3(0.0)
            if share > 0.0:
                t, weights, normal = met.triangle[p], met.weights[p], met.normal[p]
                affine = affine_momentum(particles, p, own, pull, blocks)
                ghost = particles.velocity[p] + affine @ (arm / share) / own
                sheet = mixed(t, weights, sheets, sheets.velocity)
                relative = ghost - sheet
                ghost += dt * gravity
                if relative.dot(normal) < 0.0:
                    met.touches[p] = 1
                    after = slid(relative, normal, sheets.friction[t])
                    mass = share * own / sheets.mass_unit
                    impulse = mass * (ghost - sheet - after) / sheets.speed_unit
                    ghost = after
                    for k in ti.static(range(3)):
                        node = sheets.corners[t][k]
                        add(sheets.sums, node * TERMS, weights[k] * mass)
                        for axis in ti.static(range(3)):
                            add(sheets.sums, node * TERMS + 1 + axis, weights[k] * impulse[axis])
            parting.ghost[p] = ghost


@func
def add(sums: LongIntegers, at: ti.i32, value: ti.f32):
    """Add to a sum of whole quanta, which is the same in any order."""
    ti.atomic_add(sums[at], ti.cast(value * ti.static(QUANTA), ti.i64))


@kernel
def take_sums(sheets: Sheets, mass: Floats, impulse: Vectors):
    """Masses [kg] and impulses [N s] of nodes, which start anew."""
    for n in range(sheets.nodes):
        total = ti.math.vec4(0.0)
        for k in ti.static(range(TERMS)):
            total[k] = ti.cast(ti.cast(sheets.sums[n * TERMS + k], ti.f64) / ti.static(QUANTA), ti.f32)
            sheets.sums[n * TERMS + k] = 0
        mass[n] = total[0] * sheets.mass_unit
        impulse[n] = ti.math.vec3(total[1], total[2], total[3]) * (sheets.mass_unit * sheets.speed_unit)


@kernel
def go_along(particles: Particles, sheets: Sheets, met: Met, parting: Parting):
    """Ghosts move with the sheets, as these move after their step."""
    for p in range(particles.count):
        if met.touches[p] == 1:
            parting.ghost[p] += mixed(met.triangle[p], met.weights[p], sheets, sheets.velocity)


@func
def within(x: ti.math.vec3, box: Box) -> ti.math.vec3:
    """The nearest point between the closed walls [m]."""
    return ti.min(ti.max(x, box.wall_low), box.wall_high)


@kernel
def hold_off(particles: Particles, sheets: Sheets, met: Met, box: Box, gap: ti.f32):
    """Put particles at least a gap [m] before the plane at their nearest point, as that is after the step."""
    for p in range(particles.count):
        t = met.triangle[p]
        if t >= 0 and particles.body[p] >= 0:
            before, now = normal_at(t, sheets, sheets.before), normal_at(t, sheets, sheets.place)
            side = ti.select(met.normal[p].dot(before) < 0.0, -1.0, 1.0)
            normal = (met.normal[p] + side * (now - before)).normalized()
            off = (particles.position[p] - mixed(t, met.weights[p], sheets, sheets.place)).dot(normal)
            if off < gap:
                particles.position[p] = within(particles.position[p] + (gap - off) * normal, box)


@ti.func
def volume_at(
    at: ti.f32,
    x: ti.math.vec3,
    u: ti.math.vec3,
    v: ti.math.vec3,
    x_moved: ti.math.vec3,
    u_moved: ti.math.vec3,
    v_moved: ti.math.vec3,
) -> ti.f32:
    """Volume that a point and two sides span at a time from 0 to 1 [m³], with the sign of the point's side."""
    return (x + at * x_moved).dot((u + at * u_moved).cross(v + at * v_moved))


@ti.func
def time_of_crossing(
    x: ti.math.vec3,
    u: ti.math.vec3,
    v: ti.math.vec3,
    x_moved: ti.math.vec3,
    u_moved: ti.math.vec3,
    v_moved: ti.math.vec3,
) -> ti.f32:
    """When a point is in the plane of a triangle that moves and turns, from 0 to 1: by false position, halved where one
    end stays (the Illinois method, Dowell & Jarratt 1971).

    Args:
        x, u, v: the point and the other corners, seen from the first corner, at the start [m].
        x_moved, u_moved, v_moved: how far each goes [m].
    """
    low, high = 0.0, 1.0
    at_low = volume_at(0.0, x, u, v, x_moved, u_moved, v_moved)
    at_high = volume_at(1.0, x, u, v, x_moved, u_moved, v_moved)
    at = 0.5
    for _ in range(FALSE_POSITIONS):
        if at_low != at_high:
            at = ti.math.clamp((low * at_high - high * at_low) / (at_high - at_low), 0.0, 1.0)
        value = volume_at(at, x, u, v, x_moved, u_moved, v_moved)
        if (value >= 0.0) == (at_high >= 0.0):
            high = at
            at_high = value
            at_low *= 0.5
        else:
            low = at
            at_low = value
            at_high *= 0.5
    return at


@kernel
def find_crossings(blocks: Blocks, particles: Particles, sheets: Sheets, met: Met) -> ti.i32:
    """The triangle that each particle has crossed first in the step, as a key; returns how many have crossed one."""
    for p in range(particles.count):
        met.key[p] = no_key()
    for t in range(sheets.count):
        n = sheets.corners[t]
        a, b, c = sheets.before[n[0]], sheets.before[n[1]], sheets.before[n[2]]
        a_moved, b_moved, c_moved = sheets.place[n[0]] - a, sheets.place[n[1]] - b, sheets.place[n[2]] - c
        before, now = normal_at(t, sheets, sheets.before), normal_at(t, sheets, sheets.place)
        low, high = cells_around(t, sheets, NEAR * blocks.edge, blocks)
        for z in range(low[2], high[2] + 1):
            for y in range(low[1], high[1] + 1):
                for x in range(low[0], high[0] + 1):
                    cell = cell_at(Triple(x, y, z), blocks)
                    if cell >= 0:
                        for s in range(blocks.sort.cell_start[cell], blocks.sort.cell_start[cell + 1]):
                            p = blocks.sort.order[s]
                            x_p = met.start[p]
                            moved = particles.position[p] - x_p
                            off_before = (x_p - a).dot(before)
                            off_now = (x_p - a + (moved - a_moved)).dot(now)
                            if (off_before >= 0.0) != (off_now >= 0.0):
                                at = time_of_crossing(
                                    x_p - a, b - a, c - a, moved - a_moved, b_moved - a_moved, c_moved - a_moved
                                )
                                from_a = a - x_p + at * (a_moved - moved)
                                from_b = b - x_p + at * (b_moved - moved)
                                from_c = c - x_p + at * (c_moved - moved)
                                distance = distance_to_triangle(ti.math.vec3(0.0), from_a, from_b, from_c)
                                if distance < CROSSED * blocks.edge:
                                    ti.atomic_min(met.key[p], key_of(at, t))
    crossed = 0
    for p in range(particles.count):
        if met.key[p] < no_key() and particles.body[p] >= 0:
            crossed += 1
    return crossed


@kernel
def put_back(particles: Particles, sheets: Sheets, met: Met, box: Box, gap: ti.f32):
    """Put particles that have crossed a triangle a gap [m] before it, on the side that they come from."""
    for p in range(particles.count):
        if met.key[p] < no_key() and particles.body[p] >= 0:
            t = ti.cast(met.key[p], ti.i32)
            first = sheets.corners[t][0]
            came = (met.start[p] - sheets.before[first]).dot(normal_at(t, sheets, sheets.before))
            normal = ti.select(came >= 0.0, 1.0, -1.0) * normal_at(t, sheets, sheets.place)
            off = (particles.position[p] - sheets.place[first]).dot(normal)
            particles.position[p] = within(particles.position[p] + (gap - off) * normal, box)


@kernel
def largest_square(sheets: Sheets, share: Share) -> Results:
    """Largest squared speed of a node [m²/s²]."""
    for lane in range(share.tree.lanes):
        largest = 0.0
        for k in range(share.items):
            n = lane * share.lane_step + k * share.item_step
            if n < sheets.nodes:
                largest = ti.max(largest, sheets.velocity[n].norm_sqr())
        share.tree.partial[lane] = largest
    return reduced_tree(share.tree)
