"""Jobs with smoke that cannot be meant, each told with its line before anything runs."""

import re

import pytest
from checked_jobs import BALL, PLUME, checked, load_checked_job, says

from pipeline.base.errors import JobFileError
from pipeline.job.loading import read_job
from pipeline.kinds.checks.memory_budget import MemoryBudget
from pipeline.kinds.checks.smoke import check_smokes
from pipeline.model.job import Job
from pipeline.model.problems import Findings

HEAD = 'name = "fire"\nframes = 60\n'
SMOKE, SOURCE = (PLUME[: PLUME.index("[[smoke.s")], "\n" + PLUME[PLUME.index("[[smoke.s") :])
FIRE = HEAD + SMOKE + SOURCE
BODY = BALL.replace("0.1 }", "0.15 }").replace("0.1]", "0.2]")
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


def with_keys(keys: str, source: str = SOURCE) -> str:
    """A job whose smoke has further keys."""
    return HEAD + SMOKE + keys + "\n" + source


def burning(fire: str, source: str = "fuel = 1.0") -> str:
    """A job whose source gives fuel that burns with these keys."""
    return FIRE + f"temperature = 700.0\n{source}\n\n[smoke.fire]\n{fire}\n"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (FIRE.replace("0.2]", "9.0]"), "8 smoke[0].source[0]: is wholly outside ... z 8.9..9.1 m ... z 0..1 m"),
        (FIRE.replace("radius = 0.1", "radius = 0.01"), "8 smoke[0].source[0]: holds no centre ... 0.02 m ... 0.05 m"),
        (FIRE + BODY, "8 smoke[0].source[0]: lies wholly inside solid bodies"),
        (FIRE + 'follow = "bal"\n' + BODY, '11 smoke[0].source[0].follow: ... "bal"; did you mean "ball"?'),
        # Along the body's axes that is a good place; from the domain's origin it is outside.
        (FIRE.replace("0.2]", "-0.3]") + 'follow = "bal"\n' + BODY, "11 smoke[0].source[0].follow: "),
        (FIRE + 'follow = "ball"\n', '11 smoke[0].source[0].follow: ... "ball"; add [[rigid]]'),
        (
            FIRE.replace("0.2]", "0.0]").replace("0.1 }", "0.05 }") + f'follow = "ball"\n{BODY}kind = "kinematic"\n',
            "8 smoke[0].source[0]: lies wholly inside rigid[0], which it follows",
        ),
        (
            HEAD + SMOKE + PATH.replace("[0.0, 0.0, 0.5]", "[-1.0, 0.0, 0.5]"),
            "8 smoke[0].source[0]: never comes ... x -2.346..-0.6536 y -0.3464..0.3464 z 0.1536..0.8464 m, not x -0.5",
        ),
        (burning("heat = 20000.0"), "15 smoke[0].fire.heat: makes flames of 20700 K, beyond 10000 K"),
        (with_keys("wind = [0.0, 0.0, 2.0]"), '7 smoke[0].wind: ... "z-", which is closed; add it to open_faces'),
        (
            with_keys('wind = [2.0, 0.0, 0.0]\nopen_faces = ["x-"]'),
            "7 smoke[0].wind: ... x-, and no other side",
        ),
        (
            with_keys('wind = [2.0, 0.0, 0.0]\nopen_faces = ["x-", "x+"]') + WALL,
            "7 smoke[0].wind: ... x-, but solids that stand still cut air there off ... leave a way around them",
        ),
        (
            with_keys("upres = 4").replace("radius = 0.1", "radius = 0.05"),
            "7 smoke[0].upres: in ... cells of 0.2 m: smoke[0].source[0] holds no",
        ),
        (with_keys("upres = 4\nmax = [0.5, 0.5, 0.5]"), "7 smoke[0].upres: 4 leaves the guide fewer than"),
        (with_keys("turbulence = { strength = 1.0, size = 0.06 }"), "7 smoke[0].turbulence.size: 0.06 m ... use 0.1 m"),
        (FIRE + "temperature = 2e4\n", "11 smoke[0].source[0].temperature: 20000 K is beyond 10000 K"),
    ],
)
def test_smoke_that_cannot_be_is_refused_at_its_place(text, expected, tmp_path):
    (error,) = checked(text, tmp_path / "fire.toml").errors
    assert says(error, f"fire.toml:{expected}")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (FIRE + "temperature = 4500\n", "11 smoke[0].source[0].temperature: 4500 K is hotter than any flame"),
        (FIRE + "temperature = 60\n", "11 smoke[0].source[0].temperature: 60 K is colder than any air"),
        (with_keys("ambient_temperature = 20"), "7 smoke[0].ambient_temperature: 20 K is no air; 20 °C are 293 K"),
        (FIRE + "temperature = 293\ndensity = 0.0\n", "8 smoke[0].source[0]: has no density ... emits nothing"),
        (burning("heat = 5000.0"), "15 smoke[0].fire.heat: makes flames of 5700 K, hotter than any"),
        (
            burning("soot = 0.0", "fuel = 1.0\ndensity = 0.0"),
            "16 smoke[0].fire.soot: is 0, and no source has a density",
        ),
        (FIRE + "ramp = [{ time_s = 1.0, strength = 0.0 }]\n", "11 smoke[0].source[0].ramp: is 0 ... film's 1 s"),
        (
            # It grows after the film of 1 s only.
            FIRE + "ramp = [{ time_s = 2.0, strength = 0.0 }, { time_s = 3.0, strength = 1.0 }]\n",
            "11 smoke[0].source[0].ramp: is 0 ... film's 1 s",
        ),
        (
            FIRE + "end_s = 0.5\nramp = [{ time_s = 0.5, strength = 0.0 }, { time_s = 0.6, strength = 1.0 }]\n",
            "12 smoke[0].source[0].ramp: is 0 ... film's 1 s",
        ),
        (FIRE + "start_s = 2.0\n", "11 smoke[0].source[0].start_s: starts at 2 s, after the film's end at 1 s"),
        (
            with_keys("density_dissipation = 400"),
            "7 smoke[0].density_dissipation: 400 1/s ... 0.012 s ... 0.017 s: no smoke is to be seen ... 2.8e+02 1/s",
        ),
        (with_keys("cooling = 1000"), "7 smoke[0].cooling: 1000 1/s leaves 1 % after 0.0046 s ... no heat ... 2.8e+02"),
        (with_keys("projection_tolerance = 1e-9"), "7 smoke[0].projection_tolerance: 1e-09 is below ... 2e-07"),
        (HEAD + "gravity = [0.0, 0.0, 0.0]\n" + SMOKE + SOURCE, '3 gravity: is zero ... smoke "plume"'),
        (
            HEAD + SMOKE + PATH.replace("radius = 0.1", "radius = 0.02"),
            "8 smoke[0].source[0]: is thinner than a cell of 0.05 m",
        ),
    ],
)
def test_smoke_that_may_be_unintended_is_told_at_its_place(text, expected, tmp_path):
    errors, warnings, _ = checked(text, tmp_path / "fire.toml")
    assert errors == []
    assert any(says(warning, f"fire.toml:{expected}") for warning in warnings), warnings


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
        FIRE + 'follow = "ball"\n' + BODY,
        FIRE + 'follow = "ball"\n' + BODY + 'kind = "dynamic"\ndensity = 500.0\n',
        FIRE + 'follow = "ball"\n' + BODY + 'kind = "kinematic"\nvelocity = [0.1, 0.0, 0.0]\n',
    ],
)
def test_smoke_that_is_meant_passes_without_a_word(text, tmp_path):
    assert checked(text, tmp_path / "fire.toml")[:2] == ([], [])


