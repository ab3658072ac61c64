"""Triangles of meshes, solved together in every step: one Newton step of implicit Euler by conjugate gradients."""

import taichi as ti

from sim.cloth.bundles import CellArrays, Nodes, Strains, TriangleFrames, TriangleSystem, TriangleWork
from sim.cloth.device_springs import (
    FOLLOWED_STRAINS,
    TINY_LENGTH,
    DeviceCells,
    change_of,
    derivative,
    mean_strain,
    shear_of,
    smoothed,
    strain_by,
    tension_of,
    time_ahead,
)
from sim.cloth.springs import OWN_SHARE, TRIANGLE
from sim.cloth.state import ClothState
from sim.cloth.threads import LARGEST_RESIDUAL, STRAIGHTENED, direction_of
from sim.core.arrays import Floats, Vectors
from sim.core.bundles import func, with_room
from sim.core.launch import kernel
from sim.core.reductions import BRANCHES, LaneReduction, Results, Share, reduced_tree, runs_on_gpu

ITERATIONS_AT_ONCE = 4  # iterations between two looks at how far the last ones led
MOST_ITERATIONS = 200  # more are only asked for by steps in which a wave crosses hundreds of triangles

TOLERANCE = 0.03
"""Of the displacement by triangles in a step, in the norm of energy: that `ITERATIONS_AT_ONCE` at last still change."""

FOLLOWED = 0.85
"""Part of a change of strain that its smoothed rate takes over: waves that steps cannot follow fall by 0.92 a step."""

LEAST_ACCELERATION = 1.0  # by triangles, of which `TOLERANCE` is at least [m/s²]: 0.3 % of the weight

ROOT_HALF = 0.5**0.5

BLOCK_SHARE = OWN_SHARE + (1.0 - OWN_SHARE) / 6.0
"""What blocks of nodes have of the stiffness of triangles, on equal triangles."""

TINY_ENERGY = 1.0e-37  # least divisor of energies [kg m²]: without any, there is nothing to solve
HELD = 1.0e30  # mass of held nodes in the sums over pieces [kg]


class TriangleSolver:
    """(M + dt² K) e = -dt² f for the displacements e by the triangles of all meshes, f and K at the prediction.

    Forces push along the directions of the start, as threads do (`threads`), so that K consists of the stiffnesses
    along these, and of Newmark's beta of the tension that turns with them. Damping is part of both. Conjugate gradients
    with the inverse 3 x 3 blocks B of the nodes (Baraff & Witkin 1998, "Large steps in cloth simulation"), with one
    reduction an iteration (Chronopoulos & Gear 1989), start from the multiple of the displacement of the step before
    that leaves the least energy. What they leave of linear momentum is taken from each piece that no pin holds.

    Attributes:
        cloths: numbers of those that they belong to.

    Args:
        state: what they move.
        cells: the triangles.
    """

    def __init__(self, state: ClothState, cells: DeviceCells) -> None:
        self._state, self.cloths, self._mesh = state, cells.cloths, cells.on_device.mesh
        n = state.vertex_count
        work = with_room(
            TriangleWork,
            n,
            scalars=ti.ndarray(ti.f32, 2 * MOST_ITERATIONS + 1),
            moment=ti.Vector.ndarray(4, ti.f32, self._mesh.chunks),
            shift=ti.Vector.ndarray(3, ti.f32, self._mesh.pieces),
        )
        self._system = TriangleSystem(cells.on_device, with_room(TriangleFrames, cells.count), work)
        self._expected = ti.Vector.ndarray(2, ti.f32, n)
        self._sums, self._of_excess = LaneReduction(maxima=0, sums=2), LaneReduction(maxima=1, sums=1)
        self._left = self._mass = self._least = 0.0

    def take_parameters(self) -> None:
        """Mass as it is now; cells hold their stiffness."""
        self._mass = float(self._state.mass.to_numpy()[self._mesh.node.to_numpy()].sum())

    def displace(self, dt: float, rate_before: float, *, is_first: bool) -> None:
        """Bring the displacements of a step of dt [s], after one of 1/`rate_before`, to where triangles let them go.

        Once more in a step: from where the nodes are now, with what triangles pushed them by so far as an impulse.
        """
        system, state = self._system, self._state
        share = self._sums.over(self._mesh.count)
        linearize(system, state.nodes, dt, rate_before, int(is_first))
        begin_iteration(system, state.nodes, state.elastic, dt, int(is_first), share)
        self._left = 1.0
        if is_first:
            self._least = self._mass * (LEAST_ACCELERATION * dt * dt) ** 2
        for first in range(0, MOST_ITERATIONS, ITERATIONS_AT_ONCE):
            iterate(system, state.nodes, dt, first, share)
            last, whole = decrease(system.work.scalars, first, first + ITERATIONS_AT_ONCE)
            if not last > TOLERANCE**2 * (whole + self._least):
                self._left = 0.0
                break
        if is_first:
            self._least += whole
        finish_iteration(system, state.nodes, state.elastic, self._expected)

    def excess(self) -> tuple[float, int]:
        """Largest excess of strain at a node [-], 1 if `MOST_ITERATIONS` were too few; and how many are beyond
        `LARGEST_RESIDUAL`.
        """
        share = self._of_excess.over(self._mesh.count)
        found = measure_node_excess(self._system, self._state.nodes, self._expected, share)
        return max(float(found[0]), self._left), int(found[1])


