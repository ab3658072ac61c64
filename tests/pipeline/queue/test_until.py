"""`submit --until`: a job that ends after a stage, needs nothing of what comes after it, and goes on later."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_line import pipeline
from farm_processes import Farm, wait_until

from pipeline.base.errors import PlanError, StageUnavailableError
from pipeline.base.layout import JobLayout
from pipeline.cli.export import FORMATS
from pipeline.job.loading import job_of_text
from pipeline.queue.changes import continuation
from pipeline.queue.job_queue import JobQueue
from pipeline.record.reader import SUCCEEDED
from pipeline.run.goal import read_goal, write_goal
from pipeline.run.plan import plan_job
from pipeline.stages import EXPORTS, STAGES
from pipeline.stages.render import RenderStage

SCENE = """
name = "small"
frames = 2
device = "cpu"

[[fluid]]
name = "water"
particle_radius = 0.03

[[fluid.block]]
shape = { type = "box", size = [0.2, 0.2, 0.2] }
position = [0.0, 0.0, 0.3]

[[smoke]]
name = "plume"
min = [-0.3, -0.3, 0.0]
max = [0.3, 0.3, 0.6]
cell_size = 0.1
source = [{ shape = { type = "sphere", radius = 0.1 }, position = [0.0, 0.0, 0.2] }]
"""
NO_PICTURE = (
    SCENE + '[camera]\nposition = [0.0, -1.0, 1.0]\nlook_at = [0.0, -1.0, 1.0]\n[material.ghost]\nlook = "rubber"\n'
)


@pytest.fixture
def farm(tmp_path) -> Iterator[Farm]:
    farm = Farm(tmp_path)
    yield farm
    farm.close()


def stages_until(*until: str) -> list[str]:
    job = job_of_text(SCENE, Path("job.toml"))
    return [*dict.fromkeys(task.stage for task in plan_job(job, JobLayout(Path("renders/small")), STAGES, until))]


def test_a_plan_holds_a_stage_and_what_it_needs():
    assert stages_until("simulate") == ["simulate"]
    assert stages_until("surface") == ["simulate", "spray", "surface"]
    assert stages_until("surface", "volume") == ["simulate", "spray", "surface", "volume"]
    assert stages_until("movie") == stages_until()


def test_a_stage_that_comes_later_is_not_even_asked_for_its_plan(monkeypatch):
    def refuse(*_: object) -> None:
        raise StageUnavailableError("no Blender here")

    monkeypatch.setattr(RenderStage, "plan", refuse)
    assert stages_until("volume") == ["simulate", "volume"]


@pytest.mark.parametrize(("until", "told"), [("cloth", "nothing for the stage"), ("rendr", "the stages are bodies, ")])
def test_a_stage_that_the_job_or_the_program_lacks_is_refused(until, told):
    with pytest.raises(PlanError, match=told):
        stages_until(until)


@pytest.mark.parametrize(
    ("until", "told"),
    [("surface:x", '"x" is not a frame'), ("surfac", 'no stage "surfac"'), ("cloth", 'nothing for the stage "cloth"')],
)
def test_an_end_that_is_none_is_refused_before_anything_is_told(tmp_path, monkeypatch, until, told):
    monkeypatch.chdir(tmp_path)
    Path("small.toml").write_text(NO_PICTURE)
    refused = pipeline("check", "small", "--until", until)
    assert refused.exit_code != 0
    assert refused.stdout == ""
    assert told in refused.stderr.splitlines()[-1]


def test_what_is_wrong_with_pictures_does_not_count_where_none_is_drawn(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("small.toml").write_text(NO_PICTURE)
    refused = pipeline("check", "small")
    assert refused.exit_code == 2
    assert {"camera.look_at", "material.ghost"} <= {line.split()[2].rstrip(":") for line in refused.stderr.splitlines()}
    assert pipeline("check", "small", "--until", "render").exit_code == 2
    accepted = pipeline("check", "small", "--until", "surface")
    assert (accepted.exit_code, "pixels" in accepted.stdout) == (0, False)
    Path("small.toml").write_text(NO_PICTURE.replace("particle_radius = 0.03", "particle_radius = 3.0"))
    assert "particle" in pipeline("check", "small", "--until", "simulate").stderr  # what is simulated still counts


def test_a_goal_is_kept_in_the_folder_and_goes_into_what_is_queued_later(tmp_path):
    queue = JobQueue(tmp_path)
    layout = queue.layout("small")
    layout.root.mkdir()
    layout.job_file.write_text(SCENE)
    assert read_goal(layout) == ()
    write_goal(layout, ["surface", "volume"])
    assert read_goal(layout) == continuation(queue, "small")[0].until == ("surface", "volume")
    layout.goal.write_text("garbage")
    assert read_goal(layout) == ()
    write_goal(layout, ["simulate"])
    write_goal(layout, [])
    assert not layout.goal.exists()


@pytest.mark.slow
def test_submitted_until_a_stage_where_nothing_can_be_rendered_and_later_to_its_end(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    absent = tmp_path / "no-blender"
    monkeypatch.setenv("PIPELINE_BLENDER", str(absent))
    Path("small.toml").write_text(f'{SCENE}[render]\nblender = "{absent}"\nresolution = [32, 18]\nsamples = 1\n')
    refused = pipeline("submit", "small")
    assert (refused.exit_code, str(absent) in refused.stderr) == (3, True)
    made = pipeline("submit", "small", "--until", "simulate")
    assert made.exit_code == 0, made.output
    assert "renders/small (until simulate): done" in made.stdout
    layout = JobLayout(tmp_path / "renders" / "small")
    assert len([*layout.root.glob("cache/*.h5")]) == 2
    assert not [*layout.root.glob("surfaces/*/*")]
    # Whatever is asked of it next goes by the same goal.
    status = json.loads(pipeline("status", "small", "--json").stdout)
    assert (status["state"], status["until"], [*status["stages"]]) == ("done", ["simulate"], ["simulate"])
    assert pipeline("resume", "small").stdout == "up to date: renders/small (until simulate)\n"
    assert "no stage" in pipeline("rerun", "small", "--stage", "surface").stderr
    # More of it, and then all of it: what is there is kept.
    times = {path: path.stat().st_mtime_ns for path in layout.root.glob("cache/*.h5")}
    assert pipeline("submit", "small", "--until", "surface").exit_code == 0
    assert len([*layout.root.glob("surfaces/*/*.ply")]) == 2
    assert {path: path.stat().st_mtime_ns for path in times} == times
    assert pipeline("submit", "small").exit_code == 3
    Path("small.toml").write_text(SCENE)  # with a Blender the rest would follow, and nothing of this again
    planned = json.loads(pipeline("plan", "small", "--json").stdout)
    verdicts = {(each["stage"], each["verdict"]) for each in planned}
    assert {("simulate", "up to date"), ("surface", "up to date"), ("volume", "stale")} <= verdicts


@pytest.mark.slow
def test_a_plain_submit_continues_to_the_film_and_the_queue_keeps_the_goal_of_a_paused_job(farm):
    path = farm.job("a", frames=60, pause_s=1.0)
    running = farm.start("submit", path.name, "--until", "double")
    wait_until(lambda: farm.frames_done("a") > 0, "it never began to work")
    farm.here("pause", "a")
    farm.finish(running, code=8)
    farm.faults("a", {})
    assert "renders/a (until double): done" in farm.here("resume", "a").out
    film = farm.layout("a").root / "film.bin"
    assert (farm.frames_done("a"), film.exists()) == (60, False)
    assert farm.listed()["a"]["state"] == "done"
    farm.here("submit", "a")
    assert film.exists()
    assert read_goal(farm.layout("a")) == ()
    succeeded = [row.task for row in farm.attempts("a") if row.outcome == SUCCEEDED]
    assert len(succeeded) == len(set(succeeded)) == 62


def test_a_stage_may_be_named_with_frames():
    job = job_of_text(SCENE, Path("job.toml"))
    tasks = plan_job(job, JobLayout(Path("renders/small")), STAGES, ("surface:1",))
    kinds = ["spray/water/000000", "spray/water/000001"]  # each is told from the one before
    assert [task.id for task in tasks] == ["simulate", *kinds, "surface/water/000001"]
    with pytest.raises(PlanError, match="nothing for the stage"):
        plan_job(job, JobLayout(Path("renders/small")), STAGES, ("surface:2",))
    with pytest.raises(PlanError, match="runs backwards"):
        plan_job(job, JobLayout(Path("renders/small")), STAGES, ("surface:1-0",))


def test_exports_are_planned_only_where_they_are_asked_for():
    assert stages_until("export-vtk") == ["simulate", "spray", "surface", "export-vtk"]
    assert not [stage for stage in stages_until() if stage.startswith("export")]
    assert tuple(EXPORTS) == FORMATS


@pytest.mark.parametrize(
    ("until", "frames"),
    [(("surface:1", "surface:0"), {0, 1}), (("surface:1", "surface"), {0, 1}), (("surface:1",), {1})],
)
def test_a_stage_that_is_named_more_than_once_makes_all_that_is_named(until, frames):
    job = job_of_text(SCENE, Path("job.toml"))
    tasks = plan_job(job, JobLayout(Path("renders/small")), STAGES, until)
    assert {task.frame for task in tasks if task.stage == "surface"} == frames
