"""Which contacts push in a round, how far each may go at once, and which of them are settled at once."""

import taichi as ti

from sim.cloth.bundles import Contacts, Impulses, NodeSums, PushedBodies, PushedNodes
from sim.cloth.contact_answers import Given, answered, body_mobility, give, give_body_together, opposite_of
from sim.cloth.contact_supports import SHARES_PER_UNIT, answer_of, hold, support_between, turned_to_support
from sim.cloth.proximity_contacts import INACTIVE, WALL
from sim.core.bundles import func
from sim.core.launch import large_kernel
from sim.core.reductions import runs_on_gpu
from sim.core.warps import whole_warps

LEAST_FREE_WEIGHT = 0.05
"""A contact pushes only if its vertices that no pin holds have so much of its weight, so that none moves more than
twenty times what the contact lacks. Others are only watched: a corner far from a contact of two pins is no lever."""

AT_A_TIME = 64
"""Contacts whose impulses on a body a thread of a CPU sums up by itself."""

ALONE = -1
"""In the place of the first use of a vertex: what stands touches it, and nothing else does."""


@large_kernel
def weigh_contacts(
    contacts: Contacts,
    impulses: Impulses,
    vertex_count: ti.i32,
    nodes: PushedNodes,
    sums: NodeSums,
    bodies: PushedBodies,
    is_first: ti.i32,
):
    """List the contacts that push, and compute their diagonal D; before the first round of what was found, forget their
    impulses, and keep what displacements were `predicted` as it was looked for.

    `counter` gets how many there are, and how many vertices they push, which are listed too. Contacts whose free
    vertices weigh less than `LEAST_FREE_WEIGHT` do not push.

    Which of them push a vertex, by their places in `pushing`, and with what weights, is listed in `used_by` and
    `use_weight`, between `uses[2 i]` and `uses[2 i + 1]` of vertex i: then a step sums over the contacts of a vertex,
    without the twelve atomic sums that each contact would otherwise take.

    What stands and touches a vertex that nothing else touches is settled at once: its D is exact, so that one step
    solves it, and no other contact hears of it. In draped cloth these are most of all that push.

    If bodies may move, each vertex between what stands and a body that moves gets its `support`, and its contacts a
    normal along that, from `held_sums`, `lever` and `pressing_body`.
    """
    # Bounds before the first loop: each that is found between two loops would be a launch of its own on a GPU.
    contacts_end, vertices_end, weighed_end = contacts.counter[3], vertex_count, whole_warps(contacts.counter[3])
    all_end = ti.max(vertex_count, bodies.count)
    for k in ti.static(range(5)):
        sums.counter[k] = 0
    for i in range(all_end):
        if i < vertex_count:
            sums.shares[i], nodes.uses[2 * i], nodes.uses[2 * i + 1] = 0, 0, 0
            if is_first == 1:
                sums.predicted[i] = nodes.displacement[i]
            if bodies.may_move == 1:
                sums.lever[i], sums.pressing_body[i] = 0.0, -1
                for k in ti.static(range(6)):
                    sums.held_sums[6 * i + k] = 0
        if i < bodies.count:
            bodies.load[i] = ti.cast(0, ti.i64)
    for c in range(contacts_end):
        impulses.mobility[c] = 0.0
        if contacts.floor[c] > 0.5 * INACTIVE:
            free = 0.0
            for k in ti.static(range(4)):
                if contacts.weights[c][k] != 0.0:
                    share = ti.cast(ti.ceil(ti.abs(contacts.weights[c][k]) * SHARES_PER_UNIT), ti.i32)
                    ti.atomic_add(sums.shares[contacts.vertices[c][k]], share)
                    ti.atomic_add(nodes.uses[2 * contacts.vertices[c][k] + 1], 1)
                    if nodes.inverse_mass[contacts.vertices[c][k]] > 0.0:
                        free += ti.abs(contacts.weights[c][k])
            b = contacts.kind[c]
            most = 0.0
            if b >= 0:
                most = body_mobility(contacts.arm[c], bodies.inverse_mass[b], bodies.inverse_inertia[b])
                if most > 0.0:
                    ti.atomic_add(bodies.load[b], ti.cast(ti.ceil(ti.sqrt(most) / bodies.load_unit), ti.i64))
                    free = 1.0
            if is_of_vertex_and_what_stands(c, contacts, bodies):
                ti.atomic_add(nodes.uses[2 * contacts.vertices[c][0]], 1)
            if bodies.may_move == 1 and (b >= 0 or b == WALL):
                hold(c, contacts, most, sums)
            if free >= LEAST_FREE_WEIGHT:
                impulses.mobility[c] = 1.0
    for i in range(vertices_end):
        if nodes.uses[2 * i] == 1 and nodes.uses[2 * i + 1] == 1:
            nodes.uses[2 * i] = ALONE
        elif sums.shares[i] > 0:
            nodes.touched[ti.atomic_add(sums.counter[1], 1)] = i
            first = ti.atomic_add(sums.counter[2], nodes.uses[2 * i + 1])
            nodes.uses[2 * i], nodes.uses[2 * i + 1] = first, first
        if bodies.may_move == 1:
            b = sums.pressing_body[i]
            nodes.support[i] = ti.math.vec3(0.0)
            if b >= 0 and nodes.inverse_mass[i] > 0.0:
                of_body = sums.lever[i] * ti.cast(bodies.load[b], ti.f32) * bodies.load_unit
                own = nodes.inverse_mass[i] * ti.cast(sums.shares[i], ti.f32) / SHARES_PER_UNIT
                nodes.support[i] = support_between(i, sums.held_sums, of_body / own)
    for first in range(weighed_end):
        # Contacts of a body are neighbours in the list, and threads that add to it wait for each other.
        if first % ti.static(1 if runs_on_gpu() else AT_A_TIME) != 0:
            continue
        given_body, given = -1, Given(0)
        for c in range(first, first + ti.static(1 if runs_on_gpu() else AT_A_TIME)):
            push, body, arm = ti.math.vec3(0.0), -1, ti.math.vec3(0.0)
            if c < contacts_end and impulses.mobility[c] > 0.0:
                if is_first == 1:
                    impulses.impulse[c] = ti.math.vec3(0.0)
                v = contacts.vertices[c][0]
                if nodes.uses[2 * v] == ALONE and is_of_vertex_and_what_stands(c, contacts, bodies):
                    impulses.mobility[c] = nodes.inverse_mass[v]
                    push, body, arm = settle(c, contacts, impulses, nodes, bodies), contacts.kind[c], contacts.arm[c]
                    if sums.counter[4] == 0:
                        sums.counter[4] = 1
                else:
                    place = ti.atomic_add(sums.counter[0], 1)
                    impulses.pushing[place] = c
                    impulses.mobility[c] = weighed(c, place, contacts, impulses, nodes, sums, bodies)
            if ti.static(runs_on_gpu()):
                give_body_together(push, body, arm, bodies.impulse, c)
            elif body >= 0:
                if body != given_body:
                    give(given, given_body, bodies.impulse)
                    given_body, given = body, Given(0)
                given += opposite_of(push, arm)
        give(given, given_body, bodies.impulse)


