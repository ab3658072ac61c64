"""Whitewater: spray, foam and bubbles of each fluid, from frame to frame of the cache."""

from __future__ import annotations

from collections.abc import Mapping
from math import ceil

from pipeline.base.content import tool_version
from pipeline.base.layout import JobLayout
from pipeline.base.parameter_set import ParameterSet
from pipeline.base.task import ArtifactPath, Resources, Task, TaskId
from pipeline.kinds.base import Work
from pipeline.kinds.elements import most_particles
from pipeline.kinds.fluid import FLUID
from pipeline.model.job import Job
from pipeline.stages.base import FILE_S, FileWork, Stage, TaskContext
from pipeline.stages.inputs import by_content
from pipeline.stages.obstacles import moving_obstacles, read_fluids_and_bodies
from render.point_clouds import PointCloud, read_point_cloud, validate_point_cloud, write_point_cloud
from sim.core.runtime import initialize
from sim.whitewater.cloud import WhitewaterCloud

CORES = 2  # threads of the neighbour sums; the rest of a frame is numpy's, which takes one

WORKER_BYTES = 600_000_000
BYTES_PER_PARTICLE = 400  # of the cloud
BYTES_PER_FLUID_PARTICLE = 350
"""Two snapshots, their motion, and what a substep makes of it; measured with 1 and 3 million, without a cloud."""

PARTICLE_S = 3e-6
"""Time of a particle of the fluid in a frame: gathers by neighbours, and its share of the cloud [s]."""


class WhitewaterStage(Stage):
    """One PLY a fluid and frame, each from that of the frame before and the fluids of the tank at both frames.

    So the frames of a fluid are made one after the other, each as soon as its own frame is cached. It always computes
    on the CPU: the clouds are the same wherever the simulation ran.
    """

    name = "whitewater"
    about = "spray, foam and bubbles"
    version = 4

    def plan(self, job: Job, layout: JobLayout) -> list[Task]:
        """One task a frame of each fluid that has whitewater."""
        return [
            Task(
                id=TaskId(f"whitewater/{fluid}/{frame:06d}"),
                stage=self.name,
                inputs=_inputs(layout, fluid, frame),
                outputs=(layout.whitewater(fluid, frame),),
                parameters=parameters,
                subject=fluid,
                frame=frame,
                resources=resources,
            )
            for fluid in job.whitewater
            for parameters, resources in ((self._parameters(job, fluid), _resources(job, fluid)),)
            for frame in range(job.frame_count)
        ]

    def work(self, job: Job, elements: Mapping[str, float], *, on_gpu: bool) -> FileWork:  # noqa: ARG002
        """By the particles of the fluids."""
        return FileWork("cloud", Work(0.0, FILE_S + PARTICLE_S * elements.get(FLUID.name, 0.0)))

    def lighter(self, job: Job) -> str:  # noqa: ARG002
        """What fluids say."""
        return FLUID.lighter

    def run(self, context: TaskContext) -> None:
        """Make one frame of one fluid's whitewater."""
        cloud, not_made = _next_cloud(context)
        with context.committing(context.task.outputs[0], validate_point_cloud) as path:
            write_point_cloud(
                path, PointCloud(cloud.position, cloud.velocity, cloud.radius, cloud.lifetime, cloud.kind, not_made)
            )
        lacking = f", {not_made} more had no room below max_particles" if not_made else ""
        context.progress(1, 1, f"{len(cloud)} particles{lacking}")

    def _parameters(self, job: Job, fluid: str) -> ParameterSet:
        return ParameterSet.of(
            stage=self.name,
            version=self.version,
            tools={name: tool_version(name) for name in ("taichi", "libigl", "numpy", "scipy")},
            whitewater=job.whitewater[fluid],
            fps=job.fps,
            gravity=job.gravity,
            domain=job.domain,
            rigid=[{"name": body.name, "shape": by_content(body).shape, "scale": body.scale} for body in job.rigid],
        )


def _inputs(layout: JobLayout, fluid: str, frame: int) -> tuple[ArtifactPath, ...]:
    if frame == 0:
        return (layout.frame_cache(0),)
    return layout.frame_cache(frame - 1), layout.frame_cache(frame), layout.whitewater(fluid, frame - 1)


def _resources(job: Job, fluid: str) -> Resources:
    """An upper bound: how many particles there are is not known before the simulation has filled its blocks."""
    cloud = BYTES_PER_PARTICLE * job.whitewater[fluid].max_particles
    return Resources(CORES, memory_bytes=WORKER_BYTES + cloud + ceil(BYTES_PER_FLUID_PARTICLE * most_particles(job)))


def _next_cloud(context: TaskContext) -> tuple[WhitewaterCloud, int]:
    """The task's cloud, and how many particles it has not for lack of room."""
    task, job = context.task, context.job
    assert task.frame is not None
    if task.frame == 0:
        return WhitewaterCloud.empty(), 0
    initialize("cpu", threads=context.threads)
    from sim.whitewater.motion import FluidState
    from sim.whitewater.solver import WhitewaterSolver

    before, now = (read_fluids_and_bodies(context.layout.path(cached)) for cached in task.inputs[:2])
    last = read_point_cloud(context.layout.path(task.inputs[2]))
    particle_radius = now[task.subject].number("particle_radius")
    solver = WhitewaterSolver(
        job.whitewater[task.subject],
        domain=job.domain,
        gravity=job.gravity,
        frames_per_second=job.fps,
        rest_density=now[task.subject].number("rest_density"),
    )
    cloud, report = solver.advance_frame(
        WhitewaterCloud(last.position, last.velocity, last.radius, last.lifetime, last.kind),
        FluidState.of_snapshots([before[fluid.name] for fluid in job.fluid]),
        FluidState.of_snapshots([now[fluid.name] for fluid in job.fluid]),
        frame=task.frame,
        particle_radius=particle_radius,
        bodies=moving_obstacles(job, before, now, particle_radius),
        sources=FluidState.of_snapshots([now[task.subject]]).particle_id if len(job.fluid) > 1 else None,
    )
    print(f"{len(cloud)} particles, {report.generated} of them new, in {report.substeps} substeps", flush=True)
    if report.not_generated:
        print(f"{report.not_generated} particles had no room below max_particles", flush=True)
    return cloud, report.not_generated
