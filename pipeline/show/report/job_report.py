"""What a report tells of a job, gathered from its folder."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from pipeline.base.errors import MissingInputError, PipelineError, StageUnavailableError
from pipeline.base.layout import JobLayout
from pipeline.base.quantities import COUNT_OF_FLUID
from pipeline.base.task import ArtifactPath
from pipeline.job.loading import load_job
from pipeline.kinds.table import bodies
from pipeline.model.job import Job
from pipeline.record.reader import ManifestReader, StageTiming, done_and_total
from pipeline.run.assessment import assess_job
from pipeline.run.solver_numbers import CountedWarning, simulation_numbers
from pipeline.show.picture_set import PictureSet, evenly_spread, picture_set
from pipeline.show.report.film import ReportFilm, film_of
from pipeline.show.report.panels import JobNumbers
from pipeline.store.provenance import origins_of
from pipeline.store.receipts import read_receipt
from render.errors import InvalidFileError
from render.sheet import contact_sheet
from render.temporary_folder import temporary_folder

LEFT = "particles_removed"  # of a fluid's diagnostics: those that passed an open face, since the start
SHEET_PICTURES, SHEET_COLUMNS = 12, 4
SHEET_WIDTH = 1200  # at most [pixels]; small pictures are not enlarged


@dataclass(frozen=True, slots=True)
class MadeWith:
    """What made some files of a stage."""

    stage: str
    tools: Mapping[str, str]  # versions of the stage and of its tools; empty if the parameters were not kept
    maker: str  # program, Python and kind of machine
    host: str
    files: int  # how many


@dataclass(frozen=True)
class JobReport:
    """A job as its report shows it."""

    job: Job
    title: str  # its name, or its folder where another job of the report has the same name
    done: int  # tasks
    total: int  # planned tasks
    outcome: str | None  # of the last run
    timings: tuple[StageTiming, ...]
    numbers: JobNumbers
    warnings: tuple[CountedWarning, ...]
    unreadable: tuple[int, ...]  # frames of the cache
    unreadable_whitewater: tuple[ArtifactPath, ...]
    drawn_on: dict[str, int]  # number of frames by device
    sheet: bytes | None  # its pictures side by side, as a WebP picture; None before there are any
    sheet_remark: str  # on the frames that are on it and those that are not
    film: ReportFilm | None
    versions: tuple[MadeWith, ...]
    text: str  # of its job file

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
        left = [
            f"{int(of[LEFT]):,} {'particle' if of[LEFT] == 1 else 'particles'} of {solver.replace('+', ' and ')}"
            for solver, of in (frames[-1].solvers if frames else {}).items()
            if of.get(LEFT)
        ]
        return {**facts, "left the domain": ", ".join(left)} if left else facts

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
    """Look at the folder of a submitted job.

    Raises PipelineError if the job file or the manifest cannot be used, or a picture is damaged.
    """
    job = load_job(layout.job_file)
    with ManifestReader.open_readonly(layout.manifest) as manifest:
        summary, timings, last = manifest.summary(), manifest.stage_timings(), manifest.last_run()
        drawn_on = manifest.devices("render")
        artifacts = manifest.artifacts()
    done, total = done_and_total(summary)
    simulation = simulation_numbers(layout, history=True)
    frames = picture_set(job, layout)
    return JobReport(
        job=job,
        title=title,
        done=done,
        total=total,
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


def made_with(layout: JobLayout, artifacts: Iterable[ArtifactPath], *, stages: Sequence[str]) -> list[MadeWith]:
    """What made which artifacts, by their receipts, in the order of `stages`."""
    tools: dict[str, tuple[tuple[str, str], ...]] = {}
    files: Counter[tuple[str, tuple[tuple[str, str], ...], str, str]] = Counter()
    for path in artifacts:
        receipt = read_receipt(layout, path)
        if receipt is None:
            continue
        if receipt.parameters not in tools:
            (origin,) = origins_of(layout, [receipt])
            tools[receipt.parameters] = tuple((origin.tools or {}).items())
        files[receipt.stage, tools[receipt.parameters], receipt.maker, receipt.host] += 1
    found = [MadeWith(stage, dict(tools), maker, host, count) for (stage, tools, maker, host), count in files.items()]
    place = {stage: index for index, stage in enumerate(stages)}
    return sorted(found, key=lambda each: place.get(each.stage, len(place)))


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
    if not pictures:
        return None
    chosen = evenly_spread(pictures, SHEET_PICTURES)
    width = min(SHEET_WIDTH, SHEET_COLUMNS * (picture_width + 8))
    with temporary_folder("report") as folder:
        path = folder / "sheet.webp"
        try:
            contact_sheet(chosen, path, columns=SHEET_COLUMNS, width=width)
        except (InvalidFileError, ValueError) as error:
            raise PipelineError(f"cannot put the frames of {layout.root} on a sheet: {error}") from error
        return path.read_bytes()
