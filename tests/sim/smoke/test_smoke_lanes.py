"""The loops of a GPU, compiled for whatever device the tests run on: many threads to a row, and a deeper tree."""

import numpy as np
import pytest
import taichi as ti
from smoke_scenes import CLOSED_BOX, mark

from sim.core import scheduling
from sim.core.domain import DomainParameters
from sim.shapes import build_solid
from sim.shapes.parameters import Placement
from sim.smoke import lanes
from sim.smoke.lanes import has_runs, lane_count, lane_items, lane_place
from sim.smoke.parameters import SmokeParameters
from sim.smoke.reductions import Pair, RowReductions
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


@ti.data_oriented
class Rows:
    """Counts how often each place of its rows is visited, and reduces numbers over them."""

    def __init__(self, rows_x: int, rows_y: int, length: int) -> None:
        self.shape = (rows_x, rows_y, length)
        self.lanes = lane_count()
        self.visits = ti.field(ti.i32, shape=(rows_x, rows_y, length + 1))
        self.numbers = ti.field(ti.f32, shape=(rows_x, rows_y, length + 1))
        self.rows = RowReductions(rows_x, rows_y)

    @ti.kernel
    def visit(self):
        for i, j, lane in ti.ndrange((1, self.shape[0] + 1), (1, self.shape[1] + 1), self.lanes):
            for n in range(lane_items(self.shape[2], lane)):
                self.visits[i - 1, j - 1, lane_place(n, lane)] += 1

    @ti.kernel
    def sums(self) -> Pair:
        self.leave_partials(False)
        self.rows.sum_up()
        return self.rows.result[None]

    @ti.kernel
    def maxima(self) -> Pair:
        self.leave_partials(True)
        self.rows.find_maxima()
        return self.rows.result[None]

    @ti.func
    def leave_partials(self, of_maxima: ti.template()):
        for i, j, lane in ti.ndrange((1, self.shape[0] + 1), (1, self.shape[1] + 1), self.lanes):
            pair = ti.Vector([0.0, 0.0])
            for n in range(lane_items(self.shape[2], lane)):
                number = self.numbers[i - 1, j - 1, lane_place(n, lane)]
                if ti.static(of_maxima):
                    pair = ti.max(pair, ti.Vector([number, 2.0 * number]))
                else:
                    pair += ti.Vector([number, 2.0 * number])
            self.rows.partial[self.rows.place(i, j, lane)] = pair


@pytest.mark.parametrize("shape", [(1, 1, 1), (2, 3, 32), (2, 1, 97)])
def test_the_lanes_of_a_row_visit_each_of_its_places_once(on_gpu, shape):
    rows = Rows(*shape)
    assert rows.lanes == (32 if on_gpu else 1)
    rows.visit()
    visits = rows.visits.to_numpy()
    assert (visits[..., 1:] == 1).all()
    assert not visits[..., 0].any()


@pytest.mark.parametrize("shape", [(3, 2, 5), (41, 37, 50)])
def test_sums_and_maxima_take_in_every_row(on_gpu, shape):
    rows = Rows(*shape)
    numbers = np.random.default_rng(2).integers(1, 64, (*shape[:2], shape[2] + 1)).astype(np.float32)
    # Beyond every number of the rows: what stands at place 0 must not count.
    numbers[..., 0] = 1000.0
    rows.numbers.from_numpy(numbers)
    # Sums of integers below 2^24 are exact in single precision.
    assert list(rows.sums()) == [numbers[..., 1:].sum(), 2.0 * numbers[..., 1:].sum()]
    assert list(rows.maxima()) == [numbers[..., 1:].max(), 2.0 * numbers[..., 1:].max()]


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
        centres = solver.grid.cell_centres().reshape(*solver.grid.cells, 3)
        for step in range(5):
            if moves:
                # Two thirds of a cell a step.
                away = np.linalg.norm(centres - (-0.3 + step / 27, 0.0, 0.25), axis=-1)
                mark(solver.obstacles, away < 0.15, (60 / 27, 0.0, 0.0))
            solver.substep(1 / 60)
        assert solver.diagnostics()["not_converged"] == 0.0
        states.append(solver.checkpoint())
    one, many = states
    for name, array in one.items():
        # The same arithmetic, but for the order of the sums in the projection. Measured: 2e-7.
        difference = np.abs(many[name].astype(np.float64) - array.astype(np.float64)).max()
        assert difference <= 5.0e-6 * np.abs(array).max(), name


def test_a_grid_has_runs_by_its_size_and_never_on_a_gpu(monkeypatch):
    choose_lanes(monkeypatch, on_gpu=False)
    assert has_runs((48, 48, 48))
    assert not has_runs((48, 48, 47))
    choose_lanes(monkeypatch, on_gpu=True)
    assert not has_runs((512, 512, 512))


@pytest.mark.slow
@pytest.mark.parametrize("open_faces", [("x-", "x+", "z+"), CLOSED_BOX], ids=["open", "closed"])
def test_a_plume_is_the_same_in_runs_of_cells_and_one_by_one(monkeypatch, open_faces):
    # 37 cells: two runs of 16 and five cells, on the next level one and two, and an odd end without a second child.
    tall = DomainParameters(min=(-0.25, -0.25, 0.0), max=(0.25, 0.25, 37 / 18))
    states = []
    # Every loop by all threads and nothing in runs; runs, and all of the V-cycle or its coarse levels by one thread.
    for longest_ns, least_cells in ((0.0, 1_000_000), (1.0e9, 0), (2.0e3, 0)):
        monkeypatch.setattr(scheduling, "LONGEST_NS", longest_ns)
        monkeypatch.setattr(lanes, "LEAST_CELLS_IN_RUNS", least_cells)
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
    one_by_one, *others = states
    for state in others:
        for name, array in one_by_one.items():
            # The same arithmetic, but for products that are contracted otherwise.
            difference = np.abs(state[name].astype(np.float64) - array.astype(np.float64)).max()
            assert difference <= 5.0e-6 * np.abs(array).max(), name
