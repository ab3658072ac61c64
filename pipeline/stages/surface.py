"""Surface: the particles of each fluid and frame, as a mesh that carries their velocity."""

from __future__ import annotations

from math import ceil
from typing import TYPE_CHECKING

from pipeline.cache import read_frame
from pipeline.job.models import Job
from pipeline.layout import JobLayout
from pipeline.parameter_set import ParameterSet
from pipeline.stages.base import TaskContext
from pipeline.stages.body_frames import tasks_of_bodies
from pipeline.stages.inputs import most_particles_of, tool_version
from pipeline.task import Resources, Task

if TYPE_CHECKING:
    from sim.fluid.parameters import FluidParameters

WORKER_BYTES = 100_000_000
BYTES_PER_SURFACE_PARTICLE = 140_000
"""What meshing takes goes with the surface, so with the particles to the power 2/3, at `CUBE_SIZE`. Measured: 76 MB for
16,000 particles at rest, 425 for 512,000; splashes have more surface: 119 MB for 25,000, 798 for 504,000."""
CUBE_SIZE = 0.75
"""In radii. Cubes of half the width need four times the memory (0.5: 262 MB for those 25,000)."""


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
        fluids = [(fluid.name, _resources(fluid, job)) for fluid in job.fluid]
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


def _resources(fluid: FluidParameters, job: Job) -> Resources:
    """An upper bound: how many particles there are is not known before the simulation has filled its blocks."""
    on_surface = most_particles_of(fluid, job, until_s=job.frame_count / job.fps) ** (2.0 / 3.0)
    finer = CUBE_SIZE / job.surface.cube_size_in_radii
    return Resources(memory_bytes=WORKER_BYTES + ceil(BYTES_PER_SURFACE_PARTICLE * on_surface * finer**2))
