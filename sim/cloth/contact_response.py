"""What contacts do to the displacements of a substep: a projected Jacobi iteration that keeps momentum.

The displacements u are those nearest to the predicted ones, in the norm of the masses, for which every contact has
n . w >= floor, w = sum_k c_k u_k; friction then takes tangential displacement away, within Coulomb's cone. With
P_c the impulse of contact c times the step, M u changes by sum_c c_k P_c, so that both sides get the same. All contacts
push at once, by the residual over D_c = sum_i |c_ic| S_i / m_i, S_i = sum_c |c_ic|, at least the matrix of the problem
by Cauchy's inequality (mass splitting, Tonge et al. 2012, with weights), with momentum (Nesterov 1983). Sums over
contacts are sums of integers: the same for any order of contacts and threads.

A node under a heavy body on a floor passes on what neither its mass nor twenty steps could. So nodes between what
stands and a body that moves, or between one of them and a node that the other touches, as in two layers, have a
`support` e: they answer to contacts by (1 - e²)/m, about as heavily as the body; the rest is the floor's.
"""

import taichi as ti

from sim.cloth.bundles import Contacts, Impulses, PushedBodies, PushedNodes, Response
from sim.cloth.contacts import INACTIVE, WALL, unit_or
from sim.core.arrays import Floats, Integers, LongIntegers, Vectors
from sim.core.bundles import func
from sim.core.launch import large_kernel
from sim.core.reductions import runs_on_gpu
from sim.core.warps import add_to, largest_in_warp, whole_warps

Given = ti.types.vector(6, ti.i64)
"""What a body gets of contacts, in their units: impulse and moment."""

Change = ti.types.matrix(2, 3, ti.f32)
"""How the centre of mass of what moves as one is displaced [m], and how it is turned [rad], in rows."""

AT_A_TIME = 64  # contacts whose impulses on a body a thread of a CPU sums up by itself


@func
def relative_displacement(c: ti.i32, r: Response) -> ti.math.vec3:
    """Of the first side of a contact against the second, or against the body [m]."""
    (contacts,) = ti.static((r.contacts,))
    w = ti.math.vec3(0.0)
    for k in ti.static(range(4)):
        if contacts.weights[c][k] != 0.0:
            w += contacts.weights[c][k] * r.nodes.displacement[contacts.vertices[c][k]]
    b = contacts.kind[c]
    if b >= 0:
        w -= r.bodies.motion[2 * b] + r.bodies.motion[2 * b + 1].cross(contacts.arm[c])
        if ti.static(contacts.drifts):
            w -= contacts.arm[contacts.capacity + c]
    return w


@func
def answered(c: ti.i32, ahead: ti.math.vec3, r: Response) -> ti.math.vec3:
    """The impulse of a contact that has one, by which displacements lead, after a step of the residual over D."""
    contacts, impulses = ti.static((r.contacts, r.impulses))
    n = contacts.normal[c]
    w = relative_displacement(c, r)
    along = ti.max(ahead.dot(n) + (contacts.floor[c] - w.dot(n)) / impulses.mobility[c], 0.0)
    sideways = ahead - ahead.dot(n) * n - (w - w.dot(n) * n) / impulses.mobility[c]
    held, length = contacts.friction[c] * along, sideways.norm()
    if length > held:
        sideways *= held / length
    return along * n + sideways


@func
def body_mobility(c: ti.i32, contacts: Contacts, bodies: PushedBodies) -> ti.f32:
    """Upper bound of how much a contact's point of a body moves per impulse on it [1/kg]; 0 without a body."""
    most, b = 0.0, contacts.kind[c]
    if b >= 0:
        arm = contacts.arm[c]
        if ti.static(bodies.glued):
            arm += bodies.arm[b]
        most = bodies.inverse_mass[b] + arm.norm_sqr() * ti.math.mat3(bodies.inverse_inertia[b]).norm()
    return most


@func
def leader_of(b: ti.i32, bodies: PushedBodies) -> ti.i32:
    """The body that stands for all that move as one with a body."""
    leader = b
    if ti.static(bodies.glued):
        leader = bodies.leader[b]
    return leader


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
def give_together(given: Given, body: ti.i32, body_gathered: LongIntegers, item: ti.i32):
    """The same where all threads of a warp call it: one addition for most of them."""
    common = largest_in_warp(body)
    if body != common:
        give(given, body, body_gathered)
    if common >= 0:
        for axis in ti.static(range(6)):
            add_to(body_gathered, 6 * common + axis, ti.select(body == common, given[axis], ti.cast(0, ti.i64)), item)


