"""Bodies: the mesh of each rigid body in its rest pose, for the renderer."""

from __future__ import annotations

from pipeline.job.looks import parts_of
from pipeline.job.models import Job
from pipeline.layout import JobLayout
from pipeline.parameter_set import ParameterSet
from pipeline.stages.base import TaskContext
from pipeline.stages.inputs import by_content, tool_version
from pipeline.task import Task, TaskId


class BodiesStage:
    """One PLY a rigid body and part of its shape, in its rest pose: where it stands is no matter of its mesh."""

    name = "bodies"
    version = 2

    def plan(self, job: Job, layout: JobLayout) -> list[Task]:
        """One task a body."""
        return [
            Task(
                id=TaskId(f"bodies/{body.name}"),
                stage=self.name,
                inputs=(),
                outputs=tuple(layout.body_mesh(body.name, part) for part in parts_of(body.shape.type)),
                parameters=ParameterSet.of(
                    stage=self.name,
                    version=self.version,
                    tools={name: tool_version(name) for name in ("libigl", "trimesh")},
                    shape=by_content(body).shape,
                    scale=body.scale,
                ),
                subject=body.name,
            )
            for body in job.rigid
        ]

    def obstacles(self, job: Job) -> list[str]:  # noqa: ARG002
        """None: its packages are always there."""
        return []

    def run(self, context: TaskContext) -> None:
        """Mesh one body."""
        from render.meshes import validate_ply, write_ply
        from sim.rigid.static import StaticBody

        parameters = next(body for body in context.job.rigid if body.name == context.task.subject)
        mesh = StaticBody(parameters).rest_mesh()
        for part, output in zip(parts_of(parameters.shape.type), context.task.outputs, strict=True):
            piece = mesh.piece(part)
            with context.committing(output, validate_ply) as path:
                write_ply(path, piece.vertices, piece.faces)
        context.progress(1, 1)