@func
def stiffer(s: ti.i32, cells: CellArrays, rate: ti.f32) -> ti.f32:
    """By what damping multiplies the stiffness of a step of 1/`rate`."""
    return 1.0 + cells.law[s][3] * rate


@func
def strain(s: ti.i32, system: TriangleSystem, moved: Vectors, rate: ti.f32) -> ti.math.vec2:
    """Changes of e_u and e_v by vectors at the nodes; the two forces of K without these into `frames`."""
    cells, frames = ti.static((system.cells, system.frames))
    d_u = change_of(cells.along, cells, moved, s, TRIANGLE)
    d_v = change_of(cells.across, cells, moved, s, TRIANGLE)
    n_u, n_v, turning = frames.n_u[s], frames.n_v[s], frames.turning[s]
    by_u, by_v = frames.by_u[s], frames.by_v[s]
    e_u, e_v = n_u.dot(d_u), n_v.dot(d_v)
    shear = stiffer(s, cells, rate) * cells.law[s][1] * (by_u.dot(d_u) + by_v.dot(d_v))
    more, less = ROOT_HALF * (by_u + by_v), ROOT_HALF * (by_v - by_u)
    d_more, d_less = d_u + d_v, d_u - d_v
    s_more = turning[2] * (d_more - more.dot(d_more) * more)
    s_less = turning[3] * (d_less - less.dot(d_less) * less)
    frames.s_u[s] = shear * by_u + turning[0] * (d_u - e_u * n_u) + (s_more + s_less)
    frames.s_v[s] = shear * by_v + turning[1] * (d_v - e_v * n_v) + (s_more - s_less)
    return ti.math.vec2(e_u, e_v)


@func
def stretch(s: ti.i32, system: TriangleSystem, rate: ti.f32):
    """Add the forces by e_u and e_v to those in `frames`."""
    cells, mesh, frames = ti.static((system.cells, system.cells.mesh, system.frames))
    tension = tension_of(s, cells, mesh.strain, mesh.mean)
    tension *= stiffer(s, cells, rate)
    frames.s_u[s] = frames.s_u[s] + tension[0] * frames.n_u[s]
    frames.s_v[s] = frames.s_v[s] + tension[1] * frames.n_v[s]


@func
def gathered(k: ti.i32, system: TriangleSystem) -> ti.math.vec3:
    """Sum over the corners at a node of what the triangles' two forces are there [N]."""
    cells, mesh, frames = ti.static((system.cells, system.cells.mesh, system.frames))
    total = ti.math.vec3(0.0)
    for at in range(mesh.start[k], mesh.start[k + 1]):
        corner = mesh.corner[at]
        s = corner // TRIANGLE
        total += cells.along[corner] * frames.s_u[s] + cells.across[corner] * frames.s_v[s]
    return total


@func
def block(k: ti.i32, system: TriangleSystem, rate: ti.f32):
    """About the 3 x 3 block of K at a node [N/m]: means have a sixth of the stiffness on equal triangles."""
    cells, mesh, frames = ti.static((system.cells, system.cells.mesh, system.frames))
    total = ti.Matrix.zero(ti.f32, 3, 3)
    one = ti.Matrix.identity(ti.f32, 3)
    for at in range(mesh.start[k], mesh.start[k + 1]):
        corner = mesh.corner[at]
        s = corner // TRIANGLE
        u, v, turning = cells.along[corner], cells.across[corner], frames.turning[s]
        along, shear = BLOCK_SHARE * cells.law[s][0], cells.law[s][1]
        law = stiffer(s, cells, rate) * ti.math.vec2(along, shear)
        n_u, n_v = u * frames.n_u[s], v * frames.n_v[s]
        by = u * frames.by_u[s] + v * frames.by_v[s]
        more = ROOT_HALF * (u + v) * (frames.by_u[s] + frames.by_v[s])
        less = ROOT_HALF * (u - v) * (frames.by_v[s] - frames.by_u[s])
        total += (law[0] - turning[0]) * n_u.outer_product(n_u) + (law[0] - turning[1]) * n_v.outer_product(n_v)
        across = law[0] * cells.law[s][2]
        total += across * (n_u.outer_product(n_v) + n_v.outer_product(n_u)) + law[1] * by.outer_product(by)
        total -= turning[2] * more.outer_product(more) + turning[3] * less.outer_product(less)
        round_about = turning[0] * u * u + turning[1] * v * v
        total += (round_about + turning[2] * (u + v) * (u + v) + turning[3] * (u - v) * (u - v)) * one
    return total


