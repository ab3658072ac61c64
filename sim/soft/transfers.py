"""Transfers between particles and grid: MLS-MPM (Hu et al. 2018) with APIC (Jiang et al. 2015), quadratic splines.

    m_i v_i = sum_p w_ip [m_p v_p + (m_p C_p - dt V_p 4/h² tau_p) (x_i - x_p)]
    v_p = sum_i w_ip v_i,   C_p = 4/h² sum_i w_ip v_i (x_i - x_p)'

Each cell adds up what its particles give to each of their 27 nodes, and each node what 27 cells give it, in fixed
orders: nothing is added by threads that race, so that bits do not depend on them.
"""

from typing import NamedTuple

import taichi as ti

from sim.core.arrays import Floats, Integers, Vectors
from sim.core.box import Box
from sim.core.bundles import bundle, func
from sim.core.launch import kernel
from sim.core.reductions import Results, Share, is_finite, reduced_tree
from sim.forces.field import ForceTable, change_of_velocity
from sim.soft.blocks import (
    EDGE,
    NODES,
    SUPPORT,
    Blocks,
    Triple,
    base_of,
    block_of,
    cell_behind,
    node_ahead,
    node_of,
    place_of,
)
from sim.soft.laws import APART, Laws, hardened, is_apart, moved_strain, respond
from sim.soft.materials import Law

SHARES = SUPPORT**3
PARTS = 4  # of a share: mass, and momentum along x, y, z
SYMMETRIC = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))  # what is kept of a symmetric matrix
APIC = 4.0  # over h², the inverse of the splines' second moment
MAXIMA, COUNTS = 2, 2  # of `measure`
AWAY = 1.0e9  # coordinate of what has left, where it is in no one's way [m]


@bundle
class Particles(NamedTuple):
    """Particles, (n,) each; body -1 has left, and those below wait; they are far away then.

    Of matrices each component has a row of its own, so that threads read what lies together.
    """

    position: Vectors  # [m]
    velocity: Vectors  # [m/s]
    affine: Floats  # C [1/s], (9 n,)
    strain: Floats  # elastic b - 1 [-], (6 n,)
    stress: Floats  # Kirchhoff [Pa], (6 n,)
    history: Floats  # of the law [-]
    cohesion: Floats  # that is left of snow's [-]; one number where there is no snow
    body: Integers
    count: ti.i32


@bundle
class Load(NamedTuple):
    """What touches particles and moves along with them in a step, (n,) each."""

    mass: Floats  # [kg]
    momentum: Vectors  # with the impulses on the particle, before gravity [kg m/s]
    there: ti.template()  # whether anything can touch them; no particle has a load otherwise


@bundle
class Parting(NamedTuple):
    """Nodes that sheets part particles from, (n,) each: they take nothing of the particle."""

    hidden: Integers  # a bit for each of the 27 nodes, x first
    ghost: Vectors  # velocity that the particle takes from them [m/s]
    there: ti.template()  # whether there is any sheet; no node is hidden otherwise


@bundle
class Nodes(NamedTuple):
    """Nodes of stored blocks, (k * 64,) each."""

    mass: Floats  # [kg]
    velocity: Vectors  # [m/s]
    room: Floats  # of their volume, what walls and bodies leave, where there is sand [m³]


@kernel
def push_particles(particles: Particles, forces: ForceTable, dt: ti.f32):
    """Change velocities by forces from outside."""
    for p in range(particles.count):
        if particles.body[p] >= 0:
            v_p = particles.velocity[p]
            change = change_of_velocity(forces, particles.body[p], particles.position[p], v_p, dt)
            particles.velocity[p] = v_p + change


@func
def symmetric_at(rows: Floats, p: ti.i32, count: ti.i32) -> ti.math.mat3:
    """A particle's symmetric matrix."""
    matrix = ti.math.mat3(0.0)
    for k in ti.static(range(6)):
        i, j = ti.static(SYMMETRIC[k])
        value = rows[k * count + p]
        matrix[i, j] = value
        matrix[j, i] = value
    return matrix


@ti.func
def is_hidden(hidden: ti.i32, lane: ti.i32) -> ti.i32:
    """Whether a node of a particle is behind a sheet."""
    return hidden >> lane & 1


@func
def keep_symmetric(rows: Floats, p: ti.i32, count: ti.i32, matrix: ti.math.mat3):
    """Put a particle's symmetric matrix into its rows."""
    for k in ti.static(range(6)):
        i, j = ti.static(SYMMETRIC[k])
        rows[k * count + p] = matrix[i, j]


@ti.func
def spline(distance: ti.f32) -> ti.f32:
    """The quadratic B-spline at a distance below 1.5 [edges]."""
    d = ti.abs(distance)
    return ti.select(d < 0.5, 0.75 - d * d, 0.5 * (1.5 - d) ** 2)


