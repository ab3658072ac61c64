"""What a job is expected to take before its first run."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import pipeline
from places import PROJECT

from pipeline.base.layout import JobLayout
from pipeline.base.task import FailureKind, Resources, Task, TaskId
from pipeline.job.loading import load_job
from pipeline.kinds.table import KINDS
from pipeline.model.problems import Findings
from pipeline.queue.cost import Costs, Expectation, Teacher, describe, expect, too_long
from pipeline.queue.disk import Size, size_of
from pipeline.record.reader import StageCost
from pipeline.run.events import Committed, Failed, Finished, RunStarted
from pipeline.run.plan import Assessment, Verdict, assess, plan_job
from pipeline.run.rates import MachineRates, keep, known_rates
from pipeline.stages import STAGES
from pipeline.stages.render import SAMPLES
from pipeline.store.cache import write_frame
from pipeline.store.receipts import Receipt
from sim.core.snapshots import Snapshot
from sim.core.world import FrameReport

REFERENCE = MachineRates(1.0, 2.0, 2)
TWO_CORES = Costs(REFERENCE, Resources(2, 8 * 10**9, 1))

TOOK_S = [
    # job, preview, device, particles at the end, frames made, seconds of the simulation, its peak [MB]
    ("ball_into_cloth", False, "cpu", 0, 150, 85, 395),
    ("campfire", True, "cpu", 0, 240, 73, 310),
    ("cloth_over_bunny", True, "cpu", 0, 90, 59, 412),
    ("cloth_over_sphere", True, "cpu", 0, 180, 146, 769),
    ("dam_break", True, "cpu", 12_439, 150, 84, 269),
    ("dam_break", False, "cuda", 99_268, 150, 35, 487),
    ("drop_on_bunny_dfsph", True, "cpu", 50_000, 124, 217, 322),
    ("drop_on_bunny_dfsph", False, "cuda", 400_000, 69, 43, 554),
    ("drop_on_bunny_wcsph", True, "cpu", 50_000, 71, 238, 326),
    ("drop_on_bunny_wcsph", False, "cuda", 400_000, 59, 43, 586),
    ("duck_in_pool_pcisph", True, "cpu", 86_400, 25, 185, 415),
    ("duck_in_pool_pcisph", False, "cuda", 691_200, 22, 42, 720),
    ("everything", False, "cpu", 31_992, 61, 391, 934),
    ("flag_in_wind", False, "cpu", 0, 240, 152, 461),
    ("floating_bodies", True, "cpu", 17_920, 180, 257, 309),
    ("floating_bodies", False, "cuda", 143_344, 73, 42, 528),
    ("hammock_of_water", False, "cpu", 15_367, 102, 401, 853),
    ("honey", False, "cpu", 13_376, 240, 208, 718),
    ("honey", False, "cuda", 13_376, 150, 43, 540),
    ("quickstart", False, "cpu", 14_265, 60, 198, 410),
    ("smoke_in_box", False, "cpu", 0, 154, 167, 518),
    ("smoke_in_box", False, "cuda", 0, 116, 43, 635),
    ("smoke_moving_duck", True, "cpu", 0, 300, 96, 392),
    ("smoke_past_sphere", True, "cpu", 0, 300, 62, 327),
    ("smoke_past_sphere", False, "cuda", 0, 63, 26, 647),
]
"""Measured on the reference machine: virtual cores of a Xeon server two by two, seven jobs beside each other, and the
H200 beside them; the first with `--preview`, kernels not kept or kept by the job before."""

DROP = """
name = "drop"
frames = 20
[domain]
min = [-0.5, -0.5, 0.0]
max = [0.5, 0.5, 1.0]
[[fluid]]
name = "water"
particle_radius = 0.02
[[fluid.block]]
shape = { type = "box", size = [0.3, 0.3, 0.3] }
position = [0.0, 0.0, 0.5]
"""


def elements_of(job, particles=0):
    counted = {kind.name: sum(kind.elements(job, body) for body in kind.bodies(job)) for kind in KINDS.values()}
    return counted | ({"fluid": particles} if particles else {})


def sized(job, particles=0):
    return size_of(job, Findings(elements=elements_of(job, particles)))


def planned(job, until=()):
    return assess(plan_job(job, JobLayout(Path(job.name)), STAGES, until), {}, {}, parameters=lambda _: None)


def drop(tmp_path, *changes):
    path = tmp_path / "drop.toml"
    path.write_text(DROP)
    return load_job(path, ["device=cpu", *changes])


def simulation(expected: Expectation):
    return next(each for each in expected.stages if each.stage == "simulate")


@pytest.mark.parametrize(("name", "preview", "device", "particles", "frames", "took_s", "peak_mb"), TOOK_S)
def test_simulations_of_the_sample_jobs_take_what_is_expected_within_a_factor_of_two(
    name, preview, device, particles, frames, took_s, peak_mb
):
    job = load_job(PROJECT / "jobs" / f"{name}.toml", [f"device={device}"], preview=preview)
    expected = simulation(expect(job, planned(job, ["simulate"]), sized(job, particles), TWO_CORES))
    # Of frames that were not made nothing is known; what is compiled, is compiled once.
    compiling_s = max(kind.compiling_s for kind in KINDS.values() if kind.bodies(job))
    made_s = (expected.seconds - compiling_s) * frames / job.frame_count
    assert made_s < 2.0 * took_s
    assert made_s + compiling_s > 0.5 * took_s
    assert 0.5 < expected.memory_bytes / (1e6 * peak_mb) < 2.0


def test_every_sample_job_has_a_cost_for_each_of_its_stages():
    for path in sorted((PROJECT / "jobs").glob("*.toml")):
        job = load_job(path, ["device=cpu", "render.device=cpu"])
        expected = expect(job, planned(job), sized(job), TWO_CORES)
        assert {each.stage for each in expected.stages} == {each.task.stage for each in planned(job)}
        assert all(each.seconds > 0.0 and each.memory_bytes >= 0.0 for each in expected.stages)


def test_eight_million_particles_on_two_cores_are_worth_a_warning(tmp_path):
    job = drop(tmp_path, "fluid.water.particle_radius=0.0007")
    warning = too_long(expect(job, planned(job, ["simulate"]), sized(job, 8_000_000), TWO_CORES), job)
    assert warning is not None
    assert "days" in warning
    assert "fluid.particle_radius" in warning
    small = drop(tmp_path)
    assert too_long(expect(small, planned(small), sized(small, 1000), TWO_CORES), small) is None


def test_only_what_is_left_counts_and_goes_by_what_the_job_itself_has_taken(tmp_path):
    job = drop(tmp_path)
    rest = [
        Assessment(each.task, Verdict.UP_TO_DATE)
        if each.task.stage == "simulate" or (each.task.frame or 0) < 10
        else each
        for each in planned(job)
    ]
    own = {"render": StageCost("render", 7.0, 1e6), "surface": StageCost("surface", 0.0, 5.0)}
    expected = expect(job, rest, sized(job, 1000), TWO_CORES, own)
    assert "simulate" not in {each.stage for each in expected.stages}
    render = next(each for each in expected.stages if each.stage == "render")
    assert render.seconds == pytest.approx(10 * 7.0)
    assert render.bytes == pytest.approx(10 * 1e6)
    assert render.is_measured
    # What an earlier version of the job has taken says nothing of this one.
    anew = expect(job, planned(job), sized(job, 1000), TWO_CORES, own)
    assert not next(each for each in anew.stages if each.stage == "render").is_measured


def test_a_job_on_a_gpu_is_told_both_ways(tmp_path):
    job = drop(tmp_path)
    on_gpu = [
        replace(each, task=replace(each.task, resources=Resources(1, 10**9, 1)))
        if each.task.stage in ("simulate", "render")
        else each
        for each in planned(job)
    ]
    size = sized(job, 100_000)
    gpu = expect(job, on_gpu, size, TWO_CORES)
    cpu = expect(job, on_gpu, size, TWO_CORES, without_gpu=True)
    assert gpu.seconds < cpu.seconds
    told = describe(gpu, cpu)
    assert "on the processor" in told
    assert "on the GPU" in told
    assert "GPU" not in describe(cpu, None)


def test_what_was_never_measured_here_is_told_as_a_range(tmp_path):
    job = drop(tmp_path)
    first = expect(job, planned(job, ["simulate"]), sized(job, 1000), TWO_CORES)
    assert " to " in first.time_text
    known = replace(TWO_CORES, rates=REFERENCE.taught("simulate:cpu:wcsph", time=1.0, size=1.0, memory=1.0))
    assert expect(job, planned(job, ["simulate"]), sized(job, 1000), known).time_text.startswith("about ")


def test_samples_are_those_that_blender_is_given():
    settings = (PROJECT / "blender_scripts/settings.py").read_text()
    assert f'"samples": {tuple(SAMPLES.values())},' in settings


@pytest.fixture
def rates(tmp_path, monkeypatch) -> None:
    """Those of the reference are what is known of this machine."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    keep(REFERENCE)


