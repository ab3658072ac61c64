"""The proof that a pair did not cross in a substep, and what is done where it fails."""

import taichi as ti

from sim.cloth.bundles import Contacts
from sim.cloth.contact_answers import thickness_between
from sim.cloth.proximity_contacts import EDGE_EDGE
from sim.core.arrays import Floats, Integers, Vectors
from sim.core.bundles import func

LARGEST_SHARE = 0.9
"""How much of a pair's separation a substep may use up: what is left keeps the sides apart for the next one."""

LEAST_GAP = 0.02
"""Layers are never let nearer than this, in their thickness, as far as contacts and impact zones decide it."""

KEPT_BY_REPAIR = 0.3
"""Share of its separation that a pair keeps which would have crossed: above 1 - `LARGEST_SHARE`."""

ROUNDING = 1.0e-6
"""Relative rounding of a separation in float32, in lengths of the elements."""


@func
def repair_crossing(
    c: ti.i32,
    contacts: Contacts,
    impulse: Vectors,
    position: Vectors,
    displacement: Vectors,
    inverse_mass: Floats,
    thickness: Floats,
    crossing: Integers,
    counter: Integers,
):
    """Count a pair if it is not certainly apart all through the substep, and have its worst vertices pushed.

    Two sides that a plane across n separates at the start, and one across n at the end, are separated all the time in
    between: n . (x_a - x_b) of any two vertices is linear in time. So it is enough that the separation along n, that
    of the nearest two vertices, keeps 1 - `LARGEST_SHARE` of what it was; or all of it where it was none.
    `crossing` gets 1 for pairs that fail, else 0. Pairs whose vertices are all pinned are not looked at.
    """
    crossing[c] = 0
    mobile = 0.0
    for k in ti.static(range(4)):
        mobile = ti.max(mobile, inverse_mass[contacts.vertices[c][k]])
    if contacts.kind[c] < 0 and contacts.kind[c] >= EDGE_EDGE and mobile > 0.0:
        n, v = contacts.normal[c], contacts.vertices[c]
        first = ti.select(contacts.kind[c] == EDGE_EDGE, 2, 1)
        origin, size = position[v[0]], 0.0
        start = ti.math.vec4(0.0)
        end = ti.math.vec4(0.0)
        for k in ti.static(range(4)):
            x = position[v[k]] - origin
            start[k] = n.dot(x)
            end[k] = start[k] + n.dot(displacement[v[k]])
            size = ti.max(size, x.norm(), (displacement[v[k]] - displacement[v[0]]).norm())
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
        least_gap = LEAST_GAP * thickness_between(v, thickness)
        least = ti.min(ti.max((1.0 - LARGEST_SHARE) * apart, least_gap), apart - ROUNDING * size)
        if low - high < least:
            ti.atomic_add(counter[0], 1)
            crossing[c] = 1
            pair = ti.math.vec4(0.0)
            between = 0.0
            for k in ti.static(range(4)):
                if k == lowest:
                    pair[k], between = 1.0, between + start[k]
                if k == highest:
                    pair[k], between = -1.0, between - start[k]
            contacts.weights[c] = pair
            contacts.floor[c] = ti.min(ti.max(KEPT_BY_REPAIR * apart, 2.0 * least_gap), apart) - between
            impulse[c] = ti.math.vec3(0.0)
