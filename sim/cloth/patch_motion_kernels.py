"""Kernels of patches: where they are, how they move, which of them may meet; and the end of a substep's contacts in one
launch: whether pairs may have crossed, and what of the lists is used up.
"""

import taichi as ti

from sim.cloth.bundles import (
    BoxTree,
    Contacts,
    Followed,
    KnownPairs,
    MovingPatches,
    PatchMotion,
    PatchPairArrays,
    TestedContacts,
)
from sim.cloth.contact_response import thickness_between
from sim.cloth.contacts import EDGE_EDGE
from sim.cloth.near_pairs import NEVER, SAFETY_OF_DUE
from sim.core.arrays import Floats, Integers, Vectors
from sim.core.bundles import func
from sim.core.launch import kernel, large_kernel
from sim.core.reductions import Share, is_finite, reduced_tree, runs_on_gpu
from sim.core.scheduling import begin_sharing, next_item

FAR = 1.0e30

SAFETY = 1.0e-5
"""Part of the motion of two patches against each other that is added to it: norms and sums of float32 lose some 1e-7.

Residuals of the fit lose as much of the whole displacement besides, nanometres in a substep: what is not listed is
still a whole thickness apart when a list runs out. What positions do as they are rounded is measured.
"""

REGULARIZATION = 1.0e-5
"""Part of the inertia of a patch that is added to it, so that it has an inverse."""

PATCHES_AT_A_TIME, PAIRS_AT_A_TIME = 16, 256
"""Patches, and pairs of them, that a thread takes at a time."""

WIDENED = 1.25
"""Contacts may push so many times as far as in the substep before without patches being looked at anew."""

KEPT_MARGIN = 0.97
"""Part of what they may that they keep for the next substep, whatever they did: what they do swings about a mean."""

LARGEST_STILL = 1.0e15
"""Differences of displacements from which on none are fitted [m]."""

FEWEST_SUBSTEPS, MOST_SUBSTEPS = 12.0, 60.0
PATCH_REACH_IN_EDGES = 3.0
"""How many substeps' motion of the patches the list of their pairs allows for: as many as take them so many mean edges,
but in this range. All pairs are searched when the list is made anew, and each costs a little in every substep."""

SKIN_IN_MOTIONS = 2.0
"""Least skin in motions of the substep, so that a list lasts for some."""


