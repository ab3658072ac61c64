"""Rectangles on a CPU are solved eight lines at a time: the same springs and the same air as in lists."""

import numpy as np
import pytest
import thread_reference
from cloth_scenes import advance, cloth, rectangle, solver_of

from sim.cloth import threads
from sim.cloth.parameters import ClothParameters
from sim.cloth.solver import ClothSolver

pytestmark = pytest.mark.usefixtures("only_on_a_cpu")


@pytest.fixture
def only_on_a_cpu(taichi_cpu):
    if taichi_cpu != "cpu":
        pytest.skip("a GPU solves rectangles by lists")


def by_lists(monkeypatch, *cloths: ClothParameters) -> ClothSolver:
    """A solver that takes rectangles for meshes, as on a GPU, with threads in float64."""
    for solve in (thread_reference.solve_threads, thread_reference.straighten_threads):
        monkeypatch.setattr(threads, solve.__name__, solve)
    with monkeypatch.context() as patch:
        for module in ("sim.cloth.solver", "sim.cloth.xpbd"):
            patch.setattr(f"{module}.rectangles_in_rows", lambda _host: {})
        return solver_of(*cloths)


def crumple(solver: ClothSolver, pinned: slice, *, spacing: float) -> None:
    """Nodes off their places by a fifth of their spacing, in all directions, with velocities alike; some are held."""
    random = np.random.default_rng(1)
    count = solver.state.vertex_count
    solver.state.set_positions(solver.state.positions() + 0.2 * spacing * random.standard_normal((count, 3)))
    solver.state.velocity.from_numpy(random.standard_normal((count, 3)).astype(np.float32))
    is_pinned = np.zeros(count, dtype=bool)
    is_pinned[pinned] = True
    solver.state.set_pinned(is_pinned)


COUNTS = [(2, 2), (3, 2), (2, 11), (8, 8), (17, 9), (20, 140), (197, 5)]
"""One cell, no bend springs along a side, whole blocks, and several pieces of thread along either side."""


@pytest.mark.parametrize("counts", COUNTS)
@pytest.mark.parametrize(("iterations", "poisson_ratio"), [(1, 0.0), (3, 0.5)])
def test_rows_and_lists_move_nodes_to_the_same_places(counts, iterations, poisson_ratio, monkeypatch):
    """Springs are stretched by a fifth and more here, so that tension across the threads is solved for, too."""
    spacing = 0.01
    sheet = rectangle(((counts[0] - 1) * spacing, (counts[1] - 1) * 1.5 * spacing), counts)
    keys = {"iterations": iterations, "poisson_ratio": poisson_ratio, "bend_stiffness": 1e-4, "bend_damping": 0.01}
    parameters = cloth(shape=sheet, **keys)
    rows, lists = solver_of(parameters), by_lists(monkeypatch, parameters)
    for solver in (rows, lists):
        crumple(solver, slice(counts[0] // 2), spacing=spacing)
        solver.air.predict(solver.gravity, solver.stable_dt())
    np.testing.assert_allclose(rows.state.velocity.to_numpy(), lists.state.velocity.to_numpy(), rtol=0.0, atol=1e-5)
    before = lists.state.displacement.to_numpy()
    np.testing.assert_allclose(rows.state.displacement.to_numpy(), before, rtol=0.0, atol=1e-8)
    for solver in (rows, lists):
        solver._integrator.displace(solver.stable_dt(), np.full(len(solver.parameters), iterations))
    moved = np.abs(lists.state.displacement.to_numpy() - before).max()
    difference = np.abs(rows.state.displacement.to_numpy() - lists.state.displacement.to_numpy()).max()
    assert moved > 0.1 * spacing
    # The order of the springs is the same: what differs is rounding, which stiff pieces of thread enlarge.
    assert difference < 1e-3 * moved


def test_tension_is_straightened_in_rows_as_in_lists(monkeypatch):
    """A strip pulled to twice its length with a wave across it: threads of a fixed direction would overshoot."""
    parameters = cloth(shape=rectangle((0.7, 0.1), (90, 12)))
    rows, lists = solver_of(parameters), by_lists(monkeypatch, parameters)
    for solver in (rows, lists):
        positions = solver.state.positions() * (2.0, 2.0, 1.0)
        positions[:, 2] += 0.002 * np.sin(np.arange(len(positions)) % 90)
        solver.state.set_positions(positions)
        solver.air.predict(solver.gravity, solver.stable_dt())
        solver._integrator.displace(solver.stable_dt(), np.ones(len(solver.parameters), dtype=int))
    assert lists._integrator._threads[0]._pieces.is_taut.to_numpy().any()
    moved = lists.state.displacement.to_numpy()
    difference = np.abs(rows.state.displacement.to_numpy() - moved).max()
    assert difference < 1e-3 * np.abs(moved).max()


def test_several_cloths_of_both_kinds_fall_alike(monkeypatch, tmp_path):
    """Two rectangles with a mesh between them, one of them in wind: no cloth gets what is another's."""
    path = tmp_path / "sheet.obj"
    vertices = [(0.1 * i, 0.1 * j, 0.0) for j in range(4) for i in range(4)]
    faces = [(4 * j + i, 4 * j + i + 1, 4 * j + i + 5, 4 * j + i + 4) for j in range(3) for i in range(3)]
    lines = [f"v {x} {y} {z}" for x, y, z in vertices]
    lines += [f"f {a + 1} {b + 1} {c + 1}\nf {a + 1} {c + 1} {d + 1}" for a, b, c, d in faces]
    path.write_text("\n".join(lines))
    cloths = (
        cloth("first", shape=rectangle((0.2, 0.3), (9, 14)), wind=(3.0, 1.0, 0.0)),
        cloth("mesh", shape={"type": "mesh", "file": str(path), "up": "z"}, position=(1.0, 0.0, 0.0)),
        cloth("last", shape=rectangle((0.3, 0.2), (21, 6)), position=(0.0, 1.0, 0.0), stretch_stiffness=50.0),
    )
    rows, lists = solver_of(*cloths), by_lists(monkeypatch, *cloths)
    starts = rows.state.positions()
    for solver in (rows, lists):
        advance(solver, 0.1)
    fallen = np.abs(lists.state.positions() - starts).max()
    assert fallen > 0.03
    assert np.abs(rows.state.positions() - lists.state.positions()).max() < 1e-4 * fallen
