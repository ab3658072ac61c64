"""Jobs with smoke that cannot be meant, each told with its line before anything runs."""

import re

import pytest
from checked_jobs import checked

from pipeline.job.loading import read_job
from pipeline.job.starter import starter
from pipeline.kinds.checks.memory_budget import MemoryBudget
from pipeline.kinds.checks.smoke import check_smokes
from pipeline.model.job import Job
from pipeline.model.problems import Findings
from pipeline.run.checked_job import load_checked_job

HEAD = 'name = "fire"\nframes = 60\n'
SMOKE = """
[[smoke]]
name = "plume"
cell_size = 0.05
"""
SOURCE = """
[[smoke.source]]
shape = { type = "sphere", radius = 0.1 }
position = [0.0, 0.0, 0.2]
"""
PLUME = HEAD + SMOKE + SOURCE
BALL = """
[[rigid]]
name = "ball"
shape = { type = "sphere", radius = 0.15 }
position = [0.0, 0.0, 0.2]
"""
WALL = """
[[rigid]]
name = "wall"
shape = { type = "box", size = [0.1, 1.0, 1.0] }
position = [0.3, 0.0, 0.5]
"""
PATH = """
[[smoke.source]]
shape = { type = "sphere", radius = 0.1 }
keyframe = [{ time_s = 0.0, position = [-2.0, 0.0, 0.5] }, { time_s = 1.0, position = [0.0, 0.0, 0.5] }]
"""


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            PLUME.replace("0.2]", "9.0]"),
            "fire.toml:8 smoke[0].source[0]: is wholly outside the smoke's grid: it spans x -0.1..0.1 y -0.1..0.1 "
            "z 8.9..9.1 m, not x -0.5..0.5 y -0.5..0.5 z 0..1 m",
        ),
        (
            PLUME.replace("radius = 0.1", "radius = 0.01"),
            "fire.toml:8 smoke[0].source[0]: holds no centre of a cell: it is 0.02 m thin, and cells are 0.05 m; "
            "enlarge it or use a smaller cell_size",
        ),
        (
            PLUME + BALL,
            "fire.toml:8 smoke[0].source[0]: lies wholly inside solid bodies, so it emits nothing; move it",
        ),
        (
            PLUME + 'follow = "bal"\n' + BALL,
            'fire.toml:11 smoke[0].source[0].follow: no rigid body is named "bal"; did you mean "ball"?',
        ),
        (
            # Along the body's axes that is a good place; from the domain's origin it is outside.
            PLUME.replace("0.2]", "-0.3]") + 'follow = "bal"\n' + BALL,
            'fire.toml:11 smoke[0].source[0].follow: no rigid body is named "bal"; did you mean "ball"?',
        ),
        (
            PLUME + 'follow = "ball"\n',
            'fire.toml:11 smoke[0].source[0].follow: no rigid body is named "ball"; add [[rigid]]',
        ),
        (
            PLUME.replace("0.2]", "0.0]").replace("radius = 0.1", "radius = 0.05")
            + 'follow = "ball"\n'
            + BALL
            + 'kind = "kinematic"\n',
            "fire.toml:8 smoke[0].source[0]: lies wholly inside rigid[0], which it follows: it emits nothing; move it",
        ),
        (
            HEAD + SMOKE + PATH.replace("[0.0, 0.0, 0.5]", "[-1.0, 0.0, 0.5]"),
            "fire.toml:8 smoke[0].source[0]: never comes into the smoke's grid: its way spans x -2.346..-0.6536 "
            "y -0.3464..0.3464 z 0.1536..0.8464 m, not x -0.5..0.5 y -0.5..0.5 z 0..1 m",
        ),
        (
            HEAD + SMOKE + "wind = [0.0, 0.0, 2.0]\n" + SOURCE,
            'fire.toml:7 smoke[0].wind: blows in through the side "z-", which is closed; add it to open_faces, or turn '
            "the wind",
        ),
        (
            HEAD + SMOKE + 'wind = [2.0, 0.0, 0.0]\nopen_faces = ["x-"]\n' + SOURCE,
            "fire.toml:7 smoke[0].wind: lets air in through x-, and no other side is open: as much must flow out, for "
            "air of constant density cannot be compressed; add a side on the lee to open_faces",
        ),
        (
            HEAD + SMOKE + 'wind = [2.0, 0.0, 0.0]\nopen_faces = ["x-", "x+"]\n' + SOURCE + WALL,
            "fire.toml:7 smoke[0].wind: blows in through x-, but solids that stand still cut air there off from every "
            "other open side: as much must flow out, for air of constant density cannot be compressed; leave a way "
            "around them, close the side, or turn the wind",
        ),
        (
            HEAD + SMOKE + "turbulence = { strength = 1.0, size = 0.06 }\n" + SOURCE,
            "fire.toml:7 smoke[0].turbulence.size: 0.06 m is less than two cells of 0.05 m, which carry no such "
            "eddies; use 0.1 m or more",
        ),
        (
            PLUME + "temperature = 2e4\n",
            "fire.toml:11 smoke[0].source[0].temperature: 20000 K is beyond 10000 K, where gas is a plasma; flames "
            "have 1500 K",
        ),
    ],
)
def test_smoke_that_cannot_be_is_refused_with_this_line(text, expected, tmp_path):
    assert checked(text, tmp_path / "fire.toml").errors == [expected]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (PLUME + "temperature = 4500\n", "temperature: 4500 K is hotter than any flame; wood burns at 1500 K"),
        (PLUME + "temperature = 60\n", "temperature: 60 K is colder than any air; 20 °C are 293 K"),
        (
            HEAD + SMOKE + "ambient_temperature = 20\n" + SOURCE,
            "fire.toml:7 smoke[0].ambient_temperature: 20 K is no air; 20 °C are 293 K",
        ),
        (
            PLUME + "temperature = 293\ndensity = 0.0\n",
            "source[0]: has no density, and the temperature of the air: it emits nothing",
        ),
        (
            PLUME + "ramp = [{ time_s = 1.0, strength = 0.0 }]\n",
            "source[0].ramp: is 0 whenever it emits in the film's 1 s: it emits nothing",
        ),
        (
            # It grows after the film of 1 s only.
            PLUME + "ramp = [{ time_s = 2.0, strength = 0.0 }, { time_s = 3.0, strength = 1.0 }]\n",
            "source[0].ramp: is 0 whenever it emits in the film's 1 s: it emits nothing",
        ),
        (
            PLUME + "end_s = 0.5\nramp = [{ time_s = 0.5, strength = 0.0 }, { time_s = 0.6, strength = 1.0 }]\n",
            "source[0].ramp: is 0 whenever it emits in the film's 1 s: it emits nothing",
        ),
        (PLUME + "start_s = 2.0\n", "source[0].start_s: starts at 2 s, after the film's end at 1 s"),
        (
            HEAD + SMOKE + "density_dissipation = 400\n" + SOURCE,
            "fire.toml:7 smoke[0].density_dissipation: 400 1/s leaves 1 % after 0.012 s, less than a frame of 0.017 s: "
            "no smoke is to be seen; use well below 2.8e+02 1/s",
        ),
        (
            HEAD + SMOKE + "cooling = 1000\n" + SOURCE,
            "fire.toml:7 smoke[0].cooling: 1000 1/s leaves 1 % after 0.0046 s, less than a frame of 0.017 s: no heat "
            "is left to rise; use well below 2.8e+02 1/s",
        ),
        (
            HEAD + SMOKE + "projection_tolerance = 1e-9\n" + SOURCE,
            "fire.toml:7 smoke[0].projection_tolerance: 1e-09 is below what single precision reaches, about 2e-07: "
            "solves will hit their iteration limit",
        ),
        (
            HEAD + "gravity = [0.0, 0.0, 0.0]\n" + SMOKE + SOURCE,
            'fire.toml:3 gravity: is zero, so heat and weight do not move smoke "plume", and nothing else does: it '
            "stays where it comes from; give its source a velocity, or the smoke wind",
        ),
        (
            HEAD + SMOKE + PATH.replace("radius = 0.1", "radius = 0.02"),
            "source[0]: is thinner than a cell of 0.05 m and may emit nothing; enlarge it",
        ),
    ],
)
def test_smoke_that_may_be_unintended_is_told_with_this_line(text, expected, tmp_path):
    errors, warnings, _ = checked(text, tmp_path / "fire.toml")
    assert errors == []
    assert any(warning.endswith(expected) for warning in warnings), warnings


