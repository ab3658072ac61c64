"""Export as a .blend file: the lit scene as the film has it, for artists who go on in Blender."""

from __future__ import annotations

import json
from collections.abc import Iterable
from functools import partial
from pathlib import Path

from pipeline.base.layout import JobLayout
from pipeline.base.parameter_set import ParameterSet
from pipeline.base.task import ArtifactPath, Resources, Task, TaskId
from pipeline.kinds.table import products_of
from pipeline.model.job import Job
from pipeline.stages.base import TaskContext
from pipeline.stages.export import ExportStage, meshes_of
from pipeline.stages.inputs import blender_version
from pipeline.stages.render import CORES, WORKER_BYTES, RenderStage, decisive
from pipeline.stages.render_drawing import FrameDrawing
from pipeline.stages.render_scene import framed_points, render_spec, write_motion
from render.blend_file import validate_scene_file, write_scene_file
from render.meshes import validate_ply
from render.spec import MeshSequenceObject, SceneObject
from render.temporary_folder import temporary_folder

FOLDER = "blend"


class BlendExport(ExportStage):
    """The scene, and of each frame the fluids as they are drawn; all else it plays are the job's own files."""

    format = "blend"
    version = 1
    about = "the whole lit scene for Blender 4.5 LTS and later, which renders the film's frames"
    opened_by = "open {file} in Blender 4.5 LTS or later; it plays the files beside it"
    refers_to = ("surfaces", "cloths", "whitewater", "volumes")

    def plan(self, job: Job, layout: JobLayout) -> list[Task]:
        """One task a frame with fluids that touch something, and one for the scene."""
        tools = {"blender": blender_version(job.render.blender)}
        spec = render_spec(job, layout)
        fluids = [each.name for each in _wet(spec.objects)]
        meshes = [mesh for _, _, mesh in meshes_of(job)]
        frames = self.chosen(job)
        of_objects = decisive(spec)["objects"]
        parameters = ParameterSet.of(
            stage=self.name, version=self.version, tools=tools, objects=of_objects, floor=spec.domain_min[2]
        )
        tasks = [
            Task(
                id=TaskId(f"{self.name}/{frame:06d}"),
                stage=self.name,
                inputs=(
                    *meshes,
                    *(path for _, _, path in products_of(job, layout, frame) if not path.startswith("volumes/")),
                    *([layout.frame_cache(frame)] if job.moving_bodies else ()),
                    *([layout.film_bounds()] if job.camera.frames_action else ()),
                ),
                outputs=tuple(_wet_file(name, frame) for name in fluids),
                parameters=parameters,
                frame=frame,
                resources=Resources(cores=CORES, memory_bytes=WORKER_BYTES),
            )
            for frame in (frames if fluids else ())
        ]
        drawn_otherwise = {layout.surface(name, frame) for name in fluids for frame in frames}
        played = [path for frame in frames for _, _, path in products_of(job, layout, frame)]
        points = [layout.whitewater(fluid, frame) for fluid in job.whitewater for frame in frames]
        cached = [layout.frame_cache(frame) for frame in frames] if job.moving_bodies else []
        scene = Task(
            id=TaskId(f"{self.name}/scene"),
            stage=self.name,
            inputs=(
                *(output for task in tasks for output in task.outputs),
                *(path for path in played if path not in drawn_otherwise),
                *points,
                *cached,
                *meshes,
                *([layout.film_bounds()] if job.camera.frames_action else ()),
            ),
            outputs=(self.root(job),),
            parameters=ParameterSet.of(
                stage=self.name,
                version=self.version,
                tools=tools,
                spec=decisive(spec),
                camera=job.placed_camera.model_dump(mode="json"),
                frames=frames,
            ),
            resources=Resources(memory_bytes=WORKER_BYTES),
        )
        return [*tasks, scene]

    def preflight(self, job: Job) -> list[str]:
        """What drawing needs, too."""
        return RenderStage().preflight(job)

    def run(self, context: TaskContext) -> None:
        """Write the fluids of a frame, or the scene."""
        job, layout, task = context.job, context.layout, context.task
        if task.frame is not None:
            _, view = write_motion(job, layout, task.frame, attempt=context.attempt)
            with temporary_folder("surfaces") as folder:
                FrameDrawing(context, view, []).renderer.save_surfaces(task.frame, folder)
                for output in task.outputs:
                    with context.committing(output, validate_ply) as path:
                        path.write_bytes((folder / f"{Path(output).parent.name}.ply").read_bytes())
        else:
            frames: list[int] = json.loads(task.parameters.canonical)["frames"]
            for done, frame in enumerate(frames):
                write_motion(job, layout, frame, attempt=context.attempt)
                context.progress(done, len(frames) + 1, "camera and bodies")
            document = layout.root / "scene.json"
            document.write_text(render_spec(job, layout, framed_points(job, layout)).document(), encoding="utf-8")
            blender = job.render.blender
            with context.committing(task.outputs[0], partial(validate_scene_file, blender=blender)) as path:
                write_scene_file(path, document, frames, blender)
        context.progress(1, 1)


def _wet(objects: Iterable[SceneObject]) -> list[MeshSequenceObject]:
    """Fluids that tell where they touch something."""
    return [each for each in objects if isinstance(each, MeshSequenceObject) and each.wets_within is not None]


def _wet_file(fluid: str, frame: int) -> ArtifactPath:
    return JobLayout.product(FOLDER, fluid, frame, ".ply")
