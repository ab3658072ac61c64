"""The loops of a GPU, compiled for whatever device the tests run on: many threads to a row, and a deeper tree."""

import math

import numpy as np
import pytest
import taichi as ti
from smoke_scenes import CLOSED_BOX, mark

from sim.core.arrays import Floats, Integers
from sim.core.domain import DomainParameters
from sim.core.launch import kernel
from sim.shapes.parameters import Placement
from sim.shapes.placement import build_solid
from sim.smoke import multigrid
from sim.smoke.arrays import new_faces, new_floats
from sim.smoke.lanes import Grid, clear_ghosts, device_grid, lane_items, lane_place, row_start
from sim.smoke.parameters import SmokeParameters
from sim.smoke.reductions import Pair, Rows, find_maxima, new_rows, partial_place, sum_up
from sim.smoke.solver import SmokeSolver

pytestmark = pytest.mark.usefixtures("taichi_cpu")

DOMAIN = DomainParameters(min=(-0.5, -0.5, 0.0), max=(0.5, 0.5, 1.0))


@pytest.fixture(params=[False, True], ids=["a thread a row", "many threads a row"])
def on_gpu(request, monkeypatch) -> bool:
    choose_lanes(monkeypatch, on_gpu=request.param)
    return request.param


def choose_lanes(monkeypatch, *, on_gpu: bool) -> None:
    for module in ("sim.core.reductions", "sim.core.scheduling", "sim.smoke.lanes"):
        monkeypatch.setattr(f"{module}.runs_on_gpu", lambda: on_gpu)


@kernel
def visit(box: Grid, visits: Integers):
    """Count how often each place is visited."""
    for i, j, lane in ti.ndrange((1, box.nx + 1), (1, box.ny + 1), box.lanes):
        for n in range(lane_items(box, box.nz, lane)):
            visits[row_start(box, i, j) + lane_place(box, n, lane)] += 1


@kernel
def reduce(box: Grid, numbers: Floats, rows: Rows, of_maxima: ti.template()) -> Pair:
    for i, j, lane in ti.ndrange((1, box.nx + 1), (1, box.ny + 1), box.lanes):
        pair = ti.Vector([0.0, 0.0])
        for n in range(lane_items(box, box.nz, lane)):
            number = numbers[row_start(box, i, j) + lane_place(box, n, lane)]
            if ti.static(of_maxima):
                pair = ti.max(pair, ti.Vector([number, 2.0 * number]))
            else:
                pair += ti.Vector([number, 2.0 * number])
        rows.partial[partial_place(box, i, j, lane)] = pair
    if ti.static(of_maxima):
        find_maxima(rows)
    else:
        sum_up(rows)
    return rows.nodes[0]


@pytest.mark.parametrize("shape", [(1, 1, 1), (2, 3, 32), (2, 1, 97)])
def test_the_lanes_of_a_row_visit_each_of_its_places_once(on_gpu, shape):
    box = device_grid(shape)
    assert box.lanes == (32 if on_gpu else 1)
    padded = tuple(n + 2 for n in shape)
    visits = ti.ndarray(ti.i32, math.prod(padded))
    visit(box, visits)
    expected = np.zeros(padded, np.int32)
    expected[1:-1, 1:-1, 1:-1] = 1
    assert np.array_equal(visits.to_numpy().reshape(padded), expected)


@pytest.mark.parametrize("shape", [(3, 2, 5), (41, 37, 50)])
def test_sums_and_maxima_take_in_every_row(on_gpu, shape):
    box = device_grid(shape)
    # Ghosts hold more than every number of the rows: they must not count.
    values = np.full([n + 2 for n in shape], 1000.0, np.float32)
    inner = values[1:-1, 1:-1, 1:-1]
    inner[:] = np.random.default_rng(2).integers(1, 64, shape)
    numbers, rows = new_floats(values.size), new_rows(box)
    numbers.from_numpy(values.ravel())
    # Sums of integers below 2^24 are exact in single precision.
    assert list(reduce(box, numbers, rows, False)) == [inner.sum(), 2.0 * inner.sum()]
    assert list(reduce(box, numbers, rows, True)) == [inner.max(), 2.0 * inner.max()]


GUSTS = {"strength": 3.0, "size": 0.2, "rate": 5.0, "seed": 3}


