"""Bodies that break, and compounds, all the way through a job: files, names, materials, what is told, frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from checked_jobs import checked

from pipeline import Scene
from pipeline.base.errors import JobFileError
from pipeline.base.layout import JobLayout
from pipeline.job.loading import read_job
from pipeline.kinds.table import material_of, scene_objects
from pipeline.store.cache import read_frame

ROOM = 'name = "broken"\nframes = 3\ndevice = "cpu"\n[domain]\nmin = [-1, -1, 0]\nmax = [1, 1, 1]\n'
POT = """
[[rigid]]
name = "pot"
kind = "dynamic"
density = 2000.0
shape = {shape}
position = [0.0, 0.0, 0.5]
breaks = {{ strength = 1e6, pieces = 3, seed = 1 }}
"""
HAMMER = """
[[rigid]]
name = "hammer"
kind = "dynamic"
density = 7800.0
position = [0.5, 0.0, 0.5]
shape = { type = "compound", part = [
    { shape = { type = "box", size = [0.1, 0.03, 0.03] } },
    { shape = { type = "cylinder", radius = 0.01, height = 0.2 }, position = [0.0, 0.0, -0.115], name = "handle" },
] }
"""
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
STONE = '{ type = "mesh", file = "stone.obj", size = 0.2 }'


def job_file(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "broken.toml"
    path.write_text(ROOM + text)
    return path


def test_the_file_of_what_breaks_is_found_beside_the_job_and_named_where_the_job_names_it(tmp_path):
    (tmp_path / "stone.obj").write_text(TETRAHEDRON)
    loaded = read_job(job_file(tmp_path, POT.format(shape=STONE)))
    file = (tmp_path / "stone.obj").as_posix()
    assert {body.shape.of.file for body in loaded.job.rigid} == {file}
    assert f'file = "{file}"' in loaded.text
    again = read_job(job_file(tmp_path, loaded.text.removeprefix(ROOM))).job
    assert again.rigid == loaded.job.rigid


def test_a_missing_file_is_told_once_at_the_table(tmp_path):
    told = checked(ROOM + POT.format(shape=STONE), tmp_path / "broken.toml")
    assert "stone.obj" in told.errors[0]
    assert "rigid[0].shape" in told.errors[0]


def test_a_job_tells_of_its_pieces_and_draws_their_insides(tmp_path):
    text = '{ type = "box", size = [0.2, 0.2, 0.2] }'
    looks = '[material.pot]\nlook = "ceramic"\n[material."pot.inside"]\nlook = "stone"\n'
    looks += '[material.hammer]\nlook = "metal"\n[material."hammer.handle"]\nlook = "wood"\n'
    path = job_file(tmp_path, POT.format(shape=text) + HAMMER + looks)
    job = read_job(path).job
    assert [body.name for body in job.rigid] == ["pot_1", "pot_2", "pot_3", "hammer"]
    assert {body.group for body in job.rigid} == {"pot", "hammer"}
    assert (material_of(job, "pot_2").look, material_of(job, "pot_2", "inside").look) == ("ceramic", "stone")
    assert (material_of(job, "hammer").look, material_of(job, "hammer", "handle").look) == ("metal", "wood")
    names = [each.name for each in scene_objects(job, JobLayout(tmp_path))]
    assert {"pot_1", "pot_1.inside", "hammer.handle"} <= set(names)
    told = checked(path.read_text(), path)
    assert not told.errors
    (fact,) = [each for each in told.findings.facts if "pot" in each.message]
    assert fact.path == ("rigid", 0, "breaks")
    assert "3 pieces" in fact.message


def test_parts_that_nothing_glues_are_told_of(tmp_path):
    breaks = "breaks = { strength = 1e6 }\n"
    assert not checked(ROOM + HAMMER + breaks, tmp_path / "broken.toml").warnings
    (warning,) = checked(ROOM + HAMMER.replace("-0.115", "-0.12") + breaks, tmp_path / "broken.toml").warnings
    assert "rigid[0].breaks" in warning
    assert "in 2 from the start" in warning


def test_parts_look_like_their_body_unless_they_are_said_to_differ(tmp_path):
    looks = '[material.hammer]\nlook = "plastic"\ncolor = [0.5, 0.1, 0.1]\n'
    job = read_job(job_file(tmp_path, HAMMER + looks)).job
    assert material_of(job, "hammer", "handle") == material_of(job, "hammer")


def test_names_of_parts_that_have_a_meaning_are_refused(tmp_path):
    with pytest.raises(JobFileError) as refused:
        read_job(job_file(tmp_path, HAMMER.replace('"handle"', '"inside"')))
    assert "rigid[0].shape" in "\n".join(refused.value.problems)


def test_a_scene_of_pieces_and_compounds_steps(tmp_path):
    scene = Scene(read_job(job_file(tmp_path, POT.format(shape='{ type = "sphere", radius = 0.1 }') + HAMMER)))
    scene.step()
    scene.write(tmp_path / "frame.h5")
    written, read = scene.bodies(), read_frame(tmp_path / "frame.h5").bodies
    assert set(read) == {"pot_1", "pot_2", "pot_3", "hammer"}
    for key, array in written["pot_2"].arrays.items():
        assert np.array_equal(read["pot_2"].arrays[key], array)


CLOTH = """
[[cloth]]
name = "sheet"
shape = { type = "rectangle", size = [1.0, 1.0], counts = [21, 21] }
position = [0.0, 0.0, 0.8]
"""
CLAY = """
[[soft]]
name = "clay"
material = "clay"
cell_size = 0.04
block = [{ shape = { type = "box", size = [0.6, 0.6, 0.2] }, position = [0.0, 0.0, 0.1] }]
"""


@pytest.mark.parametrize(
    ("other", "place", "told"),
    [
        (CLOTH, "cloth[0].shape", "more of its group are thin"),
        (CLAY, 'rigid[0].breaks: "pot" has pieces, ', 'the thinnest, "pot_'),
    ],
)
def test_pieces_that_cloth_or_soft_matter_may_pass_through_are_told_once(tmp_path, other, place, told):
    """Not one by one, and nothing of walls: edges of pieces are sharp, those of the whole are not."""
    pot = POT.format(shape='{ type = "box", size = [0.2, 0.2, 0.2] }').replace("pieces = 3", "pieces = 12")
    found = checked(ROOM + pot + other, tmp_path / "broken.toml")
    assert not found.errors
    (warning,) = [each for each in found.warnings if told in each]
    assert place in warning
    assert not [each for each in found.warnings if "walls" in each]
