"""Materials of .blend files on bodies: drawn, named where they are missing, and nothing of the file run."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from blender_scenes import draw_all, spec_of, sphere, write_mesh
from blender_stand_in import write_blender_stand_in
from inline_tasks import run_task
from needed_blender import needs_bpy
from warm_blender import run_script
from warm_python import run_python

from pipeline.base.layout import JobLayout
from pipeline.job.loading import load_job
from pipeline.model.job import Job
from pipeline.run.events import Finished, TaskEvent, Warned
from pipeline.run.executors.attempt import AttemptContext
from pipeline.run.executors.base import Assignment
from pipeline.stages.bodies import BodiesStage
from pipeline.stages.render import FLAT_PICTURES, RenderStage
from render.blender import open_renderer
from render.meshes import write_ply
from render.parameters import MaterialParameters
from render.spec import MeshObject

pytestmark = needs_bpy

NAMES = "Driven, Green: bright, Halves, Lamp, Named, Pictured, Projected"

# A green one, one whose strength a program of a driver decides, one with a picture outside of the file, and two with a
# picture in it, red at the left and green at the right, one of which names the UV map.
WRITE = """
    import sys
    import bpy

    file, proof = sys.argv[1:]
    bpy.ops.wm.read_factory_settings(use_empty=True)

    def new(name, color):
        material = bpy.data.materials.new(name)
        material.use_fake_user = True
        tree = material.node_tree
        tree.nodes.clear()
        shader = tree.nodes.new("ShaderNodeEmission")
        shader.inputs["Color"].default_value = (*color, 1.0)
        tree.links.new(shader.outputs[0], tree.nodes.new("ShaderNodeOutputMaterial").inputs["Surface"])
        return tree, shader

    new("Green: bright", (0.02, 0.8, 0.05))
    tree, shader = new("Driven", (0.9, 0.02, 0.02))
    driver = shader.inputs["Strength"].driver_add("default_value").driver
    driver.expression = f"1.0 + (open({proof!r}, 'w').write('ran') and 0)"
    tree, shader = new("Pictured", (1.0, 1.0, 1.0))
    picture = tree.nodes.new("ShaderNodeTexImage")
    picture.image = bpy.data.images.new("bricks", 8, 8)
    picture.image.source, picture.image.filepath = "FILE", "//bricks.png"
    for name in ("Halves", "Named"):
        tree, shader = new(name, (1.0, 1.0, 1.0))
        halves = tree.nodes.new("ShaderNodeTexImage")
        halves.image, halves.interpolation = bpy.data.images.new("halves", 2, 1), "Closest"
        halves.image.pixels[:] = (0.8, 0.02, 0.02, 1.0, 0.02, 0.8, 0.02, 1.0)
        halves.image.pack()
        tree.links.new(halves.outputs[0], shader.inputs["Color"])
        if name == "Named":
            places = tree.nodes.new("ShaderNodeUVMap")
            places.uv_map = "of the scan"
            tree.links.new(places.outputs[0], halves.inputs["Vector"])
    tree, shader = new("Lamp", (1.0, 1.0, 1.0))
    light = tree.nodes.new("ShaderNodeTexIES")
    light.mode, light.filepath = "EXTERNAL", "//lamp.ies"
    tree, shader = new("Projected", (1.0, 1.0, 1.0))
    tree.nodes.new("ShaderNodeTexCoord").object = bpy.data.objects.new("projector", None)
    text = bpy.data.texts.new("start.py")
    text.write(f"open({proof!r}, 'w').write('ran')")
    text.use_module = True
    bpy.ops.wm.save_as_mainfile(filepath=file)
    bpy.ops.wm.read_factory_settings(use_empty=True)
