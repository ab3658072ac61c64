"""What exports plan and refuse, without any file."""

from pathlib import Path

import pytest
from checked_jobs import load_checked_job
from planned_jobs import LAYOUT

from pipeline.base.errors import JobFileError, PipelineError, PlanError
from pipeline.base.layout import JobLayout
from pipeline.job.loading import job_of_text
from pipeline.model.job import Job
from pipeline.run.checked_job import needs_pictures
from pipeline.run.plan import plan_job
from pipeline.show.handing_over import refuse_if_busy
from pipeline.stages import EXPORTS, STAGES
from pipeline.stages.render_scene import render_spec

SMOKE = """
name = "tank"
frames = 6

[[smoke]]
name = "plume"
cell_size = 0.1
source = [{ shape = { type = "sphere", radius = 0.2 }, position = [0.0, 0.0, 0.3] }]
"""
SPLASH = """
name = "tank"
frames = 3
[whitewater.water]
[[fluid]]
name = "water"
[[fluid.block]]
shape = { type = "box", size = [0.2, 0.2, 0.2] }
position = [0.0, 0.0, 0.3]
[[cloth]]
name = "flag"
shape = { type = "rectangle", size = [0.4, 0.4], counts = [5, 5] }
position = [0.0, 0.0, 0.9]
"""
EMBERS = """
[[embers]]
name = "sparks"
smoke = "plume"
source = [{ shape = { type = "sphere", radius = 0.1 }, position = [0.0, 0.0, 0.3], rate = 100.0 }]
"""
HEAPS = """
name = "heaps"
frames = 3
[[soft]]
name = "lump"
material = "jelly"
cell_size = 0.05
block = [{ shape = { type = "box", size = [0.2, 0.2, 0.2] }, position = [-0.2, 0.0, 0.1] }]
[[soft]]
name = "heap"
material = "sand"
cell_size = 0.05
block = [{ shape = { type = "box", size = [0.2, 0.2, 0.2] }, position = [0.2, 0.0, 0.1] }]
"""
BALL = """
[[rigid]]
name = "ball"
shape = { type = "sphere", radius = 0.1 }
position = [0.3, 0.0, 0.3]
"""


def exported(text: str, end: str) -> dict[str, object]:
    tasks = plan_job(job_of_text(text, Path("job.toml")), LAYOUT, STAGES, (end,))
    return {task.id: task for task in tasks if task.stage.startswith("export-")}


@pytest.mark.parametrize("name", ["abc", "gltf"])
def test_what_has_no_volumes_is_refused_for_a_job_of_smoke_alone(name):
    with pytest.raises(PlanError, match="no volumes"):
        exported(SMOKE, f"export-{name}")
    assert [*exported(SMOKE + BALL, f"export-{name}")] == [f"export-{name}/scene"]
    assert EXPORTS[name].left_out(job_of_text(SMOKE + BALL, Path("job.toml"))) == ["smoke (plume)"]


@pytest.mark.parametrize(
    ("names", "prim"), [(("a-b", "a_b"), "a_b"), (("camera", "ball"), "camera"), (("Materials", "ball"), "Materials")]
)
def test_names_that_would_be_one_in_usd_are_refused_before_anything_runs(names, prim):
    first, second = (BALL.replace('"ball"', f'"{name}"') for name in names)
    job = job_of_text(f'name = "tank"\nframes = 2\n{first}{second}', Path("job.toml"))
    (problem,) = EXPORTS["usd"].preflight(job)
    assert f"/World/{prim} " in problem
    assert EXPORTS["usd"].preflight(job_of_text(SMOKE + BALL, Path("job.toml"))) == []


@pytest.mark.parametrize(("name", "draws"), [("blend", True), ("abc", True), ("usd", False), ("vtk", False)])
def test_what_is_wrong_with_looks_is_told_where_an_export_draws(name, draws, tmp_path):
    path = tmp_path / "tank.toml"
    path.write_text(f'name = "tank"\nframes = 2\n{BALL}[material.ball]\nlook = "fire"\n')
    assert needs_pictures([f"export-{name}:0-1"]) is draws
    if not draws:
        load_checked_job(path, until=[f"export-{name}"])
        return
    with pytest.raises(JobFileError, match=r"material\.ball\.look"):
        load_checked_job(path, until=[f"export-{name}"])


