from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse
from smoke_scenes import OPEN_BOX, block_distance, mark, unit_grid

from sim.core.domain import DomainParameters
from sim.smoke.cut_cells import FAR
from sim.smoke.multigrid_levels import Coefficients
from sim.smoke.obstacles import Obstacles, time_of_travel
from sim.smoke.parameters import SmokeParameters
from sim.smoke.regions import ClosedRegions
from sim.smoke.solver import SmokeSolver

pytestmark = pytest.mark.usefixtures("taichi_cpu")

CELLS = (16, 8, 8)
CELL_SIZE = 1.0 / 16
DT = 0.01
SPEED = 0.3
TOLERANCE = 1.0e-5
"""Of the projection, which is the default; a speed that adds up over n cells may be off by n times as much."""


@pytest.fixture(scope="module")
def shared_box(taichi_cpu):
    parameters = SmokeParameters(
        name="air",
        cell_size=CELL_SIZE,
        source=[{"shape": {"type": "sphere", "radius": 0.07}, "position": (0.9, 0.25, 0.25)}],
        open_faces=(),
        buoyancy_density=0.0,
        buoyancy_temperature=0.0,
        vorticity_confinement=0.0,
        cooling=0.0,
    )
    domain = DomainParameters(min=(0.0, 0.0, 0.0), max=(1.0, 0.5, 0.5))
    return SmokeSolver(parameters, domain=domain, gravity=(0.0, 0.0, -9.81), moving=True)


@pytest.fixture
def box(shared_box):
    """A closed box of air at rest with nothing in it."""
    nothing = {name: np.zeros_like(array) for name, array in shared_box.checkpoint().items()}
    nothing["obstacles"] += FAR
    shared_box.restore(nothing)
    shared_box.begin_frame(0.0)
    shared_box.obstacles.movers.clear()
    return shared_box


INFINITE = np.inf


def put_block(solver: SmokeSolver, low, high, speed=(0.0, 0.0, 0.0)) -> None:
    """Mark a box between two corners in cells, of which missing ones are beyond the sides."""
    low, high = (*low, *[-INFINITE] * (3 - len(low))), (*high, *[INFINITE] * (3 - len(high)))
    mark(solver.obstacles, block_distance(solver.grid, low, high), speed)


def velocity(solver: SmokeSolver, axis: int) -> np.ndarray:
    name = ("u_face_x", "v_face_y", "w_face_z")[axis]
    return solver.grid.trim(solver.checkpoint()[name], solver.grid.face_shape(axis))


def fill_with_smoke(solver: SmokeSolver) -> None:
    state = solver.checkpoint()
    state["density"][1:-1, 1:-1, 1:-1] = 1.0
    solver.restore(state)


def test_a_piston_in_a_closed_box_compresses_the_air_evenly(box):
    put_block(box, (-INFINITE,), (4.0,), (SPEED, 0.0, 0.0))
    box.move_obstacles()
    put_block(box, (-INFINITE,), (4.0,), (SPEED, 0.0, 0.0))
    box.substep(DT)
    # div u is the same everywhere, so that u falls linearly from the piston, at 4 cells, to the wall at 16.
    expected = SPEED * (1.0 - (np.arange(4, 17) - 4) / 12)
    assert np.abs(velocity(box, 0)[4:] - expected[:, None, None]).max() < 12 * TOLERANCE * SPEED
    assert np.abs(velocity(box, 1)[4:]).max() < 12 * TOLERANCE * SPEED
    numbers = box.diagnostics()
    assert numbers["compression"] == pytest.approx(SPEED / (12 * CELL_SIZE), rel=1.0e-6)
    assert numbers["not_converged"] == 0.0
    assert numbers["residual"] <= TOLERANCE


def test_a_piston_that_cuts_cells_presses_as_one_that_does_not(box):
    for _ in range(2):
        put_block(box, (-INFINITE,), (4.3,), (SPEED, 0.0, 0.0))
        box.substep(DT)
    expected = SPEED * (16.0 - np.arange(5, 17)) / 11.7
    assert np.abs(velocity(box, 0)[5:] - expected[:, None, None]).max() < 12 * TOLERANCE * SPEED
    assert box.diagnostics()["compression"] == pytest.approx(SPEED / (11.7 * CELL_SIZE), rel=1.0e-6)