"""


JOB = """
name = "film"
frames = 2
[[rigid]]
name = "ball"
shape = {{ type = "sphere", radius = 0.1 }}
[material.ball]
blend = '{blend}'
"""


@pytest.fixture(scope="module")
def materials(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A .blend file whose programs would write `proof` beside it."""
    folder = tmp_path_factory.mktemp("materials")
    run_python(WRITE, str(folder / "my materials.blend"), str(folder / "proof"))
    (folder / "proof").unlink(missing_ok=True)  # Blender ran the driver while it was written
    return folder / "my materials.blend"


def draw(folder: Path, blend: str) -> np.ndarray:
    """Mean colour of the middle of a ball."""
    write_mesh(folder / "ball.ply", *sphere((0.0, 0.0, 0.5), 0.3))
    ball = MeshObject(name="ball", file="ball.ply", material=MaterialParameters(blend=blend))
    (picture,) = draw_all(folder, spec_of(ball))
    return picture[14:22, 28:36].mean(axis=(0, 1))


def test_a_body_takes_the_material_of_a_blend_file(materials, tmp_path):
    red, green, blue = draw(tmp_path, f"{materials}:Green: bright")
    assert green > 1.5 * red
    assert green > 1.5 * blue


def test_a_picture_lies_where_the_bodys_texture_coordinates_say(materials, tmp_path):
    square = np.array([[-0.3, 0.0, 0.2], [0.3, 0.0, 0.2], [0.3, 0.0, 0.8], [-0.3, 0.0, 0.8]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    places = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])[faces]
    mirrored = places * [-1.0, 1.0] + [1.0, 0.0]
    for name, inside, uv, left in (
        ("upright", "Halves", places, 0),
        ("mirrored", "Halves", mirrored, 1),
        ("named", "Named", mirrored, 1),
    ):
        material = MaterialParameters(blend=f"{materials}:{inside}")
        folder = tmp_path / name
        folder.mkdir()
        write_ply(folder / "square.ply", square, faces, corner_uv=uv)
        (picture,) = draw_all(folder, spec_of(MeshObject(name="square", file="square.ply", material=material)))
        picture = picture[14:22]
        sides = [picture[:, columns].mean(axis=(0, 1)) for columns in (slice(26, 30), slice(34, 38))]
        assert [int(side[:2].argmax()) for side in sides] == [left, 1 - left]
        assert all(side[:2].max() > 1.5 * side[:2].min() for side in sides)


def test_the_renderer_tells_on_what_pictures_lie_by_texture_coordinates(materials, tmp_path):
    write_mesh(tmp_path / "ball.ply", *sphere((0.0, 0.0, 0.5), 0.3))
    insides = {"halves": "Halves", "named": "Named", "bright": "Green: bright"}
    objects = [
        MeshObject(name=name, file="ball.ply", material=MaterialParameters(blend=f"{materials}:{inside}"))
        for name, inside in insides.items()
    ]
    objects.append(MeshObject(name="plain", file="ball.ply", material=MaterialParameters(look="stone")))
    spec_of(*objects).write(tmp_path / "spec.json")
    renderer = open_renderer(tmp_path / "spec.json", threads=1, blender=str(write_blender_stand_in(tmp_path)))
    renderer.close()
    assert renderer.pictures_by_uv == {"halves", "named"}


class DrawnEnoughError(Exception):
    """A frame would be drawn now."""


