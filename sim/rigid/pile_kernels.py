"""Contacts of piles, where they were found: islands side by side, pair of bodies after pair, or pairs in colours.

No two pairs of a colour have a body that moves in common, so that it does not matter who solves which. Sweeps are those
of `contact_kernels.relax_contacts`, pair after pair in the order of the colours, each of which is a launch, or in an
order by chance.
"""

from typing import NamedTuple

import taichi as ti

from sim.core.bundles import bundle, func
from sim.core.launch import kernel
from sim.rigid.array_types import Eases, LongRows, Numbers, Velocities, Whole, WholeRows
from sim.rigid.collision_kernels import Bodies, Kept, Near, Placed
from sim.rigid.contact_kernels import (
    AHEAD,
    CHANGE,
    COLUMNS,
    IMPULSE,
    LEAST,
    NORMAL,
    OWN,
    Ahead,
    Work,
    along_axes,
    gather_contact,
    join,
    push_both,
    ratio_of,
    relax_pair,
    row_of,
    vector_of,
    velocity_at,
    wanted_apart,
)

MOST_COLOURS = 30  # besides a last one, whose pairs may have bodies in common and are solved one after the other
COLOURS = MOST_COLOURS + 1
LARGEST, SQUARE = 0, 3
"""Columns of islands: what the last three sweeps changed of velocities at most, as bits, and the sum of squares of what
they changed of impulses, in a unit of the island: integers, so that no order matters."""
MOST, TAKEN, CONTACTS, SPEED, ASKS, WORTH, INERTIA, PAIRS, BODIES = 6, 7, 9, 10, 11, 13, 15, 16, 17
"""Sweeps that an island is worth; those that it took in both solves; contacts; speed at these [1e-6 m/s]; whether it
has something to solve, in both; as bits, the largest velocity at contacts, in both, and largest 1 / A of their own;
pairs and bodies that move."""
ISLAND_COLUMNS = 18
WORK_COLUMNS, MOST_SWEEPS = COLUMNS, 100
UNIT = 2.0**42  # of a square of impulses: the least that counts of the largest one
ROUNDS = 4  # of colouring in a launch


@bundle
class Pile(NamedTuple):
    """Pairs with contacts of bodies that move, and how they are solved."""

    colour: Whole  # of each near pair, -1 where it has nothing to solve, (p,)
    by_rank: Whole  # near pairs in the order of their ranks, (p,)
    pairs: Whole  # those that have something to solve, by colour or by island, (p,)
    first: Whole  # first of each colour among these, and the end, (COLOURS + 1,)
    places: Whole  # likewise, while they are put there, (COLOURS,)
    turn: Whole  # which sweep it is, how many colours had their turn in it, and how many there are, (3,)
    masks: Whole  # colours of the pairs of each body, (n + 1,)
    least: Whole  # least rank of a pair of each body that has no colour, (n + 1,)
    group: Whole  # least number of the bodies that hang together, (n + 1,): the island's
    islands: LongRows  # (n + 1, ISLAND_COLUMNS)
    roots: Whole  # numbers of the islands that have something to solve, (n + 1,)
    spans: WholeRows  # first of `pairs` and of `movers` of each of these, and the end, (n + 2, 2)
    vacant: WholeRows  # while they are put there, the next places of each island, (n + 1, 2)
    movers: Whole  # bodies that move, by island, (n + 1,)
    done: WholeRows  # whether an island is, before and after a sweep, (n + 1, 2)
    ratios: Numbers  # by which the impulses of an island go on, (n + 1,)
    ease: Eases  # (n + 1,)
    friction: Numbers  # coefficient of each body; the domain's is below 0 (n + 1,)
    velocity: Velocities  # [m/s], [rad/s], (n + 1,)
    extra: Velocities  # what only moves bodies apart, (n + 1,)
    ahead: Ahead  # (n + 1,)
    touched: Whole  # 1 of bodies that got an impulse, 3 if something that cannot move gave it, (n + 1,)
    work: Work  # what contacts are, (c,)