def test_a_wall_that_moves_through_a_closed_box_stretches_one_side_and_compresses_the_other(box):
    for _ in range(2):
        put_block(box, (8.0,), (9.0,), (SPEED, 0.0, 0.0))
        box.substep(DT)
    u = velocity(box, 0)
    left, right = SPEED * np.arange(9) / 8, SPEED * (1.0 - np.arange(8) / 7)
    assert np.abs(u[:9] - left[:, None, None]).max() < 8 * TOLERANCE * SPEED
    assert np.abs(u[9:] - right[:, None, None]).max() < 8 * TOLERANCE * SPEED
    assert box.diagnostics()["compression"] == pytest.approx(SPEED / (7 * CELL_SIZE), rel=1.0e-6)
    # Once it is gone the two are one again, and nothing presses on it.
    for _ in range(2):
        box.begin_frame(DT)
        box.substep(DT)
    assert box.obstacles.is_air().all()
    # Rounding alone: speeds of 0.3 m/s in single precision err by 3e-8, over a cell of 1/16 m.
    assert box.diagnostics()["compression"] < 1.0e-6


@pytest.mark.parametrize("shift", [(0.0, 0.0, 0.0), (0.3, 0.45, 0.8)], ids=["along the grid", "between its planes"])
def test_a_body_inside_closed_walls_compresses_nothing(box, shift):
    velocities = (SPEED, -0.2, 0.1)
    low, high = np.add((5.0, 2.0, 3.0), shift), np.add((9.0, 5.0, 6.0), shift)
    for _ in range(2):
        put_block(box, low, high, velocities)
        box.substep(DT)
    numbers = box.diagnostics()
    assert numbers["compression"] < 1.0e-6
    assert numbers["residual"] <= TOLERANCE
    u, v, w = (velocity(box, axis) for axis in range(3))
    if not any(shift):
        on_surface = u[[5, 9], 2:5, 3:6], v[5:9, [2, 5], 3:6], w[5:9, 2:5, [3, 6]]
        for faces, own in zip(on_surface, velocities, strict=True):
            np.testing.assert_array_max_ulp(faces, np.full_like(faces, own), 1)  # they go through a normal
    # Air flows back beside it: through every cross-section, with the body's own part, no volume passes.
    for axis, (flow, own) in enumerate(zip((u, v, w), velocities, strict=True)):
        area = box.grid.trim(box.obstacles.solids.area[axis].to_numpy(), flow.shape).astype(np.float64)
        passing = (area * flow + (1.0 - area) * own).sum(axis=tuple({0, 1, 2} - {axis}))
        assert np.abs(passing).max() < 64 * 16 * TOLERANCE * SPEED


@pytest.mark.parametrize("ways", [3, 7], ids=["a third of a cell a step", "a seventh"])
def test_a_body_passes_through_even_smoke_and_leaves_it_even(box, ways):
    fill_with_smoke(box)
    speed = CELL_SIZE / ways / DT
    for step in range(24):
        first = 2.0 + step / ways
        put_block(box, (first, 3.0, 2.0), (first + 3.0, 6.0, 5.0), (speed, 0.0, 0.0))
        box.substep(DT)
        density = box.snapshots()["air"].arrays["density"]
        air = box.obstacles.is_air()
        assert not density[~air].any()
        # Means of ones are ones, but for a rounding of each of 24 steps.
        assert np.abs(density[air] - 1.0).max() < 24 * 4 * 6.0e-8
    volume = box.obstacles.open_volume().sum(dtype=np.float64)
    assert box.diagnostics()["mass"] == pytest.approx(volume * CELL_SIZE**3, rel=1.0e-5)


def test_what_a_body_that_leaps_leaves_is_filled_from_around_it(box):
    fill_with_smoke(box)
    put_block(box, (-INFINITE,), (12.0,))
    box.substep(DT)
    density = box.snapshots()["air"].arrays["density"]
    assert not density[:12].any()
    assert np.abs(density[12:] - 1.0).max() < 1.0e-5
    box.substep(DT)
    density = box.snapshots()["air"].arrays["density"]
    # The next layer; nobody knows what would be deeper, and a body that moves by cells never leaves more.
    assert np.abs(density[11:] - 1.0).max() < 1.0e-5
    assert not density[:11].any()


def test_a_source_emits_nothing_where_a_body_stands(box):
    put_block(box, (12.0,), (INFINITE,))
    box.substep(DT)
    assert box.diagnostics()["emitted_mass"] == 0.0
    box.substep(DT)  # in which it leaves
    box.substep(DT)
    assert box.diagnostics()["emitted_mass"] > 0.0


class Bullet:
    def stable_dt(self) -> float:
        return time_of_travel(CELL_SIZE, speed=1.0e3, acceleration=0.0)


def test_obstacles_cross_one_cell_in_a_step_at_most(box):
    box.obstacles.movers.append(Bullet())
    assert box.stable_dt() == pytest.approx(CELL_SIZE / 1.0e3, rel=1.0e-12)


