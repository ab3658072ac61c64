"""Volume: the cells of each smoke and frame, as OpenVDB grids."""

from __future__ import annotations

from math import prod

from pipeline.cache import read_smoke_in_box
from pipeline.errors import InvalidArtifactError
from pipeline.job.models import Job
from pipeline.layout import JobLayout
from pipeline.parameter_set import ParameterSet
from pipeline.stages.base import TaskContext
from pipeline.stages.body_frames import tasks_of_bodies
from pipeline.stages.inputs import ABSENT, tool_version
from pipeline.task import Resources, Task

WORKER_BYTES = 130_000_000
BYTES_PER_CELL = 80
"""Measured by `benchmarks/smoke_files.py`: 70 bytes a cell at 128³ cells all full of smoke, what is read from the cache
included; 41 at 256³ cells of which 18 % hold smoke."""


class VolumeStage:
    """One VDB a smoke and frame, with density, temperature and velocity."""

    name = "volume"
    version = 2

    def plan(self, job: Job, layout: JobLayout) -> list[Task]:
        """One task a smoke and frame."""
        parameters = ParameterSet.of(
            stage=self.name,
            version=self.version,
            tools=_openvdb(),
            volume=job.volume,
            fps=job.fps,
            shutter=job.render.shutter,
        )
        smokes = [
            (smoke.name, Resources(memory_bytes=WORKER_BYTES + BYTES_PER_CELL * prod(smoke.cell_counts(job.domain))))
            for smoke in job.smoke
        ]
        return tasks_of_bodies(self.name, job, layout, bodies=smokes, output=layout.volume, parameters=parameters)

    def obstacles(self, job: Job) -> list[str]:
        """No OpenVDB."""
        from render.errors import VolumeUnavailableError
        from render.volume import import_openvdb

        if not job.smoke:
            return []
        try:
            import_openvdb()
        except VolumeUnavailableError as error:
            return [str(error)]
        return []

    def run(self, context: TaskContext) -> None:
        """Write one frame of one smoke.

        Raises:
            InvalidArtifactError: the cached frame is damaged, or holds what is no smoke.
        """
        from render.volume import validate_volume, write_volume

        task, job = context.task, context.job
        cached = context.layout.path(task.inputs[0])
        smoke = read_smoke_in_box(cached, task.subject)
        with context.committing(task.outputs[0], validate_volume) as path:
            try:
                write_volume(path, **vars(smoke), parameters=job.volume, fps=job.fps, shutter=job.render.shutter)
            except ValueError as error:
                raise InvalidArtifactError(f'{cached}: smoke "{task.subject}": {error}') from error
        context.progress(1, 1)


def _openvdb() -> dict[str, str]:
    """The package that `import_openvdb` takes the binding from, with its version."""
    provider = "openvdb" if tool_version("openvdb") != ABSENT else "bpy"
    return {provider: tool_version(provider)}