def test_two_smokes_share_the_memory(tmp_path):
    second = (SMOKE + SOURCE).replace("plume", "fog")
    room = 378 * 12_000
    assert checked(FIRE, tmp_path / "fire.toml", memory_bytes=room).errors == []
    errors = checked(FIRE + second, tmp_path / "fire.toml", memory_bytes=room).errors
    assert len(errors) == 1
    assert errors[0].startswith(
        "fire.toml:14 smoke[1].cell_size: 8000 cells need 0.00302 GB, this machine has 0.00454 GB"
    )
    assert "at most 4000 fit beside the 8000 of other smoke" in errors[0]
    size = re.search(r"use ([\d.]+) m or more", errors[0]).group(1)
    coarser = second.replace("cell_size = 0.05", f"cell_size = {size}")
    assert checked(FIRE + coarser, tmp_path / "fire.toml", memory_bytes=room).errors == []


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
        budget = MemoryBudget(15_200_000, "the GPU" if on_gpu else "this machine", on_gpu=on_gpu)
        check_smokes(job.model_copy(update={"smoke": (smoke,)}), {}, budget, findings)
        return [problem.message for problem in findings.errors]

    # 100 x 100 x 4 cells of 250 bytes are 10 MB, of 378 on a CPU 15.12; 10,000 rows with 32 lanes of 8 bytes in five
    # reductions are 12.8 MB.
    assert errors(0.01, on_gpu=False) == []
    (error,) = errors(0.01, on_gpu=True)
    assert error.startswith("40000 cells need 0.0228 GB, the GPU has 0.0152 GB; at most 26666 fit: use ")
    size = float(re.search(r"use ([\d.]+) m or more", error).group(1))
    # Four layers must remain, which is told as well; this is about memory.
    assert not [told for told in errors(size, on_gpu=True) if "need" in told]
    assert [told for told in errors(0.9 * size, on_gpu=True) if "need" in told]