def test_a_box_of_no_whole_number_of_cells_ends_where_its_last_cell_does():
    source = [{"shape": {"type": "sphere", "radius": 0.07}}]
    domain = DomainParameters(min=(0.0, 0.0, -0.3), max=(1.0, 0.95, 0.0))
    smoke = SmokeParameters(name="air", cell_size=0.1, source=source)
    # An edge of 0.95 m is ten cells of 0.1 m; what is whole but for rounding, -0.3 + 3 * 0.1 = 5.6e-17, stays.
    assert smoke.corners(domain) == ((0.0, 0.0, -0.3), (1.0, 1.0, 0.0))


def test_coefficients_that_followed_obstacles_equal_those_of_static_ones(box):
    random = np.random.default_rng(4)
    for share in (0.5, 0.1, 0.3):
        distance = (random.random([n + 1 for n in CELLS]) - share).astype(np.float32)
        for _ in range(3):  # until nothing changes any more: coefficients are those of the middle of the step
            mark(box.obstacles, distance, (0.0, 0.0, 0.0))
            box.move_obstacles()
    followed = box._projection.multigrid
    static = Coefficients(Obstacles(replace(box.grid, distance=distance)))
    mine, other = (
        [array.to_numpy() for array in (*operator.faces, operator.inverse_diagonal)]
        for operator in (followed.coefficients.operator, static.operator)
    )
    assert all(map(np.array_equal, mine, other))
    assert np.array_equal(followed._coarsest_conductance, static.coarsest_conductance())
    # Many cells are shut in alone, and have no equation.
    assert (static.operator.inverse_diagonal.to_numpy()[: box.grid.size] == 0.0).sum() > 0


def labels_through(areas: list[np.ndarray], is_air: np.ndarray) -> tuple[np.ndarray, int]:
    """Regions of cells that are connected through faces, from 1; solid ones have 0."""
    index = np.arange(is_air.size).reshape(is_air.shape)
    pairs = []
    for axis, is_open in enumerate(areas):
        cells, inner = np.moveaxis(index, axis, 0), np.moveaxis(is_open, axis, 0)[1:-1]
        pairs.append(np.stack([cells[:-1][inner], cells[1:][inner]]))
    low, high = np.concatenate(pairs, axis=1)
    graph = sparse.coo_array((np.ones(len(low), bool), (low, high)), shape=(index.size, index.size))
    count, labels = sparse.csgraph.connected_components(graph, directed=False)
    return np.where(is_air, labels.reshape(is_air.shape) + 1, 0), count


@pytest.mark.parametrize("open_faces", [(), OPEN_BOX, ("z-", "y+")], ids=["closed", "open", "two open sides"])
def test_closed_regions_are_the_connected_components_that_touch_no_open_side(open_faces):
    grid = unit_grid((24, 18, 34), open_faces)
    obstacles = Obstacles(grid, moving=True)
    regions = ClosedRegions(obstacles)
    random = np.random.default_rng(7)
    counts = []
    # Three quarters of solid leave dozens of pockets, a third one large winding region.
    for share in (0.75, 0.33, 0.6, 0.0):
        distance = (random.random([n + 1 for n in grid.cells]) - share).astype(np.float32)
        for _ in range(3):  # until nothing changes any more
            mark(obstacles, distance, (0.0, 0.0, 0.0))
            obstacles.commit()
        regions.find()
        areas = [grid.trim(a.to_numpy(), grid.face_shape(n)) > 0.0 for n, a in enumerate(obstacles.solids.area)]
        labels, _ = labels_through(areas, obstacles.is_air())
        outside = {0}
        for axis in range(3):
            for side in (0, 1):
                if grid.is_open(axis, side):
                    at_side = np.take(labels, -side, axis=axis)
                    outside |= set(np.unique(at_side[np.take(areas[axis], -side, axis=axis)]))
        expected = [label for label in np.unique(labels) if label not in outside]
        assert regions.count == len(expected)
        counts.append(regions.count)
        if regions.count == 0:
            continue
        numbers = grid.trim(regions.number.to_numpy(), grid.cells)
        for label in expected:
            (number,) = np.unique(numbers[labels == label])
            assert (numbers == number).sum() == (labels == label).sum()
        assert (numbers == -1).sum() == np.isin(labels, list(outside)).sum()
    assert counts[0] > 50
    assert counts[-1] == (1 if not open_faces else 0)


def test_a_checkpoint_without_the_obstacles_is_refused(box):
    state = box.checkpoint()
    del state["obstacles"]
    with pytest.raises(ValueError, match=r"obstacles must have shape \(18, 10, 10\), got nothing"):
        box.restore(state)
