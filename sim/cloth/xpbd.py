"""Compliant springs with small steps: XPBD with one iteration a step (Macklin et al. 2019, "Small steps")."""

from collections.abc import Sequence

import taichi as ti

from sim.arrays import Floats, Integers, Vectors
from sim.cloth.device_springs import COLOURS_AT_ONCE, TINY_LENGTH, DeviceSprings, Laws, coefficient, separation
from sim.cloth.state import ClothState, Lattice
from sim.cloth.threads import ThreadSolver
from sim.launch import fast_launch

PAIR, BEND_OF_GRID = 2, 3
"""Nodes of springs: of an ordinary one, and of one over a node of a rectangle, which is flat at rest."""


class XPBDSprings:
    """Gauss-Seidel over the springs, colour by colour, each an implicit Euler step of that spring alone.

    Nodes that a spring moves in a colour belong to no other spring of it, so the result is the same whatever the number
    of threads. Momentum of free cloth is kept to rounding. Angular momentum is not quite: springs push along their
    predicted direction rather than that of the start, as implicit Euler does. Explicit springs keep both.

    Approximate: one sweep a step does not let a stiff spring know of all that hangs on it. A spring alone, of a colour
    that comes early, stretches by 2 n g dt² more than it should if n nodes hang on it, whatever its stiffness; the last
    spring of a piece of thread by n g dt², and those within a piece by nothing. That falls with the square of the step.
    """

    def __init__(self, state: ClothState, springs: Sequence[DeviceSprings]) -> None:
        self._state, self._springs = state, springs
        self._threads = [ThreadSolver(family) for family in springs if family.in_segments]

    def stable_dt(self) -> float:
        """Any step is stable [s]."""
        return float("inf")

    def accelerate(self, dt: float) -> None:
        """Damp the velocities along springs between two nodes.

        Apart from their own sweep: there, a damping of gamma = tau / dt (Macklin et al. 2016, eq. 26) also brakes what
        the sweep has to undo of the prediction, and makes their largest stiffness 1 + gamma times smaller. Bend springs
        come first in the sweep, and what gravity predicts does not bend the cloth; they are damped there.
        """
        state = self._state
        for springs in self._springs:
            if springs.arity > PAIR or not springs.is_damped:
                continue
            for colour in springs.first_colours:
                damp_springs(
                    springs.nodes, springs.law, springs.coefficients, springs.segment_start, springs.piece_of_colour,
                    colour, state.lattice, state.quantum, state.carry, state.inverse_mass, dt, springs.arity,
                    state.velocity,
                )  # fmt: skip

    def displace(self, dt: float) -> None:
        """Bring the displacements of a step of dt [s] to where the springs let them go."""
        state = self._state
        for springs in self._springs:
            for colour in () if springs.in_segments else springs.first_colours:
                solve_springs(
                    springs.nodes, springs.law, springs.coefficients, springs.piece_of_colour, colour, state.lattice,
                    state.quantum, state.inverse_mass, dt, springs.arity, state.displacement,
                )  # fmt: skip
        for threads in self._threads:
            threads.displace(state, dt)


@ti.func
def solve_spring(
    s: ti.i32, nodes: Integers, law: Laws, coefficients: Floats, lattice: Lattice, quantum: ti.f32,
    inverse_mass: Floats, dt: ti.f32, arity: ti.template(), displacement: Vectors,
):  # fmt: skip
    """Macklin, Müller & Chentanez 2016, eq. 26, from a multiplier of 0:

        Delta lambda = -(C + gamma dC) / ((1 + gamma) sum_a w_a c_a² + 1/(k dt²)),   gamma = tau / dt

    multiplied through by k dt², so that springs without stiffness do nothing; gamma is 0 between two nodes. `law` is
    (rest, k, tau).
    """
    d = separation(nodes, coefficients, lattice, quantum, s, arity)
    moved = ti.math.vec3(0.0)
    weight = 0.0
    for a in ti.static(range(arity)):
        c_a = coefficient(coefficients, s, arity, a)
        i = nodes[arity * s + a]
        moved += c_a * displacement[i]
        weight += c_a * c_a * inverse_mass[i]
    d += moved
    squared = d.dot(d)
    if squared > TINY_LENGTH * TINY_LENGTH:
        strength = law[s][1] * dt * dt
        error = 1.0  # over |d|
        if ti.static(arity != BEND_OF_GRID):
            error -= law[s][0] / ti.sqrt(squared)
        if ti.static(arity > PAIR):
            gamma = law[s][2] / dt
            error += gamma * d.dot(moved) / squared
            weight *= 1.0 + gamma
        impulse = -strength * error / (strength * weight + 1.0) * d
        for a in ti.static(range(arity)):
            i = nodes[arity * s + a]
            displacement[i] += inverse_mass[i] * coefficient(coefficients, s, arity, a) * impulse


@fast_launch
@ti.kernel
def solve_springs(
    nodes: Integers, law: Laws, coefficients: Floats, spring_of_colour: Integers, colour: ti.i32,
    lattice: Lattice, quantum: ti.f32, inverse_mass: Floats, dt: ti.f32, arity: ti.template(), displacement: Vectors,
):  # fmt: skip
    """The springs of some colours, from `colour` on, one colour after the other."""
    for k in ti.static(range(COLOURS_AT_ONCE)):
        for s in range(spring_of_colour[colour + k], spring_of_colour[colour + k + 1]):
            solve_spring(s, nodes, law, coefficients, lattice, quantum, inverse_mass, dt, arity, displacement)


@ti.func
def damp_spring(
    s: ti.i32, nodes: Integers, law: Laws, coefficients: Floats, lattice: Lattice, quantum: ti.f32, carry: Vectors,
    inverse_mass: Floats, dt: ti.f32, arity: ti.template(), velocity: Vectors,
):  # fmt: skip
    """Implicit Euler of the force -tau k dC/dt along a spring."""
    strength = law[s][1] * law[s][2] * dt
    d = separation(nodes, coefficients, lattice, quantum, s, arity)
    rate = ti.math.vec3(0.0)
    weight = 0.0
    for a in ti.static(range(arity)):
        c_a = coefficient(coefficients, s, arity, a)
        i = nodes[arity * s + a]
        d += c_a * carry[i]
        rate += c_a * velocity[i]
        weight += c_a * c_a * inverse_mass[i]
    squared = d.dot(d)
    if squared > TINY_LENGTH * TINY_LENGTH:
        impulse = -strength / (strength * weight + 1.0) * d.dot(rate) / squared * d
        for a in ti.static(range(arity)):
            i = nodes[arity * s + a]
            velocity[i] += inverse_mass[i] * coefficient(coefficients, s, arity, a) * impulse


@fast_launch
@ti.kernel
def damp_springs(
    nodes: Integers, law: Laws, coefficients: Floats, segment_start: Integers, piece_of_colour: Integers,
    colour: ti.i32, lattice: Lattice, quantum: ti.f32, carry: Vectors, inverse_mass: Floats, dt: ti.f32,
    arity: ti.template(), velocity: Vectors,
):  # fmt: skip
    """The springs of some colours, one colour after the other, and one by one within a piece."""
    for k in ti.static(range(COLOURS_AT_ONCE)):
        for piece in range(piece_of_colour[colour + k], piece_of_colour[colour + k + 1]):
            for s in range(segment_start[piece], segment_start[piece + 1]):
                damp_spring(s, nodes, law, coefficients, lattice, quantum, carry, inverse_mass, dt, arity, velocity)
