"""Wind: the air of the box starts with it, and flows in with it where it blows in from outside."""

import taichi as ti

from sim.core.arrays import Floats
from sim.core.domain import Face
from sim.core.launch import kernel
from sim.core.parameters import Vector3
from sim.smoke.arrays import Faces
from sim.smoke.lanes import Grid, cell_counts, steps
from sim.smoke.obstacles import Obstacles, Solids, is_solid


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
        openness: positive on faces that air passes.
        velocity: of the faces [m/s].
    """

    def __init__(
        self, obstacles: Obstacles, wind: Vector3, windward: tuple[Face, ...], openness: Faces, velocity: Faces
    ) -> None:
        self._obstacles, self._wind = obstacles, wind
        self._openness, self._velocity = openness, velocity
        # Axis, index of the cells behind the side, index of its faces.
        cells = obstacles.grid.cells
        self._sides = [
            (axis, cells[axis], cells[axis] + 1) if side == "+" else (axis, 1, 1)
            for axis, side in (("xyz".index(face[0]), face[1]) for face in windward)
        ]

    def fill(self) -> None:
        """Let all air of the box move with the wind; faces of solids are at rest."""
        for openness, velocity, speed in zip(self._openness, self._velocity, self._wind, strict=True):
            _set_open_faces(openness, velocity, speed)
        self.blow_in()

    def blow_in(self) -> None:
        """Give the windward sides, and the cells behind them, the velocity of the wind."""
        box, solids = self._obstacles.box, self._obstacles.solids
        for axis, layer, face in self._sides:
            _set_side(axis, layer, face, box, solids, self._openness, self._velocity, ti.math.vec3(self._wind))


@kernel
def _set_open_faces(openness: Floats, velocity: Floats, speed: ti.f32):
    for at in range(velocity.shape[0]):
        velocity[at] = ti.select(openness[at] > 0.0, speed, 0.0)


@kernel
def _set_side(
    axis: ti.template(),
    layer: ti.i32,
    face: ti.i32,
    box: Grid,
    solids: Solids,
    openness: Faces,
    velocity: Faces,
    wind: ti.math.vec3,
):
    first, second = ti.static(((1, 2), (0, 2), (0, 1))[axis])
    cells, step = cell_counts(box), steps(box)
    end_a, end_b = cells[first], cells[second]
    # One more than cells, for the faces at their far ends.
    for a, b in ti.ndrange((1, end_a + 2), (1, end_b + 2)):
        beside = a * step[first] + b * step[second]
        at = layer * step[axis] + beside
        if a <= end_a and b <= end_b and not is_solid(solids, at):
            normal = ti.static((velocity.x, velocity.y, velocity.z)[axis])
            normal[face * step[axis] + beside] = wind[axis]
        for tangent in ti.static((first, second)):
            passes = ti.static((openness.x, openness.y, openness.z)[tangent])
            along = ti.static((velocity.x, velocity.y, velocity.z)[tangent])
            if passes[at] > 0.0:
                along[at] = wind[tangent]