@func
def preconditioned(i: ti.i32, work: TriangleWork, r: ti.math.vec3) -> ti.math.vec3:
    """The inverse block of a node times r."""
    d, o = work.diagonal[i], work.off_diagonal[i]
    return ti.math.vec3(
        d.x * r.x + o.z * r.y + o.y * r.z, o.z * r.x + d.y * r.y + o.x * r.z, o.y * r.x + o.x * r.y + d.z * r.z
    )


@kernel
def linearize(system: TriangleSystem, nodes: Nodes, dt: ti.f32, rate_before: ti.f32, is_first: ti.i32):
    """Directions of each triangle, what of its tension turns with them, and its two forces times dt² [N m s²].

    Damping adds tau times the rate at which the prediction strains. `rate_before` is 1 over the last step.
    """
    cells, mesh, frames, work = ti.static((system.cells, system.cells.mesh, system.frames, system.work))
    ahead = time_ahead(dt, rate_before)
    for s in range(system.cells.count):
        start_u = derivative(cells.along, cells, nodes, nodes.carry, s, TRIANGLE)
        start_v = derivative(cells.across, cells, nodes, nodes.carry, s, TRIANGLE)
        d_u = derivative(cells.along, cells, nodes, nodes.displacement, s, TRIANGLE)
        d_v = derivative(cells.across, cells, nodes, nodes.displacement, s, TRIANGLE)
        rate = cells.law[s][3] / dt
        length_u, length_v = ti.max(d_u.norm(), TINY_LENGTH), ti.max(d_v.norm(), TINY_LENGTH)
        n_u, n_v = direction_of(start_u, d_u / length_u), direction_of(start_v, d_v / length_v)
        d_more, d_less, start_more, start_less = d_u + d_v, d_u - d_v, start_u + start_v, start_u - start_v
        more = direction_of(start_more, d_more / ti.max(d_more.norm(), TINY_LENGTH))
        less = direction_of(start_less, d_less / ti.max(d_less.norm(), TINY_LENGTH))
        by_u, by_v = ROOT_HALF * (more - less), ROOT_HALF * (more + less)
        frames.n_u[s], frames.n_v[s], frames.by_u[s], frames.by_v[s] = n_u, n_v, by_u, by_v
        moved_u, moved_v = d_u - start_u, d_v - start_v
        e = ti.math.vec2(length_u - 1.0, length_v - 1.0)
        length_u, length_v = ti.max(start_u.norm(), TINY_LENGTH), ti.max(start_v.norm(), TINY_LENGTH)
        start = ti.math.vec3(length_u - 1.0, length_v - 1.0, shear_of(start_u, start_v)[0])
        rates = ti.math.vec3(0.0)
        for a in ti.static(range(FOLLOWED_STRAINS)):
            at = FOLLOWED_STRAINS * s + a
            if is_first == 1:
                change = rate_before * (start[a] - cells.followed[at][0])
                cells.followed[at] = ti.math.vec2(start[a], smoothed(cells.followed[at][1], change, FOLLOWED))
            rates[a] = ahead * cells.followed[at][1]
        damped = rate * ti.math.vec3(n_u.dot(moved_u), n_v.dot(moved_v), by_u.dot(moved_u) + by_v.dot(moved_v))
        mesh.strain[s] = e + damped.xy - rates.xy
        shear = shear_of(d_u, d_v)[0] + damped.z - rates.z
        shear *= cells.law[s][1]
        frames.s_u[s], frames.s_v[s] = shear * by_u, shear * by_v
        frames.start[s] = start.xy
        lengths = ti.math.vec4(length_u, length_v, start_more.norm(), start_less.norm())
        pull = ROOT_HALF * cells.law[s][1] * start.z
        frames.turning[s] = STRAIGHTENED / ti.max(lengths, TINY_LENGTH) * ti.math.vec4(1.0, 1.0, pull, -pull)
    for k in range(system.cells.mesh.count):
        mesh.mean[mesh.node[k]] = mean_strain(k, mesh, mesh.strain)
        work.start_mean[mesh.node[k]] = mean_strain(k, mesh, frames.start)
    for s in range(system.cells.count):
        tension = tension_of(s, cells, frames.start, work.start_mean)
        frames.turning[s] = ti.max(frames.turning[s] * ti.math.vec4(tension, 1.0, 1.0), 0.0)
        stretch(s, system, 0.0)
        frames.s_u[s], frames.s_v[s] = dt * dt * frames.s_u[s], dt * dt * frames.s_v[s]


