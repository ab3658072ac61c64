"""Faults from within: Python imports this module in every process of a campaign, for its folder is on PYTHONPATH.

The folder that CAMPAIGN_CONTROL names says what goes wrong; files appear and vanish in it while processes run:

- `clock`: seconds that `time.time` is wrong by.
- `refuse`: an error number; nothing below the job's folder can be opened for writing, renamed or made.
- `failpoint`: `ROLE SIGNAL PATTERN`; the first process of that role that is about to do what matches takes the file
  and gets the signal. What it was about to do is one line, such as `os.rename PART ARTIFACT`.
- `balloon`: bytes; the next worker that opens a file for writing takes the file and holds so much memory for a while.

Every receipt that is about to be put in place is noted in `commits`, a line each.
"""

import os
import re
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

CONTROL = os.environ.get("CAMPAIGN_CONTROL", "")
WATCHED = {"open", "os.rename", "os.link", "os.remove", "os.mkdir", "subprocess.Popen", "sqlite3.connect"}
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT
_HELD_S = 10.0
_busy = threading.local()


def _said(name: str) -> str:
    """What a control file says; nothing where it is not there."""
    with suppress(OSError), open(f"{CONTROL}/{name}", encoding="utf-8") as file:  # noqa: PTH123 - this runs a lot
        return file.read()
    return ""


def _role() -> str:
    command = " ".join(sys.orig_argv)
    if "pipeline.run.executors.worker" in command:
        return "worker"
    return "runner" if "-m pipeline submit" in command else "other"


def _deed(event: str, arguments: tuple[object, ...]) -> str:
    """What is about to happen, in a line; nothing where no fault goes by it."""
    if event == "open":
        path, _, flags = arguments
        return f"open {path}" if isinstance(path, str) and isinstance(flags, int) and flags & _WRITING else ""
    if event == "subprocess.Popen":
        return f"{event} {arguments[1]}"
    return " ".join([event, *(os.fsdecode(each) for each in arguments[:2] if isinstance(each, str | bytes | Path))])


def _watch(event: str, arguments: tuple[object, ...]) -> None:
    if event not in WATCHED or getattr(_busy, "now", False):
        return
    _busy.now = True
    try:
        deed = _deed(event, arguments)
        if deed:
            _note_commit(deed)
            _refuse(deed)
            _fail(deed)
            _grow()
    finally:
        _busy.now = False


def _note_commit(deed: str) -> None:
    target = deed.rpartition(" ")[2]
    if deed.startswith("os.rename ") and "/.receipts/" in target:
        with open(f"{CONTROL}/commits", "a", encoding="utf-8") as file:  # noqa: PTH123
            file.write(target.partition("/.receipts/")[2] + "\n")


def _refuse(deed: str) -> None:
    number = _said("refuse")
    if number and "/renders/" in deed and deed.startswith(("open", "os.rename", "os.mkdir")):
        raise OSError(int(number), os.strerror(int(number)), deed.rpartition(" ")[2])


def _fail(deed: str) -> None:
    said = _said("failpoint")
    if not said:
        return
    role, number, pattern = said.split(" ", 2)
    if role == ROLE and re.search(pattern, deed):
        with suppress(FileNotFoundError):  # another process was quicker
            os.rename(f"{CONTROL}/failpoint", f"{CONTROL}/failpoint.hit")  # noqa: PTH104
            os.kill(os.getpid(), int(number))


def _grow() -> None:
    said = _said("balloon") if ROLE == "worker" else ""
    if said:
        with suppress(FileNotFoundError):
            os.rename(f"{CONTROL}/balloon", f"{CONTROL}/balloon.hit")  # noqa: PTH104
            balloon = bytearray(b"x") * int(said)
            time.sleep(_HELD_S)
            del balloon


if CONTROL:
    ROLE = _role()
    _true_time = time.time
    time.time = lambda: _true_time() + float(_said("clock") or 0.0)
    sys.addaudithook(_watch)