def test_a_picture_without_texture_coordinates_is_told_once_and_blender_is_not_started_for_it(tmp_path, monkeypatch):
    layout = JobLayout(tmp_path)
    text = JOB.format(blend="own.blend:Halves")
    for name in ("second", "generated"):
        text += f'[[rigid]]\nname = "{name}"\nshape = {{ type = "sphere", radius = 0.1 }}\nposition = [0, 0, 0.5]\n'
        text += f'[material.{name}]\nblend = "own.blend:Halves"\n'
    layout.job_file.write_text(text)
    film = load_job(layout.job_file)
    for body in BodiesStage().plan(film, layout):
        assert isinstance(run_task(body, layout), Finished)

    def no_process(*_arguments: object, **_options: object) -> None:
        raise AssertionError("Blender is asked in a process of its own")

    def draw(*_arguments: object) -> None:
        raise DrawnEnoughError

    renderer = SimpleNamespace(device="CPU", pictures_by_uv={"ball", "second"})
    monkeypatch.setattr("render.blend_file.run_script", no_process)
    monkeypatch.setattr("render.blender.run_script", no_process)
    monkeypatch.setattr("pipeline.stages.render.content_name", lambda *_: "own")
    monkeypatch.setattr("pipeline.stages.render.own_picture_bytes", lambda _: 0)
    monkeypatch.setattr("pipeline.stages.render_drawing.FrameDrawing.renderer", renderer)
    monkeypatch.setattr("pipeline.stages.render_drawing.FrameDrawing.draw_until_good", draw)
    told = []
    for frame, task in enumerate(RenderStage().plan(film, layout)[:2]):
        events: list[TaskEvent] = []
        assignment = Assignment(task, 1, "f", {}, 1, layout.job_file, layout.root, "pipeline.stages:STAGES")
        with pytest.raises(DrawnEnoughError):
            RenderStage().run(AttemptContext(assignment, events.append, lambda: False))
        told += [
            (frame, event.message) for event in events if isinstance(event, Warned) and event.kind == FLAT_PICTURES
        ]
    assert [frame for frame, _ in told] == [0, 0]
    for name, (_, line) in zip(("ball", "second"), told, strict=True):
        assert line.startswith(f'"{name}" has no texture coordinates, so pictures in its material "Halves" show one')


def test_no_program_of_the_file_is_run(materials, tmp_path):
    red, green, _ = draw(tmp_path, f"{materials}:Driven")
    assert red > 1.5 * green
    assert not (materials.parent / "proof").exists()


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("Lamp", "lamp.ies; make it internal"),
        ("Projected", 'depends on the object "projector", which a job has none of'),
        ("Pictured", "bricks.png, which is not in the file; pack it"),
    ],
)
def test_a_material_that_needs_more_than_itself_is_an_obstacle_before_any_work(materials, monkeypatch, name, reason):
    monkeypatch.setattr("render.blend_file.run_script", run_script)
    (obstacle,) = RenderStage().preflight(job(f"{materials}:{name}"))
    assert f'the material "{name}" of' in obstacle and reason in obstacle


def test_a_missing_name_is_told_with_those_that_are_there(materials, tmp_path):
    with pytest.raises(
        AssertionError,
        match=rf'has no material "driven"; did you mean "Driven"\?; there are {NAMES}',
    ):
        draw(tmp_path, f"{materials}:driven")


def job(*blends: str, **render: object) -> Job:
    """A ball of each of these materials."""
    bodies = {f"ball{number}": {"blend": blend} for number, blend in enumerate(blends)}
    balls = [
        {"name": name, "shape": {"type": "sphere", "radius": 0.1}, "position": (0, 0, 0.3 * number)}
        for number, name in enumerate(bodies)
    ]
    return Job.model_validate({"name": "film", "rigid": balls, "material": bodies, "render": render})


@pytest.mark.parametrize("external", [False, True])
def test_a_missing_name_is_an_obstacle_before_any_work_and_one_that_is_there_is_none(materials, tmp_path, external):
    render = {"blender": str(write_blender_stand_in(tmp_path))} if external else {}
    assert RenderStage().preflight(job(f"{materials}:Driven", f"{materials}:Gold", **render)) == [
        f'material.ball1.blend: {materials} has no material "Gold"; there are {NAMES}'
    ]
    assert not (materials.parent / "proof").exists()


def test_a_file_that_is_no_blend_file_is_an_obstacle(tmp_path, monkeypatch):
    monkeypatch.setattr("render.blend_file.run_script", run_script)
    (tmp_path / "text.blend").write_text("this is no Blender file")
    (obstacle,) = RenderStage().preflight(job(f"{tmp_path}/text.blend:Gold"))
    assert obstacle.startswith(f"{tmp_path}/text.blend: cannot read the materials of")
