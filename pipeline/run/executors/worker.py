"""Entry point of a worker process: takes assignments from the supervisor, one after another, and stays warm.

A worker leads its own session and dies with its supervisor, and nothing that it started outlives it:

- `PR_SET_PDEATHSIG` (Linux) kills it when the thread that started it ends; everywhere else the end of the channel does.
- A *guardian*, a shell in the worker's process group that waits for the worker's end, removes the worker's temporary
  folder and kills the rest of the group: an external Blender for example, which knows nothing of us.
"""

import ctypes
import faulthandler
import os
import signal
import socket
import subprocess
import sys
import threading
import traceback
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from types import FrameType

from pipeline.base.files import make_folder
from pipeline.base.task import TaskId
from pipeline.run.events import Failed, Finished, TaskEvent
from pipeline.run.executors.attempt import run_attempt
from pipeline.run.executors.base import Assignment
from pipeline.run.executors.channel import WorkerChannel

STACK_DUMP_SIGNAL = signal.SIGUSR1
"""Makes a worker write the stacks of all its threads into the log of its task."""

_PR_SET_PDEATHSIG = 1
_OOM_SCORE = "500"
"""Out of memory, the kernel takes a worker rather than the runner, which loses nothing by it."""


@dataclass(frozen=True, slots=True)
class StopAttempt:
    """To the worker: the attempt should checkpoint and return."""

    task_id: TaskId
    attempt: int


def main() -> None:
    """Serve the channel that is in the arguments, with the supervisor: `worker FD SUPERVISOR_PID TEMPORARY_FOLDER`."""
    descriptor, supervisor, scratch = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
    _start_guardian(scratch)
    _die_with(supervisor)
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(_OOM_SCORE)
    faulthandler.enable()
    faulthandler.register(STACK_DUMP_SIGNAL, all_threads=True)
    _Worker(WorkerChannel(socket.socket(fileno=descriptor))).serve()


class _Worker:
    def __init__(self, channel: WorkerChannel) -> None:
        self._channel = channel
        self._assignments: SimpleQueue[Assignment | None] = SimpleQueue()
        self._current: tuple[TaskId, int] | None = None
        self._stop = threading.Event()
        self._terminated = False

    def serve(self) -> None:
        """Run assignments until the supervisor closes the channel or somebody sends SIGTERM."""
        signal.signal(signal.SIGTERM, self._on_terminate)
        threading.Thread(target=self._listen, name="supervisor", daemon=True).start()
        while not self._terminated and (assignment := self._assignments.get()) is not None:
            run_attempt(
                assignment,
                self._emit,
                stop_requested=self._stop.is_set,
                prepare=partial(redirect_output, assignment.log, within=assignment.root),
            )

    def _emit(self, event: TaskEvent) -> None:
        if isinstance(event, Finished | Failed):
            self._current = None  # before the supervisor has the event, and sends the next assignment
        self._channel.send(event)

    def _listen(self) -> None:
        """Sort the supervisor's messages; runs in its own thread, so that a stop reaches a task that is running."""
        try:
            while True:
                message: Assignment | StopAttempt = self._channel.receive()
                if isinstance(message, Assignment):
                    self._stop.clear()
                    self._current = (message.task.id, message.attempt)
                    self._assignments.put(message)
                elif self._current == (message.task_id, message.attempt):
                    self._stop.set()
        except (EOFError, ConnectionError):
            pass
        except Exception:  # a message that cannot be read, say; nobody else would ever notice
            traceback.print_exc()
            os._exit(1)
        if self._current is not None:  # the supervisor died in the middle of our task
            _end_with_all()
        self._assignments.put(None)

    def _on_terminate(self, _signal: int, _frame: FrameType | None) -> None:
        self._terminated = True
        self._stop.set()
        self._assignments.put(None)


def redirect_output(log: Path, *, within: Path) -> None:
    """Send descriptors 1 and 2 to the end of a log file, so that what C libraries print gets there as well."""
    make_folder(log.parent, within=within)
    sys.stdout.flush()
    sys.stderr.flush()
    ctypes.CDLL(None).fflush(None)
    descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o644)
    try:
        os.dup2(descriptor, 1)
        os.dup2(descriptor, 2)
    finally:
        os.close(descriptor)


def _die_with(supervisor: int) -> None:
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != supervisor:  # it died before we asked to be told
        _end_with_all()


def _end_with_all() -> None:
    """End this process at once; the guardian ends the others of its group."""
    os.kill(os.getpid(), signal.SIGKILL)


def _start_guardian(scratch: str) -> None:
    """Start a shell that outlives this process by a moment, and takes `scratch` and the rest of the group with it.

    It waits for the end of a pipe whose other end is open in this process alone, and never closed by it: only the
    kernel does that, however this process ends.
    """
    reading, _never_closed = os.pipe()
    subprocess.Popen(
        ["/bin/sh", "-c", "trap '' TERM INT HUP; read _; rm -rf -- \"$1\"; kill -s KILL 0", "guardian", scratch],
        stdin=reading,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    os.close(reading)
