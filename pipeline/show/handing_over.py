"""Exports as they are given away: which files belong together, and copies of them."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from pipeline.base.errors import PipelineError
from pipeline.base.files import replacing
from pipeline.base.layout import JobLayout
from pipeline.base.lease import refuse_if_held
from pipeline.base.task import ArtifactPath
from pipeline.base.wording import counted
from pipeline.model.job import Job
from pipeline.run.plan import frame_ranges, parse_end, plan_job
from pipeline.stages.base import Stage
from pipeline.stages.export import PREFIX, ExportStage


@dataclass(frozen=True)
class Export:
    """What was exported.

    Attributes:
        stage: what made it.
        root: the file to open.
        files: all that has to lie together, that one last.
        frames: those that are in it.
        bytes: of all files.
        left_out: what of the job the format has no place for.
    """

    stage: ExportStage
    root: ArtifactPath
    files: tuple[ArtifactPath, ...]
    frames: tuple[int, ...]
    bytes: int
    left_out: tuple[str, ...]

    @property
    def told(self) -> str:
        """Its frames, for people."""
        steps = {later - earlier for earlier, later in pairwise(self.frames)}
        if len(steps) == 1 and steps != {1}:
            ranges = f"{self.frames[0]}-{self.frames[-1]}x{steps.pop()}"
        else:
            ranges = frame_ranges(self.frames, range(max(self.frames) + 1))
        return f"{counted(len(self.frames), 'frame')} ({ranges})"


def survey_export(job: Job, layout: JobLayout, stages: Sequence[Stage], end: str) -> Export:
    """The export that a run until `end`, as `export-vtk:0-9`, has made."""
    tasks = plan_job(job, layout, stages, (end,))
    name, frames = parse_end(end)
    stage = next(each for each in stages if each.name == name).of_frames(frames)
    assert isinstance(stage, ExportStage)
    files = tuple(stage.belonging(tasks))
    size = sum(layout.path(each).stat().st_size for each in files)
    return Export(stage, stage.root(job), files, tuple(stage.chosen(job)), size, tuple(stage.left_out(job)))


def copy_export(export: Export, layout: JobLayout, target: Path) -> int:
    """Copy an export into a folder, complete in itself; returns how many files were not there already.

    Raises PipelineError: the folder cannot be written to.
    """
    copied = 0
    for artifact in export.files:
        source, copy = layout.path(artifact), target / artifact
        status = source.stat()
        try:
            there = copy.stat() if copy.is_file() else None
            if there is not None and (there.st_size, there.st_mtime_ns) == (status.st_size, status.st_mtime_ns):
                continue
            with replacing(copy) as part:
                shutil.copy2(source, part)
        except OSError as error:
            raise PipelineError(f"{copy} cannot be written: {error.strerror}") from error
        copied += 1
    return copied


def refuse_if_busy(layout: JobLayout, until: Sequence[str] | None) -> None:
    """Refuse to export a job that is being made or waits for its turn: an export would take its film's place.

    `until` are the stages after which it ends that waits in the queue; None: nothing waits. An export may be replaced.
    Raises PipelineError.
    """
    refuse_if_held(layout.lease)
    if until is not None and not (until and all(end.startswith(PREFIX) for end in until)):
        raise PipelineError(
            f"{layout.root} waits in the queue, and an export would take its place; let it end, or: "
            f"pipeline cancel {layout.root}"
        )
