"""Kernels of patches: where they are, how they move, and which of them may meet."""

import taichi as ti

from sim.arrays import Floats, Integers, Vectors
from sim.cloth.self_collision_kernels import NEVER, SAFETY_OF_DUE, Pairs
from sim.launch import fast_launch
from sim.reductions import Results, reduced, runs_on_gpu
from sim.work_sharing import begin_sharing, next_item

FAR = 1.0e30

SAFETY = 1.0e-5
"""Part of the motion of two patches against each other that is added to it: norms and sums of float32 lose some 1e-7.

Residuals of the fit lose some 2e-7 of the whole displacement besides, nanometres in a substep. That needs no term: what
is not listed is still a whole thickness apart when a list runs out, so that contacts begin later by that, and nothing
has met unseen. What positions do besides their displacements, as they are rounded, is measured.
"""

REGULARIZATION = 1.0e-5
"""Part of the inertia of a patch that is added to it, so that it has an inverse."""

PATCHES_AT_A_TIME, PAIRS_AT_A_TIME, LANES_AT_A_TIME = 16, 256, 4
"""Patches, pairs of them, and lanes of a reduction over them that a thread takes at a time."""

WIDENED = 1.25
"""Contacts may push so many times as far as in the substep before without patches being looked at anew."""

SKIN_IN_MOTIONS = 2.0
"""Least skin in motions of the substep, so that a list lasts for some."""


@fast_launch
@ti.kernel
def look_at_patches(
    vertex_count: ti.i32, workers: ti.i32, taken: Integers, items: ti.i32, lane_step: ti.i32, item_step: ti.i32,
    still: ti.f32,
    position: Vectors, displacement: Vectors, expected: Vectors,
    count: ti.i32, patch_items: ti.i32, patch_step: ti.i32, first_corner: Integers, corners: Integers,
    low: Vectors, high: Vectors, centre: Vectors, shift: Vectors, turn: Vectors, radius: Floats, rest: Floats,
    motion: Floats, more: Floats, spent: Floats, reach: Floats, way: Floats, partial: Floats, lanes: ti.i32,
    nodes: Floats, is_short: ti.template(),
) -> Results:  # fmt: skip
    """Where patches are, and how they move in this substep.

    A rigid motion c + w x (x - centre) is fitted to the displacements of each patch, by least squares. `rest` gets the
    largest displacement that is left of it [m], `radius` the largest distance from the centre [m]. The fit decides how
    small the rest is, not whether it is a bound. `motion` gets how far vertices get from the middle of all
    displacements at most [m], `way` that with what it has spent and what contacts may add.

    Returns the largest components of displacements [m], then those of their negatives; how far a vertex is at most from
    where its last displacement should have led it; and how far the motion of a patch, with what was spent before
    and may come besides, passes the reach of the list of pairs of patches at most.
    """
    workers_end = workers
    if ti.static(is_short):
        ti.loop_config(serialize=True)
    for lane in range(lanes):
        most, least, off = ti.math.vec3(-FAR), ti.math.vec3(FAR), 0.0
        for k in range(items):
            i = lane * lane_step + k * item_step
            if i < vertex_count:
                u = displacement[i]
                most, least = ti.max(most, u), ti.min(least, u)
                off = ti.max(off, (position[i] - expected[i]).norm_sqr())
        for axis in ti.static(range(3)):
            partial[axis * lanes + lane], partial[(3 + axis) * lanes + lane] = most[axis], -least[axis]
        partial[6 * lanes + lane] = off
    ends = reduced(partial, lanes, 7, 7, nodes)
    middle = 0.5 * ti.math.vec3(ends[0] - ends[3], ends[1] - ends[4], ends[2] - ends[5])
    astray = ti.sqrt(ends[6])
    begin_sharing(taken, 0)
    for worker in range(workers_end):
        lane = next_item(-1, worker, taken, 0, LANES_AT_A_TIME)
        while lane < lanes:
            beyond = -FAR
            for k in range(patch_items):
                m = lane * patch_step + k * item_step
                if m < count:
                    fit_motion(
                        m, still, first_corner, corners, position, displacement, low, high, centre, shift, turn, radius,
                        rest,
                    )  # fmt: skip
                    motion[m] = (1.0 + SAFETY) * ((shift[m] - middle).norm() + turn[m].norm() * radius[m] + rest[m])
                    way[m] = spent[m] + astray + motion[m] + more[m]
                    beyond = ti.max(beyond, way[m] - reach[m])
            partial[lane] = beyond
            lane = next_item(lane, worker, taken, 0, LANES_AT_A_TIME)
    worst = reduced(partial, lanes, 1, 1, nodes)
    return Results(ends[0], ends[1], ends[2], ends[3], ends[4], ends[5], astray, worst[0])


