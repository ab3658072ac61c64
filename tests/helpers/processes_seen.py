"""Looking at processes that may end at any moment: one that has ended answers, it does not raise."""

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
    """The words of its command line; none once it has ended."""
    try:
        return list(process.cmdline())
    except psutil.NoSuchProcess:
        return []
