"""Jobs that are valid TOML and valid models, and still cannot be meant."""

import re
from pathlib import Path

import pytest
import trimesh
from checked_jobs import BALL, PLUME, WATER, checked, load_checked_job, says

from pipeline.base.errors import JobFileError
from pipeline.job.loading import job_of_text, read_job
from pipeline.job.magnitudes import check_magnitudes
from pipeline.job.starter import TEMPLATES, starter
from pipeline.model.problems import Findings
from pipeline.run.checked_job import check_job

HEAD = 'name = "dam"\nframes = 10\n'


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
        (WATER.replace("0.5]", "5e30]"), "9 fluid[0].block[0].position[2]: must be within ±1e+06 m, got 5e+30"),
        (WATER.replace("radius = 0.02", "radius = 1e-30"), "6 fluid[0].particle_radius: must be at least 1e-06 m"),
        (BALL + WATER.replace('"water"', '"Ball"'), '10 fluid[0].name: "Ball" is taken by rigid[0]'),
        (WATER + '[material.watr]\nlook = "water"', '10 material.watr: ... "watr"; did you mean "water"?'),
        (WATER + '[material.stone]\nlook = "stone"', '10 material.stone: ... "stone"; bodies are water'),
        (WATER + '[material.water]\nlook = "smoke"', '11 material.water.look: "smoke" is ... [[smoke]] ... [[fluid]]'),
        (PLUME + '[material.plume]\nlook = "metal"', '11 material.plume.look: ... "smoke" or "fire", got "metal"'),
        (WATER + "[render]\nresolution = [481, 270]", "11 render.resolution: ... got 481 x 270; use 482 x 270"),
        (WATER + '[render]\nblender = "/nowhere/blender"', "11 render.blender: no such file: /nowhere/blender"),
        (WATER + BALL + "[camera]\nposition = [0.0, 0.05, 0.1]", '16 camera.position: is inside "ball"'),
        (
            WATER + "[camera]\nposition = [2, 2, 2]\nlook_at = [2, 2, 2]",
            "12 camera.look_at: is where the camera",
        ),
        (BALL.replace("0.1]", "5.0]"), "4 rigid[0]: is wholly outside ... z 4.9..5.1 m, not x -0.5..0.5 ... z 0..1 m"),
        (WATER.replace("0.5]", "-0.5]"), "7 fluid[0].block[0]: is wholly outside ... z -0.7..-0.3 m ... z 0..1 m"),
        (
            WATER + BALL.replace("radius = 0.1", "radius = 0.45").replace("0.1]", "0.5]"),
            "7 fluid[0].block[0]: lies wholly inside solid bodies",
        ),
        (
            WATER.replace("[0.4, 0.4, 0.4]", "[0.4, 0.4, 0.0001]"),
            "7 fluid[0].block[0]: holds no particle ... 0.0001 m thin ... 0.04 m apart",
        ),
        (PLUME.replace("cell_size = 0.05", "max = [0.5, 0.5, -1.0]"), "6 smoke[0].max: ... z 0..-1 m"),
        (PLUME.replace("0.05", "0.4"), "6 smoke[0].cell_size: 0.4 m ... fewer than 4 cells ... of 1 m; use 0.25 m"),
    ],
)
def test_job_that_cannot_be_meant_is_refused_at_its_place(text, expected, tmp_path, monkeypatch):
    monkeypatch.setenv("PIPELINE_BLENDER", "/nowhere/blender")  # the user's own choice, which a file may name
    errors = checked(HEAD + text, tmp_path / "dam.toml").errors
    assert any(says(error, f"dam.toml:{expected}") for error in errors), errors
    with pytest.raises(JobFileError) as refused:
        load_checked_job(tmp_path / "dam.toml")
    assert refused.value.problems == errors


def test_of_numbers_of_usual_size_no_unit_is_asked_for(monkeypatch):
    """The schema of all jobs says the units: to build it takes a tenth of the time of a submit with nothing to do."""
    job = job_of_text(HEAD + WATER + BALL, Path("dam.toml"))

    def refuse() -> None:
        raise AssertionError

    monkeypatch.setattr("pipeline.job.schema.job_schema", refuse)
    assert check_magnitudes(job, Findings())


