"""The pressure and the bodies that give way to it, without anything else."""

import numpy as np
import pytest
from smoke_scenes import CLOSED_BOX, OPEN_BOX, get_faces, set_faces, unit_grid

from sim.smoke.arrays import new_faces
from sim.smoke.free_bodies import FreeBodies
from sim.smoke.obstacles import NOBODY, Obstacles
from sim.smoke.projection import PressureProjection

pytestmark = pytest.mark.usefixtures("taichi_cpu")

AIR = 1.2
TOLERANCE = 1.0e-6
RADIUS = 0.13
CENTRES = np.array([[0.3, 0.52, 0.47], [0.72, 0.45, 0.55]])
VELOCITIES = np.array([[0.6, -0.3, 0.2], [-0.9, 0.1, 0.4]])
SPINS = np.array([[1.0, 2.0, -3.0], [-2.0, 4.0, 1.0]])


class BallsInAir:
    """Two balls that fly and spin in rough air of a unit box; their centres of mass are off their middles."""

    def __init__(self, cells: int, open_faces: tuple[str, ...], densities: tuple[float, float]) -> None:
        self.grid = unit_grid((cells, cells, cells), open_faces)
        self.obstacles = Obstacles(self.grid, moving=True, carries=True)
        self.velocity = new_faces(self.grid.size)
        self.bodies = FreeBodies(2)
        self.mass = np.array(densities) * 4.0 / 3.0 * np.pi * RADIUS**3
        self.inertia = np.array([m * RADIUS**2 * np.diag([0.3, 0.5, 0.4]) for m in self.mass])
        self.projection = PressureProjection(
            self.obstacles, self.velocity, tolerance=TOLERANCE, max_iterations=60, bodies=self.bodies
        )
        self.off = CENTRES + np.array([[0.03, 0.0, -0.05], [0.0, 0.04, 0.02]])
        for _ in range(2):  # so that the areas before are those after
            self._mark()
            self.obstacles.commit()
        self.projection.update()
        random = np.random.default_rng(3)
        shapes = [self.grid.face_shape(axis) for axis in range(3)]
        rough = [0.1 * random.standard_normal(shape) for shape in shapes]
        for axis, side in np.ndindex(3, 2):
            if not self.grid.is_open(axis, side):
                np.moveaxis(rough[axis], axis, 0)[-side] = 0.0
        set_faces(self.grid, self.velocity, rough)

    def _mark(self) -> None:
        marks, grid = self.obstacles.marks, self.grid
        corners = np.stack(np.meshgrid(*(np.arange(n + 1) for n in grid.cells), indexing="ij"), axis=-1)
        place = corners * grid.cell_size
        distances = [(np.linalg.norm(place - centre, axis=-1) - RADIUS) / grid.cell_size for centre in CENTRES]
        nearest = np.argmin(distances, axis=0)
        moved = [v + np.cross(s, place - c) for v, s, c in zip(VELOCITIES, SPINS, self.off, strict=True)]
        values = [
            np.minimum(np.min(distances, axis=0), 2.0),
            *np.moveaxis(np.where(nearest[..., None], *moved[::-1]), -1, 0),
        ]
        for array, inner, rest in zip(
            (marks.distance, *marks.velocity, marks.owner),
            [*values, nearest],
            (2.0, 0.0, 0.0, 0.0, NOBODY),
            strict=True,
        ):
            padded = np.full(grid.padded, rest, np.int32 if array is marks.owner else np.float32)
            padded[1:, 1:, 1:] = inner
            array.from_numpy(padded.ravel())

    def project(self, held: bool = False):
        corners = np.tile([[1, 1, 1], [self.grid.cells[0] + 1] * 3], (2, 1, 1))
        inverse = 1.0 / self.mass, np.linalg.inv(self.inertia)
        self.bodies.place(self.obstacles, corners, self.off, *inverse, AIR)
        if held:
            self.bodies.hold()
        return self.projection.project()