@func
def multiply(system: TriangleSystem, nodes: Nodes, dt: ti.f32, product: Vectors):
    """(M + dt² K) z of all nodes that are not held, else 0; for the outermost level of a kernel."""
    mesh, work = ti.static((system.cells.mesh, system.work))
    for s in range(system.cells.count):
        mesh.strain[s] = strain(s, system, work.z, 1.0 / dt)
    for k in range(system.cells.mesh.count):
        mesh.mean[mesh.node[k]] = mean_strain(k, mesh, mesh.strain)
    for s in range(system.cells.count):
        stretch(s, system, 1.0 / dt)
    for k in range(system.cells.mesh.count):
        i = mesh.node[k]
        w_i = nodes.inverse_mass[i]
        total = ti.math.vec3(0.0)
        if w_i > 0.0:
            total = work.z[i] / w_i + dt * dt * gathered(k, system)
        product[i] = total


@func
def sum_products(system: TriangleSystem, product: Vectors, share: Share):
    """z.r and z.A z, for the `product` A z; for the outermost level of a kernel."""
    tree, work = ti.static((share.tree, system.work))
    if ti.static(not runs_on_gpu()):
        ti.loop_config(serialize=True)
    for lane in range(tree.lanes):
        of_rest, of_product = 0.0, 0.0
        for k in range(share.items):
            n = lane * share.lane_step + k * share.item_step
            if n < system.cells.mesh.count:
                i = system.cells.mesh.node[n]
                of_rest += work.z[i].dot(work.r[i])
                of_product += work.z[i].dot(product[i])
        tree.partial[lane], tree.partial[tree.lanes + lane] = of_rest, of_product
    reduced_tree(tree)