@large_kernel
def look_at_patches(
    vertex_count: ti.i32,
    of_vertices: Share,
    still: ti.f32,
    followed: Followed,
    least_skin: ti.f32,
    first_due: Floats,
    workers: ti.math.ivec2,
) -> ti.math.ivec4:
    """Where patches are, and how they move in this substep; then, if the list of their pairs holds, which of these have
    to be searched, and of which some elements are due.

    A rigid motion c + w x (x - centre) is fitted to the displacements of each patch, by least squares. The list holds
    while what patches spend, with this motion and what may come besides, is within their reach.

    Args:
        vertex_count, of_vertices: the vertices, and how lanes share them; 0 if patches have been looked at, and how far
            astray any is is known.
        still: see `fit_motion`.
        followed: its patches get the motion, `found` the two numbers of pairs, and whether the list does not hold.
        least_skin, first_due: see `age_pair`.
        workers: see `sim.core.scheduling`; for patches, and for their pairs.

    Returns half the diagonal of the box of all displacements, and how far a vertex is at most from where its last
    displacement should have led it [m], both by their bits; how many pairs have to be searched, or -1 if the list does
    not hold; and of how many some elements are due.
    """
    patches, met = ti.static((followed.patches, followed.met))
    motion, tree = ti.static((patches.motion, of_vertices.tree))
    patches_end, pairs_end = workers[0], workers[1]
    met.found[0], met.found[1], met.found[2] = 0, 0, 0
    for lane in range(tree.lanes):
        most, least, off = ti.math.vec3(-FAR), ti.math.vec3(FAR), 0.0
        for k in range(of_vertices.items):
            i = lane * of_vertices.lane_step + k * of_vertices.item_step
            if i < vertex_count:
                u = followed.displacement[i]
                most, least = ti.max(most, u), ti.min(least, u)
                off = ti.max(off, (followed.position[i] - followed.expected[i]).norm_sqr())
        for axis in ti.static(range(3)):
            tree.partial[axis * tree.lanes + lane] = most[axis]
            tree.partial[(3 + axis) * tree.lanes + lane] = -least[axis]
        tree.partial[6 * tree.lanes + lane] = off
    ends = reduced_tree(tree)
    middle = 0.5 * ti.math.vec3(ends[0] - ends[3], ends[1] - ends[4], ends[2] - ends[5])
    size = ti.math.vec3(ends[0] + ends[3], ends[1] + ends[4], ends[2] + ends[5])
    astray = ti.select(vertex_count > 0, ti.sqrt(ends[6]), followed.astray)
    begin_sharing(met.taken, 0)
    for worker in range(patches_end):
        m = next_item(-1, worker, met.taken, 0, PATCHES_AT_A_TIME)
        while m < patches.corners.count:
            fit_motion(m, still, followed)
            patches.moves[m] = (1.0 + SAFETY) * (
                (motion.shift[m] - middle).norm() + motion.turn[m].norm() * motion.radius[m] + motion.rest[m]
            )
            patches.travel[m] = patches.spent[m] + astray + patches.moves[m] + patches.more[m]
            if not patches.travel[m] <= patches.reach[m]:
                met.found[2] = 1
            m = next_item(m, worker, met.taken, 0, PATCHES_AT_A_TIME)
    begin_sharing(met.taken, 1)
    for worker in range(pairs_end):
        end = ti.select(met.found[2] == 0, met.count, 0)
        p = next_item(-1, worker, met.taken, 1, PAIRS_AT_A_TIME)
        while p < end:
            age_pair(p, followed, astray, least_skin, first_due)
            p = next_item(p, worker, met.taken, 1, PAIRS_AT_A_TIME)
    expired = ti.select(met.found[2] == 0, met.found[0], -1)
    return ti.math.ivec4(ti.bit_cast(0.5 * size.norm(), ti.i32), ti.bit_cast(astray, ti.i32), expired, met.found[1])


@func
def fit_motion(m: ti.i32, still: ti.f32, followed: Followed):
    """The box and the motion of a patch; displacements within `still` [m] of each other are not fitted any closer."""
    (patches,) = ti.static((followed.patches,))
    corners, boxes, motion = ti.static((patches.corners, patches.boxes, patches.motion))
    first, last = corners.first[m], corners.first[m + 1]
    origin, u_first = followed.position[corners.nodes[first]], followed.displacement[corners.nodes[first]]
    least, most, u_least, u_most = origin, origin, u_first, u_first
    # Sums about the first corner: what is subtracted for the mean is of their own size.
    r_sum, u_sum, moment = ti.math.vec3(0.0), ti.math.vec3(0.0), ti.math.vec3(0.0)
    squares, products = ti.math.vec3(0.0), ti.math.vec3(0.0)
    for place in range(first, last):
        i = corners.nodes[place]
        x, u = followed.position[i], followed.displacement[i]
        least, most = ti.min(least, x), ti.max(most, x)
        u_least, u_most = ti.min(u_least, u), ti.max(u_most, u)
        if still < LARGEST_STILL:
            r, v = x - origin, u - u_first
            r_sum, u_sum, moment = r_sum + r, u_sum + v, moment + r.cross(v)
            squares, products = squares + r * r, products + r * r.yzx
    boxes.low[m], boxes.high[m] = least, most
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
            i = corners.nodes[place]
            r = followed.position[i] - x_0
            left = ti.max(left, (followed.displacement[i] - u_0 - w.cross(r)).norm_sqr())
            largest = ti.max(largest, r.norm_sqr())
    motion.centre[m], motion.shift[m], motion.turn[m] = x_0, u_0, w
    motion.radius[m], motion.rest[m] = ti.sqrt(largest), ti.sqrt(left)


