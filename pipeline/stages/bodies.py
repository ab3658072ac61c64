"""Bodies: the mesh of each rigid body in its rest pose, for the renderer."""

from __future__ import annotations

from pipeline.fingerprint import ParameterSet
from pipeline.job.models import Job
from pipeline.layout import JobLayout
from pipeline.stages.base import TaskContext
from pipeline.stages.inputs import mesh_file_hashes, tool_version
from pipeline.task import Task, TaskId


class BodiesStage:
    """One PLY a rigid body; poses come from the specification or the cache, never from the mesh."""

    name = "bodies"
    version = 1

    def plan(self, job: Job, layout: JobLayout) -> list[Task]:
        """One task a body."""
        return [
            Task(
                id=TaskId(f"bodies/{body.name}"),
                stage=self.name,
                inputs=(),
                outputs=(layout.body_mesh(body.name),),
                parameters=ParameterSet.of(
                    stage=self.name,
                    version=self.version,
                    tools={name: tool_version(name) for name in ("libigl", "trimesh")},
                    shape=body.shape,
                    scale=body.scale,
                    files=mesh_file_hashes(iter([body])),
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
        with context.committing(context.task.outputs[0], validate_ply) as path:
            write_ply(path, mesh.vertices, mesh.faces)
        context.progress(1, 1)
