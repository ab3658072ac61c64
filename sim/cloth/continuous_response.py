"""What contacts do to the displacements of a substep: a projected Jacobi iteration that keeps momentum.

The displacements u are those nearest to the predicted ones, in the norm of the masses, for which every contact has
n . w >= floor, w = sum_k c_k u_k; friction then takes tangential displacement away, within Coulomb's cone. With
P_c the impulse of contact c times the step, M u changes by sum_c c_k P_c, so that both sides get the same.

All contacts push at once. That overshoots where vertices share contacts; by Cauchy's inequality
|sum_c c_ic P_c|² <= S_i sum_c |c_ic| |P_c|², S_i = sum_c |c_ic|, the matrix of the problem is at most the diagonal
D_c = sum_i |c_ic| S_i / m_i, and steps of the residual over D_c converge (mass splitting, Tonge et al. 2012, with
weights). Where all contacts push alike, as between two layers, D_c is exact and one step does; momentum (Nesterov 1983,
of contacts Mazhar et al. 2015) brings the others.

A node under a heavy body on a floor passes on what neither its mass nor twenty steps could: D_c of it is ten thousand
times too large for the body, which would fall through. So nodes between what stands and a body that moves have a
`brace` e: they answer to contacts by (1 - e²)/m, about as heavily as the body. What the answer keeps from them is the
floor's, so that the momentum of cloth and bodies changes by what stands alone. Nodes that are pressed from both sides
do not leave or enter either whatever their mass. But the cloth's own springs pull them from under the body more easily
than its friction would let them.

Sums over contacts are sums of integers, in units far below anything that matters: the same for any order of contacts
and threads. Loops over bodies are serial on a CPU: a few bodies are done sooner than other threads wake.
"""

import taichi as ti

from sim.arrays import Floats, Integers, LongIntegers, Matrices, Vectors
from sim.cloth.proximity import unit_or
from sim.cloth.proximity_contacts import EDGE_EDGE, INACTIVE, WALL, Quadruples, Weights
from sim.launch import fast_launch
from sim.reductions import reduced, runs_on_gpu

SHARES_PER_UNIT = 65536.0
"""Resolution of the sums of weights; rounded up, so that the diagonal stays an upper bound."""

LEAST_FREE_WEIGHT = 0.05
"""A contact pushes only if its vertices that no pin holds have so much of its weight, so that none moves more than
twenty times what the contact lacks. Others are only watched: a corner far from a contact of two pins is no lever."""

LARGEST_SHARE = 0.9
"""How much of a pair's separation a substep may use up: what is left keeps the sides apart for the next one."""

KEPT_BY_REPAIR = 0.3
"""Share of its separation that a pair keeps which would have crossed: above 1 - `LARGEST_SHARE`."""

STEPS = 8
"""Steps of the iteration in one launch: what all iterations have at least."""

Momenta = ti.types.vector(STEPS + 1, ti.f32)

MOST_ALIKE = -0.95
"""A vertex is between two sides, and gets a brace, if the cosine of the angle of their normals is below this: a heavy
node that meets the edge of a body obliquely would kick it."""

LEAST_COSINE = 0.86
"""Contacts are turned to a brace if the cosine of the angle between it and their normal, either way, is above this."""

LEAST_ANSWER = 1.0e-6
"""Of a vertex that has a brace: float32 tells no less from none."""

ROUNDING = 1.0e-6
"""Relative rounding of a separation in float32, in lengths of the elements."""


