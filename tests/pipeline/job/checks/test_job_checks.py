"""Jobs that are valid TOML and valid models, and still cannot be meant."""

import re

import pytest
import trimesh
from checked_jobs import checked

from pipeline.base.errors import JobFileError
from pipeline.job.loading import read_job
from pipeline.job.starter import TEMPLATES, starter
from pipeline.run.checked_job import check_job, load_checked_job

HEAD = 'name = "dam"\nframes = 10\n'
WATER = """
[[fluid]]
name = "water"
particle_radius = 0.02
[[fluid.block]]
shape = { type = "box", size = [0.4, 0.4, 0.4] }
position = [0.0, 0.0, 0.5]
"""
PLUME = """
[[smoke]]
name = "plume"
cell_size = 0.05
[[smoke.source]]
shape = { type = "sphere", radius = 0.1 }
position = [0.0, 0.0, 0.2]
"""
BALL = """
[[rigid]]
name = "ball"
shape = { type = "sphere", radius = 0.1 }
position = [0.0, 0.0, 0.1]
"""


@pytest.mark.parametrize("template", TEMPLATES)
@pytest.mark.parametrize("preview", [False, True])
def test_starter_passes_every_check_without_a_warning(template, preview, tmp_path):
    path = tmp_path / "film.toml"
    path.write_text(starter("film", template, file="film.toml"))
    loaded, findings = load_checked_job(path, preview=preview)
    assert loaded.warnings == ()
    assert sum(findings.elements.values()) > 100


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            HEAD + WATER.replace("0.5]", "5e30]"),
            "dam.toml:9 fluid[0].block[0].position[2]: must be within ±1e+06 m, got 5e+30; units are SI",
        ),
        (
            HEAD + WATER.replace("radius = 0.02", "radius = 1e-30"),
            "dam.toml:6 fluid[0].particle_radius: must be at least 1e-06 m, got 1e-30; units are SI",
        ),
        (HEAD, "dam.toml: has no body; add [[rigid]], [[fluid]], [[cloth]] or [[smoke]]"),
        (
            HEAD + BALL + WATER.replace('"water"', '"Ball"'),
            'dam.toml:10 fluid[0].name: "Ball" is taken by rigid[0]; names are unique in a job',
        ),
        (
            HEAD + WATER + '[material.watr]\nlook = "water"',
            'dam.toml:10 material.watr: no body is named "watr"; did you mean "water"?',
        ),
        (
            HEAD + WATER + '[material.stone]\nlook = "stone"',
            'dam.toml:10 material.stone: no body is named "stone"; bodies are water',
        ),
        (
            HEAD + WATER + '[material.water]\nlook = "smoke"',
            'dam.toml:11 material.water.look: "smoke" is a look for [[smoke]]; "water" is in [[fluid]]',
        ),
        (
            HEAD + PLUME + '[material.plume]\nlook = "metal"',
            'dam.toml:11 material.plume.look: smoke can only look like "smoke" or "fire", got "metal"',
        ),
        (
            HEAD + WATER + '[domain]\nopen_faces = ["z+", "x-", "z+"]',
            'dam.toml:11 domain.open_faces: names "z+" more than once',
        ),
        (
            HEAD + WATER + "[render]\nresolution = [481, 270]",
            "dam.toml:11 render.resolution: must be even numbers, as video needs them, got 481 x 270; use 482 x 270",
        ),
        (
            HEAD + WATER + '[render]\nblender = "/nowhere/blender"',
            "dam.toml:11 render.blender: no such file: /nowhere/blender; omit it to use the bpy module",
        ),
        (
            HEAD + WATER + BALL + "[camera]\nposition = [0.0, 0.05, 0.1]",
            'dam.toml:16 camera.position: is inside "ball"; move it out',
        ),
        (
            HEAD + WATER + "[camera]\nposition = [2, 2, 2]\nlook_at = [2, 2, 2]",
            "dam.toml:12 camera.look_at: is where the camera stands; it must be somewhere else",
        ),
        (
            HEAD + BALL.replace("0.1]", "5.0]"),
            "dam.toml:4 rigid[0]: is wholly outside the domain: it spans x -0.1..0.1 y -0.1..0.1 z 4.9..5.1 m, "
            "not x -0.5..0.5 y -0.5..0.5 z 0..1 m",
        ),
        (
            HEAD + WATER.replace("0.5]", "-0.5]"),
            "dam.toml:7 fluid[0].block[0]: is wholly outside the domain: it spans x -0.2..0.2 y -0.2..0.2 "
            "z -0.7..-0.3 m, not x -0.5..0.5 y -0.5..0.5 z 0..1 m",
        ),
        (
            HEAD + WATER + BALL.replace("radius = 0.1", "radius = 0.45").replace("0.1]", "0.5]"),
            "dam.toml:7 fluid[0].block[0]: lies wholly inside solid bodies, so it holds no particle; move it",
        ),
        (
            HEAD + WATER.replace("[0.4, 0.4, 0.4]", "[0.4, 0.4, 0.01]"),
            "dam.toml:7 fluid[0].block[0]: holds no particle: it is 0.01 m thin and particles are 0.04 m apart; "
            "enlarge it or use a smaller particle_radius",
        ),
        (
            HEAD + PLUME.replace("0.2]", "3.0]"),
            "dam.toml:7 smoke[0].source[0]: is wholly outside the smoke's grid: it spans x -0.1..0.1 y -0.1..0.1 "
            "z 2.9..3.1 m, not x -0.5..0.5 y -0.5..0.5 z 0..1 m",
        ),
        (
            HEAD + PLUME.replace("cell_size = 0.05", "max = [0.5, 0.5, -1.0]"),
            "dam.toml:6 smoke[0].max: max must be above min on every axis, got x -0.5..0.5 y -0.5..0.5 z 0..-1 m",
        ),
        (
            HEAD + PLUME.replace("cell_size = 0.05", "cell_size = 0.4"),
            "dam.toml:6 smoke[0].cell_size: 0.4 m leaves fewer than 4 cells along an edge of 1 m; use 0.25 m or less",
        ),
    ],
)
def test_job_that_cannot_be_meant_is_refused_with_this_line(text, expected, tmp_path):
    errors = checked(text, tmp_path / "dam.toml").errors
    assert expected in errors
    with pytest.raises(JobFileError, match=re.escape(expected)):
        load_checked_job(tmp_path / "dam.toml")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (HEAD + BALL, "dam.toml: has neither fluid nor cloth nor smoke, so nothing will move"),
        (
            HEAD + WATER.replace("0.5]", "0.0]"),
            "dam.toml:7 fluid[0].block[0]: 50 % of it are outside the domain and are clipped",
        ),
        (
            HEAD + WATER.replace("particle_radius", "dt = 0.01\nparticle_radius"),
            "dam.toml:6 fluid[0].dt: 0.01 s is above the stable step of about 0.00025 s and may blow up; "
            'use "adaptive"',
        ),
        (
            HEAD + PLUME + "start_s = 5.0",
            "dam.toml:10 smoke[0].source[0].start_s: starts at 5 s, after the film's end at 0.166667 s",
        ),
        (
            HEAD + WATER + PLUME.replace("0.2]", "0.5]"),
            "dam.toml:14 smoke[0].source[0]: lies wholly inside fluid[0].block[0] at the start, and emits nothing "
            "until that has moved off",
        ),
        (
            HEAD + PLUME + BALL.replace("0.1 }", "0.3 }") + 'kind = "kinematic"',
            "dam.toml:7 smoke[0].source[0]: lies wholly inside rigid[0] at the start, and emits nothing "
            "until that has moved off",
        ),
        (
            HEAD + WATER + '[material.water]\nlook = "milk"\ncaustics = true',
            'dam.toml:12 material.water.caustics: has no effect on the look "milk"',
        ),
        (
            HEAD + WATER + '[material.water]\nlook = "wood"',
            'dam.toml:11 material.water.look: is "wood", whose texture hangs on nothing in [[fluid]]: it swims',
        ),
        (
            HEAD + WATER + BALL + '[material.ball]\nlook = "metal"\ndensity = 2.0',
            'dam.toml:17 material.ball.density: has no effect on the look "metal"',
        ),
        (
            HEAD + PLUME + '[material.plume]\nlook = "smoke"\nroughness = 0.5',
            'dam.toml:12 material.plume.roughness: has no effect on the look "smoke"',
        ),
    ],
)
def test_job_that_may_be_unintended_is_allowed_with_this_warning(text, expected, tmp_path):
    errors, warnings, _ = checked(text, tmp_path / "dam.toml")
    assert errors == []
    assert expected in warnings


