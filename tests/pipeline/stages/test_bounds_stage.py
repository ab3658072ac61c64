"""Where a film's action is, from its cached frames; and what it makes of the plan."""

import numpy as np
import pytest
from inline_tasks import run_task

from pipeline.base.layout import JobLayout
from pipeline.job.loading import load_job
from pipeline.model.job import Job
from pipeline.run.events import Failed, Finished
from pipeline.run.plan import plan_job
from pipeline.stages import STAGES
from pipeline.stages.bounds import read_framed
from pipeline.stages.render_scene import camera_path
from pipeline.store.cache import write_frame
from render.bounds import box_of, read_bounds
from render.meshes import write_ply
from sim.core.snapshots import Snapshot
from sim.core.world import FrameReport

JOB = """
name = "pond"
frames = 2
[domain]
min = [-1.0, -1.0, 0.0]
max = [1.0, 1.0, 2.0]
[[fluid]]
name = "water"
particle_radius = 0.02
[[fluid.block]]
shape = { type = "box", size = [0.4, 0.4, 0.2] }
position = [0.0, 0.0, 0.1]
[[rigid]]
name = "rock"
shape = { type = "box", size = [0.2, 0.2, 0.2] }
position = [0.5, 0.0, 0.1]
rotation_deg = [0.0, 0.0, 45.0]
[[rigid]]
name = "stick"
kind = "dynamic"
density = 500.0
shape = { type = "box", size = [0.6, 0.02, 0.02] }
position = [0.0, 0.0, 0.5]
[[smoke]]
name = "plume"
cell_size = 0.1
[[smoke.source]]
shape = { type = "sphere", radius = 0.1 }
position = [0.0, 0.0, 0.6]
"""
FRAMED = '[camera]\nframing = "action"\n'


def job_in(folder, more: str = FRAMED, *, job: str = JOB) -> tuple[Job, JobLayout]:
    layout = JobLayout(folder / "pond")
    layout.root.mkdir(parents=True, exist_ok=True)
    layout.job_file.write_text(job + more)
    return load_job(layout.job_file), layout


def write_box_mesh(path, half: tuple[float, float, float]) -> None:
    path.parent.mkdir(exist_ok=True)
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
    write_ply(path, corners, np.array([[0, 1, 2]]))


def frame_of(layout: JobLayout, frame: int, *, height: float) -> None:
    """A cached frame: water on the ground, the stick upright at a height, and smoke in a few cells from frame 1 on."""
    water = np.random.default_rng(0).uniform((-0.2, -0.2, 0.02), (0.2, 0.2, 0.18), (4000, 3)).astype(np.float32)
    water[0] = (0.0, 0.0, 1.9)  # a droplet
    upright = np.array([np.cos(np.pi / 4), 0.0, -np.sin(np.pi / 4), 0.0])
    density = np.zeros((20, 20, 20), np.float32)
    density[9:11, 9:11, 6 : 6 + 3 * frame] = 1.0
    bodies = {
        "water": Snapshot(
            "fluid",
            {"position": water, "velocity": np.zeros_like(water)},
            {"particle_radius": 0.02, "rest_density": 1000.0},
        ),
        "stick": Snapshot(
            "rigid",
            {
                "position": np.array([0.1, 0.2, height]),
                "orientation": upright,
                "velocity": np.zeros(3),
                "angular_velocity": np.zeros(3),
            },
            {},
        ),
        "plume": Snapshot(
            "smoke",
            {
                "density": density,
                "temperature": np.full_like(density, 293.0),
                "velocity": np.zeros((*density.shape, 3), np.float32),
            },
            {"origin": (-1.0, -1.0, 0.0), "cell_size": 0.1, "ambient_temperature": 293.0},
        ),
    }
    path = layout.path(layout.frame_cache(frame))
    path.parent.mkdir(exist_ok=True)
    write_frame(path, bodies, FrameReport(frame, frame / 60, {}, {}, {}), device="cpu", longest_shutter_s=1 / 60)


@pytest.fixture
def pond(tmp_path) -> tuple[Job, JobLayout]:
    job, layout = job_in(tmp_path)
    write_box_mesh(layout.path(layout.body_mesh("rock")), (0.1, 0.1, 0.1))
    write_box_mesh(layout.path(layout.body_mesh("stick")), (0.3, 0.01, 0.01))
    for frame, height in enumerate((0.5, 0.8)):
        frame_of(layout, frame, height=height)
    return job, layout


