"""What `check` tells of soft matter."""

import pytest
from command_line import pipeline

from pipeline.job.loading import load_job
from pipeline.kinds.soft import BASE_BYTES, BYTES_PER_PARTICLE, MATTER

JOB = """\
name = "it"
frames = 2
[domain]
min = [-0.5, -0.5, 0.0]
max = [0.5, 0.5, 1.0]
[[soft]]
name = "jelly"
material = "jelly"
cell_size = 0.02
[[soft.block]]
shape = { type = "box", size = [0.2, 0.2, 0.2] }
position = [0.0, 0.0, 0.1]
"""

BODY = '[[rigid]]\nname = "plate"\nshape = { type = "box", size = [0.3, 0.3, 0.03] }\nposition = [0.0, 0.0, 0.4]\n'


def told(tmp_path, text: str, *options: str) -> tuple[int, str]:
    path = tmp_path / "it.toml"
    path.write_text(text)
    result = pipeline("check", path, *options)
    return result.exit_code, result.output


def test_a_cube_of_jelly_is_fine_and_counted(tmp_path):
    code, output = told(tmp_path, JOB)
    assert code == 0
    assert "about 8,000 particles of soft matter" in output
    assert "warning" not in output


@pytest.mark.parametrize(
    ("option", "expected"),
    [
        (
            "soft.jelly.young_modulus=1e9",
            "1e+09 Pa need steps of 1.3e-06 s, 13,000 a frame; 4.3e+08 Pa or less would do",
        ),
        ("soft.jelly.yield_stress=10.0", 'yield_stress is for material = "clay" or "dough" or "cream"'),
        ("soft.jelly.poisson_ratio=0.5", "poisson_ratio"),
        ("soft.jelly.block.0.position=[0,0,5]", "has no particle: it is outside the domain"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path, option, expected):
    finer = ("--set", "soft.jelly.cell_size=0.005") if "modulus" in option else ()
    code, output = told(tmp_path, JOB, "--set", option, *finer)
    assert code == 2
    assert expected in output


def test_what_is_too_thin_for_the_grid_is_told_with_the_cells_that_would_do(tmp_path):
    code, output = told(tmp_path, JOB + BODY)
    assert code == 0
    assert "is 0.03 m thin, less than 3 cells of soft matter, 0.02 m" in output
    assert "use soft.cell_size = 0.01 or less" in output
    _, output = told(tmp_path, JOB, "--set", "soft.jelly.block.0.shape.size=[0.2,0.2,0.05]")
    assert "is 0.05 m thin, less than 3 cells of 0.02 m, and will be too stiff" in output


def test_cloth_passes_the_checks_and_fluid_beside_both_is_refused_by_name(tmp_path):
    cloth = '[[cloth]]\nname = "sheet"\nposition = [0.0, 0.0, 0.6]\n'
    cloth += 'shape = { type = "rectangle", size = [0.3, 0.3], resolution = 0.05 }\n'
    code, output = told(tmp_path, JOB + cloth)
    assert (code, "warning" in output) == (0, False), output
    fluid = '[[fluid]]\nname = "water"\nparticle_radius = 0.02\n[[fluid.block]]\n'
    fluid += 'shape = { type = "box", size = [0.2, 0.2, 0.1] }\nposition = [0.3, 0.0, 0.05]\n'
    code, output = told(tmp_path, JOB + cloth + fluid)
    assert code == 2
    assert "soft[0]: meets cloth, and meets fluid, but not both in one job: fluid would not feel the cloth" in output


def test_cells_are_told_that_fluid_slips_through_or_that_are_far_finer_than_it(tmp_path):
    fluid = '[[fluid]]\nname = "water"\nparticle_radius = 0.01\n[[fluid.block]]\n'
    pool = JOB + fluid + 'shape = { type = "box", size = [1.0, 1.0, 0.1] }\nposition = [0.0, 0.0, 0.05]\n'
    code, output = told(tmp_path, pool, "--set", "soft.jelly.cell_size=0.04")
    assert code == 0
    assert "warning" not in output  # water makes room for the jelly in it
    code, output = told(tmp_path, pool, "--set", "soft.jelly.cell_size=0.06")
    assert code == 2
    assert (
        "cell_size: of 0.06 m would let fluid through, whose particles are 0.02 m apart; use 0.05 m or less" in output
    )
    code, output = told(tmp_path, pool, "--set", "soft.jelly.cell_size=0.015")
    assert code == 0
    assert "each of these feels some 318 of soft matter where they touch; use 0.04 m" in output


EMITTER = """\
[[soft.emitter]]
shape = { type = "disc", radius = 0.05 }
position = [0.0, 0.0, 0.6]
direction = [0.0, 0.0, -1.0]
flow_rate = 0.004
total_volume = 0.002
"""


def test_what_emitters_pour_is_counted_and_their_openings_are_looked_at(tmp_path):
    code, output = told(tmp_path, JOB + EMITTER, "--set", "frames=60")
    assert code == 0
    assert "about 10,000 particles of soft matter" in output
    for option, expected in (
        ("position=[0.0,0.0,1.2]", "soft[0].emitter[0]: 78 of the 78 places of its opening are outside the domain"),
        ("position=[0.0,0.0,0.1]", "78 of the 78 places of its opening are in a solid body; move it out"),
        ("shape.radius=0.003", "soft[0].emitter[0].shape: is too narrow for particles 0.01 m apart; enlarge it or"),
        ("start_s=2.0", "soft[0].emitter[0].start_s: starts at 2 s, after the film's end at 0.0333333 s"),
    ):
        _, output = told(tmp_path, JOB + EMITTER, "--set", f"soft.jelly.emitter.0.{option}")
        assert expected in output


def test_openings_whose_keyframes_leave_the_domain_are_refused(tmp_path):
    path = "soft.jelly.emitter.0.keyframe=[{time_s=0.0,position=[0.0,0.0,0.6]},{time_s=0.5,position=[0.0,0.0,%s]}]"
    moving = JOB + EMITTER.replace("position = [0.0, 0.0, 0.6]\n", "")
    code, output = told(tmp_path, moving, "--set", path % "0.9")
    assert code == 0, output
    code, output = told(tmp_path, moving, "--set", path % "1.5")
    assert code == 2
    assert "soft[0].emitter[0]: its keyframes take its opening out of the domain, where it pours at 0.2" in output


@pytest.mark.parametrize(
    ("option", "code", "expected"),
    [
        ("total_volume=1e-7", 2, "emitter[0].total_volume: makes 1e-07 m³ in all, less than half a particle of 1e-06"),
        ("total_volume=1e-7", 2, "it emits nothing; use more, or cell_size 0.011 m"),
        ("flow_rate=0.5", 0, "emitter[0].flow_rate: 0.5 m³/s through 0.0079 m² is a jet of 63.7 m/s, which crosses"),
        (
            "ramp=[{time_s=1.0,strength=0.0},{time_s=2.0,strength=1.0}]",
            0,
            "is 0 whenever it emits in the film's 0.0333",
        ),
        ("position=[0.3,0.0,0.012]", 0, "a wall or body is 0.015 m before its opening, where the flow needs 0.034 m"),
    ],
)
def test_emitters_are_looked_at_as_those_of_fluids(tmp_path, option, code, expected):
    told_code, output = told(tmp_path, JOB + EMITTER, "--set", f"soft.jelly.emitter.0.{option}")
    assert told_code == code, output
    assert expected in output


def test_a_block_of_a_wild_speed_and_two_openings_in_one_place_are_told(tmp_path):
    code, output = told(tmp_path, JOB, "--set", "soft.jelly.block.0.velocity=[0,0,-500]")
    assert code == 0
    assert "soft[0].block[0].velocity: 500 m/s crosses the whole domain within a frame" in output
    code, output = told(tmp_path, JOB + EMITTER + EMITTER)
    assert code == 2
    assert "soft[0].emitter[1]: is the same opening as soft[0].emitter[0], at the same time" in output


def test_what_comes_after_the_film_counts_for_the_memory_of_the_solver_alone(tmp_path):
    poured = ("--set", "soft.jelly.block=[]")
    code, output = told(tmp_path, JOB + EMITTER, *poured)
    assert code == 0
    assert "about 133 particles of soft matter" in output  # 0.004 m³/s for 1/30 s, of 2,000 in all
    job = load_job(tmp_path / "it.toml", ["soft.jelly.block=[]"])
    assert MATTER.memory_bytes(job, job.soft[0]) == pytest.approx(BASE_BYTES + BYTES_PER_PARTICLE * 133.3, rel=1e-6)
    code, output = told(tmp_path, JOB + EMITTER, *poured, "--set", "soft.jelly.emitter.0.total_volume=100")
    assert code == 2
    assert "100 million particles of soft matter need 56 GB" in output
