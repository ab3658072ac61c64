"""Steps of the particles: their motion, the walls that stop them, and measures of it, and of the solves of a frame."""

import math
from dataclasses import dataclass

import numpy as np
import taichi as ti

from sim.core.arrays import Floats, Vectors
from sim.core.box import Box
from sim.core.launch import kernel
from sim.core.reductions import LaneReduction, Results, Share, is_finite, reduced_tree

MAXIMA, COUNTS = 4, 3


@dataclass(frozen=True)
class MotionSummary:
    """Motion of the particles in the last step."""

    max_speed: float  # largest |v_i|, before a wall stops it [m/s]
    max_acceleration: float  # largest |a_i| [m/s²]
    max_displacement: float = 0.0  # largest displacement of a particle [m]
    max_frequency: float = 0.0  # largest frequency at which a particle can swing against its own pressure [1/s]
    left: int = 0  # particles that passed an open face
    touched: int = 0  # particles that were put back onto a wall
    non_finite: int = 0  # particles with a position or velocity that is NaN or infinite


class ParticleStepper:
    """Symplectic Euler for the particles, which measures their motion in the same pass."""

    def __init__(self, box: Box) -> None:
        self.box = box
        self._reduction = LaneReduction(maxima=MAXIMA, sums=COUNTS)

    def advance(
        self,
        position: ti.Ndarray,
        velocity: ti.Ndarray,
        acceleration: ti.Ndarray,
        count: int,
        dt: float,
        frequency_squared: ti.Ndarray | None = None,
    ) -> MotionSummary:
        """v_i += dt a_i, x_i += dt v_i; then particles that passed a wall are put back onto it.

        `frequency_squared` is that at which each particle can swing against its own pressure [1/s²].
        """
        reduction, with_frequency = self._reduction, frequency_squared is not None
        frequency = frequency_squared if with_frequency else reduction.partial
        share = reduction.over(count)
        results = advance_particles(
            position, velocity, acceleration, frequency, with_frequency, count, dt, self.box, share
        )
        *squares, left, touched, bad = reduction.unpack(results)
        return MotionSummary(*(float(np.sqrt(square)) for square in squares), int(left), int(touched), int(bad))


@kernel
def advance_particles(
    position: Vectors,
    velocity: Vectors,
    acceleration: Vectors,
    frequency_squared: Floats,
    with_frequency: ti.template(),
    count: ti.i32,
    dt: ti.f32,
    box: Box,
    share: Share,
) -> Results:
    """Symplectic Euler, then the walls; returns these.

    Largest |v|² [m²/s²], before a wall stops it, |a|² [m²/s⁴], |x - x before|² [m²] and squared frequency [1/s²];
    how many particles passed an open face, were put back onto a wall, and had a position or velocity that was
    not finite before the wall. Those that are not finite count neither as gone nor as put back.
    """
    lanes = share.tree.lanes
    for lane in range(lanes):
        largest = ti.math.vec4(0.0)
        counts = ti.math.vec3(0.0)
        for k in range(share.items):
            i = lane * share.lane_step + k * share.item_step
            if i < count:
                a_i = acceleration[i]
                x_before = position[i]
                v_i = velocity[i] + dt * a_i
                free = x_before + dt * v_i
                # Before the wall: it would turn NaN into a point on itself, and infinite speed into rest.
                finite = 1
                for axis in ti.static(range(3)):
                    finite &= is_finite(v_i[axis]) & is_finite(free[axis])
                largest[0] = ti.max(largest[0], v_i.norm_sqr())
                largest[1] = ti.max(largest[1], a_i.norm_sqr())
                x_i = ti.min(ti.max(free, box.wall_low), box.wall_high)
                for axis in ti.static(range(3)):
                    if x_i[axis] != free[axis]:
                        v_i[axis] = 0.0
                if finite == 0:
                    counts[2] += 1.0
                else:
                    if (x_i != free).any():
                        counts[1] += 1.0
                    if (x_i < box.keep_low).any() or (x_i > box.keep_high).any():
                        counts[0] += 1.0
                largest[2] = ti.max(largest[2], (x_i - x_before).norm_sqr())
                if ti.static(with_frequency):
                    largest[3] = ti.max(largest[3], frequency_squared[i])
                position[i] = x_i
                velocity[i] = v_i
        for q in ti.static(range(MAXIMA)):
            share.tree.partial[q * lanes + lane] = largest[q]
        for q in ti.static(range(COUNTS)):
            share.tree.partial[(MAXIMA + q) * lanes + lane] = counts[q]
    return reduced_tree(share.tree)


@dataclass
class SolveRecord:
    """Counters of the solves of one kind in a frame."""

    solves: int = 0  # their number
    iterations: int = 0  # of all of them
    worst_error: float = 0.0  # largest error with which one ended [-]
    not_converged: int = 0  # number of those that ended before their error was below the tolerance

    def add(self, iterations: int, error: float, *, converged: bool) -> None:
        """Count one solve."""
        self.solves += 1
        self.iterations += iterations
        # A NaN is larger than any number here, and stays.
        if not (error <= self.worst_error or math.isnan(self.worst_error)):
            self.worst_error = error
        self.not_converged += not converged

    def clear(self) -> None:
        """Begin a frame."""
        self.solves = self.iterations = self.not_converged = 0
        self.worst_error = 0.0

    @property
    def mean_iterations(self) -> float:
        """Iterations per solve."""
        return self.iterations / max(self.solves, 1)
