"""What contacts do to the displacements of a substep: a projected Jacobi iteration that keeps momentum.

The displacements u are those nearest to the predicted ones, in the norm of the masses, for which every contact has
n . w >= floor, w = sum_k c_k u_k; friction then takes tangential displacement away, within Coulomb's cone. With
P_c the impulse of contact c times the step, M u changes by sum_c c_k P_c, so that both sides get the same.

All contacts push at once. That overshoots where vertices share contacts; by Cauchy's inequality
|sum_c c_ic P_c|² <= S_i sum_c |c_ic| |P_c|², S_i = sum_c |c_ic|, the matrix of the problem is at most the diagonal
D_c = sum_i |c_ic| S_i / m_i, and steps of the residual over D_c converge (mass splitting, Tonge et al. 2012, with
weights). Where all contacts push alike, as between two layers, D_c is exact and one step does; momentum (Nesterov 1983,
of contacts Mazhar et al. 2015) brings the others.

Sums over contacts are sums of integers, in units far below anything that matters: the same for any order of contacts
and threads. Loops over bodies are serial on a CPU: a few bodies are done sooner than other threads wake.
"""

import taichi as ti

from sim.cloth.bundles import Contacts, Impulses, NodeSums, PushedBodies, PushedNodes
from sim.cloth.contact_answers import relative_displacement, thickness_between
from sim.cloth.contact_iteration import Momenta, finish_push, push_apart
from sim.cloth.contact_weights import weigh_contacts
from sim.core.arrays import Floats
from sim.core.launch import kernel

TOLERANCE = 0.02
"""Part of their thickness by which contacts may miss what they should keep."""


@kernel
def begin_push(
    momenta: Momenta,
    contacts: Contacts,
    impulses: Impulses,
    vertex_count: ti.i32,
    nodes: PushedNodes,
    sums: NodeSums,
    thickness: Floats,
    bodies: PushedBodies,
    is_first: ti.i32,
    is_short: ti.template(),
) -> ti.math.ivec4:
    """A round of the contacts that were found, in one launch: which of them push, some steps of the iteration, and
    where these lead.

    Returns how many contacts push on, how many vertices they push, whether any is below its floor by more than
    `TOLERANCE`, and whether any are settled.
    """
    weigh_contacts(contacts.counter[3], contacts, impulses, vertex_count, nodes, sums, bodies, is_first, is_short)
    pushing_count, touched_count = sums.counter[0], sums.counter[1]
    push_apart(momenta, 1, pushing_count, touched_count, contacts, impulses, nodes, bodies, is_short)
    finish_push(1, pushing_count, touched_count, contacts, impulses, nodes, bodies, is_short)
    if ti.static(is_short):
        ti.loop_config(serialize=True)
    for place in range(pushing_count):
        c = impulses.pushing[place]
        w = relative_displacement(c, contacts, nodes.displacement, bodies.motion)
        missing = contacts.floor[c] - w.dot(contacts.normal[c])
        if missing / thickness_between(contacts.vertices[c], thickness) > TOLERANCE:
            sums.counter[3] = 1
    return ti.math.ivec4(pushing_count, touched_count, sums.counter[3], sums.counter[4])


@kernel
def push_on(
    momenta: Momenta,
    starts: ti.i32,
    finishes: ti.i32,
    count: ti.i32,
    touched_count: ti.i32,
    contacts: Contacts,
    impulses: Impulses,
    nodes: PushedNodes,
    bodies: PushedBodies,
    is_short: ti.template(),
):
    """More steps of the iteration, and where they lead if it `finishes`."""
    push_apart(momenta, starts, count, touched_count, contacts, impulses, nodes, bodies, is_short)
    finish_push(finishes, count, touched_count, contacts, impulses, nodes, bodies, is_short)
