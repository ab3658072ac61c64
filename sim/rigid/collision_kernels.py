"""Contacts of pairs of bodies that are near: the balls of each against the distance of the other, reduced to few.

Pairs are kept in order, and their contacts in the order of the pairs, from step to step: pairs that have moved are
looked at again, and what is known of the others, and the forces of contacts that are found again, goes along.
"""

import math
from typing import NamedTuple

import taichi as ti

from sim.core.arrays import Floats
from sim.core.bundles import bundle, func
from sim.core.launch import kernel, kernel_of_host_arrays
from sim.core.scan import scan_in_parallel
from sim.rigid.array_types import Numbers, Rows, Vector3, Whole, WholeRows
from sim.rigid.contact_kernels import tangents_of
from sim.rigid.contacts import FEATURE_BITS, KEPT_BONUS, MOST_PATCHES, SAME_PATCH, WALL_BITS

Vector8 = ti.types.vector(8, ti.f64)
Index8 = ti.types.vector(8, ti.i32)

SPHERE, BOX, CYLINDER, CAPSULE, TORUS, CONE, PROFILE, GRID = range(8)
KIND, FIRST_BALL, BALLS, FIRST_CLUSTER, CLUSTERS, FIRST_VALUE, NODES, FIRST_EDGE, EDGES = 0, 1, 2, 3, 4, 5, 6, 9, 10
"""Columns of the whole numbers of a shape; the nodes of its grid are three."""
SIZE, CENTRE, ORIGIN, SPACING, REACH, STEP, SLANT, LOW, HIGH = 0, 3, 6, 9, 10, 11, 12, 13, 16
"""Columns of the other numbers of a shape; its size, centre of mass, grid's origin and its box's corners are three."""
BALLS_PER_CLUSTER = 16
MOST_KEPT = 9 * MOST_PATCHES  # contacts of a pair: of each patch the deepest and one in each of eight directions
SCRATCH = (
    18  # columns: centre, outward (in the other's frame), distance, radius, point, normal, gap, side, feature, use
)
FREE, DONE, IN_PATCH, CHOSEN = 0.0, 1.0, 2.0, 3.0  # uses of a candidate
DROPPED, KEPT, EXAMINED = range(3)  # what happens to the contacts of a pair in a step
CONTACT_BAND = 5.0e-3  # points this near, in shortest edges of the smaller body, belong to a contact
TRUSTED_MOTION = 1.0e-3  # contacts are looked for anew after surfaces moved so far, in the same unit
FAR = 1.0e30  # more than any length, and a number in float32, as kernels read it
_HALF_CELL_DIAGONAL = 0.87  # by which grids err at most, in cells


@bundle
class Shapes(NamedTuple):
    """Shapes of bodies, each once."""

    whole: WholeRows  # whole numbers, by the columns above, (s, 11)
    sizes: Rows  # other numbers, likewise, (s, 19)
    balls: Rows  # centre, radius, axis, cone of the balls of all shapes, (m, 8)
    clusters: Rows  # centre and radius of each `BALLS_PER_CLUSTER` of them, (c, 4)
    values: Floats  # distances at the nodes of all grids [m]
    edges: Rows  # start and extent of the edges of all profiles, (e, 4)


@bundle
class Bodies(NamedTuple):
    """Where bodies are, and the domain, which is the last."""

    pose: Rows  # position and rotation, row by row, (b, 12)
    shape: Whole  # number of the shape, (b - 1,)
    size: Numbers  # shortest edges [m], (b,)
    motion: Numbers  # how far surfaces may get in the coming step [m], (b,)
    moved: Numbers  # how far they got since contacts were last looked for [m], (b,)
    is_active: Whole  # (b,)
    rest_box: Rows  # centre and half edges of a box around each, in its frame [m], (b - 1, 6)
    box: Rows  # corners of axis-aligned boxes [m], (b - 1, 6)


@bundle
class Near(NamedTuple):
    """Pairs of bodies that may come near, in ascending order, and those of the broad phase before."""

    pairs: WholeRows  # first and second body, the wall that stands for the second or -1, whose balls: 1, 2, 3 both
    before: Whole  # numbers of the pairs in the step before, or -1, (p,)
    budget: Numbers  # how far surfaces may get until the pair is looked at again [m], (p,)
    action: Whole  # (p,)
    place: Whole  # of an examined pair among these, (p + 1,)
    tasks: Whole  # the examined pairs, (p,)
    numbers: Whole  # room for what is added up, (p,)
    sums: Whole  # likewise
    rank: Whole  # places in an order by chance, which is always the same for the same bodies, (p,)


