"""Steps of the iteration of contacts, all of which push at once, and where the impulses lead."""

import taichi as ti

from sim.cloth.bundles import Contacts, Impulses, PushedBodies, PushedNodes
from sim.cloth.contact_answers import answered, body_mobility, give_body
from sim.cloth.contact_supports import answer_of
from sim.core.arrays import Integers, LongIntegers
from sim.core.bundles import func
from sim.core.reductions import runs_on_gpu

STEPS = 8
"""Steps of the iteration in one launch: what all iterations have at least."""

Momenta = ti.types.vector(STEPS + 1, ti.f32)


@func
def push_apart(
    momenta: Momenta,
    starts: ti.i32,
    count: ti.i32,
    touched_count: ti.i32,
    contacts: Contacts,
    impulses: Impulses,
    nodes: PushedNodes,
    bodies: PushedBodies,
):
    """Some steps of the iteration, `STEPS` in one launch; momenta are their beta_k, and that of the step after them.

    The first launch of an iteration, which `starts` it, notes where that is.

    A step starts from impulses p_k + beta_k (p_k - p_{k-1}) and the displacements that belong to them. It leaves the
    displacements of the next, ahead by beta_{k+1} of those that it has `reached`.
    """
    # Bounds before the first loop: each that is found between two loops would be a launch of its own on a GPU.
    contacts_end, touched_end = count, touched_count
    moved_end = touched_count + bodies.count
    new_end = starts * ti.max(count, touched_count, bodies.count)
    for place in range(new_end):
        if place < touched_count:
            i = nodes.touched[place]
            nodes.start[i] = nodes.displacement[i]
            nodes.reached[i] = nodes.displacement[i]
        if place < bodies.count:
            for m in ti.static(range(2)):
                bodies.motion_start[2 * place + m] = bodies.motion[2 * place + m]
                bodies.motion_reached[2 * place + m] = bodies.motion[2 * place + m]
        if place < count:
            c = impulses.pushing[place]
            impulses.impulse_before[c] = impulses.impulse[c]
            impulses.impulse_given[c] = impulses.impulse[c]
    for step in ti.static(range(STEPS)):
        for place in range(contacts_end):
            push_contact(place, momenta[step], contacts, impulses, nodes, bodies)
        for place in range(moved_end):
            if place < touched_end:
                move_node(nodes.touched[place], momenta[step + 1], impulses, nodes)
            else:
                move_body(place - touched_end, momenta[step + 1], impulses, bodies)


@func
def push_contact(
    place: ti.i32, momentum: ti.f32, contacts: Contacts, impulses: Impulses, nodes: PushedNodes, bodies: PushedBodies
):
    """What a contact gives in a step, from its place in `pushing`."""
    c = impulses.pushing[place]
    ahead = impulses.impulse[c] + momentum * (impulses.impulse[c] - impulses.impulse_before[c])
    after = answered(c, ahead, contacts, impulses, nodes.displacement, bodies.motion)
    impulses.impulse_before[c] = impulses.impulse[c]
    impulses.impulse[c] = after
    impulses.push[place] = (after - ahead) / impulses.unit
    # What nothing moves need not hear of it before the end: its sums are in the way of all threads.
    b = contacts.kind[c]
    most = 0.0
    if b >= 0 and (after - ahead).norm_sqr() > 0.0:
        most = body_mobility(contacts.arm[c], bodies.inverse_mass[b], bodies.inverse_inertia[b])
    if most > 0.0:
        give_body(impulses.push[place], b, contacts.arm[c], bodies.gathered)


