"""Small scenes that several smoke tests share."""

from dataclasses import replace

import numpy as np
import taichi as ti

from sim.core.domain import Face
from sim.shapes.parameters import Placement, SphereShape
from sim.shapes.placement import build_solid
from sim.smoke.arrays import Faces, new_faces, new_state
from sim.smoke.cut_cells import FAR
from sim.smoke.grid import SmokeGrid
from sim.smoke.obstacles import Air, Obstacles

OPEN_BOX: tuple[Face, ...] = ("x-", "x+", "y-", "y+", "z+")
CLOSED_BOX: tuple[Face, ...] = ()


def unit_grid(cells: tuple[int, int, int], open_faces: tuple[Face, ...], *, obstacle: bool = False) -> SmokeGrid:
    """A box that is 1 m long in x, with a ball of 0.2 m in its middle if asked for."""
    cell_size = 1.0 / cells[0]
    empty = SmokeGrid.of_cells((0.0, 0.0, 0.0), cell_size, cells, frozenset(open_faces))
    if not obstacle:
        return empty
    middle = tuple(0.5 * n * cell_size for n in cells)
    return empty.with_solids([build_solid(Placement(shape=SphereShape(type="sphere", radius=0.2), position=middle))])


def with_blocks(grid: SmokeGrid, solid: np.ndarray) -> SmokeGrid:
    """A grid with whole cells that are solid, (nx, ny, nz) bool, and all whose corners those have."""
    return replace(grid, distance=corner_distance(solid))


def corner_distance(solid: np.ndarray) -> np.ndarray:
    """Of the corners of cells from solid ones, (nx + 1, ..) [cells]: 1 outside, 0 on their surface, -1 inside."""
    beside = np.pad(solid, 1, mode="edge").astype(np.int32)
    count = sum(beside[a : a - 1 or None, b : b - 1 or None, c : c - 1 or None] for a, b, c in np.ndindex(2, 2, 2))
    return np.where(count == 8, -1.0, np.where(count > 0, 0.0, 1.0)).astype(np.float32)


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


def areas_of(grid: SmokeGrid) -> Faces:
    """Open parts of faces, 1 without solids."""
    if grid.has_solids:
        return Obstacles(grid).solids.area
    areas = new_faces(grid.size)
    for array in areas:
        array.fill(1.0)
    return areas


def air_in(grid: SmokeGrid) -> Air:
    """Air at rest in a grid, without the solver around it."""
    return air_around(Obstacles(grid))


def air_around(obstacles: Obstacles) -> Air:
    """Air at rest among obstacles."""
    return Air(obstacles.box, obstacles.solids, openness_of(obstacles.grid), new_state(obstacles.grid.size))


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


def mark(obstacles: Obstacles, distance: np.ndarray, velocity: tuple[float, float, float]) -> None:
    """Mark the distances of corners, (nx + 1, ..) [cells], from a solid of one velocity [m/s]; no solid is static."""
    padded = obstacles.marks.distance.to_numpy().reshape(obstacles.grid.padded)
    padded[1:, 1:, 1:] = np.minimum(distance, FAR)
    obstacles.marks.distance.from_numpy(padded.ravel())
    for array, value in zip(obstacles.marks.velocity, velocity, strict=True):
        array.fill(value)


def block_distance(grid: SmokeGrid, low: tuple[float, ...], high: tuple[float, ...]) -> np.ndarray:
    """Of the corners from a box between two corners in cells; infinity is beyond the sides."""
    corners = np.stack(np.meshgrid(*(np.arange(n + 1.0) for n in grid.cells), indexing="ij"), axis=-1)
    beyond = np.maximum(np.asarray(low) - corners, corners - np.asarray(high))
    distance = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1) + np.minimum(beyond.max(axis=-1), 0.0)
    return np.maximum(distance, -FAR)
