"""One worker process as its supervisor sees it: how it is started, watched and ended."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import ExitStack, suppress
from dataclasses import replace
from math import inf
from pathlib import Path

import psutil

from pipeline.base.files import make_folder
from pipeline.base.memory import machine_memory_bytes, out_of_memory_kills, process_tree, tree_memory_bytes
from pipeline.base.task import FailureKind
from pipeline.base.threads import thread_variables
from pipeline.run.events import Failed, Progress
from pipeline.run.executors.base import Assignment
from pipeline.run.executors.channel import Channel
from pipeline.run.executors.failures import means_gpu_error
from pipeline.run.executors.worker import STACK_DUMP_SIGNAL
from render.temporary_folder import environment_of_child

PREPARATION_S = 4 * 3600.0
"""How long a worker may be silent while it prepares what is done once on a machine, such as Cycles' kernels [s]."""
_LOG_TAIL_LINES = 20
_DRIVER_LINES = 200
"""Within so many of a log's last lines a driver's complaint is looked for: the stacks of all threads follow it."""
WorkerKey = tuple[str, int, int | None]
"""Stage, thread count and GPU."""
_LOG_TAIL_BYTES = 16_384
_COMMAND_SHOWN = 100
"""How much of a command line is shown [characters]."""


class WorkerProcess:
    """A process that runs one assignment after another, in a session and process group of its own.

    It is warm for the stage, thread count and GPU of its `key`. Times are monotonic [s].
    """

    def __init__(self, key: WorkerKey, first: Assignment) -> None:
        self.key = key
        self.assignment: Assignment | None = None
        self.idle = False
        self.single_use = False  # to be replaced after the task that it ended last
        self.tasks_done = 0
        self.began = self.last_sign = time.monotonic()
        self.limited_since = self.began  # since when the assignment's limit of time counts; inf: not yet, it prepares
        self.peak_memory_bytes = 0  # most that it and all it started were seen to hold together during its assignment
        self.kill_at: float | None = None  # when its process group is killed
        self.verdict: tuple[FailureKind, str] | None = None  # what its task fails of, when it is us who end it
        self._out_of_memory_kills = 0
        self._process, self.channel, self._scratch = _spawn(first)
        self.exit_descriptor = _open_exit_descriptor(self._process.pid)

    @property
    def pid(self) -> int:
        """Process id; that of its group as well."""
        return self._process.pid

    @property
    def stall_s(self) -> float:
        """How long its assignment may be silent now [s]."""
        assert self.assignment is not None
        return PREPARATION_S if self.limited_since == inf else self.assignment.stall_s

    def assign(self, assignment: Assignment) -> None:
        """Hand over an attempt."""
        self.idle = False
        self.assignment = assignment
        self.verdict = None
        self.began = self.last_sign = self.limited_since = time.monotonic()
        self.peak_memory_bytes = 0
        self._out_of_memory_kills = out_of_memory_kills()
        self.channel.send(assignment)

    def note_progress(self, progress: Progress) -> None:
        """What it prepares once for this machine takes what it takes; its limit of time counts anew from the end."""
        if progress.preparing:
            self.limited_since = inf
        elif self.limited_since == inf:
            self.limited_since = time.monotonic()

    def end_assignment(self, *, failed: bool) -> None:
        """The attempt is over; what was planned against it is off.

        A worker is not used again after a failure, whose traces it may carry, nor after a long task, as its memory is
        wanted by the stages that follow.
        """
        assert self.assignment is not None
        self.single_use = failed or self.assignment.task.checkpointed
        self.assignment = None
        self.verdict = None
        self.kill_at = None
        self.tasks_done += 1

    def look_at_memory(self) -> int:
        """Resident memory of it and all that it started, now [bytes]; the peak takes note of it."""
        size = tree_memory_bytes(self.pid)
        self.peak_memory_bytes = max(self.peak_memory_bytes, size)
        return size

    def leave_evidence(self, sentence: str) -> None:
        """Write into its task's log why it is ended, and what its processes are doing; then their stacks.

        A process that was stopped from outside is continued for that, as it could write nothing.
        """
        assert self.assignment is not None
        lines = [f"the runner ends this attempt: {sentence}", *map(_describe_process, process_tree(self.pid))]
        with suppress(OSError), self.assignment.log.open("a", encoding="utf-8") as log:  # on a full disk, without
            log.write("\n".join(lines) + "\n")
        with suppress(ProcessLookupError):
            self._process.send_signal(STACK_DUMP_SIGNAL)
            self._process.send_signal(signal.SIGCONT)

    def explain_failure(self, failed: Failed) -> Failed:
        """What it says of its task; but a Blender that the kernel killed looks like one that was lost."""
        self.peak_memory_bytes = max(failed.peak_memory_bytes, self.peak_memory_bytes)
        failed = replace(failed, peak_memory_bytes=self.peak_memory_bytes)
        if failed.kind is FailureKind.WORKER_LOST and self._memory_ran_out():
            sentence = f"{failed.message}; the kernel killed it: {self._memory_held()}"
            return replace(failed, kind=FailureKind.OUT_OF_MEMORY, message=sentence)
        return failed

    def end_by(self, deadline: float, kind: FailureKind, sentence: str) -> None:
        """Kill it at `deadline`, monotonic [s], unless that was to happen earlier already."""
        if self.kill_at is None or deadline < self.kill_at:
            self.kill_at = deadline
        self.verdict = self.verdict or (kind, sentence)

    def kill(self) -> None:
        """Kill it with everything that it started."""
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)

    def has_exited(self) -> bool:
        """Whether the process is gone."""
        return self._process.poll() is not None

    def explain_exit(self) -> tuple[FailureKind, str]:
        """What its task failed of, now that the process is gone."""
        if self.verdict is not None:
            return self.verdict
        code = self._process.returncode
        if code == -signal.SIGKILL and self._memory_ran_out():
            sentence = f"the kernel killed worker {self._process.pid}: {self._memory_held()}"
            return FailureKind.OUT_OF_MEMORY, sentence
        if self.key[2] is not None and self.assignment is not None:  # some drivers end the process
            lines = log_tail(self.assignment.log, _DRIVER_LINES).splitlines()
            if words := next(filter(means_gpu_error, reversed(lines)), ""):
                return FailureKind.GPU_ERROR, f"worker {self._process.pid} ended after a GPU error: {words.strip()}"
        how = f"died of {_signal_name(-code)}" if code < 0 else f"exited with code {code}"
        return FailureKind.WORKER_LOST, f"worker {self._process.pid} {how} in the middle of its task"

    def _memory_ran_out(self) -> bool:
        """Whether the kernel has killed a process for want of memory since the assignment was given."""
        return out_of_memory_kills() > self._out_of_memory_kills

    def _memory_held(self) -> str:
        held, machine = self.peak_memory_bytes / 1e9, machine_memory_bytes() / 1e9
        return f"the machine is out of memory, of {machine:.3g} GB its processes held {held:.3g}"

    def close(self) -> None:
        """Give its descriptors back, and remove its temporary folder."""
        self.channel.close()
        if self.exit_descriptor is not None:
            os.close(self.exit_descriptor)
        self._scratch.close()