@pytest.mark.parametrize(
    ("changes", "moves"),
    [
        ({"open_faces": CLOSED_BOX, "turbulence": GUSTS}, False),
        ({"wind": (0.6, 0.0, 0.0), "turbulence": GUSTS}, True),
    ],
    # Every kernel of an open box of still air, with a ball in it that stands, is in one of these two.
    ids=["closed box with gusts", "open box with wind, gusts and a ball that moves"],
)
def test_a_plume_is_the_same_with_one_thread_a_row_and_with_many(monkeypatch, changes, moves):
    states = []
    for on_gpu in (False, True):
        choose_lanes(monkeypatch, on_gpu=on_gpu)
        parameters = SmokeParameters.model_validate(
            {
                "name": "plume",
                "cell_size": 1 / 18,
                "source": [{"shape": {"type": "sphere", "radius": 0.12}, "position": (0.0, 0.0, 0.2)}],
                **changes,
            }
        )
        ball = build_solid(Placement(shape={"type": "sphere", "radius": 0.15}, position=(0.0, 0.0, 0.6)))
        solver = SmokeSolver(
            parameters,
            domain=DOMAIN,
            gravity=(0.0, 0.0, -9.81),
            solids=[] if moves else [ball],
            moving=moves,
        )
        axes = (low + np.arange(n + 1) / 18 for low, n in zip(solver.grid.origin, solver.grid.cells, strict=True))
        corners = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        for step in range(5):
            if moves:
                # Two thirds of a cell a step.
                away = np.linalg.norm(corners - (-0.3 + step / 27, 0.0, 0.25), axis=-1)
                mark(solver.obstacles, (away - 0.15) * 18, (60 / 27, 0.0, 0.0))
            solver.substep(1 / 60)
        assert solver.diagnostics()["not_converged"] == 0.0
        states.append(solver.checkpoint())
    one, many = states
    for name, array in one.items():
        # The same arithmetic, but for the order of the sums in the projection. Measured: 2e-7.
        difference = np.abs(many[name].astype(np.float64) - array.astype(np.float64)).max()
        assert difference <= 5.0e-6 * np.abs(array).max(), name


@pytest.mark.slow
@pytest.mark.parametrize("open_faces", [("x-", "x+", "z+"), CLOSED_BOX], ids=["open", "closed"])
def test_a_plume_is_the_same_whatever_takes_the_levels_of_a_cycle(monkeypatch, open_faces):
    # 37 cells: two runs of 16 and five cells, on the next level one and two, and an odd end without a second child.
    tall = DomainParameters(min=(-0.25, -0.25, 0.0), max=(0.25, 0.25, 37 / 18))
    states = []
    # Many threads to a row, as on a GPU; every loop by all threads, all of the V-cycle or its coarse levels by one.
    for on_gpu, few_cells in ((True, 0), (False, 0), (False, 10**6), (False, 800)):
        choose_lanes(monkeypatch, on_gpu=on_gpu)
        monkeypatch.setattr(multigrid, "FEW_CELLS", few_cells)
        parameters = SmokeParameters.model_validate(
            {
                "name": "plume",
                "cell_size": 1 / 18,
                "source": [{"shape": {"type": "sphere", "radius": 0.12}, "position": (0.0, 0.0, 0.2)}],
                "open_faces": open_faces,
            }
        )
        ball = build_solid(Placement(shape={"type": "sphere", "radius": 0.15}, position=(0.0, 0.0, 0.6)))
        solver = SmokeSolver(parameters, domain=tall, gravity=(0.0, 0.0, -9.81), solids=[ball])
        assert solver.grid.cells == (9, 9, 37)
        for _ in range(5):
            solver.substep(1 / 60)
        assert solver.diagnostics()["not_converged"] == 0.0
        states.append(solver.checkpoint())
    many, *others = states
    for state in others:
        for name, array in many.items():
            # The same arithmetic, but for products that are contracted otherwise.
            difference = np.abs(state[name].astype(np.float64) - array.astype(np.float64)).max()
            assert difference <= 5.0e-6 * np.abs(array).max(), name


def test_ghosts_are_cleared_and_cells_are_not(on_gpu):
    box, arrays = device_grid((5, 3, 40)), new_faces(7 * 5 * 42)
    for array in arrays:
        array.fill(1.0)
    clear_ghosts(box, arrays)
    for array in arrays:
        values = array.to_numpy().reshape(7, 5, 42)
        assert (values[1:-1, 1:-1, 1:-1] == 1.0).all()
        assert values.sum() == 5 * 3 * 40
