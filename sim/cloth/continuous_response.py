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
and threads.
"""

import taichi as ti

from sim.cloth.bundles import Contacts, Impulses, NodeSums, PushedBodies, PushedNodes
from sim.cloth.contact_answers import relative_displacement, thickness_between
from sim.cloth.contact_iteration import Momenta, finish_push, push_apart
from sim.core.arrays import Floats
from sim.core.launch import large_kernel

TOLERANCE = 0.02
"""Part of their thickness by which contacts may miss what they should keep."""


@large_kernel
def push(
    momenta: Momenta,
    starts: ti.i32,
    finishes: ti.i32,
    contacts: Contacts,
    impulses: Impulses,
    nodes: PushedNodes,
    sums: NodeSums,
    thickness: Floats,
    bodies: PushedBodies,
) -> ti.math.ivec4:
    """Some steps of the iteration of a round (`weigh_contacts`), and where they lead if it `finishes`.

    Returns how many contacts push on, how many vertices they push, whether any is below its floor by more than
    `TOLERANCE` then, and whether any were settled.
    """
    # Bounds before the first loop: each that is found between two loops would be a launch of its own on a GPU.
    pushing_count, touched_count = sums.counter[0], sums.counter[1]
    measured_end = finishes * pushing_count
    push_apart(momenta, starts, pushing_count, touched_count, contacts, impulses, nodes, bodies)
    finish_push(finishes, pushing_count, touched_count, contacts, impulses, nodes, bodies)
    for place in range(measured_end):
        c = impulses.pushing[place]
        w = relative_displacement(c, contacts, nodes.displacement, bodies.motion)
        missing = contacts.floor[c] - w.dot(contacts.normal[c])
        if missing / thickness_between(contacts.vertices[c], thickness) > TOLERANCE:
            sums.counter[3] = 1
    return ti.math.ivec4(pushing_count, touched_count, sums.counter[3], sums.counter[4])