@ti.func
def weigh_contacts(
    count: ti.i32, vertices: Quadruples, weights: Weights, normal: Vectors, floor: Floats, kind: Integers,
    arm: Vectors, friction: Floats, mobility: Floats, impulse: Vectors, pushing: Integers, counter: Integers,
    vertex_count: ti.i32, displacement: Vectors, predicted: Vectors, inverse_mass: Floats, shares: Integers,
    touched: Integers, uses: Integers, used_by: Integers, use_weight: Floats, held_sums: Integers, lever: Floats,
    presser: Integers, brace: Vectors, body_count: ti.i32, body_inverse_mass: Floats, body_inverse_inertia: Matrices,
    body_load: LongIntegers, load_unit: ti.f32, braces: ti.i32, is_first: ti.template(), is_short: ti.template(),
):  # fmt: skip
    """List the contacts that push, and compute their diagonal D; before the first round, forget their impulses, and
    keep what displacements were `predicted` without contacts.

    `counter` gets how many there are, and how many vertices they push, which are listed too. Contacts whose free
    vertices weigh less than `LEAST_FREE_WEIGHT` do not push.

    Which of them push a vertex, by their places in `pushing`, and with what weights, is listed in `used_by` and
    `use_weight`, between `uses[2 i]` and `uses[2 i + 1]` of vertex i: then a step sums over the contacts of a vertex,
    without the twelve atomic sums that each contact would otherwise take.

    If `braces`, each vertex between what stands and a body that moves gets its `brace`, and its contacts a normal along
    that; `held_sums`, `lever` and `presser` are what is summed up for it.
    """
    # Bounds before the first loop: each that is found between two loops would be a launch of its own on a GPU.
    contacts_end, vertices_end, bodies_end, braced_end = count, vertex_count, body_count, braces * vertex_count
    counter[0], counter[1], counter[2] = 0, 0, 0
    if ti.static(is_short):
        ti.loop_config(serialize=True)
    for i in range(vertices_end):
        shares[i], uses[2 * i], uses[2 * i + 1] = 0, 0, 0
        if ti.static(is_first):
            predicted[i] = displacement[i]
    if ti.static(is_short):
        ti.loop_config(serialize=True)
    for i in range(braced_end):
        lever[i], presser[i] = 0.0, -1
        for k in ti.static(range(6)):
            held_sums[6 * i + k] = 0
    if ti.static(not runs_on_gpu()):
        ti.loop_config(serialize=True)
    for b in range(bodies_end):
        body_load[b] = ti.cast(0, ti.i64)
    if ti.static(is_short):
        ti.loop_config(serialize=True)
    for c in range(contacts_end):
        if floor[c] > 0.5 * INACTIVE:
            free = 0.0
            for k in ti.static(range(4)):
                if weights[c][k] != 0.0:
                    share = ti.cast(ti.ceil(ti.abs(weights[c][k]) * SHARES_PER_UNIT), ti.i32)
                    ti.atomic_add(shares[vertices[c][k]], share)
                    ti.atomic_add(uses[2 * vertices[c][k] + 1], 1)
                    if inverse_mass[vertices[c][k]] > 0.0:
                        free += ti.abs(weights[c][k])
            b = kind[c]
            most = 0.0
            if b >= 0:
                most = body_mobility(arm[c], body_inverse_mass[b], body_inverse_inertia[b])
                if most > 0.0:
                    ti.atomic_add(body_load[b], ti.cast(ti.ceil(ti.sqrt(most) / load_unit), ti.i64))
                    free = 1.0
            if braces == 1 and (b >= 0 or b == WALL):
                hold(c, vertices, weights, normal, kind, most, held_sums, lever, presser)
            if free >= LEAST_FREE_WEIGHT:
                pushing[ti.atomic_add(counter[0], 1)] = c
    if ti.static(is_short):
        ti.loop_config(serialize=True)
    for i in range(vertices_end):
        if shares[i] > 0:
            touched[ti.atomic_add(counter[1], 1)] = i
            first = ti.atomic_add(counter[2], uses[2 * i + 1])
            uses[2 * i], uses[2 * i + 1] = first, first
    if ti.static(is_short):
        ti.loop_config(serialize=True)
    for i in range(braced_end):
        b = presser[i]
        brace[i] = ti.math.vec3(0.0)
        if b >= 0 and inverse_mass[i] > 0.0:
            of_body = lever[i] * ti.cast(body_load[b], ti.f32) * load_unit
            own = inverse_mass[i] * ti.cast(shares[i], ti.f32) / SHARES_PER_UNIT
            brace[i] = brace_between(i, held_sums, of_body / own)
    if ti.static(is_short):
        ti.loop_config(serialize=True)
    for place in range(counter[0]):
        c = pushing[place]
        if ti.static(is_first):
            impulse[c] = ti.math.vec3(0.0)
        if braces == 1 and (kind[c] >= 0 or kind[c] == WALL):
            normal[c] = turned_to_brace(c, vertices, weights, normal, friction, brace)
        total = 0.0
        for k in ti.static(range(4)):
            weight = ti.abs(weights[c][k])
            if weight > 0.0:
                v = vertices[c][k]
                own = weight * inverse_mass[v] * (ti.cast(shares[v], ti.f32) / SHARES_PER_UNIT)
                total += answer_of(brace[v]) * own
                use = ti.atomic_add(uses[2 * v + 1], 1)
                used_by[use], use_weight[use] = place, weights[c][k]
        b = kind[c]
        if b >= 0:
            most = body_mobility(arm[c], body_inverse_mass[b], body_inverse_inertia[b])
            total += ti.sqrt(most) * ti.cast(body_load[b], ti.f32) * load_unit
        mobility[c] = total