@ti.func
def fit_motion(
    m: ti.i32, still: ti.f32, first_corner: Integers, corners: Integers, position: Vectors, displacement: Vectors,
    low: Vectors, high: Vectors, centre: Vectors, shift: Vectors, turn: Vectors, radius: Floats, rest: Floats,
):  # fmt: skip
    """The box and the motion of a patch; displacements within `still` [m] of each other are not fitted any closer."""
    first, last = first_corner[m], first_corner[m + 1]
    origin, u_first = position[corners[first]], displacement[corners[first]]
    least, most, u_least, u_most = origin, origin, u_first, u_first
    # Sums about the first corner: what is subtracted for the mean is of their own size.
    r_sum, u_sum, moment = ti.math.vec3(0.0), ti.math.vec3(0.0), ti.math.vec3(0.0)
    squares, products = ti.math.vec3(0.0), ti.math.vec3(0.0)
    for place in range(first, last):
        i = corners[place]
        x, u = position[i], displacement[i]
        least, most = ti.min(least, x), ti.max(most, x)
        u_least, u_most = ti.min(u_least, u), ti.max(u_most, u)
        r, v = x - origin, u - u_first
        r_sum, u_sum, moment = r_sum + r, u_sum + v, moment + r.cross(v)
        squares, products = squares + r * r, products + r * r.yzx
    low[m], high[m] = least, most
    x_0, u_0, w = 0.5 * (least + most), 0.5 * (u_least + u_most), ti.math.vec3(0.0)
    left, largest = (0.5 * (u_most - u_least)).norm_sqr(), (0.5 * (most - least)).norm_sqr()
    if left > still * still:
        share = 1.0 / ti.cast(last - first, ti.f32)
        x_0, u_0 = origin + share * r_sum, u_first + share * u_sum
        moment -= share * r_sum.cross(u_sum)
        squares, products = squares - share * r_sum * r_sum, products - share * r_sum * r_sum.yzx
        # Regularized: corners on a line say nothing about turns around it.
        more = (1.0 + REGULARIZATION) * squares.sum() + 1.0e-30
        xx, yy, zz, xy, yz, xz = squares.x, squares.y, squares.z, products.x, products.y, products.z
        inertia = ti.math.mat3(more - xx, -xy, -xz, -xy, more - yy, -yz, -xz, -yz, more - zz)
        w = inertia.inverse() @ moment
        left, largest = 0.0, 0.0
        for place in range(first, last):
            i = corners[place]
            r = position[i] - x_0
            left = ti.max(left, (displacement[i] - u_0 - w.cross(r)).norm_sqr())
            largest = ti.max(largest, r.norm_sqr())
    centre[m], shift[m], turn[m], radius[m], rest[m] = x_0, u_0, w, ti.sqrt(largest), ti.sqrt(left)


@fast_launch
@ti.kernel
def place_leaves(
    count: ti.i32, leaves: ti.i32, low: Vectors, high: Vectors, motion: Floats, change: Floats, more: Floats,
    fewest: ti.f32, most: ti.f32, enough: ti.f32, least: ti.f32, half_thickness: ti.f32, reach: Floats, spent: Floats,
    tree_low: Vectors, tree_high: Vectors,
):  # fmt: skip
    """Leaves of a complete binary tree: boxes around the patches, then empty ones; leaf k is node `leaves` + k.

    Boxes are larger than the patches by half a thickness and by as much as these may move, their `reach`: in `fewest`
    to `most` substeps like this one, as many as take them `enough` [m], and by `least` [m] besides.
    """
    for leaf in range(leaves):
        lowest, highest = ti.math.vec3(FAR), ti.math.vec3(-FAR)
        if leaf < count:
            spent[leaf] = 0.0
            moves = motion[leaf] + change[leaf]
            reach[leaf] = ti.math.clamp(enough, fewest * moves, most * moves) + least + more[leaf]
            lowest = low[leaf] - reach[leaf] - half_thickness
            highest = high[leaf] + reach[leaf] + half_thickness
        tree_low[leaves + leaf], tree_high[leaves + leaf] = lowest, highest


