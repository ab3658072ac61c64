"""What is kept of a session: the job with the values found, and takes, whose frames later stages find."""

import json

import numpy as np
import pytest
from click.testing import CliRunner
from live_jobs import BALL_OVER_SHEET, loaded

from pipeline.cache import read_frame
from pipeline.cli import main
from pipeline.job.checks import load_checked_job
from pipeline.job.loading import load_job
from pipeline.layout import JobLayout
from pipeline.live.saving import save_job
from pipeline.live.scene import live_job
from pipeline.live.session import Session
from pipeline.live.take import Recorder
from pipeline.resources import machine_capacity
from pipeline.stage_run import run_stage

pytestmark = pytest.mark.usefixtures("taichi")

STAGES = "pipeline.stages:STAGES"


def test_a_saved_job_has_the_values_and_all_remarks_and_passes_the_check(tmp_path):
    read = loaded(tmp_path)
    session = Session(live_job(read.job, substeps=5))
    session.turn("cloth.sheet.stretch_stiffness", 750.0)
    session.turn("cloth.sheet.wind", (1.0, 0.0, 0.5))
    session.turn("rigid.ball.density", 900.0)
    path = save_job(read, session.values, tmp_path)
    text = path.read_text()
    assert path.name == "drape-live.toml"
    assert "# what nobody may lose: a remark" in text
    assert "# soft" in text
    job = load_checked_job(path)[0].job  # which raises what is wrong with it
    assert (job.name, job.cloth[0].substeps, job.cloth[0].stretch_stiffness) == ("drape-live", 5, 750.0)
    assert (job.cloth[0].wind, job.rigid[0].density) == ((1.0, 0.0, 0.5), 900.0)
    assert job.rigid[1].kind == "static"
    again = Session(live_job(job))  # what it is saved as is what it becomes
    assert again.values == {**session.values}
    assert save_job(read, session.values, tmp_path).name == "drape-live-2.toml"


def test_a_take_is_a_job_whose_frames_are_there_and_are_never_simulated_again(tmp_path):
    read = loaded(tmp_path, BALL_OVER_SHEET.replace('name = "drape"', 'name = "drape"\nduration = 2.0'))
    session = Session(live_job(read.job))
    recorder = Recorder(read, session, tmp_path / "renders", device="cpu")
    session.advance()
    assert recorder.toggle()
    session.grab_body("post", (0.4, 0.0, 0.1))
    session.drag("body", "post", (0.4, 0.0, 0.3))
    for _ in range(3):
        session.advance()
    expected = session.bodies()
    assert not recorder.toggle()
    folder = tmp_path / "renders" / "drape-take"
    assert str(folder / "job.toml") in session.message

    job = load_job(folder / "job.toml")
    assert (job.name, job.frame_count) == ("drape-take", 4)
    assert job.rigid[1].kind == "kinematic"  # the renderer asks each frame where it is
    assert json.loads((folder / "take.json").read_text())["take"] == job.recorded
    layout = JobLayout(folder)
    frame = read_frame(layout.path(layout.frame_cache(3)))
    for name, snapshot in expected.items():
        np.testing.assert_array_equal(frame.bodies[name].arrays["position"], snapshot.arrays["position"])

    def run(stage: str):
        return run_stage(
            job, layout, stage, capacity=machine_capacity(), stages=STAGES, stop_requested=lambda: False,
            tell=lambda _share, _sentence: None,
        )  # fmt: skip

    assert run("simulate").up_to_date == 1
    assert run("cloth").ran == 4
    layout.path(layout.frame_cache(2)).unlink()
    (failed,) = run("simulate").failures
    assert "no computation can make it anew" in failed.message
    assert not layout.path(layout.frame_cache(2)).exists()
    again = CliRunner().invoke(main, ["rerun", str(folder), "--stage", "simulate"])
    assert again.exit_code == 1
    assert "it cannot be simulated again" in again.output


def test_a_reset_ends_a_take_with_what_was_before_it(tmp_path):
    read = loaded(tmp_path)
    session = Session(live_job(read.job))
    recorder = Recorder(read, session, tmp_path, device="cpu")
    recorder.toggle()
    session.advance()
    session.reset()
    assert not recorder.is_recording
    assert load_job(tmp_path / "drape-take" / "job.toml").frame_count == 2
    session.advance()  # nobody records any more
    assert len(list((tmp_path / "drape-take" / "cache").glob("[0-9]*.h5"))) == 2
