"""Bodies that files animate through the pipeline: planned, kept with the job, checked, drawn, and met by drops."""

import numpy as np
import pytest
from animated_files import BOX_FACES, ball, box, write_usd
from checked_jobs import checked
from inline_tasks import run_task
from planned_jobs import LAYOUT, planned

from pipeline.base.layout import JobLayout
from pipeline.job.inputs import keep_inputs
from pipeline.job.loading import read_job
from pipeline.kinds.rigid import ANIMATED, RIGID
from pipeline.kinds.table import scene_boxes
from pipeline.model.job import Job
from pipeline.run.events import Finished
from pipeline.stages.obstacles import moving_obstacles
from pipeline.stages.product import ProductStage
from pipeline.stages.render_scene import render_spec
from pipeline.store.cache import write_frame
from pipeline.web.drawing.bodies import body_of
from pipeline.web.drawing.shapes import Sheet
from render.meshes import read_ply
from sim.core.world import FrameReport
from sim.rigid.solver import RigidSolver
from sim.whitewater.obstacles import Obstacles

JOB_FILE = """\
name = "breath"
frames = 31
device = "cpu"
[[rigid]]
name = "lung"
kind = "kinematic"
position = [0.0, 0.0, 0.5]
shape = { type = "animation", file = "lung.usdc" }
"""
SMOKE = """\
[[smoke]]
name = "fog"
cell_size = 0.05
open_faces = []
[[smoke.source]]
shape = { type = "sphere", radius = 0.1 }
position = [0.3, 0.0, 0.2]
"""


def with_lung(folder) -> str:
    """A ball that grows from 0.1 to 0.2 m in a quarter of a second, in the job's folder."""
    vertices, faces = ball(0.1, 2)
    return write_usd(folder / "lung.usdc", np.linspace(1.0, 2.0, 7)[:, None, None] * vertices, faces)


def job_of(file: str, **more) -> Job:
    lung = {
        "name": "lung",
        "kind": "kinematic",
        "position": (0.0, 0.0, 0.5),
        "shape": {"type": "animation", "file": file},
    }
    return Job.model_validate({"name": "breath", "frames": 16, "device": "cpu", "rigid": (lung,), **more})


def snapshots(job: Job, time_s: float):
    solver = RigidSolver(job.rigid, domain=job.domain, gravity=job.gravity)
    solver.begin_frame(time_s)
    solver.substep(1.0e-9)
    return solver.snapshots()


def test_each_frame_has_a_mesh_that_its_picture_waits_for_and_none_at_rest(tmp_path):
    job = job_of(with_lung(tmp_path))
    tasks = planned(job)
    assert tasks["animated/lung/000002"].inputs == ("cache/000002.h5",)
    assert set(tasks["render/000002"].inputs) == {"animated/lung/000002.ply", "cache/000002.h5"}
    assert not [name for name in tasks if name.startswith("bodies/")]
    (drawn,) = render_spec(job, LAYOUT).objects
    assert (drawn.type, drawn.file) == ("mesh_sequence", "animated/lung/{frame}.ply")


def test_the_file_is_kept_with_the_job(tmp_path):
    with_lung(tmp_path)
    (tmp_path / "breath.toml").write_text(JOB_FILE)
    layout = JobLayout(tmp_path / "renders" / "breath")
    _, text = keep_inputs(read_job(tmp_path / "breath.toml"), layout)
    (copy,) = layout.inputs.iterdir()
    assert f'file = "inputs/{copy.name}"' in text
    assert copy.read_bytes() == (tmp_path / "lung.usdc").read_bytes()


def test_check_tells_the_samples_and_where_there_are_none(tmp_path):
    with_lung(tmp_path)
    found = checked(JOB_FILE, tmp_path / "job.toml")
    assert found.errors == []
    (line,) = [line for line in found.warnings if "held still" in line]
    assert line == "job.toml:8 rigid[0].shape: is held still after 0.25 s, where its file has no samples"
    late = JOB_FILE.replace('usdc" }', 'usdc", start_s = 0.3 }')
    (line,) = [line for line in checked(late, tmp_path / "job.toml").warnings if "held still" in line]
    assert "before 0.3 s, where" in line


def test_check_tells_what_is_wrong_with_a_file_at_its_line(tmp_path):
    (line,) = checked(JOB_FILE, tmp_path / "job.toml").errors
    assert line.startswith(f"job.toml:8 rigid[0].shape.file: no such file: {tmp_path / 'lung.usdc'}")
    (tmp_path / "lung.usdc").write_bytes(b"nothing")
    (line,) = checked(JOB_FILE, tmp_path / "job.toml").errors
    assert line.startswith("job.toml:8 rigid[0].shape: shape.file: ")
    assert "not a readable USD file; export it again" in line


