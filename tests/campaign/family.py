"""Every process of a campaign: what runs, what it cost, and that nothing is left over."""

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable

import psutil

from tests.helpers.processes_seen import lives, words_of

_PR_SET_CHILD_SUBREAPER = 36
_PR_CAPBSET_DROP = 24
_CAP_DAC_OVERRIDE, _CAP_DAC_READ_SEARCH = 1, 2


class Family:
    """All descendants of this process. Orphans come to it, so that none can hide and the cost of each is known."""

    def __init__(self) -> None:
        if sys.platform != "linux":
            raise SystemExit("the campaign needs Linux: it adopts orphans (PR_SET_CHILD_SUBREAPER)")
        libc = ctypes.CDLL(None, use_errno=True)
        libc.prctl(_PR_SET_CHILD_SUBREAPER, 1)
        # A folder without write permission would be none to the children of root.
        for capability in (_CAP_DAC_OVERRIDE, _CAP_DAC_READ_SEARCH):
            libc.prctl(_PR_CAPBSET_DROP, capability)
        self.processor_s = 0.0
        """Processor time of all that have ended so far [s]."""
        self._codes: dict[int, int] = {}

    def adopt(self, child: subprocess.Popen[bytes]) -> subprocess.Popen[bytes]:
        """Watch a child that was started just now: how an earlier process of the same number ended is forgotten."""
        self._codes.pop(child.pid, None)
        return child

    def reap(self) -> None:
        """Take note of all that have ended."""
        while True:
            try:
                pid, status, usage = os.wait4(-1, os.WNOHANG)
            except ChildProcessError:
                return
            if pid == 0:
                return
            self.processor_s += usage.ru_utime + usage.ru_stime
            self._codes[pid] = os.waitstatus_to_exitcode(status)

    def exit_code(self, pid: int) -> int | None:
        """How a child of this process ended; None while it runs."""
        self.reap()
        return self._codes.get(pid)

    def wait(self, pid: int, timeout_s: float) -> int:
        """Wait for a child's end."""
        until = time.monotonic() + timeout_s
        while (code := self.exit_code(pid)) is None:
            if time.monotonic() > until:
                raise TimeoutError(f"process {pid} has not ended after {timeout_s:g} s")
            time.sleep(0.01)
        return code

    def living(self) -> list[psutil.Process]:
        """All that live."""
        self.reap()
        return [each for each in psutil.Process().children(recursive=True) if lives(each)]

    def workers(self) -> list[psutil.Process]:
        """Worker processes, whatever they do."""
        return self._called(lambda command: "pipeline.run.executors.worker" in command)

    def blenders(self) -> list[psutil.Process]:
        """Blender executables that serve frames."""
        return self._called(lambda command: "render_frames.py" in command)

    def left_over(self, within_s: float) -> list[str]:
        """What still lives after so long [s] when nothing should; it is ended then, so that it troubles no others."""
        until = time.monotonic() + within_s
        while living := self.living():
            if time.monotonic() > until:
                told = [" ".join(words_of(each))[:120] or f"process {each.pid}" for each in living]
                for each in living:
                    with contextlib.suppress(psutil.NoSuchProcess):  # it ended just now
                        each.send_signal(signal.SIGKILL)
                return told
            time.sleep(0.02)
        return []

    def _called(self, is_meant: Callable[[str], bool]) -> list[psutil.Process]:
        return [each for each in self.living() if is_meant(" ".join(words_of(each)))]