@ti.func
def thickness_between(vertices: ti.types.vector(4, ti.i32), thickness: Floats) -> ti.f32:
    """Distance that the sides of a pair keep [m]; of a contact with a body or a wall, the thickness of the cloth."""
    return 0.5 * (thickness[vertices[0]] + thickness[vertices[3]])


SHARES_PER_UNIT = 65536.0  # resolution of the sums of weights; rounded up, so that the diagonal stays an upper bound

MOST_ALIKE = -0.95
"""A vertex is between two sides, and gets a `support`, if the cosine of the angle of their normals is below this: a
heavy node that meets the edge of a body obliquely would kick it."""

LEAST_COSINE = 0.86
"""Contacts are turned to the support of their vertices if the cosine of the angle between both lines is larger."""

STANDS, PRESSED = 1, 2  # bits of `PushedNodes.between`

LEAST_ANSWER = 1.0e-6  # of a vertex that has a support: float32 cannot tell less from none


@func
def hold(c: ti.i32, contacts: Contacts, most: ti.f32, nodes: PushedNodes, bodies: PushedBodies):
    """Sum up which way the vertices of a contact are held by what stands, and pressed by a body that moves."""
    side = ti.select(most > 0.0, 3, 0)
    for k in ti.static(range(4)):
        if contacts.weights[c][k] != 0.0:
            v = contacts.vertices[c][k]
            part = (ti.abs(contacts.weights[c][k]) * SHARES_PER_UNIT) * contacts.normal[c]
            for axis in ti.static(range(3)):
                ti.atomic_add(nodes.held_sums[6 * v + side + axis], ti.round(part[axis], ti.i32))
            ti.atomic_or(nodes.between[v], ti.select(most > 0.0, PRESSED, STANDS))
            if most > 0.0:
                ti.atomic_max(nodes.lever[v], ti.sqrt(most))
                ti.atomic_max(nodes.pressing_body[v], leader_of(contacts.kind[c], bodies))


@func
def pass_on(c: ti.i32, contacts: Contacts, nodes: PushedNodes):
    """Let each side of a contact of cloth with cloth be held, and pressed, as the other is, where nothing else does."""
    for sign in ti.static((1.0, -1.0)):
        known, lever, body = 0, 0.0, -1
        for k in ti.static(range(4)):
            v = contacts.vertices[c][k]
            if sign * contacts.weights[c][k] < 0.0:
                known |= nodes.between[v]
                if nodes.between[v] & PRESSED != 0:
                    lever, body = ti.max(lever, nodes.lever[v]), ti.max(body, nodes.pressing_body[v])
        for k in ti.static(range(4)):
            v = contacts.vertices[c][k]
            if sign * contacts.weights[c][k] > 0.0:
                part, more = (contacts.weights[c][k] * SHARES_PER_UNIT) * contacts.normal[c], known & ~nodes.between[v]
                for axis in ti.static(range(3)):
                    if more & STANDS != 0:
                        ti.atomic_add(nodes.held_sums[6 * v + axis], ti.round(part[axis], ti.i32))
                    if more & PRESSED != 0:
                        ti.atomic_add(nodes.held_sums[6 * v + 3 + axis], ti.round(part[axis], ti.i32))
                if more & PRESSED != 0:
                    ti.atomic_max(nodes.lever[v], lever)
                    ti.atomic_max(nodes.pressing_body[v], body)


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

    Where a ball rests on cloth on a floor, their forces are opposite, along the normal of the floor, as friction turns
    that of the ball: to find it by iteration takes too many steps.
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


LEAST_FREE_WEIGHT = 0.05
"""A contact pushes only if its vertices that no pin holds have so much of its weight, so that none moves more than
twenty times what the contact lacks. Others are only watched: a corner far from a contact of two pins is no lever."""

ALONE = -1  # in the place of the first use of a vertex: what stands touches it, and nothing else does