@ti.func
def hold(
    c: ti.i32, vertices: Quadruples, weights: Weights, normal: Vectors, kind: Integers, most: ti.f32,
    held_sums: Integers, lever: Floats, presser: Integers,
):  # fmt: skip
    """Sum up which way the vertices of a contact are held by what stands, and pressed by a body that moves."""
    side = ti.select(most > 0.0, 3, 0)
    for k in ti.static(range(4)):
        if weights[c][k] != 0.0:
            v = vertices[c][k]
            part = (ti.abs(weights[c][k]) * SHARES_PER_UNIT) * normal[c]
            for axis in ti.static(range(3)):
                ti.atomic_add(held_sums[6 * v + side + axis], ti.round(part[axis], ti.i32))
            if most > 0.0:
                ti.atomic_max(lever[v], ti.sqrt(most))
                ti.atomic_max(presser[v], kind[c])


@ti.func
def brace_between(i: ti.i32, held_sums: Integers, lighter: ti.f32) -> ti.math.vec3:
    """Brace of a vertex of which a body's share of a contact's mobility is `lighter` times its own; 0 if free."""
    stands, presses = ti.math.vec3(0.0), ti.math.vec3(0.0)
    for axis in ti.static(range(3)):
        stands[axis] = ti.cast(held_sums[6 * i + axis], ti.f32)
        presses[axis] = ti.cast(held_sums[6 * i + 3 + axis], ti.f32)
    brace = ti.math.vec3(0.0)
    if lighter < 1.0 and stands.norm_sqr() > 0.0 and presses.norm_sqr() > 0.0:
        stands, presses = stands.normalized(), presses.normalized()
        if stands.dot(presses) < MOST_ALIKE:
            brace = ti.sqrt(1.0 - ti.max(lighter, LEAST_ANSWER)) * stands
    return brace


@ti.func
def turned_to_brace(
    c: ti.i32, vertices: Quadruples, weights: Weights, normal: Vectors, friction: Floats, brace: Vectors
) -> ti.math.vec3:  # fmt: skip
    """Normal of a contact of vertices that have a brace: along that, as far as friction holds the wedge.

    Where a ball rests on cloth on a floor, their forces are opposite, along the normal of the floor, and friction is
    what turns that of the ball. To find it by iteration takes too many steps: what is left drives cloth out of the
    wedge.
    """
    n = normal[c]
    axis, is_braced = ti.math.vec3(0.0), True
    for k in ti.static(range(4)):
        if weights[c][k] != 0.0:
            own = brace[vertices[c][k]]
            is_braced = is_braced and own.norm_sqr() > 0.0
            axis += ti.abs(weights[c][k]) * unit_or(own, n)
    if is_braced:
        axis = unit_or(axis, n)
        along = axis.dot(n)
        across = n - along * axis
        if ti.abs(along) > LEAST_COSINE:
            steepness, held = across.norm(), friction[c] * ti.abs(along)
            n = (along * axis + ti.max(1.0 - held / ti.max(steepness, 1.0e-9), 0.0) * across).normalized()
    return n


@ti.func
def answer_of(brace: ti.math.vec3) -> ti.f32:
    """By how much of what its mass says a vertex answers to contacts."""
    return 1.0 - brace.norm_sqr()


@ti.func
def body_mobility(arm: ti.math.vec3, inverse_mass: ti.f32, inverse_inertia: ti.math.mat3) -> ti.f32:
    """Upper bound of how much a body's point moves per impulse on it [1/kg]."""
    return inverse_mass + arm.norm_sqr() * ti.math.mat3(inverse_inertia).norm()


