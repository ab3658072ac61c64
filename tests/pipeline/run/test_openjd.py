"""Hand-over to other farms: the template is valid, and running it gives what `submit` gives."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from synthetic_jobs import job_text, run_synthetic
from synthetic_stages import REFERENCE, STAGES, step_artifact, write_faults

from pipeline.base.errors import PipelineError
from pipeline.base.layout import JobLayout
from pipeline.base.task import FailureKind, Resources, TaskId
from pipeline.job.loading import load_job
from pipeline.run.events import JobOutcome
from pipeline.run.executors.inline import InlineExecutor
from pipeline.run.plan import plan_job
from pipeline.run.single_stage import StageOutcome, run_stage
from pipeline.show.openjd import job_template
from pipeline.store.receipts import read_receipt

OPENJD = Path(sys.executable).with_name("openjd")
CPU = ("--set", "device=cpu", "--set", "render.device=cpu")
JOB = """
name = "small"
frames = 3

[[rigid]]
name = "ball"
shape = { type = "sphere", radius = 0.1 }
position = [0.0, 0.0, 0.5]
kind = "dynamic"
density = 500.0

[[smoke]]
name = "plume"
min = [-0.3, -0.3, 0.0]
max = [0.3, 0.3, 0.6]
cell_size = 0.06
source = [{ shape = { type = "sphere", radius = 0.1 }, position = [0.0, 0.0, 0.2] }]

