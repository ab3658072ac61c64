"""Surface: the particles of each fluid and frame, as a mesh that carries their velocity."""

from __future__ import annotations

from pipeline.cache import read_frame
from pipeline.job.models import Job
from pipeline.layout import JobLayout
from pipeline.parameter_set import ParameterSet
from pipeline.stages.base import TaskContext
from pipeline.stages.body_frames import tasks_of_bodies
from pipeline.stages.inputs import tool_version
from pipeline.task import Resources, Task

MEMORY_BYTES = 500_000_000
"""What meshing half a million particles was measured to take (425 MB at 512,000, 76 MB at 16,000). How many there are
is not known before the simulation has filled its blocks."""


class SurfaceStage:
    """One PLY a fluid and frame (splashsurf)."""

    name = "surface"
    version = 2

    def plan(self, job: Job, layout: JobLayout) -> list[Task]:
        """One task a fluid and frame."""
        surface, tools = job.surface.model_dump(mode="json"), ["pysplashsurf"]
        if job.surface.droplet_size == 1.0:
            del surface["droplet_size"]  # droplets are as earlier versions left them, and so is the file
        else:
            tools.append("scipy")
        parameters = ParameterSet.of(
            stage=self.name,
            version=self.version,
            tools={name: tool_version(name) for name in tools},
            surface=surface,
        )
        resources = Resources(memory_bytes=MEMORY_BYTES)
        fluids = [(fluid.name, resources) for fluid in job.fluid]
        return tasks_of_bodies(self.name, job, layout, bodies=fluids, output=layout.surface, parameters=parameters)

    def obstacles(self, job: Job) -> list[str]:  # noqa: ARG002
        """None: its packages are always there."""
        return []

    def run(self, context: TaskContext) -> None:
        """Mesh one frame of one fluid."""
        from render.meshes import validate_ply, write_ply
        from render.surface import reconstruct_surface

        task = context.task
        fluid = read_frame(context.layout.path(task.inputs[0]), task.subject).bodies[task.subject]
        surface = reconstruct_surface(
            fluid.arrays["position"],
            fluid.arrays["velocity"],
            particle_radius=fluid.number("particle_radius"),
            parameters=context.job.surface,
            threads=context.threads,
        )
        with context.committing(task.outputs[0], validate_ply) as path:
            write_ply(path, surface.vertices, surface.faces, normals=surface.normals, velocities=surface.velocities)
        context.progress(1, 1)