def box_of_film(layout: JobLayout) -> np.ndarray:
    points = read_framed(layout.path(layout.film_bounds()))
    return np.stack([points.min(axis=0), points.max(axis=0)])


def tasks_of_bounds(job: Job, layout: JobLayout) -> list:
    return [task for task in plan_job(job, layout, STAGES) if task.stage == "bounds"]


def test_the_box_holds_what_moves_and_stands_in_all_frames(pond):
    job, layout = pond
    for task in tasks_of_bounds(job, layout):
        assert isinstance(run_task(task, layout), Finished)
    reaches = [read_bounds(layout.path(layout.frame_bounds(frame))) for frame in (0, 1)]
    first, second = ({name: box_of(reach) for name, reach in of_frame.items()} for of_frame in reaches)
    assert set(first) == {"water", "stick"}  # no smoke yet
    assert second["plume"] == pytest.approx(np.array([[-0.1, -0.1, 0.6], [0.1, 0.1, 0.9]]), abs=1e-6)
    assert second["stick"] == pytest.approx(np.array([[0.09, 0.19, 0.5], [0.11, 0.21, 1.1]]), abs=1e-6)
    assert second["water"][1, 2] < 0.21, "the droplet is left out"
    box = box_of_film(layout)
    rock = 0.5 + 0.1 * 2**0.5
    assert box[1] == pytest.approx([rock, 0.22, 1.1], abs=0.01)
    assert box[0] == pytest.approx([-0.22, -0.22, 0.0], abs=0.01)
    assert camera_path(job, read_framed(layout.path(layout.film_bounds()))).first() != camera_path(job).first()


def test_a_tank_is_framed_with_its_whole_floor(pond):
    _, layout = pond
    job, _ = job_in(layout.root.parent, FRAMED + "[set]\ntank = true\n")
    for task in tasks_of_bounds(job, layout):
        run_task(task, layout)
    box = box_of_film(layout)
    assert box[:, :2] == pytest.approx(np.array([[-1.0, -1.0], [1.0, 1.0]]))
    assert box[1, 2] == pytest.approx(1.1, abs=0.01)


def test_a_tank_whose_sides_are_all_open_has_no_floor_to_be_framed(pond):
    _, layout = pond
    without_walls = JOB.replace("[domain]", '[domain]\nopen_faces = ["x-", "x+", "y-", "y+"]')
    without, _ = job_in(layout.root.parent, job=without_walls)
    digests = [task.parameters.digest for task in tasks_of_bounds(without, layout)]
    job, _ = job_in(layout.root.parent, FRAMED + "[set]\ntank = true\n", job=without_walls)
    assert [task.parameters.digest for task in tasks_of_bounds(job, layout)] == digests
    for task in tasks_of_bounds(job, layout):
        run_task(task, layout)
    assert box_of_film(layout)[1, 0] < 0.7


def test_the_same_frames_give_the_same_bytes_and_a_damaged_one_none(pond):
    job, layout = pond
    first, _, film = tasks = tasks_of_bounds(job, layout)
    contents = []
    for _ in range(2):
        for task in tasks:
            run_task(task, layout)
        contents.append([layout.path(task.outputs[0]).read_bytes() for task in tasks])
    assert contents[0] == contents[1]
    layout.path(first.outputs[0]).write_text("{}")
    ended = run_task(film, layout)
    assert isinstance(ended, Failed) and "holds no bounds" in ended.message


def test_pictures_wait_for_the_box_and_other_jobs_have_none(tmp_path):
    framed, layout = job_in(tmp_path)
    tasks = plan_job(framed, layout, STAGES)
    pictures = [task for task in tasks if task.stage == "render"]
    assert all("bounds.json" in task.inputs for task in pictures)
    for more in ("", '[camera]\nframing = "domain"\n', "[camera]\norbit_deg_per_s = 5.0\n"):
        plain, _ = job_in(tmp_path, more)
        assert not tasks_of_bounds(plain, layout)


def test_naming_what_is_framed_anyway_draws_nothing_again(tmp_path):
    def digest(more: str) -> str:
        job, layout = job_in(tmp_path, more)
        return next(task.parameters.digest for task in plan_job(job, layout, STAGES) if task.stage == "render")

    orbit = "[camera]\norbit_deg_per_s = 5.0\n"
    assert digest("") == digest('[camera]\nframing = "domain"\n')
    assert digest(orbit) == digest(orbit + 'framing = "domain"\n')
    digests = {digest(""), digest(FRAMED), digest(orbit), digest(orbit + 'framing = "action"\n')}
    assert len(digests) == 4
