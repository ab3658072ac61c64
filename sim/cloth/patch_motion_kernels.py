"""Kernels of patches: where they are, how they move, and which of them may meet."""

import taichi as ti

from sim.arrays import Floats, Integers, Vectors
from sim.cloth.self_collision_kernels import Pairs
from sim.launch import fast_launch

FAR = 1.0e30

SAFETY = 1.0e-5
"""Part of the motion of two patches against each other that is added to it: norms and sums of float32 lose some 1e-7.

Other rounding is not in proportion to that motion: residuals of the fit lose some 2e-7 of the whole displacement, and
what positions take differs from displacements by half a quantum an axis, 1e-9 of the domain. In a frame, after which
lists are forgotten, that is about a micrometre where cloth moves at metres a second in a hundred substeps. It needs no
term: what is not listed is still a whole thickness apart when a list runs out, so that contacts begin later by that, a
hundredth of a thin cloth's thickness at most, and nothing has met unseen.
"""

REGULARIZATION = 1.0e-5
"""Part of the inertia of a patch that is added to it, so that it has an inverse."""

SKIN_IN_MOTIONS = 2.0
"""Least skin in motions of the substep, so that a list lasts for some."""


@fast_launch
@ti.kernel
def enclose_patches(
    count: ti.i32, first_corner: Integers, corners: Integers, position: Vectors, low: Vectors, high: Vectors
):  # fmt: skip
    """Boxes around patches where they are now."""
    for m in range(count):
        least, most = ti.math.vec3(FAR), ti.math.vec3(-FAR)
        for place in range(first_corner[m], first_corner[m + 1]):
            x = position[corners[place]]
            least, most = ti.min(least, x), ti.max(most, x)
        low[m], high[m] = least, most


@fast_launch
@ti.kernel
def fit_motions(
    count: ti.i32, first_corner: Integers, corners: Integers, position: Vectors, displacement: Vectors,
    centre: Vectors, shift: Vectors, turn: Vectors, radius: Floats, rest: Floats,
):  # fmt: skip
    """Fit a rigid motion c + w x (x - centre) to the displacements of each patch, by least squares.

    `rest` gets the largest displacement that is left of it [m], and `radius` the largest distance from the centre [m].
    The fit decides how small the rest is, not whether it is a bound.
    """
    for m in range(count):
        first, last = first_corner[m], first_corner[m + 1]
        share = 1.0 / ti.cast(last - first, ti.f32)
        origin = position[corners[first]]
        x_0, u_0 = ti.math.vec3(0.0), ti.math.vec3(0.0)
        for place in range(first, last):
            x_0 += position[corners[place]] - origin
            u_0 += displacement[corners[place]]
        x_0, u_0 = origin + share * x_0, share * u_0
        xx, yy, zz, xy, xz, yz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        moment = ti.math.vec3(0.0)
        for place in range(first, last):
            r = position[corners[place]] - x_0
            moment += r.cross(displacement[corners[place]] - u_0)
            xx, yy, zz = xx + r.x * r.x, yy + r.y * r.y, zz + r.z * r.z
            xy, xz, yz = xy + r.x * r.y, xz + r.x * r.z, yz + r.y * r.z
        # Regularized: corners on a line say nothing about turns around it.
        more = (1.0 + REGULARIZATION) * (xx + yy + zz) + 1.0e-30
        inertia = ti.math.mat3(more - xx, -xy, -xz, -xy, more - yy, -yz, -xz, -yz, more - zz)
        w = inertia.inverse() @ moment
        left, largest = 0.0, 0.0
        for place in range(first, last):
            r = position[corners[place]] - x_0
            left = ti.max(left, (displacement[corners[place]] - u_0 - w.cross(r)).norm())
            largest = ti.max(largest, r.norm())
        centre[m], shift[m], turn[m], radius[m], rest[m] = x_0, u_0, w, largest, left


@fast_launch
@ti.kernel
def place_leaves(count: ti.i32, leaves: ti.i32, low: Vectors, high: Vectors, tree_low: Vectors, tree_high: Vectors):
    """Leaves of a complete binary tree: the boxes of the patches, then empty ones; leaf k is node `leaves` + k."""
    for leaf in range(leaves):
        least, most = ti.math.vec3(FAR), ti.math.vec3(-FAR)
        if leaf < count:
            least, most = low[leaf], high[leaf]
        tree_low[leaves + leaf], tree_high[leaves + leaf] = least, most


