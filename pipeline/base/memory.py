"""Memory of processes, and kills by the kernel for want of it (Linux)."""

import os
import resource
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import psutil

_CLEAR_REFS_RESET_PEAK = "5"  # proc(5): resets the peak resident set size, VmHWM


def reset_peak_memory() -> None:
    """Start a new measurement of this process's peak, where the kernel allows that."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text(_CLEAR_REFS_RESET_PEAK)


def peak_memory_bytes() -> int:
    """Largest resident memory of this process since `reset_peak_memory`, or of its largest ended child."""
    unit = 1 if sys.platform == "darwin" else 1024
    children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * unit
    own = _peak_since_reset_bytes() or resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
    return max(own, children)


def resident_memory_bytes(pid: int) -> int:
    """Resident memory of a process now; 0 when it has ended."""
    with suppress(psutil.Error):
        return int(psutil.Process(pid).memory_info().rss)
    return 0


def process_tree(pid: int) -> list[int]:
    """A process and all that it started, theirs included; those that have ended are left out.

    Linux tells the children of each thread. Asking for the parent of every process of the machine, as is done
    elsewhere, takes some milliseconds, too much to be done twice a second.
    """
    if not Path(f"/proc/self/task/{os.getpid()}/children").exists():
        with suppress(psutil.Error):
            return [pid, *(child.pid for child in psutil.Process(pid).children(recursive=True))]
        return []
    found = [pid]
    for each in found:  # grows while it is walked
        found += _children(each)
    return found


def tree_memory_bytes(pid: int) -> int:
    """Resident memory of a process and all that it started; memory that they share counts once for each."""
    return sum(resident_memory_bytes(each) for each in process_tree(pid))


def machine_memory_bytes() -> int:
    """Memory of the machine, or what the control group of this process leaves of it, as a container's does."""
    total = int(psutil.virtual_memory().total)
    for folder in _control_groups():
        with suppress(OSError, ValueError):  # "max" is no number, and no limit
            total = min(total, int((folder / "memory.max").read_text()))
        with suppress(OSError, ValueError):  # version 1; without a limit it is larger than any machine
            total = min(total, int((folder / "memory.limit_in_bytes").read_text()))
    return total


def out_of_memory_kills() -> int:
    """Number of processes that the kernel killed for want of memory: of this control group, else of the machine.

    A rise of this number is the evidence that a SIGKILL came from the kernel and not from a person.
    """
    groups = [folder / name for folder in _control_groups() for name in ("memory.events", "memory.oom_control")]
    for path in (*groups, Path("/proc/vmstat")):
        count = read_oom_kills(path)
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


def _control_groups() -> list[Path]:
    """Folders of this process's control group of memory and of those around it, the innermost first."""
    folders: list[Path] = []
    with suppress(OSError):
        for line in Path("/proc/self/cgroup").read_text().splitlines():
            hierarchy, controllers, group = line.split(":", 2)
            if hierarchy == "0" or "memory" in controllers.split(","):  # version 2, and version 1
                base = Path("/sys/fs/cgroup") if hierarchy == "0" else Path("/sys/fs/cgroup/memory")
                inner = base / group.lstrip("/")
                folders += [folder for folder in (inner, *inner.parents) if folder.is_relative_to(base)]
    return folders


def _children(pid: int) -> Iterator[int]:
    with suppress(OSError):
        for thread in os.listdir(f"/proc/{pid}/task"):  # noqa: PTH208 - names are all that is wanted
            with suppress(OSError):
                yield from map(int, Path(f"/proc/{pid}/task/{thread}/children").read_text().split())


def _peak_since_reset_bytes() -> int | None:
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    return None