@kernel
def place_leaves(patches: MovingPatches, edge: ti.f32, thickness: ti.f32, tree: BoxTree):
    """Leaves of a complete binary tree: boxes around the patches, then empty ones; leaf k is node `leaves` + k.

    Boxes are larger than the patches by half a thickness and by their `reach`: as much as they may move in
    `FEWEST_SUBSTEPS` to `MOST_SUBSTEPS` like this one, and half an edge [m].
    """
    for leaf in range(tree.leaves):
        lowest, highest = ti.math.vec3(FAR), ti.math.vec3(-FAR)
        if leaf < patches.corners.count:
            patches.spent[leaf] = 0.0
            moves = patches.moves[leaf] + patches.change[leaf]
            ahead = ti.math.clamp(PATCH_REACH_IN_EDGES * edge, FEWEST_SUBSTEPS * moves, MOST_SUBSTEPS * moves)
            patches.reach[leaf] = ahead + 0.5 * edge + patches.more[leaf]
            lowest = patches.boxes.low[leaf] - patches.reach[leaf] - 0.5 * thickness
            highest = patches.boxes.high[leaf] + patches.reach[leaf] + 0.5 * thickness
        tree.low[tree.leaves + leaf], tree.high[tree.leaves + leaf] = lowest, highest


@kernel
def merge_boxes(first: ti.i32, tree: BoxTree):
    """Boxes of a level, of the nodes `first` to 2 `first` - 1: 2 k and 2 k + 1 are below k, and 1 is the root.

    On a CPU serial: they are few.
    """
    if ti.static(not runs_on_gpu()):
        ti.loop_config(serialize=True)
    for node in range(first, 2 * first):
        tree.low[node] = ti.min(tree.low[2 * node], tree.low[2 * node + 1])
        tree.high[node] = ti.max(tree.high[2 * node], tree.high[2 * node + 1])


@kernel
def sort_known(count: ti.i32, patch_count: ti.i32, known: KnownPairs, counter: Integers):
    """List the pairs of patches of whose elements something is known, `slack` being positive, by their first patch."""
    pairs_end, patches_end = count, patch_count
    counter[0] = 0
    for m in range(patches_end):
        known.first[2 * m], known.first[2 * m + 1] = 0, 0
    for p in range(pairs_end):
        if known.slack[p] > 0.0:
            ti.atomic_add(known.first[2 * known.pairs[p][0] + 1], 1)
    for m in range(patches_end):
        start = ti.atomic_add(counter[0], known.first[2 * m + 1])
        known.first[2 * m], known.first[2 * m + 1] = start, start
    for p in range(pairs_end):
        if known.slack[p] > 0.0:
            known.known[ti.atomic_add(known.first[2 * known.pairs[p][0] + 1], 1)] = p


@kernel
def pair_patches(
    count: ti.i32,
    workers: ti.i32,
    tree: BoxTree,
    cloth: Integers,
    collides: Integers,
    known: KnownPairs,
    now: PatchPairArrays,
    carried: Integers,
    capacity: ti.i32,
) -> ti.i32:
    """List the patches whose boxes in the tree meet, each pair once, and each patch with itself; returns how many
    there are.

    What was known before about a pair holds (`sort_known`): `carried` is its number there, or -1.
    """
    now.found[0] = 0
    begin_sharing(now.taken, 0)
    for worker in range(workers):
        m = next_item(-1, worker, now.taken, 0, PATCHES_AT_A_TIME)
        while m < count:
            least, most = tree.low[tree.leaves + m], tree.high[tree.leaves + m]
            node = 1
            while node > 0:
                # The last leaf below a node: pairs are listed by the smaller of their numbers.
                last = node
                while last < tree.leaves:
                    last = 2 * last + 1
                is_near = (tree.low[node] <= most).all() and (tree.high[node] >= least).all()
                if is_near and last - tree.leaves >= m and node < tree.leaves:
                    node = 2 * node
                else:
                    other = node - tree.leaves
                    if is_near and other >= m and (cloth[m] != cloth[other] or collides[cloth[m]] == 1):
                        slot = ti.atomic_add(now.found[0], 1)
                        if slot < capacity:
                            now.pairs[slot] = ti.Vector([m, other])
                    # On to the next node that is not below this one; 0 after the last.
                    while node % 2 == 1:
                        node = node // 2
                    node += ti.cast(node > 0, ti.i32)
            m = next_item(m, worker, now.taken, 0, PATCHES_AT_A_TIME)
    end = ti.min(now.found[0], capacity)
    for p in range(end):
        m, other, before = now.pairs[p][0], now.pairs[p][1], -1
        for place in range(known.first[2 * m], known.first[2 * m + 1]):
            if known.pairs[known.known[place]][1] == other:
                before = known.known[place]
        carried[p], now.slack[p] = before, -1.0
        if before >= 0:
            now.slack[p] = known.slack[before]
        now.wake[p], now.left[p], now.approach[p], now.allowed[p] = -1.0, FAR, 0.0, 0.0
    return now.found[0]


