"""The preview movie: while a job draws its frames, a small film of those that are there, made anew now and then.

It cannot harm the run: one child process at a time, of low priority, encodes for at most `SHARE` of the time on one
core, and whatever becomes of it, the run goes on. A film is renamed when it has been decoded, so nobody sees a part of
one. What is left of a killed run is removed by the next.
"""

import json
import os
import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from typing import Self

from pipeline.base.layout import JobLayout
from pipeline.base.task import ArtifactPath, TaskId, TaskState
from pipeline.base.threads import thread_variables
from pipeline.model.job import Job
from pipeline.run.events import Committed, JobOutcome, RunEnded, RunEvent, RunStarted, StateChanged
from pipeline.run.executors.worker_process import python_argv
from pipeline.run.plan import NEVER_MADE, Assessment, Verdict

SHARE = 0.05
"""Of the time of one core, at most so much goes into preview movies [-]."""
SHORTEST_PAUSE_S = 10.0
"""Before the first film, and between two [s]; a job that takes less needs none."""
_LAST_WAIT_S = 10.0
"""How long the end of a run waits for the child that it has killed [s]; on a disk that is gone it may not end."""


class PreviewMovie:
    """Observer of a run, and context manager around it, that keeps `JobLayout.preview_movie` up to date.

    The film is there from some seconds after the first frame until the whole film is committed. A run that is stopped
    or fails leaves it. One of an earlier version of the job goes when a run begins, and any with a job that does
    without.
    """

    def __init__(self, job: Job, layout: JobLayout, say: Callable[[str], None], warn: Callable[[str], None]) -> None:
        """`say` and `warn` take sentences and warnings for the user, from another thread."""
        self._making = job.movie.so_far
        self._job = job
        self._layout = layout
        self._say = say
        self._warn = warn
        self._frames: dict[ArtifactPath, int] = {layout.picture(frame): frame for frame in range(job.frame_count)}
        self._film = layout.movie(job.movie.suffix)
        self._frame_of_task: dict[TaskId, int] = {}
        self._drawn: set[int] = set()
        self._shown = 0
        self._changed = threading.Condition()
        self._ended = False
        self._child: subprocess.Popen[str] | None = None
        self._thread = threading.Thread(target=self._work, name="preview movie", daemon=True)
        self._told: set[str] = set()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def notify(self, event: RunEvent) -> None:
        """Take note of frames that are drawn; nothing here takes time but the removal of a film."""
        match event:
            case RunStarted(assessments):
                self._start(assessments)
            case Committed(_, _, receipt) if receipt.artifact in self._frames:
                self._add(self._frames[receipt.artifact])
            case StateChanged(task_id, _, TaskState.UP_TO_DATE) if task_id in self._frame_of_task:
                self._add(self._frame_of_task[task_id])
            # At the commit already: a run that is killed between that and its end may be the job's last.
            case Committed(_, _, receipt) if receipt.artifact == self._film:
                self._remove()
            case RunEnded(outcome) if outcome.kind is JobOutcome.SUCCEEDED:
                self._remove()

    def _start(self, assessments: Sequence[Assessment]) -> None:
        for each in assessments:
            frame = self._frames.get(each.task.outputs[0]) if each.task.outputs else None
            if frame is not None:
                self._frame_of_task[each.task.id] = frame
                if each.verdict is Verdict.UP_TO_DATE:
                    self._drawn.add(frame)
        if not self._frame_of_task:  # a run that draws none
            return
        # The job is ours by now; these are of a run that was killed.
        shutil.rmtree(self._layout.preview_scratch, ignore_errors=True)
        if not self._drawn or any(
            _may_show_another(each) for each in assessments if each.task.id in self._frame_of_task
        ):
            self._unlink()
        if self._making and len(self._drawn) < len(self._frame_of_task):
            self._thread.start()

    def _add(self, frame: int) -> None:
        with self._changed:
            self._drawn.add(frame)
            self._changed.notify_all()

    def _remove(self) -> None:
        """The whole film is there, and this one of no use any more."""
        self._end()
        self._unlink()

    def _unlink(self) -> None:
        try:
            self._layout.preview_movie.unlink(missing_ok=True)
        except OSError as error:
            self._tell(
                self._warn, f"{self._layout.preview_movie} is out of date and cannot be removed: {error.strerror}"
            )

    def _end(self) -> None:
        """Kill the child and wait for the thread. May be called twice."""
        with self._changed:
            self._ended = True
            if self._child is not None:
                self._child.kill()
            self._changed.notify_all()
        if self._thread.is_alive():
            self._thread.join(_LAST_WAIT_S)

    def _tell(self, how: Callable[[str], None], sentence: str) -> None:
        """Each sentence once: what kept one film from being made keeps the next one, too."""
        if sentence not in self._told:
            self._told.add(sentence)
            how(sentence)

    # --- in the thread ---

    def _work(self) -> None:
        not_before = time.monotonic() + SHORTEST_PAUSE_S
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._ended or len(self._drawn) > self._shown)
                self._changed.wait_for(lambda: self._ended, max(0.0, not_before - time.monotonic()))
                drawn = sorted(self._drawn)
                if self._ended or len(drawn) == len(self._frame_of_task):
                    break  # with the last frame the film itself is near
            self._shown = len(drawn)
            began = time.monotonic()
            try:
                cost_s = self._make(drawn)
            except (OSError, _ChildError) as error:
                cost_s = time.monotonic() - began
                if not self._ended:
                    self._tell(self._warn, f"no preview movie could be made: {error}; the job goes on")
            else:
                self._tell(self._say, f"the preview movie, made anew now and then: {self._layout.preview_movie}")
            not_before = time.monotonic() + max(SHORTEST_PAUSE_S, cost_s / SHARE)
        shutil.rmtree(self._layout.preview_scratch, ignore_errors=True)

    def _make(self, drawn: Sequence[int]) -> float:
        """Have a film made of these frames; returns the processor time that took [s]. Raises _ChildError, OSError."""
        layout = self._layout
        scratch = layout.preview_scratch.absolute()
        scratch.mkdir(exist_ok=True)
        film = scratch / "film.mp4"
        request = {
            "pictures": {frame: str(layout.path(layout.picture(frame)).absolute()) for frame in drawn},
            "frames": self._job.frame_count,
            "fps": self._job.movie.playback_fps or self._job.fps,
            "output": str(film),
        }
        request_file = scratch / "request.json"
        request_file.write_text(json.dumps(request), encoding="utf-8")
        with self._changed:
            if self._ended:
                raise _ChildError("the run is over")
            self._child = subprocess.Popen(
                python_argv("pipeline.queue.preview_movie_child", str(request_file)),
                stdin=subprocess.PIPE,  # it ends when the other end of this is gone, and with it this process
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                encoding="utf-8",
                errors="replace",
                process_group=0,  # Ctrl-C is for the runner
                env={**os.environ, **thread_variables(1)},
            )
        with self._child as child:
            assert child.stdout is not None
            lines = child.stdout.read().strip().splitlines() or [""]
        with self._changed:
            self._child = None
        if child.returncode != 0:
            raise _ChildError(lines[-1] or f"its process ended with code {child.returncode}")
        film.replace(layout.preview_movie)
        return float(lines[-1])


def _may_show_another(assessment: Assessment) -> bool:
    """Whether a preview movie may hold a frame of the task as an earlier version of the job had it."""
    never_made = assessment.verdict is Verdict.STALE and all(each.group == NEVER_MADE for each in assessment.reasons)
    return assessment.verdict is not Verdict.UP_TO_DATE and not never_made


class _ChildError(Exception):
    """What a child process said last."""