@pytest.mark.parametrize("open_faces", [CLOSED_BOX, OPEN_BOX], ids=["closed", "open"])
@pytest.mark.parametrize("densities", [(0.05, 3.0), (400.0, 0.4)], ids=["lighter than air", "one is heavy"])
def test_pressure_takes_the_energy_of_what_it_takes_away_from_air_and_bodies_together(open_faces, densities):
    """It is an orthogonal projection: what it changes has no part in what is left, measured by mass."""
    balls = BallsInAir(20, open_faces, densities)
    before = get_faces(balls.grid, balls.velocity)
    report = balls.project()
    assert report.converged
    assert report.iterations <= 40  # measured: 30 of a 24th of the air, 9 of 400 kg/m³ and 0.4
    after = get_faces(balls.grid, balls.velocity)
    impulses = balls.bodies.impulses()
    v = VELOCITIES + impulses[:, :3] / balls.mass[:, None]
    omega = SPINS + np.einsum("nij,nj->ni", np.linalg.inv(balls.inertia), impulses[:, 3:])
    areas = [
        balls.grid.trim(area.to_numpy(), face.shape)
        for area, face in zip(balls.obstacles.solids.area, after, strict=True)
    ]
    cell = AIR * balls.grid.cell_size**3
    for axis, side in balls.grid.open_sides:  # half a cell of air belongs to the face of a side
        np.moveaxis(areas[axis], axis, 0)[-side] *= 0.5
    air = [
        cell * area * face.astype(float) * (face - first)
        for area, face, first in zip(areas, after, before, strict=True)
    ]
    work = np.sum(v * impulses[:, :3]), np.sum(omega * impulses[:, 3:])
    total = sum(part.sum() for part in air) + sum(work)
    size = sum(np.abs(part).sum() for part in air) + np.abs(work).sum()
    assert np.abs(work).min() > 1.0e-3 * size
    assert abs(total) < 1.0e-5 * size  # the tolerance of the projection, over some cells


def test_momentum_that_the_pressure_takes_from_the_air_is_what_bodies_and_sides_get():
    """All sides are open, and what passes them is counted."""
    balls = BallsInAir(20, (*OPEN_BOX, "z-"), (1.0, 3.0))
    before = get_faces(balls.grid, balls.velocity)
    balls.project()
    after = get_faces(balls.grid, balls.velocity)
    impulse = balls.bodies.impulses()[:, :3].sum(axis=0)
    cell = AIR * balls.grid.cell_size**3
    for axis, (first, face) in enumerate(zip(before, after, strict=True)):
        area = balls.grid.trim(balls.obstacles.solids.area[axis].to_numpy(), face.shape)
        change = np.moveaxis(cell * area * (face.astype(float) - first), axis, 0)
        # Half a cell of air belongs to a face of the sides, where pressure is 0.
        gained = change[1:-1].sum() + 0.5 * (change[0].sum() + change[-1].sum())
        assert abs(gained + impulse[axis]) < 2.0e-6 * np.abs(change).sum()


def test_what_is_held_gets_impulses_and_does_not_yield():
    balls = BallsInAir(20, CLOSED_BOX, (1.0, 3.0))
    marked = [array.to_numpy() for array in balls.obstacles.solids.velocity]
    balls.project(held=True)
    assert np.abs(balls.bodies.impulses()).min() > 0.0
    for array, first in zip(balls.obstacles.solids.velocity, marked, strict=True):
        np.testing.assert_array_equal(array.to_numpy(), first)


def test_heavy_bodies_take_no_more_iterations_than_held_ones():
    counts = [BallsInAir(20, CLOSED_BOX, (2000.0, 2000.0)).project(held=held).iterations for held in (True, False)]
    assert counts[1] <= counts[0] + 1


def test_there_is_room_for_more_rows_of_cells_than_a_fifth_of_the_bodies():
    """One of 40 bodies, three cells wide, is in the air: 25 rows, each of five numbers."""
    count, obstacles = 40, Obstacles(unit_grid((8, 8, 8), OPEN_BOX), moving=True, carries=True)
    bodies = FreeBodies(count)
    corners = np.tile([[2**31 - 1] * 3, [-1] * 3], (count, 1, 1))
    corners[7] = [[3, 3, 3], [6, 6, 6]]
    bodies.place(obstacles, corners, np.full((count, 3), 0.5), np.ones(count), np.tile(np.eye(3), (count, 1, 1)), AIR)
    rows = bodies.carried.rows.to_numpy()[: 5 * bodies.carried.row_count].reshape(-1, 5)
    beside = range(2, 7)
    assert rows.tolist() == [[7, i, j, 2, 6] for i in beside for j in beside]
