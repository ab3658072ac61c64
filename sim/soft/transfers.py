"""Transfers between particles and grid: MLS-MPM (Hu et al. 2018) with APIC (Jiang et al. 2015), quadratic splines.

    m_i v_i = sum_p w_ip [m_p v_p + (m_p C_p - dt V_p 4/h² tau_p) (x_i - x_p)]
    v_p = sum_i w_ip v_i,   C_p = 4/h² sum_i w_ip v_i (x_i - x_p)'

Nodes gather from the particles of the 27 cells that reach them, in the order of these: nothing is added by threads that
race, so that bits do not depend on them.
"""

from typing import NamedTuple

import taichi as ti

from sim.core.arrays import Floats, Integers, Matrices, Vectors
from sim.core.box import Box
from sim.core.bundles import bundle
from sim.core.launch import kernel
from sim.core.reductions import Results, Share, is_finite, reduced_tree
from sim.forces.field import ForceTable, change_of_velocity
from sim.soft.blocks import NODES, SUPPORT, Blocks, Triple, base_of, block_of, node_at, node_of, within_block
from sim.soft.laws import Laws, hardened, moved_strain, respond
from sim.soft.materials import Law

APIC = 4.0  # over h², the inverse of the splines' second moment
MAXIMA, COUNTS = 2, 1  # of `measure`


@bundle
class Particles(NamedTuple):
    """Particles, (n,) each; body -1 has left."""

    position: Vectors  # [m]
    velocity: Vectors  # [m/s]
    affine: Matrices  # C [1/s]
    strain: Matrices  # elastic b - 1 [-]
    stress: Matrices  # Kirchhoff [Pa]
    history: Floats  # of the law [-]
    body: Integers
    count: ti.i32


@bundle
class Weights(NamedTuple):
    """Mass of a particle of each body [kg], its volume at rest [m³], and the body's friction, (bodies,)."""

    mass: Floats
    volume: Floats
    friction: Floats


@bundle
class Sorted(NamedTuple):
    """What nodes gather of particles, by cell, (n,) each."""

    place: Vectors  # [lattice edges]
    momentum: Vectors  # [kg m/s]
    affine: Matrices  # of the momentum, over a lattice edge [kg m/s]
    mass: Floats  # [kg]
    friction: Floats  # mass times friction [kg]


@bundle
class Nodes(NamedTuple):
    """Nodes of stored blocks, (k * 64,) each."""

    mass: Floats  # [kg]
    velocity: Vectors  # [m/s]
    friction: Floats  # against walls and bodies [-]


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


@kernel
def particles_to_grid(
    blocks: Blocks,
    stored: ti.i32,
    particles: Particles,
    weights: Weights,
    ordered: Sorted,
    nodes: Nodes,
    gravity: ti.math.vec3,
    dt: ti.f32,
):
    """Mass and velocity of the nodes, gravity included."""
    h = blocks.edge
    for s in range(blocks.first[stored * NODES]):
        p = blocks.order[s]
        b = particles.body[p]
        mass = weights.mass[b]
        ordered.place[s] = (particles.position[p] - blocks.origin) / h
        ordered.momentum[s] = mass * particles.velocity[p]
        pull = dt * weights.volume[b] * APIC / (h * h)
        ordered.affine[s] = h * (mass * particles.affine[p] - pull * particles.stress[p])
        ordered.mass[s] = mass
        ordered.friction[s] = mass * weights.friction[b]
    for n in range(stored * NODES):
        node = node_of(n, blocks)
        mass, friction = 0.0, 0.0
        momentum = ti.math.vec3(0.0)
        at = ti.cast(node, ti.f32)
        for dz in range(SUPPORT):
            for dy in range(SUPPORT):
                for dx in range(SUPPORT):
                    base = node - Triple(SUPPORT - 1 - dx, dy, dz)
                    block = -1
                    if base.min() >= 0:
                        block = blocks.number[block_of(base, blocks)]
                    if block >= 0:
                        cell = block * NODES + within_block(base)
                        for s in range(blocks.first[cell], blocks.first[cell + 1]):
                            away = at - ordered.place[s]
                            weight = spline(away[0]) * spline(away[1]) * spline(away[2])
                            mass += weight * ordered.mass[s]
                            friction += weight * ordered.friction[s]
                            momentum += weight * (ordered.momentum[s] + ordered.affine[s] @ away)
        nodes.mass[n] = mass
        inverse = ti.select(mass > 0.0, 1.0 / ti.max(mass, 1.0e-30), 0.0)
        nodes.velocity[n] = ti.select(mass > 0.0, inverse * momentum + dt * gravity, ti.math.vec3(0.0))
        nodes.friction[n] = inverse * friction


@kernel
def grid_to_particles(
    blocks: Blocks,
    stored: ti.i32,
    particles: Particles,
    laws: Laws,
    nodes: Nodes,
    box: Box,
    dt: ti.f32,
):
    """Velocities from nodes; places, strains and stresses after the step. What passed an open face leaves."""
    h = blocks.edge
    for s in range(blocks.first[stored * NODES]):
        p = blocks.order[s]
        x = particles.position[p]
        place = (x - blocks.origin) / h
        base = base_of(x, blocks)
        velocity = ti.math.vec3(0.0)
        affine = ti.math.mat3(0.0)
        for dz in range(SUPPORT):
            for dy in range(SUPPORT):
                for dx in range(SUPPORT):
                    node = base + Triple(dx, dy, dz)
                    away = ti.cast(node, ti.f32) - place
                    weight = spline(away[0]) * spline(away[1]) * spline(away[2])
                    v_i = weight * nodes.velocity[node_at(node, blocks)]
                    velocity += v_i
                    affine += v_i.outer_product(away)
        affine *= APIC / h
        change = dt * affine
        change += 0.5 * change @ change
        b = particles.body[p]
        strain, stress, history = respond(moved_strain(particles.strain[p], change), b, particles.history[p], laws)
        particles.velocity[p] = velocity
        particles.affine[p] = affine
        particles.strain[p] = strain
        particles.stress[p] = stress
        particles.history[p] = history
        moved = ti.min(ti.max(x + dt * velocity, box.wall_low), box.wall_high)
        particles.position[p] = moved
        if (moved < box.keep_low).any() or (moved > box.keep_high).any():
            particles.body[p] = -1


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


@kernel
def respond_at_rest(particles: Particles, laws: Laws):
    """Stresses of the strains that particles have."""
    for p in range(particles.count):
        if particles.body[p] >= 0:
            _, stress, _ = respond(particles.strain[p], particles.body[p], particles.history[p], laws)
            particles.stress[p] = stress