@func
def approach_of(m: ti.i32, other: ti.i32, motion: PatchMotion) -> ti.f32:
    """How much nearer points of two patches come at most [m].

    With any w and c, points P and Q go to P + c + w x P + d and Q + c + w x Q + d'. P - Q + w x (P - Q) is never
    shorter than P - Q, so that distances shrink by |d| + |d'| at most; w is the mean of their turns.
    """
    turn, nearer = 0.5 * (motion.turn[m] + motion.turn[other]), motion.rest[m] + motion.rest[other]
    if m != other:
        between = motion.centre[other] - motion.centre[m]
        nearer += 0.5 * (motion.turn[other] - motion.turn[m]).norm() * (motion.radius[m] + motion.radius[other])
        nearer += (motion.shift[other] - motion.shift[m] - turn.cross(between)).norm()
    return nearer + SAFETY * nearer


@func
def age_pair(p: ti.i32, followed: Followed, astray: ti.f32, least_skin: ti.f32, first_due: Floats):
    """List a pair of patches if its elements have to be searched before this substep, and if some of them are due.

    Pairs far apart sleep until their patches' motion can have closed the gap between their boxes.

    Args:
        p: number of the pair.
        followed: the pairs, with `slack`: how much nearer elements that are not listed may come, and be a thickness
            apart; and `left`: what of it elements that are listed may use up until they are looked at: one that was d
            apart when the slack was s is due when `left` is below s - d. `needed` gets 1 for patches of pairs that are
            searched.
        astray: largest distance of a vertex from where it was left [m].
        least_skin: how far beyond the thickness to search at least [m].
        first_due: `PairPieces.piece_due`, which is `NEVER` after this where a pair is due, as elements that are looked
            at get other numbers.
    """
    met, patches, counter = ti.static((followed.met, followed.patches, followed.met.found))
    thickness = followed.thickness
    m, other = met.pairs[p][0], met.pairs[p][1]
    if patches.travel[m] + patches.travel[other] > met.wake[p]:
        whole, besides = (patches.moves[m] + patches.moves[other], patches.more[m] + patches.more[other])
        nearer = ti.min(approach_of(m, other, patches.motion), whole)
        met.approach[p], met.allowed[p] = nearer, patches.margin[m] + patches.margin[other]
        met.slack[p] -= 2.0 * astray
        is_searched = False
        if met.slack[p] < nearer + besides + SAFETY_OF_DUE * thickness:
            low, high = ti.static((patches.boxes.low, patches.boxes.high))
            gap = ti.max(low[m] - high[other], low[other] - high[m], 0.0).norm() - (1.0 + SAFETY_OF_DUE) * thickness
            if gap > whole + besides:
                met.wake[p], met.slack[p] = (patches.spent[m] + patches.spent[other] + 2.0 * astray + gap, -1.0)
                met.approach[p], met.allowed[p], met.left[p] = 0.0, 0.0, FAR
            else:
                skin = ti.max(least_skin, SKIN_IN_MOTIONS * nearer) + 2.0 * besides + SAFETY_OF_DUE * thickness
                met.wake[p], met.slack[p], met.reach[p] = -1.0, skin, thickness + skin
                is_searched = True
                met.expired[ti.atomic_add(counter[0], 1)] = p
                met.needed[m], met.needed[other] = 1, 1
        if met.wake[p] < 0.0:
            met.left[p] = met.slack[p] - ti.max(thickness, nearer + met.allowed[p]) - SAFETY_OF_DUE * thickness
            if is_searched or ti.max(first_due[2 * p], first_due[2 * p + 1]) >= met.left[p]:
                met.due[ti.atomic_add(counter[1], 1)] = p
                first_due[2 * p], first_due[2 * p + 1] = NEVER, NEVER