@ti.func
def relative_displacement(
    c: ti.i32, vertices: Quadruples, weights: Weights, displacement: Vectors, kind: Integers, arm: Vectors,
    body_motion: Vectors,
) -> ti.math.vec3:  # fmt: skip
    """Of the first side of a contact against the second, or against the body [m]."""
    w = ti.math.vec3(0.0)
    for k in ti.static(range(4)):
        if weights[c][k] != 0.0:
            w += weights[c][k] * displacement[vertices[c][k]]
    b = kind[c]
    if b >= 0:
        w -= body_motion[2 * b] + body_motion[2 * b + 1].cross(arm[c])
    return w


@ti.func
def give_body(push: ti.math.vec3, body: ti.i32, arm: ti.math.vec3, body_gathered: LongIntegers):
    """Add the opposite of an impulse, in units, to what a body gets, to the nearest unit."""
    twist = arm.cross(push)
    for axis in ti.static(range(3)):
        ti.atomic_add(body_gathered[6 * body + axis], -ti.round(push[axis], ti.i64))
        ti.atomic_add(body_gathered[6 * body + 3 + axis], -ti.round(twist[axis], ti.i64))


@ti.func
def given_to(i: ti.i32, uses: Integers, used_by: Integers, use_weight: Floats, push: Vectors) -> ti.math.vec3:
    """Sum of what the contacts of a vertex give it, in units, each to the nearest unit."""
    x, y, z = ti.cast(0, ti.i64), ti.cast(0, ti.i64), ti.cast(0, ti.i64)
    for use in range(uses[2 * i], uses[2 * i + 1]):
        part = use_weight[use] * push[used_by[use]]
        x, y, z = x + ti.round(part[0], ti.i64), y + ti.round(part[1], ti.i64), z + ti.round(part[2], ti.i64)
    return ti.math.vec3(ti.cast(x, ti.f32), ti.cast(y, ti.f32), ti.cast(z, ti.f32))


@ti.func
def thickness_between(vertices: ti.types.vector(4, ti.i32), thickness: Floats) -> ti.f32:
    """Distance that the sides of a pair keep [m]; of a contact with a body or a wall, the thickness of the cloth."""
    return 0.5 * (thickness[vertices[0]] + thickness[vertices[3]])


@ti.func
def take(gathered: LongIntegers, first: ti.i32) -> ti.math.vec3:
    """Three sums of integers, which are zero then."""
    push = ti.math.vec3(0.0)
    for axis in ti.static(range(3)):
        push[axis] = ti.cast(gathered[first + axis], ti.f32)
        gathered[first + axis] = ti.cast(0, ti.i64)
    return push


