"""Small scenes that several smoke tests share."""

import numpy as np

from sim.core.domain import Face
from sim.shapes import build_solid
from sim.shapes.parameters import Placement, SphereShape
from sim.smoke.grid import SmokeGrid
from sim.smoke.obstacles import MOVING, Obstacles

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


def set_faces(grid: SmokeGrid, fields, values) -> None:
    """Upload face velocities, each in the shape of its faces; closed faces get 0."""
    for axis, (field, value) in enumerate(zip(fields, values, strict=True)):
        field.from_numpy(grid.pad((value * (grid.open_area[axis] > 0.0)).astype(np.float32)).ravel())


def get_faces(grid: SmokeGrid, fields) -> list[np.ndarray]:
    return [grid.trim(field.to_numpy(), grid.face_shape(axis)) for axis, field in enumerate(fields)]


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
    state = obstacles.marked.to_numpy()
    state[obstacles.grid.pad(solid).ravel()] = MOVING
    obstacles.marked.from_numpy(state)
    fields = (obstacles.velocity_x, obstacles.velocity_y, obstacles.velocity_z)
    for field, value in zip(fields, velocity, strict=True):
        field.from_numpy(np.full(obstacles.grid.size, value, np.float32))
