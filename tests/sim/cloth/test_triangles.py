"""Triangles of meshes at the default steps: they pull, swing and keep momentum as their energy says."""

import numpy as np
import pytest
import trimesh
from cloth_scenes import (
    EARTH,
    FRAMES_PER_SECOND,
    GRAVITY,
    UNDAMPED,
    VACUUM,
    WEIGHTLESS,
    advance,
    cloth,
    energy,
    irregular_square,
    solver_of,
    spring_energy,
)
from thread_counts import result_on_any_threads

from sim.cloth.sheet import sheet_of_triangles
from sim.cloth.springs import Cells, cells_of
from validation.sheet_energy import cell_energies

pytestmark = pytest.mark.usefixtures("taichi_cpu")


def mesh(folder, size, spacing: float) -> dict:
    path = folder / "mesh.stl"
    trimesh.Trimesh(*irregular_square(size, spacing), process=False).export(path)
    return {"type": "mesh", "file": str(path), "up": "z"}


def end_at(x: float) -> dict:
    return {"type": "box", "min": (x - 1e-4, -1.0, -1.0), "max": (x + 1e-4, 1.0, 1.0)}


@pytest.mark.parametrize("damping", [0.0, 2e-3])
def test_a_strip_of_cotton_pulls_with_its_stiffness(damping, tmp_path):
    """E w times a strain of 1 % within 1 %: what its energy rises by as one end is led on."""
    pins = [
        {"region": end_at(0.1 * side), "keyframe": [{"time_s": 0.0}, {"time_s": 0.1, "offset": (1e-3 * side, 0, 0)}]}
        for side in (-1, 1)
    ]
    keys = {"pin": pins, "self_collision": False, "damping": damping, **VACUUM}
    solver = solver_of(cloth(shape=mesh(tmp_path, (0.2, 0.05), 0.0125), **keys), gravity=WEIGHTLESS)
    advance(solver, 0.2)
    x, end = solver.state.positions(), solver.state.host.position[:, 0] > 0.1 - 1e-4
    energies = []
    for way in (-1e-6, 1e-6):
        solver.state.set_positions(x + way * end[:, None] * (1.0, 0.0, 0.0))
        energies.append(spring_energy(solver))
    assert (energies[1] - energies[0]) / 2e-6 == pytest.approx(4000.0 * 0.05 * 0.01, rel=0.01)


@pytest.mark.parametrize("edges", [12, 24, 36, 48])
def test_an_undamped_mesh_that_swings_on_two_corners_keeps_95_percent_of_its_energy(edges, tmp_path):
    """Of m g L / 2, in a second, on edges of 2 to 8 cm; by implicit Euler alone those of 4 cm lose 7 %."""
    corners = [{"region": {"type": "sphere", "position": (-0.5, y, 0.0), "radius": 1e-3}} for y in (-0.5, 0.5)]
    keys = {"pin": corners, "self_collision": False, **VACUUM, **UNDAMPED}
    solver = solver_of(cloth(shape=mesh(tmp_path, 1.0, 1.0 / edges), **keys))
    scale = solver.diagnostics()["mass"] * GRAVITY * 0.5
    gained = []
    for frame in range(60):
        solver.begin_frame(frame / FRAMES_PER_SECOND)
        advance(solver, 1.0 / FRAMES_PER_SECOND)
        gained.append(energy(solver) / scale)
    assert max(gained) < 0.03
    assert gained[-1] > -0.05
    assert solver.diagnostics()["max_strain"] < 0.1


def thrown(folder, *, pin=()):
    """Two sheets in one mesh, each with random speeds, and another held by a node until it is let go."""
    first = trimesh.Trimesh(*irregular_square(0.2, 0.02), process=False)
    second = first.copy()
    second.apply_translation((0.5, 0.0, 0.0))
    path = folder / "two.stl"
    trimesh.util.concatenate([first, second]).export(path)
    shape = {"type": "mesh", "file": str(path), "up": "z"}
    keys = {"self_collision": False, **VACUUM}
    solver = solver_of(
        cloth("two", shape=shape, **keys),
        cloth("held", shape=mesh(folder, 0.1, 0.02), position=(0, 0, 0.5), pin=pin, **keys),
        gravity=EARTH if pin else WEIGHTLESS,
    )
    speed = 0.5 * np.random.default_rng(1).standard_normal((solver.state.vertex_count, 3))
    solver.state.velocity.from_numpy(speed.astype(np.float32))
    return solver


def test_each_piece_of_a_mesh_keeps_its_momentum(tmp_path):
    """To rounding, however far the iteration got."""
    solver = thrown(tmp_path)
    mass, before = solver.state.mass.to_numpy().astype(np.float64)[:, None], solver.state.velocity.to_numpy()
    advance(solver, 0.1)
    after, x = solver.state.velocity.to_numpy(), solver.state.host.position
    for is_left in (True, False):
        piece = (x[:, 2] < 0.25) & ((x[:, 0] < 0.0) == is_left)
        lost = (mass * (after.astype(np.float64) - before))[piece].sum(axis=0)
        assert np.abs(lost).max() < 1e-6 * (mass * np.abs(before))[piece].sum()


def test_a_continued_run_equals_the_uninterrupted_one_bit_for_bit(tmp_path):
    """Also where a pin lets go."""
    pin = [{"index": [0, 5], "release_s": 0.06}]
    whole, first, second = (thrown(tmp_path, pin=pin) for _ in range(3))
    for solver in (whole, first):
        advance(solver, 0.05)
    second.restore(first.checkpoint())
    for solver in (whole, second):
        for frame in (3, 4):
            solver.begin_frame(frame / FRAMES_PER_SECOND)
            advance(solver, 1.0 / FRAMES_PER_SECOND)
    for name, array in whole.checkpoint().items():
        np.testing.assert_array_equal(second.checkpoint()[name], array, err_msg=name)


def places(path: str) -> list[float]:
    """Where some nodes of a mesh get."""
    solver = solver_of(cloth(shape={"type": "mesh", "file": path, "up": "z"}, pin=[{"index": [0, 1]}]))
    advance(solver, 0.02)
    found: list[float] = solver.state.positions()[::50].ravel().tolist()
    return found


def test_meshes_do_not_depend_on_the_number_of_threads(tmp_path):
    result_on_any_threads(places, mesh(tmp_path, 0.4, 0.01)["file"])


def test_nodes_take_the_mean_strain_across_a_line_where_warp_and_weft_change_places():
    """The same energy as with the same warp everywhere."""
    vertices, triangles = irregular_square(0.2, 0.04)
    sheet = sheet_of_triangles(vertices, triangles, label="sheet")
    same, law = cells_of(sheet), cells_of(sheet).law(cloth())
    is_turned = vertices[triangles].mean(axis=1)[:, 0] > 0.0
    sheet.warp[is_turned] = (0.0, 1.0, 0.0)
    turned = cells_of(sheet)
    assert isinstance(turned, Cells)
    assert turned.swapped.any()
    x = vertices * (1.01, 0.997, 1.0)
    assert cell_energies(turned, x, law).sum() == pytest.approx(cell_energies(same, x, law).sum(), rel=1e-9)