@func
def measure_change(m: ti.i32, followed: Followed, predicted: Vectors):
    """How far contacts displaced the vertices of a patch at most, `change` [m]; where that is beyond the `margin` that
    was allowed for, half as much again is from now on.

    The second number that is counted becomes 1 where it is, the third where the change is not finite.
    """
    patches, counter = ti.static((followed.patches, followed.met.found))
    (corners,) = ti.static((patches.corners,))
    squared = 0.0
    for place in range(corners.first[m], corners.first[m + 1]):
        i = corners.nodes[place]
        squared = ti.max(squared, (followed.displacement[i] - predicted[i]).norm_sqr())
    patches.change[m] = ti.sqrt(squared)
    if patches.change[m] > patches.margin[m]:
        patches.margin[m] = 1.5 * patches.change[m]
        patches.more[m] = patches.margin[m] - 0.5 * followed.thickness
        counter[1] = 1
    if is_finite(squared) == 0:
        counter[2] = 1


@func
def finish_patch(m: ti.i32, is_changed: ti.i32, followed: Followed):
    """What a patch used up of the lists in a substep; and how far contacts may displace it in the next one without it
    being looked at anew: `WIDENED` times what they did in this one, `KEPT_MARGIN` times what they might have, and half
    a thickness at least; only that where they did nothing to any patch.
    """
    (patches,) = ti.static((followed.patches,))
    margin, change, least = (
        patches.margin[m],
        ti.select(is_changed == 1, patches.change[m], 0.0),
        0.5 * followed.thickness,
    )
    patches.change[m] = change
    patches.spent[m] += patches.moves[m] + change + followed.astray
    wide = ti.select(is_changed == 1, ti.max(WIDENED * change, KEPT_MARGIN * margin), 0.0)
    patches.margin[m] = ti.max(least, wide)
    patches.more[m] = ti.max(patches.margin[m] - least, 0.0)


LARGEST_SHARE = 0.9
"""How much of a pair's separation a substep may use up: what is left keeps the sides apart for the next one."""

LEAST_GAP = 0.02
"""Layers are never let nearer than this, in their thickness, as far as contacts and impact zones decide it."""

KEPT_BY_REPAIR = 0.3
"""Share of its separation that a pair keeps which would have crossed: above 1 - `LARGEST_SHARE`."""

ROUNDING = 1.0e-6
"""Relative rounding of a separation in float32, in lengths of the elements."""


@func
def repair_crossing(c: ti.i32, contacts: Contacts, tested: TestedContacts, followed: Followed):
    """Count a pair if it is not certainly apart all through the substep, and have its worst vertices pushed.

    It is if the separation along its normal n, that of the nearest two vertices, keeps 1 - `LARGEST_SHARE` of what it
    was, or all of it where it was none: n . (x_a - x_b) of any two vertices is linear in time. `crossing` gets 1 for
    pairs that fail, else 0. Pairs whose vertices are all pinned are not looked at.
    """
    tested.crossing[c] = 0
    mobile = 0.0
    for k in ti.static(range(4)):
        mobile = ti.max(mobile, tested.inverse_mass[contacts.vertices[c][k]])
    if contacts.kind[c] < 0 and contacts.kind[c] >= EDGE_EDGE and mobile > 0.0:
        n, v = contacts.normal[c], contacts.vertices[c]
        first = ti.select(contacts.kind[c] == EDGE_EDGE, 2, 1)
        origin, size = followed.position[v[0]], 0.0
        start, end = ti.math.vec4(0.0), ti.math.vec4(0.0)
        for k in ti.static(range(4)):
            x = followed.position[v[k]] - origin
            start[k] = n.dot(x)
            end[k] = start[k] + n.dot(followed.displacement[v[k]])
            size = ti.max(size, x.norm(), (followed.displacement[v[k]] - followed.displacement[v[0]]).norm())
        low, low_start, high, high_start = 1.0e30, 1.0e30, -1.0e30, -1.0e30
        lowest, highest = 0, 0
        for k in ti.static(range(4)):
            if k < first:
                low_start = ti.min(low_start, start[k])
                if end[k] < low:
                    low, lowest = end[k], k
            else:
                high_start = ti.max(high_start, start[k])
                if end[k] > high:
                    high, highest = end[k], k
        apart = low_start - high_start
        least_gap = LEAST_GAP * thickness_between(v, tested.thickness)
        least = ti.min(ti.max((1.0 - LARGEST_SHARE) * apart, least_gap), apart - ROUNDING * size)
        if low - high < least:
            ti.atomic_add(followed.met.found[0], 1)
            tested.crossing[c] = 1
            pair = ti.math.vec4(0.0)
            between = 0.0
            for k in ti.static(range(4)):
                if k == lowest:
                    pair[k], between = 1.0, between + start[k]
                if k == highest:
                    pair[k], between = -1.0, between - start[k]
            contacts.weights[c] = pair
            contacts.floor[c] = ti.min(ti.max(KEPT_BY_REPAIR * apart, 2.0 * least_gap), apart) - between
            tested.impulse[c] = ti.math.vec3(0.0)


