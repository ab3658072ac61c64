"""Load of this machine, and the processes of a job on it."""

import platform
import shutil
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import psutil

from pipeline.base.lease import LeaseHolder

LEAST_BYTES = 16 * 2**20
"""Smaller processes only mind the others'; they compute nothing."""
LEAST_INTERVAL_S = 0.5
"""A process is counted anew this long after the look before at the earliest [s], however many pages ask."""


class Load(NamedTuple):
    """The machine at a moment: shares [-], free disk space [bytes], cores."""

    processor: float
    memory: float
    disk_used: float
    disk_free: int
    cores: int


class Process(NamedTuple):
    """A process of a run: what it takes of the processor [cores] and of the memory [bytes]."""

    pid: int
    role: str
    cores: float
    memory_bytes: int


class _Counted(NamedTuple):
    """A process at a look [s]: when that was, its processor time until then, and the cores that it took before it."""

    when: float
    spent: float
    cores: float


@dataclass
class Machine:
    """This machine; processor time is that since the look before. Safe to share between threads."""

    farm: Path
    _seen: dict[int, _Counted] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def __post_init__(self) -> None:
        self._counted = _counted()

    def load(self) -> Load:
        """The load now. Raises OSError if the farm's disk does not answer."""
        disk = shutil.disk_usage(self.farm)
        before, self._counted = self._counted, _counted()
        busy, all_of_it = (now - then for now, then in zip(self._counted, before, strict=True))
        return Load(
            processor=min(1.0, max(0.0, busy / all_of_it)) if all_of_it > 0 else 0.0,
            memory=psutil.virtual_memory().percent / 100.0,
            disk_used=disk.used / disk.total if disk.total else 0.0,
            disk_free=disk.free,
            cores=psutil.cpu_count() or 1,
        )

    def processes(self, holder: LeaseHolder | None) -> list[Process]:
        """The runner that holds a job and its workers; none if it runs on another machine."""
        if holder is None or holder.host != platform.node():
            return []
        found = []
        with self._lock:
            try:
                runner = psutil.Process(holder.pid)
                for process in (runner, *runner.children(recursive=True)):
                    cores = self._cores(process)
                    role = "runner" if process.pid == holder.pid else "worker"
                    memory_bytes = process.memory_info().rss
                    if memory_bytes >= LEAST_BYTES:
                        found.append(Process(process.pid, role, cores, memory_bytes))
            except psutil.Error:
                pass  # one that ends in this moment; the next look sees the others
            self._seen = {pid: counted for pid, counted in self._seen.items() if psutil.pid_exists(pid)}
        return found

    def _cores(self, process: psutil.Process) -> float:
        """What a process takes of the processor [cores]; over a shorter time its ticks of 10 ms would show."""
        times, now = process.cpu_times(), time.monotonic()
        spent = times.user + times.system
        before = self._seen.get(process.pid)
        if before is None:
            self._seen[process.pid] = _Counted(now, spent, 0.0)
        elif now - before.when >= LEAST_INTERVAL_S:
            self._seen[process.pid] = _Counted(now, spent, max(0.0, (spent - before.spent) / (now - before.when)))
        return self._seen[process.pid].cores


def _counted() -> tuple[float, float]:
    """Processor time of all cores since the start [s]: busy, and all of it.

    Not psutil's own percentage: that counts by the thread that asks, and requests come in ever other threads.
    """
    times = psutil.cpu_times()._asdict()
    whole = sum(seconds for name, seconds in times.items() if not name.startswith("guest"))  # which user has, too
    return whole - times["idle"] - times.get("iowait", 0.0), whole
