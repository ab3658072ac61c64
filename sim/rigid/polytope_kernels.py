"""Contacts of rounded convex polytopes with each other and with walls.

The distance of two is found by Gilbert, Johnson & Keerthi's algorithm (1988), as if edges were sharp; where these
overlap, which takes twice the radius by which they are rounded, by the face that they are least behind of. Faces that
lie on each other are clipped by each other.
"""

from typing import NamedTuple

import taichi as ti

from sim.core.bundles import bundle, func
from sim.core.launch import kernel
from sim.rigid.array_types import Numbers, Rows, Vector3, Whole, WholeRows
from sim.rigid.collision_kernels import (
    FAR,
    MOST_KEPT,
    Bodies,
    Found,
    Kept,
    Near,
    add_candidate,
    beside_wall,
    keep_few,
    margin_of,
    turned,
    turned_back,
    vector_at,
)
from sim.rigid.contacts import FEATURE_BITS, WALL_BITS

FIRST_VERTEX, VERTICES, FIRST_FACE, FACES = range(4)
"""Columns of the whole numbers of a polytope."""
MOST_STEPS = 40  # of the search for the distance
CONVERGED = 1.0e-13  # of the square of the distance: by how much its bounds still differ
OVERLAP = 1.0e-14  # square of a distance, in that of the centres, below which sharp polytopes overlap
SAME_GAP = 1.0e-6  # of the radius: gaps that differ by less are those of one point
FLUSH = 1.0e-2  # of the radius: corners that are less far beyond an edge are not cut off
SUBSETS = ((0, 0, 0), (0, 0, 0), (1, 0, 0), (0, 1, 0), (2, 0, 0), (0, 2, 0), (1, 2, 0), (0, 1, 2))
"""Members of the subsets of three, by the bits of the number of each, followed by anything."""
VERTEX_BITS = 10
NEAREST = ((1 << (FEATURE_BITS - WALL_BITS - VERTEX_BITS - 1)) - 1) << (VERTEX_BITS + 1)
"""Feature of the nearest points of two polytopes; others are vertices, or cut by the edge of a face."""


@bundle
class Polytopes(NamedTuple):
    """Shapes that are polytopes, each once; others have no vertices, and balls have one, and no faces."""

    whole: WholeRows  # whole numbers, by the columns above, (s, 4)
    radii: Numbers  # by which they are rounded [m], (s,)
    vertices: Rows  # of all [m], (v, 3)
    planes: Rows  # normal and offset of each face, (f, 4)
    loops: WholeRows  # first corner of each face, and how many it has, (f, 2)
    corners: Whole  # vertices of the faces, (c,)


@func
def support(direction: Vector3, shape: ti.i32, polytopes: Polytopes) -> ti.i32:
    """The row of the vertex that is farthest in a direction, both in the frame of the body."""
    first = polytopes.whole[shape, FIRST_VERTEX]
    best, most = first, -ti.cast(FAR, ti.f64)
    for row in range(first, first + polytopes.whole[shape, VERTICES]):
        along = direction.dot(vector_at(polytopes.vertices, row, 0))
        if along > most:
            best, most = row, along
    return best


@func
def farthest(direction: Vector3, body: ti.i32, bodies: Bodies, polytopes: Polytopes) -> Vector3:
    """The vertex of a body that is farthest in a direction, both in the world."""
    row = support(turned_back(bodies.pose, body, direction), bodies.shape[body], polytopes)
    return turned(bodies.pose, body, vector_at(polytopes.vertices, row, 0)) + vector_at(bodies.pose, body, 0)


@func
def nearest_face(direction: Vector3, body: ti.i32, bodies: Bodies, polytopes: Polytopes):
    """The row of the face of a body whose normal is nearest to a direction in the world, and the cosine."""
    within, shape = turned_back(bodies.pose, body, direction), bodies.shape[body]
    first = polytopes.whole[shape, FIRST_FACE]
    best, most = first, -ti.cast(FAR, ti.f64)
    for row in range(first, first + polytopes.whole[shape, FACES]):
        along = within.dot(vector_at(polytopes.planes, row, 0))
        if along > most:
            best, most = row, along
    return best, most


@func
def least_behind(one: ti.i32, two: ti.i32, bodies: Bodies, polytopes: Polytopes):
    """Normal in the world of the face of a body that another is least far behind of, and how far before it that is."""
    shape = bodies.shape[one]
    first = polytopes.whole[shape, FIRST_FACE]
    normal, most = Vector3(0.0), -ti.cast(FAR, ti.f64)
    for row in range(first, first + polytopes.whole[shape, FACES]):
        outward = turned(bodies.pose, one, vector_at(polytopes.planes, row, 0))
        away = farthest(-outward, two, bodies, polytopes) - vector_at(bodies.pose, one, 0)
        before = outward.dot(away) - polytopes.planes[row, 3]
        if before > most:
            normal, most = outward, before
    return normal, most