@bundle
class Found(NamedTuple):
    """Contacts of the pairs that are examined, (t,)."""

    counts: Whole  # of each pair, (t,)
    features: WholeRows  # side and number of the ball of each, (t MOST_KEPT, 2)
    planes: Rows  # anchor [m] and normal in the other's frame, (t MOST_KEPT, 6)
    heights: Numbers  # of the centre of the ball above its plane [m], (t MOST_KEPT,)
    balls: Rows  # centre, in the frame of its body, and radius [m], (t MOST_KEPT, 4)
    clearances: Numbers  # up to which gap they are all of the pair [m]: its margin or more, (t,)


@bundle
class Kept(NamedTuple):
    """Contacts by pair: a ball fixed to one body against a plane fixed to the other.

    The plane touches the other body's surface where it is nearest to the ball. While the bodies move by a small part
    of their size it stands for that surface, with an error of the motion squared over the radius of curvature; for
    flat surfaces and walls it is exact, and a ball that rolls is followed exactly.
    """

    starts: Whole  # where those of each pair begin, and the end, (p + 1,)
    features: WholeRows  # side, 0 if the ball is the first body's, else 1, and number of the ball, (c, 2)
    planes: Rows  # anchor [m] and normal, in the frame of the other, (c, 6)
    balls: Rows  # centre, in the frame of its body, and radius [m], (c, 4)
    forces: Rows  # of the last step, in the world [N], (c, 3)


@bundle
class Placed(NamedTuple):
    """Contacts where bodies are now, (c,)."""

    bodies: WholeRows  # (c, 2)
    point: Rows  # [m], (c, 3)
    normal: Rows  # from the second to the first, (c, 3)
    gap: Numbers  # [m], negative where they overlap


@ti.func
def vector_at(table: ti.template(), row: ti.i32, column: ti.i32) -> Vector3:
    """Three numbers of a table."""
    return Vector3(table[row, column], table[row, column + 1], table[row, column + 2])


@ti.func
def turned(pose: Rows, body: ti.i32, v: Vector3) -> Vector3:
    """From the frame of a body to the world's axes."""
    result = Vector3(0.0)
    for row in ti.static(range(3)):
        result[row] = pose[body, 3 + 3 * row] * v[0] + pose[body, 4 + 3 * row] * v[1] + pose[body, 5 + 3 * row] * v[2]
    return result


@ti.func
def turned_back(pose: Rows, body: ti.i32, v: Vector3) -> Vector3:
    """From the world's axes to the frame of a body."""
    result = Vector3(0.0)
    for column in ti.static(range(3)):
        result[column] = pose[body, 3 + column] * v[0] + pose[body, 6 + column] * v[1] + pose[body, 9 + column] * v[2]
    return result