@ti.func
def weight_at(away: ti.math.vec3) -> ti.f32:
    """Share of a particle in a node of its own [-]."""
    return spline(away[0]) * spline(away[1]) * spline(away[2])


@ti.func
def splines(offset: ti.math.vec3):
    """Shares of the lowest, middle and highest node along each axis, of a particle so far from the lowest [edges]."""
    return 0.5 * (1.5 - offset) ** 2, 0.75 - (offset - 1.0) ** 2, 0.5 * (offset - 0.5) ** 2


@func
def affine_momentum(particles: Particles, p: ti.i32, mass: ti.f32, pull: ti.f32, blocks: Blocks) -> ti.math.mat3:
    """Momentum of a particle across a cell [kg m/s], with the impulse of its stress, `pull` [m² s] times that."""
    momentum = -pull * symmetric_at(particles.stress, p, particles.count)
    for i, j in ti.static(ti.ndrange(3, 3)):
        momentum[i, j] += blocks.edge * mass * particles.affine[(3 * i + j) * particles.count + p]
    return momentum


@func
def pull_of(volume: ti.f32, blocks: Blocks, dt: ti.f32) -> ti.f32:
    """What the stress of a particle with this volume at rest [m³] counts in its momentum across a cell [m² s]."""
    return dt * volume * APIC / blocks.edge


