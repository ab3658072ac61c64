"""Which jobs run live, and what the others are told."""

import sys

import pytest
from click.testing import CliRunner
from live_jobs import BALL_OVER_SHEET, loaded

from pipeline.cli import main
from pipeline.errors import PipelineError
from pipeline.live.scene import live_job, require_small


def test_a_scene_that_is_too_large_is_told_what_fits(tmp_path):
    large = live_job(loaded(tmp_path, BALL_OVER_SHEET.replace("[17, 17]", "[401, 401]")).job, substeps=20)
    with pytest.raises(PipelineError, match=r"160,801 cloth nodes at 20 substeps .* about [\d,]+ nodes fit.*--anyway"):
        require_small(large, cores=2, on_gpu=False)
    require_small(live_job(loaded(tmp_path).job), cores=1, on_gpu=False)


def test_bodies_at_rest_can_be_led_but_not_in_a_fluid(tmp_path):
    job = live_job(loaded(tmp_path).job)
    assert [body.kind for body in job.rigid] == ["dynamic", "kinematic"]
    fluid = """
[[fluid]]
name = "water"
particle_radius = 0.04
[[fluid.block]]
shape = { type = "box", size = [0.2, 0.2, 0.2] }
position = [0.0, 0.3, 0.2]
"""
    job = live_job(loaded(tmp_path, BALL_OVER_SHEET + fluid).job)
    assert [body.kind for body in job.rigid] == ["dynamic", "static"]


def test_smoke_and_jobs_where_nothing_moves_are_refused(tmp_path):
    still = 'name = "still"\n[[rigid]]\nname = "box"\nshape = { type = "box", size = [0.1, 0.1, 0.1] }\n'
    with pytest.raises(PipelineError, match="nothing moves in it"):
        live_job(loaded(tmp_path, still).job)
    smoke = """
[[smoke]]
name = "plume"
cell_size = 0.1
[[smoke.source]]
shape = { type = "sphere", radius = 0.1 }
position = [0.0, 0.0, 0.2]
"""
    with pytest.raises(PipelineError, match="smoke does not run live"):
        live_job(loaded(tmp_path, BALL_OVER_SHEET + smoke).job)


def test_without_viser_the_command_says_how_to_get_it(tmp_path, monkeypatch):
    loaded(tmp_path)
    monkeypatch.setitem(sys.modules, "viser", None)
    outcome = CliRunner().invoke(main, ["live", str(tmp_path / "drape.toml")])
    assert outcome.exit_code == 3
    assert "pages in a browser need viser, which is not installed" in outcome.output
