"""`--preview` enlarges the cells of smoke as far as what is in it allows."""

import pytest
import trimesh
from checked_jobs import PLUME_FROM_A_BALL, load_checked_job

from pipeline.base.errors import JobFileError

PLUME = PLUME_FROM_A_BALL.replace(
    '{ type = "sphere", radius = 0.1 }', '{ type = "cylinder", radius = 0.1, height = 0.1 }'
)
THIN_SOURCE = PLUME.replace("height = 0.1", "height = 0.03").replace("[0.0, 0.0, 0.2]", "[0.0, 0.0, 0.04]")
PADDLE = """
[[rigid]]
name = "paddle"
shape = { type = "box", size = [0.3, 0.3, 0.03] }
position = [0.0, 0.3, 0.505]
"""
MOVES = 'kind = "kinematic"\nvelocity = [0.1, 0.0, 0.0]\n'


BURNER = """
[[rigid]]
name = "burner"
shape = { type = "box", size = [0.4, 0.4, 0.1] }
position = [0.0, 0.0, 0.05]
"""
# 0.025 m thick and turned: a column along z crosses 0.0272 m of it.
LEANING = PADDLE.replace("0.3, 0.3, 0.03]", "0.6, 0.6, 0.025]") + "rotation_deg = [20.0, 12.0, 0.0]\n"
# From 0.089 to 0.109 m, above 0.1 m in free air.
ON_BURNER = PLUME.replace("height = 0.1", "height = 0.02").replace("[0.0, 0.0, 0.2]", "[0.0, 0.0, 0.099]")
FINE = ("cell_size = 0.02", "cell_size = 0.01")


def preview(text, folder):
    """Cell size of a job's preview [m], which has no errors."""
    path = folder / "job.toml"
    path.write_text(text)
    load_checked_job(path)
    loaded, _ = load_checked_job(path, preview=True)
    return loaded.job.smoke[0].cell_size


@pytest.mark.parametrize(
    ("text", "cell_size"),
    [
        (PLUME, 0.04),
        # It is from 0.025 to 0.055 m; centres of cells are at 0.02 and 0.06 m, or at 0.0525 m.
        (THIN_SOURCE, 0.035),
        (PLUME + PADDLE.replace("0.505", "0.5"), 0.035),
        (PLUME + PADDLE.replace("0.505", "0.52"), 0.04),  # corners of such cells lie in it
        (PLUME + PADDLE + MOVES, 0.03),
        (PLUME + LEANING, 0.025),
        (PLUME + LEANING + MOVES, 0.025),
        # Air passes through it in the cells as written.
        (PLUME + LEANING.replace("0.025]", "0.015]"), 0.04),
        # Centres are at 0.105 m as written, at 0.09, 0.09625 and 0.0975 m in larger cells, and at 0.10625 m in these.
        (ON_BURNER.replace(*FINE) + BURNER, 0.0125),
        # It never comes into the smoke's box.
        (PLUME.replace("[[smoke.source]]", "max = [0.5, 0.5, 0.28]\n[[smoke.source]]") + PADDLE + MOVES, 0.04),
        # Four cells high, at least.
        (PLUME.replace("[[smoke.source]]", "min = [-0.5, -0.5, 0.1]\nmax = [0.5, 0.5, 0.25]\n[[smoke.source]]"), 0.035),
    ],
)
def test_cells_of_a_preview_are_as_large_as_sources_and_bodies_allow(text, cell_size, tmp_path):
    assert preview(text, tmp_path) == pytest.approx(cell_size)


def test_a_source_that_moves_emits_in_a_preview_too(tmp_path):
    way = "keyframe = [{ time_s = 0, position = [0, 0, 0.2] }, { time_s = 1, position = [0, 0, 0.4] }]\n"
    path = tmp_path / "job.toml"
    path.write_text(PLUME.replace("height = 0.1", "height = 0.03").replace("position = [0.0, 0.0, 0.2]\n", way))
    assert load_checked_job(path, preview=True)[1].warnings == []


def test_a_mesh_beside_the_job_is_looked_at_too(tmp_path):
    trimesh.creation.box((0.3, 0.3, 0.03)).export(tmp_path / "paddle.obj")
    mesh = PADDLE.replace('{ type = "box", size = [0.3, 0.3, 0.03] }', '{ type = "mesh", file = "paddle.obj" }')
    assert preview(PLUME + mesh + MOVES, tmp_path) < 0.035


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (PLUME + PADDLE.replace("0.03]", "0.01]") + MOVES, "job.toml:15 rigid[0]: is 0.01 m thin"),
        (PLUME.replace("cell_size = 0.02", "cell_size = 1e-6") + PADDLE, "--preview smoke[0].cell_size: "),
    ],
)
def test_what_the_written_cells_are_wrong_for_is_told_with_one_line(text, told, tmp_path):
    path = tmp_path / "job.toml"
    path.write_text(text)
    with pytest.raises(JobFileError) as error:
        load_checked_job(path, preview=True)
    (problem,) = error.value.problems
    assert problem.startswith(told)


def test_a_preview_of_a_guided_smoke_is_its_guide(tmp_path):
    # Its cells are those of the guide even where half of the film's would do.
    guided = PLUME.replace(
        "cell_size = 0.02", "cell_size = 0.02\nupres = 3\nturbulence = { strength = 1.0, size = 0.1 }"
    )
    path = tmp_path / "job.toml"
    path.write_text(guided)
    written = load_checked_job(path)[0].job.smoke[0]
    assert load_checked_job(path, preview=True)[0].job.smoke[0] == written.guide
    assert (written.guide.cell_size, written.guide.turbulence.size) == pytest.approx((0.06, 0.12))