@func
def grid_distance(p: Vector3, shape: ti.i32, shapes: Shapes) -> ti.f64:
    """Trilinear interpolation; outside of the grid that of the nearest point of it, plus the way there."""
    spacing = shapes.sizes[shape, SPACING]
    place = (p - vector_at(shapes.sizes, shape, ORIGIN)) / spacing
    nearest, share, cell = Vector3(0.0), Vector3(0.0), ti.Vector([0, 0, 0])
    for axis in ti.static(range(3)):
        nodes = shapes.whole[shape, NODES + axis]
        nearest[axis] = ti.max(0.0, ti.min(place[axis], ti.cast(nodes - 1, ti.f64)))
        cell[axis] = ti.min(ti.cast(nearest[axis], ti.i32), nodes - 2)
        share[axis] = nearest[axis] - cell[axis]
    value = ti.cast(0.0, ti.f64)
    for corner in ti.static(range(8)):
        dx, dy, dz = ti.static(corner // 4, corner // 2 % 2, corner % 2)
        wx = ti.static(1.0 - dx) + ti.static(2.0 * dx - 1.0) * share[0]
        wy = ti.static(1.0 - dy) + ti.static(2.0 * dy - 1.0) * share[1]
        wz = ti.static(1.0 - dz) + ti.static(2.0 * dz - 1.0) * share[2]
        node = (
            ((cell[0] + dx) * shapes.whole[shape, NODES + 1] + cell[1] + dy) * shapes.whole[shape, NODES + 2]
            + cell[2]
            + dz
        )
        value += wx * wy * wz * shapes.values[shapes.whole[shape, FIRST_VALUE] + node]
    return value + spacing * (place - nearest).norm()


@func
def profile_distance(r: ti.f64, z: ti.f64, first: ti.i32, count: ti.i32, shapes: Shapes) -> ti.f64:
    """Distance to the nearest edge, negative where a ray outwards crosses an odd number of edges."""
    square, crossings = ti.cast(FAR, ti.f64), 0
    for edge in range(first, first + count):
        x, y, along_x, along_y = (
            shapes.edges[edge, 0],
            shapes.edges[edge, 1],
            shapes.edges[edge, 2],
            shapes.edges[edge, 3],
        )
        offset_x, offset_y = r - x, z - y
        share = (offset_x * along_x + offset_y * along_y) / (along_x * along_x + along_y * along_y)
        share = ti.max(0.0, ti.min(share, 1.0))
        away_x, away_y = offset_x - share * along_x, offset_y - share * along_y
        square = ti.min(square, away_x * away_x + away_y * away_y)
        if (y > z) != (y + along_y > z) and x + offset_y / along_y * along_x > r:
            crossings += 1
    return ti.select(crossings % 2 == 1, -1.0, 1.0) * ti.sqrt(square)


@ti.func
def slab_distance(p: Vector3, half: Vector3) -> ti.f64:
    """Distance to a box about the origin."""
    beyond = ti.abs(p) - half
    return ti.max(beyond, 0.0).norm() + ti.min(beyond.max(), 0.0)


@ti.func
def cone_distance(radial: ti.f64, z: ti.f64, radius: ti.f64, height: ti.f64) -> ti.f64:
    """Distance to a triangle that revolves: base down, its bounding box centred on the origin."""
    px, py = radial - radius, z + 0.5 * height
    along = (height * py - radius * px) / (radius * radius + height * height)
    along = ti.max(0.0, ti.min(along, 1.0))
    slant_x, slant_y = px + along * radius, py - along * height
    base_x = ti.max(px, 0.0)
    nearest = ti.sqrt(ti.min(slant_x * slant_x + slant_y * slant_y, base_x * base_x + py * py))
    inside = py > 0.0 and height * px + radius * py < 0.0
    return ti.select(inside, -1.0, 1.0) * nearest


@func
def distance_to(p: Vector3, shape: ti.i32, shapes: Shapes) -> ti.f64:
    """Distance to a shape [m], negative inside, of a point in the frame of its centre of mass."""
    q = p + vector_at(shapes.sizes, shape, CENTRE)
    kind, size = shapes.whole[shape, KIND], vector_at(shapes.sizes, shape, SIZE)
    radial = ti.sqrt(q[0] * q[0] + q[1] * q[1])
    distance = ti.cast(0.0, ti.f64)
    if kind == SPHERE:
        distance = q.norm() - size[0]
    elif kind == BOX:
        distance = slab_distance(q, size)
    elif kind == CYLINDER:
        beyond_x, beyond_z = radial - size[0], ti.abs(q[2]) - size[1]
        out_x, out_z = ti.max(beyond_x, 0.0), ti.max(beyond_z, 0.0)
        distance = ti.sqrt(out_x * out_x + out_z * out_z) + ti.min(ti.max(beyond_x, beyond_z), 0.0)
    elif kind == CAPSULE:
        beyond = ti.max(ti.abs(q[2]) - size[1], 0.0)
        distance = ti.sqrt(radial * radial + beyond * beyond) - size[0]
    elif kind == TORUS:
        distance = ti.sqrt((radial - size[0]) ** 2 + q[2] * q[2]) - size[1]
    elif kind == CONE:
        distance = cone_distance(radial, q[2], size[0], size[1])
    elif kind == PROFILE:
        distance = profile_distance(radial, q[2], shapes.whole[shape, FIRST_EDGE], shapes.whole[shape, EDGES], shapes)
    else:
        distance = grid_distance(q, shape, shapes)
    return distance


@func
def normal_of(p: Vector3, shape: ti.i32, shapes: Shapes) -> Vector3:
    """Unit gradient of the distance; away from the centre of mass where it has none, as at the centre of a sphere."""
    step = shapes.sizes[shape, STEP]
    gradient = Vector3(0.0)
    for side in range(6):
        q = p
        for axis in ti.static(range(3)):
            if side // 2 == axis:
                q[axis] += ti.select(side % 2 == 0, step, -step)
        value = distance_to(q, shape, shapes)
        for axis in ti.static(range(3)):
            if side // 2 == axis:
                gradient[axis] += ti.select(side % 2 == 0, value, -value) / (2.0 * step)
    if gradient.norm() < 1.0e-3:
        gradient = p + Vector3(0.0, 0.0, 0.01 * step)
    return gradient / gradient.norm()


@func
def may_touch(p: Vector3, within: ti.f64, shape: ti.i32, shapes: Shapes) -> bool:
    """Whether a cluster of balls may come so near to a shape: its box is looked at, and its distance from below."""
    low, high = vector_at(shapes.sizes, shape, LOW), vector_at(shapes.sizes, shape, HIGH)
    may = slab_distance(p - 0.5 * (low + high), 0.5 * (high - low)) <= within
    if may:
        distance = distance_to(p, shape, shapes)
        if shapes.whole[shape, KIND] == GRID:
            q = p + vector_at(shapes.sizes, shape, CENTRE) - vector_at(shapes.sizes, shape, ORIGIN)
            spacing = shapes.sizes[shape, SPACING]
            distance -= _HALF_CELL_DIAGONAL * spacing
            for axis in ti.static(range(3)):
                if q[axis] < 0.0 or q[axis] > spacing * (shapes.whole[shape, NODES + axis] - 1):
                    distance = 0.0  # beyond the grid it is known from above only
        may = distance <= within
    return may


@func
def is_known(pair: ti.i32, side: ti.i32, feature: ti.i32, near: Near, kept: Kept) -> ti.i32:
    """The row of a contact of a pair in the step before, or -1."""
    row, old = -1, near.before[pair]
    if old >= 0:
        for known in range(kept.starts[old], kept.starts[old + 1]):
            if kept.features[known, 0] == side and kept.features[known, 1] == feature:
                row = known
    return row


@func
def margin_of(first: ti.i32, second: ti.i32, bodies: Bodies) -> ti.f64:
    """Gap up to which contacts of two bodies are looked for [m]."""
    smaller = ti.min(bodies.size[first], bodies.size[second])
    return (CONTACT_BAND + TRUSTED_MOTION) * smaller + bodies.motion[first] + bodies.motion[second]


@func
def choose_of_patch(
    begin: ti.i32, end: ti.i32, deepest: ti.i32, pair: ti.i32, margin: ti.f64, near: Near, kept: Kept, work: Rows
):
    """Of the candidates of a patch choose the deepest, and those that meet first when it is tilted in 8 directions.

    The tilt is a margin across the patch: of a flat face the corners are kept, of a bumpy or a round one the bumps
    that it stands on. The outermost points alone, which may hang above, would let it sink from bump to bump.
    """
    one, two = tangents_of(vector_at(work, deepest, 11))
    low, high = Vector8(FAR), Vector8(-FAR)
    for c in range(begin, end):
        if work[c, 17] == IN_PATCH:
            point = vector_at(work, c, 8)
            for d in ti.static(range(8)):
                along = ti.static(math.cos(_angle(d))) * point.dot(one) + ti.static(math.sin(_angle(d))) * point.dot(
                    two
                )
                low[d], high[d] = ti.min(low[d], along), ti.max(high[d], along)
    extent = (high - low).max()
    best, chosen = Vector8(-FAR), Index8(0)
    for c in range(begin, end):
        if work[c, 17] == IN_PATCH:
            point = vector_at(work, c, 8)
            known = is_known(pair, ti.cast(work[c, 15], ti.i32), ti.cast(work[c, 16], ti.i32), near, kept)
            bonus = ti.select(known >= 0, KEPT_BONUS * extent, 0.0)
            for d in ti.static(range(8)):
                along = ti.static(math.cos(_angle(d))) * point.dot(one) + ti.static(math.sin(_angle(d))) * point.dot(
                    two
                )
                score = margin * (along + bonus) - extent * work[c, 14]
                if score > best[d]:
                    best[d], chosen[d] = score, c
    for c in range(begin, end):
        if work[c, 17] == IN_PATCH:
            work[c, 17] = DONE
    work[deepest, 17] = CHOSEN
    for d in ti.static(range(8)):
        work[chosen[d], 17] = CHOSEN


def _angle(direction: int) -> float:
    """Of eight, which find every corner of a convex patch with an angle under 135°; the offset avoids symmetry axes."""
    return 2.0 * math.pi * (direction + 0.29) / 8.0


@func
def keep_few(
    begin: ti.i32,
    end: ti.i32,
    task: ti.i32,
    margin: ti.f64,
    near: Near,
    kept: Kept,
    work: Rows,
    found: Found,
):
    """Note a few of the candidates of a pair: patches of like normals, deepest first, few of each."""
    count = 0
    for _ in range(MOST_PATCHES):
        deepest, least = -1, ti.cast(FAR, ti.f64)
        for c in range(begin, end):
            if work[c, 17] == FREE and work[c, 14] < least:
                deepest, least = c, work[c, 14]
        if deepest >= 0:
            members = 0
            normal = vector_at(work, deepest, 11)
            for c in range(begin, end):
                if work[c, 17] == FREE and normal.dot(vector_at(work, c, 11)) >= SAME_PATCH:
                    work[c, 17] = IN_PATCH
                    members += 1
            if members > 2:
                choose_of_patch(begin, end, deepest, near.tasks[task], margin, near, kept, work)
            for c in range(begin, end):
                use = work[c, 17]
                if use >= IN_PATCH:
                    work[c, 17] = DONE
                    row = task * MOST_KEPT + count
                    found.features[row, 0] = ti.cast(work[c, 15], ti.i32)
                    found.features[row, 1] = ti.cast(work[c, 16], ti.i32)
                    found.heights[row] = work[c, 6]
                    for i in ti.static(range(3)):
                        found.planes[row, i] = work[c, i] - work[c, 6] * work[c, 3 + i]
                        found.planes[row, 3 + i] = work[c, 3 + i]
                    count += 1
    found.counts[task] = count


@func
def beside_wall(centre: Vector3, wall: ti.i32, walls: Rows):
    """Whether a point in the world has a wall before or behind it, the wall's normal, and how far it is before it."""
    axis, is_beside, column = ti.cast(walls[wall, 0], ti.i32), True, 0
    outward, distance = Vector3(0.0), ti.cast(0.0, ti.f64)
    for i in ti.static(range(3)):
        if i == axis:
            distance = walls[wall, 1] * (centre[i] - walls[wall, 2])
            outward[i] = walls[wall, 1]
        else:
            if centre[i] < walls[wall, 3 + column] or centre[i] > walls[wall, 5 + column]:
                is_beside = False
            column += 1
    return is_beside, outward, distance


@func
def add_candidate(
    end: ti.i32,
    side: ti.i32,
    other: ti.i32,
    feature: ti.i32,
    radius: ti.f64,
    centre: Vector3,
    outward: Vector3,
    distance: ti.f64,
    bodies: Bodies,
    work: Rows,
):
    """Note a ball of a body near the other: its centre, the surface's normal and its distance, in the other's frame."""
    normal = turned(bodies.pose, other, outward)
    point = turned(bodies.pose, other, centre - radius * outward) + vector_at(bodies.pose, other, 0)
    for i in ti.static(range(3)):
        work[end, i], work[end, 3 + i], work[end, 8 + i] = centre[i], outward[i], point[i]
        work[end, 11 + i] = ti.select(side == 0, normal[i], -normal[i])
    work[end, 6], work[end, 7], work[end, 14] = distance, radius, distance - radius
    work[end, 15], work[end, 16], work[end, 17] = side, feature, FREE


@kernel
def find_contacts(
    count: ti.i32,
    bodies: Bodies,
    near: Near,
    kept: Kept,
    walls: Rows,
    shapes: Shapes,
    room: ti.i32,
    blocks: ti.i32,
    run: ti.i32,
    work: Rows,
    found: Found,
):
    """Contacts of each pair that is examined by the balls of each against the distance of the other.

    Args:
        count: of these pairs; those that are polytopes are left out.
        bodies: where they are.
        near: the pairs.
        kept: the contacts of the step before.
        walls: axis, side, offset, corners of the rectangle on the two other axes, (w, 7).
        shapes: of the bodies.
        room: most balls of a pair.
        blocks: of pairs, which are looked at one after the other in each.
        run: items of a loop that one thread takes at least.
        work: room for the candidates of each block, (blocks room, SCRATCH).
        found: out.
    """
    for item in range(blocks * run):
        block = item // run
        begin = block * room
        task = ti.select(item % run == 0, block, count)
        while task < count:
            pair = near.tasks[task]
            first, second, wall, sides = (
                near.pairs[pair, 0],
                near.pairs[pair, 1],
                near.pairs[pair, 2],
                near.pairs[pair, 3],
            )
            margin, end = margin_of(first, second, bodies), begin
            for side in range(2):
                owner, other = ti.select(side == 0, first, second), ti.select(side == 0, second, first)
                clusters_of_owner = 0
                if (sides >> side) & 1 == 1:
                    clusters_of_owner = shapes.whole[bodies.shape[owner], CLUSTERS]
                for cluster in range(clusters_of_owner):
                    own = bodies.shape[owner]
                    row = shapes.whole[own, FIRST_CLUSTER] + cluster
                    middle = turned(bodies.pose, owner, vector_at(shapes.clusters, row, 0)) + vector_at(
                        bodies.pose, owner, 0
                    )
                    is_near = True
                    if wall >= 0:
                        axis = ti.cast(walls[wall, 0], ti.i32)
                        along = ti.cast(0.0, ti.f64)
                        for i in ti.static(range(3)):
                            along += ti.select(axis == i, middle[i], 0.0)
                        is_near = walls[wall, 1] * (along - walls[wall, 2]) <= margin + shapes.clusters[row, 3]
                    else:
                        there = turned_back(bodies.pose, other, middle - vector_at(bodies.pose, other, 0))
                        within = margin + shapes.clusters[row, 3]
                        is_near = may_touch(there, within, bodies.shape[other], shapes)
                    balls_here = 0
                    if is_near:
                        balls_here = ti.min(BALLS_PER_CLUSTER, shapes.whole[own, BALLS] - cluster * BALLS_PER_CLUSTER)
                    for place in range(balls_here):
                        number = cluster * BALLS_PER_CLUSTER + place
                        ball = shapes.whole[own, FIRST_BALL] + number
                        radius = shapes.balls[ball, 3]
                        centre = turned(bodies.pose, owner, vector_at(shapes.balls, ball, 0)) + vector_at(
                            bodies.pose, owner, 0
                        )
                        outward, distance, touches = Vector3(0.0), ti.cast(0.0, ti.f64), False
                        if wall >= 0:
                            is_beside, outward, distance = beside_wall(centre, wall, walls)
                            touches = is_beside and distance <= margin + radius
                        else:
                            against = bodies.shape[other]
                            centre = turned_back(bodies.pose, other, centre - vector_at(bodies.pose, other, 0))
                            if radius <= shapes.sizes[against, REACH]:
                                distance = distance_to(centre, against, shapes)
                                if distance <= margin + radius:
                                    outward = normal_of(centre, against, shapes)
                                    axis_there = turned(bodies.pose, owner, vector_at(shapes.balls, ball, 4))
                                    axis_there = turned_back(bodies.pose, other, axis_there)
                                    cosine = ti.max(-1.0, ti.min(-axis_there.dot(outward), 1.0))
                                    touches = ti.acos(cosine) <= shapes.balls[ball, 7] + shapes.sizes[against, SLANT]
                        if touches:
                            feature = number + (ti.max(wall, 0) << (FEATURE_BITS - WALL_BITS))
                            add_candidate(end, side, other, feature, radius, centre, outward, distance, bodies, work)
                            end += 1
            if sides > 0:
                found.clearances[task] = margin
                keep_few(begin, end, task, margin, near, kept, work, found)
                for row in range(task * MOST_KEPT, task * MOST_KEPT + found.counts[task]):
                    owner = ti.select(found.features[row, 0] == 0, first, second)
                    number = found.features[row, 1] & ((1 << (FEATURE_BITS - WALL_BITS)) - 1)
                    ball = shapes.whole[bodies.shape[owner], FIRST_BALL] + number
                    for column in ti.static(range(4)):
                        found.balls[row, column] = shapes.balls[ball, column]
            task += blocks


@kernel
def place_boxes(bodies: Bodies, count: ti.i32, outer: Rows) -> ti.i32:
    """Axis-aligned boxes of so many bodies; how many of these, with what they may reach, have left larger ones, (b, 6).

    What they may reach is what `margin_of` has of them.
    """
    for body in range(count):
        middle = turned(bodies.pose, body, vector_at(bodies.rest_box, body, 0)) + vector_at(bodies.pose, body, 0)
        for row in ti.static(range(3)):
            half = ti.cast(0.0, ti.f64)
            for column in ti.static(range(3)):
                half += ti.abs(bodies.pose[body, 3 + 3 * row + column]) * bodies.rest_box[body, 3 + column]
            bodies.box[body, row], bodies.box[body, 3 + row] = middle[row] - half, middle[row] + half
    left = 0
    for body in range(count):
        reach = (CONTACT_BAND + TRUSTED_MOTION) * bodies.size[body] + bodies.motion[body]
        is_outside = False
        for axis in ti.static(range(3)):
            is_outside |= bodies.box[body, axis] - reach < outer[body, axis]
            is_outside |= bodies.box[body, 3 + axis] + reach > outer[body, 3 + axis]
        if is_outside:
            left += 1
    return left


@func
def is_near(first: ti.i32, second: ti.i32, wall: ti.i32, bodies: Bodies, walls: Rows) -> bool:
    """Whether the boxes of two bodies, or that of one and a wall that it is before, are within their margin."""
    apart, may = -ti.cast(FAR, ti.f64), True
    if wall < 0:
        for axis in ti.static(range(3)):
            apart = ti.max(apart, bodies.box[first, axis] - bodies.box[second, 3 + axis])
            apart = ti.max(apart, bodies.box[second, axis] - bodies.box[first, 3 + axis])
    else:
        for axis in ti.static(range(3)):
            if ti.cast(walls[wall, 0], ti.i32) == axis:
                side, offset = walls[wall, 1], walls[wall, 2]
                apart = ti.select(side > 0.0, bodies.box[first, axis] - offset, offset - bodies.box[first, 3 + axis])
                may = side * (bodies.pose[first, axis] - offset) > 0.0  # a body that left by an open face falls on
    return may and apart <= margin_of(first, second, bodies)


@kernel
def choose_pairs(count: ti.i32, bodies: Bodies, near: Near, walls: Rows) -> ti.i32:
    """What happens to the contacts of each of so many pairs; how many are to be examined.

    Those of no active body stay, those that are no longer near go, and those that moved too far are looked at again.
    """
    for pair in range(count):
        first, second = near.pairs[pair, 0], near.pairs[pair, 1]
        budget = near.budget[pair] - bodies.moved[first] - bodies.moved[second]
        action = ti.select(budget > -0.5 * FAR, KEPT, DROPPED)
        if bodies.is_active[first] == 1 or bodies.is_active[second] == 1:
            if not is_near(first, second, near.pairs[pair, 2], bodies, walls):
                action, budget = DROPPED, -ti.cast(FAR, ti.f64)
            elif bodies.motion[first] + bodies.motion[second] > budget:
                action = EXAMINED
        near.budget[pair], near.action[pair] = budget, action
        near.numbers[pair] = ti.cast(action == EXAMINED, ti.i32)
    total = scan_in_parallel(near.numbers, count, near.sums, near.place)
    for pair in range(count):
        if near.action[pair] == EXAMINED:
            near.tasks[near.place[pair]] = pair
    return total


@kernel
def count_contacts(count: ti.i32, bodies: Bodies, near: Near, found: Found, before: Kept, kept: Kept) -> ti.i32:
    """Where the contacts of each of so many pairs will stand, and how many there are of all."""
    for pair in range(count):
        number, old = 0, near.before[pair]
        if near.action[pair] == EXAMINED:
            task = near.place[pair]
            smaller = ti.min(bodies.size[near.pairs[pair, 0]], bodies.size[near.pairs[pair, 1]])
            number, near.budget[pair] = found.counts[task], found.clearances[task] - CONTACT_BAND * smaller
        elif near.action[pair] == KEPT and old >= 0:
            number = before.starts[old + 1] - before.starts[old]
        near.numbers[pair] = number
    return scan_in_parallel(near.numbers, count, near.sums, kept.starts)


@ti.func
def copy_contact(row: ti.i32, kept: ti.template(), source: ti.i32, known: ti.template()):
    """What a contact is, from a row of `Found` or `Kept`."""
    for column in ti.static(range(2)):
        kept.features[row, column] = known.features[source, column]
    for column in ti.static(range(6)):
        kept.planes[row, column] = known.planes[source, column]
    for column in ti.static(range(4)):
        kept.balls[row, column] = known.balls[source, column]


@kernel
def place_contacts(
    count: ti.i32, bodies: Bodies, near: Near, found: Found, before: Kept, kept: Kept, placed: Placed
) -> ti.i64:
    """Put the contacts of so many pairs in their places, with their forces if they were there, and find where they are.

    Only what `kept` has of `starts` is read, the rest is written, as `placed` is. Returns the deepest overlap [nm].
    """
    deepest = ti.cast(0, ti.i64)
    for pair in range(count):
        first, second, old = near.pairs[pair, 0], near.pairs[pair, 1], near.before[pair]
        is_examined = near.action[pair] == EXAMINED
        depth = ti.cast(0.0, ti.f64)
        for row in range(kept.starts[pair], kept.starts[pair + 1]):
            number = row - kept.starts[pair]
            if is_examined:
                source = near.place[pair] * MOST_KEPT + number
                known = is_known(pair, found.features[source, 0], found.features[source, 1], near, before)
                copy_contact(row, kept, source, found)
                for column in ti.static(range(3)):
                    kept.forces[row, column] = 0.0
                    if known >= 0:
                        kept.forces[row, column] = before.forces[known, column]
            else:
                source = before.starts[old] + number
                copy_contact(row, kept, source, before)
                for column in ti.static(range(3)):
                    kept.forces[row, column] = before.forces[source, column]
            side = kept.features[row, 0]
            owner, other = ti.select(side == 0, first, second), ti.select(side == 0, second, first)
            outward = turned(bodies.pose, other, vector_at(kept.planes, row, 3))
            anchor = turned(bodies.pose, other, vector_at(kept.planes, row, 0)) + vector_at(bodies.pose, other, 0)
            centre = turned(bodies.pose, owner, vector_at(kept.balls, row, 0)) + vector_at(bodies.pose, owner, 0)
            placed.bodies[row, 0], placed.bodies[row, 1] = first, second
            gap = outward.dot(centre - anchor) - kept.balls[row, 3]
            placed.gap[row] = gap
            if bodies.is_active[first] == 1 or bodies.is_active[second] == 1:
                depth = ti.max(depth, -gap)
            for axis in ti.static(range(3)):
                placed.point[row, axis] = centre[axis] - kept.balls[row, 3] * outward[axis]
                placed.normal[row, axis] = ti.select(side == 0, outward[axis], -outward[axis])
        if depth > 0.0:
            ti.atomic_max(deepest, ti.cast(ti.min(1.0e9 * depth, 1.0e18), ti.i64))
    return deepest


@kernel_of_host_arrays
def overlapping_boxes(
    boxes: Rows,
    axis: ti.i32,
    order: Whole,
    moves: Whole,
    room: ti.i32,
    starts: Whole,
    numbers: Whole,
    pairs: WholeRows,
):
    """Count for each place in the order of lower corners the boxes it overlaps, and write the first `room` of them.

    Of two the one that comes first in order has the pair. One of both moves.
    """
    for place in range(order.shape[0]):
        one, count, other_place = order[place], 0, place + 1
        while other_place < order.shape[0]:
            two = order[other_place]
            if boxes[two, axis] > boxes[one, 3 + axis]:
                break
            overlap = moves[one] == 1 or moves[two] == 1
            for side in ti.static(range(3)):
                overlap &= boxes[one, side] <= boxes[two, 3 + side] and boxes[two, side] <= boxes[one, 3 + side]
            if overlap:
                if count < room:
                    pairs[starts[place] + count, 0] = ti.min(one, two)
                    pairs[starts[place] + count, 1] = ti.max(one, two)
                count += 1
            other_place += 1
        numbers[place] = count