@pytest.mark.parametrize("grid", ["window", "open"])
def test_a_window_needs_memory_for_its_sources_and_not_for_its_box(grid, tmp_path):
    """Ten thousand cells along each edge of the box; the second source is 6 km away, where the window has no end."""
    path = tmp_path / "fire.toml"
    keys = f'grid = "{grid}"\n' + ("max = [500.0, 500.0, 500.0]\n" if grid == "window" else "")
    path.write_text(with_keys(keys))
    assert load_checked_job(path)[1].errors == []
    far = SOURCE.replace("0.2]", "500.0]" if grid == "window" else "6000.0]").replace("[0.0,", "[490.0,", 1)
    path.write_text(with_keys(keys.replace("500.0, 500.0, 500.0", "5000.0, 5000.0, 5000.0"), SOURCE + far))
    with pytest.raises(JobFileError, match=r"cells lie in one window around all sources, and need .* a smoke each"):
        load_checked_job(path)


def test_a_window_needs_memory_for_the_bodies_that_its_air_pushes(tmp_path):
    """A body at the other end of a box of ten thousand cells along each edge; a smaller box leaves it out."""
    path, body = tmp_path / "fire.toml", BODY + 'kind = "dynamic"\ndensity = 300.0\n'
    far = body.replace("0.2]", "490.0]").replace("[0.0, 0.0,", "[490.0, 490.0,", 1)
    open_domain = "[domain]\nmax = [500.0, 500.0, 500.0]\n"
    path.write_text(with_keys('grid = "window"\n', SOURCE + far + open_domain))
    with pytest.raises(JobFileError, match=r"cells lie in one window around all sources and dynamic bodies, and need"):
        load_checked_job(path)
    path.write_text(with_keys('grid = "window"\nmax = [100.0, 100.0, 100.0]\n', SOURCE + far + open_domain))
    assert load_checked_job(path)[1].errors == []


@pytest.mark.parametrize(("size", "expected"), [(0.12, 0.2), (0.2, 0.2), (0.5, 0.5)])
def test_a_preview_has_gusts_that_its_cells_can_carry(size, expected, tmp_path):
    path = tmp_path / "fire.toml"
    path.write_text(HEAD + SMOKE + f"turbulence = {{ strength = 1.0, size = {size} }}\n" + SOURCE)
    assert load_checked_job(path)[1].errors == load_checked_job(path, preview=True)[1].errors == []
    assert read_job(path, preview=True).job.smoke[0].turbulence.size == pytest.approx(expected)


def test_what_a_guide_costs_is_told(tmp_path):
    findings = checked(with_keys("upres = 2"), tmp_path / "fire.toml").findings
    (fact,) = (fact for fact in findings.facts if fact.path == ("smoke", 0, "upres"))
    assert fact.message == (
        "2: a simulation of 1000 cells of 0.1 m guides it, for 16 % more time; --preview draws that one"
    )
    assert not findings.errors and not findings.warnings


def test_a_guide_takes_memory_as_well(tmp_path):
    def needed(upres: int) -> float:
        path, findings = tmp_path / f"{upres}.toml", Findings()
        path.write_text(with_keys(f"upres = {upres}"))
        check_smokes(read_job(path).job, {}, MemoryBudget(1_000_000, "this machine", on_gpu=False), findings)
        (error,) = (problem.message for problem in findings.errors if "need" in problem.message)
        return float(re.search(r"need ([\d.]+) GB", error).group(1))

    assert needed(2) == pytest.approx(1.125 * needed(1), rel=0.01)