@ti.func
def push_apart(
    momenta: Momenta, starts: ti.i32, count: ti.i32, pushing: Integers, vertices: Quadruples, weights: Weights,
    normal: Vectors, floor: Floats, kind: Integers, arm: Vectors, friction: Floats, mobility: Floats,
    impulse: Vectors, impulse_before: Vectors, impulse_given: Vectors, push: Vectors,
    touched_count: ti.i32, touched: Integers, displacement: Vectors, start: Vectors, reached: Vectors,
    inverse_mass: Floats, uses: Integers, used_by: Integers, use_weight: Floats, brace: Vectors,
    body_count: ti.i32, body_motion: Vectors, body_start: Vectors, body_reached: Vectors, body_inverse_mass: Floats,
    body_inverse_inertia: Matrices, body_gathered: LongIntegers, unit: ti.f32, is_short: ti.template(),
):  # fmt: skip
    """Some steps of the iteration, `STEPS` in one launch; momenta are their beta_k, and that of the step after them.

    The first launch of an iteration, which `starts` it, notes where that is.

    A step starts from impulses p_k + beta_k (p_k - p_{k-1}) and the displacements that belong to them. It leaves the
    displacements of the next, ahead by beta_{k+1} of those that it has `reached`.
    """
    # Bounds before the first loop: each that is found between two loops would be a launch of its own on a GPU.
    contacts_end, touched_end, bodies_end = count, touched_count, body_count
    new_contacts_end, new_touched_end, new_bodies_end = starts * count, starts * touched_count, starts * 2 * body_count
    if ti.static(is_short):
        ti.loop_config(serialize=True)
    for place in range(new_touched_end):
        i = touched[place]
        start[i] = displacement[i]
        reached[i] = displacement[i]
    if ti.static(not runs_on_gpu()):
        ti.loop_config(serialize=True)
    for m in range(new_bodies_end):
        body_start[m] = body_motion[m]
        body_reached[m] = body_motion[m]
    if ti.static(is_short):
        ti.loop_config(serialize=True)
    for place in range(new_contacts_end):
        c = pushing[place]
        impulse_before[c] = impulse[c]
        impulse_given[c] = impulse[c]
    for step in ti.static(range(STEPS)):
        if ti.static(is_short):
            ti.loop_config(serialize=True)
        for place in range(contacts_end):
            c = pushing[place]
            n = normal[c]
            w = relative_displacement(c, vertices, weights, displacement, kind, arm, body_motion)
            ahead = impulse[c] + momenta[step] * (impulse[c] - impulse_before[c])
            along = ti.max(ahead.dot(n) + (floor[c] - w.dot(n)) / mobility[c], 0.0)
            sideways = ahead - ahead.dot(n) * n - (w - w.dot(n) * n) / mobility[c]
            held, length = friction[c] * along, sideways.norm()
            if length > held:
                sideways *= held / length
            after = along * n + sideways
            impulse_before[c] = impulse[c]
            impulse[c] = after
            push[place] = (after - ahead) / unit
            # What nothing moves need not hear of it before the end: its sums are in the way of all threads.
            b = kind[c]
            most = 0.0
            if b >= 0 and (after - ahead).norm_sqr() > 0.0:
                most = body_mobility(arm[c], body_inverse_mass[b], body_inverse_inertia[b])
            if most > 0.0:
                give_body(push[place], b, arm[c], body_gathered)
        if ti.static(is_short):
            ti.loop_config(serialize=True)
        for place in range(touched_end):
            i = touched[place]
            given = answer_of(brace[i]) * given_to(i, uses, used_by, use_weight, push)
            u = displacement[i] + (inverse_mass[i] * unit) * given
            displacement[i] = u + momenta[step + 1] * (u - reached[i])
            reached[i] = u
        if ti.static(not runs_on_gpu()):
            ti.loop_config(serialize=True)
        for b in range(bodies_end):
            shift = body_motion[2 * b] + (body_inverse_mass[b] * unit) * take(body_gathered, 6 * b)
            turn = body_motion[2 * b + 1] + unit * (body_inverse_inertia[b] @ take(body_gathered, 6 * b + 3))
            body_motion[2 * b] = shift + momenta[step + 1] * (shift - body_reached[2 * b])
            body_motion[2 * b + 1] = turn + momenta[step + 1] * (turn - body_reached[2 * b + 1])
            body_reached[2 * b] = shift
            body_reached[2 * b + 1] = turn


@ti.func
def finish_push(
    count: ti.i32, pushing: Integers, kind: Integers, arm: Vectors, impulse: Vectors, impulse_given: Vectors,
    push: Vectors, touched_count: ti.i32, touched: Integers, displacement: Vectors, start: Vectors,
    inverse_mass: Floats, uses: Integers, used_by: Integers, use_weight: Floats, brace: Vectors,
    body_count: ti.i32, body_motion: Vectors, body_start: Vectors, body_inverse_mass: Floats,
    body_inverse_inertia: Matrices, body_gathered: LongIntegers, body_impulse: LongIntegers, unit: ti.f32,
    is_short: ti.template(),
):  # fmt: skip
    """The displacements that the impulses alone make, from where the iteration started; so both sides get the same."""
    # Bounds before the first loop: each that is found between two loops would be a launch of its own on a GPU.
    contacts_end, touched_end, bodies_end = count, touched_count, body_count
    if ti.static(is_short):
        ti.loop_config(serialize=True)
    for place in range(contacts_end):
        c = pushing[place]
        push[place] = (impulse[c] - impulse_given[c]) / unit
        if kind[c] >= 0:
            give_body(push[place], kind[c], arm[c], body_gathered)
    if ti.static(is_short):
        ti.loop_config(serialize=True)
    for place in range(touched_end):
        i = touched[place]
        given = answer_of(brace[i]) * given_to(i, uses, used_by, use_weight, push)
        displacement[i] = start[i] + (inverse_mass[i] * unit) * given
    if ti.static(not runs_on_gpu()):
        ti.loop_config(serialize=True)
    for b in range(bodies_end):
        for axis in ti.static(range(6)):
            body_impulse[6 * b + axis] += body_gathered[6 * b + axis]
        body_motion[2 * b] = body_start[2 * b] + (body_inverse_mass[b] * unit) * take(body_gathered, 6 * b)
        twist = unit * take(body_gathered, 6 * b + 3)
        body_motion[2 * b + 1] = body_start[2 * b + 1] + body_inverse_inertia[b] @ twist