@ti.func
def row_at(rows: ti.template(), row: ti.template()) -> Vector3:
    """A row of a matrix of three columns."""
    return Vector3(rows[row, 0], rows[row, 1], rows[row, 2])


@ti.func
def nearest_of_simplex(points: ti.template(), last: Vector3, count: ti.i32):
    """Weights of the point nearest to the origin of a simplex, one point of which belongs to it; and its distance².

    Of all subsets of so many points, which are three at most, and the last one, the nearest whose weights are positive;
    weights are those of the points.
    """
    weights, least = Vector3(0.0), ti.cast(FAR, ti.f64)
    for subset in ti.static(range(8)):
        if subset < 1 << count:
            e = row_at(points, ti.static(SUBSETS[subset][0])) - last
            f = row_at(points, ti.static(SUBSETS[subset][1])) - last
            g = row_at(points, ti.static(SUBSETS[subset][2])) - last
            s, t, u, holds = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64), True
            size = ti.static(bin(subset).count("1"))
            if ti.static(size == 1):
                s = -last.dot(e) / e.dot(e)
            elif ti.static(size == 2):
                ee, ef, ff, le, lf = e.dot(e), e.dot(f), f.dot(f), last.dot(e), last.dot(f)
                determinant = ee * ff - ef * ef
                holds = determinant > 1.0e-14 * ee * ff
                determinant = ti.select(holds, determinant, 1.0)
                s, t = (ef * lf - ff * le) / determinant, (ef * le - ee * lf) / determinant
            elif ti.static(size == 3):
                determinant = e.dot(f.cross(g))
                holds = ti.abs(determinant) > 1.0e-14 * e.norm() * f.norm() * g.norm()
                determinant = ti.select(holds, determinant, 1.0)
                s = -last.dot(f.cross(g)) / determinant
                t, u = -e.dot(last.cross(g)) / determinant, -e.dot(f.cross(last)) / determinant
            if holds and s >= 0.0 and t >= 0.0 and u >= 0.0 and s + t + u <= 1.0:
                nearest = last + s * e + t * f + u * g
                square = ti.cast(0.0, ti.f64) if ti.static(size == 3) else nearest.dot(nearest)
                if square < least:
                    least, weights = square, Vector3(0.0)
                    if ti.static(size > 0):
                        weights[ti.static(SUBSETS[subset][0])] = s
                    if ti.static(size > 1):
                        weights[ti.static(SUBSETS[subset][1])] = t
                    if ti.static(size > 2):
                        weights[ti.static(SUBSETS[subset][2])] = u
    return weights, least


@ti.func
def put_row(rows: ti.template(), place: ti.i32, row: Vector3):
    """Put a row into a matrix of three columns."""
    for each in ti.static(range(3)):
        if each == place:
            for axis in ti.static(range(3)):
                rows[each, axis] = row[axis]


@func
def nearest_points(first: ti.i32, second: ti.i32, within: ti.f64, bodies: Bodies, polytopes: Polytopes):
    """The way from the nearest point of one body to that of another, and that one, without their radii.

    Returns:
        a distance that they have at least, beyond the one that is asked for, or 0; the way (0 where they overlap); the
        point of the second body.
    """
    way = vector_at(bodies.pose, first, 0) - vector_at(bodies.pose, second, 0)
    scale = way.dot(way)
    # Points of the difference of both, and the second body's part of them.
    simplex, on_second = ti.Matrix.zero(ti.f64, 3, 3), ti.Matrix.zero(ti.f64, 3, 3)
    count, square, apart, point = 0, ti.cast(FAR, ti.f64), ti.cast(0.0, ti.f64), Vector3(0.0)
    for _ in range(MOST_STEPS):
        there = farthest(way, second, bodies, polytopes)
        added = farthest(-way, first, bodies, polytopes) - there
        along = way.dot(added)
        if along > 0.0 and along * along > within * within * way.dot(way):
            apart = along / way.norm()
            break
        if count > 0 and square - along <= CONVERGED * square:
            break
        is_known = False
        for j in ti.static(range(3)):
            if j < count and simplex[j, 0] == added[0] and simplex[j, 1] == added[1] and simplex[j, 2] == added[2]:
                is_known = True
        if is_known:
            break
        weights, least = nearest_of_simplex(simplex, added, count)
        if least >= square:
            break
        square = least
        if square <= OVERLAP * scale:
            way = Vector3(0.0)
            break
        share = 1.0 - weights.sum()
        way, point, kept = share * added, share * there, 0
        for j in ti.static(range(3)):
            if weights[j] > 0.0:
                own, of_second = row_at(simplex, j), row_at(on_second, j)
                way += weights[j] * own
                point += weights[j] * of_second
                put_row(simplex, kept, own)
                put_row(on_second, kept, of_second)
                kept += 1
        if share > 0.0:
            put_row(simplex, kept, added)
            put_row(on_second, kept, there)
            kept += 1
        count = kept
    return apart, way, point


