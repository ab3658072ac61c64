"""Exchange of places: a light particle that is held under a heavier fluid changes places with it.

Particles at rest bear shear, up to a hundredth of their pressure, and lie in layers along walls. So a layer of a light
fluid on the floor, or a single particle of it amid still water, would stay under the heavier one for ever. What happens
there is finer than the particles: a part of the size d rises by its buoyancy at a speed u of

    1/u = sqrt(rho / (delta rho g d)) + 18 mu / (delta rho g d²)

with the larger rho and mu of the two: free fall, and Stokes' law. Who has neither risen nor sunk under a heavier
neighbour for several d/u changes places with it. Both keep their velocities, so that momentum is kept to the bit; the
energy set free is what the flow in between would lose. Whatever the particles can tell, such as a wave of Rayleigh and
Taylor, moves, and is left to them (docs/decisions/0061-held-under-what-is-heavier.md).
"""

from typing import NamedTuple

import numpy as np
import taichi as ti

from sim.core.arrays import Floats, Integers, Vectors
from sim.core.bundles import bundle, func
from sim.core.launch import kernel
from sim.core.parameters import Vector3
from sim.fluid.dye import DYE
from sim.fluid.particles import Fluid, Materials, Particles, ParticleSet

HELD = "held"
"""Name of the carried scalar: how long a particle has been held under a heavier one, over d/u [-]."""
PATIENCE = 4.0  # how long it is held at least before it changes places, over d/u, and up to twice that by its id [-]
AT_REST = 0.2  # vertical speed over u below which a particle neither rises nor sinks [-]
SLIDING = 1.0  # speed over u at which the two slide along each other, from which on this is a flow [-]
LEAST_COSINE = 0.4  # of the angle to the vertical under which the heavier particle is seen
FARTHEST = 1.7  # and its distance [spacings]
GOLDEN = 0.618034  # its multiples' fractions spread successive ids evenly


class Exchange:
    """Exchanges of places among fluids of several densities."""

    def __init__(self, capacity: int, gravity: Vector3, spacing: float, first_of_sheets: int) -> None:
        """Prepare for so many particles; those near samples of sheets, which count their mass, keep their places."""
        strength = float(np.linalg.norm(gravity))
        self._up, self._gravity = ti.math.vec3(*(-np.array(gravity) / strength)), strength
        self._spacing, self._first_of_sheets = spacing, first_of_sheets
        self._choice, self._answer = (ti.ndarray(ti.i32, max(capacity, 1)) for _ in range(2))

    def step(self, particles: ParticleSet, fluid: Fluid, acceleration: ti.Ndarray, dt: float) -> bool:
        """Let those change places that are due after a step of dt [s]; returns whether any did.

        Neighbours must be up to date; they have to be found anew afterwards, as their order depends on ids.
        """
        held = particles.carried[HELD]
        place = Vertical(self._up, self._gravity, self._spacing)
        choose(fluid, place, self._first_of_sheets, dt, held, self._choice)
        answer(fluid, self._choice, self._answer)
        pairs = change_places(fluid.particles, self._answer, acceleration, held)
        if pairs and DYE in particles.carried:
            change_scalars(self._answer, particles.count, particles.carried[DYE])
        return pairs > 0


@bundle
class Vertical(NamedTuple):
    """What tells above from below, and how fast things rise."""

    up: ti.math.vec3  # unit vector against gravity
    gravity: ti.f32  # [m/s²]
    spacing: ti.f32  # d [m]


@func
def slowness(materials: Materials, place: Vertical, light: ti.i32, heavy: ti.i32) -> ti.f32:
    """1/u of a part of the lighter fluid in the heavier one [s/m]."""
    rho = materials.rest_density[heavy]
    pull = place.gravity * place.spacing * (rho - materials.rest_density[light])
    mu = ti.max(materials.dynamic_viscosity[light], materials.dynamic_viscosity[heavy])
    return ti.sqrt(rho / pull) + 18.0 * mu / (place.spacing * pull)


@kernel
def choose(fluid: Fluid, place: Vertical, first_of_sheets: ti.i32, dt: ti.f32, held: Floats, choice: Integers):
    """The heavier neighbour most nearly above each particle that has been held for long enough, else -1."""
    particles, near, materials = ti.static((fluid.particles, fluid.near, fluid.materials))
    ti.loop_config(block_dim=128)
    for i in range(particles.count):
        x_i, v_i, own = particles.position[i], particles.velocity[i], particles.phase[i]
        above, cosine = -1, LEAST_COSINE
        first = near.start[i]
        for k in range(near.fluid_count[i]):
            j = near.indices[first + k * near.stride]
            if materials.rest_density[particles.phase[j]] > materials.rest_density[own]:
                x_ji = particles.position[j] - x_i
                r = x_ji.norm()
                if r < FARTHEST * place.spacing and place.up.dot(x_ji) > cosine * r:
                    above, cosine = j, place.up.dot(x_ji) / r
        time = 0.0
        if above >= 0:
            per_speed = slowness(materials, place, own, particles.phase[above])
            v_j = particles.velocity[above]
            rising = ti.max(ti.abs(place.up.dot(v_i)), ti.abs(place.up.dot(v_j))) / AT_REST
            sliding = (v_i - v_j).norm() / SLIDING
            passed = dt / (place.spacing * per_speed)
            time = ti.max(held[i] + ti.select(ti.max(rising, sliding) * per_speed < 1.0, passed, -passed), 0.0)
        held[i] = time
        turn = GOLDEN * ti.cast(particles.particle_id[i], ti.f32)
        is_due = time > PATIENCE * (1.0 + turn - ti.floor(turn))
        if is_due:
            first += near.fluid_count[i] * near.stride
            for k in range(near.boundary_count[i]):
                is_due &= near.indices[first + k * near.stride] < first_of_sheets
        choice[i] = ti.select(is_due, above, -1)


@kernel
def answer(fluid: Fluid, choice: Integers, answers: Integers):
    """Of those that chose a particle, which waits for none itself, the one with the lowest id; else -1."""
    particles, near = ti.static((fluid.particles, fluid.near))
    ti.loop_config(block_dim=128)
    for j in range(particles.count):
        chosen = -1
        if choice[j] < 0:
            first = near.start[j]
            for k in range(near.fluid_count[j]):
                i = near.indices[first + k * near.stride]
                if choice[i] == j and (chosen < 0 or particles.particle_id[i] < particles.particle_id[chosen]):
                    chosen = i
        answers[j] = chosen


@kernel
def change_places(particles: Particles, answers: Integers, acceleration: Vectors, held: Floats) -> ti.i32:
    """Let pairs change places, and count them. Density and pressure are those of the place, and stay."""
    pairs = 0
    for j in range(particles.count):
        i = answers[j]
        if i >= 0:
            pairs += 1
            particles.velocity[i], particles.velocity[j] = particles.velocity[j], particles.velocity[i]
            particles.particle_id[i], particles.particle_id[j] = particles.particle_id[j], particles.particle_id[i]
            particles.phase[i], particles.phase[j] = particles.phase[j], particles.phase[i]
            acceleration[i], acceleration[j] = acceleration[j], acceleration[i]
            held[i] = 0.0
            held[j] = 0.0
    return pairs


@kernel
def change_scalars(answers: Integers, count: ti.i32, values: Floats):
    """A scalar of the particles that change places goes along."""
    for j in range(count):
        i = answers[j]
        if i >= 0:
            values[i], values[j] = values[j], values[i]