@bundle
class Limits(NamedTuple):
    """When sweeps end."""

    relative: ti.f64  # part of the largest velocity at contacts of an island without impulses that may change
    absolute: ti.f64  # what may change besides [m/s]
    apart: ti.f64  # part of the largest velocity that is wanted to move bodies apart that may change
    most: ti.i32  # sweeps
    coarse_speed: ti.f64  # islands that are faster, in the mean, [m/s]
    coarse_work: ti.i32  # get so many looks at contacts
    coarse_contacts: ti.f64  # or s sweeps if they have so many contacts times s³
    fewest: ti.i32  # or at least so many
    rate: ti.f64  # at which overlaps shrink [1/s]
    slop: ti.f64  # overlap that stays [m]
    dt: ti.f64  # [s]


@func
def moving(near: Near, kept: Kept, pile: Pile, pair: ti.i32):
    """The numbers of the two bodies of a near pair, one past the last for what does not move, and if it is solved."""
    last = pile.group.shape[0] - 1
    one, two = ti.min(near.pairs[pair, 0], last), ti.min(near.pairs[pair, 1], last)
    is_used = kept.starts[pair + 1] > kept.starts[pair] and (pile.ease[one][0] > 0.0 or pile.ease[two][0] > 0.0)
    return one, two, is_used


@func
def island_of(one: ti.i32, two: ti.i32, pile: Pile) -> ti.i32:
    """The island of two bodies, of which one moves at least."""
    return pile.group[ti.select(pile.ease[one][0] > 0.0, one, two)]


@func
def colour_pair(pair: ti.i32, one: ti.i32, two: ti.i32, pile: Pile):
    """Give a pair the first colour that none of its bodies has."""
    moves_one, moves_two = pile.ease[one][0] > 0.0, pile.ease[two][0] > 0.0
    taken = ti.select(moves_one, pile.masks[one], 0) | ti.select(moves_two, pile.masks[two], 0)
    colour = 0
    while colour < MOST_COLOURS and (taken >> colour) & 1 == 1:
        colour += 1
    pile.colour[pair] = colour
    if colour < MOST_COLOURS:
        if moves_one:
            pile.masks[one] |= 1 << colour
        if moves_two:
            pile.masks[two] |= 1 << colour


@kernel
def begin_pile(count: ti.i32, near: Near, kept: Kept, pile: Pile):
    """Islands of so many near pairs; none has a colour."""
    for body in range(pile.group.shape[0]):
        pile.group[body], pile.masks[body], pile.touched[body] = body, 0, 0
        for column in range(ISLAND_COLUMNS):
            pile.islands[body, column] = 0
        for column in ti.static(range(6)):
            pile.extra[body][column] = 0.0
    for pair in range(count):
        one, two, is_used = moving(near, kept, pile, pair)
        pile.colour[pair] = ti.select(is_used, -1, COLOURS)
        if is_used and pile.ease[one][0] > 0.0 and pile.ease[two][0] > 0.0:
            join(one, two, pile.group)
    for body in range(pile.group.shape[0]):
        first = pile.group[body]
        while pile.group[first] != first:
            first = pile.group[first]
        pile.group[body] = first


