"""Vertices between what stands and a body that moves: they get a `support`, and answer to contacts about as the body
does.

A node under a heavy body on a floor passes on what neither its mass nor twenty steps could: D_c of it is ten thousand
times too large for the body, which would fall through. So nodes between what stands and a body that moves have a
`support` e: they answer to contacts by (1 - e²)/m, about as heavily as the body. What the answer keeps from them is the
floor's, so that the momentum of cloth and bodies changes by what stands alone. Nodes that are pressed from both sides
do not leave or enter either whatever their mass. But the cloth's own springs pull them from under the body more easily
than its friction would let them.
"""

import taichi as ti

from sim.cloth.bundles import Contacts, NodeSums
from sim.cloth.proximity import unit_or
from sim.core.arrays import Integers, Vectors
from sim.core.bundles import func

SHARES_PER_UNIT = 65536.0
"""Resolution of the sums of weights; rounded up, so that the diagonal stays an upper bound."""

MOST_ALIKE = -0.95
"""A vertex is between two sides, and gets a `support`, if the cosine of the angle of their normals is below this: a
heavy node that meets the edge of a body obliquely would kick it."""

LEAST_COSINE = 0.86
"""Contacts are turned to the support of their vertices if the cosine of the angle between both lines is larger."""

LEAST_ANSWER = 1.0e-6
"""Of a vertex that has a support: float32 cannot tell less from none."""


@func
def hold(c: ti.i32, contacts: Contacts, most: ti.f32, sums: NodeSums):
    """Sum up which way the vertices of a contact are held by what stands, and pressed by a body that moves."""
    side = ti.select(most > 0.0, 3, 0)
    for k in ti.static(range(4)):
        if contacts.weights[c][k] != 0.0:
            v = contacts.vertices[c][k]
            part = (ti.abs(contacts.weights[c][k]) * SHARES_PER_UNIT) * contacts.normal[c]
            for axis in ti.static(range(3)):
                ti.atomic_add(sums.held_sums[6 * v + side + axis], ti.round(part[axis], ti.i32))
            if most > 0.0:
                ti.atomic_max(sums.lever[v], ti.sqrt(most))
                ti.atomic_max(sums.pressing_body[v], contacts.kind[c])


@func
def support_between(i: ti.i32, held_sums: Integers, lighter: ti.f32) -> ti.math.vec3:
    """Support of a vertex of which a body's share of a contact's mobility is `lighter` times its own; 0 if free."""
    stands, presses = ti.math.vec3(0.0), ti.math.vec3(0.0)
    for axis in ti.static(range(3)):
        stands[axis] = ti.cast(held_sums[6 * i + axis], ti.f32)
        presses[axis] = ti.cast(held_sums[6 * i + 3 + axis], ti.f32)
    support = ti.math.vec3(0.0)
    if lighter < 1.0 and stands.norm_sqr() > 0.0 and presses.norm_sqr() > 0.0:
        stands, presses = stands.normalized(), presses.normalized()
        if stands.dot(presses) < MOST_ALIKE:
            support = ti.sqrt(1.0 - ti.max(lighter, LEAST_ANSWER)) * stands
    return support


@func
def turned_to_support(c: ti.i32, contacts: Contacts, support: Vectors) -> ti.math.vec3:
    """Normal of a contact of vertices that have a support: along that, as far as friction holds the wedge.

    Where a ball rests on cloth on a floor, their forces are opposite, along the normal of the floor, and friction is
    what turns that of the ball. To find it by iteration takes too many steps: what is left drives cloth out of the
    wedge.
    """
    n = contacts.normal[c]
    axis, is_supported = ti.math.vec3(0.0), True
    for k in ti.static(range(4)):
        if contacts.weights[c][k] != 0.0:
            own = support[contacts.vertices[c][k]]
            is_supported = is_supported and own.norm_sqr() > 0.0
            axis += ti.abs(contacts.weights[c][k]) * unit_or(own, n)
    if is_supported:
        axis = unit_or(axis, n)
        along = axis.dot(n)
        across = n - along * axis
        if ti.abs(along) > LEAST_COSINE:
            steepness, held = across.norm(), contacts.friction[c] * ti.abs(along)
            n = (along * axis + ti.max(1.0 - held / ti.max(steepness, 1.0e-9), 0.0) * across).normalized()
    return n


@ti.func
def answer_of(support: ti.math.vec3) -> ti.f32:
    """By how much of what its mass says a vertex answers to contacts."""
    return 1.0 - support.norm_sqr()
