"""Spray: what each particle of a fluid stands for, and the drops that its spray breaks up into."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from math import ceil
from typing import TYPE_CHECKING

import numpy as np

from pipeline.base.content import tool_version
from pipeline.base.layout import JobLayout
from pipeline.base.parameter_set import ParameterSet
from pipeline.base.task import ArtifactPath, Resources, Task, TaskId
from pipeline.kinds.base import Work
from pipeline.kinds.elements import most_particles
from pipeline.kinds.fluid import FLUID, wetted_walls
from pipeline.model.job import Job
from pipeline.stages.base import FILE_S, FileWork, Stage, TaskContext
from pipeline.stages.inputs import by_content
from pipeline.stages.obstacles import moving_obstacles, read_fluids_and_bodies
from pipeline.store.cache import read_frame, validate_frame, write_frame
from render.point_clouds import PointCloud, validate_point_cloud, write_point_cloud
from render.walls import in_films
from sim.core.runtime import initialize
from sim.core.snapshots import Snapshot
from sim.core.world import FrameReport
from sim.fluid.parameters import FluidParameters
from sim.whitewater.kinds import LiquidKind

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sim.whitewater.drops import Drops, Reach
    from sim.whitewater.liquid import LiquidState
    from sim.whitewater.obstacles import Obstacles

CORES = 2  # as whitewater, which a process may make, too: its Taichi keeps its number of threads

WORKER_BYTES = 600_000_000
BYTES_PER_PARTICLE = 350  # as whitewater's neighbour sums

PARTICLE_S = 1.5e-6
"""Time of a particle of the fluid in a frame: two gathers by neighbours [s]."""

LIFETIME_S = 1.0
"""Of drops in the files: they do not fade [s]."""


class SprayStage(Stage):
    """Two files a fluid and frame: the kinds of its particles, and its drops as points.

    Each is made from the kinds of the frame before and the fluids of the tank. It always computes on the CPU: the
    drops are the same wherever the simulation ran.
    """

    name = "spray"
    about = "drops of fluids"
    version = 4

    def plan(self, job: Job, layout: JobLayout) -> list[Task]:
        """One task a frame of each fluid."""
        return [
            Task(
                id=TaskId(f"spray/{fluid.name}/{frame:06d}"),
                stage=self.name,
                inputs=_inputs(layout, fluid.name, frame),
                outputs=(layout.liquid(fluid.name, frame), layout.drops(fluid.name, frame)),
                parameters=parameters,
                subject=fluid.name,
                frame=frame,
                resources=resources,
            )
            for fluid in job.fluid
            for parameters in (self._parameters(job, fluid),)
            for resources in (_resources(job),)
            for frame in range(job.frame_count)
        ]

    def work(self, job: Job, elements: Mapping[str, float], *, on_gpu: bool) -> FileWork:  # noqa: ARG002
        """By the particles of the fluids."""
        return FileWork("drops", Work(0.0, FILE_S + PARTICLE_S * elements.get(FLUID.name, 0.0)))

    def lighter(self, job: Job) -> str:  # noqa: ARG002
        """What fluids say."""
        return FLUID.lighter

    def run(self, context: TaskContext) -> None:
        """Make the files of one frame of one fluid."""
        task, job, layout = context.task, context.job, context.layout
        assert task.frame is not None
        initialize("cpu", threads=context.threads)

        bodies = read_fluids_and_bodies(layout.path(task.inputs[0]))
        solids = _solids(job, bodies, bodies[task.subject].number("particle_radius"))
        state = _kinds(context, bodies, solids)
        reach = _reach(job, bodies[task.subject], state)
        drops, gone = _drops(job, bodies, task.subject, state, reach=reach, solids=solids)
        kinds = Snapshot(
            "fluid",
            {"particle_id": state.particle_id, "liquid": state.kind, "held": state.held, "reach": reach.width},
            {"volume_of_drops": drops.volume + gone},
        )
        with ExitStack() as stack:
            to_kinds = stack.enter_context(context.committing(task.outputs[0], validate_frame))
            to_drops = stack.enter_context(context.committing(task.outputs[1], validate_point_cloud))
            report = FrameReport(task.frame, task.frame / job.fps, {}, {}, {})
            write_frame(to_kinds, {task.subject: kinds}, report, device="cpu")
            write_point_cloud(to_drops, _points(drops, bodies[task.subject]))
        spray = np.count_nonzero(state.kind == LiquidKind.SPRAY)
        context.progress(1, 1, f"{spray} particles of spray, {len(drops.radius)} drops")

    def _parameters(self, job: Job, fluid: FluidParameters) -> ParameterSet:
        return ParameterSet.of(
            stage=self.name,
            version=self.version,
            tools={name: tool_version(name) for name in ("taichi", "libigl", "numpy", "scipy")},
            viscosity=fluid.viscosity,
            rest_density=fluid.rest_density,
            drop_diameter=job.surface.drop_diameter,
            drops_per_particle=job.surface.drops_per_particle,
            fps=job.fps,
            domain=job.domain,
            rigid=[{"name": body.name, "shape": by_content(body).shape, "scale": body.scale} for body in job.rigid],
        )


def _resources(job: Job) -> Resources:
    """An upper bound: how many particles there are is not known before the simulation has filled its blocks."""
    return Resources(CORES, memory_bytes=WORKER_BYTES + ceil(BYTES_PER_PARTICLE * most_particles(job)))


def _inputs(layout: JobLayout, fluid: str, frame: int) -> tuple[ArtifactPath, ...]:
    return (layout.frame_cache(frame), *((layout.liquid(fluid, frame - 1),) if frame else ()))


def _solids(job: Job, bodies: Mapping[str, Snapshot], particle_radius: float) -> Obstacles:
    """Walls and bodies where they are in a frame, as finely as fluid of this particle radius [m] can tell."""
    from sim.whitewater.obstacles import Obstacles

    return Obstacles(job.domain, moving_obstacles(job, bodies, bodies, particle_radius), 1.0 / job.fps)


def _kinds(context: TaskContext, bodies: Mapping[str, Snapshot], solids: Obstacles) -> LiquidState:
    """The kinds of the task's fluid, from those of the frame before."""
    from sim.whitewater.drops import atomizes
    from sim.whitewater.liquid import LiquidState, lie_on, next_liquid
    from sim.whitewater.motion import FluidState

    task, job = context.task, context.job
    fluid = FluidState.of_snapshots([bodies[task.subject]])
    particle_radius = bodies[task.subject].number("particle_radius")
    said = next(each for each in job.fluid if each.name == task.subject)
    before = LiquidState.empty()
    if task.frame:
        last = read_frame(context.layout.path(task.inputs[1]), task.subject).bodies[task.subject].arrays
        before = LiquidState.of_arrays(last)
    breaks_up = job.surface.drops_per_particle > 0 and atomizes(
        viscosity=said.viscosity, rest_density=said.rest_density, particle_radius=particle_radius
    )
    lies = lie_on(solids, fluid, particle_radius=particle_radius, frame_dt=1.0 / job.fps)
    lies |= in_films(fluid.position, wetted_walls(job.domain), spacing=2.0 * particle_radius)
    return next_liquid(
        before,
        FluidState.of_snapshots([bodies[each.name] for each in job.fluid]),
        fluid.particle_id,
        particle_radius=particle_radius,
        frame_dt=1.0 / job.fps,
        atomizes=breaks_up,
        lies=lies,
    )


