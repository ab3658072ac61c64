"""What one contact lacks, and the impulse by which it answers, within Coulomb's cone."""

import taichi as ti

from sim.cloth.bundles import Contacts, Impulses
from sim.core.arrays import Floats, LongIntegers, Vectors
from sim.core.bundles import func
from sim.core.warps import add_to, largest_in_warp

Given = ti.types.vector(6, ti.i64)
"""What a body gets of contacts, in their units: impulse and moment."""


@func
def relative_displacement(c: ti.i32, contacts: Contacts, displacement: Vectors, body_motion: Vectors) -> ti.math.vec3:
    """Of the first side of a contact against the second, or against the body [m]."""
    w = ti.math.vec3(0.0)
    for k in ti.static(range(4)):
        if contacts.weights[c][k] != 0.0:
            w += contacts.weights[c][k] * displacement[contacts.vertices[c][k]]
    b = contacts.kind[c]
    if b >= 0:
        w -= body_motion[2 * b] + body_motion[2 * b + 1].cross(contacts.arm[c])
    return w


@func
def answered(
    c: ti.i32, ahead: ti.math.vec3, contacts: Contacts, impulses: Impulses, displacement: Vectors, body_motion: Vectors
) -> ti.math.vec3:
    """The impulse of a contact that has one, by which displacements lead, after a step of the residual over D."""
    n = contacts.normal[c]
    w = relative_displacement(c, contacts, displacement, body_motion)
    along = ti.max(ahead.dot(n) + (contacts.floor[c] - w.dot(n)) / impulses.mobility[c], 0.0)
    sideways = ahead - ahead.dot(n) * n - (w - w.dot(n) * n) / impulses.mobility[c]
    held, length = contacts.friction[c] * along, sideways.norm()
    if length > held:
        sideways *= held / length
    return along * n + sideways


@ti.func
def body_mobility(arm: ti.math.vec3, inverse_mass: ti.f32, inverse_inertia: ti.math.mat3) -> ti.f32:
    """Upper bound of how much a body's point moves per impulse on it [1/kg]."""
    return inverse_mass + arm.norm_sqr() * ti.math.mat3(inverse_inertia).norm()


@ti.func
def give_body(push: ti.math.vec3, body: ti.i32, arm: ti.math.vec3, body_gathered: LongIntegers):
    """Add the opposite of an impulse, in units, to what a body gets, to the nearest unit."""
    give(opposite_of(push, arm), body, body_gathered)


@ti.func
def opposite_of(push: ti.math.vec3, arm: ti.math.vec3) -> Given:
    """The opposite of an impulse, in units, and of its moment, to the nearest unit."""
    twist = arm.cross(push)
    given = Given(0)
    for axis in ti.static(range(3)):
        given[axis], given[3 + axis] = -ti.round(push[axis], ti.i64), -ti.round(twist[axis], ti.i64)
    return given


@ti.func
def give(given: Given, body: ti.i32, body_gathered: LongIntegers):
    """Add what a body gets; of body -1 nothing."""
    if body >= 0:
        for axis in ti.static(range(6)):
            ti.atomic_add(body_gathered[6 * body + axis], given[axis])


@ti.func
def give_body_together(push: ti.math.vec3, body: ti.i32, arm: ti.math.vec3, body_gathered: LongIntegers, item: ti.i32):
    """The same where all threads of a warp call it, for body -1 where there is none: one addition for most of them."""
    common = largest_in_warp(body)
    if body >= 0 and body != common:
        give_body(push, body, arm, body_gathered)
    if common >= 0:
        own = ti.cast(body == common, ti.f32)
        p, twist = own * push, own * arm.cross(push)
        for axis in ti.static(range(3)):
            add_to(body_gathered, 6 * common + axis, -ti.round(p[axis], ti.i64), item)
            add_to(body_gathered, 6 * common + 3 + axis, -ti.round(twist[axis], ti.i64), item)


@ti.func
def thickness_between(vertices: ti.types.vector(4, ti.i32), thickness: Floats) -> ti.f32:
    """Distance that the sides of a pair keep [m]; of a contact with a body or a wall, the thickness of the cloth."""
    return 0.5 * (thickness[vertices[0]] + thickness[vertices[3]])