@large_kernel
def weigh_contacts(r: Response, vertex_count: ti.i32, is_first: ti.i32):
    """List the contacts that push, and compute their diagonal D; before the first round of what was found, forget their
    impulses, and keep what displacements were `predicted` as it was looked for.

    `counter` gets how many there are, and how many vertices they push, which are listed too. Which of them push vertex
    i, by their places in `pushing`, and with what weights, is listed in `used_by` and `use_weight`, between `uses[2 i]`
    and `uses[2 i + 1]`, so that a step needs no atomic sums. What stands and touches a vertex that nothing else touches
    is settled in one step (`settle_all`), as its D is exact. If bodies may move, each vertex between what stands and a
    body that moves gets its `support`, and its contacts a normal along that.
    """
    contacts, impulses, nodes, bodies = ti.static((r.contacts, r.impulses, r.nodes, r.bodies))
    # Bounds before the first loop: each that is found between two loops would be a launch of its own on a GPU.
    contacts_end, vertices_end = contacts.counter[2], vertex_count
    braced_end, all_end = bodies.may_move * contacts_end, ti.max(vertex_count, bodies.count)
    for k in ti.static(range(5)):
        nodes.counter[k] = 0
    for i in range(all_end):
        if i < vertex_count:
            nodes.shares[i], nodes.uses[2 * i], nodes.uses[2 * i + 1] = 0, 0, 0
            if is_first == 1:
                nodes.predicted[i] = nodes.displacement[i]
            if bodies.may_move == 1:
                nodes.lever[i], nodes.pressing_body[i], nodes.between[i] = 0.0, -1, 0
                for k in ti.static(range(6)):
                    nodes.held_sums[6 * i + k] = 0
        if i < bodies.count:
            bodies.load[i] = ti.cast(0, ti.i64)
    for c in range(contacts_end):
        impulses.mobility[c] = 0.0
        if contacts.floor[c] > 0.5 * INACTIVE:
            free = 0.0
            for k in ti.static(range(4)):
                if contacts.weights[c][k] != 0.0:
                    share = ti.cast(ti.ceil(ti.abs(contacts.weights[c][k]) * SHARES_PER_UNIT), ti.i32)
                    ti.atomic_add(nodes.shares[contacts.vertices[c][k]], share)
                    ti.atomic_add(nodes.uses[2 * contacts.vertices[c][k] + 1], 1)
                    if nodes.inverse_mass[contacts.vertices[c][k]] > 0.0:
                        free += ti.abs(contacts.weights[c][k])
            b, most = contacts.kind[c], body_mobility(c, contacts, bodies)
            if most > 0.0:
                part = ti.cast(ti.ceil(ti.sqrt(most) / bodies.load_unit), ti.i64)
                ti.atomic_add(bodies.load[leader_of(b, bodies)], part)
                free = 1.0
            if is_of_vertex_and_what_stands(c, contacts, bodies):
                ti.atomic_add(nodes.uses[2 * contacts.vertices[c][0]], 1)
            if bodies.may_move == 1 and (b >= 0 or b == WALL):
                hold(c, contacts, most, nodes, bodies)
            if free >= LEAST_FREE_WEIGHT:
                impulses.mobility[c] = 1.0
    for c in range(braced_end):
        if contacts.floor[c] > 0.5 * INACTIVE and WALL < contacts.kind[c] < 0:
            pass_on(c, contacts, nodes)
    for i in range(vertices_end):
        if nodes.uses[2 * i] == 1 and nodes.uses[2 * i + 1] == 1:
            nodes.uses[2 * i] = ALONE
        elif nodes.shares[i] > 0:
            nodes.touched[ti.atomic_add(nodes.counter[1], 1)] = i
            first = ti.atomic_add(nodes.counter[2], nodes.uses[2 * i + 1])
            nodes.uses[2 * i], nodes.uses[2 * i + 1] = first, first
        if bodies.may_move == 1:
            b = nodes.pressing_body[i]
            nodes.support[i] = ti.math.vec3(0.0)
            if b >= 0 and nodes.inverse_mass[i] > 0.0:
                of_body = nodes.lever[i] * ti.cast(bodies.load[b], ti.f32) * bodies.load_unit
                own = nodes.inverse_mass[i] * ti.cast(nodes.shares[i], ti.f32) / SHARES_PER_UNIT
                nodes.support[i] = support_between(i, nodes.held_sums, of_body / own)
    for c in range(contacts_end):
        if impulses.mobility[c] > 0.0:
            if is_first == 1:
                impulses.impulse[c] = ti.math.vec3(0.0)
            if is_settled(c, r):
                impulses.mobility[c] = nodes.inverse_mass[contacts.vertices[c][0]]
                if nodes.counter[4] == 0:
                    nodes.counter[4] = 1
            else:
                place = ti.atomic_add(nodes.counter[0], 1)
                impulses.pushing[place] = c
                impulses.mobility[c] = weighed(c, place, r)


