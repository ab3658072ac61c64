"""Threads of rectangles are solved from end to end, on a CPU eight side by side: as by whole matrices in float64."""

import numpy as np
import pytest
from cloth_scenes import advance, cloth, rectangle, solver_of
from thread_reference import threads_in_float64

from sim.cloth.solver import ClothSolver

pytestmark = pytest.mark.usefixtures("taichi_cpu")


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
def test_springs_move_nodes_to_the_same_places(counts, iterations, poisson_ratio):
    """Springs are stretched by a fifth and more here, so that tension across the threads is solved for, too."""
    spacing = 0.01
    sheet = rectangle(((counts[0] - 1) * spacing, (counts[1] - 1) * 1.5 * spacing), counts)
    keys = {"iterations": iterations, "poisson_ratio": poisson_ratio, "bend_stiffness": 1e-4, "bend_damping": 0.01}
    solver, expected = (solver_of(cloth(shape=sheet, **keys)) for _ in range(2))
    for each in (solver, expected):
        crumple(each, slice(counts[0] // 2), spacing=spacing)
        each.air.predict(each.gravity, each.stable_dt())
    before = expected.state.displacement.to_numpy()
    solver._integrator.displace(solver.stable_dt(), np.array([iterations]))
    with threads_in_float64():
        expected._integrator.displace(expected.stable_dt(), np.array([iterations]))
    moved = np.abs(expected.state.displacement.to_numpy() - before).max()
    difference = np.abs(solver.state.displacement.to_numpy() - expected.state.displacement.to_numpy()).max()
    assert moved > 0.1 * spacing
    # The order of the springs is the same: what differs is rounding, which stiff pieces of thread enlarge.
    assert difference < 1e-3 * moved


def test_tension_is_straightened():
    """A strip pulled to twice its length with a wave across it: threads of a fixed direction would overshoot."""
    solver, expected = (solver_of(cloth(shape=rectangle((0.7, 0.1), (90, 12)))) for _ in range(2))
    for each in (solver, expected):
        positions = each.state.positions() * (2.0, 2.0, 1.0)
        positions[:, 2] += 0.002 * np.sin(np.arange(len(positions)) % 90)
        each.state.set_positions(positions)
        each.air.predict(each.gravity, each.stable_dt())
    solver._integrator.displace(solver.stable_dt(), np.array([1]))
    with threads_in_float64():
        expected._integrator.displace(expected.stable_dt(), np.array([1]))
    assert expected._integrator._threads[0]._work.is_taut.to_numpy().any()
    moved = expected.state.displacement.to_numpy()
    difference = np.abs(solver.state.displacement.to_numpy() - moved).max()
    assert difference < 1e-3 * np.abs(moved).max()


def test_several_cloths_of_both_kinds_fall_alike(tmp_path):
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
    solver, expected = solver_of(*cloths), solver_of(*cloths)
    starts = solver.state.positions()
    advance(solver, 0.1)
    with threads_in_float64():
        advance(expected, 0.1)
    fallen = np.abs(expected.state.positions() - starts).max()
    assert fallen > 0.03
    assert np.abs(solver.state.positions() - expected.state.positions()).max() < 1e-4 * fallen
