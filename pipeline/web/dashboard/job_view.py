"""View of one job: a page of its tasks, one task's story, frames, film, and the work that goes on."""

from __future__ import annotations

import time
import tomllib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

from pipeline.base.errors import ManifestError
from pipeline.base.layout import JobLayout
from pipeline.base.task import TaskId, TaskState
from pipeline.job.loading import MAX_BYTES
from pipeline.record.glance import glance
from pipeline.record.reader import AttemptRow, EventRow, ManifestReader, TaskPage, TaskRow
from pipeline.show.report.film import PLAYABLE
from pipeline.web.dashboard.estimates import DONE, LOST
from pipeline.web.dashboard.farm_view import JobCard, Picture, picture_of
from pipeline.web.dashboard.places import NotThereError, Places

PAGE_TASKS = 50
PAGE_PICTURES = 24
EVENTS = 12
LOG_BYTES = 24 * 1024
LONGEST_TEXT = 200
MOST_PAGES = 1_000_000

STATE_GROUPS: Mapping[str, tuple[TaskState, ...]] = {
    "running": (TaskState.RUNNING,),
    "failed": LOST,
    "waiting": (TaskState.PENDING, TaskState.READY, TaskState.CANCELLED),
    "done": DONE,
}
"""Groups of states that the list of tasks can be narrowed down to."""

USUAL_CODEC = "h264"
"""Of a job that names none; see `render.parameters.MovieParameters`."""


class Question(NamedTuple):
    """A question about a job, as the address of its page asks it."""

    stage: str = ""  # tasks of this stage only; empty: of all
    state: str = ""  # a key of STATE_GROUPS; empty: in any state
    text: str = ""  # tasks whose id contains this
    page: int = 1  # of the tasks, from 1
    pictures: int = 1  # page of the frames, from 1
    task: str = ""  # the task whose story is told; empty: none
    attempt: int = 0  # whose log is shown; 0: the last one

    @classmethod
    def of(cls, query: Mapping[str, str]) -> Question:
        """Read an address's query; what makes no sense counts as not said."""
        state = query.get("state", "")
        return cls(
            stage=query.get("stage", "")[:LONGEST_TEXT],
            state=state if state in STATE_GROUPS else "",
            text=query.get("text", "").strip()[:LONGEST_TEXT],
            page=_number(query.get("page", ""), 1),
            pictures=_number(query.get("pictures", ""), 1),
            task=query.get("task", "")[:LONGEST_TEXT],
            attempt=_number(query.get("attempt", ""), 0),
        )


class Film(NamedTuple):
    """A film that can be played."""

    path: str  # relative to the job's folder
    version: int  # changes with it
    finished: bool  # whether it is the whole film, not what there is so far
    size: int  # [bytes]
    is_playable: bool  # whether browsers play it; H.265 and ProRes they do not
    is_old: bool = False  # whether an earlier run made it, and it is to be made anew


class Work(NamedTuple):
    """A running attempt. `share` is its progress by the mean so far [-], None if that is not known."""

    task: TaskId
    attempt: int
    host: str
    elapsed_s: float
    share: float | None


class Story(NamedTuple):
    """One task: its row, its attempts, last first, and the end of a log, and whether that is not all of it."""

    row: TaskRow
    attempts: list[AttemptRow]
    shown: int
    log: str
    is_cut: bool