@kernel
def colour_pairs(count: ti.i32, near: Near, kept: Kept, pile: Pile) -> ti.i32:
    """Some rounds of colouring of so many near pairs; how many are without a colour still.

    A pair gets its colour when those of its bodies that come before it by chance have theirs (Jones & Plassmann 1993),
    so that the colours do not depend on the order of the threads.
    """
    left = 0
    for _round in ti.static(range(ROUNDS)):
        for body in range(pile.least.shape[0]):
            pile.least[body] = count
        for pair in range(count):
            if pile.colour[pair] < 0:
                one, two, _ = moving(near, kept, pile, pair)
                ti.atomic_min(pile.least[one], near.rank[pair])
                ti.atomic_min(pile.least[two], near.rank[pair])
        for pair in range(count):
            if pile.colour[pair] < 0:
                one, two, _ = moving(near, kept, pile, pair)
                is_first_of_one = pile.ease[one][0] == 0.0 or pile.least[one] == near.rank[pair]
                is_first_of_two = pile.ease[two][0] == 0.0 or pile.least[two] == near.rank[pair]
                if is_first_of_one and is_first_of_two:
                    colour_pair(pair, one, two, pile)
    for pair in range(count):
        if pile.colour[pair] < 0:
            left += 1
    return left


@func
def count_pair(pair: ti.i32, near: Near, kept: Kept, pile: Pile):
    """Add a pair that has something to solve to its island."""
    one, two, _ = moving(near, kept, pile, pair)
    island = island_of(one, two, pile)
    contacts = ti.cast(kept.starts[pair + 1] - kept.starts[pair], ti.i64)
    speed = ti.max(vector_of(pile.velocity, one, 0).norm(), vector_of(pile.velocity, two, 0).norm())
    ti.atomic_add(pile.islands[island, PAIRS], ti.cast(1, ti.i64))
    ti.atomic_add(pile.islands[island, CONTACTS], contacts)
    ti.atomic_add(pile.islands[island, SPEED], contacts * ti.cast(1.0e6 * ti.min(speed, 1.0e6), ti.i64))
    ti.atomic_max(pile.islands[island, ASKS], ti.cast(1, ti.i64))


