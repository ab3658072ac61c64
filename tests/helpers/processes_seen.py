"""Looking at processes that may end at any moment: one that has ended answers, it does not raise."""

import time

import psutil


def lives(process: psutil.Process) -> bool:
    """Whether a process still runs. A zombie, which nobody has collected yet, does not."""
    try:
        return bool(process.is_running() and process.status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False


def pid_lives(pid: int) -> bool:
    """Likewise, of the process that has a number now, if there is one."""
    try:
        return lives(psutil.Process(pid))
    except psutil.NoSuchProcess:
        return False


def words_of(process: psutil.Process) -> list[str]:
    """The words of its command line; none once it has ended, or where others may not know them."""
    try:
        return list(process.cmdline())
    except (psutil.NoSuchProcess, psutil.AccessDenied):
        return []


def began_by(process: psutil.Process) -> str:
    """The test that began a process, by its environment; empty if none did, or if it has ended."""
    try:
        return process.environ().get("PYTEST_CURRENT_TEST", "").partition(" ")[0]
    except (psutil.NoSuchProcess, psutil.AccessDenied):
        return ""


def busiest(count: int = 6, within_s: float = 0.5) -> list[str]:
    """The processes of this machine that are busiest just now, a line each: what a slow test may have waited for."""
    before = {process: _seconds(process) for process in psutil.process_iter()}
    time.sleep(within_s)
    shares = {process: (_seconds(process) - start) / within_s for process, start in before.items()}
    first = sorted(shares, key=lambda process: shares[process], reverse=True)[:count]
    return [
        f"{shares[process]:.0%} {process.pid} {' '.join(words_of(process))[:100]} {began_by(process)}".rstrip()
        for process in first
        if shares[process] > 0.0
    ]


def _seconds(process: psutil.Process) -> float:
    try:
        times = process.cpu_times()
    except (psutil.NoSuchProcess, psutil.AccessDenied):
        return 0.0
    return float(times.user + times.system)
