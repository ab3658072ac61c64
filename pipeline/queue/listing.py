"""All jobs of a farm, each with its state: what `pipeline status` shows."""

from dataclasses import dataclass

from pipeline.base.errors import OutdatedManifestError, PipelineError
from pipeline.base.layout import JobLayout
from pipeline.base.lease import live_holder
from pipeline.base.places import check_places
from pipeline.queue.job_queue import JobQueue, QueuedJob
from pipeline.queue.states import JobState, state_after, state_of
from pipeline.record.reader import LastRun, ManifestReader, done_and_total, record_of
from pipeline.store.artifacts import holds_frames


@dataclass(frozen=True, slots=True)
class ListedJob:
    """A job in a line."""

    name: str  # of its folder
    state: JobState
    priority: int | None  # in the queue; None: it is not in it
    changed: float  # when it was submitted, or, out of the queue, when something last happened [s since the epoch]
    done: int = 0  # how many of its tasks are done
    tasks: int = 0  # how many there are; 0 before its first run
    note: str = ""  # why it pauses or failed, or empty


def list_jobs(queue: JobQueue) -> tuple[list[ListedJob], list[str]]:
    """The jobs of a farm: those of the queue in the order in which they run, then the others, newest first.

    Returns the jobs, and a sentence about each record or entry that cannot be read.
    """
    listing = queue.listing()
    flaws = [*listing.flaws]
    queued = [_listed(queue.layout(entry.name), entry, flaws) for entry in listing.jobs]
    names = {job.name for job in queued}
    folders = sorted(queue.farm.iterdir()) if queue.farm.is_dir() else []
    others = [
        _listed(JobLayout(folder), None, flaws)
        for folder in folders
        if folder.name not in names and not folder.name.startswith(".") and _holds_job(JobLayout(folder), flaws)
    ]
    return queued + sorted(others, key=lambda job: -job.changed), flaws


def state_of_job(layout: JobLayout, entry: QueuedJob | None) -> JobState:
    """Where a job stands. Raises ManifestError if its record cannot be read."""
    runs = live_holder(layout.lease) is not None
    if entry is not None:
        return state_of(entry, runs=runs)
    last_run, is_empty = LastRun(None, None), True
    if layout.manifest.exists():
        with ManifestReader.open_readonly(layout.manifest) as manifest:
            last_run, is_empty = manifest.last_run(), manifest.is_empty()
    return state_by_record(layout, last_run, runs=runs, is_empty=is_empty, is_recording=layout.recording_story.exists())


def state_by_record(
    layout: JobLayout, last_run: LastRun, *, runs: bool, is_empty: bool, is_recording: bool
) -> JobState:
    """Where a job stands that is not in the queue; its record may be empty, and its folder that of a recording."""
    if runs:
        return JobState.RUNNING
    if last_run.run is not None:
        return state_after(last_run.outcome)
    if is_recording:
        return JobState.RECORDED
    # A record may be lost, and knows no run then; that of a recording that crashed is empty, as it is filled last.
    return JobState.NOT_STARTED if is_empty and not holds_frames(layout) else JobState.INTERRUPTED


def _listed(layout: JobLayout, entry: QueuedJob | None, flaws: list[str]) -> ListedJob:
    name, note = layout.root.name, "" if entry is None else entry.note
    priority = None if entry is None else entry.priority
    changed = _last_change(layout) if entry is None else entry.submitted
    try:
        check_places(layout)
        state = state_of_job(layout, entry)
        done, tasks = done_and_total(record_of(layout)[0])
    except OutdatedManifestError:  # the next run brings it up to date
        return ListedJob(name, JobState.INTERRUPTED, priority, changed, note=note)
    except (PipelineError, OSError) as error:
        flaws.append(f"{name}: {error}")
        state = JobState.UNKNOWN if entry is None else state_of(entry, runs=False)
        return ListedJob(name, state, priority, changed, note=note)
    return ListedJob(name, state, priority, changed, done, tasks, note)


def _holds_job(layout: JobLayout, flaws: list[str]) -> bool:
    try:
        return layout.job_file.is_file() or layout.manifest.is_file()
    except OSError as error:
        flaws.append(f"{layout.root}: {error.strerror}")
        return False


def _last_change(layout: JobLayout) -> float:
    return max((path.stat().st_mtime for path in (layout.manifest, layout.job_file) if path.exists()), default=0.0)
