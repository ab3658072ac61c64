"""A group of bodies all the way through a job: names, materials, what is told of it, its files and frames."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from checked_jobs import Checked, checked, says

from pipeline import Scene, make_job
from pipeline.base.errors import JobFileError
from pipeline.base.layout import JobLayout
from pipeline.job.input_files import input_files
from pipeline.job.loading import read_job
from pipeline.kinds.checks.shapes import TRIANGLE_BYTES, build_solids
from pipeline.kinds.table import material_of, placements, scene_objects
from pipeline.model.problems import Findings
from pipeline.stages.bodies import BodiesStage
from pipeline.stages.render import RenderStage
from pipeline.store.cache import open_bodies, read_frame, read_numbers, validate_frame
from pipeline.web.live.parameters import parameters_of, set_parameter
from pipeline.web.live.saving import text_with_values

ROOM = 'name = "many"\nframes = 3\ndevice = "cpu"\n[domain]\nmin = [-1, -1, 0]\nmax = [1, 1, 1]\n'
BRICKS = """
[[rigid]]
name = "brick"
kind = "dynamic"
density = 1800.0
shape = { type = "box", size = [0.1, 0.05, 0.04] }
position = [-0.5, 0.0, 0.02]
count = [4, 1, 3]
spacing = [0.1, 0.05, 0.04]
"""
BALL = """
[[rigid]]
name = "ball"
shape = { type = "sphere", radius = 0.05 }
position = [0.5, 0.5, 0.05]
"""
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def job_of(tmp_path: Path, text: str, *overrides: str):
    path = tmp_path / "many.toml"
    path.write_text(text)
    return read_job(path, overrides)


def check(tmp_path: Path, text: str) -> Checked:
    return checked(text, tmp_path / "many.toml")


def refusal(tmp_path: Path, text: str, *overrides: str) -> str:
    with pytest.raises(JobFileError) as error:
        job_of(tmp_path, text, *overrides)
    return "\n".join(error.value.problems)


def test_a_table_of_the_group_counts_less_than_one_of_a_body_and_more_than_a_pattern(tmp_path):
    materials = (
        '[material."b*"]\nlook = "rubber"\n[material.brick]\nlook = "stone"\ncolor = [0.5, 0.2, 0.1]\n'
        "[material.brick_3]\nroughness = 0.9\n"
    )
    job = job_of(tmp_path, ROOM + BRICKS + BALL + materials).job
    assert material_of(job, "ball").look == "rubber"
    assert material_of(job, "brick_1").look == "stone"
    own = material_of(job, "brick_3")
    assert (own.look, own.color, own.roughness) == ("stone", (0.5, 0.2, 0.1), 0.9)
    assert material_of(job, "brick_4").roughness is None


def test_materials_of_groups_are_checked_once_and_those_of_nobody_are_refused(tmp_path):
    told = check(
        tmp_path, ROOM + BRICKS + '[material.brick]\nlook = "stone"\ndensity = 2.0\n[material.brik]\nlook = "wood"\n'
    )
    assert len([line for line in told.warnings if "has no effect" in line]) == 1
    assert any('no body is named "brik"; did you mean "brick"?' in line for line in told.errors)


def test_what_is_wrong_with_many_bodies_is_told_of_three_at_the_line_of_their_table(tmp_path):
    told = check(
        tmp_path,
        ROOM + BALL + BRICKS.replace("[0.1, 0.05, 0.04]\n", "[0.1, 0.05, 0.03]\n", 1).replace("0.02]", "0.005]"),
    )
    lines = [line for line in told.errors if "rigid[1]" in line]
    assert len(lines) == 4
    assert all(line.startswith("many.toml:") for line in lines)
    assert 'rigid bodies "brick_1" and "brick_5"' in told.errors[0] or '"brick_1"' in told.errors[0]
    assert "more like these in the group" in lines[-1]


@pytest.mark.parametrize(
    "asks",
    [
        '[camera]\nfollow = "brick"\n',
        '[camera]\nlook_at = "brick"\n',
        '[camera]\nf_stop = 2.8\nfocus = "brick"\n',
    ],
)
def test_who_wants_one_body_is_told_that_the_name_is_of_a_group(tmp_path, asks):
    assert '"brick" is a group of 12; name one' in refusal(tmp_path, ROOM + BRICKS + asks)
    assert job_of(tmp_path, ROOM + BRICKS + asks.replace('"brick"', '"brick_12"'))


def test_emitters_and_sources_name_one_body_of_a_group(tmp_path):
    emitter = (
        '[[fluid]]\nname = "water"\nparticle_radius = 0.01\n[[fluid.emitter]]\nfollow = "brick"\nspeed = 1.0\n'
        'shape = { type = "disc", radius = 0.03 }\nposition = [0.0, 0.0, 0.2]\ndirection = [0.0, 0.0, 1.0]\n'
    )
    source = (
        '[[smoke]]\nname = "fog"\ncell_size = 0.05\n[[smoke.source]]\nfollow = "brick"\n'
        'shape = { type = "sphere", radius = 0.1 }\n'
    )
    for table in (emitter, source):
        told = check(tmp_path, ROOM + BRICKS + table)
        assert any('"brick" is a group of 12; name one' in line for line in told.errors), told.errors


def test_keys_are_set_for_the_group_and_not_for_one_of_it(tmp_path):
    job = job_of(tmp_path, ROOM + BRICKS, "rigid.brick.friction=0.9", "rigid.brick.count=[2, 1, 2]").job
    assert [body.friction for body in job.rigid] == [0.9] * 4
    assert 'no element "brick_2" in rigid; did you mean "brick"?' in refusal(
        tmp_path, ROOM + BRICKS, "rigid.brick_2.friction=0.9"
    )


def test_a_body_with_the_name_of_one_of_a_group_is_refused(tmp_path):
    told = check(tmp_path, ROOM + BRICKS + BALL.replace('"ball"', '"Brick_2"'))
    assert any('rigid[1].name: "Brick_2" is taken by rigid[0]' in line for line in told.errors), told.errors


CLAY = """
[[soft]]
name = "brick"
material = "clay"
cell_size = 0.05
block = [{ shape = { type = "box", size = [0.2, 0.2, 0.2] }, position = [0.5, -0.5, 0.1] }]
"""
POT = """
[[rigid]]
name = "{}"
kind = "dynamic"
density = 2000.0
shape = {{ type = "box", size = [0.2, 0.2, 0.2] }}
position = [0.0, 0.5, 0.5]
breaks = {{ strength = 1e6, pieces = 3 }}
"""


@pytest.mark.parametrize(
    ("tables", "expected"),
    [
        (BRICKS + CLAY, ['soft[0].name: "brick" is taken by rigid[0]']),
        (BALL.replace('"ball"', '"Brick"') + BRICKS, ['rigid[1].name: ... of "brick", ... taken by rigid[0]']),
        (POT.format("brick") + CLAY, ['soft[0].name: "brick" is taken by rigid[0]']),
        (BRICKS + POT.format("brick_5"), ['rigid[1].name: ... of "brick_5", ... taken by rigid[0]']),
        (POT.format("a") + CLAY.replace("brick", "a_2"), ['soft[0].name: "a_2" is taken by rigid[0]']),
        (BRICKS + POT.format("a"), []),
    ],
)
def test_names_of_groups_and_of_what_breaks_are_taken_too(tmp_path, tables, expected):
    lines = [line for line in check(tmp_path, ROOM + tables).errors if "taken" in line]
    assert len(lines) == len(expected)
    assert all(says(line, f"many.toml ... {text}") for line, text in zip(lines, expected, strict=True)), lines


def test_a_frame_with_a_body_and_a_group_of_one_name_is_refused(tmp_path):
    brick = BALL.replace('"ball"', '"brick"')
    with pytest.raises(ValueError, match='"brick" is a body and a group of others'):
        Scene(job_of(tmp_path, ROOM + BRICKS + brick)).write(tmp_path / "frame.h5")


def test_a_mesh_file_of_a_group_is_one_file_at_its_table(tmp_path):
    (tmp_path / "stone.obj").write_text(TETRAHEDRON)
    stones = (
        '[[rigid]]\nname = "stone"\nkind = "dynamic"\ndensity = 2000.0\ncount = 9\nscales = [0.5, 1.0]\n'
        'shape = { type = "mesh", file = "stone.obj", size = 0.1 }\nposition = [0.0, 0.0, 0.5]\n'
        'scatter = { shape = { type = "box", size = [0.8, 0.8, 0.6] } }\n'
    )
    loaded = job_of(tmp_path, ROOM + BALL + stones)
    assert [file.place for file in input_files(loaded.job)] == [("rigid", 1, "shape", "file")]
    assert {body.shape.file for body in loaded.job.rigid[1:]} == {str(tmp_path / "stone.obj")}
    assert job_of(tmp_path, loaded.text).job == loaded.job
    tasks = BodiesStage().plan(loaded.job, JobLayout(tmp_path))
    assert len(tasks) == 1 + len({body.scale for body in loaded.job.rigid[1:]})


def test_meshes_that_no_memory_holds_are_refused_with_their_number_and_a_group_of_them_is_not(tmp_path):
    (tmp_path / "stone.obj").write_text(TETRAHEDRON)
    stone = (
        '[[rigid]]\nname = "stone{}"\nshape = {{ type = "mesh", file = "stone.obj", size = 0.1 }}\n'
        "position = [0.0, 0.0, {}]\n"
    )
    room = 2.5 * 4 * TRIANGLE_BYTES  # two tetrahedra and a half
    each = "".join(stone.format(number, 0.2 * number) for number in range(1, 5))
    findings = Findings()
    solids = build_solids(placements(job_of(tmp_path, ROOM + each).job), findings, room_bytes=room)
    (problem,) = findings.errors
    assert problem.path == ("rigid", 2, "shape") and len(solids) == 3
    assert "the first 3 meshes have 12 triangles" in problem.message
    group = stone.format("", 0.2) + "count = 4\nspacing = 0.2\n"
    findings = Findings()
    build_solids(placements(job_of(tmp_path, ROOM + group).job), findings, room_bytes=room)
    assert not findings.errors


def test_a_thousand_bodies_are_one_mesh_and_four_arrays(tmp_path):
    scattered = (
        '[[rigid]]\nname = "pea"\nkind = "dynamic"\ndensity = 1000.0\ncount = 1000\nposition = [0.0, 0.0, 0.5]\n'
        'shape = { type = "sphere", radius = 0.02 }\nscatter = { shape = { type = "box", size = [1.9, 1.9, 0.9] } }\n'
    )
    loaded = job_of(tmp_path, ROOM + scattered + BALL)
    layout = JobLayout(tmp_path)
    assert len(BodiesStage().plan(loaded.job, layout)) == 2
    (frame, *_) = RenderStage().plan(loaded.job, layout)
    assert len([each for each in frame.inputs if each.startswith("meshes/")]) == 2
    assert len({drawn.file for drawn in scene_objects(loaded.job, layout)}) == 2
    scene = Scene(loaded)
    scene.write(tmp_path / "frame.h5")
    validate_frame(tmp_path / "frame.h5")
    with h5py.File(tmp_path / "frame.h5") as file:
        assert sorted(file["bodies"]) == ["ball", "pea"]
        assert {key: array.shape for key, array in file["bodies/pea"].items()} == {
            "position": (1000, 3),
            "orientation": (1000, 4),
            "velocity": (1000, 3),
            "angular_velocity": (1000, 3),
        }


def test_what_is_read_of_a_frame_is_what_was_written(tmp_path):
    scene = Scene(job_of(tmp_path, ROOM + BRICKS + BALL))
    scene.step()
    scene.write(tmp_path / "frame.h5")
    written, read = scene.bodies(), read_frame(tmp_path / "frame.h5").bodies
    assert set(written) == set(read) and len(read) == 13
    for name, snapshot in written.items():
        assert read[name].kind == "rigid" and not read[name].attributes
        for key, array in snapshot.arrays.items():
            assert np.array_equal(read[name].arrays[key], array)
    (one,) = read_frame(tmp_path / "frame.h5", "brick_7").bodies.values()
    assert np.array_equal(one.arrays["position"], written["brick_7"].arrays["position"])
    assert read_numbers(tmp_path / "frame.h5").kinds == dict.fromkeys(read, "rigid")
    with open_bodies(tmp_path / "frame.h5") as groups:
        assert set(groups) == set(written) and "brick" not in groups
        assert np.array_equal(groups["brick_2"]["position"][()], written["brick_2"].arrays["position"])


def test_pieces_of_a_group_are_read_by_their_names(tmp_path):
    vases = BRICKS.replace('"brick"', '"vase"').replace("[4, 1, 3]", "2").replace("[0.1, 0.05, 0.04]\n", "0.3\n", 2)
    vases = vases.replace("size = 0.3", "size = [0.1, 0.05, 0.04]") + "breaks = { strength = 1e9, pieces = 3 }\n"
    scene = Scene(job_of(tmp_path, ROOM + vases + BALL))
    scene.step()
    scene.write(tmp_path / "frame.h5")
    written, read = scene.bodies(), read_frame(tmp_path / "frame.h5").bodies
    assert [*read] == ["ball", *(f"vase_{body}_{piece}" for body in (1, 2) for piece in (1, 2, 3))]
    for name, snapshot in written.items():
        assert not read[name].attributes
        assert np.array_equal(read[name].arrays["position"], snapshot.arrays["position"])
    with h5py.File(tmp_path / "frame.h5") as file:
        assert sorted(file["bodies"]) == ["ball", "vase"]


def test_the_library_takes_the_name_of_a_group(tmp_path):
    scene = Scene(job_of(tmp_path, ROOM + BRICKS.replace("0.02]", "0.3]") + BALL))
    assert scene.view("brick")["position"].shape == (12, 3)
    scene.add_force("brick", (1.0, 0.0, 0.0))
    scene.step()
    velocities = scene.view("brick")["velocity"]
    assert velocities[:, 0] == pytest.approx([1.0 / 60.0] * 12, rel=1e-9)
    with pytest.raises(ValueError, match='no body is named "brik"'):
        scene.view("brik")


def test_live_parameters_of_a_group_are_those_of_all_its_bodies(tmp_path):
    loaded = job_of(tmp_path, ROOM + BALL + BRICKS)
    parameters = {each.name: each for each in parameters_of(loaded.job)}
    density, friction = parameters["rigid.brick.density"], parameters["rigid.brick.friction"]
    assert density.paths == (("rigid", 1, "density"),)
    scene = Scene(loaded)
    solver = scene.world.solvers["rigid"]
    mass = solver.bodies.mass.copy()
    set_parameter(scene.world, loaded.job, density, 900.0, before=1800.0)
    set_parameter(scene.world, loaded.job, friction, 0.1, before=0.5)
    assert solver.bodies.mass == pytest.approx(0.5 * mass)
    assert solver.surfaces.friction[:12] == pytest.approx([0.1] * 12)
    values = {name: each.start for name, each in parameters.items()} | {"rigid.brick.friction": 0.1}
    text = text_with_values(loaded, values)
    assert {body.friction for body in job_of(tmp_path, text).job.rigid if body.group == "brick"} == {0.1}


def test_jobs_made_in_python_have_groups():
    bricks = {
        "name": "brick",
        "shape": {"type": "box", "size": [0.1, 0.1, 0.1]},
        "count": 3,
        "spacing": [0.2, 0.0, 0.0],
    }
    job = make_job(name="row", frames=2, rigid=[bricks]).job
    assert [body.name for body in job.rigid] == ["brick_1", "brick_2", "brick_3"]


SNOWBALLS = """
[[soft]]
name = "snow"
material = "snow"
cell_size = 0.01
[[soft.block]]
shape = { type = "sphere", radius = 0.03 }
position = [-0.8, 0.0, 0.1]
[[soft.block]]
shape = { type = "sphere", radius = 0.03 }
position = [0.0, 0.0, 0.1]
count = 8
spacing = 0.2
"""


def test_what_is_told_of_many_blocks_stands_at_their_table_and_says_which(tmp_path):
    found = check(tmp_path, ROOM + SNOWBALLS).errors
    # From the seventh on, at x = 1.2 m, they are outside of the domain.
    assert [line.split(" has no particle")[0] for line in found] == [
        f"many.toml:15 soft[0].block[1]: block {number} of the group" for number in (7, 8)
    ]