@fast_launch
@ti.kernel
def merge_boxes(first: ti.i32, tree_low: Vectors, tree_high: Vectors):
    """Boxes of a level, of the nodes `first` to 2 `first` - 1: 2 k and 2 k + 1 are below k, and 1 is the root.

    On a CPU serial: half a million nodes of cloth have 65,000 patches, whose level takes 0.2 ms now and then.
    """
    if ti.static(not runs_on_gpu()):
        ti.loop_config(serialize=True)
    for node in range(first, 2 * first):
        tree_low[node] = ti.min(tree_low[2 * node], tree_low[2 * node + 1])
        tree_high[node] = ti.max(tree_high[2 * node], tree_high[2 * node + 1])


@fast_launch
@ti.kernel
def sort_known(
    count: ti.i32, pairs: Pairs, slack: Floats, patch_count: ti.i32, first: Integers, known: Integers,
    counter: Integers,
):  # fmt: skip
    """List the pairs of patches of whose elements something is known, `slack` being positive, by their first patch.

    Numbers of the pairs of patch m are `known` from `first[2 m]` to `first[2 m + 1]`.
    """
    pairs_end, patches_end = count, patch_count
    counter[0] = 0
    for m in range(patches_end):
        first[2 * m], first[2 * m + 1] = 0, 0
    for p in range(pairs_end):
        if slack[p] > 0.0:
            ti.atomic_add(first[2 * pairs[p][0] + 1], 1)
    for m in range(patches_end):
        start = ti.atomic_add(counter[0], first[2 * m + 1])
        first[2 * m], first[2 * m + 1] = start, start
    for p in range(pairs_end):
        if slack[p] > 0.0:
            known[ti.atomic_add(first[2 * pairs[p][0] + 1], 1)] = p


@fast_launch
@ti.kernel
def pair_patches(
    count: ti.i32, workers: ti.i32, taken: Integers, leaves: ti.i32, tree_low: Vectors, tree_high: Vectors,
    cloth: Integers, collides: Integers, first_known: Integers, known: Integers, pairs_before: Pairs,
    slack_before: Floats,
    pairs: Pairs, carried: Integers, wake: Floats, slack: Floats, left: Floats, approach: Floats, allowed: Floats,
    counter: Integers, capacity: ti.i32,
) -> ti.i32:  # fmt: skip
    """List the patches whose boxes in the tree meet, each pair once, and each patch with itself; returns how many
    there are.

    What was known before about a pair holds (`sort_known`): `carried` is its number there, or -1.
    """
    counter[0] = 0
    begin_sharing(taken, 0)
    for worker in range(workers):
        m = next_item(-1, worker, taken, 0, PATCHES_AT_A_TIME)
        while m < count:
            least, most = tree_low[leaves + m], tree_high[leaves + m]
            node = 1
            while node > 0:
                # The last leaf below a node: pairs are listed by the smaller of their numbers.
                last = node
                while last < leaves:
                    last = 2 * last + 1
                is_near = (tree_low[node] <= most).all() and (tree_high[node] >= least).all()
                if is_near and last - leaves >= m and node < leaves:
                    node = 2 * node
                else:
                    other = node - leaves
                    if is_near and other >= m and (cloth[m] != cloth[other] or collides[cloth[m]] == 1):
                        slot = ti.atomic_add(counter[0], 1)
                        if slot < capacity:
                            before = -1
                            for place in range(first_known[2 * m], first_known[2 * m + 1]):
                                if pairs_before[known[place]][1] == other:
                                    before = known[place]
                            pairs[slot], carried[slot] = ti.Vector([m, other]), before
                            wake[slot], left[slot], approach[slot], allowed[slot] = -1.0, FAR, 0.0, 0.0
                            slack[slot] = -1.0
                            if before >= 0:
                                slack[slot] = slack_before[before]
                    # On to the next node that is not below this one; 0 after the last.
                    while node % 2 == 1:
                        node = node // 2
                    node += ti.cast(node > 0, ti.i32)
            m = next_item(m, worker, taken, 0, PATCHES_AT_A_TIME)
    return counter[0]


@ti.func
def gap_of_boxes(m: ti.i32, other: ti.i32, low: Vectors, high: Vectors) -> ti.f32:
    """Distance of two patches' boxes [m]."""
    between = ti.max(low[m] - high[other], low[other] - high[m], 0.0)
    return between.norm()


@ti.func
def approach_of(
    m: ti.i32, other: ti.i32, centre: Vectors, shift: Vectors, turn: Vectors, radius: Floats, rest: Floats
) -> ti.f32:
    """How much nearer points of two patches come at most [m].

    With w and c of the first patch, points P and Q go to P + c + w x P + d and Q + c + w x Q + d', where d and d' are
    what is left. P - Q + w x (P - Q) is never shorter than P - Q, so that distances shrink by |d| + |d'| at most.
    """
    between = centre[other] - centre[m]
    turned = (turn[other] - turn[m]).norm() * radius[other] if m != other else 0.0
    shifted = (shift[other] - shift[m] - turn[m].cross(between)).norm() if m != other else 0.0
    return rest[m] + rest[other] + turned + shifted + SAFETY * (rest[m] + rest[other] + turned + shifted)