def test_a_body_too_thin_for_the_cells_of_smoke_is_refused_where_it_can_come_there(tmp_path):
    plate = BALL.replace('"sphere", radius = 0.1', '"box", size = [0.3, 0.3, 0.02]') + 'kind = "kinematic"\n'
    errors = checked(HEAD + PLUME + plate, tmp_path / "dam.toml").errors
    assert errors == [
        'dam.toml:11 rigid[0]: is 0.02 m thin and would fall between the cells of smoke "plume", 0.05 m, into whose '
        "box it can come; use a smaller cell_size or a thicker body"
    ]
    fog = PLUME.replace("cell_size", "min = [-0.5, -0.5, 0.4]\ncell_size").replace("0.2]", "0.7]")
    assert checked(HEAD + fog + plate, tmp_path / "dam.toml").errors == []


def test_overlap_of_fluid_and_body_is_counted_in_particles(tmp_path):
    # Centres of the block's 10³ particles lie at heights 0.32, 0.36, ... 0.68; those below 0.51 + radius go.
    floor = BALL.replace('type = "sphere", radius = 0.1', 'type = "box", size = [0.9, 0.9, 0.51]').replace(
        "0.1]", "0.255]"
    )
    errors, warnings, _ = checked(HEAD + WATER + floor, tmp_path / "dam.toml")
    assert errors == []
    assert warnings == ["dam.toml:7 fluid[0].block[0]: overlaps a solid body: 600 of its 1000 particles are left out"]