@kernel
def begin_iteration(system: TriangleSystem, nodes: Nodes, elastic: Vectors, dt: ti.f32, is_first: ti.i32, share: Share):
    """Residual at the start, and inverse blocks; in the first solve of a step the start is a multiple of `elastic`, and
    that is 0 from there on.
    """
    tree, mesh, work = ti.static((share.tree, system.cells.mesh, system.work))
    for k in range(system.cells.mesh.count):
        i = mesh.node[k]
        w_i = nodes.inverse_mass[i]
        e_i, r_i = ti.math.vec3(0.0), ti.math.vec3(0.0)
        if w_i > 0.0:
            e_i = elastic[i]
            r_i = -gathered(k, system)
            if is_first == 0:
                r_i -= e_i / w_i
            mass = 1.0 / w_i * ti.Matrix.identity(ti.f32, 3)
            inverse = (mass + dt * dt * block(k, system, 1.0 / dt)).inverse()
            work.diagonal[i] = ti.math.vec3(inverse[0, 0], inverse[1, 1], inverse[2, 2])
            work.off_diagonal[i] = ti.math.vec3(inverse[1, 2], inverse[0, 2], inverse[0, 1])
        work.r[i] = r_i
        work.z[i] = ti.select(is_first, e_i, 0.0)
        elastic[i] = ti.select(is_first, 0.0, e_i)
    multiply(system, nodes, dt, work.q)
    sum_products(system, work.q, share)
    for k in range(system.cells.mesh.count):
        i = mesh.node[k]
        work_done, energy = tree.nodes[0], tree.nodes[tree.lanes // BRANCHES]
        multiple = work_done / ti.max(energy, TINY_ENERGY)
        if k == 0:
            work.scalars[0] = multiple * work_done
        work.x[i] = multiple * work.z[i]
        r_i = work.r[i] - multiple * work.q[i]
        work.r[i] = r_i
        work.z[i] = preconditioned(i, work, r_i)
        work.p[i], work.q[i] = ti.math.vec3(0.0), ti.math.vec3(0.0)


@kernel
def iterate(system: TriangleSystem, nodes: Nodes, dt: ti.f32, first: ti.i32, share: Share):
    """`ITERATIONS_AT_ONCE` iterations, from number `first` on: with z = B r, gamma = r.z, delta = z.A z,

    beta = gamma/gamma', alpha = gamma/(delta - beta gamma/alpha'), p = z + beta p, q = A z + beta q,
    x += alpha p, r -= alpha q.
    """
    tree, work = ti.static((share.tree, system.work))
    for step in ti.static(range(ITERATIONS_AT_ONCE)):
        multiply(system, nodes, dt, work.a_z)
        sum_products(system, work.a_z, share)
        for k in range(system.cells.mesh.count):
            i = system.cells.mesh.node[k]
            gamma, delta = tree.nodes[0], tree.nodes[tree.lanes // BRANCHES]
            beta, before = 0.0, 1.0
            if first + step > 0:
                beta = gamma / ti.max(work.scalars[2 * (first + step) - 1], TINY_ENERGY)
                before = work.scalars[2 * (first + step)]
            alpha = 0.0
            if before > 0.0:
                rest = delta - beta * gamma / before
                alpha = ti.select(rest > 0.0, gamma / rest, 0.0)
            if k == 0:
                work.scalars[2 * (first + step) + 1], work.scalars[2 * (first + step) + 2] = gamma, alpha
            p_i = work.z[i] + beta * work.p[i]
            q_i = work.a_z[i] + beta * work.q[i]
            work.p[i], work.q[i] = p_i, q_i
            work.x[i] = work.x[i] + alpha * p_i
            r_i = work.r[i] - alpha * q_i
            work.r[i] = r_i
            work.z[i] = preconditioned(i, work, r_i)


@kernel
def decrease(scalars: Floats, first: ti.i32, end: ti.i32) -> ti.math.vec2:
    """By how much iterations from `first` to before `end` let the energy fall, and by how much all up to there."""
    last, whole = 0.0, scalars[0]
    ti.loop_config(serialize=True)
    for k in range(end):
        change = scalars[2 * k + 1] * scalars[2 * k + 2]
        whole += change
        if k >= first:
            last += change
    return ti.math.vec2(last, whole)


@kernel
def finish_iteration(system: TriangleSystem, nodes: Nodes, elastic: Vectors, expected: Strains):
    """Displace the nodes by the solution, less what momentum it has in each piece that no pin holds; the strains that
    nodes are expected to have then.
    """
    mesh, work = ti.static((system.cells.mesh, system.work))
    for chunk in range(mesh.chunks):
        moment, mass = ti.math.vec3(0.0), 0.0
        for k in range(mesh.chunk[chunk], mesh.chunk[chunk + 1]):
            i = mesh.node[k]
            w_i = nodes.inverse_mass[i]
            m_i = HELD
            if w_i > 0.0:
                m_i = 1.0 / w_i
            moment += m_i * work.x[i]
            mass += m_i
        work.moment[chunk] = ti.math.vec4(moment, mass)
    for piece in range(mesh.pieces):
        total = ti.math.vec4(0.0)
        for chunk in range(mesh.first_chunk[piece], mesh.first_chunk[piece + 1]):
            total += work.moment[chunk]
        work.shift[piece] = ti.select(total[3] < HELD, total.xyz / total[3], 0.0)
    for k in range(system.cells.mesh.count):
        i = mesh.node[k]
        if nodes.inverse_mass[i] > 0.0:
            x_i = work.x[i] - work.shift[mesh.piece[k]]
            elastic[i] = elastic[i] + x_i
            nodes.displacement[i] = nodes.displacement[i] + x_i
    strain_by(nodes.displacement, 0, system.cells, nodes)
    for k in range(system.cells.mesh.count):
        expected[mesh.node[k]] = mesh.mean[mesh.node[k]]


@kernel
def measure_node_excess(system: TriangleSystem, nodes: Nodes, expected: Strains, share: Share) -> Results:
    """Largest excess of strain of nodes of triangles, as `threads.measure_excess` has it, and how many along warp and
    weft are beyond `LARGEST_RESIDUAL`.
    """
    tree, mesh = ti.static((share.tree, system.cells.mesh))
    strain_by(nodes.displacement, 0, system.cells, nodes)
    if ti.static(not runs_on_gpu()):
        ti.loop_config(serialize=True)
    for lane in range(tree.lanes):
        largest, unconverged = 0.0, 0.0
        for k in range(share.items):
            n = lane * share.lane_step + k * share.item_step
            if n < system.cells.mesh.count:
                excess = mesh.mean[mesh.node[n]] - expected[mesh.node[n]]
                largest = ti.max(largest, excess.x, excess.y)
                for axis in ti.static(range(2)):
                    if excess[axis] > LARGEST_RESIDUAL:
                        unconverged += 1.0
        tree.partial[lane], tree.partial[tree.lanes + lane] = largest, unconverged
    return reduced_tree(tree)