@fast_launch
@ti.kernel
def age_pairs(
    count: ti.i32, workers: ti.i32, taken: Integers, pairs: Pairs, low: Vectors, high: Vectors, centre: Vectors,
    shift: Vectors, turn: Vectors, radius: Floats, rest: Floats, motion: Floats, margin: Floats, more: Floats,
    spent: Floats,
    way: Floats, thickness: ti.f32, least_skin: ti.f32, astray: ti.f32, wake: Floats, slack: Floats, left: Floats,
    approach: Floats, allowed: Floats, reach: Floats, first_due: Floats, first_due_of_edges: Floats,
    due: Integers, expired: Integers, needed: Integers, counter: Integers,
) -> ti.math.ivec2:  # fmt: skip
    """List the pairs of patches whose elements have to be searched before this substep, and those of whose elements
    some are due; returns how many there are.

    Pairs far apart sleep until their patches' motion can have closed the gap between their boxes.

    Args:
        motion: how far vertices of a patch get from the middle of all displacements at most [m]; `spent` is the sum of
            the substeps before, `way` all that with `more`.
        margin: how far contacts may displace them beyond that [m]; `more` what of it is beyond half a thickness.
        thickness: the largest [m].
        least_skin: how far beyond to search at least [m].
        astray: how far vertices are from where they were left at most [m].
        wake: what their patches spend until a pair wakes [m].
        slack: how much nearer the elements of a pair may come, that are not listed, and be a thickness apart [m].
        left: what of the slack elements may use up, that are listed, until they are looked at [m]: an element that was
            d apart when the slack was s is due when `left` is below s - d.
        first_due, first_due_of_edges: the largest of these numbers of a pair of patches; `NEVER` after this where it is
            due, as those that are looked at get other ones.
        approach: what this substep uses of it; 0 where a pair sleeps; `allowed` the margins of both, likewise.
        needed: gets 1 for patches of pairs that are searched.
        reach: how far to search for elements, so that the list lasts for some substeps [m].
    """
    counter[0], counter[1] = 0, 0
    begin_sharing(taken, 0)
    for worker in range(workers):
        p = next_item(-1, worker, taken, 0, PAIRS_AT_A_TIME)
        while p < count:
            m, other = pairs[p][0], pairs[p][1]
            if way[m] + way[other] > wake[p]:
                whole, besides = motion[m] + motion[other], more[m] + more[other]
                nearer = ti.min(approach_of(m, other, centre, shift, turn, radius, rest), whole)
                approach[p], allowed[p] = nearer, margin[m] + margin[other]
                slack[p] -= 2.0 * astray
                is_searched = False
                if slack[p] < nearer + besides + SAFETY_OF_DUE * thickness:
                    gap = gap_of_boxes(m, other, low, high) - (1.0 + SAFETY_OF_DUE) * thickness
                    if gap > whole + besides:
                        wake[p], slack[p] = spent[m] + spent[other] + 2.0 * astray + gap, -1.0
                        approach[p], allowed[p], left[p] = 0.0, 0.0, FAR
                    else:
                        skin = ti.max(least_skin, SKIN_IN_MOTIONS * nearer) + 2.0 * besides + SAFETY_OF_DUE * thickness
                        wake[p], slack[p], reach[p] = -1.0, skin, thickness + skin
                        is_searched = True
                        expired[ti.atomic_add(counter[0], 1)] = p
                        needed[m], needed[other] = 1, 1
                if wake[p] < 0.0:
                    left[p] = slack[p] - ti.max(thickness, nearer + allowed[p]) - SAFETY_OF_DUE * thickness
                    if is_searched or first_due[p] >= left[p] or first_due_of_edges[p] >= left[p]:
                        due[ti.atomic_add(counter[1], 1)] = p
                        first_due[p], first_due_of_edges[p] = NEVER, NEVER
            p = next_item(p, worker, taken, 0, PAIRS_AT_A_TIME)
    return ti.math.ivec2(counter[0], counter[1])