@func
def clip_faces(
    begin: ti.i32,
    room: ti.i32,
    own: ti.i32,
    other: ti.i32,
    own_face: ti.i32,
    face: ti.i32,
    bodies: Bodies,
    polytopes: Polytopes,
    work: Rows,
):
    """Cut a face of a body by the sides of one of another (Sutherland & Hodgman 1974).

    Returns the row of the first corner of what is left, and how many there are: places in the other's frame, features.
    """
    there, count = begin + room, polytopes.loops[own_face, 1]
    first_vertex = polytopes.whole[bodies.shape[own], FIRST_VERTEX]
    for corner in range(count):
        vertex = polytopes.corners[polytopes.loops[own_face, 0] + corner]
        place = turned(bodies.pose, own, vector_at(polytopes.vertices, first_vertex + vertex, 0))
        place = turned_back(
            bodies.pose, other, place + vector_at(bodies.pose, own, 0) - vector_at(bodies.pose, other, 0)
        )
        for axis in ti.static(range(3)):
            work[there + corner, axis] = place[axis]
        work[there + corner, 3] = vertex
    begin_of_corners, sides = polytopes.loops[face, 0], polytopes.loops[face, 1]
    first_there = polytopes.whole[bodies.shape[other], FIRST_VERTEX]
    normal = vector_at(polytopes.planes, face, 0)
    first_corner_of_body = polytopes.loops[polytopes.whole[bodies.shape[other], FIRST_FACE], 0]
    for side in range(sides):
        before = polytopes.corners[begin_of_corners + side]
        following = polytopes.corners[begin_of_corners + (side + 1) % sides]
        start = vector_at(polytopes.vertices, first_there + before, 0)
        inward = normal.cross(vector_at(polytopes.vertices, first_there + following, 0) - start)
        slack = FLUSH * polytopes.radii[bodies.shape[other]] * inward.norm()
        edge = begin_of_corners - first_corner_of_body + side
        source, there = there, begin + room + ti.select(there == begin + room, room, 0)
        left = 0
        for corner in range(count):
            here, after = source + corner, source + (corner + 1) % count
            depth = inward.dot(vector_at(work, here, 0) - start)
            depth_after = inward.dot(vector_at(work, after, 0) - start)
            if depth >= -slack:
                for column in ti.static(range(4)):
                    work[there + left, column] = work[here, column]
                left += 1
            if (depth >= -slack) != (depth_after >= -slack):
                share = ti.math.clamp(depth / (depth - depth_after), 0.0, 1.0)
                for axis in ti.static(range(3)):
                    work[there + left, axis] = work[here, axis] + share * (work[after, axis] - work[here, axis])
                vertex = ti.cast(work[here, 3], ti.i32) & ((1 << VERTEX_BITS) - 1)
                leaves = ti.select(depth >= -slack, 1, 0)
                work[there + left, 3] = ((1 + edge) << (VERTEX_BITS + 1)) + (leaves << VERTEX_BITS) + vertex
                left += 1
        count = left
    return there, count