@func
def weighed(c: ti.i32, place: ti.i32, r: Response) -> ti.f32:
    """The diagonal D of a contact, which gets its place among the uses of its vertices, and its normal."""
    contacts, impulses, nodes, bodies = ti.static((r.contacts, r.impulses, r.nodes, r.bodies))
    if bodies.may_move == 1 and (contacts.kind[c] >= 0 or contacts.kind[c] == WALL):
        contacts.normal[c] = turned_to_support(c, contacts, nodes.support)
    total = 0.0
    for k in ti.static(range(4)):
        weight = ti.abs(contacts.weights[c][k])
        if weight > 0.0:
            v = contacts.vertices[c][k]
            own = weight * nodes.inverse_mass[v] * (ti.cast(nodes.shares[v], ti.f32) / SHARES_PER_UNIT)
            total += answer_of(nodes.support[v]) * own
            use = ti.atomic_add(nodes.uses[2 * v + 1], 1)
            impulses.used_by[use], impulses.use_weight[use] = place, contacts.weights[c][k]
    if contacts.kind[c] >= 0:
        load = ti.cast(bodies.load[leader_of(contacts.kind[c], bodies)], ti.f32) * bodies.load_unit
        total += ti.sqrt(body_mobility(c, contacts, bodies)) * load
    return total


@func
def is_of_vertex_and_what_stands(c: ti.i32, contacts: Contacts, bodies: PushedBodies) -> ti.u1:
    """Whether a contact is one of a single vertex with a wall, or with a body that no push moves."""
    is_against = contacts.kind[c] >= 0 or contacts.kind[c] == WALL
    return is_against and body_mobility(c, contacts, bodies) == 0.0 and contacts.weights[c][0] == 1.0


@func
def is_settled(c: ti.i32, r: Response) -> ti.u1:
    """Whether a contact that pushes is settled in one step."""
    return r.nodes.uses[2 * r.contacts.vertices[c][0]] == ALONE and is_of_vertex_and_what_stands(
        c, r.contacts, r.bodies
    )


@func
def settle_all(count: ti.i32, whole_end: ti.i32, r: Response):
    """Settle those of so many contacts that one step solves; `whole_end` is that of whole warps."""
    contacts, impulses, bodies = ti.static((r.contacts, r.impulses, r.bodies))
    for first in range(whole_end):
        # Contacts of a body are neighbours in the list, and threads that add to it wait for each other.
        if first % ti.static(1 if runs_on_gpu() else AT_A_TIME) != 0:
            continue
        given_body, given = -1, Given(0)
        for c in range(first, first + ti.static(1 if runs_on_gpu() else AT_A_TIME)):
            body, more = -1, Given(0)
            settles = False
            if c < count:  # what functions read is read whatever stands before an `and`
                settles = impulses.mobility[c] > 0.0 and is_settled(c, r)
            if settles:
                push = settle(c, r)
                body = contacts.kind[c]
                if body >= 0:
                    more = opposite_of(push, contacts.arm[c])
            if ti.static(runs_on_gpu()):
                give_together(more, body, bodies.impulse, c)
            elif body >= 0:
                if body != given_body:
                    give(given, given_body, bodies.impulse)
                    given_body, given = body, Given(0)
                given += more
        give(given, given_body, bodies.impulse)


@func
def settle(c: ti.i32, r: Response) -> ti.math.vec3:
    """Push the only vertex of a contact, which has no other, by all that it lacks; returns that, in units."""
    impulses, nodes = ti.static((r.impulses, r.nodes))
    v, before = r.contacts.vertices[c][0], impulses.impulse[c]
    after = answered(c, before, r)
    push = (after - before) / impulses.unit
    impulses.impulse[c] = after
    nodes.displacement[v] += (nodes.inverse_mass[v] * impulses.unit) * ti.round(push)
    return push


STEPS = 8  # steps of the iteration in one launch: what all iterations have at least

Momenta = ti.types.vector(STEPS + 1, ti.f32)