@func
def weighed(
    c: ti.i32,
    place: ti.i32,
    contacts: Contacts,
    impulses: Impulses,
    nodes: PushedNodes,
    sums: NodeSums,
    bodies: PushedBodies,
) -> ti.f32:
    """The diagonal D of a contact, which gets its place among the uses of its vertices, and its normal."""
    if bodies.may_move == 1 and (contacts.kind[c] >= 0 or contacts.kind[c] == WALL):
        contacts.normal[c] = turned_to_support(c, contacts, nodes.support)
    total = 0.0
    for k in ti.static(range(4)):
        weight = ti.abs(contacts.weights[c][k])
        if weight > 0.0:
            v = contacts.vertices[c][k]
            own = weight * nodes.inverse_mass[v] * (ti.cast(sums.shares[v], ti.f32) / SHARES_PER_UNIT)
            total += answer_of(nodes.support[v]) * own
            use = ti.atomic_add(nodes.uses[2 * v + 1], 1)
            impulses.used_by[use], impulses.use_weight[use] = place, contacts.weights[c][k]
    b = contacts.kind[c]
    if b >= 0:
        most = body_mobility(contacts.arm[c], bodies.inverse_mass[b], bodies.inverse_inertia[b])
        total += ti.sqrt(most) * ti.cast(bodies.load[b], ti.f32) * bodies.load_unit
    return total


@func
def is_of_vertex_and_what_stands(c: ti.i32, contacts: Contacts, bodies: PushedBodies) -> ti.u1:
    """Whether a contact is one of a single vertex with a wall, or with a body that no push moves."""
    b = contacts.kind[c]
    stands = b == WALL
    if b >= 0:
        stands = body_mobility(contacts.arm[c], bodies.inverse_mass[b], bodies.inverse_inertia[b]) == 0.0
    return stands and contacts.weights[c][0] == 1.0


@func
def settle(c: ti.i32, contacts: Contacts, impulses: Impulses, nodes: PushedNodes, bodies: PushedBodies) -> ti.math.vec3:
    """Push the only vertex of a contact, which has no other, by all that it lacks; returns that, in units."""
    v, before = contacts.vertices[c][0], impulses.impulse[c]
    after = answered(c, before, contacts, impulses, nodes.displacement, bodies.motion)
    push = (after - before) / impulses.unit
    impulses.impulse[c] = after
    nodes.displacement[v] += (nodes.inverse_mass[v] * impulses.unit) * ti.round(push)
    return push