def teacher_of(job, folder: Path, *, particles: int) -> Teacher:
    """Of a job whose first frame is there and has so many particles."""
    layout = JobLayout(folder)
    frame = layout.path(layout.frame_cache(0))
    frame.parent.mkdir(parents=True)
    water = Snapshot("fluid", {"position": np.zeros((particles, 3), np.float32)}, {})
    write_frame(frame, {"water": water}, FrameReport(0, 0.0, {}, {}, {}), device="cpu")
    return Teacher(job, layout, TWO_CORES)


def commit_all(teacher: Teacher, task: Task) -> None:
    for artifact in task.outputs:
        receipt = Receipt(artifact, task.id, task.stage, 1, "", "", size=1000, mtime_ns=0, hash="")
        teacher.notify(Committed(task.id, 1, receipt))


def test_a_run_teaches_how_long_its_work_takes_here(tmp_path, rates):
    job = drop(tmp_path)
    teacher = teacher_of(job, tmp_path / "drop", particles=50_000)
    assert teacher.elements()["fluid"] == 50_000
    tasks = planned(job, ["simulate"])
    usual = simulation(expect(job, tasks, Size({"fluid": 50_000.0}, 1), TWO_CORES)).seconds
    teacher.notify(RunStarted(tasks))
    commit_all(teacher, tasks[0].task)
    teacher.notify(Failed(TaskId("simulate"), 1, FailureKind.CANCELLED, "", seconds=0.5 * usual))  # stopped by hand
    teacher.notify(Finished(TaskId("simulate"), 2, 2.5 * usual, 10**9))
    teacher.teach()
    learnt = known_rates()
    assert learnt is not None
    now = simulation(expect(job, tasks, Size({"fluid": 50_000.0}, 1), Costs(learnt, TWO_CORES.capacity)))
    assert 2.0 * usual < now.seconds < 4.0 * usual
    assert now.is_measured
    assert now.memory_bytes == pytest.approx(1e9, rel=0.01)