@func
def push_apart(momenta: Momenta, new_end: ti.i32, count: ti.i32, touched_count: ti.i32, moved_end: ti.i32, r: Response):
    """Some steps of the iteration, `STEPS` in one launch; momenta are their beta_k, and that of the step after them.

    A step starts from impulses p_k + beta_k (p_k - p_{k-1}) and the displacements that belong to them. It leaves the
    displacements of the next, ahead by beta_{k+1} of those that it has `reached`. The first launch of an iteration
    notes where that is, at `new_end` places; bodies follow the vertices up to `moved_end`.
    """
    impulses, nodes, bodies = ti.static((r.impulses, r.nodes, r.bodies))
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
        for place in range(count):
            push_contact(place, momenta[step], r)
        for place in range(moved_end):
            if place < touched_count:
                move_node(nodes.touched[place], momenta[step + 1], r)
            else:
                move_body(place - touched_count, momenta[step + 1], r)


@func
def push_contact(place: ti.i32, momentum: ti.f32, r: Response):
    """What a contact gives in a step, from its place in `pushing`."""
    contacts, impulses, bodies = ti.static((r.contacts, r.impulses, r.bodies))
    c = impulses.pushing[place]
    ahead = impulses.impulse[c] + momentum * (impulses.impulse[c] - impulses.impulse_before[c])
    after = answered(c, ahead, r)
    impulses.impulse_before[c] = impulses.impulse[c]
    impulses.impulse[c] = after
    impulses.push[place] = (after - ahead) / impulses.unit
    # What nothing moves need not hear of it before the end: its sums are in the way of all threads.
    if (after - ahead).norm_sqr() > 0.0 and body_mobility(c, contacts, bodies) > 0.0:
        give(opposite_of(impulses.push[place], contacts.arm[c]), contacts.kind[c], bodies.gathered)


@func
def given_to(i: ti.i32, uses: Integers, impulses: Impulses) -> ti.math.vec3:
    """Sum of what the contacts of a vertex give it, in units, each to the nearest unit."""
    x, y, z = ti.cast(0, ti.i64), ti.cast(0, ti.i64), ti.cast(0, ti.i64)
    for use in range(uses[2 * i], uses[2 * i + 1]):
        part = impulses.use_weight[use] * impulses.push[impulses.used_by[use]]
        x, y, z = x + ti.round(part[0], ti.i64), y + ti.round(part[1], ti.i64), z + ti.round(part[2], ti.i64)
    return ti.math.vec3(ti.cast(x, ti.f32), ti.cast(y, ti.f32), ti.cast(z, ti.f32))


@func
def move_node(i: ti.i32, momentum: ti.f32, r: Response):
    """Displace a vertex by what its contacts give it in a step, and ahead by the momentum of the next."""
    impulses, nodes = ti.static((r.impulses, r.nodes))
    given = answer_of(nodes.support[i]) * given_to(i, nodes.uses, impulses)
    u = nodes.displacement[i] + (nodes.inverse_mass[i] * impulses.unit) * given
    nodes.displacement[i] = u + momentum * (u - nodes.reached[i])
    nodes.reached[i] = u


@func
def move_body(b: ti.i32, momentum: ti.f32, r: Response):
    """The same of a body and of all that it leads."""
    (bodies,) = ti.static((r.bodies,))
    if leader_of(b, bodies) == b:
        change = moved_by(b, r)
        number = b
        while number >= 0:
            shift = bodies.motion[2 * number] + shift_of(number, change, bodies)
            turn = bodies.motion[2 * number + 1] + change[1, :]
            bodies.motion[2 * number] = shift + momentum * (shift - bodies.motion_reached[2 * number])
            bodies.motion[2 * number + 1] = turn + momentum * (turn - bodies.motion_reached[2 * number + 1])
            bodies.motion_reached[2 * number] = shift
            bodies.motion_reached[2 * number + 1] = turn
            number = next_of(number, bodies)


@func
def moved_by(b: ti.i32, r: Response) -> Change:
    """How what a body and all that it leads have gathered, which is nothing then, moves them."""
    (bodies,) = ti.static((r.bodies,))
    push, twist = ti.math.vec3(0.0), ti.math.vec3(0.0)
    number = b
    while number >= 0:
        own = take(bodies.gathered, 6 * number)
        push += own
        twist += take(bodies.gathered, 6 * number + 3)
        if ti.static(bodies.glued):
            twist += bodies.arm[number].cross(own)
        number = next_of(number, bodies)
    shift = (bodies.inverse_mass[b] * r.impulses.unit) * push
    turn = r.impulses.unit * (bodies.inverse_inertia[b] @ twist)
    return ti.Matrix.rows([shift, turn])