def test_gltf_says_that_it_has_no_zoom():
    keyframes = """
[camera]
keyframe = [{ time_s = 0.0, position = [1.0, 0.0, 0.5] }, { time_s = 1.0, position = [1.0, 0.0, 0.5]%s }]
"""
    fixed, zoomed = (
        job_of_text(BALL.join(["name = 'a'\nframes = 6\n", keyframes % each]), Path("job.toml"))
        for each in ("", ", focal_length_mm = 90.0")
    )
    assert EXPORTS["gltf"].left_out(fixed) == []
    assert EXPORTS["gltf"].left_out(zoomed) == ["the camera's zoom"]


@pytest.mark.parametrize("name", ["blend", "abc"])
def test_what_plays_every_frame_refuses_gaps(name):
    with pytest.raises(PlanError, match="one range"):
        exported(SMOKE + BALL, f"export-{name}:0,2")
    assert f"export-{name}/scene" in exported(SMOKE + BALL, f"export-{name}:2-4")


def test_frames_are_those_that_were_chosen():
    assert [*exported(SMOKE + BALL, "export-usd:1-5x3")] == [*exported(SMOKE + BALL, "export-usd:1,4")]
    assert [*exported(SMOKE + BALL, "export-usd:1,4")] == ["export-usd/000001", "export-usd/000004", "export-usd/scene"]


@pytest.mark.parametrize("name", EXPORTS)
def test_what_is_given_away_ends_with_the_file_to_open(name):
    job = job_of_text(SMOKE + BALL, Path("job.toml"))
    tasks = plan_job(job, LAYOUT, STAGES, (f"export-{name}",))
    files = EXPORTS[name].belonging(tasks)
    assert files[-1] == EXPORTS[name].root(job)
    assert not [each for each in files if each.startswith("cache/")]
    assert any(each.endswith(".vdb") for each in files) == (name in ("usd", "blend"))


def test_every_file_that_a_blend_file_plays_is_given_away_with_it():
    job = job_of_text(SPLASH + SMOKE.partition("\n\n")[2] + EMBERS + BALL, Path("job.toml"))
    assert_all_is_given_away(job, {"surfaces", "cloths", "drops", "whitewater", "volumes", "embers"})


def test_soft_matter_that_a_blend_file_plays_is_given_away_with_it():
    assert_all_is_given_away(job_of_text(HEAPS, Path("job.toml")), {"soft"})


def assert_all_is_given_away(job: Job, folders: set[str]) -> None:
    files = EXPORTS["blend"].belonging(plan_job(job, LAYOUT, STAGES, ("export-blend",)))
    objects = [each for each in render_spec(job, LAYOUT).objects if "{frame}" in each.file]
    assert {Path(each.file).parts[0] for each in objects} == folders
    for each in objects:
        # Fluids are there as they are drawn.
        file = each.file.replace("surfaces/", "blend/")
        assert {file.replace("{frame}", f"{frame:06d}") for frame in range(3)} <= set(files)


@pytest.mark.parametrize("name", ["usd", "abc", "vtk"])
def test_what_copies_points_into_its_own_files_reads_the_drops_of_every_frame(name):
    tasks = exported(SPLASH, f"export-{name}").values()
    read = {each for task in tasks for each in task.inputs}
    assert {LAYOUT.drops("water", frame) for frame in range(3)} <= read
    assert "drops" not in EXPORTS[name].refers_to


def test_paraview_has_surfaces_of_soft_matter_and_says_that_it_has_no_grains():
    frame = exported(HEAPS, "export-vtk")["export-vtk/000001"]
    assert "soft/lump/000001.ply" in frame.inputs
    assert not [each for each in frame.inputs if each.startswith("soft/heap")]
    assert {Path(each).parts[1] for each in frame.outputs} == {"lump", "lump.surface", "heap", "000001.vtm"}
    assert EXPORTS["vtk"].left_out(job_of_text(HEAPS, Path("job.toml"))) == ["grains (heap)"]


def test_gltf_says_that_it_has_no_drops():
    told = EXPORTS["gltf"].left_out(job_of_text(SPLASH, Path("job.toml")))
    assert told == ["drops (water)", "whitewater (water)"]
    none = job_of_text(SPLASH + "[surface]\ndrops_per_particle = 0\n", Path("job.toml"))
    assert EXPORTS["gltf"].left_out(none) == ["whitewater (water)"]


def test_an_export_does_not_take_the_place_of_a_film_that_waits(tmp_path):
    layout = JobLayout(tmp_path)
    refuse_if_busy(layout, None)
    refuse_if_busy(layout, ("export-usd:0-9",))
    for waiting in ((), ("surface",), ("export-usd", "render")):
        with pytest.raises(PipelineError, match="waits in the queue"):
            refuse_if_busy(layout, waiting)
