"""Contacts of pairs of bodies that are near: the balls of each against the distance of the other, reduced to few."""

import math
from typing import NamedTuple

import taichi as ti

from sim.core.bundles import bundle, func
from sim.core.launch import kernel_of_host_arrays
from sim.rigid.contact_kernels import tangents_of
from sim.rigid.contacts import BODY_BITS, FEATURE_BITS, KEPT_BONUS, MOST_PATCHES, SAME_PATCH, WALL_BITS

Numbers = ti.types.ndarray(dtype=ti.f64, ndim=1)
Rows = ti.types.ndarray(dtype=ti.f64, ndim=2)
Whole = ti.types.ndarray(dtype=ti.i32, ndim=1)
WholeRows = ti.types.ndarray(dtype=ti.i32, ndim=2)
Keys = ti.types.ndarray(dtype=ti.i64, ndim=1)
Distances = ti.types.ndarray(dtype=ti.f32, ndim=1)
Vector3 = ti.types.vector(3, ti.f64)
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
FAR = 1.0e30  # more than any length, and a number in float32, as kernels read it
_HALF_CELL_DIAGONAL = 0.87  # by which grids err at most, in cells


@bundle
class Shapes(NamedTuple):
    """Shapes of bodies, each once."""

    whole: WholeRows  # whole numbers, by the columns above, (s, 11)
    sizes: Rows  # other numbers, likewise, (s, 19)
    balls: Rows  # centre, radius, axis, cone of the balls of all shapes, (m, 8)
    clusters: Rows  # centre and radius of each `BALLS_PER_CLUSTER` of them, (c, 4)
    values: Distances  # distances at the nodes of all grids [m]
    edges: Rows  # start and extent of the edges of all profiles, (e, 4)


@bundle
class Bodies(NamedTuple):
    """Where bodies are."""

    pose: Rows  # position and rotation, row by row, (b, 12)
    shape: Whole  # number of the shape, (b,)


@bundle
class Tasks(NamedTuple):
    """Pairs to be looked at."""

    pairs: WholeRows  # first and second body, the wall that stands for the second or -1, whose balls: 1, 2, 3 both
    margins: Numbers  # gap up to which contacts are looked for [m], (t,)


@bundle
class Found(NamedTuple):
    """Contacts of the pairs."""

    counts: Whole  # of each pair, (t,)
    features: WholeRows  # side and number of the ball of each, (t MOST_KEPT, 2)
    planes: Rows  # anchor [m] and normal in the other's frame, (t MOST_KEPT, 6)
    heights: Numbers  # of the centre of the ball above its plane [m], (t MOST_KEPT,)
    clearances: Numbers  # up to which gap they are all of the pair [m]: its margin or more, (t,)


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


@ti.func
def key_of(first: ti.i32, second: ti.i32, side: ti.i32, feature: ti.i32) -> ti.i64:
    """As `AnchoredContacts.keys`."""
    pair = (ti.cast(first, ti.i64) << BODY_BITS) | second
    return (pair << (FEATURE_BITS + 1)) | (ti.cast(side, ti.i64) << FEATURE_BITS) | feature


@ti.func
def is_among(key: ti.i64, keys: Keys) -> bool:
    """Whether a key is among ascending ones; the first of them is none."""
    low, high = 0, keys.shape[0] - 1
    while low < high:
        middle = (low + high + 1) // 2
        if keys[middle] <= key:
            low = middle
        else:
            high = middle - 1
    return keys[low] == key


@ti.func
def choose_of_patch(
    begin: ti.i32, end: ti.i32, deepest: ti.i32, first: ti.i32, second: ti.i32, margin: ti.f64, last: Keys, work: Rows
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
            key = key_of(first, second, ti.cast(work[c, 15], ti.i32), ti.cast(work[c, 16], ti.i32))
            bonus = ti.select(is_among(key, last), KEPT_BONUS * extent, 0.0)
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
    first: ti.i32,
    second: ti.i32,
    margin: ti.f64,
    last: Keys,
    work: Rows,
    found: Found,
):
    """Note a few of the candidates of a pair: patches of like normals, deepest first, few of each."""
    kept = 0
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
                choose_of_patch(begin, end, deepest, first, second, margin, last, work)
            for c in range(begin, end):
                use = work[c, 17]
                if use >= IN_PATCH:
                    work[c, 17] = DONE
                    row = task * MOST_KEPT + kept
                    found.features[row, 0] = ti.cast(work[c, 15], ti.i32)
                    found.features[row, 1] = ti.cast(work[c, 16], ti.i32)
                    found.heights[row] = work[c, 6]
                    for i in ti.static(range(3)):
                        found.planes[row, i] = work[c, i] - work[c, 6] * work[c, 3 + i]
                        found.planes[row, 3 + i] = work[c, 3 + i]
                    kept += 1
    found.counts[task] = kept


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


@kernel_of_host_arrays
def find_contacts(
    tasks: Tasks,
    bodies: Bodies,
    walls: Rows,
    last: Keys,
    shapes: Shapes,
    room: ti.i32,
    blocks: ti.i32,
    run: ti.i32,
    work: Rows,
    found: Found,
):
    """Contacts of each pair by the balls of each against the distance of the other.

    Args:
        tasks: the pairs.
        bodies: where they are.
        walls: axis, side, offset, corners of the rectangle on the two other axes, (w, 7).
        last: ascending keys of the contacts of the last step, -1 first.
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
        task = ti.select(item % run == 0, block, found.counts.shape[0])
        while task < found.counts.shape[0]:
            first, second, wall, sides = (
                tasks.pairs[task, 0],
                tasks.pairs[task, 1],
                tasks.pairs[task, 2],
                tasks.pairs[task, 3],
            )
            margin, end = tasks.margins[task], begin
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
            keep_few(begin, end, task, first, second, margin, last, work, found)
            task += blocks