def test_check_and_plan_tell_the_cost(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "drop.toml").write_text(DROP)
    result = pipeline("check", tmp_path / "drop.toml", "--until", "simulate")
    assert "of disk" in result.output
    assert "of memory" in result.output
    result = pipeline("plan", tmp_path / "drop.toml", "--until", "simulate", "--farm", tmp_path)
    assert "simulate: about" in result.output


def test_a_small_run_teaches_nothing(tmp_path, rates):
    """It would tell how long a start takes, and make films of the same kind look as slow."""
    job = drop(tmp_path)
    teacher, tasks = teacher_of(job, tmp_path / "drop", particles=100), planned(job, ["simulate"])
    teacher.notify(RunStarted(tasks))
    commit_all(teacher, tasks[0].task)
    teacher.notify(Finished(TaskId("simulate"), 1, 60.0, 10**9))
    teacher.teach()
    assert known_rates() == REFERENCE


def test_tiny_pictures_teach_nothing_of_large_ones(tmp_path, rates):
    """They are overhead: a film after them was expected to take a tenth of its time."""
    job = drop(tmp_path, "render.resolution=[32,18]", "render.samples=1")
    teacher, tasks = teacher_of(job, tmp_path / "drop", particles=50_000), planned(job)
    teacher.notify(RunStarted(tasks))
    for each in (each.task for each in tasks if each.task.stage == "render"):
        commit_all(teacher, each)
        teacher.notify(Finished(each.id, 1, 0.2, 10**8))
    teacher.teach()
    assert known_rates() == REFERENCE