def log_tail(log: Path, lines: int = _LOG_TAIL_LINES) -> str:
    """The last lines of a log; empty if there is none, or none that can be read."""
    try:
        with log.open("rb") as file:
            file.seek(0, os.SEEK_END)
            file.seek(max(0, file.tell() - _LOG_TAIL_BYTES))
            text = file.read().decode(errors="replace")
    except OSError:  # on a shared disk anything can be; the failure that it was to explain matters more
        return ""
    return "\n".join(text.splitlines()[-lines:])


def python_argv(module: str, *words: str) -> list[str]:
    """Arguments that run a module's `main` in a fresh interpreter, which finds modules where this one does."""
    boot = f"import json, sys; sys.path[:] = json.loads(sys.argv.pop()); from {module} import main; main()"
    return [sys.executable, "-c", boot, *words, json.dumps([str(Path(entry).absolute()) for entry in sys.path])]


def _describe_process(pid: int) -> str:
    try:
        process = psutil.Process(pid)
        with process.oneshot():
            times, memory, command = process.cpu_times(), process.memory_info().rss, " ".join(process.cmdline())
            return (
                f"  process {pid}, {process.status()}, {times.user + times.system:.1f} s of processor time, "
                f"{memory / 1e6:.0f} MB: {command[:_COMMAND_SHOWN]}"
            )
    except psutil.Error:
        return f"  process {pid} has ended"


def _spawn(first: Assignment) -> tuple[subprocess.Popen[bytes], Channel, ExitStack]:
    """Start a fresh interpreter; what it prints before its first task goes into that task's log.

    Its temporary folder is its own, as Blender and Taichi leave theirs behind where they are killed. The last of what
    is returned removes it.
    """
    make_folder(first.log.parent, within=first.root)
    ours, theirs = socket.socketpair()
    with ExitStack() as on_failure, theirs, first.log.open("ab") as log:
        on_failure.enter_context(ours)
        # What somebody still writes goes with the worker's guardian.
        scratch = on_failure.enter_context(ExitStack())
        environment = scratch.enter_context(environment_of_child("worker"))
        process = subprocess.Popen(
            python_argv("pipeline.run.executors.worker", str(theirs.fileno()), str(os.getpid()), environment["TMPDIR"]),
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            pass_fds=[theirs.fileno()],
            start_new_session=True,
            env={**environment, **thread_variables(first.threads)},
        )
        on_failure.pop_all()
    return process, Channel(ours), scratch


def _open_exit_descriptor(pid: int) -> int | None:
    """A descriptor that becomes readable when the process ends, where the system has such."""
    if not hasattr(os, "pidfd_open"):
        return None
    try:
        return os.pidfd_open(pid)
    except OSError:  # a kernel before 5.3, or a sandbox that forbids it: exits are then polled for
        return None


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