@func
def shift_of(b: ti.i32, change: Change, bodies: PushedBodies) -> ti.math.vec3:
    """How far the centre of mass of a body moves with all that moves as one with it [m]."""
    shift = change[0, :]
    if ti.static(bodies.glued):
        shift += change[1, :].cross(bodies.arm[b])
    return shift


@func
def next_of(b: ti.i32, bodies: PushedBodies) -> ti.i32:
    """The next of those that move as one, or -1."""
    following = -1
    if ti.static(bodies.glued):
        following = bodies.next[b]
    return following


@ti.func
def take(gathered: LongIntegers, first: ti.i32) -> ti.math.vec3:
    """Three sums of integers, which are zero then."""
    push = ti.math.vec3(0.0)
    for axis in ti.static(range(3)):
        push[axis] = ti.cast(gathered[first + axis], ti.f32)
        gathered[first + axis] = ti.cast(0, ti.i64)
    return push


@func
def finish_push(count: ti.i32, touched_count: ti.i32, moved_end: ti.i32, r: Response):
    """The displacements that the impulses alone make, from where the iteration started; so both sides get the same.

    Nothing where there are no places, as it does not finish yet: one kernel, not two to be compiled.
    """
    contacts, impulses, nodes, bodies = ti.static((r.contacts, r.impulses, r.nodes, r.bodies))
    for place in range(count):
        c = impulses.pushing[place]
        impulses.push[place] = (impulses.impulse[c] - impulses.impulse_given[c]) / impulses.unit
        if contacts.kind[c] >= 0:
            give(opposite_of(impulses.push[place], contacts.arm[c]), contacts.kind[c], bodies.gathered)
    for place in range(moved_end):
        if place < touched_count:
            i = nodes.touched[place]
            given = answer_of(nodes.support[i]) * given_to(i, nodes.uses, impulses)
            nodes.displacement[i] = nodes.start[i] + (nodes.inverse_mass[i] * impulses.unit) * given
        else:
            leave_body(place - touched_count, r)


@func
def leave_body(b: ti.i32, r: Response):
    """Motion of a body and of all that it leads as the impulses of an iteration make it."""
    (bodies,) = ti.static((r.bodies,))
    if leader_of(b, bodies) == b:
        number = b
        while number >= 0:
            for axis in ti.static(range(6)):
                bodies.impulse[6 * number + axis] += bodies.gathered[6 * number + axis]
            number = next_of(number, bodies)
        change = moved_by(b, r)
        number = b
        while number >= 0:
            bodies.motion[2 * number] = bodies.motion_start[2 * number] + shift_of(number, change, bodies)
            bodies.motion[2 * number + 1] = bodies.motion_start[2 * number + 1] + change[1, :]
            number = next_of(number, bodies)


TOLERANCE = 0.02  # part of their thickness by which contacts may miss what they should keep


@large_kernel
def push(
    momenta: Momenta, starts: ti.i32, settles: ti.i32, finishes: ti.i32, r: Response, thickness: Floats
) -> ti.math.ivec3:
    """Some steps of the iteration of a round of contacts that were weighed (`weigh_contacts`), and where they lead if
    it `finishes`; first those that one step solves, if it `settles` them.

    Returns how many contacts push on, whether any is below its floor by more than `TOLERANCE` then, and whether any are
    settled.
    """
    contacts, nodes = ti.static((r.contacts, r.nodes))
    # Bounds before the first loop: each that is found between two loops would be a launch of its own on a GPU.
    pushing_count, touched_count = nodes.counter[0], nodes.counter[1]
    moved_end = touched_count + r.bodies.count
    new_end = starts * ti.max(pushing_count, moved_end)
    finished_end, finished_moved_end = finishes * pushing_count, finishes * moved_end
    settled_end = settles * nodes.counter[4] * contacts.counter[2]
    whole_end = whole_warps(settled_end)
    nodes.counter[3] = 0
    settle_all(settled_end, whole_end, r)
    push_apart(momenta, new_end, pushing_count, touched_count, moved_end, r)
    finish_push(finished_end, touched_count, finished_moved_end, r)
    for place in range(finished_end):
        c = r.impulses.pushing[place]
        w = relative_displacement(c, r)
        missing = contacts.floor[c] - w.dot(contacts.normal[c])
        if missing / thickness_between(contacts.vertices[c], thickness) > TOLERANCE:
            nodes.counter[3] = 1
    return ti.math.ivec3(pushing_count, nodes.counter[3], nodes.counter[4])