@ti.func
def most_missing(
    count: ti.i32, pushing: Integers, vertices: Quadruples, weights: Weights, normal: Vectors, floor: Floats,
    kind: Integers, arm: Vectors, displacement: Vectors, thickness: Floats, body_motion: Vectors,
    partial: Floats, lanes: ti.i32, quantities: ti.i32, maxima: ti.i32, nodes: Floats, is_short: ti.template(),
) -> ti.f32:  # fmt: skip
    """The most that a contact's displacement is below its floor, in thicknesses of what touches."""
    lanes_end = lanes
    # Lanes as those of `sim.reductions.Lanes`, for a number of contacts that the host does not know yet.
    items = (count + lanes - 1) // lanes
    lane_step, item_step = items, 1
    if ti.static(runs_on_gpu()):
        lane_step, item_step = 1, lanes
    if ti.static(is_short):
        ti.loop_config(serialize=True)
    for lane in range(lanes_end):
        missing = 0.0
        for k in range(items):
            place = lane * lane_step + k * item_step
            if place < count:
                c = pushing[place]
                w = relative_displacement(c, vertices, weights, displacement, kind, arm, body_motion)
                least = floor[c] - w.dot(normal[c])
                missing = ti.max(missing, least / thickness_between(vertices[c], thickness))
        partial[lane] = missing
    return reduced(partial, lanes, quantities, maxima, nodes)[0]


@fast_launch
@ti.kernel
def begin_push(
    momenta: Momenta, count: ti.i32, vertices: Quadruples, weights: Weights, normal: Vectors, floor: Floats,
    kind: Integers, arm: Vectors, friction: Floats, mobility: Floats, impulse: Vectors, impulse_before: Vectors,
    impulse_given: Vectors, pushing: Integers, push: Vectors, counter: Integers, vertex_count: ti.i32,
    displacement: Vectors, predicted: Vectors, start: Vectors, reached: Vectors, inverse_mass: Floats,
    thickness: Floats, shares: Integers, touched: Integers, uses: Integers, used_by: Integers, use_weight: Floats,
    brace: Vectors, held_sums: Integers, lever: Floats, presser: Integers, braces: ti.i32,
    body_count: ti.i32, body_motion: Vectors, body_start: Vectors, body_reached: Vectors, body_inverse_mass: Floats,
    body_inverse_inertia: Matrices, body_gathered: LongIntegers, body_impulse: LongIntegers, body_load: LongIntegers,
    load_unit: ti.f32, unit: ti.f32, partial: Floats, lanes: ti.i32, quantities: ti.i32, maxima: ti.i32,
    nodes: Floats, is_first: ti.template(), is_short: ti.template(),
) -> ti.math.ivec3:  # fmt: skip
    """A round of contacts in one launch: which of them push, some steps of the iteration, and where these lead.

    Returns how many contacts push, how many vertices they push, and the bits of what `most_missing` is.
    """
    weigh_contacts(
        count, vertices, weights, normal, floor, kind, arm, friction, mobility, impulse, pushing, counter,
        vertex_count, displacement, predicted, inverse_mass, shares, touched, uses, used_by, use_weight, held_sums,
        lever, presser, brace, body_count, body_inverse_mass, body_inverse_inertia, body_load, load_unit, braces,
        is_first, is_short,
    )  # fmt: skip
    pushing_count, touched_count = counter[0], counter[1]
    push_apart(
        momenta, 1, pushing_count, pushing, vertices, weights, normal, floor, kind, arm, friction, mobility, impulse,
        impulse_before, impulse_given, push, touched_count, touched, displacement, start, reached, inverse_mass, uses,
        used_by, use_weight, brace, body_count, body_motion, body_start, body_reached, body_inverse_mass,
        body_inverse_inertia, body_gathered, unit, is_short,
    )  # fmt: skip
    finish_push(
        pushing_count, pushing, kind, arm, impulse, impulse_given, push, touched_count, touched, displacement, start,
        inverse_mass, uses, used_by, use_weight, brace, body_count, body_motion, body_start, body_inverse_mass,
        body_inverse_inertia, body_gathered, body_impulse, unit, is_short,
    )  # fmt: skip
    missing = most_missing(
        pushing_count, pushing, vertices, weights, normal, floor, kind, arm, displacement, thickness, body_motion,
        partial, lanes, quantities, maxima, nodes, is_short,
    )  # fmt: skip
    return ti.math.ivec3(pushing_count, touched_count, ti.bit_cast(missing, ti.i32))