@func
def candidates_of_pair(
    begin: ti.i32,
    room: ti.i32,
    first: ti.i32,
    second: ti.i32,
    margin: ti.f64,
    bodies: Bodies,
    polytopes: Polytopes,
    work: Rows,
    task: ti.i32,
    found: Found,
) -> ti.i32:
    """Note where two polytopes are near, or how far they are apart; returns the row after the last."""
    end = begin
    radius, radius_of_second = polytopes.radii[bodies.shape[first]], polytopes.radii[bodies.shape[second]]
    apart, way, point = nearest_points(first, second, margin + radius + radius_of_second, bodies, polytopes)
    if apart > 0.0:
        found.clearances[task] = apart - radius - radius_of_second
    else:
        distance = way.norm()
        normal = way / ti.max(distance, 1.0e-300)  # from the second to the first
        overlaps = distance == 0.0
        if overlaps:
            behind_first, one = least_behind(first, second, bodies, polytopes)
            behind_second, two = least_behind(second, first, bodies, polytopes)
            normal = behind_second
            if one > two:
                normal = -behind_first
        own_face, cosine_of_first = nearest_face(-normal, first, bodies, polytopes)
        face, cosine_of_second = nearest_face(normal, second, bodies, polytopes)
        side, own, other = 0, first, second  # whose corners meet the other's face
        if cosine_of_first > cosine_of_second + 1.0e-6:
            side, own, other = 1, second, first
            face = own_face
        outward = vector_at(polytopes.planes, face, 0)
        own_radius, other_radius = polytopes.radii[bodies.shape[own]], polytopes.radii[bodies.shape[other]]
        there, count = begin, 0
        if polytopes.whole[bodies.shape[own], FACES] > 0:  # a ball has none
            own_face, _ = nearest_face(-turned(bodies.pose, other, outward), own, bodies, polytopes)
            there, count = clip_faces(begin, room, own, other, own_face, face, bodies, polytopes, work)
        least = ti.cast(FAR, ti.f64)
        for corner in range(there, there + count):
            centre = vector_at(work, corner, 0)
            before = outward.dot(centre) - polytopes.planes[face, 3] - other_radius
            least = ti.min(least, before - own_radius)
            if before - own_radius <= margin:
                feature = ti.cast(work[corner, 3], ti.i32)
                add_candidate(end, side, other, feature, own_radius, centre, outward, before, bodies, work)
                end += 1
        gap = distance - radius - radius_of_second
        if overlaps and end == begin:
            # What is deepest lies beside the face.
            centre = farthest(-turned(bodies.pose, other, outward), own, bodies, polytopes)
            centre = turned_back(bodies.pose, other, centre - vector_at(bodies.pose, other, 0))
            before = outward.dot(centre) - polytopes.planes[face, 3] - other_radius
            add_candidate(end, side, other, NEAREST, own_radius, centre, outward, before, bodies, work)
            end += 1
        elif not overlaps and gap < least - SAME_GAP * radius:
            centre = turned_back(bodies.pose, second, point + way - vector_at(bodies.pose, second, 0))
            outward = turned_back(bodies.pose, second, normal)
            add_candidate(end, 0, second, NEAREST, radius, centre, outward, distance - radius_of_second, bodies, work)
            end += 1
    return end


@func
def candidates_at_wall(
    begin: ti.i32,
    first: ti.i32,
    second: ti.i32,
    wall: ti.i32,
    margin: ti.f64,
    bodies: Bodies,
    walls: Rows,
    polytopes: Polytopes,
    work: Rows,
) -> ti.i32:
    """Note which vertices of a polytope are near a wall, which belongs to the second body; returns the row after."""
    end, shape = begin, bodies.shape[first]
    radius, first_vertex = polytopes.radii[shape], polytopes.whole[shape, FIRST_VERTEX]
    for vertex in range(polytopes.whole[shape, VERTICES]):
        centre = turned(bodies.pose, first, vector_at(polytopes.vertices, first_vertex + vertex, 0))
        centre += vector_at(bodies.pose, first, 0)
        is_beside, outward, distance = beside_wall(centre, wall, walls)
        if is_beside and distance - radius <= margin:
            feature = vertex + (wall << (FEATURE_BITS - WALL_BITS))
            add_candidate(end, 0, second, feature, radius, centre, outward, distance, bodies, work)
            end += 1
    return end


@kernel
def find_polytope_contacts(
    count: ti.i32,
    bodies: Bodies,
    near: Near,
    kept: Kept,
    walls: Rows,
    polytopes: Polytopes,
    room: ti.i32,
    blocks: ti.i32,
    run: ti.i32,
    work: Rows,
    found: Found,
):
    """Contacts of pairs of polytopes, whose `sides` are 0; arguments as those of `find_contacts`.

    Args:
        room: of candidates, and of corners of a face that is cut: a third of the rows of a block.
    """
    for item in range(blocks * run):
        block = item // run
        begin = 3 * room * block
        task = ti.select(item % run == 0, block, count)
        while task < count:
            pair = near.tasks[task]
            if near.pairs[pair, 3] == 0:
                first, second, wall = near.pairs[pair, 0], near.pairs[pair, 1], near.pairs[pair, 2]
                margin, end = margin_of(first, second, bodies), begin
                found.clearances[task] = margin
                if wall >= 0:
                    end = candidates_at_wall(begin, first, second, wall, margin, bodies, walls, polytopes, work)
                else:
                    end = candidates_of_pair(begin, room, first, second, margin, bodies, polytopes, work, task, found)
                keep_few(begin, end, task, margin, near, kept, work, found)
                for row in range(task * MOST_KEPT, task * MOST_KEPT + found.counts[task]):
                    own, other = first, second
                    if found.features[row, 0] == 1:
                        own, other = second, first
                    centre = vector_at(found.planes, row, 0) + found.heights[row] * vector_at(found.planes, row, 3)
                    centre = turned(bodies.pose, other, centre) + vector_at(bodies.pose, other, 0)
                    centre = turned_back(bodies.pose, own, centre - vector_at(bodies.pose, own, 0))
                    for axis in ti.static(range(3)):
                        found.balls[row, axis] = centre[axis]
                    found.balls[row, 3] = polytopes.radii[bodies.shape[own]]
            task += blocks
