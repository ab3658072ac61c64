"""Meshes of bodies, and which of them keep the texture coordinates of their files."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from inline_tasks import run_task
from trimesh.visual import TextureVisuals

from pipeline.base.layout import JobLayout
from pipeline.base.task import Task
from pipeline.job.loading import load_job
from pipeline.run.events import Finished
from pipeline.stages.bodies import BodiesStage, mesh_within
from render.meshes import read_ply
from sim.shapes.parameters import Placement
from sim.shapes.placement import build_solid
from sim.shapes.tessellation import longest_edge

JOB = """
name = "film"
[[rigid]]
name = "box"
shape = {{ type = "mesh", file = "box.glb" }}
scale = 0.1
[[rigid]]
name = "ball"
shape = {{ type = "sphere", radius = 0.1 }}
position = [0.4, 0.0, 0.0]
[material.box]
{box}
[material.ball]
{ball}
"""
LOOK, BLEND = 'look = "metal"', 'blend = "own.blend:Bricks"'


@pytest.fixture
def layout(tmp_path: Path) -> JobLayout:
    box = trimesh.creation.box()
    box.visual = TextureVisuals(uv=box.vertices[:, :2] + 0.5)
    box.export(tmp_path / "box.glb")
    (tmp_path / "own.blend").write_bytes(b"BLENDER")
    return JobLayout(tmp_path)


def planned(layout: JobLayout, *, box: str, ball: str = LOOK) -> dict[str, Task]:
    layout.job_file.write_text(JOB.format(box=box, ball=ball))
    return {str(task.subject): task for task in BodiesStage().plan(load_job(layout.job_file), layout)}


def test_only_a_mesh_with_a_material_of_a_blend_file_is_made_with_texture_coordinates(layout):
    plain, own = planned(layout, box=LOOK), planned(layout, box=BLEND, ball=BLEND)
    assert plain["ball"].parameters.digest == own["ball"].parameters.digest
    assert plain["box"].parameters.digest != own["box"].parameters.digest
    for box, textured in ((LOOK, False), (BLEND, True)):
        assert isinstance(run_task(planned(layout, box=box)["box"], layout), Finished)
        mesh = read_ply(layout.path(layout.body_mesh("box", "body")))
        assert np.ptp(mesh.vertices, axis=0) == pytest.approx([0.1] * 3)
        if not textured:
            assert mesh.corner_uv is None
            continue
        np.testing.assert_allclose(mesh.corner_uv, mesh.vertices[mesh.faces][..., :2] * 10.0 + 0.5, atol=1e-6)


def test_texture_coordinates_that_are_not_there_change_no_mesh(layout):
    trimesh.creation.box().export(layout.root / "box.glb")
    contents = []
    for box in (LOOK, BLEND):
        assert isinstance(run_task(planned(layout, box=box)["box"], layout), Finished)
        contents.append(layout.path(layout.body_mesh("box", "body")).read_bytes())
    assert contents[0] == contents[1]


FLUID = """
[[fluid]]
name = "water"
particle_radius = 0.004
[[fluid.block]]
shape = { type = "box", size = [0.1, 0.1, 0.1] }
position = [0.0, 0.0, 0.5]
"""


def test_a_body_that_fluid_is_seen_through_is_as_fine_as_the_particles(layout):
    glass = 'look = "glass"'
    alone, metal = planned(layout, box=glass), planned(layout, box=LOOK)
    assert alone["box"].parameters.digest == metal["box"].parameters.digest
    longest = {}
    for look in (LOOK, glass):
        layout.job_file.write_text(JOB.format(box=look, ball=LOOK) + FLUID)
        tasks = {str(task.subject): task for task in BodiesStage().plan(load_job(layout.job_file), layout)}
        assert isinstance(run_task(tasks["box"], layout), Finished)
        mesh = read_ply(layout.path(layout.body_mesh("box", "body")))
        corners = mesh.vertices[mesh.faces]
        longest[look] = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max()
        assert np.ptp(mesh.vertices, axis=0) == pytest.approx([0.1] * 3)
    assert longest[LOOK] > 0.1
    assert longest[glass] <= 1.5 * 0.004


PROFILE = [(0.0, 0.0), (0.3, 0.0), (0.3, 0.01), (0.01, 0.02), (0.01, 1.0), (0.0, 1.0)]  # a foot of 0.3 m, a thin stem


@pytest.mark.parametrize(
    "shape",
    [
        {"type": "box", "size": (1.0, 0.7, 0.01)},
        {"type": "cylinder", "radius": 0.005, "height": 4.0},
        {"type": "sphere", "radius": 0.5},
        {"type": "torus", "major_radius": 0.5, "minor_radius": 0.01},
        {"type": "revolved", "profile": PROFILE},
        {"type": "mesh", "file": "rod.obj"},
    ],
    ids=lambda shape: shape["type"],
)
def test_a_body_has_as_many_triangles_as_it_may_and_no_more(shape, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    trimesh.creation.cylinder(radius=0.01, height=1.0, sections=320).export(tmp_path / "rod.obj")
    solid = build_solid(Placement.model_validate({"shape": shape}))
    most, finest = 60_000, 1.0e-4
    mesh = mesh_within(solid, finest, most=most)
    assert mesh.is_closed
    assert most / 5.0 < len(mesh.faces) <= most  # a sphere's are four times as many or none
    assert mesh.signed_volume == pytest.approx(solid.volume, rel=1.5e-3)
    coarse = mesh_within(solid, 0.07, most=most)
    assert len(coarse.faces) < most
    assert longest_edge(coarse) <= 0.07