@fast_launch
@ti.kernel
def measure_changes(
    count: ti.i32, workers: ti.i32, taken: Integers, items: ti.i32, lane_step: ti.i32, item_step: ti.i32,
    first_corner: Integers, corners: Integers, displacement: Vectors, predicted: Vectors, half_thickness: ti.f32,
    change: Floats, margin: Floats, more: Floats,
    partial: Floats, lanes: ti.i32, nodes: Floats, is_short: ti.template(),
) -> ti.math.vec2:  # fmt: skip
    """How far contacts displaced the vertices of each patch, `change` [m]; where that is beyond the `margin` that was
    allowed for, half as much again is from now on.

    Returns the largest change, and the largest that is beyond its margin, or 0.
    """
    begin_sharing(taken, 0)
    if ti.static(is_short):
        ti.loop_config(serialize=True)
    for worker in range(workers):
        lane = next_item(-1, worker, taken, 0, LANES_AT_A_TIME)
        while lane < lanes:
            largest, largest_beyond = 0.0, 0.0
            for k in range(items):
                m = lane * lane_step + k * item_step
                if m < count:
                    squared = 0.0
                    for place in range(first_corner[m], first_corner[m + 1]):
                        i = corners[place]
                        squared = ti.max(squared, (displacement[i] - predicted[i]).norm_sqr())
                    change[m] = ti.sqrt(squared)
                    largest = ti.max(largest, change[m])
                    if change[m] > margin[m]:
                        largest_beyond = ti.max(largest_beyond, change[m])
                        margin[m] = 1.5 * change[m]
                        more[m] = margin[m] - half_thickness
            partial[lane], partial[lanes + lane] = largest, largest_beyond
            lane = next_item(lane, worker, taken, 0, LANES_AT_A_TIME)
    results = reduced(partial, lanes, 2, 2, nodes)
    return ti.math.vec2(results[0], results[1])


@fast_launch
@ti.kernel
def finish_patches(
    vertex_count: ti.i32, still: ti.f32, position: Vectors, displacement: Vectors, expected: Vectors,
    count: ti.i32, patch_workers: ti.i32, pair_workers: ti.i32, taken: Integers, first_corner: Integers,
    corners: Integers, low: Vectors, high: Vectors,
    centre: Vectors, shift: Vectors, turn: Vectors, radius: Floats, rest: Floats,
    motion: Floats, change: Floats, is_changed: ti.i32, astray: ti.f32, negligible: ti.f32, least_margin: ti.f32,
    half_thickness: ti.f32, margin: Floats, more: Floats, spent: Floats,
    pair_count: ti.i32, pairs: Pairs, approach: Floats, slack: Floats, is_short: ti.template(),
):  # fmt: skip
    """The displacements of a substep are final: note where they lead, and what of the lists they use up.

    Patches that contacts changed by more than `negligible` [m] are fitted anew. Margins for the next substep are
    `WIDENED` times what contacts did in this one, and `least_margin` at least [m].
    """
    # Bounds before the first loop: each that is found between two loops would be a launch of its own on a GPU.
    vertices_end, patches_end, pairs_end = vertex_count, count, pair_count
    first_end, second_end = patch_workers, pair_workers
    if ti.static(is_short):
        ti.loop_config(serialize=True)
    for i in range(vertices_end):
        expected[i] = position[i] + displacement[i]
    begin_sharing(taken, 0)
    for worker in range(first_end):
        m = next_item(-1, worker, taken, 0, PATCHES_AT_A_TIME)
        while m < patches_end:
            change[m] = ti.select(is_changed == 1, change[m], 0.0)
            spent[m] += motion[m] + change[m] + astray
            margin[m] = ti.max(least_margin, WIDENED * change[m])
            more[m] = ti.max(margin[m] - half_thickness, 0.0)
            if change[m] > negligible:
                fit_motion(
                    m, still, first_corner, corners, position, displacement, low, high, centre, shift, turn, radius,
                    rest,
                )  # fmt: skip
            m = next_item(m, worker, taken, 0, PATCHES_AT_A_TIME)
    begin_sharing(taken, 1)
    for worker in range(second_end):
        p = next_item(-1, worker, taken, 1, PAIRS_AT_A_TIME)
        while p < pairs_end:
            if slack[p] > 0.0:
                m, other = pairs[p][0], pairs[p][1]
                nearer = approach[p] + change[m] + change[other]
                if ti.max(change[m], change[other]) > negligible:
                    nearer = approach_of(m, other, centre, shift, turn, radius, rest)
                    # A patch that was not fitted anew moves as noted, but for its change.
                    nearer += ti.select(change[m] > negligible, 0.0, change[m])
                    nearer += ti.select(change[other] > negligible, 0.0, change[other])
                slack[p] -= nearer
            p = next_item(p, worker, taken, 1, PAIRS_AT_A_TIME)
