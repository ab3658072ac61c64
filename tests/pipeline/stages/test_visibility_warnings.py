"""What is told of a frame's camera before the frame is drawn, and how it gets to the user."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.base.layout import JobLayout
from pipeline.base.task import ArtifactPath
from pipeline.job.loading import load_job
from pipeline.run.events import RunStarted, TaskEvent, Warned
from pipeline.run.executors.attempt import AttemptContext
from pipeline.run.executors.base import Assignment
from pipeline.run.plan import Assessment, Verdict
from pipeline.run.progress import ProgressObserver
from pipeline.stages.render import RenderStage
from pipeline.stages.render_scene import camera_path
from pipeline.stages.visibility import CAMERA_INSIDE, NOTHING_SEEN, bodies_at, warn_if_invisible
from render.meshes import write_ply
from render.point_clouds import PointCloud, write_point_cloud

JOB = """
name = "pond"
frames = 3
[[fluid]]
name = "water"
[[fluid.block]]
shape = {{ type = "box", size = [0.2, 0.2, 0.2] }}
position = [0.0, 0.0, 0.5]
[[rigid]]
name = "ball"
kind = "dynamic"
density = 500.0
shape = {{ type = "sphere", radius = 0.1 }}
position = [0.0, 0.0, 0.7]
[camera]
position = {position}
look_at = {look_at}
"""
TETRAHEDRON = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=float) - 0.25
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


def write_points(layout: JobLayout, artifact: ArtifactPath, count: int) -> None:
    """Points in the place of the tetrahedron."""
    path = layout.path(artifact)
    path.parent.mkdir(parents=True, exist_ok=True)
    rows, ones = np.zeros((count, 3), np.float32), np.ones(count, np.float32)
    write_point_cloud(path, PointCloud(rows, rows, ones, ones, np.zeros(count, np.uint8)))


def warnings_of(
    folder: Path, *, position: list[float], look_at: list[float], ball: list[float], water: bool = True
) -> list[Warned]:
    """What is told of frame 2, whose ball is there, and whose water is a tetrahedron around the origin."""
    layout = JobLayout(folder)
    layout.job_file.write_text(JOB.format(position=position, look_at=look_at))
    job = load_job(layout.job_file)
    for artifact, scale in ((layout.body_mesh("ball"), 0.1), (layout.surface("water", 2), 1.0)):
        path = layout.path(artifact)
        path.parent.mkdir(parents=True, exist_ok=True)
        if water or scale < 1.0:
            write_ply(path, scale * TETRAHEDRON, FACES)
        else:
            write_ply(path, np.zeros((0, 3)), np.zeros((0, 3)))
    write_points(layout, layout.drops("water", 2), 0)
    task = RenderStage().plan(job, layout)[2]
    events: list[TaskEvent] = []
    assignment = Assignment(task, 1, "f", {}, 1, layout.job_file, layout.root, "pipeline.stages:STAGES")
    context = AttemptContext(assignment, events.append, lambda: False)
    poses = {"ball": {"position": np.array(ball), "orientation": UPRIGHT}}
    warn_if_invisible(context, camera_path(job).first(), list(bodies_at(job, layout, 2, poses)))
    return [event for event in events if isinstance(event, Warned)]


def test_a_camera_that_sees_something_is_not_warned_of(tmp_path):
    place = {"position": [0.0, -4.0, 0.0], "look_at": [0.0, 0.0, 0.0]}
    assert not warnings_of(tmp_path, **place, ball=[0.0, 0.0, 50.0])
    assert not warnings_of(tmp_path, **place, ball=[0.0, 0.0, 0.0], water=False)


def test_a_picture_without_anything_of_the_scene_is_told_with_its_frame(tmp_path, capsys):
    away = {"position": [0.0, -4.0, 0.0], "look_at": [0.0, -9.0, 0.0]}
    (warned,) = warnings_of(tmp_path, **away, ball=[0.0, 0.0, 50.0])
    assert warned.kind == NOTHING_SEEN
    assert "frame 2: nothing of the scene is in the picture" in warned.message
    assert f"warning: {warned.message}" in capsys.readouterr().out, "it is in the log"


def test_a_camera_in_the_water_or_in_a_body_is_told(tmp_path):
    inside = {"position": [0.0, -0.01, 0.0], "look_at": [0.0, 2.0, 0.0]}
    (warned,) = warnings_of(tmp_path, **inside, ball=[0.0, 0.0, 50.0])
    assert warned.kind == CAMERA_INSIDE and '"water"' in warned.message
    (warned,) = warnings_of(tmp_path, **inside, ball=[0.0, 0.0, 0.0], water=False)
    assert warned.kind == CAMERA_INSIDE and '"ball"' in warned.message


def test_points_are_called_by_what_is_drawn(tmp_path):
    layout = JobLayout(tmp_path)
    layout.job_file.write_text(JOB.format(position=[0, -4, 0], look_at=[0, 0, 0]) + "[whitewater.water]\n")
    for artifact in (layout.body_mesh("ball"), layout.surface("water", 2)):
        layout.path(artifact).parent.mkdir(parents=True)
        write_ply(layout.path(artifact), TETRAHEDRON, FACES)
    write_points(layout, layout.drops("water", 2), 3)
    write_points(layout, layout.whitewater("water", 2), 5)
    poses = {"ball": {"position": np.zeros(3), "orientation": UPRIGHT}}
    found = {each.name: len(each.points) for each in bodies_at(load_job(layout.job_file), layout, 2, poses)}
    assert found == {"ball": 4, "water": 4, "drops of water": 3, "whitewater of water": 5}


class Lines:
    """A display that keeps what it is told."""

    def __init__(self) -> None:
        self.said: list[str] = []

    def show(self, stages) -> None:
        pass

    def say(self, sentence: str, *, style: str = "") -> None:
        assert style == "yellow"
        self.said.append(sentence)

    def close(self) -> None:
        pass


@pytest.mark.parametrize("kinds", [("a", "a", "a"), ("a", "b", "a")])
def test_each_kind_of_warning_is_said_once_while_it_runs(tmp_path, kinds):
    layout = JobLayout(tmp_path)
    layout.job_file.write_text(JOB.format(position=[0, -4, 0], look_at=[0, 0, 0]))
    tasks = RenderStage().plan(load_job(layout.job_file), layout)
    display = Lines()
    observer = ProgressObserver(display)
    observer.notify(RunStarted([Assessment(task, Verdict.STALE, (), task.outputs) for task in tasks]))
    for task, kind in zip(tasks, kinds, strict=True):
        observer.notify(Warned(task.id, 1, kind, f"{kind} in {task.id}"))
    assert len(display.said) == len(set(kinds))
    assert "a in render/000000" in display.said[0]
