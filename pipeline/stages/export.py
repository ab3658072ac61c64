"""Exports: a job's frames in the files of other programs, made when somebody asks for them (`pipeline export`)."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from copy import copy
from pathlib import PurePosixPath
from typing import Self

from pipeline.base.errors import PlanError
from pipeline.base.layout import JobLayout
from pipeline.base.task import ArtifactPath, Task
from pipeline.model.job import Job
from pipeline.stages.base import Stage, TaskContext
from pipeline.stages.render_scene import camera_path, framed_points, view_at
from pipeline.store.cache import read_frame
from render.camera_path import View
from render.meshes import SurfaceMesh, read_ply
from render.poses import Placement
from render.spec import MovingMeshObject, RenderSpec, VolumeSequenceObject

PREFIX = "export-"  # begins the names of these stages; that of the format follows


class ExportStage(Stage):
    """A stage that hands frames over to other programs: parts of each frame, and one file to open.

    Attributes:
        format: its name, as `pipeline export --to` takes it.
        opened_by: how to open it, a sentence with {file}.
        frames: those that are chosen; None: all.
        of_one_range: whether its frames have to follow each other.
        refers_to: folders of the job whose files the export shows by relative paths instead of copying them.
    """

    on_demand = True
    format: str
    opened_by: str
    frames: frozenset[int] | None = None
    of_one_range: bool = False
    refers_to: tuple[str, ...] = ()

    @property
    def name(self) -> str:  # type: ignore[override]
        """Name of the stage."""
        return f"{PREFIX}{self.format}"

    def of_frames(self, frames: frozenset[int] | None) -> Self:
        """The same for some frames."""
        chosen = copy(self)
        chosen.frames = frames
        return chosen

    def root(self, job: Job) -> ArtifactPath:
        """The file to open, right below the job's folder: what it refers to lies beside it."""
        return ArtifactPath(f"{job.name}.{self.format}")

    def chosen(self, job: Job) -> list[int]:
        """The frames to export. Raises PlanError: one is not in the film."""
        frames = range(job.frame_count) if self.frames is None else sorted(self.frames)
        if frames and frames[-1] >= job.frame_count:
            raise PlanError(f"{job.name} has no frame {frames[-1]}; its frames are 0-{job.frame_count - 1}")
        if self.of_one_range and len(frames) != frames[-1] - frames[0] + 1:
            raise PlanError(f"{self.format} plays every frame from its first to its last; name one range, like 10-40")
        return list(frames)

    def require_meshes(self, spec: RenderSpec, name: str) -> None:
        """Raises PlanError: nothing of a job has a place in a format, called by this name, that has no volumes."""
        if all(isinstance(each, VolumeSequenceObject) for each in spec.objects):
            raise PlanError(f"the job has only smoke, and {name} has no volumes; use --to usd or --to blend")

    def left_out(self, job: Job) -> list[str]:  # noqa: ARG002
        """What of a job the format has no place for, in words."""
        return []

    def belonging(self, tasks: list[Task]) -> list[ArtifactPath]:
        """What has to lie together for the export to be whole, the file to open last."""
        mine = [task for task in tasks if task.stage == self.name]
        shown = [each for each in mine[-1].inputs if PurePosixPath(each).parts[0] in self.refers_to]
        return [*dict.fromkeys([*shown, *(output for task in mine for output in task.outputs)])]


def motion(
    context: TaskContext, spec: RenderSpec, frames: Collection[int]
) -> tuple[dict[str, dict[int, Placement]], dict[int, View]]:
    """Places of the objects that move as a whole, by frame, and views of the camera, one if it stands still."""
    job, layout = context.job, context.layout
    moving = [each for each in spec.objects if isinstance(each, MovingMeshObject)]
    placements: dict[str, dict[int, Placement]] = {each.name: {} for each in moving}
    camera = camera_path(job, framed_points(job, layout))
    views: dict[int, View] = {}
    for done, frame in enumerate(frames):
        poses = {}
        if job.moving_bodies:
            cached = read_frame(layout.path(layout.frame_cache(frame)), kind="rigid").bodies
            poses = {name: cached[name].arrays for name in job.moving_bodies}
        for each in moving:
            pose = poses[each.body]
            placements[each.name][frame] = Placement(pose["position"].tolist(), pose["orientation"].tolist())
        if camera.moves or not views:
            views[frame] = view_at(job, camera, frame, poses)
        context.progress(done, len(frames), "camera and bodies")
    return placements, views


def frame_of(artifact: ArtifactPath) -> int:
    """The frame in the name of a file of one frame."""
    return int(PurePosixPath(artifact).stem)


def read_meshes(layout: JobLayout, files: Mapping[str, str]) -> dict[str, SurfaceMesh]:
    """Meshes at rest of objects by name, of their files in the job's folder; objects of one file share it."""
    read = {file: read_ply(layout.root / file) for file in dict.fromkeys(files.values())}
    return {name: read[file] for name, file in files.items()}