@fast_launch
@ti.kernel
def merge_boxes(first: ti.i32, tree_low: Vectors, tree_high: Vectors):
    """Boxes of a level, of the nodes `first` to 2 `first` - 1: 2 k and 2 k + 1 are below k, and 1 is the root."""
    for node in range(first, 2 * first):
        tree_low[node] = ti.min(tree_low[2 * node], tree_low[2 * node + 1])
        tree_high[node] = ti.max(tree_high[2 * node], tree_high[2 * node + 1])


@fast_launch
@ti.kernel
def pair_patches(
    count: ti.i32, leaves: ti.i32, low: Vectors, high: Vectors, tree_low: Vectors, tree_high: Vectors,
    cloth: Integers, collides: Integers, reach: ti.f32, pairs: Pairs, counter: Integers, capacity: ti.i32,
) -> ti.i32:  # fmt: skip
    """List the patches whose boxes are within `reach` [m] of each other along every axis, each pair once, and each
    patch with itself; returns how many there are."""
    counter[0] = 0
    for m in range(count):
        least, most = low[m] - reach, high[m] + reach
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
                        pairs[slot] = ti.Vector([m, other])
                # On to the next node that is not below this one; 0 after the last.
                while node % 2 == 1:
                    node = node // 2
                node += ti.cast(node > 0, ti.i32)
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
    count: ti.i32, pairs: Pairs, low: Vectors, high: Vectors, centre: Vectors, shift: Vectors, turn: Vectors,
    radius: Floats, rest: Floats, thickness: ti.f32, least_skin: ti.f32, whole: ti.f32, more: ti.f32,
    used: ti.f32, is_new: ti.i32, wake: Floats, slack: Floats, approach: Floats, reach: Floats, expired: Integers,
    counter: Integers,
) -> ti.i32:  # fmt: skip
    """List the pairs of patches whose elements have to be searched before this substep; returns how many there are.

    Pairs far apart sleep until the motion of the whole cloth can have closed the gap between their boxes.

    Args:
        thickness: the largest [m].
        least_skin: how far beyond to search at least [m].
        whole: how much nearer any two points come at most [m]; `more` by which contacts may add to that, `used` by
            the substeps before.
        is_new: whether nothing is known about the pairs yet.
        wake: value of `used` until which a pair sleeps.
        slack: how much nearer the elements of a pair may come, that are not listed, and be a thickness apart [m].
        approach: what this substep uses of it; 0 where a pair sleeps.
        reach: how far to search for elements, so that the list lasts for some substeps [m].
    """
    counter[0] = 0
    for p in range(count):
        approach[p] = 0.0
        if is_new == 1:
            wake[p], slack[p] = -1.0, -1.0
        if used + whole + more > wake[p]:
            m, other = pairs[p][0], pairs[p][1]
            nearer = approach_of(m, other, centre, shift, turn, radius, rest)
            approach[p] = nearer
            if slack[p] < nearer + more:
                gap = gap_of_boxes(m, other, low, high) - thickness
                if gap > whole + more:
                    wake[p], slack[p], approach[p] = used + gap, -1.0, 0.0
                else:
                    skin = ti.max(least_skin, SKIN_IN_MOTIONS * nearer) + 2.0 * more
                    wake[p], slack[p], reach[p] = -1.0, skin, thickness + skin
                    expired[ti.atomic_add(counter[0], 1)] = p
    return counter[0]


@fast_launch
@ti.kernel
def use_slack(count: ti.i32, more: ti.f32, approach: Floats, slack: Floats):
    """Subtract what the substep used, and what contacts added to it at most [m]."""
    for p in range(count):
        if slack[p] > 0.0:
            slack[p] -= approach[p] + more


@fast_launch
@ti.kernel
def measure_approach(
    count: ti.i32, pairs: Pairs, centre: Vectors, shift: Vectors, turn: Vectors, radius: Floats, rest: Floats,
    whole: ti.f32, used: ti.f32, wake: Floats, approach: Floats,
):  # fmt: skip
    """Note how much nearer the elements of pairs of patches come that do not sleep."""
    for p in range(count):
        if used + whole > wake[p]:
            approach[p] = approach_of(pairs[p][0], pairs[p][1], centre, shift, turn, radius, rest)
