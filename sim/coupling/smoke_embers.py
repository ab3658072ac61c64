"""Embers in the air of a smoke: they are carried, and do not slow it."""

from typing import TYPE_CHECKING

import taichi as ti

from sim.core.arrays import Integers, Vectors
from sim.core.launch import kernel
from sim.smoke.interpolation import face_velocity_at
from sim.smoke.lanes import cell_counts, row_start
from sim.smoke.obstacles import Air, mean_volume

if TYPE_CHECKING:
    from sim.core.domain import DomainParameters
    from sim.smoke.solver import SmokeSolver

FAR = 1.0e30  # from anything [m]
SOLID_PART = 0.5  # of a cell with less air an ember is inside of what is solid


class AirOfSmoke:
    """The air of a smoke where embers are.

    Outside of the smoke's box air is at rest, outside of a window of it as it is there. What is in the way of the air
    stops them, and so do faces of the domain that are closed to the smoke, too.
    """

    def __init__(self, smoke: "SmokeSolver", domain: "DomainParameters") -> None:
        self._smoke, self.cell_size = smoke, smoke.parameters.cell_size
        is_open = {*domain.open_faces, *smoke.parameters.open_faces}
        sides = zip("xyz", domain.min, domain.max, strict=True)
        ends = [
            (-FAR if f"{axis}-" in is_open else low, FAR if f"{axis}+" in is_open else high)
            for axis, low, high in sides
        ]
        self.low, self.high = (ti.math.vec3(end) for end in zip(*ends, strict=True))
        everywhere = ((-FAR,) * 3, (FAR,) * 3)
        around = {"box": ((0.0,) * 3,) * 2, "window": smoke.parameters.corners(domain), "open": everywhere}
        self._around = tuple(map(ti.math.vec3, around[smoke.parameters.grid]))

    def find(self, position: ti.Ndarray, velocity: ti.Ndarray, is_stuck: ti.Ndarray) -> None:
        """Velocity of the air at positions now [m/s], (n, 3), and where something stops what flies, (n,)."""
        smoke = self._smoke
        outside = (ti.math.vec3(smoke.outside_velocity), *self._around)
        place = ti.math.vec3(smoke.grid.origin), smoke.grid.cell_size, self.low, self.high
        _find(smoke.air, *outside, *place, position, velocity, is_stuck)


@kernel
def _find(
    air: Air,
    outside: ti.math.vec3,
    around_low: ti.math.vec3,
    around_high: ti.math.vec3,
    origin: ti.math.vec3,
    cell_size: ti.f32,
    low: ti.math.vec3,
    high: ti.math.vec3,
    position: Vectors,
    velocity: Vectors,
    is_stuck: Integers,
):
    box, solids, state = ti.static((air.box, air.solids, air.state))
    for i in range(position.shape[0]):
        place = (position[i] - origin) / cell_size
        cell = ti.floor(place, ti.i32) + 1
        is_around = (position[i] > around_low).all() and (position[i] < around_high).all()
        found = ti.select(is_around, outside, ti.math.vec3(0.0))
        stuck = int(not ((position[i] > low).all() and (position[i] < high).all()))
        if (cell >= 1).all() and (cell <= cell_counts(box)).all():
            found = face_velocity_at(box, state.velocity, place)
            if mean_volume(solids, row_start(box, cell[0], cell[1]) + cell[2]) < SOLID_PART:
                stuck = 1
        velocity[i], is_stuck[i] = found, stuck