@kernel
def particles_to_grid(
    blocks: Blocks,
    stored: ti.i32,
    particles: Particles,
    masses: Floats,
    volume: ti.f32,
    load: Load,
    parting: Parting,
    shares: Floats,
    nodes: Nodes,
    gravity: ti.math.vec3,
    dt: ti.f32,
):
    """Mass and velocity of the nodes, gravity included.

    Particles have masses by body [kg], and all of them one volume at rest [m³]. What touches a particle has its C.
    `shares` are what the particles of a cell give to its 27 nodes: of each node a row of masses [kg] and three of
    momenta [kg m/s], with a number for every cell; those of empty cells mean nothing.
    """
    cells = stored * NODES
    pull = pull_of(volume, blocks, dt)
    for k in range(SUPPORT * cells):
        cell, dz = k // SUPPORT, k % SUPPORT
        first, end = blocks.sort.cell_start[cell], blocks.sort.cell_start[cell + 1]
        if first < end:
            lowest = ti.cast(node_of(cell, blocks) + Triple(0, 0, dz), ti.f32)
            given = ti.Vector([0.0] * (PARTS * SUPPORT * SUPPORT))
            for s in range(first, end):
                p = blocks.sort.order[s]
                away = place_of(particles.position[p], blocks) - lowest
                weights, across = splines(away), spline(away[2])
                mass = masses[particles.body[p]]
                momentum = mass * particles.velocity[p]
                if ti.static(load.there):
                    mass += load.mass[p]
                    momentum += load.momentum[p]
                affine = affine_momentum(particles, p, mass, pull, blocks)
                momentum -= affine @ away
                for dy, dx in ti.static(ti.ndrange(SUPPORT, SUPPORT)):
                    weight = weights[dx][0] * weights[dy][1] * across
                    if ti.static(parting.there):
                        weight *= 1.0 - is_hidden(parting.hidden[p], (dz * SUPPORT + dy) * SUPPORT + dx)
                    carried = momentum + affine @ ti.math.vec3(dx, dy, 0.0)
                    at = ti.static(PARTS * (dy * SUPPORT + dx))
                    given[at] += weight * mass
                    for axis in ti.static(range(3)):
                        given[at + 1 + axis] += weight * carried[axis]
            for node in ti.static(range(SUPPORT * SUPPORT)):
                row = PARTS * (SUPPORT * SUPPORT * dz + node)
                for part in ti.static(range(PARTS)):
                    shares[(row + part) * cells + cell] = given[PARTS * node + part]
    for n in range(cells):
        inside = Triple(n % EDGE, n // EDGE % EDGE, n % NODES // (EDGE * EDGE))
        mass = 0.0
        momentum = ti.math.vec3(0.0)
        for lane in range(SHARES):
            base = inside - Triple(lane % SUPPORT, lane // SUPPORT % SUPPORT, lane // SUPPORT**2)
            cell = cell_behind(n // NODES, base, blocks)
            if cell >= 0 and blocks.sort.cell_start[cell] < blocks.sort.cell_start[cell + 1]:
                at = PARTS * lane * cells + cell
                mass += shares[at]
                momentum += ti.math.vec3(shares[at + cells], shares[at + 2 * cells], shares[at + 3 * cells])
        nodes.mass[n] = mass
        nodes.velocity[n] = ti.select(mass > 0.0, momentum / ti.max(mass, 1.0e-30) + dt * gravity, ti.math.vec3(0.0))


@func
def density_around(hidden: ti.i32, block: ti.i32, inside: Triple, blocks: Blocks, nodes: Nodes) -> ti.f32:
    """Density of the fullest node of a particle [kg/m³]: at a surface that is one within."""
    most = 0.0
    for lane in range(SHARES):
        step = Triple(lane % SUPPORT, lane // SUPPORT % SUPPORT, lane // SUPPORT**2)
        n = node_ahead(block, inside + step, blocks)
        if is_hidden(hidden, lane) == 0:
            most = ti.max(most, nodes.mass[n] / nodes.room[n])
    return most


@kernel
def grid_to_particles(
    blocks: Blocks,
    stored: ti.i32,
    particles: Particles,
    laws: Laws,
    nodes: Nodes,
    parting: Parting,
    box: Box,
    dt: ti.f32,
):
    """Velocities from nodes; places, strains and stresses after the step. What passed an open face leaves."""
    for s in range(blocks.sort.cell_start[stored * NODES]):
        p = blocks.sort.order[s]
        x = particles.position[p]
        base = base_of(x, blocks)
        offset = place_of(x, blocks) - ti.cast(base, ti.f32)
        weights = splines(offset)
        velocity = ti.math.vec3(0.0)
        affine = ti.math.mat3(0.0)
        block, inside = blocks.number[block_of(base, blocks)], base & (EDGE - 1)
        for dz in range(SUPPORT):
            across = spline(offset[2] - ti.cast(dz, ti.f32))
            for dy, dx in ti.static(ti.ndrange(SUPPORT, SUPPORT)):
                step = Triple(dx, dy, dz)
                weight = weights[dx][0] * weights[dy][1] * across
                v_i = nodes.velocity[node_ahead(block, inside + step, blocks)]
                if ti.static(parting.there):
                    is_behind = is_hidden(parting.hidden[p], (dz * SUPPORT + dy) * SUPPORT + dx)
                    v_i = ti.select(is_behind, parting.ghost[p], v_i)
                v_i *= weight
                velocity += v_i
                affine += v_i.outer_product(ti.cast(step, ti.f32) - offset)
        affine *= APIC / blocks.edge
        change = dt * affine
        change += 0.5 * change @ change
        b = particles.body[p]
        trial = moved_strain(symmetric_at(particles.strain, p, particles.count), change)
        history = particles.history[p]
        if is_apart(b, history, laws):
            hidden = 0
            if ti.static(parting.there):
                hidden = parting.hidden[p]
            is_dense = density_around(hidden, block, inside, blocks, nodes) > laws.dense[b]
            history = ti.select(is_dense, 0.0, 2.0 * APART)  # no step takes back as much
        cohesion = 1.0
        if laws.law[b] == ti.static(int(Law.SNOW)):
            cohesion = particles.cohesion[p]
        strain, stress, history, cohesion = respond(trial, b, history, cohesion, dt, laws)
        if laws.law[b] == ti.static(int(Law.SNOW)):
            particles.cohesion[p] = cohesion
        particles.velocity[p] = velocity
        for i, j in ti.static(ti.ndrange(3, 3)):
            particles.affine[(3 * i + j) * particles.count + p] = affine[i, j]
        keep_symmetric(particles.strain, p, particles.count, strain)
        keep_symmetric(particles.stress, p, particles.count, stress)
        particles.history[p] = history
        moved = ti.min(ti.max(x + dt * velocity, box.wall_low), box.wall_high)
        if not (is_finite(velocity[0]) & is_finite(velocity[1]) & is_finite(velocity[2])):
            moved = x  # and is found by `measure`
        particles.position[p] = moved
        if (moved < box.keep_low).any() or (moved > box.keep_high).any():
            particles.body[p] = -1
            particles.position[p] = ti.math.vec3(AWAY)


@kernel
def measure(particles: Particles, laws: Laws, share: Share) -> Results:
    """Largest squared speed [m²/s²], largest factor on the moduli [-], numbers of particles that are not finite and of
    sand that is apart."""
    lanes = share.tree.lanes
    for lane in range(lanes):
        speed, factor, bad, apart = 0.0, 1.0, 0.0, 0.0
        for k in range(share.items):
            p = lane * share.lane_step + k * share.item_step
            if p < particles.count and particles.body[p] >= 0:
                v_p = particles.velocity[p]
                b = particles.body[p]
                finite = 1
                for axis in ti.static(range(3)):
                    finite &= is_finite(v_p[axis]) & is_finite(particles.position[p][axis])
                bad += 1.0 - finite
                speed = ti.max(speed, v_p.norm_sqr())
                apart += is_apart(b, particles.history[p], laws)
                if laws.law[b] == ti.static(int(Law.SNOW)):
                    factor = ti.max(factor, hardened(laws.hardening[b], particles.history[p]))
        share.tree.partial[lane] = speed
        share.tree.partial[lanes + lane] = factor
        share.tree.partial[2 * lanes + lane] = bad
        share.tree.partial[3 * lanes + lane] = apart
    return reduced_tree(share.tree)