@pytest.mark.parametrize(
    "text",
    [
        HEAD + "gravity = [0.0, 0.0, 0.0]\n" + SMOKE + "wind = [1.0, 0.0, 0.0]\n" + SOURCE,
        HEAD + "gravity = [0.0, 0.0, 0.0]\n" + SMOKE + SOURCE + "velocity = [1.0, 0.0, 0.0]\n",
        # There is a way over the wall.
        HEAD + SMOKE + "wind = [1.0, 0.0, 0.0]\n" + SOURCE + WALL,
        # The path comes in from outside.
        HEAD + SMOKE + PATH,
        # On a body that is there, of either kind, and out of it.
        PLUME + 'follow = "ball"\n' + BALL,
        PLUME + 'follow = "ball"\n' + BALL + 'kind = "dynamic"\ndensity = 500.0\n',
        PLUME + 'follow = "ball"\n' + BALL + 'kind = "kinematic"\nvelocity = [0.1, 0.0, 0.0]\n',
    ],
)
def test_smoke_that_is_meant_passes_without_a_word(text, tmp_path):
    assert checked(text, tmp_path / "fire.toml")[:2] == ([], [])


def test_two_smokes_share_the_memory(tmp_path):
    second = (SMOKE + SOURCE).replace("plume", "fog")
    room = 320 * 12_000
    assert checked(PLUME, tmp_path / "fire.toml", memory_bytes=room).errors == []
    errors = checked(PLUME + second, tmp_path / "fire.toml", memory_bytes=room).errors
    assert len(errors) == 1
    assert errors[0].startswith(
        "fire.toml:14 smoke[1].cell_size: 8000 cells need 0.00256 GB, this machine has 0.00384 GB"
    )
    assert "at most 4000 fit beside the 8000 of other smoke" in errors[0]
    size = re.search(r"use ([\d.]+) m or more", errors[0]).group(1)
    coarser = second.replace("cell_size = 0.05", f"cell_size = {size}")
    assert checked(PLUME + coarser, tmp_path / "fire.toml", memory_bytes=room).errors == []


