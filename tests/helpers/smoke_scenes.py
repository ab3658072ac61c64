"""Small scenes that several smoke tests share."""

import numpy as np
import taichi as ti

from sim.core.domain import Face
from sim.shapes.parameters import Placement, SphereShape
from sim.shapes.placement import build_solid
from sim.smoke.arrays import Faces, new_faces, new_state
from sim.smoke.grid import SmokeGrid
from sim.smoke.obstacles import MOVING, Air, Obstacles

OPEN_BOX: tuple[Face, ...] = ("x-", "x+", "y-", "y+", "z+")
CLOSED_BOX: tuple[Face, ...] = ()


def unit_grid(cells: tuple[int, int, int], open_faces: tuple[Face, ...], *, obstacle: bool = False) -> SmokeGrid:
    """A box that is 1 m long in x, with a ball of 0.2 m in its middle if asked for."""
    cell_size = 1.0 / cells[0]
    empty = SmokeGrid((0.0, 0.0, 0.0), cell_size, cells, frozenset(open_faces), np.zeros(cells, bool))
    if not obstacle:
        return empty
    middle = tuple(0.5 * n * cell_size for n in cells)
    ball = build_solid(Placement(shape=SphereShape(type="sphere", radius=0.2), position=middle))
    return SmokeGrid(empty.origin, cell_size, cells, empty.open_faces, empty.cells_inside(ball))


def set_faces(grid: SmokeGrid, faces: Faces, values) -> None:
    """Upload face velocities, each in the shape of its faces; closed faces get 0."""
    for axis, (array, value) in enumerate(zip(faces, values, strict=True)):
        array.from_numpy(grid.pad((value * (grid.open_area[axis] > 0.0)).astype(np.float32)).ravel())


def get_faces(grid: SmokeGrid, faces: Faces) -> list[np.ndarray]:
    return [grid.trim(array.to_numpy(), grid.face_shape(axis)) for axis, array in enumerate(faces)]


def openness_of(grid: SmokeGrid) -> Faces:
    """1 on open faces, 0 on closed ones."""
    openness = new_faces(grid.size)
    set_faces(grid, openness, (1.0, 1.0, 1.0))
    return openness


def air_in(grid: SmokeGrid) -> Air:
    """Air at rest in a grid, without the solver around it."""
    obstacles = Obstacles(grid)
    return Air(obstacles.box, obstacles.solids, openness_of(grid), new_state(grid.size))


class Bytes:
    """Counts what the arrays that are made from now on take; of at least so many values each."""

    def __init__(self, monkeypatch, *, least_values: int = 0) -> None:
        self.total = 0
        make, make_vectors = ti.ndarray, ti.Vector.ndarray

        def note(array):
            size = array.arr.nelement() * array.arr.element_size()
            if size >= 4 * least_values:
                self.total += size
            return array

        monkeypatch.setattr(ti, "ndarray", lambda *args, **keywords: note(make(*args, **keywords)))
        monkeypatch.setattr(ti.Vector, "ndarray", lambda *args, **keywords: note(make_vectors(*args, **keywords)))


def rough_velocity(grid: SmokeGrid) -> list[np.ndarray]:
    """A jet with noise: every length from the box to the cell has divergence."""
    random = np.random.default_rng(1)
    values = []
    for axis in range(3):
        shape = grid.face_shape(axis)
        position = grid.face_centres(axis).reshape(*shape, 3)
        jet = np.exp(-((position - 0.5) ** 2).sum(axis=-1) / 0.02)
        values.append(jet + 0.1 * random.standard_normal(shape))
    return values


def mark(obstacles: Obstacles, solid: np.ndarray, velocity: tuple[float, float, float]) -> None:
    """Mark cells, (nx, ny, nz) bool, as solid in the coming step, all with one velocity [m/s]; no solid is static."""
    state = obstacles.marks.state.to_numpy()
    state[obstacles.grid.pad(solid).ravel()] = MOVING
    obstacles.marks.state.from_numpy(state)
    for array, value in zip(obstacles.marks.velocity, velocity, strict=True):
        array.fill(value)