def test_a_job_without_a_body_is_refused(tmp_path):
    assert checked(HEAD, tmp_path / "dam.toml").errors == [
        "dam.toml: has no body; add [[rigid]], [[fluid]], [[cloth]], [[soft]], [[smoke]] or [[embers]]"
    ]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (BALL, ": has no [[fluid]], [[cloth]], [[soft]], [[smoke]] or [[embers]], so nothing will move"),
        (WATER.replace("0.5]", "0.0]"), ":7 fluid[0].block[0]: 50 % of it are outside the domain"),
        (WATER.replace("particle_radius", "dt = 0.01\nparticle_radius"), ":6 fluid[0].dt: 0.01 s ... 0.00025 s"),
        (
            WATER + PLUME.replace("0.2]", "0.5]"),
            ":14 smoke[0].source[0]: lies wholly inside fluid[0].block[0] at the start",
        ),
        (
            PLUME + BALL.replace("0.1 }", "0.3 }") + 'kind = "kinematic"',
            ":7 smoke[0].source[0]: lies wholly inside rigid[0] at the start",
        ),
        (WATER + '[material.water]\nlook = "milk"\ncaustics = true', ':12 material.water.caustics: ... look "milk"'),
        (WATER + '[material.water]\nlook = "wood"', ':11 material.water.look: is "wood" ... [[fluid]]: it swims'),
        (WATER + BALL + '[material.ball]\nlook = "metal"\ndensity = 2.0', ':17 material.ball.density: ... "metal"'),
        (PLUME + '[material.plume]\nlook = "smoke"\nroughness = 0.5', ':12 material.plume.roughness: ... "smoke"'),
    ],
)
def test_job_that_may_be_unintended_is_allowed_with_a_warning(text, expected, tmp_path):
    errors, warnings, _ = checked(HEAD + text, tmp_path / "dam.toml")
    assert errors == []
    assert any(says(warning, f"dam.toml{expected}") for warning in warnings), warnings


def test_a_body_too_thin_for_the_cells_of_smoke_is_refused_where_it_can_come_there(tmp_path):
    plate = BALL.replace('"sphere", radius = 0.1', '"box", size = [0.3, 0.3, 0.02]') + 'kind = "kinematic"\n'
    errors = checked(HEAD + PLUME + plate, tmp_path / "dam.toml").errors
    assert len(errors) == 1
    assert says(errors[0], 'dam.toml:11 rigid[0]: is 0.02 m thin ... between the cells of smoke "plume", 0.05 m')
    fog = PLUME.replace("cell_size", "min = [-0.5, -0.5, 0.4]\ncell_size").replace("0.2]", "0.7]")
    assert checked(HEAD + fog + plate, tmp_path / "dam.toml").errors == []


def test_overlap_of_fluid_and_body_is_counted_in_particles(tmp_path):
    # Of the block, from 0.3 to 0.7 m, 0.21 m are in the floor: particles have its volume, whatever their spacing.
    floor = BALL.replace('type = "sphere", radius = 0.1', 'type = "box", size = [0.9, 0.9, 0.51]').replace(
        "0.1]", "0.255]"
    )
    errors, warnings, _ = checked(HEAD + WATER + floor, tmp_path / "dam.toml")
    assert errors == []
    assert warnings == ["dam.toml:7 fluid[0].block[0]: overlaps a solid body: 525 of its 1000 particles are left out"]


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


DYED = (
    WATER + '[[fluid.block]]\nshape = { type = "box", size = [0.1, 0.1, 0.1] }\nposition = [0.3, 0.3, 0.1]\ndye = 1.0\n'
)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            DYED + '[material.water]\nlook = "metal"\n',
            'fluid[0]: has dye, and its look "metal" does not show it ... "muddy_water", "rubber" ... or "jelly"',
        ),
        (DYED, "fluid[0]: has dye ... add dye_color to [material.water]"),
        (DYED + '[material.water]\nlook = "milk"\n', "fluid[0]: has dye ... add dye_color to [material.water]"),
        (
            WATER + '[material.water]\nlook = "milk"\ndye_color = [0.5, 0.0, 0.0]\n',
            'material.water.dye_color: has no effect, as "water" has no dye ... [[fluid.block]]',
        ),
    ],
)
def test_dye_that_no_picture_shows_is_told(text, expected, tmp_path):
    errors, warnings, _ = checked(HEAD + text, tmp_path / "dam.toml")
    assert errors == []
    assert any(says(warning.partition(" ")[2], expected) for warning in warnings), warnings


@pytest.mark.parametrize("look", ["milk", "water"])
def test_dye_in_a_liquid_with_its_colour_passes_without_a_word(look, tmp_path):
    text = DYED + f'[material.water]\nlook = "{look}"\ndye_color = [0.5, 0.0, 0.0]\n'
    errors, warnings, _ = checked(HEAD + text, tmp_path / "dam.toml")
    assert errors == []
    assert not [warning for warning in warnings if "dye" in warning]


def test_the_colour_of_dye_that_comes_from_another_fluid_has_an_effect(tmp_path):
    other = DYED.replace('"water"', '"oil"').replace("[0.0, 0.0, 0.5]", "[0.0, 0.0, 0.2]").replace("0.4]", "0.1]")
    colors = "".join(f"[material.{name}]\ndye_color = [0.5, 0.0, 0.0]\n" for name in ("water", "oil"))
    errors, warnings, _ = checked(HEAD + WATER + other + colors, tmp_path / "dam.toml")
    assert errors == []
    assert not [warning for warning in warnings if "dye" in warning], warnings