@func
def given_to(i: ti.i32, uses: Integers, impulses: Impulses) -> ti.math.vec3:
    """Sum of what the contacts of a vertex give it, in units, each to the nearest unit."""
    x, y, z = ti.cast(0, ti.i64), ti.cast(0, ti.i64), ti.cast(0, ti.i64)
    for use in range(uses[2 * i], uses[2 * i + 1]):
        part = impulses.use_weight[use] * impulses.push[impulses.used_by[use]]
        x, y, z = x + ti.round(part[0], ti.i64), y + ti.round(part[1], ti.i64), z + ti.round(part[2], ti.i64)
    return ti.math.vec3(ti.cast(x, ti.f32), ti.cast(y, ti.f32), ti.cast(z, ti.f32))


@func
def move_node(i: ti.i32, momentum: ti.f32, impulses: Impulses, nodes: PushedNodes):
    """Displace a vertex by what its contacts give it in a step, and ahead by the momentum of the next."""
    given = answer_of(nodes.support[i]) * given_to(i, nodes.uses, impulses)
    u = nodes.displacement[i] + (nodes.inverse_mass[i] * impulses.unit) * given
    nodes.displacement[i] = u + momentum * (u - nodes.reached[i])
    nodes.reached[i] = u


@func
def move_body(b: ti.i32, momentum: ti.f32, impulses: Impulses, bodies: PushedBodies):
    """The same of a body."""
    shift = bodies.motion[2 * b] + (bodies.inverse_mass[b] * impulses.unit) * take(bodies.gathered, 6 * b)
    turn = bodies.motion[2 * b + 1] + impulses.unit * (bodies.inverse_inertia[b] @ take(bodies.gathered, 6 * b + 3))
    bodies.motion[2 * b] = shift + momentum * (shift - bodies.motion_reached[2 * b])
    bodies.motion[2 * b + 1] = turn + momentum * (turn - bodies.motion_reached[2 * b + 1])
    bodies.motion_reached[2 * b] = shift
    bodies.motion_reached[2 * b + 1] = turn


@ti.func
def take(gathered: LongIntegers, first: ti.i32) -> ti.math.vec3:
    """Three sums of integers, which are zero then."""
    push = ti.math.vec3(0.0)
    for axis in ti.static(range(3)):
        push[axis] = ti.cast(gathered[first + axis], ti.f32)
        gathered[first + axis] = ti.cast(0, ti.i64)
    return push


@func
def finish_push(
    finishes: ti.i32,
    count: ti.i32,
    touched_count: ti.i32,
    contacts: Contacts,
    impulses: Impulses,
    nodes: PushedNodes,
    bodies: PushedBodies,
):
    """The displacements that the impulses alone make, from where the iteration started; so both sides get the same.

    Nothing where it does not finish yet: a kernel with it and one without would be compiled, for seconds each.
    """
    # Bounds before the first loop: each that is found between two loops would be a launch of its own on a GPU.
    contacts_end, touched_end, bodies_end = finishes * count, finishes * touched_count, finishes * bodies.count
    for place in range(contacts_end):
        c = impulses.pushing[place]
        impulses.push[place] = (impulses.impulse[c] - impulses.impulse_given[c]) / impulses.unit
        if contacts.kind[c] >= 0:
            give_body(impulses.push[place], contacts.kind[c], contacts.arm[c], bodies.gathered)
    for place in range(touched_end):
        i = nodes.touched[place]
        given = answer_of(nodes.support[i]) * given_to(i, nodes.uses, impulses)
        nodes.displacement[i] = nodes.start[i] + (nodes.inverse_mass[i] * impulses.unit) * given
    if ti.static(not runs_on_gpu()):
        ti.loop_config(serialize=True)
    for b in range(bodies_end):
        for axis in ti.static(range(6)):
            bodies.impulse[6 * b + axis] += bodies.gathered[6 * b + axis]
        bodies.motion[2 * b] = bodies.motion_start[2 * b] + (bodies.inverse_mass[b] * impulses.unit) * take(
            bodies.gathered, 6 * b
        )
        twist = impulses.unit * take(bodies.gathered, 6 * b + 3)
        bodies.motion[2 * b + 1] = bodies.motion_start[2 * b + 1] + bodies.inverse_inertia[b] @ twist