def _reach(job: Job, body: Snapshot, state: LiquidState) -> Reach:
    """How far the drops of a fluid's spray are spread, from how far they were."""
    from sim.whitewater.drops import grown_reach
    from sim.whitewater.motion import FluidState

    fluid = FluidState.of_snapshots([body])
    return grown_reach(state, fluid, particle_radius=body.number("particle_radius"), dt=1.0 / job.fps)


def _drops(
    job: Job, bodies: Mapping[str, Snapshot], name: str, state: LiquidState, *, reach: Reach, solids: Obstacles
) -> tuple[Drops, float]:
    """The drops of a fluid's spray that are neither in liquid nor in walls and bodies; what has left [m³]."""
    from sim.whitewater.drops import drops_of, in_the_air
    from sim.whitewater.motion import FluidState

    fluid, particle_radius = FluidState.of_snapshots([bodies[name]]), bodies[name].number("particle_radius")
    drops = drops_of(
        state,
        fluid,
        reach,
        particle_radius=particle_radius,
        diameter=job.surface.drop_diameter,
        most=job.surface.drops_per_particle,
    )
    if not len(drops.radius):
        return drops, 0.0
    # Half of a cloud at a wall would else be spread on it.
    position, velocity = solids.mirrored(drops.position, drops.velocity)
    position, velocity, _, stays = solids.collide(position, velocity, 1.0)
    drops = replace(drops, position=position, velocity=velocity)
    has_left = ((position < job.domain.min) | (position > job.domain.max)).any(axis=1) & ~stays
    in_air = drops.kept(stays)
    for liquid in (fluid.position[state.kind != LiquidKind.SPRAY], *_other_liquid(job, bodies, name, particle_radius)):
        in_air = in_the_air(in_air, liquid, particle_radius=particle_radius)
    return in_air, drops.kept(has_left).volume


def _other_liquid(
    job: Job, bodies: Mapping[str, Snapshot], name: str, particle_radius: float
) -> Iterator[NDArray[np.float32]]:
    """Particles of each other fluid of the tank [m], (n, 3), but those that are spray by this frame alone."""
    from sim.whitewater.liquid import hangs_together
    from sim.whitewater.motion import FluidState

    others = [each.name for each in job.fluid if each.name != name]
    if not others:
        return
    tank = FluidState.of_snapshots([bodies[each.name] for each in job.fluid])
    whole = tank.particle_id[hangs_together(tank, particle_radius=particle_radius)]
    for other in others:
        fluid = FluidState.of_snapshots([bodies[other]])
        yield fluid.position[np.isin(fluid.particle_id, whole)]


def _points(drops: Drops, fluid: Snapshot) -> PointCloud:
    """Drops as points of spray that do not fade, each with the dye of its particle where the fluid has some."""
    count = len(drops.radius)
    dye = fluid.arrays.get("dye")
    return PointCloud(
        drops.position.astype(np.float32),
        drops.velocity.astype(np.float32),
        drops.radius.astype(np.float32),
        np.full(count, LIFETIME_S, np.float32),
        np.zeros(count, np.uint8),
        dye=None
        if dye is None
        else dye[np.searchsorted(fluid.arrays["particle_id"], drops.particle_id)].astype(np.float32),
    )
