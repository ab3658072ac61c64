"""The executor for looking into a stage: runs each assignment here and now, where a debugger can follow it."""

import time
from collections import deque
from contextlib import ExitStack, redirect_stderr, redirect_stdout
from dataclasses import replace

from pipeline.base.files import make_folder
from pipeline.base.task import FailureKind, TaskId
from pipeline.model.gpus import first_gpu
from pipeline.run.events import Failed
from pipeline.run.executors.attempt import run_attempt
from pipeline.run.executors.base import Assignment, Executor


class InlineExecutor(Executor):
    """Runs one assignment per `wait`, in the calling process; what it prints goes into the attempt's log.

    Nothing interrupts a running task here, so `cancel` and timeouts act only on tasks that have not begun, and what a
    C library prints stays on the terminal.
    """

    def __init__(self) -> None:
        super().__init__()
        self._queue: deque[Assignment] = deque()

    def submit(self, assignment: Assignment) -> None:
        """Put the attempt into the queue."""
        # A simulation would leave this very process its own GPU alone, and the frames may have another.
        if assignment.need.gpus and not assignment.task.lowest_gpu:
            assignment = replace(assignment, gpu=first_gpu(assignment.task))
        self._queue.append(assignment)

    def _turn(self, timeout_s: float) -> None:
        """Run the next assignment to its end, however long that takes."""
        if not self._events and self._queue:
            self._run(self._queue.popleft())
        elif not self._events:
            time.sleep(max(0.0, timeout_s))

    def cancel(self, task_id: TaskId, *, grace_s: float) -> None:  # noqa: ARG002 - nothing that runs can be here
        """Take a task out of the queue."""
        for assignment in [assignment for assignment in self._queue if assignment.task.id == task_id]:
            self._queue.remove(assignment)
            self._events.append(Failed(task_id, assignment.attempt, FailureKind.CANCELLED, "cancelled"))

    def shutdown(self) -> None:
        """Take everything out of the queue."""
        for assignment in list(self._queue):
            self.cancel(assignment.task.id, grace_s=0.0)

    def _run(self, assignment: Assignment) -> None:
        with ExitStack() as output:

            def open_log() -> None:
                make_folder(assignment.log.parent, within=assignment.root)
                log = output.enter_context(assignment.log.open("a", encoding="utf-8"))
                output.enter_context(redirect_stdout(log))
                output.enter_context(redirect_stderr(log))

            run_attempt(assignment, self._events.append, stop_requested=lambda: False, prepare=open_log)