@func
def sweeps_worth(island: ti.i32, pile: Pile, limits: Limits) -> ti.i64:
    """How many sweeps an island is worth whose pairs were counted."""
    most = ti.cast(limits.most, ti.i64)
    contacts = pile.islands[island, CONTACTS]
    if pile.islands[island, SPEED] > 1.0e6 * limits.coarse_speed * contacts:
        fewer = ti.cast(ti.max(limits.fewest, limits.coarse_work // ti.max(contacts, 1)), ti.i64)
        fewer = ti.min(most, fewer)
        while fewer < most and limits.coarse_contacts * fewer * fewer * fewer < contacts:
            fewer += 1
        most = fewer
    return most


@kernel
def sort_pairs(count: ti.i32, near: Near, kept: Kept, pile: Pile, limits: Limits) -> ti.i32:
    """Put so many near pairs in the order of their colours, and find how many sweeps islands are worth.

    Returns how many pairs have something to solve. Within a colour any order does.
    """
    pile.turn[0], pile.turn[1], pile.turn[2] = 0, 0, 0
    for colour in range(COLOURS):
        pile.places[colour] = 0
    for pair in range(count):
        if pile.colour[pair] < COLOURS:
            ti.atomic_add(pile.places[pile.colour[pair]], 1)
            count_pair(pair, near, kept, pile)
    total = 0
    ti.loop_config(serialize=True)
    for colour in range(COLOURS):
        pairs = pile.places[colour]
        pile.first[colour], pile.places[colour] = total, total
        pile.turn[2] += ti.cast(pairs > 0, ti.i32)  # those of bodies are the first that were left
        total += pairs
        pile.first[colour + 1] = total
    for pair in range(count):
        if pile.colour[pair] < COLOURS:
            pile.pairs[ti.atomic_add(pile.places[pile.colour[pair]], 1)] = pair
    for body in range(pile.group.shape[0]):
        pile.islands[body, MOST] = sweeps_worth(body, pile, limits)
    return total


@kernel
def sort_islands(count: ti.i32, near: Near, kept: Kept, pile: Pile, limits: Limits) -> ti.i32:
    """Put so many near pairs in the order of islands, those of one by chance, and find how many sweeps they are worth.

    Returns how many islands have something to solve. By chance, but always the same: along rows of bodies sweeps carry
    what they leave to one side.
    """
    for pair in range(count):
        pile.by_rank[near.rank[pair]] = pair
        if pile.colour[pair] < COLOURS:
            count_pair(pair, near, kept, pile)
    for body in range(pile.group.shape[0]):
        if pile.ease[body][0] > 0.0:
            ti.atomic_add(pile.islands[pile.group[body], BODIES], ti.cast(1, ti.i64))
    number, pairs, movers = 0, 0, 0
    ti.loop_config(serialize=True)
    for island in range(pile.group.shape[0]):
        if pile.islands[island, PAIRS] > 0:
            pile.roots[number], pile.islands[island, MOST] = island, sweeps_worth(island, pile, limits)
            pile.spans[number, 0], pile.spans[number, 1] = pairs, movers
            pile.vacant[island, 0], pile.vacant[island, 1] = pairs, movers
            pairs += ti.cast(pile.islands[island, PAIRS], ti.i32)
            movers += ti.cast(pile.islands[island, BODIES], ti.i32)
            number += 1
            pile.spans[number, 0], pile.spans[number, 1] = pairs, movers
    ti.loop_config(serialize=True)
    for place in range(count):
        pair = pile.by_rank[place]
        if pile.colour[pair] < COLOURS:
            one, two, _ = moving(near, kept, pile, pair)
            island = island_of(one, two, pile)
            pile.pairs[pile.vacant[island, 0]] = pair
            pile.vacant[island, 0] += 1
    ti.loop_config(serialize=True)
    for body in range(pile.group.shape[0]):
        island = pile.group[body]
        if pile.ease[body][0] > 0.0 and pile.islands[island, PAIRS] > 0:
            pile.movers[pile.vacant[island, 1]] = body
            pile.vacant[island, 1] += 1
    return number


@ti.func
def bits(value: ti.f64) -> ti.i64:
    """Of a number that is not negative: whole numbers in the same order."""
    return ti.bit_cast(ti.max(value, 0.0), ti.i64)


@ti.func
def number(value: ti.i64) -> ti.f64:
    """The number of these bits."""
    return ti.bit_cast(value, ti.f64)


@func
def gather_pair(item: ti.i32, near: Near, kept: Kept, bodies: Bodies, placed: Placed, pile: Pile, limits: Limits):
    """Put together what the contacts of a pair are; impulses start from the forces of the step before."""
    pair = pile.pairs[item]
    one, two, _ = moving(near, kept, pile, pair)
    rubbing = pile.friction[near.pairs[pair, 0]]
    other = pile.friction[near.pairs[pair, 1]]
    rubbing = ti.sqrt(rubbing * ti.select(other < 0.0, rubbing, other))
    worth, inertia = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
    for at in range(kept.starts[pair], kept.starts[pair + 1]):
        point, least = row_of(placed.point, at), -ti.max(placed.gap[at], 0.0) / limits.dt
        gather_contact(
            at,
            row_of(placed.normal, at),
            point - row_of(bodies.pose, one),
            point - row_of(bodies.pose, two),
            limits.dt * row_of(kept.forces, at),
            rubbing,
            least,
            one,
            two,
            pile.ease,
            pile.work,
        )
        free = velocity_at(at, one, two, pile.work, pile.velocity)
        worth = ti.max(worth, ti.abs(free).max(), ti.abs(least))
        inertia = ti.max(inertia, 1.0 / pile.work[at][OWN])
    island = island_of(one, two, pile)
    ti.atomic_max(pile.islands[island, WORTH], bits(worth))
    ti.atomic_max(pile.islands[island, INERTIA], bits(inertia))


@kernel
def gather_pile(total: ti.i32, near: Near, kept: Kept, bodies: Bodies, placed: Placed, pile: Pile, limits: Limits):
    """Put together what the contacts of so many pairs are."""
    for item in range(total):
        gather_pair(item, near, kept, bodies, placed, pile, limits)


@func
def start_pair(item: ti.i32, near: Near, kept: Kept, pile: Pile):
    """Give the bodies of a pair the impulses that are started from."""
    pair = pile.pairs[item]
    one, two, _ = moving(near, kept, pile, pair)
    for at in range(kept.starts[pair], kept.starts[pair + 1]):
        push_both(one, two, along_axes(at, IMPULSE, pile.work), at, pile.ease, pile.velocity, pile.work)


@func
def may_change_in(solve: ti.template(), island: ti.i32, pile: Pile, limits: Limits) -> ti.f64:
    """By how much the last sweep may change velocities at contacts of an island [m/s]."""
    may_change = limits.absolute + limits.relative * number(pile.islands[island, WORTH])
    if ti.static(solve == 1):
        may_change = limits.apart * number(pile.islands[island, WORTH + 1])
    return may_change


@func
def most_in(solve: ti.template(), island: ti.i32, pile: Pile, limits: Limits) -> ti.i32:
    """How many sweeps an island gets at most; half as many move it apart if it is worth fewer looks than it gets."""
    most = ti.cast(pile.islands[island, MOST], ti.i32)
    is_large = most < limits.most and pile.islands[island, CONTACTS] * most > limits.coarse_work
    if ti.static(solve == 1) and is_large:
        most = (most + 1) // 2
    return most


@func
def begin_sweep(
    solve: ti.template(),
    sweep: ti.i32,
    body: ti.i32,
    pile: Pile,
    velocity: Velocities,
    limits: Limits,
    alive: WholeRows,
):
    """Let a body go on along the direction before; its island's first one notes whether the island is done.

    See `contact_kernels.relax_contacts`. Counts the islands that are not in `alive`, by sweep.
    """
    island = pile.group[body]
    if pile.islands[island, ASKS + solve] == 1 and pile.ease[body][0] > 0.0:
        may_change = may_change_in(solve, island, pile, limits)
        last, before_last = (sweep + 2) % 3, (sweep + 1) % 3
        was_done = sweep > 0 and pile.done[island, (sweep + 1) % 2] == 1
        is_small = sweep > 0 and number(pile.islands[island, LARGEST + last]) <= may_change
        most = most_in(solve, island, pile, limits)
        is_done = was_done or is_small or sweep >= most
        ratio = ti.cast(0.0, ti.f64)
        square, square_before = pile.islands[island, SQUARE + last], pile.islands[island, SQUARE + before_last]
        if sweep > 1:
            ratio = ratio_of(ti.cast(square, ti.f64), ti.cast(square_before, ti.f64))
        if not is_done:
            for column in ti.static(range(6)):
                now = velocity[body][column]
                if sweep > 0:
                    on = ratio * pile.ahead[body][6 + column]
                    pile.ahead[body][6 + column] = on + now - pile.ahead[body][column]
                    now += on
                    velocity[body][column] = now
                else:
                    pile.ahead[body][6 + column] = 0.0
                pile.ahead[body][column] = now
        if body == island:
            pile.done[island, sweep % 2] = ti.cast(is_done, ti.i32)
            pile.islands[island, LARGEST + sweep % 3], pile.islands[island, SQUARE + sweep % 3] = 0, 0
            pile.ratios[island] = ratio
            if not is_done:
                alive[solve, sweep] += 1
            elif not was_done:
                pile.islands[island, TAKEN + solve] = ti.select(is_small, sweep, most + 1)


@func
def relax_item(
    solve: ti.template(),
    sweep: ti.i32,
    item: ti.i32,
    near: Near,
    kept: Kept,
    pile: Pile,
    velocity: Velocities,
):
    """Solve a pair; what changed goes to its island."""
    pair = pile.pairs[item]
    one, two, _ = moving(near, kept, pile, pair)
    island = island_of(one, two, pile)
    if pile.islands[island, ASKS + solve] == 1 and pile.done[island, sweep % 2] == 0:
        largest, square = relax_pair(
            ti.static(solve == 0), sweep % 2 == 0, pile.ratios[island], kept.starts[pair], kept.starts[pair + 1],
            one, two, pile.ease, velocity, pile.work,
        )  # fmt: skip
        unit = number(pile.islands[island, WORTH + solve]) * number(pile.islands[island, INERTIA])
        ti.atomic_max(pile.islands[island, LARGEST + sweep % 3], bits(largest))
        if unit > 0.0:
            share = ti.min(square / (unit * unit), 1.0e3)
            ti.atomic_add(pile.islands[island, SQUARE + sweep % 3], ti.cast(share * ti.cast(UNIT, ti.f64), ti.i64))


@func
def finish_pair(item: ti.i32, near: Near, kept: Kept, placed: Placed, pile: Pile, limits: Limits):
    """Keep the forces of a pair, and ask what moves it apart."""
    pair = pile.pairs[item]
    one, two, _ = moving(near, kept, pile, pair)
    island, worth, asks, pushes = island_of(one, two, pile), ti.cast(0.0, ti.f64), False, False
    for at in range(kept.starts[pair], kept.starts[pair + 1]):
        impulse = along_axes(at, IMPULSE, pile.work)
        along_normal = velocity_at(at, one, two, pile.work, pile.velocity).dot(vector_of(pile.work, at, NORMAL))
        for axis in ti.static(range(3)):
            kept.forces[at, axis] = impulse[axis] / limits.dt
            pushes = pushes or impulse[axis] != 0.0
        wanted, moves = wanted_apart(
            placed.gap[at], along_normal, limits.rate, limits.slop, limits.dt, False, 0.0, 0.0
        )  # fmt: skip
        worth, asks = ti.max(worth, ti.abs(wanted)), asks or moves
        pile.work[at][LEAST] = wanted
        pile.work[at][IMPULSE], pile.work[at][CHANGE], pile.work[at][AHEAD] = 0.0, 0.0, 0.0
    if pushes:
        ti.atomic_or(pile.touched[one], ti.select(pile.ease[two][0] > 0.0, 1, 3))
        ti.atomic_or(pile.touched[two], ti.select(pile.ease[one][0] > 0.0, 1, 3))
    ti.atomic_max(pile.islands[island, WORTH + 1], bits(worth))
    if asks:
        ti.atomic_max(pile.islands[island, ASKS + 1], ti.cast(1, ti.i64))


@func
def next_colour(pile: Pile):
    """The colour whose turn it is in a sweep, the last one first in every other: its first item and the end."""
    turn = pile.turn[1]
    pile.turn[1] = turn + 1
    colour = ti.select(pile.turn[0] % 2 == 0, turn, pile.turn[2] - 1 - turn)
    return pile.first[colour], pile.first[colour + 1], colour == MOST_COLOURS


@kernel
def start_colour(near: Near, kept: Kept, pile: Pile):
    """Give the bodies of all pairs of the next colour the impulses that are started from."""
    first, end, is_last = next_colour(pile)
    runs = ti.select(is_last, ti.min(1, end - first), end - first)
    for run in range(runs):
        for item in range(first + run, ti.select(is_last, end, first + run + 1)):
            start_pair(item, near, kept, pile)


@kernel
def begin_sweeps(solve: ti.template(), sweep: ti.i32, pile: Pile, limits: Limits, alive: WholeRows):
    """Let all bodies go on, before a sweep; counts islands that are not done, by solve and sweep."""
    alive[solve, sweep], pile.turn[0], pile.turn[1] = 0, sweep, 0
    for body in range(pile.group.shape[0]):
        if ti.static(solve == 0):
            begin_sweep(solve, sweep, body, pile, pile.velocity, limits, alive)
        else:
            begin_sweep(solve, sweep, body, pile, pile.extra, limits, alive)


@kernel
def relax_colour(solve: ti.template(), near: Near, kept: Kept, pile: Pile):
    """Solve all pairs of the next colour; those of the last one after the other."""
    first, end, is_last = next_colour(pile)
    runs = ti.select(is_last, ti.min(1, end - first), end - first)
    for run in range(runs):
        for item in range(first + run, ti.select(is_last, end, first + run + 1)):
            if ti.static(solve == 0):
                relax_item(solve, pile.turn[0], item, near, kept, pile, pile.velocity)
            else:
                relax_item(solve, pile.turn[0], item, near, kept, pile, pile.extra)


@kernel
def finish_pairs(total: ti.i32, near: Near, kept: Kept, placed: Placed, pile: Pile, limits: Limits):
    """Keep the forces of so many pairs, and ask what moves them apart."""
    for item in range(total):
        finish_pair(item, near, kept, placed, pile, limits)


@func
def relax_island(
    solve: ti.template(), place: ti.i32, near: Near, kept: Kept, pile: Pile, velocity: Velocities, limits: Limits
):
    """Sweep over an island until it is done: see `contact_kernels.relax_contacts`."""
    island = pile.roots[place]
    begin, end, begin_movers, end_movers = (
        pile.spans[place, 0],
        pile.spans[place + 1, 0],
        pile.spans[place, 1],
        pile.spans[place + 1, 1],
    )
    may_change, most = may_change_in(solve, island, pile, limits), most_in(solve, island, pile, limits)
    taken, ratio, square_before = most + 1, ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
    for sweep in range(most):
        for mover in range(begin_movers, end_movers):
            body = pile.movers[mover]
            for column in ti.static(range(6)):
                now, on = velocity[body][column], ti.cast(0.0, ti.f64)
                if sweep > 0:
                    on = ratio * pile.ahead[body][6 + column]
                    pile.ahead[body][6 + column] = on + now - pile.ahead[body][column]
                    velocity[body][column] = now + on
                else:
                    pile.ahead[body][6 + column] = 0.0
                pile.ahead[body][column] = now + on
        largest, square = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
        for step in range(begin, end):
            pair = pile.pairs[ti.select(sweep % 2 == 0, step, begin + end - 1 - step)]
            one, two, _ = moving(near, kept, pile, pair)
            of_velocity, of_impulses = relax_pair(
                ti.static(solve == 0), sweep % 2 == 0, ratio, kept.starts[pair], kept.starts[pair + 1],
                one, two, pile.ease, velocity, pile.work,
            )  # fmt: skip
            largest, square = ti.max(largest, of_velocity), square + of_impulses
        if largest <= may_change:
            taken = sweep + 1
            break
        ratio, square_before = ratio_of(square, square_before), square
    pile.islands[island, TAKEN + solve] = taken


@kernel
def solve_islands(
    count: ti.i32,
    run: ti.i32,
    near: Near,
    kept: Kept,
    bodies: Bodies,
    placed: Placed,
    pile: Pile,
    limits: Limits,
):
    """Solve so many islands, for velocities, then for those that move bodies apart.

    `run` items of a loop are what one thread takes at least.
    """
    for item in range(count * run):
        if item % run == 0:
            place = item // run
            for each in range(pile.spans[place, 0], pile.spans[place + 1, 0]):
                gather_pair(each, near, kept, bodies, placed, pile, limits)
            for each in range(pile.spans[place, 0], pile.spans[place + 1, 0]):
                start_pair(each, near, kept, pile)
            relax_island(0, place, near, kept, pile, pile.velocity, limits)
            for each in range(pile.spans[place, 0], pile.spans[place + 1, 0]):
                finish_pair(each, near, kept, placed, pile, limits)
            if pile.islands[pile.roots[place], ASKS + 1] == 1:
                relax_island(1, place, near, kept, pile, pile.extra, limits)
