"""Exports by Blender: the lit scene as the film has it, and its moving meshes as Alembic."""

from __future__ import annotations

import json
from collections.abc import Iterable
from functools import partial
from pathlib import Path

from pipeline.base.layout import JobLayout
from pipeline.base.parameter_set import ParameterSet
from pipeline.base.task import ArtifactPath, Resources, Task, TaskId
from pipeline.kinds.rigid import meshes_at_rest
from pipeline.kinds.table import KINDS, points_of, products_of
from pipeline.model.job import Job
from pipeline.stages.base import TaskContext
from pipeline.stages.export import ExportStage
from pipeline.stages.inputs import blender_version
from pipeline.stages.render import CORES, WORKER_BYTES, RenderStage, decisive
from pipeline.stages.render_drawing import FrameDrawing
from pipeline.stages.render_scene import framed_points, framing_files, render_spec, write_motion
from render.blend_file import validate_alembic, validate_scene_file, write_scene_file
from render.meshes import validate_ply
from render.spec import MeshSequenceObject, RenderSpec, SceneObject
from render.temporary_folder import temporary_folder

FOLDER = "blend"


class _SceneExport(ExportStage):
    """One file of all frames, written by Blender."""

    of_one_range = True
    draws = True

    def preflight(self, job: Job) -> list[str]:
        """What drawing needs, too."""
        return RenderStage().preflight(job)

    def _spec(self, job: Job, layout: JobLayout) -> RenderSpec:
        return render_spec(job, layout, framed_points(job, layout))

    def _scene_task(self, job: Job, layout: JobLayout, read: Iterable[ArtifactPath]) -> Task:
        """The task that writes the file; beside meshes at rest and poses it reads these."""
        frames = self.chosen(job)
        cached = [layout.frame_cache(frame) for frame in frames] if job.moving_bodies else []
        meshes = [*meshes_at_rest(job.rigid)]
        return Task(
            id=TaskId(f"{self.name}/scene"),
            stage=self.name,
            inputs=(*read, *cached, *meshes, *framing_files(job, layout)),
            outputs=(self.root(job),),
            parameters=ParameterSet.of(
                stage=self.name,
                version=self.version,
                tools={"blender": blender_version(job.render.blender)},
                spec=decisive(render_spec(job, layout)),
                camera=job.placed_camera.model_dump(mode="json"),
                frames=frames,
            ),
            resources=Resources(memory_bytes=WORKER_BYTES),
        )

    def _write_scene(self, context: TaskContext) -> None:
        job, layout, task = context.job, context.layout, context.task
        frames: list[int] = json.loads(task.parameters.canonical)["frames"]
        for done, frame in enumerate(frames):
            write_motion(job, layout, frame, attempt=context.attempt)
            context.progress(done, len(frames) + 1, "camera and bodies")
        document = layout.root / "scene.json"
        document.write_text(self._spec(job, layout).document(), encoding="utf-8")
        blender = job.render.blender
        validate = validate_alembic if self.format == "abc" else partial(validate_scene_file, blender=blender)
        with context.committing(task.outputs[0], validate) as path:
            write_scene_file(path, document, frames, blender, suffix=f".{self.format}")


class BlendExport(_SceneExport):
    """The scene, and of each frame the fluids as they are drawn; all else it plays are the job's own files."""

    format = "blend"
    version = 3
    about = "the scene for Blender"
    opened_by = "open {file} in Blender 4.5 LTS or later; it plays the files beside it"

    @property
    def refers_to(self) -> tuple[str, ...]:  # type: ignore[override]
        """Folders of all that kinds of bodies make of each frame, and of points of fluids."""
        return ("drops", "whitewater", *(kind.product.folder for kind in KINDS.values() if kind.product))

    def plan(self, job: Job, layout: JobLayout) -> list[Task]:
        """One task a frame with fluids that touch something, and one for the scene."""
        spec = render_spec(job, layout)
        fluids = _wet(spec.objects)
        frames = self.chosen(job)
        meshes = [*meshes_at_rest(job.rigid)]
        parameters = ParameterSet.of(
            stage=self.name,
            version=self.version,
            tools={"blender": blender_version(job.render.blender)},
            objects=decisive(spec)["objects"],
            floor=spec.domain_min[2],
        )
        tasks = [
            Task(
                id=TaskId(f"{self.name}/{frame:06d}"),
                stage=self.name,
                inputs=(
                    *meshes,
                    *_played(job, layout, frame, volumes=False),
                    *([layout.frame_cache(frame)] if job.moving_bodies else ()),
                    *framing_files(job, layout),
                ),
                outputs=tuple(JobLayout.product(FOLDER, name, frame, ".ply") for name in fluids),
                parameters=parameters,
                frame=frame,
                resources=Resources(cores=CORES, memory_bytes=WORKER_BYTES),
            )
            for frame in (frames if fluids else ())
        ]
        drawn_otherwise = {layout.surface(name, frame) for name in fluids for frame in frames}
        played = [path for frame in frames for path in _played(job, layout, frame, volumes=True)]
        wet = [output for task in tasks for output in task.outputs]
        return [
            *tasks,
            self._scene_task(job, layout, [*wet, *(each for each in played if each not in drawn_otherwise)]),
        ]

    def left_out(self, job: Job) -> list[str]:
        """What frames are laid over once they are drawn."""
        return [] if job.set.backplate is None else [f"the backplate ({Path(job.set.backplate).name})"]

    def run(self, context: TaskContext) -> None:
        """Write the fluids of a frame, or the scene."""
        task = context.task
        if task.frame is None:
            self._write_scene(context)
        else:
            _, view = write_motion(context.job, context.layout, task.frame, attempt=context.attempt)
            with temporary_folder("surfaces") as folder:
                FrameDrawing(context, view, []).renderer.save_surfaces(task.frame, folder)
                for output in task.outputs:
                    with context.committing(output, validate_ply) as path:
                        path.write_bytes((folder / f"{Path(output).parent.name}.ply").read_bytes())
        context.progress(1, 1)


class AbcExport(_SceneExport):
    """Alembic: bodies, surfaces, cloths, drops and whitewater as loose points, the camera. It has no volumes."""

    format = "abc"
    version = 1
    about = "moving meshes as Alembic"
    opened_by = "import {file} in any program of Alembic; metres, y up, 1 sample a frame"

    def plan(self, job: Job, layout: JobLayout) -> list[Task]:
        """One task."""
        self.require_meshes(render_spec(job, layout), "Alembic")
        read = [path for frame in self.chosen(job) for path in _played(job, layout, frame, volumes=True)]
        return [self._scene_task(job, layout, read)]

    def left_out(self, job: Job) -> list[str]:
        """Smoke."""
        return [f"smoke ({each.name})" for each in job.smoke]

    def run(self, context: TaskContext) -> None:
        """Write the file."""
        self._write_scene(context)
        context.progress(1, 1)


def _played(job: Job, layout: JobLayout, frame: int, *, volumes: bool) -> list[ArtifactPath]:
    """Files of a frame that the scene plays."""
    products = [path for _, _, path in products_of(job, layout, frame) if volumes or not path.endswith(".vdb")]
    return [*products, *points_of(job, layout, frame)]


def _wet(objects: Iterable[SceneObject]) -> list[str]:
    """Names of the fluids that tell where they touch something."""
    return [each.name for each in objects if isinstance(each, MeshSequenceObject) and each.wets_within is not None]
