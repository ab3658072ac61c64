"""The end of a substep's contacts in one launch: whether pairs may have crossed, and what of the lists is used up."""

import taichi as ti

from sim.cloth.bundles import (
    Contacts,
    Counters,
    MovingPatches,
    PatchPairArrays,
    SubstepEnd,
    TestedContacts,
    TrackedNodes,
)
from sim.cloth.contact_response import thickness_between
from sim.cloth.patch_motion_kernels import (
    PAIRS_AT_A_TIME,
    PATCHES_AT_A_TIME,
    finish_pair,
    finish_patch,
    measure_change,
)
from sim.cloth.proximity_contacts import EDGE_EDGE
from sim.core.arrays import Integers, Vectors
from sim.core.bundles import func
from sim.core.launch import large_kernel
from sim.core.scheduling import begin_sharing, next_item

LARGEST_SHARE = 0.9
"""How much of a pair's separation a substep may use up: what is left keeps the sides apart for the next one."""

LEAST_GAP = 0.02
"""Layers are never let nearer than this, in their thickness, as far as contacts and impact zones decide it."""

KEPT_BY_REPAIR = 0.3
"""Share of its separation that a pair keeps which would have crossed: above 1 - `LARGEST_SHARE`."""

ROUNDING = 1.0e-6
"""Relative rounding of a separation in float32, in lengths of the elements."""


@func
def repair_crossing(c: ti.i32, contacts: Contacts, tested: TestedContacts, nodes: TrackedNodes, counter: Integers):
    """Count a pair if it is not certainly apart all through the substep, and have its worst vertices pushed.

    Two sides that a plane across n separates at the start, and one across n at the end, are separated all the time in
    between: n . (x_a - x_b) of any two vertices is linear in time. So it is enough that the separation along n, that
    of the nearest two vertices, keeps 1 - `LARGEST_SHARE` of what it was; or all of it where it was none.
    `crossing` gets 1 for pairs that fail, else 0. Pairs whose vertices are all pinned are not looked at.
    """
    tested.crossing[c] = 0
    mobile = 0.0
    for k in ti.static(range(4)):
        mobile = ti.max(mobile, tested.inverse_mass[contacts.vertices[c][k]])
    if contacts.kind[c] < 0 and contacts.kind[c] >= EDGE_EDGE and mobile > 0.0:
        n, v = contacts.normal[c], contacts.vertices[c]
        first = ti.select(contacts.kind[c] == EDGE_EDGE, 2, 1)
        origin, size = nodes.position[v[0]], 0.0
        start = ti.math.vec4(0.0)
        end = ti.math.vec4(0.0)
        for k in ti.static(range(4)):
            x = nodes.position[v[k]] - origin
            start[k] = n.dot(x)
            end[k] = start[k] + n.dot(nodes.displacement[v[k]])
            size = ti.max(size, x.norm(), (nodes.displacement[v[k]] - nodes.displacement[v[0]]).norm())
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
            ti.atomic_add(counter[0], 1)
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
    nodes: TrackedNodes,
    predicted: Vectors,
    patches: MovingPatches,
    end: SubstepEnd,
    met: PatchPairArrays,
    workers: ti.math.ivec3,
    counters: Counters,
) -> ti.math.ivec3:
    """Test `count` contacts (`repair_crossing`); if none failed, measure how far they displaced patches; if not farther
    than allowed for, displacements are final: note where they lead, and what of the lists they use up.

    Args:
        count, contacts, tested: see `repair_crossing`.
        vertex_count, nodes: the vertices.
        predicted: displacements as contacts were looked for [m].
        patches, end, met: see `finish_patch` and `finish_pair`.
        workers: see `sim.core.scheduling`; for patches that contacts may have displaced, all, and their pairs.
        counters: three numbers.

    Returns how many pairs failed; whether patches were displaced farther than allowed for; and whether any displacement
    is not finite.
    """
    # Bounds before the first loop: each that is found between two loops would be a launch of its own on a GPU.
    contacts_end, vertices_end = count, vertex_count
    displaced_end, patches_end, pairs_end = workers[0], workers[1], workers[2]
    counters.found[0], counters.found[1], counters.found[2] = 0, 0, 0
    for c in range(contacts_end):
        repair_crossing(c, contacts, tested, nodes, counters.found)
    begin_sharing(counters.taken, 0)
    for worker in range(displaced_end):
        stop = ti.select(counters.found[0] == 0, patches.corners.count, 0)
        m = next_item(-1, worker, counters.taken, 0, PATCHES_AT_A_TIME)
        while m < stop:
            measure_change(m, patches, nodes.displacement, predicted, end.half_thickness, counters.found)
            m = next_item(m, worker, counters.taken, 0, PATCHES_AT_A_TIME)
    for i in range(vertices_end):
        if counters.found[0] + counters.found[1] + counters.found[2] == 0:
            nodes.expected[i] = nodes.position[i] + nodes.displacement[i]
    begin_sharing(counters.taken, 1)
    for worker in range(patches_end):
        stop = ti.select(counters.found[0] + counters.found[1] + counters.found[2] == 0, patches.corners.count, 0)
        m = next_item(-1, worker, counters.taken, 1, PATCHES_AT_A_TIME)
        while m < stop:
            finish_patch(m, nodes, patches, end)
            m = next_item(m, worker, counters.taken, 1, PATCHES_AT_A_TIME)
    begin_sharing(counters.taken, 2)
    for worker in range(pairs_end):
        stop = ti.select(counters.found[0] + counters.found[1] + counters.found[2] == 0, met.count, 0)
        p = next_item(-1, worker, counters.taken, 2, PAIRS_AT_A_TIME)
        while p < stop:
            finish_pair(p, met, patches, end.negligible)
            p = next_item(p, worker, counters.taken, 2, PAIRS_AT_A_TIME)
    return ti.math.ivec3(counters.found[0], counters.found[1], counters.found[2])