@dataclass(frozen=True)
class JobDetail:
    """A job as its page shows it."""

    card: JobCard  # its card in the list
    question: Question  # the question
    tasks: TaskPage  # the asked page of its tasks
    story: Story | None  # of the asked task; None if none was asked for, or there is none of the name
    pictures: list[Picture]  # the asked page of its frames, newest first
    film: Film | None  # the film, or its part so far
    has_report: bool  # whether its report has been written
    events: list[EventRow]  # the last ones, newest first
    work: list[Work]  # attempts that run

    @property
    def task_pages(self) -> int:
        """Number of pages of its tasks."""
        return max(1, -(-self.tasks.total // PAGE_TASKS))

    @property
    def picture_pages(self) -> int:
        """Number of pages of its frames."""
        return max(1, -(-self.card.record.pictures // PAGE_PICTURES))


class _Found(NamedTuple):
    tasks: TaskPage
    pictures: list[Picture]
    events: list[EventRow]
    row: TaskRow | None
    attempts: list[AttemptRow]
    old_films: tuple[str, ...]


MOVIES = tuple(JobLayout.movie(suffix) for suffix in (".mp4", ".mov"))
_NOTHING = _Found(TaskPage([], 0), [], [], None, [], ())


def look_at_job(places: Places, card: JobCard, question: Question) -> JobDetail:
    """Look at a job's folder; of a record that cannot be read nothing is shown, the card says why."""
    layout = JobLayout(places.farm / card.name)
    found = _NOTHING
    if not card.flaw and card.total:
        with suppress(ManifestError, OSError, ValueError):  # changed since; the next look says what it is
            found = glance(layout.manifest, lambda manifest: _ask(manifest, question))
    return JobDetail(
        card=card,
        question=question,
        tasks=found.tasks,
        story=_story(places, card, question, found),
        pictures=found.pictures,
        film=_dated(film_of(places, card), card, found),
        has_report=places.has(card.name, layout.report.name),
        events=found.events[::-1],
        work=_work(card),
    )


def _ask(manifest: ManifestReader, question: Question) -> _Found:
    states = STATE_GROUPS.get(question.state, ())
    tasks = manifest.task_page(
        stage=question.stage or None,
        states=states,
        text=question.text,
        limit=PAGE_TASKS,
        offset=(question.page - 1) * PAGE_TASKS,
    )
    pictures = manifest.newest_in("frames", ".png", limit=PAGE_PICTURES, offset=(question.pictures - 1) * PAGE_PICTURES)
    row = None
    if question.task:
        row = next((row for row in tasks.rows if row.task == question.task), None) or next(
            (row for row in manifest.task_page(text=question.task, limit=500).rows if row.task == question.task), None
        )
    return _Found(
        tasks=tasks,
        pictures=[picture for each in pictures if (picture := picture_of(each)) is not None],
        events=manifest.events(limit=EVENTS),
        row=row,
        attempts=[] if row is None else manifest.history(row.task)[::-1],
        old_films=tuple(movie for movie in MOVIES if manifest.is_old(movie)),
    )


def _story(places: Places, card: JobCard, question: Question, found: _Found) -> Story | None:
    if found.row is None:
        return None
    shown = next((each for each in found.attempts if each.number == question.attempt), None)
    shown = shown or (found.attempts[0] if found.attempts else None)
    log, size = "", 0
    if shown is not None and shown.log:
        with suppress(NotThereError, OSError):  # cleaned away, or not begun
            log, size = places.tail(card.name, shown.log, LOG_BYTES)
    return Story(found.row, found.attempts, 0 if shown is None else shown.number, log, size > LOG_BYTES)


def _work(card: JobCard) -> list[Work]:
    now = time.time()
    stages = {stage.name: stage for stage in card.record.stages}
    work = []
    for attempt in card.record.running:
        stage = stages.get(attempt.task.partition("/")[0])
        elapsed_s = max(0.0, now - attempt.started)
        share = None
        if stage is not None and stage.frames is not None:
            share = stage.frames[0] / max(1, stage.frames[1])
        elif stage is not None and stage.mean_s:
            share = min(0.97, elapsed_s / stage.mean_s)  # a mean is no promise
        work.append(Work(attempt.task, attempt.number, attempt.host, elapsed_s, share))
    return work


def film_of(places: Places, card: JobCard) -> Film | None:
    """The finished film of a job that is done, else the newer one of a film and the film so far."""
    so_far = JobLayout(places.farm / card.name).preview_movie.name
    films = []
    for name in (*MOVIES, so_far):
        with suppress(NotThereError, OSError):  # one goes in this moment, as at the end of a run
            status = places.file(card.name, name).stat()
            finished = name != so_far
            # The film so far is H.264.
            is_playable = not finished or (not name.endswith(".mov") and _codec(places, card.name) in PLAYABLE)
            films.append(Film(name, status.st_mtime_ns, finished, status.st_size, is_playable))
    return max(films, key=lambda film: (card.state == "done" and film.finished, film.version), default=None)


def _dated(film: Film | None, card: JobCard, found: _Found) -> Film | None:
    """A film that knows whether it is old; the film so far is as old as the newest frame, and is remade with it."""
    if film is None:
        return None
    newest = card.record.picture
    is_old = film.path in found.old_films if film.finished else newest is not None and newest.is_old
    return film._replace(is_old=is_old)


def _codec(places: Places, name: str) -> str:
    """Codec of a job's film, as its job file says; the usual one where that says nothing."""
    try:
        with places.file(name, JobLayout(places.farm / name).job_file.name).open("rb") as file:
            movie = tomllib.loads(file.read(MAX_BYTES + 1).decode("utf-8-sig")).get("movie")
    except (NotThereError, OSError, ValueError, RecursionError):  # whether its film is played the browser finds out
        return USUAL_CODEC
    return str(movie.get("codec", USUAL_CODEC)) if isinstance(movie, dict) else USUAL_CODEC


def _number(text: str, least: int) -> int:
    return min(max(int(text), least), MOST_PAGES) if text.isascii() and text.isdecimal() and len(text) < 9 else least
