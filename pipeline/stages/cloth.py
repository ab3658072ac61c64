"""Cloth: each cloth of a frame, as a mesh that carries its velocity and its coordinates at rest."""

from __future__ import annotations

from pipeline.cache import read_frame
from pipeline.job.models import Job
from pipeline.layout import JobLayout
from pipeline.parameter_set import ParameterSet
from pipeline.stages.base import TaskContext
from pipeline.stages.body_frames import tasks_of_bodies
from pipeline.stages.inputs import count_nodes, tool_version
from pipeline.task import Resources, Task

BASE_BYTES = 250_000_000
"""Interpreter, numpy and h5py."""
BYTES_PER_NODE = 600
"""The frame's arrays, the normals of its triangles and the mesh as it is written: 512 x 512 nodes take 150 MB."""


class ClothStage:
    """One PLY a cloth and frame: the sheet in its middle, without its thickness, which is less than a pixel."""

    name = "cloth"
    version = 1

    def plan(self, job: Job, layout: JobLayout) -> list[Task]:
        """One task a cloth and frame."""
        parameters = ParameterSet.of(stage=self.name, version=self.version, tools={"numpy": tool_version("numpy")})
        cloths = [
            (cloth.name, Resources(memory_bytes=BASE_BYTES + BYTES_PER_NODE * count_nodes(cloth)))
            for cloth in job.cloth
        ]
        return tasks_of_bodies(self.name, job, layout, bodies=cloths, output=layout.cloth, parameters=parameters)

    def obstacles(self, job: Job) -> list[str]:  # noqa: ARG002
        """None: its packages are always there."""
        return []

    def run(self, context: TaskContext) -> None:
        """Mesh one frame of one cloth."""
        from render.cloth import vertex_normals
        from render.meshes import validate_ply, write_ply

        task = context.task
        cloth = read_frame(context.layout.path(task.inputs[0]), task.subject).bodies[task.subject].arrays
        normals = vertex_normals(cloth["position"], cloth["triangles"])
        with context.committing(task.outputs[0], validate_ply) as path:
            write_ply(
                path,
                cloth["position"],
                cloth["triangles"],
                normals=normals,
                velocities=cloth["velocity"],
                uv=cloth["uv"],
            )
        context.progress(1, 1)