[render]
resolution = [32, 18]
samples = 1
"""


def run(*command: object) -> str:
    ended = subprocess.run([*map(str, command)], capture_output=True, text=True, check=False, timeout=500)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return ended.stdout


def pipeline(*arguments: object) -> str:
    return run(sys.executable, "-m", "pipeline", *arguments)


@pytest.fixture
def synthetic(tmp_path) -> JobLayout:
    layout = JobLayout(tmp_path / "job")
    layout.root.mkdir()
    layout.job_file.write_text(job_text())
    return layout


def template_of(layout: JobLayout) -> dict[str, Any]:
    return job_template("synthetic", plan_job(load_job(layout.job_file), layout, STAGES), python="/opt/python")


def steps_of(layout: JobLayout) -> dict[str, dict[str, Any]]:
    return {step["name"]: step for step in template_of(layout)["steps"]}


def run_frames(layout: JobLayout, stage: str, frames: set[int] | None = None, stop: bool = False) -> StageOutcome:
    return run_stage(
        load_job(layout.job_file),
        layout,
        stage,
        None if frames is None else frozenset(frames),
        capacity=Resources(cores=1),
        stages=REFERENCE,
        stop_requested=lambda: stop,
        tell=lambda *_: None,
    )


# --- the template ---


def test_a_step_a_stage_that_depends_on_those_it_reads(synthetic):
    steps = steps_of(synthetic)
    assert list(steps) == ["steps", "double", "film"]
    assert [step.get("dependencies") for step in steps.values()] == [
        None,
        [{"dependsOn": "steps"}],
        [{"dependsOn": "double"}],
    ]


def test_frames_that_do_not_depend_on_each_other_are_cut_into_chunks(synthetic):
    steps = steps_of(synthetic)
    [parameter] = steps["double"]["parameterSpace"]["taskParameterDefinitions"]
    assert (parameter["type"], parameter["range"]) == ("CHUNK[INT]", "0-5")
    assert steps["double"]["script"]["actions"]["onRun"]["args"][-2:] == ["--frames", "{{Task.Param.Frames}}"]
    assert "parameterSpace" not in steps["steps"]
    assert "parameterSpace" not in steps["film"]


def test_the_reference_runtime_accepts_the_template(synthetic):
    path = synthetic.root / "openjd.json"
    template = template_of(synthetic)
    path.write_text(json.dumps(template))
    assert "passes validation checks" in run(OPENJD, "check", path)
    template["steps"][1]["dependencies"] = [{"dependsOn": "absent"}]
    path.write_text(json.dumps(template))
    assert subprocess.run([str(OPENJD), "check", str(path)], capture_output=True, check=False).returncode != 0


# --- running a stage by itself ---


def test_stages_run_one_by_one_give_what_a_run_gives_and_are_taken_over(synthetic, tmp_path):
    assert run_frames(synthetic, "steps").ran == 1
    assert run_frames(synthetic, "double", {3, 4, 5}).ran == 3
    assert run_frames(synthetic, "double", {0, 1, 2, 3}) == StageOutcome(3, 1, ())
    assert run_frames(synthetic, "film").ran == 1
    with InlineExecutor() as executor:
        run_synthetic(tmp_path / "run", executor)
        assert (tmp_path / "run" / "film.bin").read_bytes() == (synthetic.root / "film.bin").read_bytes()
        outcome = run_synthetic(synthetic.root, executor)
    assert (outcome.kind, outcome.ran) == (JobOutcome.SUCCEEDED, 0)


def test_a_stage_whose_inputs_are_missing_or_damaged_says_so(synthetic):
    with pytest.raises(PipelineError, match=r"double/000000 needs steps/000000.bin: it was never made; run the stage"):
        run_frames(synthetic, "double", {0})
    run_frames(synthetic, "steps")
    (synthetic.root / "steps" / "000002.bin").write_bytes(b"cut")
    with pytest.raises(PipelineError, match=r"steps/000002.bin: file was edited or truncated"):
        run_frames(synthetic, "double", {2})


def test_a_failing_frame_does_not_stop_the_others_and_is_tried_again(synthetic):
    run_frames(synthetic, "steps")
    write_faults(synthetic.root, {"double/000001": ["fail"]})
    outcome = run_frames(synthetic, "double")
    assert (outcome.ran, [failed.task_id for failed in outcome.failures]) == (5, ["double/000001"])
    assert run_frames(synthetic, "double") == StageOutcome(1, 5, ())


def test_a_full_disk_ends_it(synthetic):
    run_frames(synthetic, "steps")
    write_faults(synthetic.root, {"double/000001": ["disk full"]})
    outcome = run_frames(synthetic, "double")
    assert (outcome.ran, [failed.kind for failed in outcome.failures]) == (1, [FailureKind.DISK_FULL])
    assert outcome.up_to_date == 0  # those after it were not looked at


def test_a_stage_that_is_stopped_continues_later(synthetic):
    outcome = run_frames(synthetic, "steps", stop=True)
    assert [failed.kind for failed in outcome.failures] == [FailureKind.CANCELLED]
    assert run_frames(synthetic, "steps").ran == 1


def test_every_try_has_a_number_of_its_own_also_beside_others(synthetic):
    """The number of a try that was killed, or that another machine has just begun, has no receipt yet."""
    log = synthetic.log(TaskId("steps"), 1)
    log.parent.mkdir()
    log.write_text("somebody else's")
    run_frames(synthetic, "steps")
    assert log.read_text() == "somebody else's"
    receipt = read_receipt(synthetic, step_artifact(0))
    assert receipt is not None
    assert receipt.attempt == 2


# --- the commands ---


@pytest.mark.slow
def test_a_job_run_by_the_reference_runtime_has_the_same_frames(tmp_path):
    (tmp_path / "small.toml").write_text(JOB)
    pipeline("export", tmp_path / "small.toml", "--to", "openjd", "--farm", tmp_path / "farm", *CPU)
    template = tmp_path / "farm" / "small" / "openjd.json"
    run(OPENJD, "check", template)
    told = run(OPENJD, "run", template, "--step", "movie", "--run-dependencies", "--job-param", "ChunkFrames=2")
    assert "openjd_progress: 100.0" in told
    pipeline("submit", tmp_path / "small.toml", "--farm", tmp_path / "here", *CPU)
    here, farm = (sorted((tmp_path / name / "small" / "frames").iterdir()) for name in ("here", "farm"))
    assert len(farm) == 3
    assert [path.read_bytes() for path in farm] == [path.read_bytes() for path in here]
