"""Steps of the particles: their motion, the walls that stop them, and measures of both."""

from dataclasses import dataclass
from typing import Self

import numpy as np
import taichi as ti

from sim.core.arrays import Floats, Vectors
from sim.core.domain import DomainParameters
from sim.core.launch import kernel
from sim.core.parameters import Vector3
from sim.core.reductions import LaneReduction, Results, Share, is_finite, reduced_tree

MAXIMA, COUNTS = 4, 3

UNLIMITED = 1.0e30  # coordinate that no particle reaches [m]


@dataclass(frozen=True)
class Box:
    """The box that holds the particles: closed faces stop them, open faces let them go.

    Attributes:
        walls: lower and upper corner of the closed faces [m]; out of reach where a face is open.
        openings: lower and upper corner of the open faces [m]; out of reach where a face is closed.
    """

    walls: tuple[Vector3, Vector3]
    openings: tuple[Vector3, Vector3]

    @classmethod
    def of_domain(cls, domain: DomainParameters) -> Self:
        """The box of a domain."""
        return cls(_corners(domain, of_open_faces=False), _corners(domain, of_open_faces=True))


def _corners(domain: DomainParameters, *, of_open_faces: bool) -> tuple[Vector3, Vector3]:
    is_open = np.array([[f"{axis}{side}" in domain.open_faces for axis in "xyz"] for side in "-+"])
    low = np.where(is_open[0] == of_open_faces, domain.min, -UNLIMITED)
    high = np.where(is_open[1] == of_open_faces, domain.max, UNLIMITED)
    return tuple(low.tolist()), tuple(high.tolist())


@dataclass(frozen=True)
class MotionSummary:
    """Motion of the particles in the last step.

    Attributes:
        max_speed: largest |v_i|, before a wall stops it [m/s].
        max_acceleration: largest |a_i| [m/s²].
        max_displacement: largest displacement of a particle [m].
        max_frequency: largest frequency at which a particle can swing against its own pressure [1/s].
        left: particles that passed an open face.
        touched: particles that were put back onto a wall.
        non_finite: particles with a position or velocity that is NaN or infinite.
    """

    max_speed: float
    max_acceleration: float
    max_displacement: float = 0.0
    max_frequency: float = 0.0
    left: int = 0
    touched: int = 0
    non_finite: int = 0


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
        results = advance_particles(
            position,
            velocity,
            acceleration,
            frequency_squared if with_frequency else reduction.partial,
            with_frequency,
            count,
            dt,
            *self.box.walls,
            *self.box.openings,
            reduction.over(count),
        )
        speed, strength, displacement, frequency, left, touched, bad = reduction.unpack(results)
        return MotionSummary(
            max_speed=float(np.sqrt(speed)),
            max_acceleration=float(np.sqrt(strength)),
            max_displacement=float(np.sqrt(displacement)),
            max_frequency=float(np.sqrt(frequency)),
            left=int(left),
            touched=int(touched),
            non_finite=int(bad),
        )


@kernel
def advance_particles(
    position: Vectors,
    velocity: Vectors,
    acceleration: Vectors,
    frequency_squared: Floats,
    with_frequency: ti.template(),
    count: ti.i32,
    dt: ti.f32,
    wall_low: ti.math.vec3,
    wall_high: ti.math.vec3,
    keep_low: ti.math.vec3,
    keep_high: ti.math.vec3,
    share: Share,
) -> Results:
    """Symplectic Euler, then the walls; returns these.

    Largest |v|² [m²/s²], before a wall stops it, |a|² [m²/s⁴], |x - x before|² [m²] and squared frequency [1/s²];
    how many particles passed an open face, were put back onto a wall, and had a position or velocity that was
    not finite before the wall. Those that are not finite count neither as gone nor as put back.
    """
    lanes = share.tree.lanes
    for lane in range(lanes):
        max_speed_squared = 0.0
        max_acceleration_squared = 0.0
        max_displacement_squared = 0.0
        max_frequency_squared = 0.0
        left = 0.0
        touched = 0.0
        bad = 0.0
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
                max_speed_squared = ti.max(max_speed_squared, v_i.norm_sqr())
                max_acceleration_squared = ti.max(max_acceleration_squared, a_i.norm_sqr())
                x_i = ti.min(ti.max(free, wall_low), wall_high)
                for axis in ti.static(range(3)):
                    if x_i[axis] != free[axis]:
                        v_i[axis] = 0.0
                if finite == 0:
                    bad += 1.0
                else:
                    if (x_i != free).any():
                        touched += 1.0
                    if (x_i < keep_low).any() or (x_i > keep_high).any():
                        left += 1.0
                max_displacement_squared = ti.max(max_displacement_squared, (x_i - x_before).norm_sqr())
                if ti.static(with_frequency):
                    max_frequency_squared = ti.max(max_frequency_squared, frequency_squared[i])
                position[i] = x_i
                velocity[i] = v_i
        share.tree.partial[lane] = max_speed_squared
        share.tree.partial[lanes + lane] = max_acceleration_squared
        share.tree.partial[2 * lanes + lane] = max_displacement_squared
        share.tree.partial[3 * lanes + lane] = max_frequency_squared
        share.tree.partial[4 * lanes + lane] = left
        share.tree.partial[5 * lanes + lane] = touched
        share.tree.partial[6 * lanes + lane] = bad
    return reduced_tree(share.tree)
