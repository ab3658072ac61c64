"""Transfers between particles and grid: MLS-MPM (Hu et al. 2018) with APIC (Jiang et al. 2015), quadratic splines.

    m_i v_i = sum_p w_ip [m_p v_p + (m_p C_p - dt V_p 4/h² tau_p) (x_i - x_p)]
    v_p = sum_i w_ip v_i,   C_p = 4/h² sum_i w_ip v_i (x_i - x_p)'

Each cell adds up what its particles give to each of their 27 nodes, and each node what 27 cells give it, in fixed
orders: nothing is added by threads that race, so that bits do not depend on them.
"""

from typing import NamedTuple

import taichi as ti

from sim.core.arrays import Floats, Integers, Matrices, Vectors
from sim.core.box import Box
from sim.core.bundles import bundle, func
from sim.core.launch import kernel
from sim.core.reductions import Results, Share, is_finite, reduced_tree, runs_on_gpu
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
from sim.soft.laws import Laws, hardened, moved_strain, respond
from sim.soft.materials import Law

SHARES = SUPPORT**3
WARP = 32  # threads of a GPU that read together
APIC = 4.0  # over h², the inverse of the splines' second moment
MAXIMA, COUNTS = 2, 1  # of `measure`
AWAY = 1.0e9  # coordinate of what has left, where it is in no one's way [m]


@bundle
class Particles(NamedTuple):
    """Particles, (n,) each; body -1 has left, and those below wait; they are far away then."""

    position: Vectors  # [m]
    velocity: Vectors  # [m/s]
    affine: Matrices  # C [1/s]; within a step its momentum across a cell [kg m/s]
    strain: Matrices  # elastic b - 1 [-]
    stress: Matrices  # Kirchhoff [Pa]
    history: Floats  # of the law [-]
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
class Shares(NamedTuple):
    """What the particles of each cell give each of their 27 nodes, (k * 64 * 27,); of no meaning in empty cells."""

    mass: Floats  # [kg]
    momentum: Vectors  # [kg m/s]


@bundle
class Nodes(NamedTuple):
    """Nodes of stored blocks, (k * 64,) each."""

    mass: Floats  # [kg]
    velocity: Vectors  # [m/s]


@kernel
def push_particles(particles: Particles, forces: ForceTable, dt: ti.f32):
    """Change velocities by forces from outside."""
    for p in range(particles.count):
        if particles.body[p] >= 0:
            v_p = particles.velocity[p]
            change = change_of_velocity(forces, particles.body[p], particles.position[p], v_p, dt)
            particles.velocity[p] = v_p + change


@ti.func
def spline(distance: ti.f32) -> ti.f32:
    """The quadratic B-spline at a distance [lattice edges]."""
    d = ti.abs(distance)
    return ti.select(d < 0.5, 0.75 - d * d, 0.5 * ti.max(1.5 - d, 0.0) ** 2)


@ti.func
def weight_at(away: ti.math.vec3) -> ti.f32:
    """Share of a particle in a node [-]."""
    return spline(away[0]) * spline(away[1]) * spline(away[2])


@ti.func
def is_hidden(hidden: ti.i32, lane: ti.i32) -> ti.i32:
    """Whether a node of a particle is behind a sheet."""
    return hidden >> lane & 1


