"""Export as glTF: one small animated scene for the web."""

from __future__ import annotations

import json
from collections.abc import Iterator

from pipeline.base.errors import PipelineError
from pipeline.base.layout import JobLayout
from pipeline.base.parameter_set import ParameterSet
from pipeline.base.task import ArtifactPath, Task, TaskId
from pipeline.kinds.rigid import meshes_at_rest
from pipeline.kinds.soft import is_grainy
from pipeline.kinds.table import products_of
from pipeline.model.job import Job
from pipeline.stages.base import TaskContext
from pipeline.stages.export import ExportStage, motion, read_meshes
from pipeline.stages.render_scene import framed_points, framing_files, render_spec
from render.gltf_files import TooLargeError, validate_glb, write_glb
from render.meshes import SurfaceMesh, read_ply
from render.spec import MeshObject, MeshSequenceObject, MovingMeshObject

LIMIT_BYTES = 100_000_000
"""What somebody may still wait for who opens a page."""


class GltfExport(ExportStage):
    """One file of all frames that are chosen: bodies, surfaces, cloths, the camera, plain materials."""

    format = "gltf"
    version = 2
    about = "a scene for the web"
    opened_by = "drop {file} on a page that shows glTF, or import it in any program; metres, y up"

    def root(self, job: Job) -> ArtifactPath:
        """The ending of one binary file."""
        return ArtifactPath(f"{job.name}.glb")

    def left_out(self, job: Job) -> list[str]:
        """Smoke, drops, whitewater, grains, embers, a zoom."""
        keyframes = job.camera.keyframe
        lengths = {key.focal_length_mm or job.camera.focal_length_mm for key in keyframes}
        return [
            *(f"smoke ({each.name})" for each in job.smoke),
            *(f"drops ({each.name})" for each in (job.fluid if job.surface.drops_per_particle else ())),
            *(f"whitewater ({name})" for name in job.whitewater),
            *(f"grains ({each.name})" for each in job.soft if is_grainy(each)),
            *(f"embers ({each.name})" for each in job.embers),
            *(["the camera's zoom"] if len(lengths) > 1 else []),
        ]

    def plan(self, job: Job, layout: JobLayout) -> list[Task]:
        """One task."""
        spec, frames = render_spec(job, layout), self.chosen(job)
        self.require_meshes(spec, "glTF")
        played = [path for frame in frames for _, _, path in products_of(job, layout, frame)]
        poses = [layout.frame_cache(frame) for frame in frames] if job.moving_bodies or job.placed_camera.moves else []
        scene = Task(
            id=TaskId(f"{self.name}/scene"),
            stage=self.name,
            inputs=(
                *(path for path in played if not path.endswith(".vdb")),
                *poses,
                *meshes_at_rest(job.rigid),
                *framing_files(job, layout),
            ),
            outputs=(self.root(job),),
            parameters=ParameterSet.of(
                stage=self.name,
                version=self.version,
                tools={},
                objects=spec.model_dump(mode="json", include={"objects"})["objects"],
                camera=job.placed_camera.model_dump(mode="json"),
                first_view=spec.camera.model_dump(mode="json"),
                resolution=spec.render.resolution,
                fps=job.fps,
                frames=frames,
                limit_bytes=LIMIT_BYTES,
            ),
        )
        return [scene]

    def run(self, context: TaskContext) -> None:
        """Write the file. Raises PipelineError: it would be larger than a page can load."""
        job, layout = context.job, context.layout
        frames: list[int] = json.loads(context.task.parameters.canonical)["frames"]
        spec = render_spec(job, layout, framed_points(job, layout))
        placements, views = motion(context, spec, frames)

        def played(drawn: MeshSequenceObject) -> Iterator[SurfaceMesh]:
            for done, frame in enumerate(frames):
                context.progress(done, len(frames), drawn.name)
                yield read_ply(layout.root / drawn.file.replace("{frame}", f"{frame:06d}"))

        changing = [each for each in spec.objects if isinstance(each, MeshSequenceObject)]
        still = [each for each in spec.objects if isinstance(each, MeshObject | MovingMeshObject)]
        try:
            with context.committing(context.task.outputs[0], validate_glb) as path:
                write_glb(
                    path,
                    spec,
                    times=[(frame - frames[0]) / job.fps for frame in frames],
                    meshes=read_meshes(layout, {each.name: each.file for each in still}),
                    sequences={each.name: played(each) for each in changing},
                    placements={name: list(by_frame.values()) for name, by_frame in placements.items()},
                    views=list(views.values()),
                    limit_bytes=LIMIT_BYTES,
                )
        except TooLargeError as error:
            raise PipelineError(
                f"{len(frames)} frames of {job.name} have more than {LIMIT_BYTES // 1_000_000} MB as glTF, more than a "
                f"page should load; export fewer, such as every fourth: --frames {frames[0]}-{frames[-1]}x4, or "
                "coarser surfaces"
            ) from error
        context.progress(1, 1)