def test_check_tells_of_growth_in_a_closed_box_of_smoke(tmp_path):
    with_lung(tmp_path)
    lines = checked(JOB_FILE + SMOKE, tmp_path / "job.toml").warnings
    # 4/3 pi (0.2³ - 0.1³) of a cubic metre, and a mesh of 320 triangles has 96 % of that.
    assert [line for line in lines if 'the box of smoke "fog", of which it takes about 2.8 %' in line]
    opened = SMOKE.replace("open_faces = []", 'open_faces = ["z+"]')
    assert not [line for line in checked(JOB_FILE + opened, tmp_path / "job.toml").warnings if "takes about" in line]


def test_check_tells_of_a_surface_that_is_stretched_for_a_fluid(tmp_path):
    water = '[[fluid]]\nname = "water"\n[[fluid.block]]\nshape = { type = "box", size = [0.3, 0.3, 0.2] }\n'
    water += "position = [0.3, 0.0, 0.1]\n"
    with_lung(tmp_path)  # it grows as a whole, and is sampled where it is largest
    text = JOB_FILE + water
    assert not [line for line in checked(text, tmp_path / "job.toml").warnings if "stretches" in line]
    vertices, faces = ball(0.1, 2)
    # One side, then the other, is drawn out.
    pulled = np.stack([vertices * (1.0 + 3.0 * (sign * vertices[:, :1] > 0.0) * [1, 0, 0]) for sign in (1, -1, 1)])
    write_usd(tmp_path / "lung.usdc", pulled, faces)
    (line,) = [line for line in checked(text, tmp_path / "job.toml").warnings if "stretches" in line]
    assert "most at 0.04167 s after its first: fluid may leak in there" in line


def test_a_camera_frames_where_it_goes(tmp_path):
    corners = box((0.1, 0.1, 0.1))
    points = np.stack([corners + np.array([x, 0.0, 0.2]) for x in np.linspace(0.0, 0.9, 10)])
    job = job_of(write_usd(tmp_path / "box.usdc", points, BOX_FACES))
    assert scene_boxes(job)[1:, 1, 0].max() == pytest.approx(0.95, abs=1e-5)


def test_a_frames_mesh_has_its_velocities_and_sharp_edges(tmp_path):
    corners = box((0.2, 0.2, 0.2))
    growing = np.linspace(1.0, 2.0, 13)[:, None, None] * corners
    job = job_of(write_usd(tmp_path / "box.usdc", growing, BOX_FACES))
    layout = JobLayout(tmp_path / "breath")
    layout.path(layout.frame_cache(0)).parent.mkdir(parents=True)
    layout.job_file.write_text(JOB_FILE.replace("lung.usdc", "../box.usdc"))
    there = snapshots(job, 0.25)
    write_frame(layout.path(layout.frame_cache(0)), there, FrameReport(0, 0.25, {}, {}, {}), device="cpu")
    task = ProductStage(RIGID, ANIMATED).plan(job, layout)[0]
    assert isinstance(run_task(task, layout), Finished)
    mesh = read_ply(layout.path(layout.product("animated", "lung", 0, ".ply")))
    # Each corner is one of three sides, and turned half-way through its growth.
    assert len(mesh.vertices) == 24
    np.testing.assert_allclose(np.abs(mesh.vertices - [0.0, 0.0, 0.5]), 0.15, atol=1e-5)
    np.testing.assert_allclose(mesh.velocities, 2.0 * np.sign(mesh.vertices - [0.0, 0.0, 0.5]) * 0.1, atol=1e-4)
    np.testing.assert_allclose(np.abs(mesh.normals).max(axis=1), 1.0, atol=1e-6)
    # Live and in the viewer it is the mesh that it is.
    shown = body_of(there["lung"], 0)
    assert isinstance(shown, Sheet)
    assert len(shown.position) == 8


def test_drops_are_pushed_out_with_the_speed_of_the_surface(tmp_path):
    job = job_of(with_lung(tmp_path))
    frame_dt = 1.0 / 60.0
    before, now = snapshots(job, 0.1), snapshots(job, 0.1 + frame_dt)
    obstacles = Obstacles(job.domain, moving_obstacles(job, before, now, 0.01), frame_dt)
    radius = float(np.linalg.norm(now["lung"].arrays["vertices"] - [0.0, 0.0, 0.5], axis=1).max())
    inside = np.array([[radius - 0.004, 0.0, 0.5]])
    position, velocity, touched, _ = obstacles.collide(inside, np.zeros((1, 3)), 1.0)
    assert touched.all()
    assert position[0, 0] == pytest.approx(radius, abs=3e-3)  # facets are 2 % of the radius below their ball
    speed = float(np.linalg.norm(now["lung"].arrays["vertex_velocities"], axis=1).max())
    assert velocity[0, 0] == pytest.approx(speed, rel=0.1)  # over the frame, at a corner's direction