@func
def give(
    cell: ti.i32,
    corner: Triple,
    lane: ti.i32,
    blocks: Blocks,
    particles: Particles,
    masses: Floats,
    load: Load,
    parting: Parting,
    shares: Shares,
):
    """What the particles of a cell, with this lowest node, give to one of their nodes, their loads included."""
    at = ti.cast(corner + Triple(lane % SUPPORT, lane // SUPPORT % SUPPORT, lane // SUPPORT**2), ti.f32)
    mass = 0.0
    momentum = ti.math.vec3(0.0)
    for s in range(blocks.sort.cell_start[cell], blocks.sort.cell_start[cell + 1]):
        p = blocks.sort.order[s]
        away = at - place_of(particles.position[p], blocks)
        weight = weight_at(away)
        if ti.static(parting.there):
            weight *= 1.0 - is_hidden(parting.hidden[p], lane)
        own = masses[particles.body[p]]
        carried = own * particles.velocity[p] + particles.affine[p] @ away
        if ti.static(load.there):
            own += load.mass[p]
            carried += load.momentum[p]
        mass += weight * own
        momentum += weight * carried
    place = cell * SHARES + lane
    shares.mass[place] = mass
    shares.momentum[place] = momentum


@kernel
def particles_to_grid(
    blocks: Blocks,
    stored: ti.i32,
    particles: Particles,
    masses: Floats,
    volume: ti.f32,
    load: Load,
    parting: Parting,
    shares: Shares,
    nodes: Nodes,
    gravity: ti.math.vec3,
    dt: ti.f32,
):
    """Mass and velocity of the nodes, gravity included; C becomes its momentum with the impulse of the stress.

    Particles have masses by body [kg], and all of them one volume at rest [m³]. What touches a particle has its C.
    """
    for p in range(particles.count):
        b = particles.body[p]
        if b >= 0:
            pull = dt * volume * APIC / blocks.edge
            mass = masses[b]
            if ti.static(load.there):
                mass += load.mass[p]
            particles.affine[p] = blocks.edge * mass * particles.affine[p] - pull * particles.stress[p]
    if ti.static(runs_on_gpu()):
        ti.loop_config(block_dim=128)
        for i in range(stored * (NODES * WARP)):
            cell = i // WARP
            if i % WARP < SHARES and blocks.sort.cell_start[cell] < blocks.sort.cell_start[cell + 1]:
                give(cell, node_of(cell, blocks), i % WARP, blocks, particles, masses, load, parting, shares)
    else:
        for cell in range(stored * NODES):
            if blocks.sort.cell_start[cell] < blocks.sort.cell_start[cell + 1]:
                corner = node_of(cell, blocks)
                for lane in range(SHARES):
                    give(cell, corner, lane, blocks, particles, masses, load, parting, shares)
    for n in range(stored * NODES):
        inside = Triple(n % EDGE, n // EDGE % EDGE, n % NODES // (EDGE * EDGE))
        mass = 0.0
        momentum = ti.math.vec3(0.0)
        for lane in range(SHARES):
            base = inside - Triple(lane % SUPPORT, lane // SUPPORT % SUPPORT, lane // SUPPORT**2)
            cell = cell_behind(n // NODES, base, blocks)
            if cell >= 0 and blocks.sort.cell_start[cell] < blocks.sort.cell_start[cell + 1]:
                mass += shares.mass[cell * SHARES + lane]
                momentum += shares.momentum[cell * SHARES + lane]
        nodes.mass[n] = mass
        nodes.velocity[n] = ti.select(mass > 0.0, momentum / ti.max(mass, 1.0e-30) + dt * gravity, ti.math.vec3(0.0))


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
    h = blocks.edge
    for s in range(blocks.sort.cell_start[stored * NODES]):
        p = blocks.sort.order[s]
        x = particles.position[p]
        place = place_of(x, blocks)
        base = base_of(x, blocks)
        velocity = ti.math.vec3(0.0)
        affine = ti.math.mat3(0.0)
        block, inside = blocks.number[block_of(base, blocks)], base & (EDGE - 1)
        for dz in ti.static(range(SUPPORT)):
            for dy in ti.static(range(SUPPORT)):
                for dx in ti.static(range(SUPPORT)):
                    step = Triple(dx, dy, dz)
                    away = ti.cast(base + step, ti.f32) - place
                    v_i = nodes.velocity[node_ahead(block, inside + step, blocks)]
                    if ti.static(parting.there):
                        lane = ti.static((dz * SUPPORT + dy) * SUPPORT + dx)
                        v_i = ti.select(is_hidden(parting.hidden[p], lane), parting.ghost[p], v_i)
                    v_i *= weight_at(away)
                    velocity += v_i
                    affine += v_i.outer_product(away)
        affine *= APIC / h
        change = dt * affine
        change += 0.5 * change @ change
        b = particles.body[p]
        strain, stress, history = respond(moved_strain(particles.strain[p], change), b, particles.history[p], dt, laws)
        particles.velocity[p] = velocity
        particles.affine[p] = affine
        particles.strain[p] = strain
        particles.stress[p] = stress
        particles.history[p] = history
        moved = ti.min(ti.max(x + dt * velocity, box.wall_low), box.wall_high)
        particles.position[p] = moved
        if (moved < box.keep_low).any() or (moved > box.keep_high).any():
            particles.body[p] = -1
            particles.position[p] = ti.math.vec3(AWAY)


@kernel
def measure(particles: Particles, laws: Laws, share: Share) -> Results:
    """Largest squared speed [m²/s²], largest factor on the moduli [-], and how many particles are not finite."""
    lanes = share.tree.lanes
    for lane in range(lanes):
        speed, factor, bad = 0.0, 1.0, 0.0
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
                if laws.law[b] == ti.static(int(Law.SNOW)):
                    factor = ti.max(factor, hardened(laws.hardening[b], particles.history[p]))
        share.tree.partial[lane] = speed
        share.tree.partial[lanes + lane] = factor
        share.tree.partial[2 * lanes + lane] = bad
    return reduced_tree(share.tree)
