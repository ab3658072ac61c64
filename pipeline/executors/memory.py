"""How much memory processes use, and whether the kernel killed one for want of it (Linux)."""

from __future__ import annotations

import resource
import sys
from contextlib import suppress
from pathlib import Path

_CLEAR_REFS_RESET_PEAK = "5"  # proc(5): resets the peak resident set size, VmHWM


def reset_peak_memory() -> None:
    """Start a new measurement of this process's peak, where the kernel allows that."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text(_CLEAR_REFS_RESET_PEAK)


def peak_memory_bytes() -> int:
    """Largest resident memory of this process since `reset_peak_memory`, or of its largest ended child."""
    unit = 1 if sys.platform == "darwin" else 1024
    children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * unit
    own = _status_bytes("VmHWM") or resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
    return max(own, children)


def resident_memory_bytes() -> int:
    """Resident memory of this process now; 0 when the system does not tell."""
    return _status_bytes("VmRSS") or 0


def out_of_memory_kills() -> int:
    """How many processes the kernel has killed for want of memory: of this control group, else of the machine.

    A rise of this number is the evidence that a SIGKILL came from the kernel and not from a person.
    """
    for path in (_control_group_events(), Path("/proc/vmstat")):
        count = None if path is None else read_oom_kills(path)
        if count is not None:
            return count
    return 0


def read_oom_kills(path: Path) -> int | None:
    """The `oom_kill` line of /proc/vmstat or of a control group's memory.events; None if there is none."""
    with suppress(OSError):
        for line in path.read_text().splitlines():
            name, _, value = line.partition(" ")
            if name == "oom_kill":
                return int(value)
    return None


def _control_group_events() -> Path | None:
    with suppress(OSError):
        for line in Path("/proc/self/cgroup").read_text().splitlines():
            hierarchy, _, group = line.split(":", 2)
            if hierarchy == "0":
                return Path("/sys/fs/cgroup") / group.lstrip("/") / "memory.events"
    return None


def _status_bytes(field: str) -> int | None:
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            name, _, value = line.partition(":")
            if name == field:
                return int(value.split()[0]) * 1024
    return None
