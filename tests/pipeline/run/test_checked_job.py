"""Every problem of a job file at once: of its keys, of its tables, and of the scene that is left without those."""

from pathlib import Path

import pytest
from checked_jobs import load_checked_job

from pipeline.base.errors import JobFileError

SIX_FAULTS = """name = "six"
duration = 2.0
frames = 60
fsp = 30

[[rigid]]
name = "ball"
shape = { type = "sphere", radius = 0.1 }
position = [0, 0, 0.5]

[[rigid]]
name = "far"
shape = { type = "sphere", radius = 0.1 }
position = [0, 50, 0.5]

[camera]
look_at = "bal"

[render]
resolution = [481, 270]

[limits.rendr]
timeout_s = 5
"""


def problems(text: str, folder: Path) -> list[str]:
    path = folder / "job.toml"
    path.write_text(text)
    with pytest.raises(JobFileError) as caught:
        load_checked_job(path)
    return caught.value.problems


def places(text: str, folder: Path) -> list[str]:
    return [problem.removeprefix("job.toml:").partition(": ")[0] for problem in problems(text, folder)]


def test_faults_of_three_layers_come_in_one_list_each_with_its_line(tmp_path):
    assert places(SIX_FAULTS, tmp_path) == [
        "2 duration",
        "4 fsp",
        "11 rigid[1]",
        "17 camera.look_at",
        "20 render.resolution",
        "22 limits.rendr",
    ]


def test_what_may_follow_from_a_fault_is_not_told(tmp_path):
    """Without its radius the ball has no shape, and without the ball the camera nothing to look at."""
    text = SIX_FAULTS.replace("duration = 2.0\n", "").replace("fsp = 30\n", "").replace('"bal"', '"ball"')
    assert places(text.replace("radius = 0.1 }\nposition = [0, 0", "radius = -0.1 }\nposition = [0, 0"), tmp_path) == [
        "6 rigid[0].shape.radius",
        "9 rigid[1]",
        "18 render.resolution",
        "20 limits.rendr",
    ]


def test_places_are_those_of_the_file_though_a_table_before_is_refused(tmp_path):
    text = SIX_FAULTS.replace('type = "sphere"', 'type = "spere"', 1)
    assert "13 rigid[1]" not in places(text, tmp_path)
    assert "11 rigid[1]" in places(text, tmp_path)


@pytest.mark.parametrize(
    "text", ["rigid = [1, 2]", "[rigid]\nname = 3", "rigid = 5\nframes = 0", "[[rigid]]\nname = []"]
)
def test_a_body_that_is_no_table_is_told(text, tmp_path):
    assert all(
        place.split()[1].startswith(("rigid", "frames")) for place in places(f'name = "odd"\n{text}\n', tmp_path)
    )


def test_a_scene_in_a_domain_that_is_refused_is_not_looked_at(tmp_path):
    assert "11 rigid[1]" not in places(SIX_FAULTS + "[domain]\nmax = [1, 1, -5]\n", tmp_path)


def test_a_mesh_in_millimetres_is_told_in_those_words(tmp_path):
    (tmp_path / "cube.obj").write_text(
        "".join(f"v {x} {y} {z}\n" for x in (0, 200) for y in (0, 200) for z in (0, 200))
        + "f 1 2 4 3\nf 5 7 8 6\nf 1 5 6 2\nf 3 4 8 7\nf 1 3 7 5\nf 2 6 8 4\n"
    )
    body = '[[rigid]]\nname = "cube"\nshape = { type = "mesh", file = "cube.obj" }\n'
    smoke = '[[smoke]]\nname = "plume"\n[[smoke.source]]\nshape = { type = "sphere", radius = 0.1 }\n'
    domain = "[domain]\nmin = [-0.2, -0.2, 0.0]\nmax = [0.2, 0.2, 0.4]\n"
    (problem,) = problems(f'name = "units"\n{domain}{body}{smoke}', tmp_path)
    assert problem.startswith("job.toml:7 rigid[0].shape: ")
    assert "millimetres, scale = 0.001 makes it 0.2 m" in problem
    scaled = f'name = "units"\n{domain}{body}scale = 0.001\nposition = [0, 0, 0.3]\n'
    (tmp_path / "job.toml").write_text(scaled)
    load_checked_job(tmp_path / "job.toml")
