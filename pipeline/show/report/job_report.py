"""What a report tells of a job, gathered from its folder."""

from __future__ import annotations

import tempfile
from base64 import b64encode
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from pipeline.base.errors import MissingInputError, PipelineError, StageUnavailableError
from pipeline.base.layout import JobLayout
from pipeline.base.quantities import COUNT_OF_FLUID
from pipeline.base.task import ArtifactPath, TaskState
from pipeline.job.loading import load_job
from pipeline.kinds.table import bodies
from pipeline.model.job import Job
from pipeline.record.reader import ManifestReader, StageTiming
from pipeline.run.assessment import assess_job
from pipeline.run.solver_numbers import Warned, simulation_numbers
from pipeline.show.picture_set import PictureSet, evenly_spread, picture_set
from pipeline.show.report.film import ReportFilm, film_of
from pipeline.show.report.panels import JobNumbers
from pipeline.show.report.versions import MadeWith, made_with

SHEET_PICTURES, SHEET_COLUMNS = 12, 4
SHEET_WIDTH = 1200
"""At most [pixels]; small pictures are not enlarged."""


@dataclass(frozen=True)
class JobReport:
    """A job as its report shows it.

    Attributes:
        job: the job as submitted.
        title: its name, or its folder where another job of the report has the same name.
        done: finished tasks.
        total: planned tasks.
        outcome: how the last run ended, or None.
        timings: what each stage has taken.
        numbers: what the solvers told.
        warnings: what they warned of.
        unreadable: frames of the cache that cannot be read.
        unreadable_whitewater: files of whitewater that cannot.
        drawn_on: number of frames by the device that drew them.
        sheet: its pictures side by side, as the bytes of a WebP picture; None before there are any.
        sheet_remark: what to say of the frames on it, and of those that are not; empty if there is nothing.
        film: None before there is one.
        versions: what made its files.
        text: of its job file, as submitted.
    """

    job: Job
    title: str
    done: int
    total: int
    outcome: str | None
    timings: tuple[StageTiming, ...]
    numbers: JobNumbers
    warnings: tuple[Warned, ...]
    unreadable: tuple[int, ...]
    unreadable_whitewater: tuple[ArtifactPath, ...]
    drawn_on: dict[str, int]
    sheet: bytes | None
    sheet_remark: str
    film: ReportFilm | None
    versions: tuple[MadeWith, ...]
    text: str

    @property
    def facts(self) -> dict[str, str]:
        """The job in a few words."""
        job, frames = self.job, self.numbers.frames
        width, height = job.render.resolution
        facts = {
            "frames": f"{job.frame_count}, {job.frame_count / job.fps:.3g} s at {job.fps:g} fps",
            "simulated": f"{len(frames)} frames" + (f" on {frames[-1].device}" if frames else ""),
            "tasks": f"{self.done:,} of {self.total:,} done"
            + (f", last run {self.outcome}" if self.outcome is not None else ""),
            "pictures": f"{width} × {height}, {job.render.quality} quality"
            + (f", drawn on {', '.join(self.drawn_on)}" if self.drawn_on else ""),
        }
        for _, kind, body in bodies(job):
            if fact := kind.facts(body, self._particle_count(body.name)):
                facts[body.name] = fact
        return facts

    def _particle_count(self, fluid: str) -> float | None:
        """Particles of a fluid in the last frame: of its own solver, or its part of those that share one."""
        solvers = self.numbers.frames[-1].solvers if self.numbers.frames else {}
        shared = next(
            (of[f"{COUNT_OF_FLUID}{fluid}"] for of in solvers.values() if f"{COUNT_OF_FLUID}{fluid}" in of), None
        )
        return solvers.get(fluid, {}).get("particle_count", shared)

    def as_json(self) -> dict[str, object]:
        """All numbers for machines."""
        frames = self.numbers.frames
        return {
            "name": self.title,
            "fps": self.job.fps,
            "frame_count": self.job.frame_count,
            "tasks": {"done": self.done, "total": self.total},
            "stages": [timing._asdict() for timing in self.timings],
            "warnings": [each.as_json() for each in self.warnings],
            "drawn_on": self.drawn_on,
            "unreadable_frames": list(self.unreadable),
            "unreadable_whitewater": list(self.unreadable_whitewater),
            "versions": [asdict(each) for each in self.versions],
            "frame": [frame.frame for frame in frames],
            "time_s": [frame.time_s for frame in frames],
            "solvers": {
                solver: {name: self.numbers.series(solver, name) for name in self.numbers.names(solver)}
                for solver in self.numbers.solvers
            },
            "total_mechanical_energy": self.numbers.total_energy(),
        }


def gather(layout: JobLayout, *, title: str) -> JobReport:
    """Look at a job's folder.

    Args:
        layout: the folder of a submitted job.
        title: what to call the job.

    Raises:
        PipelineError: the job file or the manifest cannot be used, or a picture is damaged.
    """
    job = load_job(layout.job_file)
    with ManifestReader.open_readonly(layout.manifest) as manifest:
        summary, timings, last = manifest.summary(), manifest.stage_timings(), manifest.last_run()
        drawn_on = manifest.devices("render")
        artifacts = manifest.artifacts()
    finished = (TaskState.SUCCEEDED, TaskState.UP_TO_DATE)
    simulation = simulation_numbers(layout, history=True)
    frames = picture_set(job, layout)
    return JobReport(
        job=job,
        title=title,
        done=sum(stage.counts.get(state, 0) for stage in summary for state in finished),
        total=sum(stage.total for stage in summary),
        outcome=last.outcome,
        timings=tuple(timings),
        numbers=JobNumbers(title, simulation.frames),
        warnings=tuple(simulation.warnings()),
        unreadable=simulation.unreadable,
        unreadable_whitewater=simulation.unreadable_whitewater,
        drawn_on=drawn_on,
        sheet=_sheet(layout, frames.all, picture_width=job.render.resolution[0]),
        sheet_remark=_remark(frames),
        film=film_of(layout, job, current=_current(job, layout), pictures=frames.unbroken),
        versions=tuple(made_with(layout, artifacts, stages=[timing.stage for timing in timings])),
        text=layout.job_file.read_text(encoding="utf-8"),
    )


def as_data(picture: bytes) -> str:
    """A WebP picture as an address that holds it."""
    return f"data:image/webp;base64,{b64encode(picture).decode()}"


def _current(job: Job, layout: JobLayout) -> frozenset[ArtifactPath] | None:
    """The files of the job as it is now; None where that cannot be told, as when a mesh of the job was moved away."""
    try:
        return assess_job(job, layout).current
    except (MissingInputError, StageUnavailableError):
        return None


def _remark(frames: PictureSet) -> str:
    """What to say of the frames on the sheet, and of those that are not on it."""
    left_out = f"{frames.earlier} frames are of an earlier version of the job, and not shown" if frames.earlier else ""
    return "; ".join(filter(None, [left_out, frames.remark]))


def _sheet(layout: JobLayout, pictures: Sequence[Path], *, picture_width: int) -> bytes | None:
    from render.errors import InvalidFileError
    from render.sheet import contact_sheet

    if not pictures:
        return None
    chosen = evenly_spread(pictures, SHEET_PICTURES)
    width = min(SHEET_WIDTH, SHEET_COLUMNS * (picture_width + 8))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "sheet.webp")
        try:
            contact_sheet(chosen, path, columns=SHEET_COLUMNS, width=width)
        except (InvalidFileError, ValueError) as error:
            raise PipelineError(f"cannot put the frames of {layout.root} on a sheet: {error}") from error
        return path.read_bytes()