@fast_launch
@ti.kernel
def push_on(
    momenta: Momenta, starts: ti.i32, finishes: ti.template(), count: ti.i32, pushing: Integers, vertices: Quadruples,
    weights: Weights, normal: Vectors, floor: Floats, kind: Integers, arm: Vectors, friction: Floats,
    mobility: Floats, impulse: Vectors, impulse_before: Vectors, impulse_given: Vectors, push: Vectors,
    touched_count: ti.i32, touched: Integers, displacement: Vectors, start: Vectors, reached: Vectors,
    inverse_mass: Floats, uses: Integers, used_by: Integers, use_weight: Floats, brace: Vectors,
    body_count: ti.i32, body_motion: Vectors, body_start: Vectors, body_reached: Vectors, body_inverse_mass: Floats,
    body_inverse_inertia: Matrices, body_gathered: LongIntegers, body_impulse: LongIntegers, unit: ti.f32,
    is_short: ti.template(),
):  # fmt: skip
    """More steps of the iteration, and where they lead if it `finishes`."""
    push_apart(
        momenta, starts, count, pushing, vertices, weights, normal, floor, kind, arm, friction, mobility, impulse,
        impulse_before, impulse_given, push, touched_count, touched, displacement, start, reached, inverse_mass, uses,
        used_by, use_weight, brace, body_count, body_motion, body_start, body_reached, body_inverse_mass,
        body_inverse_inertia, body_gathered, unit, is_short,
    )  # fmt: skip
    if ti.static(finishes):
        finish_push(
            count, pushing, kind, arm, impulse, impulse_given, push, touched_count, touched, displacement, start,
            inverse_mass, uses, used_by, use_weight, brace, body_count, body_motion, body_start, body_inverse_mass,
            body_inverse_inertia, body_gathered, body_impulse, unit, is_short,
        )  # fmt: skip


@fast_launch
@ti.kernel
def repair_crossings(
    count: ti.i32, vertices: Quadruples, weights: Weights, normal: Vectors, floor: Floats, kind: Integers,
    impulse: Vectors, position: Vectors, displacement: Vectors, inverse_mass: Floats, thickness: Floats,
    least_gap_in_thicknesses: ti.f32, crossing: Integers, counter: Integers, is_short: ti.template(),
) -> ti.i32:  # fmt: skip
    """Count the pairs that are not certainly apart all through the substep, and have their worst vertices pushed.

    Two sides that a plane across n separates at the start, and one across n at the end, are separated all the time in
    between: n . (x_a - x_b) of any two vertices is linear in time. So it is enough that the separation along n, that
    of the nearest two vertices, keeps 1 - `LARGEST_SHARE` of what it was; or all of it where it was none.
    `crossing` gets 1 for pairs that fail, else 0. Pairs whose vertices are all pinned are not looked at.
    """
    counter[0] = 0
    if ti.static(is_short):
        ti.loop_config(serialize=True)
    for c in range(count):
        crossing[c] = 0
        mobile = 0.0
        for k in ti.static(range(4)):
            mobile = ti.max(mobile, inverse_mass[vertices[c][k]])
        if kind[c] < 0 and kind[c] >= EDGE_EDGE and mobile > 0.0:
            n, v = normal[c], vertices[c]
            first = ti.select(kind[c] == EDGE_EDGE, 2, 1)
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
            least_gap = least_gap_in_thicknesses * thickness_between(v, thickness)
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
                weights[c] = pair
                floor[c] = ti.min(ti.max(KEPT_BY_REPAIR * apart, 2.0 * least_gap), apart) - between
                impulse[c] = ti.math.vec3(0.0)
    return counter[0]
