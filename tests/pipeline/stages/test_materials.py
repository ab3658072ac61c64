"""What bodies and their parts look like by the tables of a job, and what `check` says of those."""

from pathlib import Path

from checked_jobs import checked

from pipeline.base.layout import JobLayout
from pipeline.job.loading import load_job
from pipeline.kinds.table import material_of
from pipeline.model.job import Job
from pipeline.model.looks import NATURAL_MATERIALS
from pipeline.stages.render_scene import render_spec

DUCK = """
name = "pond"
frames = 2
[[rigid]]
name = "duck"
kind = "kinematic"
shape = { type = "duck", length = 0.2 }
position = [0.0, 0.0, 0.5]
velocity = [0.1, 0.0, 0.0]
[[cloth]]
name = "flag"
material = "silk"
shape = { type = "rectangle", size = [0.2, 0.1], counts = [9, 5] }
position = [0.0, 0.3, 0.5]
"""
NATURAL = NATURAL_MATERIALS["duck"]


def job(folder: Path, tables: str) -> Job:
    found = checked(DUCK + tables, folder / "pond.toml")
    assert found.errors == []
    return load_job(folder / "pond.toml")


def test_a_parts_own_material_counts_whatever_the_body_is_made_of(tmp_path):
    tables = '[material.duck]\nlook = "metal"\n[material."duck.bill"]\nlook = "rubber"\ncolor = [0.1, 0.2, 0.9]\n'
    metal = job(tmp_path, tables)
    assert material_of(metal, "duck").look == material_of(metal, "duck", "eyes").look == "metal"
    assert material_of(metal, "duck", "bill").look == "rubber"
    assert material_of(metal, "duck", "bill").color == (0.1, 0.2, 0.9)


def test_a_part_of_one_piece_with_its_body_may_have_another_colour(tmp_path):
    metal = job(tmp_path, '[material.duck]\nlook = "metal"\n[material."duck.bill"]\ncolor = [0.9, 0.1, 0.1]\n')
    assert material_of(metal, "duck", "bill").look == "metal"
    assert material_of(metal, "duck", "bill").color == (0.9, 0.1, 0.1)


def test_a_colour_alone_keeps_the_look_that_a_body_has_by_itself(tmp_path):
    blue = job(tmp_path, "[material.duck]\ncolor = [0.0, 0.1, 0.9]\n[material.flag]\nthread_spacing = 0.002\n")
    assert material_of(blue, "duck") == NATURAL["body"].model_copy(update={"color": (0.0, 0.1, 0.9)})
    assert material_of(blue, "duck", "bill") == NATURAL["bill"]
    assert (material_of(blue, "flag").look, material_of(blue, "flag").thread_spacing) == ("silk", 0.002)
    assert all(drawn.material.look is not None for drawn in render_spec(blue, JobLayout(tmp_path)).objects)


def test_a_key_that_the_own_look_does_not_have_is_told(tmp_path):
    found = checked(DUCK + "[material.duck]\ncaustics = true\nthread_spacing = 0.01\n", tmp_path / "pond.toml")
    assert found.errors == []
    for key in ("caustics", "thread_spacing"):
        assert any(f'material.duck.{key}: has no effect on the look "rubber"' in line for line in found.warnings)


def test_a_colour_of_a_part_whose_body_is_of_a_blend_file_is_told_to_have_no_effect(tmp_path):
    (tmp_path / "own.blend").write_bytes(b"BLENDER")
    tables = '[material.duck]\nblend = "own.blend:Gold"\n[material."duck.bill"]\ncolor = [1.0, 0.0, 0.0]\n'
    found = checked(DUCK + tables, tmp_path / "pond.toml")
    assert found.errors == []
    assert any("duck.bill" in line and "color: has no effect beside blend" in line for line in found.warnings)


MANY = (
    DUCK
    + """
[[rigid]]
name = "ball1"
shape = { type = "sphere", radius = 0.05 }
position = [0.2, 0.0, 0.5]
[[rigid]]
name = "ball2"
shape = { type = "sphere", radius = 0.05 }
position = [0.4, 0.0, 0.5]
"""
)


def test_one_table_is_about_many_bodies_of_which_one_may_differ(tmp_path):
    tables = '[material.ball2]\ncolor = [0.9, 0.1, 0.1]\n[material."ball*"]\nlook = "metal"\ncolor = [0.5, 0.5, 0.5]\n'
    assert checked(MANY + tables, tmp_path / "pond.toml").errors == []
    balls = load_job(tmp_path / "pond.toml")
    assert material_of(balls, "ball1").look == material_of(balls, "ball2").look == "metal"
    assert (material_of(balls, "ball1").color, material_of(balls, "ball2").color) == ((0.5,) * 3, (0.9, 0.1, 0.1))
    assert material_of(balls, "duck") == NATURAL["body"]


def test_a_table_of_many_is_not_about_parts_and_is_told_where_it_does_not_fit(tmp_path):
    tables = '[material."*"]\nlook = "smoke"\n[material."b*x"]\nlook = "glass"\n'
    found = checked(MANY + tables, tmp_path / "pond.toml")
    assert any('material."*".look: ' in each and '"flag"' in each for each in found.errors), found.errors
    assert any('material."b*x": no body is named "b*x"' in each for each in found.errors)
    (tmp_path / "duck.toml").write_text(MANY + '[material."d*"]\nlook = "plastic"\n')
    duck = load_job(tmp_path / "duck.toml")
    assert material_of(duck, "duck", "bill") == NATURAL["bill"]
