"""What the stages plan for a job, and what they tell Blender."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.job.looks import parts_of
from pipeline.job.models import Job
from pipeline.layout import JobLayout
from pipeline.plan import plan_job
from pipeline.stages import STAGES
from pipeline.stages.render import render_spec
from sim.shapes import build_solid
from sim.shapes.parameters import Placement

LAYOUT = JobLayout(Path("renders/tank"))

TANK = {
    "name": "tank",
    "frames": 40,
    "device": "cpu",
    "rigid": [{"name": "ball", "shape": {"type": "sphere", "radius": 0.1}, "rotation_deg": [10, 20, 30]}],
    "fluid": [{"name": "water", "block": [{"shape": {"type": "box", "size": [0.2, 0.2, 0.2]}}]}],
    "smoke": [{"name": "plume", "source": [{"shape": {"type": "sphere", "radius": 0.1}}]}],
}


def job(**changes) -> Job:
    return Job.model_validate({**TANK, **changes}, strict=False)


def digests(of: Job) -> dict[str, str]:
    return {task.stage: task.parameters.digest for task in plan_job(of, LAYOUT, STAGES)}


def test_every_frame_gets_its_surface_volume_and_picture():
    tasks = plan_job(job(), LAYOUT, STAGES)
    count = {stage.name: sum(task.stage == stage.name for task in tasks) for stage in STAGES}
    assert count == {"bodies": 1, "simulate": 1, "surface": 40, "volume": 40, "render": 40, "movie": 3}


def test_a_picture_waits_for_its_own_frame_only():
    tasks = {task.id: task for task in plan_job(job(), LAYOUT, STAGES)}
    assert tasks["render/000007"].inputs == (
        "meshes/ball.ply",
        "surfaces/water/000007.ply",
        "volumes/plume/000007.vdb",
    )


def test_the_film_is_cut_every_half_second():
    tasks = {task.id: task for task in plan_job(job(), LAYOUT, STAGES)}
    assert len(tasks["movie/segment-0000"].inputs) == 30
    assert len(tasks["movie/segment-0001"].inputs) == 10
    assert tasks["movie/film"].inputs == ("movie/0000.mp4", "movie/0001.mp4")


@pytest.mark.parametrize(
    ("change", "concerned"),
    [
        ({"camera": {"position": [0, -3, 1]}}, {"render"}),
        ({"material": {"ball": {"look": "metal"}}}, {"render"}),
        ({"movie": {"crf": 20}}, {"movie"}),
        ({"surface": {"threshold": 0.5}}, {"surface"}),
        ({"gravity": [0, 0, -1.62]}, {"simulate"}),
        ({"frames": 80}, set()),
        ({"name": "other"}, set()),
        ({"render": {"device": "cpu"}}, set()),
        ({"render": {"shutter": 0.25}}, {"render", "volume"}),
        ({"fps": 30}, {"simulate", "volume", "render", "movie"}),
    ],
    ids=str,
)
def test_a_change_concerns_only_the_stages_that_read_it(change, concerned):
    before, after = digests(job()), digests(job(**change))
    assert {stage for stage in before if before[stage] != after[stage]} == concerned


@pytest.mark.parametrize("angles", [(0, 0, 0), (90, 0, 0), (10, 20, 30), (-35, 120, 200)])
def test_blender_turns_a_body_as_the_simulation_does(angles):
    spec = render_spec(job(rigid=[{**TANK["rigid"][0], "rotation_deg": angles}]), LAYOUT)
    w, x, y, z = spec.objects[0].orientation
    ours = Rotation.from_quat([x, y, z, w]).as_matrix()
    np.testing.assert_allclose(ours, Rotation.from_euler("xyz", angles, degrees=True).as_matrix(), atol=1e-12)


def test_nothing_stands_in_the_way_of_a_job_on_this_machine_but_what_is_said(monkeypatch):
    simulate = next(stage for stage in STAGES if stage.name == "simulate")
    monkeypatch.setattr("sim.runtime.available_devices", lambda: {"cpu": "ok", "cuda": "no driver"})
    assert simulate.obstacles(job()) == []
    (obstacle,) = simulate.obstacles(job(device="cuda"))
    assert obstacle == 'device "cuda" is not available: no driver; use device = "auto" or "cpu"'


def test_a_blender_that_is_not_there_is_said_before_any_work(tmp_path):
    render = next(stage for stage in STAGES if stage.name == "render")
    (obstacle,) = render.obstacles(job(render={"blender": str(tmp_path / "blender")}))
    assert "cannot start the Blender executable" in obstacle


DUCK = {"name": "duck", "shape": {"type": "duck", "length": 0.2}}


def test_a_duck_comes_in_parts_with_colours_of_their_own():
    objects = render_spec(job(rigid=[DUCK]), LAYOUT).objects
    assert [each.name for each in objects[:3]] == ["duck", "duck.bill", "duck.eyes"]
    assert len({each.material.color for each in objects[:3]}) == 3
    assert [each.file for each in objects[:3]] == ["meshes/duck.ply", "meshes/duck.bill.ply", "meshes/duck.eyes.ply"]


def test_a_duck_of_metal_is_of_one_piece():
    objects = render_spec(job(rigid=[DUCK], material={"duck": {"look": "metal"}}), LAYOUT).objects
    assert {each.material.look for each in objects[:3]} == {"metal"}


def test_a_part_can_be_painted():
    material = {"duck.bill": {"look": "rubber", "color": (0.0, 0.2, 0.9)}}
    objects = render_spec(job(rigid=[DUCK], material=material), LAYOUT).objects
    assert objects[1].material.color == (0.0, 0.2, 0.9)


@pytest.mark.parametrize("shape", ["duck", "bunny"])
def test_the_parts_that_have_looks_are_those_that_the_shape_has(shape):
    mesh = build_solid(Placement.model_validate({"shape": {"type": shape}})).rest_mesh()
    assert parts_of(shape) == mesh.part_names
    pieces = [mesh.piece(part) for part in mesh.part_names]
    assert sum(len(piece.faces) for piece in pieces) == len(mesh.faces)
    # The cut changes no triangle, so the volumes under the pieces' faces add up to float64 rounding.
    assert sum(piece.area_vectors.sum(axis=0) @ [1, 1, 1] for piece in pieces) == pytest.approx(0.0, abs=1e-9)