@large_kernel
def end_contacts(
    count: ti.i32,
    contacts: Contacts,
    tested: TestedContacts,
    vertex_count: ti.i32,
    predicted: Vectors,
    is_changed: ti.i32,
    followed: Followed,
    workers: ti.math.ivec3,
) -> ti.math.ivec3:
    """Test `count` contacts (`repair_crossing`); if none failed, measure how far they displaced patches; if not farther
    than allowed for, displacements are final: note where they lead, and what of the lists they use up.

    Args:
        count, contacts, tested: see `repair_crossing`.
        vertex_count, predicted: vertices, and their displacements as contacts were looked for [m].
        is_changed: whether contacts displaced anything.
        followed: the patches and their pairs; `found` gets what is returned.
        workers: see `sim.core.scheduling`; for patches that contacts may have displaced, all, and their pairs.

    Returns how many pairs failed; whether patches were displaced farther than allowed for; and whether any displacement
    is not finite.
    """
    patches, met = ti.static((followed.patches, followed.met))
    # Bounds before the first loop: each that is found between two loops would be a launch of its own on a GPU.
    contacts_end, vertices_end = count, vertex_count
    displaced_end, patches_end, pairs_end = workers[0], workers[1], workers[2]
    met.found[0], met.found[1], met.found[2] = 0, 0, 0
    for c in range(contacts_end):
        repair_crossing(c, contacts, tested, followed)
    begin_sharing(met.taken, 0)
    for worker in range(displaced_end):
        stop = ti.select(met.found[0] == 0, patches.corners.count, 0)
        m = next_item(-1, worker, met.taken, 0, PATCHES_AT_A_TIME)
        while m < stop:
            measure_change(m, followed, predicted)
            m = next_item(m, worker, met.taken, 0, PATCHES_AT_A_TIME)
    for i in range(vertices_end):
        if met.found[0] + met.found[1] + met.found[2] == 0:
            followed.expected[i] = followed.position[i] + followed.displacement[i]
    begin_sharing(met.taken, 1)
    for worker in range(patches_end):
        stop = ti.select(met.found[0] + met.found[1] + met.found[2] == 0, patches.corners.count, 0)
        m = next_item(-1, worker, met.taken, 1, PATCHES_AT_A_TIME)
        while m < stop:
            finish_patch(m, is_changed, followed)
            m = next_item(m, worker, met.taken, 1, PATCHES_AT_A_TIME)
    begin_sharing(met.taken, 2)
    for worker in range(pairs_end):
        stop = ti.select(met.found[0] + met.found[1] + met.found[2] == 0, met.count, 0)
        p = next_item(-1, worker, met.taken, 2, PAIRS_AT_A_TIME)
        while p < stop:
            if met.slack[p] > 0.0:
                met.slack[p] -= met.approach[p] + patches.change[met.pairs[p][0]] + patches.change[met.pairs[p][1]]
            p = next_item(p, worker, met.taken, 2, PAIRS_AT_A_TIME)
    return ti.math.ivec3(met.found[0], met.found[1], met.found[2])
