"""Wind: the air of the box starts with it, and flows in with it where it blows in from outside."""

import taichi as ti

from sim.core.domain import Face
from sim.core.parameters import Vector3
from sim.smoke.obstacles import Obstacles


@ti.data_oriented
class Wind:
    """Air that flows in through the windward sides at a given velocity, and out of the other open sides freely.

    For the pressure windward sides are closed faces that move: u.n = U.n. Zero pressure there would let obstacles slow
    the wind down in time, as nothing but the air's inertia would drive it. What flows in has the whole velocity of the
    wind, so the first cells behind these sides are given its components along the side as well, before each projection.
    At all other open sides air comes and goes as the flow demands and the pressure outside can drive it (`OpenSides`).

    Args:
        obstacles: in the grid where the faces are; what they cover lets no wind in.
        wind: velocity U [m/s].
        windward: the open sides that it blows onto.
        openness: by axis, positive on faces that air passes, flat fields.
        velocity: the three face velocities [m/s], flat fields.
    """

    def __init__(
        self, obstacles: Obstacles, wind: Vector3, windward: tuple[Face, ...], *, openness: tuple, velocity: tuple
    ) -> None:
        grid = obstacles.grid
        self._obstacles, self._wind = obstacles, wind
        self._cells = grid.cells
        self._steps = (grid.padded[1] * grid.padded[2], grid.padded[2], 1)
        self._openness, self._velocity = openness, velocity
        # Axis, index of the cells behind the side, index of its faces.
        self._sides = [
            (axis, grid.cells[axis], grid.cells[axis] + 1) if side == "+" else (axis, 1, 1)
            for axis, side in (("xyz".index(face[0]), face[1]) for face in windward)
        ]

    def fill(self) -> None:
        """Let all air of the box move with the wind; faces of solids are at rest."""
        for axis in range(3):
            self._set_open_faces(self._openness[axis], self._velocity[axis], self._wind[axis])
        self.blow_in()

    def blow_in(self) -> None:
        """Give the windward sides, and the cells behind them, the velocity of the wind."""
        for axis, layer, face in self._sides:
            self._set_side(axis, layer, face)

    @ti.kernel
    def _set_open_faces(self, openness: ti.template(), field: ti.template(), speed: ti.f32):
        for at in field:
            field[at] = ti.select(openness[at] > 0.0, speed, 0.0)

    @ti.kernel
    def _set_side(self, axis: ti.template(), layer: ti.i32, face: ti.i32):
        along = ti.static(((1, 2), (0, 2), (0, 1))[axis])
        first, second = ti.static(along[0], along[1])
        normal = ti.static(self._velocity[axis])
        # One more than cells, for the faces at their far ends.
        for a, b in ti.ndrange((1, self._cells[first] + 2), (1, self._cells[second] + 2)):
            beside = a * self._steps[first] + b * self._steps[second]
            at = layer * self._steps[axis] + beside
            if a <= self._cells[first] and b <= self._cells[second] and not self._obstacles.is_solid(at):
                normal[face * self._steps[axis] + beside] = self._wind[axis]
            for tangent in ti.static(along):
                if self._openness[tangent][at] > 0.0:
                    self._velocity[tangent][at] = self._wind[tangent]