@pytest.mark.parametrize(
    ("box", "cell_size"), [("", "0.0009"), ("min = [-50, -50, 0]\nmax = [50, 50, 0.1]\n", "0.003")]
)
def test_a_smoke_has_no_more_cells_than_files_of_it_may_hold_however_much_memory_there_is(box, cell_size, tmp_path):
    domain = "[domain]\nmin = [-50.0, -50.0, 0.0]\nmax = [50.0, 50.0, 1.0]\n" if box else ""

    def errors(cell_size: str, memory_bytes: float) -> tuple[str, ...]:
        smoke = SMOKE.replace("0.05", cell_size) + box.replace("50,", "50.0,").replace("0]", "0.0]")
        text = HEAD + domain + smoke + SOURCE.replace("0.2]", "0.05]")
        return tuple(checked(text, tmp_path / "fire.toml", memory_bytes=memory_bytes).errors)

    (error,) = errors(cell_size, 10**14)
    assert "cells are more than a smoke may have, 1.07 billion; use " in error
    size = re.search(r"use ([\d.]+) m or more", error).group(1)
    assert errors(size, 10**14) == ()
    # With less memory than so many cells need, that is what counts.
    (error,) = errors(cell_size, 10**10)
    assert "cells need" in error


@pytest.mark.parametrize("extent", [0.3, 0.0999, 1.0 / 7.0])
def test_the_size_that_is_suggested_for_a_thin_box_is_small_enough(extent, tmp_path):
    text = HEAD + SMOKE.replace("0.05", "0.09") + f"min = [-0.5, -0.5, 0.0]\nmax = [0.5, 0.5, {extent!r}]\n"
    text += SOURCE.replace("0.2]", "0.05]")
    errors = [error for error in checked(text, tmp_path / "fire.toml").errors if "fewer than 4 cells" in error]
    assert len(errors) == 1
    size = re.search(r"use ([\d.]+) m or less", errors[0]).group(1)
    assert 0.9 * extent / 4 <= float(size) <= extent / 4
    assert checked(text.replace("0.09", size, 1), tmp_path / "fire.toml").errors == []


def test_a_flat_box_on_a_gpu_counts_the_lanes_of_its_rows():
    job = Job.model_validate(
        {
            "name": "a",
            "frames": 2,
            "smoke": [
                {
                    **{"name": "fog", "cell_size": 0.01, "min": (-0.5, -0.5, 0.0), "max": (0.5, 0.5, 0.04)},
                    "source": [{"shape": {"type": "box", "size": (0.1, 0.1, 0.02)}, "position": (0.0, 0.0, 0.02)}],
                }
            ],
        },
        strict=False,
    )

    def errors(cell_size: float, *, on_gpu: bool) -> list[str]:
        smoke = job.smoke[0].model_copy(update={"cell_size": cell_size})
        findings = Findings()
        budget = MemoryBudget(15_000_000, "the GPU" if on_gpu else "this machine", on_gpu=on_gpu)
        check_smokes(job.model_copy(update={"smoke": (smoke,)}), {}, budget, findings)
        return [problem.message for problem in findings.errors]

    # 100 x 100 x 4 cells of 250 bytes are 10 MB, and of 320 on a CPU 12.8; 10,000 rows with 32 lanes of 8 bytes in five
    # reductions are 12.8 MB.
    assert errors(0.01, on_gpu=False) == []
    (error,) = errors(0.01, on_gpu=True)
    assert error.startswith("40000 cells need 0.0228 GB, the GPU has 0.015 GB; at most 26315 fit: use ")
    size = float(re.search(r"use ([\d.]+) m or more", error).group(1))
    # Four layers must remain, which is told as well; this is about memory.
    assert not [told for told in errors(size, on_gpu=True) if "need" in told]
    assert [told for told in errors(0.9 * size, on_gpu=True) if "need" in told]


@pytest.mark.parametrize(("size", "expected"), [(0.12, 0.2), (0.2, 0.2), (0.5, 0.5)])
def test_a_preview_has_gusts_that_its_cells_can_carry(size, expected, tmp_path):
    path = tmp_path / "fire.toml"
    path.write_text(HEAD + SMOKE + f"turbulence = {{ strength = 1.0, size = {size} }}\n" + SOURCE)
    assert load_checked_job(path)[1].errors == load_checked_job(path, preview=True)[1].errors == []
    assert read_job(path, preview=True).job.smoke[0].turbulence.size == pytest.approx(expected)


def test_the_starter_of_smoke_passes(tmp_path):
    text = starter("film", "smoke", file="film.toml")
    assert checked(text, tmp_path / "film.toml")[:2] == ([], [])
