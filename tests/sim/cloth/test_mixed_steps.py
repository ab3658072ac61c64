"""Cloths of a scene that ask for different substeps and iterations."""

import numpy as np
import pytest
import trimesh
from cloth_scenes import FRAMES_PER_SECOND, SOFT, VACUUM, cloth, irregular_square, rectangle, solver_of
from contact_scenes import cloth_of, world_of

from sim.cloth.parameters import DEFAULT_SUBSTEPS
from sim.cloth.solver import ClothSolver

pytestmark = pytest.mark.usefixtures("taichi_cpu")

HUNG = {"rotation_deg": (90.0, 0.0, 0.0), "pin": [{"index": (0,)}], **VACUUM}


@pytest.fixture(scope="module")
def mesh(tmp_path_factory):
    path = tmp_path_factory.mktemp("sheets") / "square.ply"
    trimesh.Trimesh(*irregular_square(0.3, 0.06), process=False).export(path)
    return {"type": "mesh", "file": str(path)}


def frame_of(solver: ClothSolver) -> int:
    """Substeps of one more frame."""
    steps, left = 0, 1.0 / FRAMES_PER_SECOND
    while left > 1.0e-9:
        dt = min(solver.stable_dt(), left)
        solver.substep(dt)
        steps, left = steps + 1, left - dt
    return steps


def test_each_cloth_sweeps_as_often_as_alone(mesh):
    """Rectangles and meshes: to the bit, at the same place in the same reach."""
    shapes = (rectangle((0.3, 0.3), (9, 9)), mesh)
    cloths = [
        cloth(f"of{number}_{iterations}", shape=shape, iterations=iterations, substeps=DEFAULT_SUBSTEPS, **HUNG)
        for number, shape in enumerate(shapes)
        for iterations in (1, 6, None)
    ]
    together, positions = solver_of(*cloths), []
    for solver in (together, *(solver_of(each) for each in cloths)):
        for _ in range(4):
            assert frame_of(solver) == DEFAULT_SUBSTEPS
        positions.append(solver.state.positions())
    np.testing.assert_array_equal(positions[0], np.concatenate(positions[1:]))
    assert not np.array_equal(positions[1], positions[2])
    np.testing.assert_array_equal(positions[1], positions[3])


def test_sweeps_adapt_only_to_cloths_that_omit_them():
    hung = {**HUNG, "shape": rectangle((1.0, 1.0), (32, 32)), "pin": [{"corner": "x-y+"}]}
    given, omits = cloth("given", iterations=1, substeps=4, **hung), cloth("omits", **hung)
    both = cloth("both", iterations=2, substeps=4, **hung)
    heavy = (0.0, 0.0, -60.0)
    alone, beside, asked = (solver_of(*cloths, gravity=heavy) for cloths in ((omits,), (given, omits), (given, both)))
    for solver in (alone, beside, asked):
        for _ in range(6):
            frame_of(solver)
    assert beside._sweeps == alone._sweeps > 1
    np.testing.assert_array_equal(beside.state.positions()[1024:], alone.state.positions())
    assert asked.stable_dt() == 1.0 / (4 * FRAMES_PER_SECOND)
    assert asked._sweeps == 1
    assert asked.diagnostics()["overlong_springs"] > 0.0


@pytest.mark.parametrize(("keys", "steps"), [((40, 10), 40), ((10, None), DEFAULT_SUBSTEPS), ((None, 40), 40)])
def test_cloths_take_the_steps_of_the_one_with_the_most(keys, steps):
    sheets = [{"substeps": each} | ({"position": (0.0, 0.0, 0.5 + 0.2 * k)}) for k, each in enumerate(keys)]
    world = world_of(*sheets)
    assert world.advance_frame().substeps["cloth"] == steps
    cloth_of(world).take_substeps(7)
    assert world.advance_frame().substeps["cloth"] == 7


def test_steps_are_shortened_for_cloth_that_omits_them_beside_one_that_asks_for_some():
    def most(*others: dict) -> int:
        cone = {"shape": {"type": "cone", "radius": 0.1, "height": 0.3}, "position": (0.0, 0.0, 0.15)}
        sheet = {"shape": rectangle((0.6, 0.6), (31, 31)), "position": (0.0, 0.0, 0.31), "iterations": 1}
        world = world_of(sheet, *others, bodies=[cone])
        return max(world.advance_frame().substeps["cloth"] for _ in range(14))

    assert 25 < most({"position": (0.0, 0.0, 1.5), "substeps": 25}) <= 1.5 * most()


def test_explicit_springs_take_steps_that_each_cloth_bears():
    keys = {**SOFT, "integrator": "explicit"}
    soft, stiff = cloth("soft", **keys), cloth("stiff", **{**keys, "stretch_stiffness": 1.0e4})
    least = solver_of(stiff).stable_dt()
    assert solver_of(soft, stiff).stable_dt() == least < solver_of(soft).stable_dt()
    asked = stiff.model_copy(update={"substeps": 600})
    assert solver_of(soft, asked).stable_dt() == pytest.approx(1.0 / (600 * FRAMES_PER_SECOND))
    assert least < 1.0 / (600 * FRAMES_PER_SECOND)
    with pytest.raises(ValueError, match=r'cloth "stiff": 20 substeps a frame are .* give substeps'):
        solver_of(soft.model_copy(update={"substeps": 10}), stiff.model_copy(update={"substeps": 20}))


def test_a_mixed_scene_continues_from_a_checkpoint_to_the_bit(mesh):
    def scene():
        rows = {"shape": rectangle((0.5, 0.5), (16, 16)), "iterations": 3, "substeps": 12}
        above = {"shape": mesh, "position": (0.0, 0.0, 0.01)}
        pinned = {"shape": rectangle((0.5, 0.5), (8, 8)), "position": (0.0, 0.0, 0.02), "pin": [{"corner": "x-y-"}]}
        return world_of(rows, above, {**pinned, "iterations": 2})

    through, resumed = scene(), scene()
    for _ in range(5):
        through.advance_frame()
    resumed.restore(through.frame, through.checkpoint())
    counts = [[world.advance_frame().substeps["cloth"] for _ in range(5)] for world in (through, resumed)]
    assert counts[0] == counts[1]
    np.testing.assert_array_equal(cloth_of(through).state.positions(), cloth_of(resumed).state.positions())