def test_fluid_that_does_not_fit_into_memory_is_refused_with_a_radius_that_fits(tmp_path):
    errors = checked(HEAD + WATER, tmp_path / "dam.toml", memory_bytes=1_000_000).errors
    assert len(errors) == 1
    radius = float(re.search(r"use ([\d.]+) m or more", errors[0]).group(1))
    assert "dam.toml:6 fluid[0].particle_radius: 1000 particles need" in errors[0]
    assert "at most 976 fit" in errors[0]
    text = (HEAD + WATER).replace("particle_radius = 0.02", f"particle_radius = {radius}")
    assert checked(text, tmp_path / "dam.toml", memory_bytes=1_000_000).errors == []


def test_a_fluid_far_too_large_is_refused_at_once(tmp_path):
    text = (HEAD + WATER).replace("particle_radius = 0.02", "particle_radius = 1e-6")
    errors = checked(text, tmp_path / "dam.toml").errors
    assert len(errors) == 1
    assert "particles need" in errors[0]


def test_domain_too_large_for_its_particles_is_refused_with_a_radius_that_fits(tmp_path):
    text = HEAD + WATER + "[domain]\nmin = [-300, -300, 0]\nmax = [300, 300, 100]\n"
    errors = checked(text, tmp_path / "dam.toml", memory_bytes=10**9).errors
    assert len(errors) == 1
    assert errors[0].startswith("dam.toml:10 domain: is so large that walls and search cells for particles of 0.02 m")
    radius = re.search(r"particle_radius ([\d.]+) m$", errors[0]).group(1)
    text = text.replace("particle_radius = 0.02", f"particle_radius = {radius}").replace("0.4, 0.4, 0.4", "9, 9, 9")
    assert checked(text, tmp_path / "dam.toml", memory_bytes=10**9).errors == []


def test_smoke_that_does_not_fit_into_memory_is_refused_with_a_cell_size_that_fits(tmp_path):
    errors = checked(HEAD + PLUME, tmp_path / "dam.toml", memory_bytes=1_000_000).errors
    size = float(re.search(r"use ([\d.]+) m or more", errors[0]).group(1))
    text = (HEAD + PLUME).replace("cell_size = 0.05", f"cell_size = {size}")
    assert checked(text, tmp_path / "dam.toml", memory_bytes=1_000_000).errors == []


def test_large_fluid_is_counted_on_a_coarser_lattice(tmp_path):
    # 0.4 m / 0.004 m = 100 particles an edge; a box's count is exact, however many of the coarse lattice fit.
    path = tmp_path / "dam.toml"
    path.write_text((HEAD + WATER).replace("particle_radius = 0.02", "particle_radius = 0.002"))
    assert check_job(read_job(path).job).elements["fluid"] == 1_000_000


def test_missing_mesh_file_is_named_with_its_likely_spelling(tmp_path):
    (tmp_path / "duck.obj").write_text("")
    mesh = BALL.replace('type = "sphere", radius = 0.1', 'type = "mesh", file = "dukc.obj"')
    errors = checked(HEAD + WATER + mesh, tmp_path / "dam.toml").errors
    assert errors == [f'dam.toml:13 rigid[0].shape.file: no such file: {tmp_path}/dukc.obj; did you mean "duck.obj"?']


def test_mesh_without_faces_and_mesh_with_holes_are_told_apart(tmp_path):
    (tmp_path / "points.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    ball.update_faces(list(range(20, len(ball.faces))))
    ball.export(tmp_path / "holed.ply")
    mesh = BALL.replace('type = "sphere", radius = 0.1', 'type = "mesh", file = "FILE"')
    errors = checked(HEAD + WATER + mesh.replace("FILE", "points.obj"), tmp_path / "dam.toml").errors
    assert len(errors) == 1
    assert errors[0].startswith("dam.toml:13 rigid[0].shape: ")
    errors, warnings, _ = checked(HEAD + WATER + mesh.replace("FILE", "holed.ply"), tmp_path / "dam.toml")
    assert errors == []
    assert len(warnings) == 1
    assert "hole" in warnings[0]
